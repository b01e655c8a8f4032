"""The protocol: what is done to the specimen, step by step. A TOML file of ``[[step]]`` tables.

Displacements are of the disk out of the film's plane, from where the pusher meets the flat film. Steps do not know
the specimen; `rig.protocol.plan` turns them into moves, ramps and waits for one scene.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from rig.base.table import Table
from rig.base.toml_file import load_table
from rig.calibrate import steps as calibration
from rig.steps.follow import Follow

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Cycles = Annotated[int, Field(ge=1, le=1000)]


class Home(Table):
    """Let the stage find its reference position, before anything is in contact."""

    do: Literal["home"]


class Zero(Table):
    """Average the unloaded sensors: the force zero, and the displacement zero where there is a laser."""

    do: Literal["zero"]
    duration_s: Positive = 2.0


class Approach(Table):
    """Advance slowly until the force says that the pusher has met the film; that is displacement zero."""

    do: Literal["approach"]
    speed_mm_per_s: Positive = 0.5
    threshold_mN: Positive = 5.0
    max_travel_mm: Positive = 20.0


class Precondition(Table):
    """Load and unload without voltage until the film's softening has settled."""

    do: Literal["precondition"]
    displacement_mm: Positive
    speed_mm_per_s: Positive
    cycles: Cycles = 3
    valid_for_min: NotNegative = 60.0  # a run resumed within this time does not precondition again


class Ramp(Table):
    """Move to one displacement at constant speed, at the voltage that is on."""

    do: Literal["ramp"]
    displacement_mm: NotNegative
    speed_mm_per_s: Positive


class Prompt(Table):
    """Ask the operator to do something (mount the specimen, close the lid) and wait for his answer; voltage off."""

    do: Literal["prompt"]
    text: str = Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")


class Hold(Table):
    """Stay where we are."""

    do: Literal["hold"]
    duration_s: Positive


class Voltage(Table):
    """Ramp the voltage and wait; at the displacement where we are."""

    do: Literal["voltage"]
    voltage_V: NotNegative
    settle_s: NotNegative = 1.0


class Sweep(Table):
    """Displacement up and back at each voltage in turn; the voltage ends at zero."""

    do: Literal["sweep"]
    displacement_mm: Positive
    from_mm: NotNegative = 0.0
    speed_mm_per_s: Positive
    voltages_V: list[NotNegative] = Field(default=[0.0], min_length=1, max_length=100)
    cycles: Cycles = 1
    settle_s: NotNegative = 1.0


class Return(Table):
    """Voltage to zero, then the pusher back from the film."""

    do: Literal["return"]
    speed_mm_per_s: Positive = 2.0
    clearance_mm: NotNegative = 2.0


Step = Annotated[
    Home | Zero | Approach | Precondition | Ramp | Hold | Prompt | Voltage | Sweep | Return | Follow | calibration.Step,
    Field(discriminator="do"),
]


class Protocol(Table):
    """A titled list of steps."""

    title: str = ""
    step: list[Step] = Field(min_length=1, max_length=1000)


def load_protocol(path: Path) -> tuple[Protocol, str]:
    """The protocol in ``path`` and its exact text.

    Raises
    ------
    ConfigError
        Naming file, step, key, value and what is allowed.
    """
    return load_table(path, Protocol, "protocol")
