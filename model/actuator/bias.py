"""What pushes against a film: spring, mass, second cone, bistable mechanism, measured law. One smooth force each.

``force(h)`` is the force on the disk (N), positive when it pushes the disk to positive h; ``slope(h)`` is dB/dh (N/m);
``reach`` is the range of h over which the law holds (m).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from model.arrays import Array
from model.membrane.solve import Status, Wrinkling, solve_many
from model.specimen import Specimen

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


class Bias(Protocol):
    """A law of force against displacement of the disk."""

    @property
    def reach(self) -> tuple[float, float]: ...

    def force(self, h: Array) -> Array: ...

    def slope(self, h: Array) -> Array: ...


def _number(name: str, value: float, *, positive: bool = False) -> float:
    if not math.isfinite(value) or (positive and not value > 0.0):
        raise ValueError(f"{name} = {value!r}; it must be {'positive and ' if positive else ''}finite")
    return float(value)


@dataclass(frozen=True)
class Spring:
    """A compression spring: ``B = F0 - K h``, until it is at its free length.

    Parameters
    ----------
    preload : F0, its force with the film flat (N)
    stiffness : K (N/m)
    """

    preload: float
    stiffness: float

    def __post_init__(self) -> None:
        _number("spring: preload", self.preload, positive=True)
        _number("spring: stiffness", self.stiffness, positive=True)

    @property
    def reach(self) -> tuple[float, float]:
        return 0.0, self.preload / self.stiffness

    def force(self, h: Array) -> Array:
        return np.asarray(self.preload - self.stiffness * np.asarray(h, dtype=float))

    def slope(self, h: Array) -> Array:
        return np.full(np.shape(h), -self.stiffness)


@dataclass(frozen=True)
class Mass:
    """A hanging mass: ``B = M g``.

    Parameters
    ----------
    weight : M g (N)
    """

    weight: float

    def __post_init__(self) -> None:
        _number("mass: weight", self.weight, positive=True)

    @property
    def reach(self) -> tuple[float, float]:
        return 0.0, math.inf

    def force(self, h: Array) -> Array:
        return np.full(np.shape(h), self.weight)

    def slope(self, h: Array) -> Array:
        return np.zeros(np.shape(h))


@dataclass(frozen=True)
class Antagonist:
    """A second film whose disk is joined to the first one's: ``B(h) = F2(L - h, V2)``.

    Parameters
    ----------
    film : the second film
    spacer : L, the sum of the two displacements (m)
    voltage : V2 (V); 0 for a passive antagonist
    wrinkling : how `model.membrane.solve.solve_many` treats folds in it

    A slack antagonist pushes with no force; where it has no other answer the force is NaN.
    """

    film: Specimen
    spacer: float
    voltage: float = 0.0
    wrinkling: Wrinkling = "tension_field"

    def __post_init__(self) -> None:
        _number("antagonist: spacer", self.spacer, positive=True)
        _number("antagonist: voltage", self.voltage)

    @property
    def reach(self) -> tuple[float, float]:
        return 0.0, self.spacer

    def force(self, h: Array) -> Array:
        return np.asarray(forces([self], np.asarray(h, dtype=float)[None])[0][0])

    def slope(self, h: Array) -> Array:
        return np.asarray(forces([self], np.asarray(h, dtype=float)[None])[1][0])


@dataclass(frozen=True)
class Bistable:
    """A mechanism with a negative rate in its middle: ``B = F_m + k1 (h - h_m) - k3 (h - h_m)^3``.

    Parameters
    ----------
    middle : h_m, where it snaps (m)
    offset : F_m, force in the middle (N)
    rate : k1 > 0, how fast its force grows there in the direction of motion (N/m)
    cubic : k3 > 0 (N/m^3); without a film its two rests are sqrt(k1/k3) off the middle when F_m = 0
    """

    middle: float
    offset: float
    rate: float
    cubic: float

    def __post_init__(self) -> None:
        _number("bistable: middle", self.middle)
        _number("bistable: offset", self.offset)
        _number("bistable: rate", self.rate, positive=True)
        _number("bistable: cubic", self.cubic, positive=True)

    @property
    def reach(self) -> tuple[float, float]:
        return 0.0, math.inf

    def force(self, h: Array) -> Array:
        x = np.asarray(h, dtype=float) - self.middle
        return np.asarray(self.offset + self.rate * x - self.cubic * x**3)

    def slope(self, h: Array) -> Array:
        x = np.asarray(h, dtype=float) - self.middle
        return np.asarray(self.rate - 3.0 * self.cubic * x**2)


@dataclass(frozen=True)
class Tabulated:
    """A measured law: the cubic spline through points, no further than they go.

    Parameters
    ----------
    displacement : h, rising (m), at least four values
    values : B there (N)
    """

    displacement: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", tuple(float(h) for h in self.displacement))
        object.__setattr__(self, "values", tuple(float(f) for f in self.values))
        if len(self.displacement) < 4 or len(self.displacement) != len(self.values):
            raise ValueError(
                f"tabulated bias: {len(self.displacement)} displacements and {len(self.values)} forces; "
                "give as many of each, at least four"
            )
        if not (np.all(np.isfinite(self.values)) and np.all(np.diff(self.displacement) > 0.0)):
            raise ValueError("tabulated bias: displacements must rise, and forces be finite")

    @property
    def reach(self) -> tuple[float, float]:
        return self.displacement[0], self.displacement[-1]

    @cached_property
    def _spline(self) -> CubicSpline:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.displacement, self.values, extrapolate=False)

    def force(self, h: Array) -> Array:
        return np.asarray(self._spline(h))

    def slope(self, h: Array) -> Array:
        return np.asarray(self._spline(h, 1))


def forces(biases: Sequence[Bias], h: Array, tolerance: float = 1e-10) -> tuple[Array, Array]:
    """Force and slope of many biases at ``h`` of shape (biases, ...); all antagonists are solved together."""
    force, slope = np.full(h.shape, np.nan), np.full(h.shape, np.nan)
    cones: dict[Wrinkling, list[int]] = {}
    for i, bias in enumerate(biases):
        if isinstance(bias, Antagonist):
            cones.setdefault(bias.wrinkling, []).append(i)
        else:
            force[i], slope[i] = bias.force(h[i]), bias.slope(h[i])
    for wrinkling, index in cones.items():
        second = [bias for i in index if isinstance(bias := biases[i], Antagonist)]
        tail = (len(index),) + (1,) * (h.ndim - 1)
        films = np.empty(len(index), dtype=object)
        films[:] = [bias.film for bias in second]
        spacer, voltage = (
            np.array([getattr(bias, name) for bias in second]).reshape(tail) for name in ("spacer", "voltage")
        )
        found = solve_many(
            films.reshape(tail),
            spacer - h[index],
            voltage,
            tolerance=tolerance,
            wrinkling=wrinkling,
            sensitivities=True,
        )
        assert found.dforce is not None
        slack = found.status == Status.SLACK
        force[index] = np.where(slack, 0.0, found.force)
        slope[index] = np.where(slack, 0.0, -found.dforce["h"])
    return force, slope
