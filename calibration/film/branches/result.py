"""What a fit says about the branches of a film."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.result import SIGNIFICANT, Quantity, finite, quantity_dict

Array = NDArray[np.float64]

KNOWN_RATIO, KNOWN_TIME = 0.15, 0.3  # relative standard uncertainties up to which a branch is identified
EXPLAINED = 1.5  # times what is expected, up to which a lack of fit is one that the stated uncertainties carry
EDGE = 0.1  # of the logarithm of a time, from the end of the window
HOLD = 1.2  # times a relaxation time, that a film is held to see it
USUAL, FAR = 0.1, 0.5  # ratio of a branch that occurs; one that would not show below this ratio does not show


@dataclass(frozen=True)
class Known:
    """A number of a branch: standard uncertainty if there is no further branch, and the shift by one that hides.

    The hidden one is that which shifts it most, of the relaxation time ``near`` (s); 0 where there is none.
    """

    value: float
    alone: float
    shift: float = 0.0
    near: float = 0.0

    @property
    def combined(self) -> float:
        """Standard uncertainty whether or not there is a further branch."""
        return math.hypot(self.alone, self.shift)


@dataclass(frozen=True)
class FoundBranch:
    """A Maxwell branch: ratio (over the relaxed film) and time (s) with standard uncertainties; the time's is relative.

    They are combined ones: a further branch that the record cannot show may stand beside it. ``ratio_alone`` and
    ``time_alone`` are those if there is none; ``hidden`` (s) is the relaxation time of the one that does most where it
    keeps the branch from being identified, else 0.
    ``verdict`` is "identified", "bounded" or "outside the window". ``ratios`` and ``times`` (s) are 95 % limits.
    """

    ratio: float
    ratio_uncertainty: float
    time: float
    time_relative: float
    verdict: str
    ratios: tuple[float, float]
    times: tuple[float, float]
    ratio_alone: float
    time_alone: float
    hidden: float = 0.0

    @classmethod
    def judged(cls, ratio: Known, log_time: Known, window: tuple[float, float], *, explained: bool) -> FoundBranch:
        """With its verdict and limits, from the times that the record can show (s).

        None is identified by a fit that does not predict what is left out (``explained``).
        """
        low, high = (math.log(one) for one in window)
        time = math.exp(log_time.value)
        inside = low + EDGE < log_time.value < high - EDGE

        def known(ratio_error: float, time_error: float) -> bool:
            return inside and explained and ratio_error <= KNOWN_RATIO * ratio.value and time_error <= KNOWN_TIME

        word = (
            "identified" if known(ratio.combined, log_time.combined) else "bounded" if inside else "outside the window"
        )
        keeps = word == "bounded" and known(ratio.alone, log_time.alone)
        most = ratio if ratio.combined > KNOWN_RATIO * ratio.value else log_time
        wide = min(1.96 * log_time.combined, 50.0)
        return cls(
            ratio=ratio.value,
            ratio_uncertainty=ratio.combined,
            time=time,
            time_relative=log_time.combined,
            verdict=word,
            ratios=(max(0.0, ratio.value - 1.96 * ratio.combined), ratio.value + 1.96 * ratio.combined),
            times=(time * math.exp(-wide), time * math.exp(wide)),
            ratio_alone=ratio.alone,
            time_alone=log_time.alone,
            hidden=most.near if keeps else 0.0,
        )


@dataclass(frozen=True)
class LeftOut:
    """How fits to the rest of the records predict parts that were left out.

    What a fit says of a part differs from it by the noise of that part and by the uncertainty of the fit: far more than
    noise where the rest hardly tells of it, as one of two rates of stretch does of the other. Against both together the
    squares of a part of n numbers sum up to chi-square of n degrees of freedom. For a linear model the sum is by how
    much chi-square of the fit falls when the part is left out (Chow 1960). Noise is taken by the misfit of the fit, so
    that one stated too small is no lack of the law; but no larger than half of the parts show it at least, as a part
    that makes the misfit by itself would excuse itself.

    Attributes
    ----------
    noise : float
        Root mean square of all the differences over the noise alone, by which models are compared.
    expected : float
        Of the part that is predicted worst: root mean square over what noise, as the misfit has it, and uncertainty
        together give; near 1.
    chance : float
        Probability of as much by chance in any of the parts.
    """

    noise: float
    expected: float
    chance: float

    @classmethod
    def judged(cls, noise: float, parts: Sequence[tuple[int, float]], misfit: float) -> LeftOut:
        """From the degrees of freedom and the chi-square of every part; the worst one is the largest beyond chance."""
        from scipy.special import chdtrc

        usual = sorted(square / freedom for freedom, square in parts)[(len(parts) - 1) // 2]
        scale, found = max(1.0, min(misfit, usual)), []
        for freedom, square in ((freedom, square / scale) for freedom, square in parts):
            chance = min(1.0, len(parts) * float(chdtrc(freedom, square)))
            found.append((math.sqrt(square / freedom), chance))
        beyond = [one for one in found if one[1] < SIGNIFICANT]
        worst = max(beyond) if beyond else min(found, key=lambda one: one[1])
        return cls(noise, *worst)

    @property
    def explained(self) -> bool:
        """Whether what is left out is as the fit says; a lack of fit below `EXPLAINED` is in what the fit states."""
        return self.expected <= EXPLAINED or self.chance >= SIGNIFICANT


@dataclass(frozen=True)
class BranchCount:
    """A number of branches: AICc over the least of all, and how the fit predicts what is left out."""

    branches: int
    aicc: float
    left_out: LeftOut

    @property
    def words(self) -> tuple[str, str, str, str]:
        """A row of a table."""
        left = self.left_out
        return str(self.branches), f"{self.aicc:.1f}", f"{left.noise:.2f}", f"{left.expected:.2f}"


@dataclass(frozen=True, eq=False, kw_only=True)
class OverTime:
    """Means over time that were fitted (N or Pa), their deviations, and the model with and without branches.

    ``segment`` numbers the stretches between bends of the history, of which ``moving`` says where it moved.
    """

    time: Array
    measured: Array
    deviation: Array
    model: Array
    relaxed: Array
    segment: NDArray[np.intp]
    moving: NDArray[np.bool_]


@dataclass(frozen=True, eq=False, kw_only=True)
class Trace(OverTime):
    """One run over time: forces (N) at displacements (m) and voltages (V)."""

    run: str
    h: Array
    voltage: Array


@dataclass(frozen=True)
class Softening:
    """By how much of its force a film has softened when a cycle of a run begins (Mullins), with standard uncertainty.

    Cycles count from 1, those before the first measured one too; the law is that of the first measured one.
    """

    run: str
    cycle: int
    loss: float
    uncertainty: float


@dataclass(frozen=True, eq=False)
class Spectrum:
    """What a record tells of a film's branches.

    Attributes
    ----------
    branches : tuple of FoundBranch
        From the quickest on.
    window : (float, float)
        Relaxation times (s) that the record can show: two samples, and its length.
    instant : Quantity
        Stiffness of the film with all its branches against a quick move from rest (Pa), at the stretches of
        ``stiffness_fixed``, which is the relaxed one.
    counts : tuple of BranchCount
        The numbers of branches that were tried.
    slow : float
        A relaxation time (s) from which on a branch of a usual size would look like stiffness.
    hold : float
        How long the film has to be held to see that one (s).
    quick : float
        A relaxation time (s) below which such a branch would not show either; 0 where there is none.
    traces : tuple of Trace
    softening : tuple of Softening
        Of every cycle after the first, where the record shows that the film softens; else empty.
    left_out : float
        Share of the mean forces from which on the film hangs slack or is wrinkled: they took no part.
    """

    branches: tuple[FoundBranch, ...]
    window: tuple[float, float]
    instant: Quantity
    counts: tuple[BranchCount, ...]
    slow: float
    hold: float
    quick: float
    traces: tuple[Trace, ...] = ()
    softening: tuple[Softening, ...] = ()
    left_out: float = 0.0

    @property
    def sentences(self) -> list[str]:
        """For the operator: what was found and what the record cannot show."""
        words = []
        for one in self.branches:
            low, high = one.times
            words.append(
                f"branch: ratio {one.ratio:.3g} +- {one.ratio_uncertainty:.1g}, time {one.time:.3g} s (95 %: {low:.3g} "
                f"to {high:.3g} s): {one.verdict}"
            )
            if one.hidden > 0.0:
                words.append(
                    f"a further branch near {one.hidden:.2g} s, which this record cannot show, could change that of "
                    f"{one.time:.3g} s; without it the ratio is known to +- {one.ratio_alone:.1g}, the time to "
                    f"{100.0 * one.time_alone:.1g} %: move faster, and hold longer"
                )
        if self.branches and not self.counts[-1].left_out.explained:
            words.append(
                f"a part of the record that was left out is predicted to {self.counts[-1].left_out.expected:.1f} times "
                "what the noise, as most parts show it, and the uncertainty of the fit to the rest give: the film is "
                "not this law with these branches, or that part was disturbed, so that none counts as identified"
            )
        if not self.branches:
            words.append("no branch is needed to explain this record")
        words.append(f"a branch of {self.slow:.0f} s would look like stiffness; hold {_minutes(self.hold)} to see it")
        words += [
            f"{one.run}: by cycle {one.cycle} the film has lost {100.0 * one.loss:.2g} % of its force, +- "
            f"{100.0 * one.uncertainty:.1g} %; the law is that of the first one recorded"
            for one in self.softening
        ]
        if self.left_out > 0.0:
            words.append(
                f"the film hangs slack or wrinkles on the way back: {100.0 * self.left_out:.0f} % of the mean forces "
                "are left out, those of later cycles too; move back more slowly"
            )
        if self.quick > 0.0:
            words.append(f"a branch of {self.quick:.2g} s would not show; move faster to see it")
        return words

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, without the traces."""
        return {
            "branches": [
                {
                    "ratio": one.ratio,
                    "ratio_standard_uncertainty": finite(one.ratio_uncertainty),
                    "time_s": one.time,
                    "time_relative_standard_uncertainty": finite(one.time_relative),
                    "ratio_standard_uncertainty_without_further_branch": finite(one.ratio_alone),
                    "time_relative_standard_uncertainty_without_further_branch": finite(one.time_alone),
                    "hidden_branch_near_s": one.hidden,
                    "ratio_interval_95": [finite(end) for end in one.ratios],
                    "time_interval_95_s": [finite(end) for end in one.times],
                    "verdict": one.verdict,
                }
                for one in self.branches
            ],
            "window_s": list(self.window),
            "instantaneous_stiffness": quantity_dict(self.instant),
            "counts": [asdict(one) for one in self.counts],
            "looks_like_stiffness_from_s": self.slow,
            "hold_to_see_it_s": self.hold,
            "does_not_show_below_s": self.quick,
            "softening": [asdict(one) for one in self.softening],
            "share_left_out": self.left_out,
            "sentences": self.sentences,
        }


def blind_times(alone: Iterable[tuple[float, float]], longest: float) -> tuple[float, float]:
    """Times (s) from which on, and below which (0: none) a branch would not show.

    ``alone`` has relaxation times (s) and from which ratio on each would be found; ``longest`` ends the window.
    """
    shown = list(alone)
    late = [time for time, size in shown if time > longest / 3.0 and not size <= USUAL]
    quick = [time for time, size in shown if time < 0.03 * longest and not size <= FAR]
    return _round_up(min(late, default=10.0 * longest)), max(quick, default=0.0)


def _round_up(seconds: float) -> float:
    """The next of 1, 2, 5, 10, ... s."""
    power = 10.0 ** math.floor(math.log10(seconds))
    return next(one * power for one in (1.0, 2.0, 5.0, 10.0) if one * power >= 0.999 * seconds)


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
