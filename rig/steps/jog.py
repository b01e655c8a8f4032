"""``do = "jog"``: the stage by hand, and what the instruments say after each move; the voltage stays off."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.roles import HVFlag, MonitorSample
from rig.base.errors import LimitError
from rig.operator.control import Question
from rig.safety.limits import Limit
from rig.scene.scene import Scene
from rig.steps.base import Action, Positive, State, Step, Turns, allowed
from rig.steps.home import find_reference
from rig.steps.output import take_down
from rig.steps.rig import Rig
from rig.steps.standards import check_speed
from rig.steps.turns import Readings, listening, pause, stand_still

ZERO_C_IN_K = 273.15
READ_S = 0.5  # over which the sensors are averaged
MOVE_S = 10.0  # for the estimate: nobody knows yet from where to where
PATTERN = r"^(home|read|[-+]?\d+(\.\d*)?|[-+]?\.\d+)$"
WORDS = "home; read; a position in mm (20); a way in mm (+0.5, -2)"
HINT = "+ or - for one step; 20: to 20 mm; +0.5 or -2: by so much; home; Enter: read again; end"

Given = Annotated[str, Field(pattern=PATTERN, max_length=20)]


class Jog(Step):
    """Move the stage by hand and read the instruments; voltage off, and measured off. Positions are the stage's own."""

    hands: ClassVar[bool] = True

    do: Literal["jog"] = Field(description="The kind of step.")
    moves: Annotated[list[Given], Field(max_length=200)] = Field(
        default=[],
        description=f"What to do in turn, as texts: {WORDS}. Default: empty; the operator is asked each time.",
    )
    step_mm: Positive = Field(
        default=0.1,
        description="How far + and - go (mm). Typical: 0.01 to 1.",
        json_schema_extra={"usual": [0.0001, 50]},
    )
    speed_mm_per_s: Positive = Field(
        default=1.0,
        description="Speed of the stage (mm/s). Typical: 0.1 to 2.",
        json_schema_extra={"usual": [0.0005, 200]},
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        where = self.where(state.number)
        if state.voltage > 0 or state.contact:
            raise LimitError(f"{where} comes in contact or with voltage; put a return step before.")
        check_speed(where, self.speed_mm_per_s, scene)
        state.homed = state.homed or "home" in self.moves
        length, speed = self.step_mm * 1e-3, self.speed_mm_per_s * 1e-3
        for move in self.moves or [""]:
            yield Jogging(
                by=self,
                step=state.number,
                label=f"{move} mm" if move[-1:].isdigit() else move or "by hand",
                duration=READ_S if move == "read" else MOVE_S,
                speed=speed,
                move=move,
                length=length,
            )


@dataclass(frozen=True, kw_only=True)
class Jogging(Action):
    """One move and what is read after it; or as many as the operator types.

    Attributes
    ----------
    move : str
        What to do; empty: the operator is asked, until he ends it.
    length : float
        m, of one step.
    targets : list of float
        Where a move began to go, so that one which is done anew after a pause does not go further.
    """

    move: str
    length: float
    targets: list[float] = field(default_factory=list, compare=False)

    def carry_out(self, rig: Rig) -> Turns:
        yield from take_down(rig, "the stage is moved by hand")
        if self.move:
            yield from self._do(rig, self.move)
            return
        yield from self._do(rig, "read")
        while (word := (yield from rig.ask(Question("Move the stage.", hint=HINT))).text.strip().lower()) != "end":
            try:
                yield from self._do(rig, word)
            except LimitError as error:  # of a move that was not begun: the film has not been touched
                rig.control.say(str(error))

    def _do(self, rig: Rig, word: str) -> Turns:
        if word == "home":
            yield from find_reference(rig)
        elif word not in ("", "read"):
            target = self._target(rig, word)
            rig.move_stage(target, self.speed)
            yield from stand_still(rig, allowed(abs(target - rig.position) / self.speed))
        yield from tell_readings(rig)

    def _target(self, rig: Rig, word: str) -> float:
        """Where to go, in metres of the stage's scale. Raises `LimitError` before anything moves."""
        stage = rig.bench.stage
        if self.targets:
            return self.targets[0]
        if not stage.referenced:
            raise LimitError("The stage has no reference position yet. Type home; nothing must be in its way.")
        one = {"+": self.length, "-": -self.length}.get(word)
        try:
            number = float(word) * 1e-3 if one is None else one
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise LimitError(f"{word!r} is not understood. Type one of: +; -; {WORDS}; end.")
        target = rig.position + number if word[0] in "+-" else number
        Limit("stage position", *stage.travel, "mm", 1e3).check(target, f"Move {word}")
        if self.move:
            self.targets.append(target)
        return target


def tell_readings(rig: Rig) -> Turns:
    """One line for each instrument: what it says now."""
    read = Readings(rig, raw=True)
    with listening(rig, read):
        yield from pause(rig, READ_S)
    for line in reading_lines(rig, read):
        rig.control.say(line)


def _monitored(sample: MonitorSample) -> str:
    """One monitor's value, in the units of the scene."""
    match sample.quantity:
        case "voltage":
            return f"{sample.value:.1f} V, the second reading of the voltage"
        case "temperature":
            return f"{sample.value - ZERO_C_IN_K:.2f} C, temperature of the air"
        case _:
            return f"{100 * sample.value:.1f} %, relative humidity of the air"


def reading_lines(rig: Rig, read: Readings) -> Iterator[str]:
    """Role, value, state and who it is."""
    recorder, stage = rig.recorder, rig.recorder.stage
    said = {}
    if stage is not None:
        state = "moving" if stage.moving else "standing"
        said["stage"] = f"{stage.position * 1e3:.4f} mm, {state}{'' if stage.referenced else ', no reference position'}"
    said["force"] = _force(rig, read.force)
    said["displacement"] = f"{_mean(read.displacement) * 1e3:.4f} mm, as the sensor states it"
    if recorder.hv is not None:
        hv = recorder.hv
        current = f"{hv.current * 1e6:.2f} uA, " if math.isfinite(hv.current) else ""
        on = "ON" if HVFlag.ON in hv.flags else "off"
        said["hv"] = f"{hv.voltage:.1f} V measured, {current}set-point {hv.setpoint:.0f} V, channel {on}"
    for monitor in recorder.monitors.values():
        said[monitor.role] = _monitored(monitor)
    for role, device in rig.bench.devices.items():
        who = device.identity
        name = f"{who.model} {who.serial}".strip()
        yield f"  {role:<12} {said.get(role, 'no value')}{f'  ({name})' if name else ''}"


def _force(rig: Rig, readings: list[float]) -> str:
    mean = _mean(readings)
    recorder, unit = rig.recorder, rig.bench.force.reading_unit
    against = "against the stored zero" if recorder.has_stored_zero else "no zero is stored"
    return f"{recorder.from_stored_zero(mean):.4f} N, {against} ({mean:.6g} {unit})"


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan
