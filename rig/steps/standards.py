"""What the calibrating steps share: a series of standstills at standards, and what of them goes into the log.

Every standard is applied rising and falling, several times; each standstill waits ``settle_s`` and then reads for
``average_s``. Positions are the stage's own, because there need be no film.

Each standstill leaves in the log a phase ``standstill``, labelled with its standard, and a reference ``applied`` with
what was applied and its own standard uncertainty; each way of a glide leaves a phase ``way``. `rig.analysis.sensors`
needs nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from rig.base.errors import LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Step, write_phase
from rig.steps.rig import Rig

OPERATOR_S = 10.0  # for the estimate: what an operator takes to do what he is asked

Standards = Annotated[list[NotNegative], Field(min_length=2, max_length=50)]
Cycles = Annotated[int, Field(ge=1, le=20)]


class Averaged(Step):
    """What every series of standstills has."""

    cycles: Cycles = Field(default=2, description="Times through all standards, up and down. Typical: 2 to 5.")
    settle_s: NotNegative = Field(
        default=2.0,
        description="Wait before each reading (s). Typical: 1 to 5.",
        json_schema_extra={"usual": [0.01, 10000]},
    )
    average_s: Positive = Field(default=2.0, description="How long to read at each standstill (s). Typical: 2 to 10.")


@dataclass(frozen=True, kw_only=True)
class Standstill(Action):
    """An action that ends in a standstill at a standard.

    Attributes
    ----------
    settle, average : float
        Before reading, and for how long (s).
    applied_error : float
        Standard uncertainty of what is applied, in its unit.
    way : int
        +1 with rising standards, -1 with falling ones, 0 neither.
    """

    settle: float
    average: float
    applied_error: float = 0.0
    way: int = 0

    def begin(self, rig: Rig, label: str = "") -> None:
        """What is read from here on belongs to the standard; by default that of the action's label."""
        write_phase(rig, self, "standstill", label or self.label, direction=self.way, cycle=self.cycle)

    def end(self, rig: Rig) -> None:
        """What is read from here on belongs to nothing."""
        end_phase(rig, self)


def end_phase(rig: Rig, action: Action) -> None:
    """A part of ``action`` of which the log shall know is over."""
    write_phase(rig, action, action.kind, "done", cycle=action.cycle)


def series(standards: Sequence[float], cycles: int) -> list[tuple[int, int, float]]:
    """(cycle, direction, standard): each cycle rising through all of them, then falling."""
    rising = sorted(set(standards))
    return [
        (cycle, direction, one)
        for cycle in range(1, cycles + 1)
        for direction, order in ((1, rising), (-1, rising[::-1]))
        for one in order
    ]


def check_place(step: Step, state: State, *, homed: bool = False, contact: bool = False) -> None:
    """Refuse a calibrating step where it cannot work.

    Parameters
    ----------
    homed : bool
        Whether it needs the stage's reference position.
    contact : bool
        Whether it may come in contact with the film.

    Raises
    ------
    LimitError
    """
    where = step.where(state.number)
    if state.contact and not contact:
        raise LimitError(f"{where} must not come in contact with the film: put a return step before it.")
    if homed and not state.homed:
        raise LimitError(f"{where} needs a home step before it.")


def check_speed(where: str, speed: float, scene: Scene) -> None:
    """Refuse a speed (mm/s) beyond the scene's limit."""
    if not speed <= scene.limits.speed_mm_per_s:
        raise LimitError(f"{where}: {speed:g} mm/s is beyond limits.speed_mm_per_s.")
