"""An analogue HV amplifier (Trek, UltraVolt, Matsusada) driven by a LabJack: DAC, monitors, a line to enable it.

The amplifier cannot be identified: what is typed in is proven. Each time the output is switched on, a step of
``proof_V`` (below the 60 V that count as safe) must show on the voltage monitor with the right size and sign; else the
output is taken off and the run is refused. An unplugged monitor shows 0 V, so that 0 V alone proves nothing.

The DAC holds its value when the host dies, and closing the connection changes nothing. So the device's own watchdog, in
strict mode, is armed before the first volt: unless its key is written again within ``watchdog_s``, it sets the DAC to
0 V and the enable line to off. The key is written only after `renew`, which the code that decides on the output calls.
Its settings are kept in flash: they are compared first, and written only where they differ. It stays armed afterwards,
also through a power cycle; all that it can do is to switch off.

There is no ramp in the device: the DAC moves in steps at the polling rate, each read back, since it is clamped silently
at the end of its range. While the output lags behind (the amplifier is at its current limit) the steps wait.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.dialogue import LOST_AGAIN_S, Schedule
from drivers.instruments.labjack.codec import (
    DAC0,
    DAC1_SQUARE_WAVE,
    DIO0,
    DIO_DIRECTION,
    DIO_STATE,
    PRODUCTS,
    WATCHDOG_ADVANCED,
    WATCHDOG_CLEAR,
    WATCHDOG_DAC0,
    WATCHDOG_DAC0_VOLTS,
    WATCHDOG_DIO,
    WATCHDOG_DIO_DIRECTION,
    WATCHDOG_DIO_INHIBIT,
    WATCHDOG_DIO_STATE,
    WATCHDOG_ENABLE,
    WATCHDOG_KEY,
    WATCHDOG_RESET,
    WATCHDOG_STARTUP_S,
    WATCHDOG_STRICT,
    WATCHDOG_TIMEOUT_S,
    Product,
    f32,
    u16,
    u32,
)
from drivers.instruments.labjack.registers import RAIL, Part, Registers, Script
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused
from drivers.roles import HVFlag, HVSample, Identity

COARSEST = PRODUCTS[4]  # until it is known which it is

KEY = 0x4445_4131
"""What clears the watchdog, and how often it is written (s): several times in the shortest period."""
KEY_S = 0.25

LONGEST_STEP_S = 0.25  # a ramp does not make up for time in which nobody polled
LAG_V, LAG_PART = 30.0, 0.05  # how far the output may be behind before the ramp waits
LAG_LIMIT_S = 2.0  # and how long the ramp may wait
PROOF_SAMPLES = 5
OFF_V = 60.0
_ALL_LINES = 0x7F_FFFF
_UNSAFE = "Take the high voltage away by hand: switch the amplifier off, then ground the electrodes."
_RELAY = "Check the amplifier's own switch, its remote enable and its cable."


@dataclass(frozen=True)
class Amplifier:
    """What is typed in about the amplifier: its gain, its monitors and its ends.

    ``polarity`` -1: a positive input gives a negative output. Voltages and currents are stated positive either way.
    """

    gain_V_per_V: float
    voltage_monitor_V_per_V: float
    current_monitor_uA_per_V: float
    full_scale_V: float
    current_limit_uA: float
    slew_V_per_us: float
    polarity: int = 1


class LabJackAmplifier:
    """A `drivers.roles.HVSupply`. Set-up reads, and sets the ranges of the inputs; it changes no output.

    Parameters
    ----------
    amplifier : Amplifier
        What is typed in about it.
    dac : int
        DAC0 or DAC1.
    voltage_ain, current_ain : int
        Inputs with the monitors.
    enable_line : int, optional
        Digital line (0: FIO0) that enables the amplifier; None where there is none.
    enable_high : bool
        Whether the amplifier is enabled by a high level.
    watchdog_s : int
        After how long without its key the device takes the output off by itself.
    proof_V, proof_tolerance, settle_s : float
        The step that proves gain and monitor, how far off it may be (relative), and how long it is waited for.
    poll_rate_Hz : float
        How often monitors and outputs are read; also the rate of the ramp's steps.
    boot_s : float
        How long the first answer may take.
    """

    measures_current = True

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        amplifier: Amplifier,
        dac: int = 0,
        voltage_ain: int = 0,
        current_ain: int = 1,
        enable_line: int | None = None,
        enable_high: bool = False,
        watchdog_s: int = 3,
        proof_V: float = 50.0,
        proof_tolerance: float = 0.15,
        settle_s: float = 0.2,
        poll_rate_Hz: float = 20.0,
        timeout_s: float = 0.25,
        ramp_V_per_s: float = 100.0,
        boot_s: float = 0.0,
    ) -> None:
        self.name = name
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"lagging": 0, "over_range": 0, "watchdog_keys": 0}
        self._registers = Registers(name, link, self.counters, timeout_s, boot_s)
        self._label = self._registers.label
        self._dialogue = self._registers.dialogue
        self._link = link
        self._amplifier = amplifier
        self._dac, self._inputs = dac, (voltage_ain, current_ain)
        self._line, self._high = enable_line, enable_high
        self._watchdog_s = watchdog_s
        self._proof, self._tolerance, self._settle = proof_V, proof_tolerance, settle_s
        self._period = 1.0 / poll_rate_Hz
        self._schedule = Schedule(self._period, self.counters)
        self._samples: deque[HVSample] = deque()
        self._now = self._next_poll = 0.0
        self._ready = False
        self._commands = 0
        self._product: Product | None = None
        self._ranges = (math.nan, math.nan)
        self._ramp = ramp_V_per_s
        self._limit = math.inf  # A
        self._over_limit = 0
        self._wanted = self._setpoint = 0.0  # V of the output
        self._measured = self._dac_volts = math.nan
        self._proven = False
        self._stepped_at: float | None = None
        self._lags_since: float | None = None
        self._on = self._emergency = self._tripped = self._found_live = False
        self._renewed = self._armed = False
        self._key_at = -math.inf
        self._dialogue.begin(self._set_up())

    # -- what it can do ----------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def nominal(self) -> tuple[float, float]:
        """(volts, amperes): the smaller of what the amplifier gives and what the DAC can ask for."""
        reach = math.nan if self._product is None else self._product.dac_V * self._amplifier.gain_V_per_V
        return min(self._amplifier.full_scale_V, reach), self._amplifier.current_limit_uA * 1e-6

    @property
    def fastest_ramp(self) -> float:
        return self._amplifier.slew_V_per_us * 1e6

    @property
    def busy(self) -> bool:
        return self._commands > 0

    # -- commands ----------------------------------------------------------------------------------------------------

    def renew(self) -> None:
        """The code that decides on the output has decided: the watchdog's key may be written once more."""
        self._renewed = True

    def set_ramp(self, volts_per_second: float) -> None:
        self._require_ready()
        if not 0 < volts_per_second <= self.fastest_ramp:
            raise DeviceRefused(
                self._label, f"{volts_per_second:g} V/s is no ramp of it", f"At most {self.fastest_ramp:g} V/s."
            )
        self._ramp = volts_per_second

    def set_current_limit(self, amperes: float) -> None:
        """More in two samples running is a trip; what limits at once is the amplifier itself."""
        self._require_ready()
        if not 0 < amperes <= self.nominal[1]:
            raise DeviceRefused(
                self._label, f"a current limit of {amperes:g} A is outside its range", f"At most {self.nominal[1]:g} A."
            )
        self._limit = amperes

    def set_voltage(self, volts: float) -> None:
        self._require_ready()
        if not 0 <= volts <= self.nominal[0]:
            raise DeviceRefused(
                self._label,
                f"a set-point of {volts:g} V is outside its range",
                f"Allowed: 0 to {self.nominal[0]:g} V, which amplifier and DAC can give.",
            )
        self._wanted = volts  # at once: there is nothing to send before the next step
        self._stepped_at = self._lags_since = None

    def switch_on(self) -> None:
        """Arm the watchdog, enable the amplifier at 0 V, prove it, and ramp to the set-point."""
        self._require_ready()
        if self._emergency or self._tripped:
            raise DeviceRefused(self._label, "it is not switched on after a trip", "Find the cause, then clear.")
        self._command(self._switch_on())

    def switch_off(self) -> None:
        self._require_ready()
        self._dialogue.clear()  # nothing that was queued before may switch on after it
        self._commands = 0
        self._command(self._switch_off())

    def emergency_off(self) -> None:
        self._dialogue.clear()
        self._commands = 0
        self._emergency = True
        self._wanted = self._setpoint = 0.0  # no step down may write more than 0 V after it, confirmed or not
        self._command(self._emergency_off())
        if not self._ready:
            self._dialogue.begin(self._set_up())

    def clear(self) -> None:
        self._emergency = self._tripped = False

    def poll(self, now: float) -> Sequence[HVSample]:
        self._now = now
        try:
            self._registers.take_in(now)
            if self._ready and self._dialogue.idle and self._schedule.take(now):
                self._dialogue.begin(self._cycle())
            self._dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now
            raise
        due = self._schedule.due if self._dialogue.idle else math.inf
        self._next_poll = min(self._dialogue.next_poll(now), due)
        samples = list(self._samples)
        self._samples.clear()
        return samples

    def close(self) -> None:
        self._link.close()

    # -- set-up ------------------------------------------------------------------------------------------------------

    def _set_up(self) -> Script:
        identity, product = yield from self._registers.identify(self.settings)
        voltage_ain, current_ain = self._inputs
        ranges = []
        for ain in self._inputs:
            ranges.append((yield from self._registers.widest_range(ain, product, self.settings)))
        self._ranges = (ranges[0], ranges[1])
        if self._dac == 1 and (yield from self._registers.whole(DAC1_SQUARE_WAVE)):
            raise DeviceRefused(
                self._label, "DAC1 gives a square wave", f"Write 0 to register {DAC1_SQUARE_WAVE} in its software."
            )
        dac = yield from self._registers.number(self._dac_register)
        enabled = yield from self._is_enabled()
        watchdog = yield from self._registers.whole(WATCHDOG_ENABLE)
        self._product = product
        self.identity = identity
        self._setpoint = self._wanted = self._volts(dac)
        self._on = self._found_live = abs(self._setpoint) > self._least_step and enabled
        self.settings |= {
            "gain_V_per_V": f"{self._amplifier.gain_V_per_V:g}",
            "largest_voltage_V": f"{self.nominal[0]:g}",
            "step_of_output_V": f"{self._least_step:.4g}",
            "DAC_at_setup_V": f"{dac:.4f}",
            "enabled_at_setup": "no line" if self._line is None else ("yes" if enabled else "no"),
            "watchdog_at_setup": "armed" if watchdog else "off",
            "inputs": f"AIN{voltage_ain} AIN{current_ain}",
        }
        self._schedule.start(self._now)
        self._ready = True

    @property
    def _dac_register(self) -> int:
        return DAC0 + 2 * self._dac

    @property
    def _least_step(self) -> float:
        """Volts of the output per step of the DAC."""
        product = self._product or COARSEST
        return product.dac_V / product.dac_steps * self._amplifier.gain_V_per_V

    def _volts(self, dac: float) -> float:
        """Output that the DAC asks for (V); the DAC's own offset at its end is none."""
        return dac * self._amplifier.gain_V_per_V

    def _is_enabled(self) -> Part[bool]:
        """Whether the line enables the amplifier; where there is none it always is."""
        if self._line is None:
            return True
        state = yield from self._registers.whole(DIO_STATE)
        return bool(state >> self._line & 1) is self._high

    def _enable(self, on: bool) -> Part[None]:
        """Set the line and see that it is an output with the level that was asked for."""
        if self._line is None:
            return
        level = int(on is self._high)
        yield from self._registers.write(DIO0 + self._line, u16(level))
        state = yield from self._registers.whole(DIO_STATE)
        direction = yield from self._registers.whole(DIO_DIRECTION)
        if state >> self._line & 1 != level or not direction >> self._line & 1:
            raise DeviceRefused(
                self._label, f"digital line {self._line} does not take level {level}", "Is something else driving it?"
            )

    # -- samples and ramp --------------------------------------------------------------------------------------------

    @property
    def _target(self) -> float:
        """Where the ramp goes: nowhere before the output has been proven, unless it was found live."""
        return self._wanted if self._proven or self._found_live else 0.0

    def _cycle(self) -> Script:
        if self._on and self._setpoint != self._target:
            yield from self._step()
        yield from self._sample()

    def _sample(self, delay_s: float = 0.0) -> Part[float]:
        """Read monitors and outputs; the measured voltage."""
        if self._armed and self._renewed and self._now >= self._key_at + KEY_S:
            self._renewed, self._key_at = False, self._now
            self.counters["watchdog_keys"] += 1
            yield from self._registers.write(WATCHDOG_CLEAR, u32(KEY))
        volts, amperes, t = yield from self._registers.inputs(*self._inputs, delay_s)
        dac = yield from self._registers.number(self._dac_register)
        enabled = yield from self._is_enabled()
        a = self._amplifier
        voltage = volts * a.voltage_monitor_V_per_V * a.polarity
        current = amperes * a.current_monitor_uA_per_V * 1e-6 * a.polarity
        self._measured, self._dac_volts = voltage, dac
        self._judge(volts, amperes, current)
        read_back = self._volts(dac)
        as_asked = abs(read_back - self._setpoint) <= self._least_step
        self._samples.append(
            HVSample(t, voltage, current, self._setpoint if as_asked else read_back, self._flags(enabled, voltage))
        )
        return voltage

    def _judge(self, volts: float, amperes: float, current: float) -> None:
        """A saturated input is over range, which counts as a trip; so does more current than the limit, twice."""
        rails = zip((volts, amperes), self._ranges, strict=True)
        if not all(abs(value) < RAIL * end for value, end in rails):
            self.counters["over_range"] += 1
            self._tripped |= self._on
        self._over_limit = self._over_limit + 1 if abs(current) > self._limit else 0
        self._tripped |= self._on and self._over_limit >= 2

    def _flags(self, enabled: bool, voltage: float) -> HVFlag:
        flags = HVFlag(0)
        if self._on or (enabled and self._line is not None):
            flags |= HVFlag.ON
        if self._on and (self._setpoint != self._target or self._lags_since is not None):
            flags |= HVFlag.RAMPING
        if self._lags_since is not None:
            flags |= HVFlag.CURRENT_LIMIT
        if self._tripped:
            flags |= HVFlag.TRIPPED
        if self._emergency:
            flags |= HVFlag.EMERGENCY_OFF
        return flags

    def _step(self) -> Part[None]:
        """Move the DAC towards the target by what the ramp allows since the last step."""
        if self._stepped_at is None:
            self._stepped_at = self._now
            return
        if self._target > self._setpoint:
            self._check_dac(self._dac_volts)
        elif self._volts(self._dac_volts) < self._setpoint - self._least_step:
            self._setpoint = self._volts(self._dac_volts)  # somebody was faster: the way down goes on from there
        if self._is_behind(self._measured):
            return
        longest = max(LONGEST_STEP_S, 1.01 * self._least_step / self._ramp)  # a slow ramp waits for a whole step
        elapsed = min(self._now - self._stepped_at, longest)
        change = max(-self._ramp * elapsed, min(self._ramp * elapsed, self._target - self._setpoint))
        if abs(change) < self._least_step and self._setpoint + change != self._target:
            return  # not yet a step's time
        self._stepped_at = self._now
        yield from self._write(self._setpoint + change)

    def _check_dac(self, dac: float) -> None:
        """Before the output is raised: the DAC must hold what was written."""
        if not abs(self._volts(dac) - self._setpoint) <= self._least_step:
            raise DeviceRefused(
                self._label,
                f"the DAC holds {dac:.4f} V, not the {self._setpoint / self._amplifier.gain_V_per_V:.4f} V written",
                "Its watchdog has acted, or another program writes to it.",
            )

    def _is_behind(self, voltage: float) -> bool:
        """Whether the output lags behind the set-point: the ramp waits, for a while."""
        allowed = max(LAG_V, (LAG_PART + self._tolerance) * self._setpoint)
        missing = self._setpoint - voltage if self._target > self._setpoint else voltage - self._setpoint
        behind = missing > allowed
        if not behind:
            self._lags_since = None
            return False
        self.counters["lagging"] += 1
        self._stepped_at = self._now
        if self._lags_since is None:
            self._lags_since = self._now
        if self._now - self._lags_since > LAG_LIMIT_S:
            raise DeviceRefused(
                self._label,
                f"the output is {voltage:.0f} V with {self._setpoint:.0f} V asked for since {LAG_LIMIT_S:g} s",
                "The amplifier is at its current limit, or off: ramp more slowly, look for a leak, check its switch.",
            )
        return True

    def _write(self, volts: float) -> Part[None]:
        """Set the DAC and read it back: it is clamped without a word, and set to 0 by the watchdog."""
        if volts > self._setpoint:
            self._check_dac((yield from self._registers.number(self._dac_register)))
        wanted = volts / self._amplifier.gain_V_per_V
        yield from self._registers.write(self._dac_register, f32(wanted))
        dac = yield from self._registers.number(self._dac_register)
        if not abs(self._volts(dac) - volts) <= self._least_step:
            raise DeviceRefused(
                self._label, f"the DAC reads back {dac:.4f} V after {wanted:.4f} V", "The end of its range is reached."
            )
        self._setpoint = volts

    # -- on and off --------------------------------------------------------------------------------------------------

    def _switch_on(self) -> Script:
        if self._on:
            return
        yield from self._registers.write(self._dac_register, f32(0.0))
        self._setpoint = 0.0
        yield from self._arm_watchdog()
        yield from self._enable(True)
        self._on = True
        try:
            yield from self._prove()
        except DeviceError:
            yield from self._cut()
            raise
        self._proven = True
        self._stepped_at = self._now

    def _prove(self) -> Part[None]:
        """A small step must show on the monitor, with the right size and sign."""
        before = yield from self._mean()
        yield from self._write(self._proof)
        after = yield from self._mean()
        yield from self._write(0.0)
        yield from self._mean()  # back at 0 V before the ramp begins
        seen = (after - before) / self._proof
        if abs(seen - 1.0) <= self._tolerance:
            return
        step = f"a step of {self._proof:g} V shows as {after - before:.1f} V on the voltage monitor"
        if abs(seen) < 0.1:
            why = "the monitor is dead or unplugged, or the amplifier is off"
        elif abs(seen + 1.0) <= self._tolerance:
            why = "it has the wrong sign: check polarity and the leads"
        else:
            why = "gain_V_per_V or voltage_monitor_V_per_V is wrong, or the output is loaded"
        raise DeviceRefused(self._label, f"{step}: {why}", f"The output was taken off. {_RELAY}")

    def _mean(self) -> Part[float]:
        """The measured voltage once it has settled."""
        for _ in range(max(1, math.ceil(self._settle / self._period))):
            yield from self._sample(delay_s=self._period)
        readings = []
        for _ in range(PROOF_SAMPLES):
            readings.append((yield from self._sample()))
        return sum(readings) / len(readings)

    def _arm_watchdog(self) -> Part[None]:
        """Compare its settings, write those that differ while it is off, read them back, and let it run."""
        line = self._line
        off_level = 0 if line is None else int(not self._high)
        wanted: list[tuple[int, bytes]] = [
            (WATCHDOG_ADVANCED, u32(0)),
            (WATCHDOG_TIMEOUT_S, u32(self._watchdog_s)),
            (WATCHDOG_STARTUP_S, u32(0)),
            (WATCHDOG_STRICT, u32(1)),
            (WATCHDOG_KEY, u32(KEY)),
            (WATCHDOG_RESET, u32(0)),
            (WATCHDOG_DIO, u32(line is not None)),
            (WATCHDOG_DAC0 + 10 * self._dac, u32(1)),
            (WATCHDOG_DAC0_VOLTS + 10 * self._dac, f32(0.0)),
        ]
        if line is not None:
            wanted += [
                (WATCHDOG_DIO_STATE, u32(off_level << line)),
                (WATCHDOG_DIO_DIRECTION, u32(1 << line)),
                (WATCHDOG_DIO_INHIBIT, u32(_ALL_LINES & ~(1 << line))),
            ]
        different = yield from self._differing(wanted)
        if different:
            yield from self._registers.write(WATCHDOG_ENABLE, u32(0))
            for address, data in different:
                yield from self._registers.write(address, data)
            if still := (yield from self._differing(different)):
                raise DeviceRefused(
                    self._label,
                    f"its watchdog does not take register {still[0][0]}",
                    "Its firmware is too old for it: at least 1.0016 on a T7, 1.0012 on a T8.",
                )
        if not (yield from self._registers.whole(WATCHDOG_ENABLE)):
            yield from self._registers.write(WATCHDOG_ENABLE, u32(1))
            if not (yield from self._registers.whole(WATCHDOG_ENABLE)):
                raise DeviceRefused(self._label, "its watchdog cannot be armed", "Check its firmware version.")
        yield from self._registers.write(WATCHDOG_CLEAR, u32(KEY))
        self._armed, self._key_at = True, self._now
        self.settings["watchdog"] = f"strict, {self._watchdog_s} s"

    def _differing(self, wanted: Sequence[tuple[int, bytes]]) -> Part[list[tuple[int, bytes]]]:
        found = []
        for address, data in wanted:
            if (yield from self._registers.whole(address)) != int.from_bytes(data, "big"):
                found.append((address, data))
        return found

    def _switch_off(self) -> Script:
        self._wanted, self._stepped_at, self._lags_since = 0.0, self._now, None
        while self._on and self._setpoint > 0:
            self._renewed = True  # the way to 0 V has been decided, and is let come to its end
            yield from self._cycle()
            yield from self._sample(delay_s=self._period)
        yield from self._cut()

    def _cut(self) -> Part[None]:
        """DAC to 0 and the line to off, both read back."""
        yield from self._registers.write(self._dac_register, f32(0.0))
        yield from self._enable(False)
        dac = yield from self._registers.number(self._dac_register)
        if not abs(self._volts(dac)) <= max(self._least_step, OFF_V / 4):
            raise DeviceRefused(self._label, f"the DAC stays at {dac:.4f} V", _UNSAFE)
        self._on = self._proven = self._found_live = False
        self._setpoint = self._wanted = 0.0

    def _emergency_off(self) -> Script:
        try:
            self._registers.send_now(self._dac_register, f32(0.0))  # on their way before anything is waited for
            if self._line is not None:
                self._registers.send_now(DIO0 + self._line, u16(int(not self._high)))
            yield from self._cut()
        except DeviceError as error:
            raise type(error)(self._label, f"EMERGENCY OFF IS NOT CONFIRMED ({error.what})", _UNSAFE) from error

    def _command(self, script: Script) -> None:
        self._commands += 1
        self._dialogue.begin(self._tracked(script))
        self._next_poll = self._now

    def _tracked(self, script: Script) -> Script:
        try:
            yield from script
        finally:
            self._commands = max(0, self._commands - 1)

    def _require_ready(self) -> None:
        if not self._ready:
            raise DeviceRefused(self._label, "the supply is not set up yet", "Poll it until it is ready.")
