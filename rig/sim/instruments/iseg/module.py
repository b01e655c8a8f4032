"""An iseg high-voltage module on CAN that speaks EDCP, frame by frame.

Identifiers are ``0x200 | module << 3 | direction``; direction 1 asks (two-byte opcode, channel byte where there is
one), direction 0 writes, and the module's answers look exactly like writes. Values are big-endian. Writes are not
acknowledged. Until the host logs on (``D8 01``), and after a minute without being addressed, the module sends log-on
frames ``D8 status type``. Identifier 0x004 is a broadcast to every channel of every module.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.sim.instruments.iseg import more
from rig.sim.instruments.iseg.truth import IsegTruth
from rig.sim.instruments.iseg.words import (
    ARC,
    BLOCKING,
    CONSTANT_I,
    CONSTANT_V,
    DISABLED,
    DO_CLEAR,
    EMERGENCY,
    END_OF_RAMP,
    EVENT_ACTIVE,
    FINE,
    FLAG_ONLY,
    HV_ON,
    I_BOUNDS,
    INHIBIT,
    INPUT_ERROR,
    KILL,
    LIMIT_GOOD,
    MODULE_GOOD,
    MODULE_INPUT_ERROR,
    MODULE_OFF,
    NO_RAMP,
    NO_SUM_ERROR,
    OFF_AT_ONCE,
    OFF_WITH_RAMP,
    ON,
    ON_TO_OFF,
    RAMPING,
    SAFETY_LOOP,
    SET_FINE,
    SET_KILL,
    SUPPLY,
    TEMPERATURE,
    TRIP,
    V_BOUNDS,
    Channel,
)
from rig.sim.noise import ConversionNoise
from rig.sim.supply import switch_output
from rig.sim.truth import Fault
from rig.sim.wire import Frame, FrameWire
from rig.sim.world import TICK, World

ANSWER_S = 0.5e-3
ADC_S = 0.02
QUIET_S = 60.0
MODULE_CLASS = 0x14  # type byte of the log-on frame


class IsegEDCP:
    """One module.

    Attributes
    ----------
    stuck_on, lies, sag, wrong_status, interlock_open, inhibited : faults
        The output ignores every way of switching off; it is reported off and 0 V whatever is true; the part of the
        voltage that is left; bits inverted in the channel status; the safety loop is open; the external inhibit is
        active.
    before_reply : callable or None
        A fault: called with the time before each answer is sent.
    """

    def __init__(self, settings: IsegTruth, world: World, wire: FrameWire, rng: np.random.Generator) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._v_noise = ConversionNoise(rng.spawn(1)[0], ADC_S)
        self._i_noise = ConversionNoise(rng.spawn(1)[0], ADC_S)
        self._base = 0x200 | settings.module << 3
        self.nominal_v = settings.nominal_voltage_V
        self._sign = -1.0 if settings.negative else 1.0
        self.nominal_i = settings.nominal_current_mA * 1e-3
        self._rated = more.Rated(self.nominal_v, self.nominal_i, settings.channels)
        self.stuck_on = self.lies = False
        self.sag = 1.0
        self.wrong_status = 0
        self.before_reply: Callable[[float], None] | None = None
        self._interlock_open = False
        self._inhibited = False
        self._frozen: tuple[float, float] | None = None
        self._power_up(0.0)
        if settings.start_live_V:
            live = self._channels[0]
            live.setpoint, live.control, live.on = settings.start_live_V, ON, True

    @property
    def largest_current(self) -> float:
        """What a channel can give at most (A)."""
        return self.nominal_i

    @property
    def registered(self) -> bool:
        """Whether a host has logged on; until then, and after a minute of silence, it announces itself."""
        return self._registered

    def _power_up(self, t: float) -> None:
        limit = self.nominal_i * self._settings.current_limit_percent / 100
        self._channels = [Channel(current_limit=limit) for _ in range(self._settings.channels)]
        self._ramp_percent = self._settings.ramp_percent_per_s
        self._kill = False
        self._fine = False
        self._input_error = False
        self._event = 0
        self._event_mask = 0
        self._group_mask = 0
        self._registered = False
        self._addressed = t
        self._next_logon = t + 0.1
        self._asleep_until = -math.inf
        self._tick = math.floor(t / TICK + 1e-9)

    def reset(self, t: float, boot_s: float = 1.0) -> None:
        """Lose power and come back: output off at once, everything at power-up values, deaf for ``boot_s``."""
        self._cut(t, self._settings.fall_time_s)
        self._power_up(t)
        self._asleep_until = t + boot_s
        self._next_logon = t + boot_s + 0.1

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: measured voltage and current stay what they were at ``t``."""
        self._frozen = None
        if frozen:
            self._frozen = self._measured_v(t), self._measured_i(t)

    def alert(self, t: float) -> None:
        """Announce itself as a module that nobody has registered."""
        self._wire.send((self._base | 1, bytes([0xD8, self._module_status() >> 8, MODULE_CLASS])), t)

    def _reply(self, data: bytes, t: float) -> None:
        if self.before_reply is not None:
            self.before_reply(t)
        self._wire.send((self._base, data), t + ANSWER_S)

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: those of every output, ``interlock``, ``inhibit`` and ``wrong_status``."""
        match fault.kind:
            case "interlock":
                self.open_interlock(t, begins)
            case "inhibit":
                self.inhibit(t, begins)
            case "wrong_status":
                bits = 0xFFFF if fault.value is None else int(fault.value) & 0xFFFF
                self.wrong_status = bits if begins else 0
            case _:
                switch_output(self, self._world, fault, begins, t)

    def open_interlock(self, t: float, is_open: bool) -> None:
        """The safety loop opens (output off at once) or closes."""
        self._interlock_open = is_open
        if is_open:
            self._event |= SAFETY_LOOP
            for channel in self._channels:
                self._off_at_once(channel, t)

    def inhibit(self, t: float, active: bool) -> None:
        """The external inhibit acts (output off at once) or is released."""
        self._inhibited = active
        if active:
            for channel in self._channels:
                self._off_at_once(channel, t)
                channel.event |= INHIBIT

    def set_sag(self, t: float, left: float) -> None:
        """Only this part of the set-point reaches the output from now on."""
        self.sag = left
        if self._channels[0].on:
            self._drive(self._channels[0], t)

    # Output

    @property
    def _rate(self) -> float:
        return self._ramp_percent / 100 * self.nominal_v

    def _drive(self, channel: Channel, t: float) -> None:
        """Ramp the output to where it now should go."""
        target = channel.setpoint if channel.on else 0.0
        channel.ramping = True
        if channel is not self._channels[0] or (self.stuck_on and target == 0.0):
            return
        true = target * (1.0 + self._settings.gain_error) * self.sag
        self._world.output.ramp(t, true, self._rate)

    def _cut(self, t: float, fall_time: float) -> None:
        """Take the output to zero without a ramp."""
        voltage = self._world.output.at(t)[0]
        if voltage > 0 and not self.stuck_on:
            self._world.output.ramp(t, 0.0, voltage / fall_time)

    def _off_at_once(self, channel: Channel, t: float) -> None:
        if channel.on:
            channel.event |= ON_TO_OFF
        channel.on = channel.ramping = channel.limiting = False
        channel.control &= ~ON
        if channel is self._channels[0]:
            self._cut(t, self._settings.fall_time_s)

    def _off_with_ramp(self, channel: Channel, t: float) -> None:
        if channel.on:
            channel.event |= ON_TO_OFF
            channel.on = channel.limiting = False
            self._drive(channel, t)
        channel.control &= ~ON

    # Time

    @property
    def next_time(self) -> float:
        due = self._next_logon if not self._registered else self._addressed + QUIET_S
        if self._watching:
            due = min(due, (self._tick + 1) * TICK)
        return due

    @property
    def _watching(self) -> bool:
        """Whether the regulation has anything to do."""
        return any(c.on or c.ramping for c in self._channels) or self._tick * TICK < self._world.output.end

    def advance(self, t: float) -> None:
        if self._registered and self._addressed + QUIET_S <= t:
            self._registered = False
            self._next_logon = self._addressed + QUIET_S
        while not self._registered and self._next_logon <= t:
            self.alert(self._next_logon)
            self._next_logon += self._settings.logon_period_s
        tick = math.floor(t / TICK + 1e-9)
        if tick > self._tick:
            self._tick = tick
            self._regulate(t)

    def _regulate(self, t: float) -> None:
        for channel in self._channels:
            if channel.ramping and (channel is not self._channels[0] or t >= self._world.output.end):
                channel.ramping = False
                channel.event |= END_OF_RAMP
        channel = self._channels[0]
        voltage = self._world.output.at(t)[0]
        current = self._world.current(t)
        if not channel.on:
            channel.over_since = math.inf
            return
        if current > channel.current_limit or (channel.limiting and self._needed(channel) > channel.current_limit):
            channel.over_since = min(channel.over_since, t)
            self._over_current(channel, voltage, t)
        else:
            channel.over_since = math.inf
            if channel.limiting:
                channel.limiting = False
                self._drive(channel, t)
        if self._world.broken_down and channel.on:
            channel.event |= ARC
        if not channel.ramping and channel.v_bounds and abs(self._measured_v(t) - channel.setpoint) > channel.v_bounds:
            channel.event |= V_BOUNDS
        if channel.i_bounds and current > channel.i_bounds:
            channel.event |= I_BOUNDS

    def _needed(self, channel: Channel) -> float:
        """Current (A) that the set-point would draw when standing."""
        return channel.setpoint / self._world.film_resistance + self._world.extra_leakage

    def _over_current(self, channel: Channel, voltage: float, t: float) -> None:
        """More current than set: trip, or hold the current."""
        waited = t - channel.over_since >= channel.trip_delay_ms * 1e-3
        if self._kill or (waited and channel.trip_action in (OFF_AT_ONCE, MODULE_OFF)):
            channel.event |= TRIP
            channel.latched |= TRIP
            for one in self._channels if channel.trip_action == MODULE_OFF and not self._kill else [channel]:
                self._off_at_once(one, t)
            return
        if waited and channel.trip_action == OFF_WITH_RAMP:
            channel.event |= TRIP
            channel.latched |= TRIP
            self._off_with_ramp(channel, t)
            return
        if waited and channel.trip_action == FLAG_ONLY:
            channel.event |= TRIP
        channel.event |= CONSTANT_I
        channel.limiting = True
        held = max(channel.current_limit - self._world.extra_leakage, 0.0) * self._world.film_resistance
        if voltage > held:
            channel.ramping = False
            self._world.output.ramp(t, held, max(voltage - held, 1.0) / TICK)

    # What it reports

    def _measured_v(self, t: float) -> float:
        if self._frozen is not None:
            return self._frozen[0]
        true = 0.0 if self.lies else self._world.output.at(t)[0] / (1.0 + self._settings.gain_error)
        return true + self._settings.voltage_noise_V * self._v_noise.at(t)

    def _measured_i(self, t: float) -> float:
        if self._frozen is not None:
            return self._frozen[1]
        current = 0.0 if self.lies else min(max(self._world.read_current(t), 0.0), 1.2 * self.nominal_i)
        return current + self._settings.current_noise_nA * 1e-9 * self._i_noise.at(t)

    def _channel_status(self, channel: Channel) -> int:
        status = channel.latched
        if channel.on:
            status |= ON | (CONSTANT_I if channel.limiting else CONSTANT_V)
        if channel.ramping:
            status |= RAMPING
        if channel.emergency:
            status |= EMERGENCY
        if self._inhibited:
            status |= INHIBIT
        if channel.event & INPUT_ERROR:
            status |= INPUT_ERROR
        if self._world.broken_down and channel.on:
            status |= ARC
        if channel is self._channels[0]:
            status ^= self.wrong_status
            if self.lies:
                status &= ~(ON | RAMPING | CONSTANT_V | CONSTANT_I)
        return status

    def _module_status(self) -> int:
        status = TEMPERATURE | SUPPLY | (LIMIT_GOOD if self._settings.limit_good_bit else 0)
        events = self._event & self._event_mask or any(c.event & c.mask for c in self._channels)
        no_sum_error = not any(c.event & BLOCKING for c in self._channels)
        for bit, true in (
            (KILL, self._kill),
            (EVENT_ACTIVE, bool(events)),
            (SAFETY_LOOP, not self._interlock_open),
            (NO_RAMP, not any(c.ramping for c in self._channels)),
            (NO_SUM_ERROR, no_sum_error),
            (MODULE_GOOD, no_sum_error and not self._event & (TEMPERATURE | SUPPLY | SAFETY_LOOP)),
            (MODULE_INPUT_ERROR, self._input_error),
            (HV_ON, any(c.on for c in self._channels)),
            (FINE, self._fine),
        ):
            if true:
                status |= bit
        return status

    # Frames in

    def receive(self, frame: Frame, t: float) -> None:
        """A frame from the bus, complete at time ``t``."""
        identifier, data = frame
        if t < self._asleep_until:
            return
        if identifier == 0x004:
            if data[:5] == b"\xe8\x00\x60\x01\x00" and len(data) == 6:
                for channel in self._channels:
                    self._set_control(channel, data[5], t)
            return
        if identifier & ~1 != self._base or not data:
            return
        self._addressed = t
        if data[0] == 0xD8:
            if identifier == self._base and len(data) == 2:
                self._registered = bool(data[1] & 1)
                self._next_logon = t + self._settings.logon_period_s
            return
        if len(data) < 2:
            self._input_error = True
            return
        opcode = int.from_bytes(data[:2], "big")
        if identifier & 1:
            self._read(opcode, data[2:], t)
        else:
            self._write(opcode, data[2:], t)

    # Reading

    def _read(self, opcode: int, rest: bytes, t: float) -> None:
        if opcode & 0xF000 == 0x6000:  # many channels at once: one answer each
            if len(rest) == 3:
                mask = int.from_bytes(rest[:2], "big")
                for number in range(len(self._channels)):
                    if mask >> number & 1:
                        self._answer_channel(opcode - 0x2000, number, t)
            return
        if opcode & 0xF000 == 0x4000:
            if len(rest) == 1 and rest[0] < len(self._channels):
                self._answer_channel(opcode, rest[0], t)
            else:
                self._input_error = True
            return
        value = self._module_value(opcode)
        if value is not None:
            head = struct.pack(">H", opcode) + (rest[:1] if opcode == 0x1004 else b"")
            self._reply(head + value, t)

    def _answer_channel(self, opcode: int, number: int, t: float) -> None:
        value = self._channel_value(opcode, self._channels[number], t)
        if value is not None:
            self._reply(struct.pack(">HB", opcode, number) + value, t)

    def _module_value(self, opcode: int) -> bytes | None:
        s = self._settings
        values: dict[int, tuple[str, Any]] = {
            0x1000: (">H", self._module_status()),
            0x1001: (">H", (SET_KILL if self._kill else 0) | (SET_FINE if self._fine else 0)),
            0x1002: (">H", self._event),
            0x1003: (">H", self._event_mask),
            0x1004: (">H", sum(1 << i for i, c in enumerate(self._channels) if c.event & c.mask)),
            0x1005: (">I", 0),
            more.GROUP_MASK: (">I", self._group_mask),
            0x1100: (">f", self._ramp_percent),
            **{code: (">f", at) for code, at in ((0x1101, 100.0), (0x1104, 24.1), (0x1105, 5.02), (0x1106, 31.0))},
            0x1200: (">I", s.serial_number),
            0x1201: (">I", 0x0005_0012),
            0x1202: (">H", s.bitrate // 1000),
            0x1203: ("4s", b"E08C"),
            0x1208: ("B", s.channels),
            0x1280: (">I", 0),
        }
        return struct.pack(*values[opcode]) if opcode in values else None

    def _channel_value(self, opcode: int, channel: Channel, t: float) -> bytes | None:
        first = channel is self._channels[0]
        if opcode == 0x4102:  # a measurement is made when it is asked for
            return struct.pack(">f", self._sign * self._measured_v(t) if first else 0.0)
        if opcode == 0x4103:
            return struct.pack(">f", self._measured_i(t) if first else 0.0)
        values: dict[int, tuple[str, Any]] = {
            0x4000: (">H", self._channel_status(channel)),
            0x4001: (">H", channel.control),
            0x4002: (">H", channel.event),
            0x4003: (">H", channel.mask),
            0x4005: (">H", channel.trip_delay_ms),
            0x4006: ("B", channel.trip_action),
            0x4100: (">f", self._sign * channel.setpoint),
            0x4101: (">f", channel.current_limit),
            0x4104: (">f", channel.v_bounds),
            0x4105: (">f", channel.i_bounds),
            0x4106: (">f", self._sign * self.nominal_v),
            0x4107: (">f", self.nominal_i),
            **dict.fromkeys((0x4123, 0x4124), (">f", self._rate)),
            0x4127: (">f", 0.0),
            0x4128: (">f", self._settings.max_ramp_percent_per_s / 100 * self.nominal_v),
        }
        if opcode in values:
            return struct.pack(*values[opcode])
        volts, amperes = (self._measured_v(t), self._measured_i(t)) if first else (0.0, 0.0)
        return more.read(opcode, channel, self._rated, volts, amperes)

    # Writing

    def _write(self, opcode: int, rest: bytes, t: float) -> None:
        if opcode & 0xF000 == 0x4000:
            if len(rest) < 2 or rest[0] >= len(self._channels):
                self._input_error = True
                return
            channel = self._channels[rest[0]]
            if not self._write_channel(opcode, channel, rest[1:], t):
                channel.event |= INPUT_ERROR
                self._input_error = True
        elif not self._write_module(opcode, rest, t):
            self._input_error = True

    def _write_module(self, opcode: int, value: bytes, t: float) -> bool:
        if opcode in (0x1001, 0x1002, 0x1003) and len(value) == 2:
            (word,) = struct.unpack(">H", value)
            if opcode == 0x1001:
                self._kill, self._fine = bool(word & SET_KILL), bool(word & SET_FINE)
                if word & DO_CLEAR:
                    self._clear_events()
            elif opcode == 0x1002:
                self._event &= ~word
                if word & SAFETY_LOOP and self._interlock_open:
                    self._event |= SAFETY_LOOP
            else:
                self._event_mask = word
            return True
        if opcode == more.GROUP_MASK and len(value) == 4:
            (self._group_mask,) = struct.unpack(">I", value)
            return True
        if opcode == 0x1100 and len(value) == 4:
            (percent,) = struct.unpack(">f", value)
            if not 0 < percent <= self._settings.max_ramp_percent_per_s:
                return False
            self._ramp_percent = percent
            for channel in self._channels:
                if channel.ramping:
                    self._drive(channel, t)
            return True
        return False

    def _clear_events(self) -> None:
        self._event = SAFETY_LOOP if self._interlock_open else 0
        self._input_error = False
        for channel in self._channels:
            self._clear_event(channel, 0xFFFF)

    def _clear_event(self, channel: Channel, word: int) -> None:
        channel.event &= ~word
        channel.latched &= ~word
        if channel.emergency:
            channel.event |= EMERGENCY
        if self._inhibited:
            channel.event |= INHIBIT
        if not any(c.event & INPUT_ERROR for c in self._channels):
            self._input_error = False

    def _write_channel(self, opcode: int, channel: Channel, value: bytes, t: float) -> bool:
        if opcode in (0x4001, 0x4002, 0x4003, 0x4005) and len(value) == 2:
            (word,) = struct.unpack(">H", value)
            if opcode == 0x4001:
                self._set_control(channel, word, t)
            elif opcode == 0x4002:
                self._clear_event(channel, word)
            elif opcode == 0x4003:
                channel.mask = word
            else:
                if word > 4095:
                    return False
                channel.trip_delay_ms = word
            return True
        if opcode == 0x4006 and len(value) == 1 and value[0] <= DISABLED:
            channel.trip_action = value[0]
            return True
        if opcode in (0x4100, 0x4101, 0x4104, 0x4105) and len(value) == 4:
            (number,) = struct.unpack(">f", value)
            if opcode == 0x4100:  # either sign means the channel's own
                number = abs(number)
            return self._write_quantity(opcode, channel, number, t)
        return more.write(opcode, channel, value, self._rated)

    def _write_quantity(self, opcode: int, channel: Channel, number: float, t: float) -> bool:
        v_top = self.nominal_v * self._settings.voltage_limit_percent / 100
        i_top = self.nominal_i * self._settings.current_limit_percent / 100
        top = v_top if opcode in (0x4100, 0x4104) else i_top
        if not 0 <= number <= top * (1 + 1e-6):  # NaN fails too
            return False
        match opcode:
            case 0x4100:
                channel.setpoint = number
                if channel.on:
                    channel.limiting = False
                    self._drive(channel, t)
            case 0x4101:
                channel.current_limit = number
            case 0x4104:
                channel.v_bounds = number
            case 0x4105:
                channel.i_bounds = number
        return True

    def _set_control(self, channel: Channel, word: int, t: float) -> None:
        was_emergency = channel.emergency
        channel.emergency = bool(word & EMERGENCY)
        channel.control = word  # bits that mean nothing here are kept as they were written
        if channel.emergency:
            self._off_at_once(channel, t)
            channel.event |= EMERGENCY
            channel.control &= ~ON
            return
        if word & ON:
            blocked = (
                channel.event & BLOCKING & channel.mask
                or self._event & SAFETY_LOOP
                or self._interlock_open
                or self._inhibited
            )
            if blocked or was_emergency:
                channel.control &= ~ON
            elif not channel.on:
                channel.on = True
                self._drive(channel, t)
        elif channel.on:
            self._off_with_ramp(channel, t)
