"""The rig as a protocol step sees it: the eight things that a step may do, and the state that it needs for them.

A step commands nothing directly. What goes through here is written to the log before it is given, and held against
the scene's limits and the guard.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

from drivers.roles import HVFlag, Sample
from rig.base.errors import FaultError
from rig.bench.bench import Bench
from rig.log.recorder import Gains, Recorder
from rig.operator.control import Answer, Control, Question
from rig.safety.arming import Arming
from rig.safety.guard import AnyGuard, GuardState
from rig.safety.limits import Limits
from rig.steps.advisor import Advisor
from rig.steps.hands import Hands


@dataclass(frozen=True)
class CyclesDone:
    """What a run that ended early had counted of a step: whole cycles, and what counts as 100 % of their response.

    Of a closed loop: its questions, and the seconds that they took.
    """

    count: int
    reference: float


class Rig:
    """One bench during one run.

    Parameters
    ----------
    bench, recorder, limits, gains, control, arming
        Of the run.
    highest_voltage : float
        The highest that the plan asks for (V): what the operator confirms.
    take_down : str
        How he chose, when he started the run, to have an output taken down that is found live; empty: he did not.
    clear : str
        How he said, when he started the run, that the cause of what the supply has latched is removed; likewise.

    Attributes
    ----------
    guard : AnyGuard or None
        None where the scene has no HV, and until the engine has appointed one.
    force_noise : float
        Standard deviation (N) of one sample of the unloaded force sensor; NaN before the zero step.
    listener : callable or None
        Told every sample as it arrives.
    on_readings : callable
        ``on_readings(role, readings)`` is told the readings of an unloaded sensor.
    advisor : Advisor or None
        Who fits for a closed loop.
    latched_at_start : HVFlag
        What the supply had latched before anything moved: of that, and of nothing later, ``clear`` was said.
    doing : str
        What a step adds to its label on the status line.
    counts : dict
        What a step has counted, by its number: it outlives the operator's pause.
    hands : Hands or None
        Who does what the operator is asked to do by hand, on the simulated bench in memory; else the operator himself.
    """

    def __init__(
        self,
        bench: Bench,
        recorder: Recorder,
        limits: Limits,
        gains: Gains,
        control: Control,
        arming: Arming,
        highest_voltage: float,
        take_down: str = "",
        clear: str = "",
    ) -> None:
        self.bench = bench
        self.clock = bench.clock
        self.scene = bench.scene
        self.recorder = recorder
        self.limits = limits
        self.gains = gains
        self.control = control
        self.arming = arming
        self.highest_voltage = highest_voltage
        self.take_down = take_down
        self.clear = clear
        self.latched_at_start = HVFlag(0)
        self.guard: AnyGuard | None = None
        self.force_noise = math.nan
        self.question_number = ""  # which of the plan's questions is asked next ("3 of 34")
        self.listener: Callable[[Sample], None] | None = None
        self.on_readings: Callable[[str, Sequence[float]], None] = lambda role, readings: None
        self.counts: dict[int, CyclesDone] = {}
        self.advisor: Advisor | None = None
        self.doing = ""
        self.hands: Hands | None = None if bench.simulated is None else bench.simulated.operator

    @property
    def position(self) -> float:
        """Where the stage was last measured, in metres of its own scale; NaN before that."""
        stage = self.recorder.stage
        return math.nan if stage is None else stage.position

    # What steps may do ---------------------------------------------------------------------------------------

    def command(self, device: str, command: str, argument: str) -> None:
        """Write a command to the log before it is given, its numbers in full: `rig.replay` gives it again."""
        self.recorder.command(device, command, argument)

    def move_stage(self, position: float, speed: float) -> None:
        """Move the stage to ``position`` metres of its own scale."""
        self.limits.speed.check(speed, "Stage speed")
        self.recorder.speed = speed
        self.command("stage", "move_to", f"{float(position)!r} m at {speed!r} m/s")
        self.bench.stage.move_to(position, speed)

    def move_to(self, h: float, speed: float) -> None:
        """Move the disk to displacement ``h`` metres, with the film checked along the way when there is HV."""
        self.limits.displacement.check(h, "Displacement set-point")
        voltage = 0.0
        if self.guard is not None:
            voltage = self.guard.setpoint
            self.guard.check_move(self.recorder.displacement, h)
        self.recorder.target(h, voltage, speed)
        self.move_stage(self.recorder.contact + h, speed)

    def stop_stage(self) -> None:
        """Decelerate to a standstill."""
        self.command("stage", "stop", "")
        self.bench.stage.stop()

    def request_voltage(self, volts: float) -> None:
        """Ask the guard for a voltage at the displacement where the film is; a guard that is SAFE is armed for it.

        Before contact the disk lies where the flat film holds it, at zero.
        """
        if self.guard is None:
            raise FaultError(f"{volts:g} V asked for, but the scene has no HV.")
        if volts != 0.0 or self.guard.state is GuardState.SAFE:  # never above what the operator typed; to 0 V always
            self.arming.check(volts)
        if self.guard.state is GuardState.SAFE:
            self.recorder.operator("arms", self.arming.confirmed, self.arming.requested)
            self.event("hv", f"armed by two acts: {self.arming.requested}; {self.arming.confirmed}")
            self.guard.arm()
        h = self.recorder.displacement if math.isfinite(self.recorder.contact) else 0.0
        self.recorder.target(h, volts, 0.0)
        self.guard.request(volts, h)

    def event(self, source: str, message: str) -> None:
        """Write to the log what a reader of it should know."""
        self.recorder.event("info", source, message)

    def learn(self, role: str, readings: Sequence[float]) -> None:
        """Let the watch learn the noise of an unloaded sensor."""
        if readings:
            self.on_readings(role, readings)

    def ask(
        self, question: Question, by_hand: Callable[[Hands], object] | None = None
    ) -> Generator[None, None, Answer]:
        """Ask the operator and yield until he has answered; question and answer go into the log.

        ``by_hand`` is what is to be done for it, where `hands` can do it in his place; what they read is the answer.
        """
        self.recorder.operator("is asked", question.text, "")
        self.event("operator", f"asked: {question.text}")
        if self.question_number and not question.expected:
            question = replace(question, number=self.question_number)
        self.control.put(question)
        if by_hand is not None and self.hands is not None:
            done = by_hand(self.hands)
            self.control.answer = Answer("done" if done is None else str(done), "the simulated operator")
        try:
            while (answer := self.control.answer) is None:
                yield
        finally:
            self.control.withdraw()
        self.recorder.operator("answers", answer.text, answer.source)
        self.event("operator", f"answered: {answer}")
        return answer
