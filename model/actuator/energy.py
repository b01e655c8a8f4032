"""Energy of a film and its charge, from its profile: the balance of an actuator's work that no force enters.

At a displacement ``h`` and voltage ``V`` the film stores ``U = integral 2 pi R (T/lp^2) W dR`` in its elastomer and
``C V^2/2`` between its electrodes, ``C = eps integral 2 pi R (l1 l2)^2 / (lp^2 T) dR``, in folds with the natural
width. The source that holds the voltage gives ``V dQ`` with ``Q = C V``, and the bias gives ``B dh``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from model.actuator.equilibrium import Actuator
from model.actuator.stroke import balancing, clenshaw_curtis, quadrature
from model.arrays import Array
from model.material.law import stack
from model.membrane.solve import Wrinkling, solve
from model.specimen import Specimen

PROFILE = 33  # points an element
PANELS, NODES = 16, 5  # of the path: where folds begin and end it has kinks


@dataclass(frozen=True)
class Stored:
    """What a film holds: elastic energy (J), charge (C), voltage (V)."""

    elastic: float
    charge: float
    voltage: float

    @property
    def electric(self) -> float:
        """``C V^2/2`` (J)."""
        return 0.5 * self.charge * self.voltage

    @property
    def at_voltage(self) -> float:
        """``U - C V^2/2`` (J): its derivative with respect to h at constant voltage is the force."""
        return self.elastic - self.electric


def stored(film: Specimen, h: float, voltage: float, wrinkling: Wrinkling, tolerance: float = 1e-9) -> Stored:
    """Elastic energy and charge of a film.

    Raises
    ------
    ValueError : the state has no answer
    """
    p = solve(film, h, voltage, tolerance=tolerance, wrinkling=wrinkling).profile(PROFILE)
    material = film.material
    l1, l2 = p.stretch_1, p.stretch_2
    law = material.law(np.array(material.mu)[:, None], np.array(material.alpha)[:, None])
    density = law.energy(stack(np.log(l1), np.log(l2)))
    ring = 2.0 * np.pi * p.R**2 / film.prestretch**2  # dR = R dx
    weights = _weights(np.log(p.R))
    elastic = float((ring * film.thickness * density) @ weights)
    capacitance = float((ring * material.permittivity / film.thickness * (l1 * l2) ** 2) @ weights)
    return Stored(elastic, capacitance * voltage, voltage)


def _weights(x: Array) -> Array:
    """Clenshaw-Curtis over the profile's elements, which share their ends."""
    pieces = (len(x) - 1) // (PROFILE - 1)
    weights = np.zeros(len(x))
    one = clenshaw_curtis(PROFILE - 1)
    for first in range(0, pieces * (PROFILE - 1), PROFILE - 1):
        weights[first : first + PROFILE] += (x[first + PROFILE - 1] - x[first]) * one
    return weights


def _panels() -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights in equal panels of 0 to 1."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    nodes = (np.arange(PANELS)[:, None] + 0.5 * (1.0 + x)) / PANELS
    return nodes.ravel(), np.tile(0.5 * w / PANELS, PANELS)


@dataclass(frozen=True)
class EnergyBalance:
    """Where the energy of a stroke comes from and goes (J). Without a snap nothing is lost: the sums agree.

    Attributes
    ----------
    work : what a load takes at constant voltage, by the film's energy: bias work minus the change of ``U - C V^2/2``
    source, bias : what voltage source and bias give along the equilibria, from rest to the end
    elastic, electric : what the film holds more at the end than at rest
    efficiency : work over what the source gives while the disk moves at constant voltage
    """

    work: float
    source: float
    bias: float
    elastic: float
    electric: float
    efficiency: float

    @property
    def residual(self) -> float:
        """What is given and not found again, over the largest of the sums."""
        largest = max(abs(self.source), abs(self.bias), abs(self.elastic), abs(self.electric))
        return (self.source + self.bias - self.elastic - self.electric) / largest


def work_by_energy(
    actuator: Actuator, rest: float, reached: float, voltage: float, wrinkling: Wrinkling | None = None
) -> float:
    """Bias work minus the change of the film's energy at constant voltage (J): the work without any force of the film.

    NaN where the film goes slack on the way.
    """
    kind = wrinkling or actuator.wrinkling
    try:
        held, done = (stored(actuator.film, h, voltage, kind) for h in (rest, reached))
    except ValueError:
        return math.nan
    return _bias_work(actuator, rest, reached) - (done.at_voltage - held.at_voltage)


def _bias_work(actuator: Actuator, rest: float, reached: float) -> float:
    nodes, weights, _ = quadrature()
    return float((reached - rest) * (actuator.bias.force(rest + (reached - rest) * nodes) @ weights))


def energy_balance(actuator: Actuator, rest: float, reached: float, voltage: float) -> EnergyBalance:
    """The energy balance of a stroke without snaps, from `model.actuator.stroke.strokes`.

    Raises
    ------
    ValueError : the film goes slack on the way, or the way is no path of equilibria
    """
    kind, film = actuator.wrinkling, actuator.film
    idle, done = stored(film, rest, 0.0, kind), stored(film, reached, voltage, kind)
    held = stored(film, rest, voltage, kind)
    share, weights = _panels()
    h = rest + (reached - rest) * share
    there, _ = balancing([actuator], h[None], 1e-10)
    volts = there.voltage[0]
    if not np.isfinite(volts).all():
        raise ValueError("film and bias do not balance everywhere between rest and the end")
    # Q dV = C V (dV/dh) dh, and along the equilibria (dF/dV) dV = (dB/dh - dF/dh) dh.
    charge = np.array([stored(film, x, v, kind).charge for x, v in zip(h, volts, strict=True)])
    rise = -there.stiffness[0] / there.by_voltage[0]
    q_dv = (reached - rest) * float((charge * rise) @ weights)
    work = work_by_energy(actuator, rest, reached, voltage)
    return EnergyBalance(
        work=work,
        source=voltage * done.charge - q_dv,
        bias=_bias_work(actuator, rest, reached),
        elastic=done.elastic - idle.elastic,
        electric=done.electric - idle.electric,
        efficiency=work / (voltage * (done.charge - held.charge)),
    )
