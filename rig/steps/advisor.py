"""Who tells a closed loop what the data say so far, and where to measure next."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol


class Kind(StrEnum):
    """What an advice says."""

    GO = "go"  # measure at this place
    MET = "met"  # all that was wanted is reached
    UNREACHABLE = "unreachable"  # what no time makes smaller is more than was wanted; the rest is reached
    TIME = "time"  # the time is out; of one quantity: it needs more time
    FAILED = (
        "failed"  # no advice: the fit failed, or its process ended or took too long; of one quantity: that ended it
    )


@dataclass(frozen=True)
class Ask:
    """Where the loop stands, SI units.

    Attributes
    ----------
    step : int
        Of the protocol that asks, from 1.
    number : int
        Of the question, from 1.
    h, voltage : float
        Where the film is held.
    spent_s, left_s : float
        Time of the rig in this step so far, and what is left of it, the way back taken off.
    """

    step: int
    number: int
    h: float
    voltage: float
    spent_s: float
    left_s: float


@dataclass(frozen=True)
class Standing:
    """How well one of the quantities that are wanted is known, SI units, by the parts of the uncertainty that count.

    ``relative`` is its standard uncertainty over its value, ``wanted`` what of that is wanted. ``outcome`` is its own,
    whatever the others are: `Kind.MET`, `Kind.UNREACHABLE`, or `Kind.TIME` while it needs more time; ``reason`` is for
    people.
    """

    quantity: str
    value: float
    standard_uncertainty: float
    relative: float
    wanted: float
    outcome: Kind
    reason: str

    def as_fields(self) -> dict[str, str | float]:
        """As ``/standing`` of the log has it."""
        told = {there: getattr(self, here) for here, there in _KNOWN.items()}
        return told | {"outcome": str(self.outcome), "reason": self.reason, "unit": unit_of(self.quantity)}

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Standing:
        """What a row of ``/standing`` says."""
        told = {here: fields[there] for here, there in _KNOWN.items()}
        return cls(**told, outcome=Kind(fields["outcome"]), reason=fields["reason"])


def unit_of(quantity: str) -> str:
    """Of a quantity; empty where there is none."""
    return {"": "", "eps_r": "1"}.get(quantity, "Pa")


@dataclass(frozen=True)
class Advice:
    """An answer, SI units.

    Attributes
    ----------
    kind : Kind
    reason : str
        For people.
    h, voltage, hold_s : float
        Where to measure next and for how long.
    quantity : str
        Of those wanted the one that is farthest from what is wanted; empty before there is a fit.
    value, standard_uncertainty : float
        Of that quantity, by the parts of the uncertainty that count.
    relative, wanted : float
        Its relative standard uncertainty and what is wanted.
    expected_s : float
        Seconds that it will still take as far as can be told; NaN where it cannot.
    known : tuple of Standing
        Those of the quantities that are wanted that a fit knows, in the order of the wish; empty before there is a fit.
    """

    kind: Kind
    reason: str
    h: float = math.nan
    voltage: float = math.nan
    hold_s: float = 0.0
    quantity: str = ""
    value: float = math.nan
    standard_uncertainty: float = math.nan
    relative: float = math.nan
    wanted: float = math.nan
    expected_s: float = math.nan
    known: tuple[Standing, ...] = ()

    def as_fields(self) -> dict[str, str | float]:
        """As ``/decision`` of the log has it."""
        told = {there: getattr(self, here) for here, there in _FIELDS.items()}
        return told | {"outcome": str(self.kind), "unit": self.unit}

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any], known: Iterable[Mapping[str, Any]] = ()) -> Advice:
        """What a row of ``/decision`` says, and those of ``/standing`` that belong to it."""
        told = {here: fields[there] for here, there in _FIELDS.items()}
        return cls(Kind(fields["outcome"]), **told, known=tuple(Standing.from_fields(one) for one in known))

    @property
    def unit(self) -> str:
        """Of the quantity; empty before there is one."""
        return unit_of(self.quantity)

    @property
    def standing(self) -> str:
        """How well it is known, in words; empty before there is a fit."""
        if not self.quantity:
            return ""
        return f"{self.quantity} {100 * self.relative:.3g} % of {100 * self.wanted:.3g} % wanted"


# Names here, and in the log, where their units stand with them.
_FIELDS = {
    "reason": "reason",
    "h": "displacement_m",
    "voltage": "voltage_V",
    "hold_s": "hold_s",
    "quantity": "quantity",
    "value": "value",
    "standard_uncertainty": "standard_uncertainty",
    "relative": "relative_uncertainty",
    "wanted": "wanted_uncertainty",
    "expected_s": "expected_s",
}
_KNOWN = {
    "quantity": "quantity",
    "value": "value",
    "standard_uncertainty": "standard_uncertainty",
    "relative": "relative_uncertainty",
    "wanted": "wanted_uncertainty",
}


class Advisor(Protocol):
    """Answers one question at a time, and never makes the loop wait."""

    def ask(self, question: Ask, now: float) -> None:
        """Put a question at clock time ``now`` (s)."""
        ...

    def answer(self, now: float, stopping: Callable[[], bool]) -> Advice | None:
        """The answer; None while there is none. ``stopping`` says whether the operator wants the run to end."""
        ...

    def close(self) -> None:
        """No more questions."""
        ...
