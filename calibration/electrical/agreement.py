"""Whether force and charge say the same of one film: what a fit of both states of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from calibration.electrical.charge import Capacitance

CHANCE = 0.01  # probability below which a difference is not put down to chance
PART = "force against charge"  # in the budget of a permittivity that the two do not agree on
AGREE, SOFTENED, CONTRADICT = "agree", "agree if the film softened", "contradict"


@dataclass(frozen=True)
class Difference:
    """By how much the capacitance measured is above what the force says of it (relative), and its standard uncertainty.

    Errors that force and charge share are counted once. ``probability`` is that of as much by chance.
    """

    relative: float
    standard_uncertainty: float

    @property
    def deviations(self) -> float:
        """The difference in standard uncertainties; 0 where the data know nothing of it."""
        return self.relative / self.standard_uncertainty if math.isfinite(self.standard_uncertainty) else 0.0

    @property
    def probability(self) -> float:
        """Of as much by chance."""
        return math.erfc(abs(self.deviations) / math.sqrt(2.0))

    @property
    def significant(self) -> bool:
        """Whether it is no chance."""
        return self.probability < CHANCE


@dataclass(frozen=True)
class Charged:
    """What the current says beside the force.

    Attributes
    ----------
    plain : Difference
        With a film that does not soften.
    softening : Difference or None
        With one that may lose a part of its force from each curve to the next; None where it was not fitted along.
    softened : tuple of float or None
        That part and its standard uncertainty, by force and charge together.
    told_apart : bool
        Whether the forces alone would tell softening of this size from a current whose gain is wrong.
    noise, resolution : float
        Standard deviation of a reading of the current, and its smallest step (A).
    samples : int
        Readings on rises of the voltage.
    capacitances : sequence of Capacitance
        d(CV)/dV of film and cable at each place, measured, and by the fit of both.
    """

    plain: Difference
    softening: Difference | None
    softened: tuple[float, float] | None
    told_apart: bool
    noise: float
    resolution: float
    samples: int
    capacitances: Sequence[Capacitance]

    @property
    def verdict(self) -> str:
        """`AGREE`, `SOFTENED` or `CONTRADICT`."""
        allowed = self.softening or self.plain
        grows = self.softened is not None and self.softened[0] < -2.6 * self.softened[1]  # no film does
        if allowed.significant or (grows and self.plain.significant):
            return CONTRADICT
        return SOFTENED if self.plain.significant else AGREE

    @property
    def words(self) -> str:
        """For the operator."""
        apart = f"{100.0 * self.plain.relative:+.2g} % (+- {100.0 * self.plain.standard_uncertainty:.1g} %)"
        if self.verdict == AGREE:
            return f"force and charge agree: the capacitance is {apart} off what the force says"
        if self.verdict == CONTRADICT:
            return (
                f"force and charge contradict each other: the capacitance is {apart} off what the force says, and no "
                "softening explains it. Is the gain of the current as stated, the film's thickness, the capacitance of "
                "cable and output? Neither is right until that is known; the permittivity counts as not certain"
            )
        assert self.softened is not None
        lost = f"{100.0 * self.softened[0]:.2g} % (+- {100.0 * self.softened[1]:.1g} %)"
        text = f"force and charge agree if the film lost {lost} of its force from each curve to the next; else the "
        text += f"capacitance is {apart} off what the force says"
        if self.told_apart:
            return text
        return text + (
            ". A current with a wrong gain would look the same: measure the curve at the first voltage once more at "
            "the end, which tells them apart"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, SI units; what is not known is None."""

        def difference(one: Difference | None) -> dict[str, float | None] | None:
            if one is None or not math.isfinite(one.standard_uncertainty):
                return None
            return {
                "relative": one.relative,
                "standard_uncertainty": one.standard_uncertainty,
                "probability": one.probability,
            }

        return {
            "verdict": self.verdict,
            "difference": difference(self.plain),
            "difference_allowing_softening": difference(self.softening),
            "softening_per_curve": None if self.softened is None else list(self.softened),
            "told_apart": self.told_apart,
            "noise_A": self.noise,
            "resolution_A": self.resolution,
            "samples": self.samples,
            "capacitances": [asdict(one) for one in self.capacitances],
        }
