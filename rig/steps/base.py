"""What every protocol step is made of: its keys, its plan, and the actions that carry it out.

A step is one file. It declares a `Step`, a table of described keys with the facts that the rest of the house asks for.
Its ``plan`` yields `Action` objects; each action carries itself out as a generator over a `Rig`, resumed once a turn of
the engine's loop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from model.specimen import Specimen
from rig.base.table import Table
from rig.safety.limits import Limits
from rig.scene.scene import Scene
from rig.steps.rig import CyclesDone, Rig

Turns = Generator[None, None, None]

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

# An action that takes this many times its planned duration, and so much longer, is a fault.
ALLOWED_PART, ALLOWED_S = 1.5, 10.0


class Result(Exception):
    """The experiment has its result, which ends the run well: the output goes off at once, nothing more is done.

    Raised by an action in place of the error that the result shows itself by, such as a breakdown that was wanted.
    """


class OnResume(Enum):
    """What becomes of a step that was done already, when a run that ended early goes on at a later one."""

    SKIPPED = "not done again"
    LAST_ONE = "the last one before there is done again"
    IN_CONTACT = "done again if the film was in contact"
    ENDS_CONTACT = "what came before it is not done again"


@dataclass
class State:
    """Where the plan stands: as the steps before have left the rig.

    ``h`` (m) and ``voltage`` (V) are those at which the next action begins.
    """

    number: int = 0
    h: float = 0.0
    voltage: float = 0.0
    homed: bool = False
    zeroed: bool = False
    contact: bool = False
    done: CyclesDone | None = None  # of the step that is being planned, by the run that this one goes on with


class Step(Table, ABC):
    """Base of all steps; ``do`` is the key by which a protocol names its kind.

    Attributes
    ----------
    hands : bool
        Whether the operator's hands come near the rig while it is carried out: no voltage is confirmed before.
    needs_contact : bool
        Whether it needs the contact position, so an approach before it.
    records : bool
        Whether samples taken meanwhile are data of the film, from which the fit takes curves.
    joins : bool
        Whether its data, with those of such steps before and after it at the same voltage, are one curve.
    calibrates : str
        What it calibrates (force, displacement, hv, compliance, timing): there it goes beyond what is calibrated so
        far. Empty: nothing.
    on_resume : OnResume
        What becomes of it when a later step is resumed.
    """

    hands: ClassVar[bool] = False
    needs_contact: ClassVar[bool] = False
    finds_contact: ClassVar[bool] = False
    records: ClassVar[bool] = False
    joins: ClassVar[bool] = False
    calibrates: ClassVar[str] = ""
    on_resume: ClassVar[OnResume] = OnResume.SKIPPED

    @property
    def kind(self) -> str:
        """The name by which protocols call it."""
        return str(getattr(self, "do", ""))

    @property
    def highest_voltage(self) -> float:
        """The highest voltage that it asks for (V)."""
        return 0.0

    @property
    def valid_for_s(self) -> float:
        """How long (s) what it did to the film lasts: a run resumed within this time does not do it again."""
        return -1.0

    def where(self, number: int) -> str:
        """The step in an error message."""
        return f"Step {number} ({self.kind})"

    @abstractmethod
    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        """Its actions in order, from ``state`` on, which is left as the step will leave the rig.

        Raises
        ------
        LimitError
            When it comes where it cannot work, or what it asks for is beyond the scene's limits.
        """


@dataclass(frozen=True, kw_only=True)
class Action(ABC):
    """One thing the engine does; each kind of action adds what it needs to know.

    Attributes
    ----------
    by : Step
        The step that asks for it.
    step : int
        Its number in the protocol, from 1.
    label : str
        What is done, for the operator and for the log.
    h, voltage : (float, float)
        Before and after, in metres and volts.
    duration : float
        Expected time (s).
    speed : float
        Of a move (m/s).
    cycle : int
        From 1; 0 where there are none.
    record : bool
        Whether the samples are data of the film: the fit takes these.
    kind : str
        The word under which it stands in the log; by default the step's.
    """

    by: Step
    step: int
    label: str
    h: tuple[float, float] = (0.0, 0.0)
    voltage: tuple[float, float] = (0.0, 0.0)
    duration: float = 0.0
    speed: float = 0.0
    cycle: int = 0
    record: bool = False
    kind: str = ""

    hears_errors: ClassVar[bool] = False  # whether a limit or fault is thrown into it: it may have its `Result` by that
    begins_anywhere: ClassVar[bool] = False  # whether it needs no way back to where it begins after a pause

    def __post_init__(self) -> None:
        if not self.kind:
            object.__setattr__(self, "kind", self.by.kind)

    @property
    def asks(self) -> bool:
        """Whether the operator is asked something by it, once."""
        return False

    @property
    def moves(self) -> bool:
        """Whether the stage moves along the film's axis, from one known displacement to another."""
        return self.speed > 0 and self.h[0] != self.h[1]

    @property
    def direction(self) -> int:
        """+1 loading, -1 unloading, 0 standing."""
        return int(np.sign(self.h[1] - self.h[0])) if self.moves else 0

    @property
    def allowed_s(self) -> float:
        """How long its way may take before that is a fault."""
        return allowed(self.duration)

    @property
    def likely(self) -> float:
        """Seconds that it will probably take, where that is less than what is planned for."""
        return self.duration

    def check(self, specimen: Specimen, limits: Limits, force_noise: float) -> None:  # noqa: B027 # most have nothing
        """Refuse before anything moves what only this kind of action knows; nothing by default.

        Parameters
        ----------
        force_noise : float
            Standard deviation (N) of one force sample by the sensor's certificate; 0 where there is none.

        Raises
        ------
        LimitError
        """

    @property
    def may(self) -> tuple[Action, ...]:
        """What it may do beside what ``h`` and ``voltage`` say, where that is decided on the way; checked like it."""
        return ()

    @property
    def ends(self) -> tuple[float, ...]:
        """Displacements (m) at the ends of all ways that it may go."""
        return (*self.h, *(end for one in self.may for end in one.ends))

    @property
    def levels(self) -> tuple[float, ...]:
        """Voltages (V) likewise."""
        return (*self.voltage, *(level for one in self.may for level in one.levels))

    @property
    def highest_voltage(self) -> float:
        """The highest voltage that it may come to (V)."""
        return max(self.levels)

    @property
    def kept_s(self) -> float:
        """Seconds of it of which the log keeps everything."""
        return self.duration

    @property
    def summaries(self) -> int:
        """How many summaries of cycles it writes to the log."""
        return 0

    @abstractmethod
    def carry_out(self, rig: Rig) -> Turns:
        """Give the commands, and yield until what they are to bring about has happened.

        The engine polls the instruments and checks the limits between two turns.
        """


def allowed(duration: float) -> float:
    """Seconds that something planned for ``duration`` may take."""
    return duration * ALLOWED_PART + ALLOWED_S


def write_phase(
    rig: Rig,
    action: Action,
    kind: str,
    label: str,
    *,
    direction: int = 0,
    cycle: int = 0,
    voltage: float | None = None,
    record: bool = False,
) -> None:
    """Write to the log that a part of ``action`` begins; by default at the voltage that it ends with."""
    rig.recorder.phase(
        {
            "step": action.step,
            "kind": kind,
            "label": label,
            "cycle": cycle,
            "direction": direction,
            "voltage_V": action.voltage[1] if voltage is None else voltage,
            "record": record,
        }
    )
