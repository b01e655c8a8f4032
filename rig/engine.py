"""The engine: one single-threaded loop that polls the instruments, checks the limits and carries out the plan.

Whatever ends a run, `Engine.run` goes through `_make_safe`: the stage stops, the output goes off, and the log says
by *measured* values in what state the rig was left. Nothing can skip it: signals only set a flag that hastens it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.link import DeviceError
from drivers.roles import DisplacementSample, ForceSample, HVSample, Sample
from rig.actions import carry_out, film_checked
from rig.bench import Bench
from rig.errors import ConfigError, FaultError, LimitError, RigError, Stopped
from rig.plan import Action
from rig.recorder import Gains, Recorder
from rig.safety.guard import SAFE_VOLTAGE, Guard, GuardState, flag_names
from rig.safety.limits import FilmLimits, Limits
from rig.signals import StopRequest

if TYPE_CHECKING:
    from rig.log.writer import LogWriter

SHORTEST_TURN_S, LONGEST_TURN_S = 0.002, 0.005  # the loop comes round at these intervals, as the devices wish
SETUP_LIMIT_S = 15.0
SILENCE_PERIODS = 10.0  # a sensor silent for this many periods, and longer than two of its time-outs, is a fault
BAD_SAMPLES = 3  # this many samples in a row that the sensor itself calls bad are a fault
FROZEN_SAMPLES = 25  # this many equal force readings in a row: an amplifier's last digits are never so quiet
DISAGREEMENT_M = 0.5e-3  # between laser and stage, besides what the stage moves in DISAGREEMENT_LAG_S ...
DISAGREEMENT_LAG_S = 0.05
DISAGREEMENT_S = 0.25  # ... and for longer than this: one of the two is frozen, or the pusher has slipped
FILM_CHECK_S = 0.05  # how often the model is asked about the measured (displacement, voltage)
SAFE_LIMIT_S = 60.0  # a ramp down takes as long as it takes; after this the output is called NOT SAFE


@dataclass(frozen=True)
class Outcome:
    """Why the run ended, and the measured state it ended in.

    ``status`` is one of complete, stopped, limit, fault. ``safe`` is True only when the output was *measured* below
    60 V twice, or when the scene has no HV.
    """

    status: str
    reason: str
    safe: bool
    voltage: float
    force: float
    position: float
    duration: float

    @property
    def state(self) -> str:
        """The state of the output, in words for the operator."""
        if math.isnan(self.voltage):
            return "no high voltage in this scene" if self.safe else "high voltage NOT SAFE: never measured"
        return f"high voltage {'off' if self.safe else 'NOT SAFE'}, measured {self.voltage:.0f} V"

    def as_text(self) -> dict[str, str]:
        """As the log's metadata: text only, units in the names."""
        return {
            "status": self.status,
            "reason": self.reason,
            "safe": "yes" if self.safe else "NO",
            "measured_voltage_V": f"{self.voltage:.1f}",
            "measured_force_N": f"{self.force:.5f}",
            "stage_position_mm": f"{self.position * 1e3:.4f}",
            "duration_s": f"{self.duration:.3f}",
        }


class Engine:
    """Runs one plan on one bench into one log.

    Parameters
    ----------
    bench : Bench
        Opened, not yet attached.
    actions : sequence of Action
        From `rig.plan.plan`, already checked.
    log : LogWriter
        Open; the engine writes rows, the caller attaches scene and protocol and finishes it.
    gains : Gains
        From the sensors' certificates.
    stop : StopRequest
        Set by signals; looked at once a turn.
    progress : callable
        ``progress(done_s, total_s, label)`` about five times a second of the bench's time.
    """

    def __init__(
        self,
        bench: Bench,
        actions: Sequence[Action],
        log: LogWriter,
        gains: Gains,
        stop: StopRequest,
        progress: Callable[[float, float, str], None],
    ) -> None:
        self.bench = bench
        self.clock = bench.clock
        self.gains = gains
        self.recorder = Recorder(log, self.clock, gains)
        self.recorder.has_laser = bench.scene.displacement is not None
        self.limits = Limits.of(bench.scene)
        self.film = FilmLimits(bench.scene.specimen.specimen(), self.limits)
        self.force_noise = math.nan
        self.listener: Callable[[Sample], None] | None = None
        self._actions = actions
        self._stop = stop
        self._progress = progress
        self._guard: Guard | None = None
        self._nominal_voltage = 0.0
        self._started = self.clock.now()
        self._last_sample: dict[str, float] = {}
        self._silence: dict[str, float] = {}
        self._bad_samples: dict[str, int] = {}
        self._last_force = math.nan
        self._equal_forces = 0
        self._agreed = -math.inf
        self._next_film_check = 0.0
        self._next_progress = 0.0
        self._watching = False

    # What actions may do -------------------------------------------------------------------------------------

    def command(self, device: str, command: str, argument: str) -> None:
        """Write a command to the log before it is given."""
        self.recorder.command(device, command, argument)

    def move_stage(self, position: float, speed: float) -> None:
        """Move the stage to ``position`` metres of its own scale."""
        self.limits.speed.check(speed, "Stage speed")
        self.command("stage", "move_to", f"{position * 1e3:.4f} mm at {speed * 1e3:g} mm/s")
        self.bench.stage.move_to(position, speed)

    def move_to(self, h: float, speed: float, voltage: float) -> None:
        """Move the disk to displacement ``h`` metres, with the film checked along the way when there is HV."""
        self.limits.displacement.check(h, "Displacement set-point")
        if self._guard is not None:
            film_checked(self, h, voltage)
        self.recorder.target(h, voltage, speed)
        self.move_stage(self.recorder.contact + h, speed)

    def stop_stage(self) -> None:
        """Decelerate to a standstill."""
        self.command("stage", "stop", "")
        self.bench.stage.stop()

    def request_voltage(self, volts: float) -> None:
        """Ask the guard for a voltage at the displacement where the film is; the first time arms it."""
        if self._guard is None:
            raise FaultError(f"{volts:g} V asked for, but the scene has no HV.")
        if self._guard.state is GuardState.SAFE and self._guard.cause == "start":
            self._guard.arm()
        self.recorder.target(self.recorder.displacement, volts, 0.0)
        self._guard.request(volts, self.recorder.displacement)
        self._nominal_voltage = volts

    # The run -------------------------------------------------------------------------------------------------

    def run(self) -> tuple[Outcome, RigError | DeviceError | None]:
        """Carry out the plan and leave the rig safe. The error, if any, is what ended the run."""
        status, reason = "complete", "the protocol ended"
        error: RigError | DeviceError | None = None
        try:
            self.bench.attach(self.recorder.wire)
            if self.bench.hv is not None:
                ramp = self.bench.scene.hv.ramp_V_per_s if self.bench.scene.hv is not None else 0.0
                tell = lambda command, argument: self.command("hv", command, argument)  # noqa: E731
                self._guard = Guard(self.bench.hv, self.limits, self.film, ramp, tell)
                if not self.bench.hv.measures_current:
                    self.recorder.event("warning", "hv", "this supply does not measure its current: nothing watches it")
            self._set_up()
            self._watching = True
            self._carry_out_all()
        except Stopped as caught:
            status, reason, error = "stopped", str(caught), caught
        except LimitError as caught:
            status, reason, error = "limit", str(caught), caught
        except (RigError, DeviceError) as caught:
            status, reason, error = "fault", str(caught), caught
        except BaseException as caught:
            self._make_safe(f"internal error: {caught!r}", orderly=False)
            raise
        orderly = status in ("complete", "stopped")
        if error is not None:
            self.recorder.event("error", "engine", reason)
        safe = self._make_safe(reason, orderly)
        outcome = self._outcome(status, reason, safe)
        return outcome, error

    def _set_up(self) -> None:
        """Poll until every driver has finished its set-up dialogue; then check who answered."""
        end = self.clock.now() + SETUP_LIMIT_S
        while not all(device.ready for device in self.bench.devices.values()):
            self._turn()
            if self.clock.now() > end:
                waiting = [name for name, device in self.bench.devices.items() if not device.ready]
                raise FaultError(f"{', '.join(waiting)}: not ready within {SETUP_LIMIT_S:.0f} s of set-up.")
        for role, table in self.bench.scene.instruments.items():
            device = self.bench.devices[role]
            found = device.identity
            settings = ", ".join(f"{key}={value}" for key, value in sorted(device.settings.items()))
            self.recorder.event(
                "info", role, f"model {found.model}, serial {found.serial}, firmware {found.firmware}; {settings}"
            )
            if table.serial is not None and table.serial != found.serial:
                raise ConfigError(
                    f"{role}: the scene names serial number {table.serial}, but {found.serial or 'no serial number'} "
                    "answered. Are two instruments swapped? Nothing was moved and no output changed."
                )
        unit = self.bench.force.reading_unit
        self.recorder.units(unit)
        if unit != self.gains.force_unit:
            raise ConfigError(
                f"force: the certificate is for readings in {self.gains.force_unit}, but the instrument gives them in "
                f"{unit}. Use the instrument's own certificate. Nothing was moved and no output changed."
            )
        self._last_sample = dict.fromkeys(self.bench.devices, self.clock.now())
        self._silence = self._allowed_silence()

    def _carry_out_all(self) -> None:
        total = sum(action.duration for action in self._actions)
        done = 0.0
        for action in self._actions:
            began = self.clock.now()
            self._nominal_voltage = action.voltage[1]
            self.recorder.phase(
                {
                    "step": action.step,
                    "kind": action.kind,
                    "label": action.label,
                    "cycle": action.cycle,
                    "direction": action.direction,
                    "voltage_V": action.voltage[1],
                    "record": action.record,
                }
            )
            label = f"step {action.step} {action.kind}: {action.label}"
            with closing(carry_out(self, action)) as turns:
                for _ in turns:
                    if self.clock.now() >= self._next_progress:
                        self._next_progress = self.clock.now() + 0.2
                        self._progress(done + min(self.clock.now() - began, action.duration), total, label)
                    self._turn()
            done += action.duration
            self._progress(done, total, label)

    def _turn(self) -> None:
        """One turn of the loop: poll, judge, write, wait."""
        if self._stop.count:
            raise Stopped(f"stopped by {self._stop.source}")
        began = self.clock.now()
        for role, device in self.bench.devices.items():
            # Each device its own time: data must never seem to have come before they were sent.
            now = self.clock.now()
            for sample in device.poll(now):
                self._take(role, sample, now)
        now = self.clock.now()
        if self._watching:
            self._watch(now)
        self.recorder.tick(now)
        self.clock.sleep_until(self._next_turn(began))

    def _next_turn(self, now: float) -> float:
        wanted = min(device.next_poll for device in self.bench.devices.values())
        return min(max(wanted, now + SHORTEST_TURN_S), now + LONGEST_TURN_S)

    def _take(self, role: str, sample: Sample, now: float) -> None:
        self.recorder.add(sample)
        self._last_sample[role] = now
        if isinstance(sample, ForceSample | DisplacementSample):
            self._judge(role, sample)
        if isinstance(sample, ForceSample):
            self._judge_frozen(sample)
        if self.listener is not None:
            self.listener(sample)
        if isinstance(sample, HVSample) and self._guard is not None:
            self._guard.on_sample(sample)

    def _judge(self, role: str, sample: ForceSample | DisplacementSample) -> None:
        """A sensor may call single samples bad, but not several in a row: then nobody knows where the film is."""
        self._bad_samples[role] = self._bad_samples.get(role, 0) + 1 if sample.flags else 0
        if self._watching and self._bad_samples[role] >= BAD_SAMPLES:
            raise FaultError(f"{role}: {BAD_SAMPLES} samples in a row are bad ({flag_names(sample.flags)}).")

    def _judge_frozen(self, sample: ForceSample) -> None:
        self._equal_forces = self._equal_forces + 1 if sample.reading == self._last_force else 0
        self._last_force = sample.reading
        if self._watching and self._equal_forces >= FROZEN_SAMPLES:
            raise FaultError(f"force: {FROZEN_SAMPLES} equal readings in a row; the sensor is frozen.")

    def _watch(self, now: float) -> None:
        """Hold what was measured against the limits, and the age of every sensor against its rate."""
        recorder = self.recorder
        for role, allowed in self._silence.items():
            age = now - self._last_sample[role]
            if not age <= allowed:
                raise FaultError(f"{role}: no sample for {age:.2f} s. Motion was stopped and the voltage taken down.")
        if math.isfinite(recorder.force_zero):
            self.limits.force.check(recorder.force, "Force measured")
        if math.isfinite(recorder.contact):
            self.limits.displacement.check(recorder.displacement, "Displacement measured")
            self._compare_stage_and_laser(now)
            live = self._guard is not None and self._guard.state is GuardState.LIVE
            if live and now >= self._next_film_check:
                self._next_film_check = now + FILM_CHECK_S
                voltage = recorder.hv.voltage if recorder.hv is not None else math.nan
                self.film.check(recorder.displacement, max(voltage, 0.0), "Film, as measured")

    def _compare_stage_and_laser(self, now: float) -> None:
        """Beyond contact the disk goes with the stage; if they part, one of the two sensors does not tell the truth."""
        recorder = self.recorder
        if not recorder.has_laser or recorder.stage is None:
            return
        by_stage = recorder.stage.position - recorder.contact
        allowed = DISAGREEMENT_M + DISAGREEMENT_LAG_S * self.limits.speed.high
        if by_stage < 0 or abs(by_stage - recorder.displacement) <= allowed:
            self._agreed = now
        elif now - self._agreed > DISAGREEMENT_S:
            raise FaultError(
                f"stage and laser disagree: {by_stage * 1e3:.2f} against {recorder.displacement * 1e3:.2f} mm. "
                "One of them is frozen, or the pusher has slipped."
            )

    def _allowed_silence(self) -> dict[str, float]:
        """Seconds without a sample after which a device counts as silent."""
        bench = self.bench
        rates = {"stage": bench.scene.stage.poll_rate_Hz, "force": bench.force.rate}
        if bench.displacement is not None:
            rates["displacement"] = bench.displacement.rate
        if bench.scene.hv is not None:
            rates["hv"] = bench.scene.hv.poll_rate_Hz
        return {
            role: max(2 * self.bench.scene.instruments[role].timeout_s, SILENCE_PERIODS / rate)
            for role, rate in rates.items()
        }

    # The end -------------------------------------------------------------------------------------------------

    def _make_safe(self, cause: str, orderly: bool) -> bool:
        """Stop the stage, take the voltage off, wait until that is measured. Returns whether it was.

        An orderly end ramps down; a limit or fault takes the output off at once. A second signal turns a ramp into
        an emergency off. A device that fails here is reported and does not keep the others from being made safe.
        """
        if not self.bench.devices:
            return self.bench.scene.hv is None
        guard = self._guard
        if guard is not None:
            try:
                guard.ramp_off(cause) if orderly else guard.kill(cause)
            except DeviceError as error:
                self.recorder.event("error", "hv", str(error))
        try:
            self.stop_stage()
        except DeviceError as error:
            self.recorder.event("error", "stage", str(error))
        hastened = not orderly
        began = self.clock.now()
        lost: set[str] = set()
        while self.clock.now() < began + SAFE_LIMIT_S:
            now = self.clock.now()
            if guard is not None and not hastened and (self._stop.count >= 2 or "hv" in lost):
                hastened = True
                lost.discard("hv")  # whatever it met on the way down: the emergency off goes out with the next poll
                try:
                    guard.kill(f"{cause}; hastened")
                except DeviceError as error:
                    self.recorder.event("error", "hv", str(error))
            for role, device in self.bench.devices.items():
                if role not in lost:
                    self._poll_to_the_end(role, device.poll, self.clock.now(), lost)
            still = "stage" in lost or not self.bench.stage.moving
            off = guard is None or guard.output_is_safe or (hastened and "hv" in lost)
            if still and off:
                break
            self.recorder.tick(now)
            self.clock.sleep_until(self._next_turn(now))
        safe = guard is None or (guard.output_is_safe and "hv" not in lost)
        if guard is not None and not safe:
            self.recorder.event(
                "error",
                "hv",
                f"NOT SAFE: the output was not measured below {SAFE_VOLTAGE:.0f} V. Keep away; switch the supply off "
                "at its mains switch and use the grounding stick.",
            )
        return safe

    def _poll_to_the_end(
        self, role: str, poll: Callable[[float], Sequence[Sample]], now: float, lost: set[str]
    ) -> None:
        try:
            for sample in poll(now):
                self.recorder.add(sample)
                if isinstance(sample, HVSample) and self._guard is not None:
                    self._guard.on_sample(sample)
        except DeviceError as error:
            lost.add(role)
            self.recorder.event("error", role, str(error))
        except RigError as error:  # a trip seen while already going down changes nothing
            self.recorder.event("warning", role, str(error))

    def _outcome(self, status: str, reason: str, safe: bool) -> Outcome:
        recorder = self.recorder
        return Outcome(
            status=status,
            reason=reason,
            safe=safe,
            voltage=recorder.hv.voltage if recorder.hv is not None else math.nan,
            force=recorder.force,
            position=recorder.stage.position if recorder.stage is not None else math.nan,
            duration=self.clock.now() - self._started,
        )
