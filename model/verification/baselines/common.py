"""What the methods of comparison share: the film in dimensionless form, and the answer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model.specimen import Specimen

Array = NDArray[np.float64]
PROFILE = 41  # points along the film from which peak field and least hoop stress are found


@dataclass(frozen=True)
class Result:
    """Answer of a method of comparison.

    ``evaluations`` counts evaluations of the right-hand side (a vectorised one counts its points); ``seconds`` is the
    time that the method measured itself where another program does the work: starting that program is not counted.
    """

    force: float  # N
    peak_field: float  # V/m
    min_hoop_stress: float  # Pa, true stress
    ok: bool
    message: str
    evaluations: int
    start: tuple[float, ...] | None = None  # unknowns of a shooting method, to begin the next solve with
    seconds: float | None = None


def failed(message: str, evaluations: int) -> Result:
    """No answer, and why."""
    return Result(math.nan, math.nan, math.nan, False, message, evaluations)


class Baseline(Protocol):
    """One method of comparison; it solves the plain equations only and never raises for a hard case."""

    def __call__(self, specimen: Specimen, h: float, voltage: float, tolerance: float) -> Result: ...


class OutOfDomain(Exception):
    """A trial state has left the range where the equations mean anything, or the work is out of proportion."""


def largest(values: Array) -> float:
    """Maximum of a smooth function given at equal steps: the quartic through the five points about the largest one."""
    i = int(np.argmax(values))
    if i == 0 or i == len(values) - 1 or len(values) < 5:
        return float(values[i])
    first = min(max(i - 2, 0), len(values) - 5)
    quartic = _QUARTIC @ values[first : first + 5]
    at = float(i - first)
    powers = np.arange(5)
    for _ in range(8):
        slope = float(np.sum(powers[1:] * quartic[1:] * at ** powers[:-1]))
        bend = float(np.sum(powers[2:] * powers[1:-1] * quartic[2:] * at ** powers[:-2]))
        if not bend < 0:
            return float(values[i])
        change = -slope / bend
        at += change
        if abs(change) < 1e-10:
            break
    return float(quartic @ at**powers) if abs(at - (i - first)) <= 1 else float(values[i])


_QUARTIC = np.linalg.inv(np.vander(np.arange(5.0), increasing=True))


class Film:
    """A film in units of its ring radius and shear modulus.

    Its law must be a sum of powers of the stretches: another raises ValueError.

    ``disk`` = a/b, ``height`` = h/b, ``terms`` = pairs (mu/G, alpha), ``electric`` = eps (V/T)^2 / G.
    """

    def __init__(self, specimen: Specimen, h: float, voltage: float) -> None:
        material = specimen.material
        shear = material.shear_modulus
        self.specimen = specimen
        self.voltage = voltage
        self.disk = specimen.disk_radius / specimen.ring_radius
        self.lp = specimen.prestretch
        self.height = h / specimen.ring_radius
        moduli, exponents = material.powers
        self.mu = np.array(moduli) / shear
        self.alpha = np.array(exponents)
        self.terms = tuple(zip(self.mu.tolist(), self.alpha.tolist(), strict=True))
        self.electric = material.permittivity * (voltage / specimen.thickness) ** 2 / shear

    def stresses(self, l1: Array, l2: Array) -> tuple[Array, Array]:
        """True stresses over G."""
        along = np.power.outer(l1, self.alpha)
        across = np.power.outer(l2, self.alpha)
        through = np.power.outer(l1 * l2, -self.alpha)
        maxwell = self.electric * (l1 * l2) ** 2
        return (along - through) @ self.mu - maxwell, (across - through) @ self.mu - maxwell

    def stiffness(self, l1: Array, l2: Array) -> tuple[Array, Array, Array]:
        """``ds1/de1``, ``ds1/de2 = ds2/de1`` and ``ds2/de2`` over G, with ``e`` the logarithmic stretches."""
        weight = self.mu * self.alpha
        maxwell = 2 * self.electric * (l1 * l2) ** 2
        through = np.power.outer(l1 * l2, -self.alpha) @ weight - maxwell
        return (
            np.power.outer(l1, self.alpha) @ weight + through,
            through,
            np.power.outer(l2, self.alpha) @ weight + through,
        )

    def answer(
        self,
        pull: float,
        l1: Array,
        l2: Array,
        evaluations: int,
        *,
        start: tuple[float, ...] | None = None,
        seconds: float | None = None,
    ) -> Result:
        """From the dimensionless pull ``(R/b) S1 sin(theta)`` and the stretches at equal steps along the film to SI."""
        specimen = self.specimen
        shear = specimen.material.shear_modulus
        s1, s2 = self.stresses(l1, l2)
        if not (math.isfinite(pull) and bool(np.all(s1 > 0))):
            return failed("the film found is not in tension along the meridian", evaluations)
        force = 2 * math.pi * specimen.ring_radius * specimen.thickness / self.lp * shear * pull
        peak = abs(self.voltage) / specimen.thickness * largest(l1 * l2)
        least = -shear * largest(-s2)
        return Result(force, peak, least, True, "solved", evaluations, start, seconds)

    def power_law(self, radius: Array) -> Array:
        """First guess of (ln l1, ln l2, theta, z): ``r = R`` and slopes ``dz/dR ~ R^(-1/n)``, shape (4, points).

        ``R S1 sin(theta)`` is the same at every radius; n is the logarithmic derivative of ``S1 sin(theta)`` by the
        slope, at the mean slope (1 where the film has no tension there).
        """
        mean = self.height / (1.0 - self.disk)
        mean_l1 = np.array([self.lp * math.hypot(1.0, mean)])
        l2 = np.array([self.lp])
        (s1,), _ = self.stresses(mean_l1, l2)
        (s11,), _, _ = self.stiffness(mean_l1, l2)
        part = mean * mean / (1.0 + mean * mean)  # d ln(l1) / d ln(slope); S1 sin(theta) = s1 slope / (l1^2 / lp)
        power = 1.0 - 2.0 * part + part * s11 / s1 if s1 > 0.0 else 1.0
        power = power if power > 0.5 else 1.0

        def rise(at: Array) -> Array:
            """The integral of ``R^(-1/n)`` from the disk."""
            if abs(power - 1.0) < 1e-9:
                return np.log(at / self.disk)
            exponent = 1.0 - 1.0 / power
            return np.asarray((at**exponent - self.disk**exponent) / exponent)

        scale = self.height / float(rise(np.ones(1))[0])
        slope = scale * radius ** (-1.0 / power)
        l1 = self.lp * np.hypot(1.0, slope)
        return np.stack([np.log(l1), np.full_like(l1, math.log(self.lp)), np.arctan(slope), scale * rise(radius)])

    def cone(self) -> tuple[float, float]:
        """Meridional stretch and slope of a straight cone: the plainest guess."""
        slope = self.height / (1.0 - self.disk)
        return self.lp * math.hypot(1.0, slope), math.atan(slope)
