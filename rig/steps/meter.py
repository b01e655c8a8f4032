"""``do = "meter"``: the voltage monitor against a reference meter."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.base.errors import FaultError, LimitError
from rig.operator.control import Question
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, State, Turns
from rig.steps.moves import ramp_duration
from rig.steps.output import ramp_to
from rig.steps.rig import Rig
from rig.steps.standards import OPERATOR_S, Averaged, Standards, Standstill, check_place, series
from rig.steps.turns import pause


class Meter(Averaged):
    """Set voltages; the operator types what a reference meter at the output says. The disk must be at rest, at zero."""

    calibrates: ClassVar[str] = "hv"

    do: Literal["meter"] = Field(description="The kind of step.")
    voltages_V: Standards = Field(
        description="Voltages to set (V), 0 among them. Typical: five, evenly spread up to the highest that is used.",
        json_schema_extra={"usual": [5, 30000]},
    )
    meter_relative_uncertainty: NotNegative = Field(
        default=5e-4, description="Standard uncertainty of the reference meter, as a part of its reading."
    )
    meter_uncertainty_V: NotNegative = Field(
        default=0.5, description="Standard uncertainty of the reference meter that does not grow with its reading (V)."
    )

    @property
    def highest_voltage(self) -> float:
        return max(self.voltages_V)

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state)
        if scene.hv is None:
            raise LimitError(f"{self.where(state.number)} needs an [hv] instrument in the scene.")
        before = 0.0
        for cycle, way, level in [*series(self.voltages_V, self.cycles), (0, 0, 0.0)]:
            yield Metering(
                by=self,
                step=state.number,
                label=f"{level:g} V",
                voltage=(before, level),
                duration=ramp_duration(scene, before, level) + self.settle_s + self.average_s + OPERATOR_S,
                cycle=cycle,
                way=way,
                settle=self.settle_s,
                average=self.average_s,
                applied_error=self.meter_uncertainty_V,
                relative_error=self.meter_relative_uncertainty,
            )
            before = level


@dataclass(frozen=True, kw_only=True)
class Metering(Standstill):
    """One voltage, read by the operator; with ``way = 0`` only set.

    Attributes
    ----------
    relative_error : float
        The meter's standard uncertainty as a part of its reading, which all readings share.
    """

    relative_error: float

    @property
    def asks(self) -> bool:
        return self.way != 0

    def carry_out(self, rig: Rig) -> Turns:
        yield from ramp_to(rig, self.voltage[1], self.allowed_s)
        yield from pause(rig, self.settle)
        if self.way == 0:
            return
        self.begin(rig)
        yield from pause(rig, self.average)
        volts = yield from self._read(rig)
        rig.recorder.reference("applied", volts, self.applied_error, "V")
        self.end(rig)

    def _read(self, rig: Rig) -> Generator[None, None, float]:
        """What the operator reads on the meter (V); asked again until it is a number."""
        text = f"Read the reference meter (about {self.voltage[1]:g} V) and type its voltage in V."
        while True:
            answer = yield from rig.ask(
                Question(text, hint="type its voltage"),
                lambda hands: hands.read_meter(self.relative_error, self.applied_error, rig.clock.now()),
            )
            with suppress(ValueError):
                volts = float(answer.text.strip().removesuffix("V").replace(",", "."))
                if math.isfinite(volts):
                    return volts
            if rig.control.unattended:
                raise FaultError(f"The meter's voltage was to be typed in V; {answer.text!r} is not a number.")
            rig.control.say(f"{answer.text!r} is not a number of volts.")
