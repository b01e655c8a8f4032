r"""Capacitance of the mounted film as a table: for a supply that charges it all day.

The film keeps its volume, so that where its area has grown by :math:`\lambda_1 \lambda_2` it is thinner by as much:

.. math:: C(h, V) = \frac{\varepsilon}{T \lambda_p^2} \int_a^b 2 \pi R (\lambda_1 \lambda_2)^2 dR

Like the film's force (`rig.sim.film`) it is interpolated in w = (s/s_max)^2 and u = (V/V_c)^2, even in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.specimen import Specimen
from rig.sim.film import FilmTable, FilmTableError, clenshaw, columns, nodes, tabulate

SIZE = (24, 10)
WORST = 1e-3  # relative; above it no table is made


@dataclass(frozen=True)
class Electrodes:
    """Capacitance (F) of one film on one rig; ``error`` is the largest relative difference found between the nodes."""

    film: FilmTable
    error: float
    _columns: list[list[float]]

    def capacitance(self, s: float, voltage: float) -> float:
        """At indentation ``s`` (m), disk and rig sharing the way, and ``voltage`` (V)."""
        x = min(s / self.film.reach, 1.0)
        w, bound = x * x, self.film.bound(s)
        u = min((voltage / bound) ** 2, 1.0) if bound > 0 else 0.0
        return clenshaw([clenshaw(column, w) for column in self._columns], u)


@lru_cache(maxsize=8)
def electrodes(specimen: Specimen, compliance: float) -> Electrodes:
    """The table for ``specimen`` on a rig of ``compliance`` (m/N).

    Raises
    ------
    FilmTableError
        The film has no state somewhere, or its capacitance cannot be interpolated.
    """
    film = tabulate(specimen, compliance, True)
    w, u = nodes(SIZE[0]), nodes(SIZE[1])
    at = np.array([[_exact(specimen, film, compliance, a, b) for b in u.tolist()] for a in w.tolist()])
    table = Electrodes(film, math.inf, columns(at))
    error = 0.0
    for a in (0.0, *(0.5 * (w[1:] + w[:-1])).tolist()):
        for b in (0.0, *(0.5 * (u[1:] + u[:-1]))[::3].tolist()):
            exact = _exact(specimen, film, compliance, a, b)
            s = film.reach * math.sqrt(a)
            error = max(error, abs(table.capacitance(s, film.bound(s) * math.sqrt(b)) / exact - 1.0))
    if not error <= WORST:
        raise FilmTableError(
            f"the capacitance of specimen {specimen.name!r} cannot be simulated: its table is wrong by up to"
            f" {error:.2g} of it; simulate more pre-stretch, or a constant capacitance"
        )
    return Electrodes(film, error, table._columns)


def _exact(specimen: Specimen, film: FilmTable, compliance: float, w: float, u: float) -> float:
    from model.membrane.solve import solve

    s = film.reach * math.sqrt(w)
    voltage = film.bound(s) * math.sqrt(u)
    state = solve(specimen, s - compliance * film.force(s, voltage), voltage, wrinkling="tension_field")
    if not state.answered:
        raise FilmTableError(f"no membrane solution for the film at {s * 1e3:.4g} mm and {voltage:.4g} V")
    return state.capacitance()
