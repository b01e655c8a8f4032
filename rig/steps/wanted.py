"""What a closed loop is to reach, as an operator writes it: ``"eps_r 0.5 %"``; and times with their units."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

NAMES = ("stiffness", "eps_r")
LOWEST, HIGHEST = 1e-5, 0.5  # relative; beyond it nothing is meant
EXAMPLE = '"eps_r 0.5 %", or several with commas: "eps_r 0.5 %, stiffness 1 %"'
# Entries of a budget: what is stated of specimen and instruments, and what more time of the rig makes smaller.
DIMENSIONS = ("thickness", "pre-stretch", "disk radius", "ring radius")
GAINS = ("force gain", "displacement gain", "displacement axis", "voltage gain", "voltage at the film")
STATED = (*GAINS, *DIMENSIONS, "eccentricity")
BY_TIME = ("noise", "force zero", "displacement zero", "lag", "compliance", "range of exponents", "other solutions")


class Counts(StrEnum):
    """Which parts of a standard uncertainty count."""

    ALL = ""
    GIVEN_DIMENSIONS = "given dimensions"
    NOISE_AND_ZEROS = "noise and zeros"


@dataclass(frozen=True)
class Wanted:
    """A quantity of the fit and the relative standard uncertainty at which it is known well enough.

    By default all parts of the uncertainty count, as `dea-rig fit` states it.
    """

    name: str
    relative: float
    counts: Counts = Counts.ALL

    def __str__(self) -> str:
        return f"{self.name} {100 * self.relative:.3g} %{f' {self.counts}' if self.counts else ''}"

    def of(self, value: float, budget: Mapping[str, float]) -> tuple[float, float]:
        """Relative standard uncertainty of a quantity with this budget; and what of it no time makes smaller.

        With noise and zeros count whatever is not stated of specimen and instruments: a lack of fit, too.
        """
        left_out = {Counts.NOISE_AND_ZEROS: STATED, Counts.GIVEN_DIMENSIONS: DIMENSIONS}.get(self.counts, ())
        parts = {part: size for part, size in budget.items() if part not in left_out}
        square = sum(size**2 for size in parts.values())
        stays = sum(size**2 for part, size in parts.items() if part not in BY_TIME)
        return square**0.5 / abs(value), stays**0.5 / abs(value)


def parse_wanted(text: str) -> tuple[Wanted, ...]:
    """What ``--until`` says.

    Raises
    ------
    ValueError
        Saying what is wrong with which part, and what is allowed.
    """
    found: dict[str, Wanted] = {}
    for part in text.split(","):
        one = _one(part.strip())
        if one.name in found:
            raise ValueError(f"{one.name} is named twice; name it once")
        found[one.name] = one
    return tuple(found.values())


def _one(text: str) -> Wanted:
    shape = re.fullmatch(r"(\S+)\s+([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(%?)\s*(.*)", text, re.IGNORECASE)
    name = (shape[1] if shape else text.split()[0] if text else "").lower()
    if name not in NAMES:
        near = difflib.get_close_matches(name, NAMES, 1)
        meant = f" Is {near[0]} meant?" if near else ""
        raise ValueError(f"{text!r}: {name!r} is no quantity of the fit.{meant} Write {EXAMPLE}")
    if shape is None:
        raise ValueError(f"{text!r}: the uncertainty is missing or no number. Write {EXAMPLE}")
    if not shape[3]:
        raise ValueError(f"{text!r}: the unit is missing; the uncertainty is relative, in %. Write {EXAMPLE}")
    try:
        percent = float(shape[2])
    except ValueError:
        raise ValueError(f"{text!r}: {shape[2]!r} is no number. Write {EXAMPLE}") from None
    if not LOWEST <= percent / 100.0 <= HIGHEST:
        raise ValueError(f"{text!r}: {percent:g} % is outside {100 * LOWEST:g} to {100 * HIGHEST:g} %")
    words = " ".join(shape[4].lower().split())
    if words not in [str(one) for one in Counts]:
        raise ValueError(
            f"{text!r}: {shape[4]!r} is not understood. Nothing behind the % means all parts of the uncertainty; else "
            f"write {Counts.GIVEN_DIMENSIONS!s}, or {Counts.NOISE_AND_ZEROS!s}"
        )
    return Wanted(name, percent / 100.0, Counts(words))
