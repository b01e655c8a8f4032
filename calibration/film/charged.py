"""The film's capacitance as data beside its force: residuals of one least-squares problem, and their derivatives.

The capacitance of the deformed film is ``eps_r c(h, V)``, and c depends on the law and on eps_r only as far as the
shape under load does. So c and its derivatives are worked out once a pass of the fit, at the film where the pass
begins, and taken as linear; the passes end when that is as good as the model itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.charge import NotResolved
from calibration.electrical.rows import Currents
from calibration.film.differences import DIMENSIONS
from model.material.materials import Material
from model.membrane.solve import solve
from model.specimen import Specimen

Array = NDArray[np.float64]

STEP = 2e-3  # relative, of what the capacitance is differentiated by
LEAST = 1e-3  # of the shear modulus: a smaller modulus changes as if it were so large
STEP_M = 1e-5  # of the displacement
KINDS = {"current_gain": "1", "cable": "F", "current_step": "A"}  # errors that all readings share, and their unit


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Weighted rows of S films, (S, m): residuals; slopes by capacitances at all nodes and by the shared errors.

    ``by_mu``, ``by_alpha``, ``by_eps_r`` are (S, m, numbers) and (S, m), ``by_kind`` (S, m) for one unit of each.
    """

    residual: Array
    by_mu: Array
    by_alpha: Array
    by_eps_r: Array
    by_kind: dict[str, Array]
    by_h: Array  # (S, P, m): by the displacement of each place


class ChargeModel:
    """The capacitances of a film near ``at``, held against currents; ``whole`` False leaves out what the law does.

    Places without a state of the film are left out, ``left_out`` of them. Raises `NotResolved` where the others do not
    tell the capacitance.
    """

    def __init__(self, currents: Currents, at: Material, *, whole: bool = True) -> None:
        specimen = currents.specimen.with_material(at)
        at_once = _capacitances(currents, specimen)
        lost = np.asarray(~np.isfinite(at_once).all(axis=1))
        self.left_out = int(np.count_nonzero(lost))
        if self.left_out:
            currents, at_once = _without(currents, lost, at), at_once[~lost]
        self.currents, self.at, self.specimen = currents, at, specimen
        self.per_eps = at_once / at.eps_r  # F, (P, N)
        self.whole = whole

    @property
    def size(self) -> int:
        """Residual rows."""
        return int(self.currents.target.size)

    @cached_property
    def _by_law(self) -> tuple[Array, Array, Array]:
        """Derivatives of c by mu (P, N, moduli), alpha (P, N, shapes) and eps_r (P, N)."""

        def slope(film: Material, change: float) -> Array:
            moved = _capacitances(self.currents, self.specimen.with_material(film)) / film.eps_r
            found: Array = np.nan_to_num((moved - self.per_eps) / change)
            return found

        by = []
        for name in ("mu", "alpha"):
            values = getattr(self.at, name)
            sides = []
            for k, value in enumerate(values):
                change = STEP * max(abs(value), LEAST * self.at.shear_modulus if name == "mu" else LEAST)
                moved = (*values[:k], value + change, *values[k + 1 :])
                film = replace(self.at, mu=moved) if name == "mu" else replace(self.at, alpha=moved)
                sides.append(slope(film, change))
            by.append(np.stack(sides, axis=-1) if sides else np.zeros((*self.per_eps.shape, 0)))
        change = -STEP * self.at.eps_r  # towards the film that surely holds the voltage
        return by[0], by[1], slope(replace(self.at, eps_r=self.at.eps_r + change), change)

    @cached_property
    def by_h(self) -> Array:
        """Relative change of c by the displacement (1/m), (P, N)."""
        moved = _capacitances(self.currents, self.specimen, more=STEP_M) / self.at.eps_r
        return np.asarray(np.nan_to_num((moved / self.per_eps - 1.0) / STEP_M))

    def evaluate(self, films: Sequence[Material], errors: Mapping[str, Array], shift: Array) -> Evaluated:
        """Rows of S films with the shared errors (S,), each place displaced by ``shift`` (S, P) metres."""
        eps = np.array([film.eps_r for film in films])[:, None, None]
        if self.whole:
            by_mu, by_alpha, by_eps = self._by_law
            mu, alpha = (np.array([getattr(f, n) for f in films]) - getattr(self.at, n) for n in ("mu", "alpha"))
            c = self.per_eps + by_eps * (eps - self.at.eps_r)
            c = c + np.einsum("pnk,sk->spn", by_mu, mu) + np.einsum("pnk,sk->spn", by_alpha, alpha)
        else:  # the films may have another number of terms than the one that the pass begins with
            by_mu, by_alpha = (np.zeros((*self.per_eps.shape, len(of))) for of in (films[0].mu, films[0].alpha))
            by_eps = np.zeros_like(self.per_eps)
            c = np.broadcast_to(self.per_eps, (len(films), *self.per_eps.shape))
        stretched = 1.0 + self.by_h * shift[:, :, None] if shift.any() else 1.0
        film = eps * c * stretched
        gain = 1.0 + errors.get("current_gain", np.zeros(len(films)))[:, None]
        cable = self.currents.known.cable_F + errors.get("cable", np.zeros(len(films)))[:, None, None]
        steps = errors.get("current_step", np.zeros(len(films)))[:, None] * self.currents.step
        bare = self.project(film + cable)
        root = self.currents.root.reshape(self.size, *film.shape[1:])
        gained = gain[:, :, None]
        return Evaluated(
            residual=gain * bare + steps - self.currents.target,
            by_mu=gained * np.einsum("mpn,spnk->smk", root, eps[..., None] * by_mu),
            by_alpha=gained * np.einsum("mpn,spnk->smk", root, eps[..., None] * by_alpha),
            by_eps_r=gain * self.project((c + eps * by_eps) * stretched),
            by_kind={
                "current_gain": bare,
                "cable": gain * self.project(np.ones_like(film)),
                "current_step": np.broadcast_to(self.currents.step, bare.shape),
            },
            by_h=gained * np.einsum("mpn,spn->spm", root, eps * c * self.by_h),
        )

    def project(self, capacitances: Array) -> Array:
        """Weighted rows (..., m) of capacitances (F) at the nodes, (..., P, N)."""
        return np.asarray(capacitances.reshape(*capacitances.shape[:-2], -1) @ self.currents.root.T)

    def off(self, film: Material) -> float:
        """How far the linear model is off that of a film: the largest weighted row."""
        shift = np.zeros((1, len(self.currents.places)))
        linear = self.evaluate([film], {}, shift).residual[0]
        exact = _capacitances(self.currents, self.specimen.with_material(film))
        rows = self.project(exact + self.currents.known.cable_F) - self.currents.target
        return float(np.abs(rows - linear).max())

    @cached_property
    def systematic(self) -> dict[str, Array]:
        """What a relative change by 1 of a dimension, of ``h`` and of ``voltage`` does to the rows, (m,) each."""
        eps, found = self.at.eps_r, {}
        for name in DIMENSIONS:
            moved = replace(self.specimen, **{name: getattr(self.specimen, name) * (1.0 + STEP)})
            change = _capacitances(self.currents, moved) - eps * self.per_eps
            found[name] = self.project(np.nan_to_num(change) / STEP)
        found["h"] = self.project(eps * self.per_eps * self.by_h * self.currents.h[:, None])
        fewer = _capacitances(self.currents, self.specimen, factor=1.0 - STEP)
        by_voltage = np.nan_to_num(eps * self.per_eps - fewer) / STEP  # at a voltage that is higher by 1, relative
        found["voltage"] = self.project(eps * self.per_eps + self.currents.known.cable_F + by_voltage)
        return found


def _without(currents: Currents, lost: NDArray[np.bool_], film: Material) -> Currents:
    """Currents without the places that are lost, where the film has no state."""
    try:
        return currents.without(lost)
    except NotResolved as error:
        raise NotResolved(
            f"a film with eps_r = {film.eps_r:.3g} and a shear modulus of {film.shear_modulus:.3g} Pa has no state at "
            f"the voltages of the currents in {np.count_nonzero(lost)} of {lost.size} displacements, and the others do "
            "not tell the capacitance. Correct eps_r or the moduli of the material in the scene, which the fit begins "
            "with, or fit without the charge"
        ) from error


def _capacitances(currents: Currents, specimen: Specimen, *, more: float = 0.0, factor: float = 1.0) -> Array:
    """Capacitance (F) at all nodes, displaced by ``more`` (m), voltages times ``factor``; NaN where no state is."""
    found = np.full(currents.nodes.shape, np.nan)
    for p, place in enumerate(currents.places):
        for n, volts in enumerate(place.nodes.tolist()):
            state = solve(specimen, max(place.h + more, 0.0), volts * factor, wrinkling="tension_field")
            if state.answered:
                found[p, n] = state.capacitance()
    return found
