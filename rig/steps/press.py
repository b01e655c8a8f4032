"""``do = "press"``: the compliance of the rig, against a rigid dummy."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.base.errors import FaultError, LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Turns, write_phase
from rig.steps.rig import Rig
from rig.steps.standards import Averaged, Standstill, check_place, check_speed
from rig.steps.turns import Readings, listening, pause, stand_still

PRESS_STEPS = 20  # for the estimate: how many steps pressing a dummy takes
MOST_STEPS = 200  # of a dummy pressed: more means that it gives way, or is not there


class Press(Averaged):
    """Press against a rigid dummy in small steps of the stage until ``force_N``, and back again."""

    calibrates: ClassVar[str] = "compliance"

    do: Literal["press"] = Field(description="The kind of step.")
    force_N: Positive = Field(
        description="Force up to which to press (N); within limits.force_N.",
        json_schema_extra={"usual": [0.001, 200]},
    )
    step_um: Positive = Field(
        default=0.5,
        description="How far the stage goes from standstill to standstill (um). Start small: a step must not cost "
        "more force than the sensor bears. Typical: 0.5 to 5.",
    )
    speed_mm_per_s: Positive = Field(default=0.05, description="Speed of the stage (mm/s).")
    accuracy_um: NotNegative = Field(default=0.2, description="Standard uncertainty of the stage over one step (um).")

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state, homed=True)
        where = self.where(state.number)
        check_speed(where, self.speed_mm_per_s, scene)
        if not self.force_N <= scene.limits.force_N:
            raise LimitError(f"{where}: force_N is beyond limits.force_N.")
        yield Pressing(
            by=self,
            step=state.number,
            label=f"to {self.force_N:g} N",
            duration=PRESS_STEPS * (self.settle_s + self.average_s) * self.cycles,
            speed=self.speed_mm_per_s * 1e-3,
            settle=self.settle_s,
            average=self.average_s,
            applied_error=self.accuracy_um * 1e-6,
            force=self.force_N,
            length=self.step_um * 1e-6,
            cycles=self.cycles,
        )


@dataclass(frozen=True, kw_only=True)
class Pressing(Standstill):
    """All cycles of it.

    Attributes
    ----------
    force : float
        N, up to which to press.
    length : float
        m, of one step of the stage.
    cycles : int
    """

    force: float
    length: float
    cycles: int

    def carry_out(self, rig: Rig) -> Turns:
        start = rig.position
        for cycle in range(1, self.cycles + 1):
            taken = 0
            # The next step is taken only if, by what the last ones cost, it stays below the force asked for.
            first, rise = (yield from self._stand(rig, 1, cycle)), 0.0
            last = first
            while last + rise < self.force:
                taken += 1
                if taken > MOST_STEPS:
                    raise FaultError(f"The dummy was pressed {MOST_STEPS} steps without reaching {self.force:g} N.")
                yield from self._step_to(rig, start + taken * self.length)
                now = yield from self._stand(rig, 1, cycle)
                rise, last = max(now - last, (now - first) / taken), now
            for down in range(taken - 1, -1, -1):
                yield from self._step_to(rig, start + down * self.length)
                yield from self._stand(rig, -1, cycle)

    def _step_to(self, rig: Rig, position: float) -> Turns:
        rig.move_stage(position, self.speed)
        yield from stand_still(rig, self.allowed_s)

    def _stand(self, rig: Rig, way: int, cycle: int) -> Generator[None, None, float]:
        """The mean force at a standstill (N)."""
        yield from pause(rig, self.settle)
        at, read = rig.position, Readings(rig)
        write_phase(rig, self, "standstill", f"{at * 1e6:.2f} um", direction=way, cycle=cycle)
        rig.recorder.reference("applied", at, self.applied_error, "m")
        with listening(rig, read):
            yield from pause(rig, self.average)
        self.end(rig)
        if len(read.force) < 2:
            raise FaultError("force: no samples arrived while the dummy was pressed.")
        return float(np.mean(read.force))
