"""The engine: one single-threaded loop that polls the instruments, judges what they say and carries out the plan.

Whatever ends a run, `rig.engine.teardown` comes after it: the output goes off, the stage stops, and the log says by
*measured*
values in what state the rig was left. What the operator wants (`rig.operator.control`) is looked at once a turn: a
stop ends the
run or hastens the teardown, a pause lets the voltage down and, once continued, begins the interrupted action anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from drivers.links.link import DeviceError, DeviceSilent
from drivers.roles import HVSample, MonitorSample, Sample
from rig.base.errors import ConfigError, FaultError, LimitError, RigError, StaleData, Stopped
from rig.base.host import HostTime
from rig.bench.bench import Bench
from rig.engine.attention import Attention
from rig.engine.lent import Kept, Lent, wait_given_back
from rig.engine.look import Outlook
from rig.engine.outcome import NOT_SAFE_STATUS, Outcome
from rig.engine.pause import pause
from rig.engine.teardown import Rest, Teardown
from rig.engine.watch import Watch, allowed_silence
from rig.log.recorder import Gains, Recorder, Severity
from rig.log.schema import SETTINGS
from rig.operator.control import Control
from rig.operator.status import Status
from rig.safety import heartbeat
from rig.safety.arming import Arming
from rig.safety.guard import AT_ONCE_S, GIVE_BACK, AnyGuard, Guard, GuardState
from rig.safety.limits import FilmLimits, Limit, Limits
from rig.safety.second import SecondReading
from rig.steps.advisor import Advisor
from rig.steps.base import Action, Result, Turns, write_phase
from rig.steps.output import choose_about_live_output, confirm_voltage, refuse_latched
from rig.steps.regain import regain_duration
from rig.steps.rig import Rig

if TYPE_CHECKING:
    from calibration.sensors.certificate import Certificate
    from rig.log.process import LogProcess
    from rig.log.writer import LogWriter
    from rig.safety.remote import RemoteGuard

SHORTEST_TURN_S, LONGEST_TURN_S = 0.002, 0.005  # the loop comes round at these intervals, as the devices wish
SETUP_LIMIT_S = 15.0  # besides what the devices may take to start
SHOWN_EVERY_S = 2.0  # how often those are named that have not answered yet
SNAPSHOT_S = 1.0  # before and after what ended a run under voltage: the log holds every sample of it, and says where
ROUNDING_S = 1e-6  # of clock times: whether a turn is the last one must not hang on the last digit
OUTPUT_LIMIT_S = 3.0  # how long a supply may take after set-up to be measured off


def _within_bounds(now: float, wanted: float, puts_off: float = 0.0) -> float:
    """When the turn after that of ``now`` begins, for devices that wish it at ``wanted``, which has been put off."""
    return min(max(now + SHORTEST_TURN_S, wanted), now + LONGEST_TURN_S + puts_off)  # in this order NaN is no time


def _lets_ramp_down(error: Exception) -> bool:
    """Whether a run that ended so may ramp its voltage down; otherwise the output is taken off at once."""
    silent = isinstance(error, DeviceSilent) and error.role not in ("", "hv")
    return silent or isinstance(error, Stopped | StaleData)


class Engine:
    """Runs one plan on one bench into one log.

    Parameters
    ----------
    bench : Bench
        Opened, not yet attached.
    actions : sequence of Action
        From `rig.protocol.plan.plan`, already checked.
    log : LogWriter or LogProcess
        Open; the engine writes rows, the caller attaches scene and protocol and finishes it.
    gains : Gains
        From the sensors' certificates.
    control : Control
        What the operator wants; looked at once a turn.
    progress : callable
        ``progress(done_s, total_s, label)`` about five times a second of the bench's time. Its errors end the
        display, not the run.
    certificates : mapping of str to Certificate
        By role, to be held against the serial numbers that the instruments state.
    requested : str
        How the operator asked for high voltage when he started the run; without it none is given.
    take_down : str
        How he chose, when he started the run, to have an output taken down that is found live; empty: he did not.
    clear : str
        How he said, when he started the run, that the cause of what the supply has latched is removed; likewise.
    guard_process : RemoteGuard, optional
        The guard, when it is a process of its own; without it the engine makes one for a supply in memory.
    show : callable, optional
        ``show(status)`` about five times a second, before ``progress``; as that, it must return at once.
    advisor : Advisor, optional
        Who fits for a closed loop.
    kept : Kept, optional
        Where what the run changes in instruments is kept, should it be killed; files of the user by default.
    """

    def __init__(
        self,
        bench: Bench,
        actions: Sequence[Action],
        log: LogWriter | LogProcess,
        gains: Gains,
        control: Control,
        progress: Callable[[float, float, str], None],
        certificates: Mapping[str, Certificate] | None = None,
        requested: str = "",
        take_down: str = "",
        clear: str = "",
        guard_process: RemoteGuard | None = None,
        show: Callable[[Status], None] | None = None,
        advisor: Advisor | None = None,
        kept: Kept | None = None,
    ) -> None:
        self.bench = bench
        self.clock = bench.clock
        self.gains = gains
        self.recorder = Recorder(log, self.clock, gains, has_laser=bench.scene.displacement is not None)
        self.limits = Limits.of(bench.scene)
        self.control = control
        highest = max((action.highest_voltage for action in actions), default=0.0)
        arming = Arming(requested)
        self.rig = Rig(bench, self.recorder, self.limits, gains, control, arming, highest, take_down, clear)
        self.rig.advisor = advisor
        self._actions = actions
        self._progress = progress
        self._certificates = certificates or {}
        self._guard_process = guard_process
        self._show_status = show
        self._outlook = Outlook(self.rig, actions, max((action.step for action in actions), default=0))
        self._host = HostTime(self.clock)
        self._lent = Lent(bench, self.recorder, kept)
        self._beats = 0
        self._next_beat = -math.inf
        self._watch: Watch | None = None
        self._air = set(bench.scene.monitors) - {bench.scene.second_reading}
        self._told_of_air: set[str] = set()
        self._started = self.clock.now()
        self._next_progress = 0.0
        self._number = 0  # of the action that is being carried out
        self._began = 0.0
        self._doing_now: Action | None = None
        self._doing = ""
        self._paused = False

    @property
    def guard(self) -> AnyGuard | None:
        """Who commands the supply; None where the scene has none, or before it is appointed."""
        return self.rig.guard

    # The run -------------------------------------------------------------------------------------------------

    def run(self) -> tuple[Outcome, Exception | None]:
        """Carry out the plan and leave the rig safe. The error, if any, is what ended the run."""
        status, reason = "complete", "the protocol ended"
        error: Exception | None = None
        found = False  # a result that ended the run: it is complete, and what is on goes off at once
        try:
            self.set_up()
            self._watch = Watch(self.bench, self.recorder, self.limits, self.guard)
            self.rig.on_readings = self._watch.learn
            if self.rig.highest_voltage > 0 and not self._hands_come_first():
                self._take_turns(confirm_voltage(self.rig))
            self._carry_out_all()
        except Result as caught:
            reason, found = str(caught), True
        except Stopped as caught:
            status, error = "stopped", caught
        except LimitError as caught:
            status, error = "limit", caught
        except Exception as caught:  # a mistake of ours must end as safely as a fault of the rig
            status, error = "fault", caught
        except BaseException as caught:  # a step or driver of another package that calls sys.exit, for one
            status, error = "fault", FaultError(f"internal error: {caught!r}")
        if error is not None:
            known = isinstance(error, RigError | DeviceError)
            reason = str(error) if known else f"internal error: {error!r}"
            if self._doing:
                error.add_note(f"It happened during {self._doing}.")
        ended = self.clock.now()
        snapshot = (found or status in ("limit", "fault")) and self.guard is not None and self.guard.commanded
        rest = Teardown(self.bench, self.guard, self.recorder, self.control).run(
            reason,
            not found and (error is None or _lets_ramp_down(error)),
            self._next_turn,
            ended + SNAPSHOT_S - ROUNDING_S if snapshot else ended,
        )
        self._lent.end(rest.standing)
        guard = self.guard
        if guard is not None and rest.safe and not guard.given_back:
            wait_given_back("hv", guard.give_back, lambda: guard.given_back, self.bench, self.recorder)
        if isinstance(error, Stopped):  # not before: a log that fails now stops nothing
            self.recorder.operator("stops", "", self.control.source)
        if snapshot:
            self.recorder.snapshot(reason, ended, SNAPSHOT_S, SNAPSHOT_S)
        for role, device in self.bench.devices.items():
            with suppress(Exception):  # what a driver miscounts must not hide how the run ended
                self.recorder.counters(role, device.counters)
        if error is not None:
            self.recorder.event("error", "engine", reason)
        return self._outcome(status, reason, rest), error

    def _hands_come_first(self) -> bool:
        """Whether somebody may touch the rig before there is voltage: then it is confirmed after that."""
        for action in self._actions:
            if action.by.hands:
                return True
            if action.highest_voltage > 0:
                return False
        return False

    def _appoint_guard(self) -> None:
        scene, process = self.bench.scene, self._guard_process
        if scene.hv is None:
            return

        def tell(command: str, argument: str, t: float | None = None) -> None:
            self.recorder.command("hv" + SETTINGS * (command == GIVE_BACK), command, argument, t)

        def event(severity: Severity, message: str) -> None:
            self.recorder.event(severity, "guard", message)

        allowed = allowed_silence(self.bench)
        fresh = {role: allowed[role] + heartbeat.MARGIN_S for role in heartbeat.ROLES if role in allowed}
        if process is not None:
            process.appoint(self.gains.voltage, self.gains.second, fresh, tell, event)
            self.rig.guard = process
        else:
            assert self.bench.hv is not None
            film = FilmLimits(scene.specimen.specimen(), self.limits)
            second = SecondReading.of(scene, self.limits.measured_voltage.high)
            self.rig.guard = Guard(self.bench.hv, self.limits, film, scene.hv.ramp_V_per_s, tell, fresh, second)
        if not scene.hv.measures_current:
            self.recorder.event("warning", "hv", "this supply does not measure its current: nothing watches it")

    def set_up(self) -> None:
        """Put the drivers to work and poll until each has finished its set-up dialogue; then check who answered, what
        the plan needs of them, and that HV is off. Nothing has been moved and no output changed by then.

        Raises
        ------
        RigError, DeviceError
            What does not fit, or does not answer.
        """
        self.bench.attach(self.recorder.wire)
        self._attention = Attention(self.bench)
        self._appoint_guard()
        devices = self.bench.devices
        began, told = self.clock.now(), 0.0
        limit = SETUP_LIMIT_S + max(table.boot_s for table in self.bench.scene.instruments.values())
        while waiting := ", ".join(name for name, device in devices.items() if not device.ready):
            self._turn()
            waited = self.clock.now() - began
            if waited > limit:
                raise FaultError(f"{waiting}: not ready within {limit:.0f} s of set-up.")
            if waited > told + SHOWN_EVERY_S:
                told = waited
                self.control.say(f"Waiting for {waiting} to answer and to be set up: {waited:.0f} s of {limit:.0f} s.")
        for role in devices:
            self._check_identity(role)
        unit = self.bench.force.reading_unit
        self.recorder.units(unit)
        if unit != self.gains.force_unit:
            raise ConfigError(
                f"force: the certificate is for readings in {self.gains.force_unit}, but the instrument gives them in "
                f"{unit}. Use the instrument's own certificate. Nothing was moved and no output changed."
            )
        self._lent.begin()
        self._check_devices()
        self._check_output()

    def idle(self, seconds: float) -> None:
        """Poll and record for so long, doing nothing: a rehearsal."""
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            self._turn()

    def _check_devices(self) -> None:
        """What the plan needs and these devices cannot do is refused while nothing has moved."""
        if self.guard is not None and self.rig.highest_voltage > 0:
            self.guard.check_supply(self.rig.highest_voltage)
        start = self.bench.scene.stage.approach_from_mm * 1e-3
        if any(action.by.finds_contact for action in self._actions):
            travel = Limit("stage position", *self.bench.stage.travel, "mm", 1e3)
            travel.check(start, "stage.approach_from_mm, for this stage")
            ends = [end for action in self._actions for end in action.ends]
            travel.check(start + min(ends), "Clearance of the return step, where the film can be met first")
            travel.check(start + max(ends), "Largest displacement, where the film can be met first")

    def _check_identity(self, role: str) -> None:
        table, device = self.bench.scene.instruments[role], self.bench.devices[role]
        found = device.identity
        link_settings = self.bench.link_settings(role)
        self.recorder.identity(role, found, {**device.settings, **link_settings})
        if remark := link_settings.get("remark"):
            self._remark(role, remark)
        if slow := self.bench.too_slow(role):
            self._remark(role, slow)
        if table.serial is not None and table.serial != found.serial:
            raise ConfigError(
                f"{role}: serial number {table.serial} is wanted, but {found.serial or 'no serial number'} "
                "answered. Are two instruments swapped? Nothing was moved and no output changed."
            )
        certificate = self._certificates.get(role)
        if certificate is not None:
            today = datetime.fromtimestamp(self.clock.epoch_ns(self.clock.now()) * 1e-9, UTC).date()
            for problem in certificate.check(found.serial, today):
                self.recorder.certificate_problem(role, problem)
                self.recorder.event("warning", role, problem)

    def _remark(self, role: str, remark: str) -> None:
        """Something that the operator should know of an instrument, and that ends nothing."""
        self.recorder.event("warning", role, remark)
        self.control.say(f"{role}: {remark}.")

    def _check_output(self) -> None:
        """High voltage must be measured off before anything moves: nobody stretches a film under unknown voltage."""
        guard = self.guard
        if guard is None:
            return
        end = self.clock.now() + OUTPUT_LIMIT_S + guard.off_limit - AT_ONCE_S
        while not guard.output_is_safe and self.clock.now() < end:
            self._turn()
        self._take_turns(choose_about_live_output(self.rig))
        guard.check_off()
        refuse_latched(self.rig)

    def _carry_out_all(self) -> None:
        total = sum(action.duration for action in self._actions)
        done = 0.0
        for number, action in enumerate(self._actions):
            self._number = number
            while not self._carry_out(action, done, total):
                self._pause(action, done, total)
            done += action.duration
            self._show_numbers(self._doing)
            self._show(done, total, self._doing)

    def _carry_out(self, action: Action, done: float, total: float) -> bool:
        """Whether the action came to its end; False when the operator wants a pause."""
        began = self._began = self.clock.now()
        self._doing_now = action
        asked = [other.asks for other in self._actions]
        self.rig.question_number = f"{sum(asked[: self._number + 1])} of {sum(asked)}" if action.asks else ""
        write_phase(
            self.rig,
            action,
            action.kind,
            action.label,
            direction=action.direction,
            cycle=action.cycle,
            record=action.record,
        )
        self.rig.doing = ""
        label = self._doing = self.control.doing = f"step {action.step} {action.kind}: {action.label}"
        with closing(action.carry_out(self.rig)) as turns:
            for _ in turns:
                shown = f"{label}; {self.rig.doing}" if self.rig.doing else label
                self.control.doing = shown
                self._show_now_and_then(done + min(self.clock.now() - began, action.duration), total, shown)
                try:
                    self._turn()
                except (LimitError, FaultError) as error:
                    if action.hears_errors:
                        self._tell(turns, error)
                    raise
                self._keep_hands_safe(action)
                if self.control.pausing:
                    return False
        return True

    def _tell(self, turns: Turns, error: LimitError | FaultError) -> None:
        """Let the action know what ends it. A breakdown may be its result; whatever else it does, the error stands."""
        latched = self.guard is None or self.guard.state is GuardState.SAFE  # a guard in its own process has acted
        if self.guard is not None and not latched and not _lets_ramp_down(error):
            with suppress(Exception):  # the teardown does it again
                self.guard.kill(str(error))  # first: what an action does now takes its time
        try:
            turns.throw(error)
        except Result:
            if error.breakdown:
                raise
        except Exception:
            return

    def _keep_hands_safe(self, action: Action) -> None:
        """A step whose hands come near the rig asks for them only when the output is latched and measured off."""
        guard = self.guard
        if guard is None or not action.by.hands or self.control.question is None:
            return
        if not (guard.state is GuardState.SAFE and guard.output_is_safe):
            raise FaultError(
                f"Step {action.step} ({action.kind}) asks for the operator's hands though the high voltage is not "
                "latched and measured off: its carry_out must take it down first."
            )

    def _pause(self, action: Action, done: float, total: float) -> None:
        """Stage standing, voltage down; once the operator continues, back to where the action begins."""
        self.recorder.operator("pauses", self._doing, self.control.pausing)
        self.rig.event("operator", f"paused by {self.control.pausing} during {self._doing}")
        words = "the operator's pause"
        write_phase(self.rig, action, "pause", words, direction=action.direction, cycle=action.cycle, voltage=0.0)
        self._paused = True
        with closing(pause(self.rig, action)) as turns:
            for _ in turns:
                self._show_now_and_then(done, total, f"paused: {self._doing}")
                self._turn()
        self._paused = False

    def _take_turns(self, turns: Turns) -> None:
        with closing(turns):
            for _ in turns:
                self._turn()

    def _show_now_and_then(self, done: float, total: float, label: str) -> None:
        if self.clock.now() >= self._next_progress:
            self._next_progress = self.clock.now() + 0.2
            question = self.control.question
            label = f"waiting for you: {question.shown}" if question is not None else label
            self._show_numbers(label)
            self._show(done, total, label)

    def _show_numbers(self, label: str) -> None:
        """Show the status. As with progress, a display that fails must not end an experiment."""
        action = self._doing_now
        if self._show_status is None or action is None:
            return
        try:
            elapsed = self.clock.now() - self._began
            if self._paused:  # its time has not begun: first the way back to where it begins
                elapsed = -regain_duration(self.rig, action)
            status = self._outlook.look(self._number, action, elapsed, label)
            self.control.left = status.left
            self.control.measured = {} if self.recorder.keeping else status.measured(self.clock.now())
            self._show_status(status)
        except Exception as error:
            self._show_status = None
            self.recorder.event("warning", "engine", f"the status line failed: {error!r}")

    def _show(self, done: float, total: float, label: str) -> None:
        """Show progress. A terminal that is gone must not end an experiment."""
        try:
            self._progress(done, total, label)
        except Exception as error:
            self._progress = lambda done, total, label: None
            self.recorder.event("warning", "engine", f"the display of progress failed: {error!r}")

    def _turn(self) -> None:
        """One turn of the loop: poll, judge, write, wait."""
        began = self.recorder.turn = self.clock.now()
        self.control.poll(began)
        if self.control.count:
            raise Stopped(f"stopped by {self.control.source}")
        attention = self._attention
        for role in attention.wanted(began):
            # Each device its own time: data must never seem to have come before they were sent.
            now = self.clock.now()
            attention.polled(role, now)
            self._take_all(role, self._poll(role, now), now)
            for remark in self.bench.remarks(role):
                self._remark(role, remark)
        now = self.clock.now()
        if step := self._host.check():
            message = f"the host's calendar was set by {step:+.3f} s; this log goes on by the calendar as it was"
            self.recorder.event("warning", "host", message)
        if self._watch is not None:
            self._watch.turn(now)
            self._beat(self._watch, now)
        self.recorder.tick(now)
        due, awaited = attention.next()
        attention.wait(began + SHORTEST_TURN_S, _within_bounds(began, due, attention.puts_off), awaited)

    def _poll(self, role: str, now: float) -> Sequence[Sample]:
        """New samples. An instrument that only says what air it is ends no run, once it has begun."""
        try:
            return self.bench.poll(role, now)
        except DeviceError as error:
            if self._watch is None or role not in self._air:
                raise
            if str(error) not in self._told_of_air:
                self._told_of_air.add(str(error))
                self._remark(role, f"{str(error).rstrip('.')}; the run goes on without")
            return ()

    def _beat(self, watch: Watch, now: float) -> None:
        """Tell the guard that this loop turns, and on how fresh data. Nothing else ever does."""
        guard = self.guard
        if guard is None:
            return
        if now >= self._next_beat:
            self._next_beat = now + heartbeat.INTERVAL_S
            self._beats += 1
            beat = heartbeat.Heartbeat(self._beats, now, self.recorder.displacement, watch.newest_good)
            guard.heartbeat(beat.encode(), now)
        guard.turn(now)

    def _next_turn(self, now: float) -> float:
        return _within_bounds(now, min(device.next_poll for device in self.bench.devices.values()))

    def _take_all(self, role: str, samples: Sequence[Sample], now: float) -> None:
        """Take them one by one. Of those after one that ends the run, the log has what was measured."""
        for number, sample in enumerate(samples, 1):
            try:
                self._take(role, sample, now)
            except BaseException:
                with suppress(Exception):  # nothing may take the place of what ended the run
                    for later in samples[number:]:
                        self.recorder.add(later)
                raise

    def _take(self, role: str, sample: Sample, now: float) -> None:
        sample = self.recorder.add(sample)
        if self.rig.listener is not None:  # before the guard judges it: then the same wherever the guard is
            self.rig.listener(sample)
        if isinstance(sample, HVSample) and self.guard is not None:
            self.guard.on_sample(sample)
        elif isinstance(sample, MonitorSample) and self.guard is not None:
            self.guard.on_monitor(sample)
        if self._watch is not None:
            self._watch.sample(role, sample, now)

    def _outcome(self, status: str, reason: str, rest: Rest) -> Outcome:
        recorder = self.recorder
        return Outcome(
            status=status if rest.safe else NOT_SAFE_STATUS,
            reason=reason,
            safe=rest.safe,
            standing=rest.standing,
            voltage=recorder.hv.voltage if recorder.hv is not None else math.nan,
            force=recorder.force,
            position=recorder.stage.position if recorder.stage is not None else math.nan,
            duration=self.clock.now() - self._started,
            second=self.guard.second_words if self.guard is not None else "",
        )
