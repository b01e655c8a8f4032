"""``do = "zero"``: the readings of the unloaded sensors become their zeros."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.safety.limits import check_zero
from rig.scene.scene import Scene
from rig.steps.base import Action, OnResume, Positive, State, Step, Turns
from rig.steps.rig import Rig
from rig.steps.turns import Readings, listening, mean_of, pause


class Zero(Step):
    """Average the unloaded sensors: the force zero, and the displacement zero where there is a laser."""

    on_resume: ClassVar[OnResume] = OnResume.LAST_ONE

    do: Literal["zero"] = Field(description="The kind of step.")
    duration_s: Positive = Field(
        default=2.0,
        description="How long to average the readings (s). The zero's uncertainty falls with its square root. "
        "Typical: 2 to 5.",
        json_schema_extra={"usual": [0.01, 100000]},
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if state.contact:
            raise LimitError(f"{self.where(state.number)} must come before the approach, with nothing touching.")
        state.zeroed = True
        yield Zeroing(by=self, step=state.number, label="average the unloaded sensors", duration=self.duration_s)


@dataclass(frozen=True, kw_only=True)
class Zeroing(Action):
    """Mean of every unloaded sensor and its standard error, taken as independent samples."""

    def carry_out(self, rig: Rig) -> Turns:
        recorder = rig.recorder
        read = Readings(rig, raw=True)
        with listening(rig, read):
            yield from pause(rig, self.duration)
        zero, error = mean_of(read.force, "force")
        check_zero(rig.limits, recorder.from_stored_zero(zero))
        recorder.force_zero = zero
        rig.learn("force", read.force)
        rig.learn("displacement", read.displacement)
        rig.force_noise = error * math.sqrt(len(read.force)) * rig.gains.force
        recorder.reference("force_zero", recorder.force_zero, error, rig.bench.force.reading_unit)
        if recorder.has_laser:
            recorder.displacement_zero, error = mean_of(read.displacement, "displacement")
            recorder.reference("displacement_zero", recorder.displacement_zero, error, "m")
