"""The guard: sole commander of the high voltage.

It starts latched SAFE. Arming needs the operator's word and a supply that is measurably off; the first set-point
makes it LIVE; any fault latches it SAFE again, and nothing but a new arming leads out of there. Connecting, reading
and latching never raise an output. On real ports it lives in a process of its own (`rig.safety.process`); on a bench in
memory in the engine's, by the same rules. In both it lives by the engine's heartbeats. Software is not the
safety function: the interlock loop, the emergency stop, the supply's own current limit and the bleed resistor are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import Enum, Flag
from typing import TYPE_CHECKING, TypeAlias

from drivers.roles import GivesBack, HVFlag, HVSample, HVSupply, MonitorSample, OwnTrip, Renewed
from rig.base.errors import Breakdown, BreakdownCurrent, FaultError, LimitError, StaleData
from rig.safety.commanded import DEVIATION_PART, DEVIATION_V, CommandedRamp, ramp_limit
from rig.safety.heartbeat import DEADLINE_S, Heartbeat
from rig.safety.limits import FilmLimits, Limit, Limits
from rig.safety.stopped import LOOK_S, Peer

if TYPE_CHECKING:
    from rig.safety.remote import RemoteGuard
    from rig.safety.second import SecondReading

AnyGuard: TypeAlias = "Guard | RemoteGuard"  # in the engine's process, or in one of its own

SAFE_VOLTAGE = 60.0  # V; below this the discharge is harmless (EN 50191 names 60 V DC)
AWAY_V = 3.0  # an output outside what its ramp allows that moves away by more than this from sample to sample ...
DEVIATION_SAMPLES = 2  # ... and so many samples in a row that show it outside, are a fault
FROZEN_SAMPLES = 25  # this many equal measurements of voltage and current in a row: last digits are never so quiet
FROZEN_RAMP_V, FROZEN_RAMP_SAMPLES = 100.0, 3  # nor does a ramp over so much leave so many voltages equal
FILM_CHECK_S = 0.05  # how often the model is asked about the measured (displacement, voltage)
AT_ONCE_S = 4.0  # how long an emergency off may take to be measured before the output is called NOT SAFE
NOT_SAFE = f"NOT SAFE: the output was not measured off (below {SAFE_VOLTAGE:.0f} V, and the channel off)."
ADVICE = "Keep away; switch the supply off at its mains switch and use the grounding stick."
CHARGING_PART = 0.2  # what the model may be wrong in the film's charging current
GIVE_BACK = "give_back"
SAFE_SAMPLES = 2  # consecutive samples that show the output off before we call it safe

DRIVEN = HVFlag.ON | HVFlag.RAMPING  # an output that is driven may be low only for now
ARC = HVFlag.ARC | HVFlag.TRIPPED  # what the supply itself sees of a breakdown
TRIP = HVFlag.TRIPPED | HVFlag.INHIBITED | HVFlag.EMERGENCY_OFF | HVFlag.INTERLOCK_OPEN | HVFlag.ARC | HVFlag.FAULT


class GuardState(Enum):
    """Where the latch stands."""

    SAFE = "safe"
    ARMED = "armed"
    LIVE = "live"


class Guard:
    """Owns the supply's commands, checks every set-point and every sample.

    Parameters
    ----------
    supply : HVSupply
        Nobody else may command it. The current of one that does not measure it is not watched; a missing value from
        one that does is outside its limits.
    limits, film : Limits, FilmLimits
        What is allowed of voltage and current, and of the pair (displacement, voltage) on the deformed film.
    ramp : float
        Ramp rate in V/s for every change of the output.
    tell : callable
        ``tell(command, argument)`` is called with each command before it is given, for the log.
    fresh : mapping of str to float
        How old the newest good sample of each role may be while armed (s), by the engine's `heartbeat`.
    second : SecondReading, optional
        A monitor of the voltage: off is only what both show. Its readings come by `on_monitor`.
    engine : Peer, optional
        The engine's process, where it is another one: whether it was stopped.
    """

    def __init__(
        self,
        supply: HVSupply,
        limits: Limits,
        film: FilmLimits,
        ramp: float,
        tell: Callable[[str, str], None],
        fresh: Mapping[str, float] | None = None,
        second: SecondReading | None = None,
        engine: Peer | None = None,
    ) -> None:
        self.state = GuardState.SAFE
        self.cause = "not armed"
        self.commanded = False  # whether the supply was ever told anything; until then it is left alone
        self.setpoint = 0.0
        self.ramps_down = False  # whether the last off was a ramp, which takes its time
        self._supply = supply
        self._renew = supply.renew if isinstance(supply, Renewed) else None  # both asked here once: it is slow
        self._lent = supply if isinstance(supply, GivesBack) else None
        self._limits = limits
        self._film = film
        self._ramp = ramp
        self._tell = tell
        self._fresh = dict(fresh or {})
        self._second = second
        self._engine = engine
        self._beat: Heartbeat | None = None
        self._alive_at: float | None = None  # when the engine last gave a sign of life; None: not yet since arming
        self.longest_silence = 0.0  # s between two signs of life while armed; to be held against DEADLINE_S
        self._goal = 0.0  # displacement to which the disk is being moved
        self._next_film_check = -math.inf
        self._low_samples = 0
        self._deviating_samples = 0
        self._equal_samples = 0
        self._equal_since: tuple[HVSample, bool] | None = None  # and whether the output was to move
        self._seen_on = self._was_up = False  # in this arming: the channel on, and an output where its ramp has it
        self._commanded: CommandedRamp | None = None  # what the output was last told to do, but for an emergency off
        self._charge: tuple[float, float] | None = None  # time (s) and charge on the film (C) at the last sample
        self._leaking_samples = 0
        self.last: HVSample | None = None

    @property
    def output_is_safe(self) -> bool:
        """Whether the last two samples show it *measured* below 60 V, not rising, the channel off, no ramp under way,
        and no more current than the film may leak.

        A low voltage alone proves nothing: an output that does not obey its off may be on its way up. Where there is a
        second reading, that too must show it.
        """
        return self._low_samples >= SAFE_SAMPLES and self._second_shows_off

    @property
    def _second_shows_off(self) -> bool:
        return self._second is None or (self.last is not None and self._second.shows_off(self.last.t))

    @property
    def second_words(self) -> str:
        """What the second reading shows, in words; empty without one."""
        if self._second is None:
            return ""
        return self._second.words(math.nan if self.last is None else self.last.t)

    @property
    def off_limit(self) -> float:
        """Seconds that an emergency off may take to be measured."""
        return AT_ONCE_S + (0.0 if self._second is None else self._second.wait_s)

    @property
    def ramp_duration(self) -> float:
        """Seconds that a ramp from the measured voltage to zero should take."""
        measured = abs(self.last.voltage) if self.last is not None else math.nan
        start = measured if math.isfinite(measured) else self._limits.voltage.high
        return start / self._ramp

    @property
    def ramp_limit(self) -> float:
        """Seconds after which an output that is ramped down must have been measured off."""
        return ramp_limit(self.ramp_duration) + self.off_limit - AT_ONCE_S

    def arm(self) -> None:
        """Leave SAFE. The supply must be measurably off and free of faults.

        Raises
        ------
        FaultError
            When the supply is live, tripped or unmeasured; nothing is changed then.
        """
        self.check_off()
        assert self.last is not None
        if faults := self.last.flags & TRIP:
            raise FaultError(f"hv: cannot be armed, the supply reports {flag_names(faults)}. Clear the cause first.")
        limited = self._supply.measures_current
        limit = f"current limit {self._limits.current.high!r} A" if limited else "no current limit"
        bounds = max(DEVIATION_V, DEVIATION_PART * self._limits.voltage.high)
        trips = f", own trip beyond it, bounds {bounds!r} V" if isinstance(self._supply, OwnTrip) else ""
        self._tell("arm", f"ramp {self._ramp!r} V/s, {limit}{trips}")
        self.commanded = True
        self._supply.set_ramp(self._ramp)
        if limited:
            self._supply.set_current_limit(self._limits.current.high)
        if isinstance(self._supply, OwnTrip):
            self._supply.arm_trip(bounds, self._limits.current.high)
        self.state = GuardState.ARMED
        self.cause = ""
        self._alive_at = None
        self._seen_on = self._was_up = False
        self._charge = None

    def check_supply(self, highest: float) -> None:
        """Refuse what this supply cannot be asked for, before anything moves.

        Raises
        ------
        LimitError
            When its ramp, its current limit or ``highest``, the highest voltage planned, is beyond what it can do.
        """
        volts, amperes = self._supply.nominal
        Limit("voltage", 0.0, volts, "V").check(highest, "hv: the protocol's highest voltage, for this supply")
        fastest = Limit("ramp", 0.0, self._supply.fastest_ramp, "V/s")
        fastest.check(self._ramp, "hv.ramp_V_per_s, for this supply")
        if self._supply.measures_current:
            Limit("current", 0.0, amperes, "uA", 1e6).check(
                self._limits.current.high, "limits.current_uA, for this supply"
            )

    def check_off(self) -> None:
        """The output must have been measured off, and the channel say that it is.

        Raises
        ------
        FaultError
            When it is live or unmeasured; nothing is changed then.
        """
        low = self.last is not None and abs(self.last.voltage) < SAFE_VOLTAGE
        if self.last is not None and low and HVFlag.ON in self.last.flags:
            raise FaultError("hv: cannot be used, the channel is on already. Nothing was changed. Switch it off first.")
        if self.last is not None and low and self._low_samples >= SAFE_SAMPLES and not self._second_shows_off:
            raise FaultError(
                f"hv: cannot be used, the supply says that its output is off, but {self.second_words}. Off is "
                "what both show. Nothing was changed. Check the monitor and its probe; if the output is live, take it "
                "down by hand; start again."
            )
        if self.last is None or not self.output_is_safe:
            measured = "not measured yet" if self.last is None else f"{self.last.voltage:.0f} V"
            if self.last is not None and self._draws(self.last):
                measured += f" and drives {self.last.current * 1e6:.3g} uA (limits.leakage_uA)"
            raise FaultError(
                f"hv: cannot be used, its output is {measured} though nobody switched it on from here. Nothing was "
                "changed. Find out who did; take it down by hand; start again."
            )

    def take_down(self, cause: str) -> None:
        """Ramp down and switch off an output that was found live, by the operator's choice; the latch stays SAFE."""
        self.commanded = self.ramps_down = True
        self._low_samples = 0
        if self._second is not None:
            self._second.expect_off()
        self._expect(0.0)
        try:
            self._tell("take_down", f"ramp {self._ramp!r} V/s; {cause}")
        finally:
            try:
                self._supply.set_ramp(self._ramp)
            finally:
                self._supply.switch_off()

    def clear_faults(self, cause: str) -> None:
        """Clear what the supply has latched, an earlier emergency off for one, by the operator's choice; leaves it off.

        Raises
        ------
        FaultError
            When the output is live or unmeasured; nothing is changed then.
        """
        self.check_off()
        self._tell("clear", cause)
        self._supply.clear()

    @property
    def given_back(self) -> bool:
        """Whether the supply has everything back that arming changed."""
        return self._lent is None or self._lent.given_back

    def give_back(self) -> None:
        """Put back what arming changed in the supply; only while the output is measured off."""
        if self._lent is not None and self.output_is_safe and self.state is GuardState.SAFE:
            self._tell(GIVE_BACK, "")
            self._lent.give_back()

    def request(self, volts: float, h: float) -> None:
        """Ramp the output to ``volts`` with the disk at displacement ``h`` metres.

        Raises
        ------
        LimitError
            When the voltage, the field or the tension on the deformed film would be outside its limits.
        FaultError
            When the guard is latched.
        """
        if self.state is GuardState.SAFE:
            raise FaultError(f"hv: {volts:g} V refused, the guard is latched safe ({self.cause}).")
        self._limits.voltage.check(volts, "HV set-point")
        for where in (h, self._goal):
            self._film.check(where, volts, f"HV set-point {volts:g} V at {where * 1e3:.2f} mm")
        self._tell("set_voltage", f"{volts!r} V")
        self.setpoint = volts
        self._expect(volts)
        self._supply.set_voltage(volts)
        if self.state is GuardState.ARMED:
            self._tell("switch_on", "")
            self._supply.switch_on()
            self.state = GuardState.LIVE
        self._low_samples = 0
        if self._second is not None:
            self._second.expect_off()

    def _expect(self, volts: float) -> None:
        """From here on the output is held against a ramp to ``volts``."""
        if self.last is None or not math.isfinite(self.last.voltage):
            self._commanded = None
        else:
            before = self._commanded.target if self._commanded is not None else self.last.voltage
            self._commanded = CommandedRamp(self.last.t, self.last.voltage, volts, self._ramp, before)

    def check_move(self, h0: float, h1: float) -> None:
        """Ask before the disk is moved from displacement ``h0`` to ``h1`` metres.

        Raises
        ------
        LimitError
            When field or tension would be outside their limits somewhere on the way, at the voltage that is on.
        """
        self._film.check_path(h0, h1, self._voltage)
        self._goal = h1

    def heartbeat(self, data: bytes, now: float) -> None:
        """Take in one sign of life of the engine's loop, as `Heartbeat.encode` gives it.

        Raises
        ------
        FaultError
            Damaged, repeated, or one is missing before it; the output has been taken off at once then.
        """
        try:
            beat = Heartbeat.decode(data)
            last = self._beat.counter if self._beat is not None else 0
            if beat.counter != last + 1:
                raise ValueError(f"it is number {beat.counter} after {last}")
        except ValueError as error:
            raise self._off(f"the engine's heartbeat cannot be believed: {error}") from None
        if self._alive_at is not None and self.state is not GuardState.SAFE:
            self.longest_silence = max(self.longest_silence, now - self._alive_at)
        self._beat = beat
        self._alive_at = now

    def excuse(self, seconds: float) -> None:
        """The engine could not beat for so long, because it waited for the guard's own answer."""
        if self._alive_at is not None:
            self._alive_at += seconds

    def turn(self, now: float) -> None:
        """Judge what only shows over time: the engine's life, the age of its data, the film as measured.

        Raises
        ------
        FaultError
            The engine has been silent for longer than `DEADLINE_S`, or was stopped: off at once.
        StaleData
            A sensor's newest good sample is too old: ramped down.
        LimitError
            Field or tension at the measured displacement is outside its limits: off at once.
        """
        if self.state is not GuardState.SAFE:
            self._judge_engine(now)
            self._judge_second_age(now)
        h = self._beat.displacement if self._beat is not None else math.nan
        cut = self.state is GuardState.SAFE and not self.ramps_down  # an off that is given again and again is not heard
        live = self.commanded and not self.output_is_safe and not cut
        if live and now >= self._next_film_check and math.isfinite(h):  # else the sensor's own judgement decides
            self._next_film_check = now + FILM_CHECK_S
            try:
                self._film.check(h, self._voltage, "Film, as measured")
            except LimitError as error:
                self.kill(str(error))
                raise
        if self._renew is not None:
            self._renew()

    @property
    def next_look(self) -> float:
        """When `turn` has something to judge, though nothing may have come by then; infinity while latched."""
        if self.state is GuardState.SAFE or self._alive_at is None:
            return math.inf
        return min(self._next_film_check, self._alive_at + LOOK_S)

    def _judge_engine(self, now: float) -> None:
        if self._alive_at is None:
            self._alive_at = now
        silent = now - self._alive_at
        if not silent <= DEADLINE_S:
            raise self._off(f"the engine has been silent for {silent * 1e3:.0f} ms")
        if silent > LOOK_S and self._engine is not None and self._engine.stopped:
            raise self._off(f"the engine was stopped, and has been silent for {silent * 1e3:.0f} ms")
        if self._beat is None:
            return
        for role, allowed in self._fresh.items():
            age = now - self._beat.samples.get(role, math.nan)
            if not age <= allowed:
                cause = f"the newest good sample of {role} is {age:.2f} s old"
                self.ramp_off(cause)
                raise StaleData(f"hv: {cause}; the guard ramps the output down.")

    def _judge_second_age(self, now: float) -> None:
        try:
            if self._second is not None:
                self._second.check_age(now)
        except StaleData as error:
            self.ramp_off(str(error))
            raise

    @property
    def _voltage(self) -> float:
        """The higher of what is set and what is measured."""
        measured = self.last.voltage if self.last is not None else 0.0
        return max(self.setpoint, measured if measured > 0 else 0.0)

    def _off(self, cause: str) -> FaultError:
        """Take the output off at once and give back the error that says so."""
        self.kill(cause)
        return FaultError(f"hv: {cause}; the guard took the output off.")

    def on_sample(self, sample: HVSample) -> None:
        """Judge one measurement of the output.

        Raises
        ------
        LimitError, FaultError
            When voltage or current is outside its limit, or the supply reports a trip while live; and when the
            monitor is frozen, whoever takes the voltage down.
        """
        before, self.last = self.last, sample
        if self._second is not None:
            self._second.on_supply(sample)
        below = abs(sample.voltage) < SAFE_VOLTAGE  # False for NaN
        rises = before is not None and abs(sample.voltage) > abs(before.voltage) + AWAY_V
        off = below and not rises and not sample.flags & DRIVEN and not self._draws(sample)
        self._low_samples = self._low_samples + 1 if off else 0
        if self.commanded and not below:
            self._judge_frozen(sample)
        if self.state is not GuardState.LIVE:
            if self.ramps_down and self.commanded and not self.output_is_safe:
                self._judge_ramp_down(sample)
            return
        self._limits.measured_voltage.check(sample.voltage, "HV monitor")
        if self._supply.measures_current:
            self._judge_current(sample)
        faults = sample.flags & TRIP
        if faults:
            kind = Breakdown if faults & ARC else FaultError
            raise kind(f"hv: the supply reports {flag_names(faults)}.")
        self._judge_deviation(sample, before)

    def _draws(self, sample: HVSample) -> bool:
        """Whether more current flows than the film may leak: what is off drives none, whatever else is said of it."""
        return self._supply.measures_current and sample.current > self._limits.leakage

    def on_monitor(self, sample: MonitorSample) -> None:
        """Judge one reading of the monitor. It can end a run and keep an output from counting as off, nothing else.

        Raises
        ------
        LimitError, FaultError
            While there is voltage: it is outside its limit, or supply and monitor disagree.
        """
        if self._second is None or sample.role != self._second.role:
            return
        self._second.take(sample)
        goes_down = self.ramps_down and self.commanded and not self.output_is_safe
        if self.state is GuardState.LIVE or goes_down:
            self._second.judge()

    def _judge_frozen(self, sample: HVSample) -> None:
        """A monitor that shows the very same for too long, or while the output must be moving, tells nothing any more.

        At rest only where a current is measured as well: a voltage in whole volts may rightly stand still.
        """
        ramping = HVFlag.RAMPING in sample.flags and abs(sample.voltage - self.setpoint) > DEVIATION_V
        first, was_ramping = self._equal_since or (sample, not ramping)
        same = sample.voltage == first.voltage and (ramping or sample.current == first.current)  # never for NaN
        if not same or ramping is not was_ramping:
            self._equal_since, self._equal_samples = (sample, ramping), 1
            return
        self._equal_samples += 1
        if ramping:
            missing = self._ramp * (sample.t - first.t)
            frozen = missing > FROZEN_RAMP_V and self._equal_samples >= FROZEN_RAMP_SAMPLES
        else:
            frozen = self._equal_samples >= FROZEN_SAMPLES
        if frozen:
            self._equal_since = None
            raise FaultError(
                f"hv: the monitor has shown the same {sample.voltage:.6g} V for {sample.t - first.t:.2f} s"
                f"{' of a ramp' if ramping else ''}; it is frozen."
            )

    def _judge_current(self, sample: HVSample) -> None:
        r"""More current than charges the film and may leak, in two samples running or above the limit, is a breakdown.

        A film takes :math:`i = d(CV)/dt + V/R`: here the model's charge on the deformed film, differenced from sample
        to sample, and the limit ``leakage_uA``. While it discharges the supply may show no current at all.
        """
        h = self._beat.displacement if self._beat is not None else math.nan
        volts = max(sample.voltage, 0.0)
        charge = volts * self._film.capacitance(h if math.isfinite(h) else 0.0, volts)
        last, self._charge = self._charge, (sample.t, charge)
        known = last is not None and sample.t > last[0]
        charging = max((charge - last[1]) / (sample.t - last[0]), 0.0) if last is not None and known else math.nan
        allowed = charging * (1 + CHARGING_PART) + self._limits.leakage
        try:
            self._limits.current.check(sample.current, "HV monitor")
        except LimitError as error:
            if sample.current > allowed:
                raise BreakdownCurrent(str(error)) from None
            raise
        if not known:
            return
        self._leaking_samples = 0 if sample.current <= allowed else self._leaking_samples + 1
        if self._leaking_samples >= DEVIATION_SAMPLES:
            raise Breakdown(
                f"hv: breakdown, the film draws {sample.current * 1e6:.3g} uA where charging and leakage explain at "
                f"most {allowed * 1e6:.3g} uA."
            )

    def _judge_deviation(self, sample: HVSample, before: HVSample | None) -> None:
        """The output must be on, and where the commanded ramp has it; two samples in a row that say no are a fault.

        That the supply says of itself that it is ramping excuses nothing. Where no current is measured, a film that
        breaks down shows in nothing but an output that was up and sags; one that never rose is a fault.
        """
        on = HVFlag.ON in sample.flags
        self._seen_on = self._seen_on or on
        settled = on and not self._supply.busy and HVFlag.RAMPING not in sample.flags
        sagged = False
        if self._seen_on and not on:
            problem = "the supply says that it is off, and nobody switched it off from here"
        elif settled and not math.isclose(sample.setpoint, self.setpoint, rel_tol=1e-3, abs_tol=1.0):
            problem = f"its set-point is {sample.setpoint:.0f} V, and {self.setpoint:.0f} V were asked for from here"
        else:
            problem, sagged = self._off_its_ramp(sample, before, settled=settled)
        self._deviating_samples = self._deviating_samples + 1 if problem else 0
        if self._deviating_samples >= DEVIATION_SAMPLES:
            if sagged and self._was_up and not self._supply.measures_current:
                raise Breakdown(f"hv: {problem}. This supply measures no current: the film has probably broken down.")
            raise FaultError(f"hv: {problem}.")

    def _off_its_ramp(self, sample: HVSample, before: HVSample | None, *, settled: bool) -> tuple[str, bool]:
        """What is wrong with the voltage, held against the commanded ramp, and whether it sags; empty if nothing is."""
        if self._commanded is None:
            return f"the output is at {sample.voltage:.0f} V, and it was never measured before it was commanded", False
        self._commanded.confirm(sample.t, busy=self._supply.busy)
        least, most = self._commanded.band(sample.t)
        missing = abs(sample.voltage - self.setpoint)
        allowed = max(DEVIATION_V, DEVIATION_PART * self.setpoint)
        heard = HVFlag.ON in sample.flags and not self._supply.busy
        goes_away = heard and before is not None and missing > abs(before.voltage - self.setpoint) + AWAY_V
        inside = least <= sample.voltage <= most and not ((settled or goes_away) and not missing <= allowed)
        if inside:
            self._was_up = self._was_up or sample.voltage > DEVIATION_V
            return "", False
        ahead = most < sample.voltage < self.setpoint or self.setpoint < sample.voltage < least
        sagged = not ahead and sample.voltage < self.setpoint
        word = "run ahead of its ramp" if ahead else "sagged" if sagged else "risen"
        return (
            f"the output has {word} to {sample.voltage:.0f} V with {self.setpoint:.0f} V set; the commanded ramp has "
            f"it between {least:.0f} and {most:.0f} V",
            sagged,
        )

    def _judge_ramp_down(self, sample: HVSample) -> None:
        """An output that does not come down as commanded is not waited for."""
        if self._commanded is None:
            return
        self._commanded.confirm(sample.t, busy=self._supply.busy)
        _, most = self._commanded.band(sample.t)
        self._deviating_samples = self._deviating_samples + 1 if not sample.voltage <= most else 0
        if self._deviating_samples >= DEVIATION_SAMPLES:
            self._deviating_samples = 0
            raise FaultError(f"hv: the output is at {sample.voltage:.0f} V, its ramp down has it below {most:.0f} V.")

    def ramp_off(self, cause: str) -> None:
        """Ramp the output down, switch it off and latch SAFE. For orderly ends; does nothing unless armed or live."""
        if self.state is GuardState.SAFE:
            return
        self._latch(cause, ramps_down=True)
        self._expect(0.0)
        try:
            self._tell("switch_off", cause)
        finally:
            self._supply.switch_off()

    def kill(self, cause: str) -> None:
        """Take the output off at once and latch SAFE. A supply that was never armed is left alone."""
        if not self.commanded:
            return
        self._latch(cause, ramps_down=False)
        try:
            self._tell("emergency_off", cause)
        finally:
            self._supply.emergency_off()

    def _latch(self, cause: str, *, ramps_down: bool) -> None:
        if self._second is not None and self.state is not GuardState.SAFE:  # not each time that an off is repeated
            self._second.expect_off()
        self.state = GuardState.SAFE
        self.ramps_down = ramps_down
        self.cause = cause
        self.setpoint = 0.0
        self._low_samples = self._deviating_samples = 0


def flag_names(flags: Flag) -> str:
    """The flags in plain words."""
    return ", ".join((flag.name or "").lower().replace("_", " ") for flag in flags)
