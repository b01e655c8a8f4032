"""A LabJack T4, T7 or T8 on Modbus TCP, with an HV amplifier on its DAC and monitors, or a sensor on an input.

Frames ``transaction, 0, length, unit, function ..`` (functions 3, 4, 6 and 16, and 76 of the maker's own), big-endian.
Everything is a register: inputs, outputs, digital lines, the watchdog, whose settings survive a power cycle. The DAC
is clamped and quantised; what is read back is what it puts out. In strict mode only its key clears the watchdog; when
its time is over it acts, again each time.

Instruments of one bench with the same product and serial number are on one device, which takes two connections.

Sources: the maker's register map (ljm_constants.json) and T-series datasheet. Assumed, for no source says it: a
watchdog of n seconds acts after exactly n; a read-only or unknown register is refused with reason 2.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.probe import Probe
from rig.sim.supply import switch_output
from rig.sim.truth import Fault, LoadCellTruth, MonitorTruth, NetworkTruth, NotNegative, OutputTruth, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import TICK, World

ANSWER_S = 1e-3  # one transaction, Ethernet
BOOT_S = 1.0
FLOAT_S = 0.3  # of the boot: digital lines are inputs with a pull-up, before the defaults are applied
PRODUCTS: dict[int, tuple[float, int, float]] = {4: (5.0, 2**10, 10.0), 7: (5.0, 2**12, 10.0), 8: (10.0, 2**16, 11.0)}
LINES = 23
WATCHDOG = range(61_600, 61_654)
MAP = 0x4C
ADDRESS, VALUE, FUNCTION = 2, 3, 1


class _Refused(Exception):
    """The request is answered with this reason."""

    def __init__(self, reason: int) -> None:
        self.reason = reason


class Box:
    """The registers of one LabJack, and what is connected to it.

    Parameters
    ----------
    product, serial : int
        4, 7 or 8; serial number.

    Attributes
    ----------
    inputs : dict
        By analogue input, ``volts(channel, t)`` at it.
    changed : callable
        ``changed(t)`` is called after an output has changed.
    connections : int
        How many hosts it serves at once.
    """

    connections = 2

    def __init__(self, product: int, serial: int) -> None:
        self.dac_top, self._steps, self._ain_top = PRODUCTS[product]
        self._product, self._serial = product, serial
        self.inputs: dict[int, Callable[[int, float], float]] = {}
        self.changed: Callable[[float], None] = lambda t: None
        self._kept: dict[int, bytes] = {}  # watchdog settings, in flash
        self.flash_writes = 0
        self.watchdog_acted = 0
        self.asleep_until = -math.inf
        self._fed = 0.0
        self._power_up(0.0)

    def _power_up(self, t: float) -> None:
        self.dac = [0.0, 0.0]
        self.direction = 0
        self.state = (1 << LINES) - 1  # pulled up
        self._ranges = [self._ain_top] * 14
        self._fed = t

    def reset(self, t: float) -> None:
        """Lose power and come back: outputs at their defaults, lines floating high; the watchdog keeps its settings."""
        self._power_up(t + BOOT_S)
        self.asleep_until = t + BOOT_S
        self.changed(t)

    def level(self, line: int) -> bool:
        """Level of a digital line, high while it is an input with nothing on it."""
        return bool(self.state >> line & 1) or not self.direction >> line & 1

    # Watchdog

    def _setting(self, address: int) -> int:
        return int.from_bytes(self._kept.get(address, b"\0\0\0\0"), "big")

    @property
    def deadline(self) -> float:
        """When the watchdog acts next; inf while it is off."""
        return self._fed + max(self._setting(61_604), 1) if self._setting(61_600) else math.inf

    def act(self, t: float) -> None:
        """The watchdog's time is over."""
        self.watchdog_acted += 1
        self._fed = t
        for n in (0, 1):
            if self._setting(61_640 + 10 * n):
                self.dac[n] = self._clamped(struct.unpack(">f", self._kept.get(61_642 + 10 * n, b"\0\0\0\0"))[0])
        if self._setting(61_630):
            mask = ~self._setting(61_636) & ((1 << LINES) - 1)
            self.state = self.state & ~mask | self._setting(61_632) & mask
            self.direction = self.direction & ~mask | self._setting(61_634) & mask
        self.changed(t)

    def _write_watchdog(self, address: int, data: bytes, t: float) -> None:
        if address == 61_614:
            if int.from_bytes(data, "big") == self._setting(61_612):
                self._fed = t
            return
        if address != 61_600 and self._setting(61_600):
            raise _Refused(VALUE)  # it must be off first
        if self._kept.get(address, b"\0\0\0\0") != data:
            self._kept[address] = data
            self.flash_writes += 1
        if address == 61_600:
            self._fed = t

    # Registers

    def _clamped(self, volts: float) -> float:
        top = self.dac_top
        step = top / self._steps
        return min(max(round(volts / step) * step, 0.0), top - step)

    def read(self, address: int, count: int, t: float) -> bytes:
        """``count`` registers from ``address`` on."""
        data = b""
        while len(data) < 2 * count:
            data += self._value(address + len(data) // 2, t)
        if len(data) != 2 * count:
            raise _Refused(VALUE)
        return data

    def _value(self, address: int, t: float) -> bytes:
        fixed = {
            60_000: struct.pack(">f", self._product),
            60_002: struct.pack(">f", 1.3),
            60_004: struct.pack(">f", 1.0292),
            60_028: struct.pack(">I", self._serial),
            55_100: struct.pack(">I", 0x0011_2233),
            55_110: struct.pack(">H", 0x0011),
            61_532: struct.pack(">I", 0),
            61_522: struct.pack(">I", int(t * 20) & 0xFFFF_FFFF),
            1000: struct.pack(">f", self.dac[0]),
            1002: struct.pack(">f", self.dac[1]),
            2800: struct.pack(">I", sum(self.level(n) << n for n in range(LINES))),
            2850: struct.pack(">I", self.direction),
        }
        if address in fixed:
            return fixed[address]
        if 0 <= address < 28 and address % 2 == 0:
            channel = address // 2
            end = 1.06 * self._ranges[channel]
            volts = self.inputs[channel](channel, t) if channel in self.inputs else 0.0
            return struct.pack(">f", min(max(volts, -end), end))
        if 40_000 <= address < 40_028 and address % 2 == 0:
            return struct.pack(">f", self._ranges[(address - 40_000) // 2])
        if 2000 <= address < 2000 + LINES:
            self.direction &= ~(1 << (address - 2000))  # reading a line makes it an input
            self.changed(t)
            return struct.pack(">H", self.level(address - 2000))
        if address in WATCHDOG and address % 2 == 0 and address != 61_614:
            return self._kept.get(address, b"\0\0\0\0")
        raise _Refused(ADDRESS)

    def write(self, address: int, data: bytes, t: float) -> None:
        """Write registers from ``address`` on."""
        while data:
            size = 2 if 2000 <= address < 2000 + LINES else 4
            if len(data) < size:
                raise _Refused(VALUE)
            self._set(address, data[:size], t)
            address, data = address + size // 2, data[size:]

    def _set(self, address: int, data: bytes, t: float) -> None:
        if address in (1000, 1002):
            self.dac[(address - 1000) // 2] = self._clamped(struct.unpack(">f", data)[0])
        elif 2000 <= address < 2000 + LINES:
            bit = 1 << (address - 2000)
            self.direction |= bit
            self.state = self.state | bit if int.from_bytes(data, "big") else self.state & ~bit
        elif 40_000 <= address < 40_028 and address % 2 == 0:
            self._ranges[(address - 40_000) // 2] = struct.unpack(">f", data)[0]
        elif address in WATCHDOG and address % 2 == 0:
            self._write_watchdog(address, data, t)
        else:
            raise _Refused(ADDRESS)
        self.changed(t)


class Server:
    """Modbus frames in and out of a `Box`.

    ``before_reply`` is a fault: called with the time before each answer is sent.
    """

    def __init__(self, box: Box, wire: ByteWire) -> None:
        self.box = box
        self._wire = wire
        self._buffer = b""
        self.refuses = False  # a fault: every request fails
        self.before_reply: Callable[[float], None] | None = None

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self.box.asleep_until:
            return
        self._buffer += data
        while len(self._buffer) >= 7:
            transaction, protocol, length = struct.unpack_from(">HHH", self._buffer)
            if protocol or not 2 <= length <= 254:
                self._buffer = b""  # the connection is of no use any more
                return
            if len(self._buffer) < 6 + length:
                return
            frame, self._buffer = self._buffer[: 6 + length], self._buffer[6 + length :]
            answer = self._answer(frame[7], frame[8:], t)
            if self.before_reply is not None:
                self.before_reply(t)
            self._wire.send(struct.pack(">HHHB", transaction, 0, 1 + len(answer), frame[6]) + answer, t + ANSWER_S)

    def alert(self, t: float) -> None:
        """An answer that nobody asked for, with a transaction of its own."""
        self._wire.send(struct.pack(">HHHBBBH", 0xFFFE, 0, 5, 1, 3, 2, 0), t)

    def _answer(self, function: int, rest: bytes, t: float) -> bytes:
        try:
            if self.refuses:
                raise _Refused(4)
            return bytes((function,)) + self._carry_out(function, rest, t)
        except _Refused as refused:
            return bytes((function | 0x80, refused.reason))
        except struct.error:
            return bytes((function | 0x80, VALUE))

    def _carry_out(self, function: int, rest: bytes, t: float) -> bytes:
        if function in (3, 4):
            address, count = struct.unpack(">HH", rest)
            if not 1 <= count <= 125:
                raise _Refused(VALUE)
            data = self.box.read(address, count, t)
            return bytes((len(data),)) + data
        if function == 6:
            address, value = struct.unpack(">H2s", rest)
            self.box.write(address, value, t)
            return rest
        if function == 16:
            address, count, size = struct.unpack_from(">HHB", rest)
            if size != 2 * count or len(rest) != 5 + size:
                raise _Refused(VALUE)
            self.box.write(address, rest[5:], t)
            return rest[:4]
        if function == MAP:
            return self._feedback(rest, t)
        raise _Refused(FUNCTION)

    def _feedback(self, rest: bytes, t: float) -> bytes:
        """Reads and writes back to back: 00 address n, or 01 address n data; only what was read comes back."""
        out = b""
        while rest:
            kind, address, count = struct.unpack_from(">BHB", rest)
            rest = rest[4:]
            if kind == 0:
                out += self.box.read(address, count, t)
            elif kind == 1:
                self.box.write(address, rest[: 2 * count], t)
                rest = rest[2 * count :]
            else:
                raise _Refused(VALUE)
        return out


class BoxTruth(NetworkTruth):
    """What every simulated LabJack has."""

    means_nothing: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("drop", "duplicate", "corrupt"), "TCP repeats what is lost and checks what comes"
    )

    product: Literal[4, 7, 8] = Field(default=7, description="T4, T7 or T8.")
    serial_number: int = Field(default=470_010_000, description="Serial number that it states.")
    input_noise_mV: NotNegative = Field(default=0.5, description="Standard deviation of an input (mV).")
    input_offset_mV: float = Field(default=0.3, description="Offset of its inputs (mV).")


def box_of(truth: BoxTruth, world: World) -> Box:
    """The device that an instrument is on: one for all with this product and serial number."""
    key = ("LabJack", truth.product, truth.serial_number)
    box = world.devices.get(key) or Box(truth.product, truth.serial_number)
    assert isinstance(box, Box)
    world.devices[key] = box
    return box


class AmplifierTruth(OutputTruth, BoxTruth):
    """An HV amplifier on a LabJack: input on DAC0, monitors of voltage and current on AIN0 and AIN1, enable on FIO0."""

    driver: Literal["labjack-amplifier"] = Field(default="labjack-amplifier", description="Amplifier on a LabJack.")
    gain_V_per_V: float = Field(default=1000.0, description="Output per input (V/V); negative if it inverts.")
    monitor_V_per_V: Positive = Field(default=1000.0, description="Output per volt of the voltage monitor (V/V).")
    monitor_uA_per_V: Positive = Field(default=200.0, description="Current per volt of the current monitor (uA/V).")
    full_scale_V: Positive = Field(default=10_000.0, description="Highest output (V).")
    current_limit_uA: Positive = Field(default=2000.0, description="Largest current (uA).")
    slew_V_per_us: Positive = Field(default=35.0, description="Fastest change of the output (V/us).")
    has_enable_line: bool = Field(default=True, description="Whether FIO0 low enables it; otherwise it always is.")
    monitor_unplugged: bool = Field(default=False, description="Whether the voltage monitor is not connected.")


class Amplifier:
    """The amplifier and its LabJack. ``stuck_on`` is a fault: the output neither falls nor is switched off."""

    def __init__(self, truth: AmplifierTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._truth = truth
        self._world = world
        self._rng = rng
        self.stuck_on = self.lies = False
        self._left = 1.0
        self._frozen: tuple[float, float] | None = None
        self._rail = 0
        self._tick = 0
        self.box = box_of(truth, world)
        self.box.inputs |= dict.fromkeys((0, 1), self._input)
        self.box.changed = self._drive
        self._server = Server(self.box, wire)
        if truth.start_live_V:
            self.box.write(2000, b"\0\0", 0.0)
            self.box.write(1000, struct.pack(">f", truth.start_live_V / abs(truth.gain_V_per_V)), 0.0)

    @property
    def largest_current(self) -> float:
        """What it can give at most (A)."""
        return self._truth.current_limit_uA * 1e-6

    @property
    def before_reply(self) -> Callable[[float], None] | None:
        return self._server.before_reply

    @before_reply.setter
    def before_reply(self, call: Callable[[float], None] | None) -> None:
        self._server.before_reply = call

    def receive(self, data: bytes, t: float) -> None:
        self._server.receive(data, t)

    def alert(self, t: float) -> None:
        self._server.alert(t)

    def reset(self, t: float) -> None:
        """The LabJack loses power and comes back."""
        self.box.reset(t)

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: the monitors stay what they were at ``t``."""
        self._frozen = None
        if frozen:
            self._frozen = self._monitor(0, t), self._monitor(1, t)

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: those of every output, ``saturate`` and ``wrong_status``: every request is refused."""
        match fault.kind:
            case "saturate":
                self._rail = fault.sign if begins else 0
            case "wrong_status":
                self._server.refuses = begins
            case _:
                switch_output(self, self._world, fault, begins, t)

    def set_sag(self, t: float, left: float) -> None:
        """A fault: only this part of the set-point reaches the output from now on."""
        self._left = left
        self._drive(t)

    # Output

    @property
    def _enabled(self) -> bool:
        return not self._truth.has_enable_line or not self.box.level(0)

    def _wanted(self) -> float:
        """Magnitude of the output (V) if it can give the current."""
        s = self._truth
        volts = self.box.dac[0] * abs(s.gain_V_per_V) * (1.0 + s.gain_error) * self._left
        return min(volts, s.full_scale_V) if self._enabled else 0.0

    def _drive(self, t: float) -> None:
        now = self._world.output.at(t)[0]
        spare = max(self.largest_current - self._world.extra_leakage, 0.0)
        target = min(self._wanted(), spare * self._world.film_resistance)
        slew = self._truth.slew_V_per_us * 1e6
        if target > now:
            charging = max(spare - now / self._world.film_resistance, 1e-9)
            self._world.output.ramp(t, target, min(slew, charging / max(self._world.capacitance(t), 1e-12)))
        elif target < now and not self.stuck_on:
            self._world.output.ramp(t, target, min(slew, max(now, 1.0) / self._truth.fall_time_s))

    # Monitors

    def _monitor(self, channel: int, t: float) -> float:
        s = self._truth
        if channel == 0:
            if s.monitor_unplugged or self.lies:
                return 0.0
            return math.copysign(self._world.output.at(t)[0], s.gain_V_per_V) / s.monitor_V_per_V
        return math.copysign(1.0, s.gain_V_per_V) * self._world.read_current(t) * 1e6 / s.monitor_uA_per_V

    def _input(self, channel: int, t: float) -> float:
        if self._rail:
            return self._rail * 20.0
        s = self._truth
        if self._frozen is not None:
            return self._frozen[channel] + s.input_offset_mV * 1e-3
        noise = s.input_noise_mV * float(self._rng.standard_normal())
        return self._monitor(channel, t) + (s.input_offset_mV + noise) * 1e-3

    # Time

    @property
    def next_time(self) -> float:
        due = self.box.deadline
        return min(due, (self._tick + 1) * TICK) if self._world.output.at(self._tick * TICK)[0] > 0 else due

    def advance(self, t: float) -> None:
        """The watchdog's time, and whether the amplifier still holds its voltage."""
        while self.box.deadline <= t:
            self.box.act(self.box.deadline)
        tick = math.floor(t / TICK + 1e-9)
        if tick > self._tick:
            self._tick = tick
            if t >= self._world.output.end:
                self._drive(t)


class AnalogSensorTruth(BoxTruth):
    """A sensor on a LabJack's input."""

    volts_at_full_scale: Positive = Field(default=5.0, description="Its output at full scale (V).")


class AnalogForceTruth(LoadCellTruth, AnalogSensorTruth):
    """A load cell with a conditioner on AIN2."""

    driver: Literal["labjack-force"] = Field(default="labjack-force", description="Load cell on a LabJack's input.")
    zero_offset_V: float = Field(default=0.02, description="Output of the unloaded cell (V).")


class AnalogDisplacementTruth(AnalogSensorTruth):
    """A laser with a voltage output on AIN3."""

    driver: Literal["labjack-displacement"] = Field(
        default="labjack-displacement", description="Laser on a LabJack's input."
    )
    range_mm: Positive = Field(default=20.0, description="Displacement at full scale (mm).")
    gain_error: float = Field(default=0.0, description="Hidden relative error of the scale. Typical: +-0.001.")
    noise_um: NotNegative = Field(default=1.0, description="Standard deviation of a reading (um).")
    offset_V: float = Field(default=0.1, description="Output for the flat film (V).")


class AnalogMonitorTruth(MonitorTruth, BoxTruth):
    """A high-voltage probe, a thermometer or a hygrometer with a voltage output, on AIN4."""

    driver: Literal["labjack-monitor"] = Field(
        default="labjack-monitor", description="Probe or sensor on a LabJack's input."
    )
    ain: int = Field(default=4, ge=0, le=13, description="Analogue input that it is on.")


class AnalogSensor:
    """A sensor with a voltage output, and its LabJack: on AIN2 a load cell, on AIN3 a laser, on AIN4 a probe."""

    def __init__(
        self,
        truth: AnalogForceTruth | AnalogDisplacementTruth | AnalogMonitorTruth,
        world: World,
        wire: ByteWire,
        rng: np.random.Generator,
    ) -> None:
        self._truth = truth
        self._world = world
        self._rng = rng
        self._frozen: float | None = None
        self._rail = 0
        self.box = box_of(truth, world)
        channel = 2 if isinstance(truth, AnalogForceTruth) else 3
        if isinstance(truth, AnalogMonitorTruth):
            channel, self._probe = truth.ain, Probe(truth, world, rng)
        self.box.inputs[channel] = self._input
        self._server = Server(self.box, wire)

    @property
    def before_reply(self) -> Callable[[float], None] | None:
        return self._server.before_reply

    @before_reply.setter
    def before_reply(self, call: Callable[[float], None] | None) -> None:
        self._server.before_reply = call

    @property
    def next_time(self) -> float:
        return math.inf

    def advance(self, t: float) -> None:
        """It does nothing by itself."""

    def receive(self, data: bytes, t: float) -> None:
        self._server.receive(data, t)

    def alert(self, t: float) -> None:
        self._server.alert(t)

    def reset(self, t: float) -> None:
        self.box.reset(t)

    def freeze(self, t: float, frozen: bool) -> None:
        self._frozen = self._volts(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate`` and ``wrong_status``: every request is refused."""
        if fault.kind == "saturate":
            self._rail = fault.sign if begins else 0
        else:
            self._server.refuses = begins

    def _volts(self, t: float) -> float:
        s = self._truth
        if isinstance(s, AnalogMonitorTruth):
            return self._probe.number(t)
        if isinstance(s, AnalogForceTruth):
            true = self._world.force_at(t - s.lag_ms * 1e-3) / s.full_scale_N * (1.0 + s.gain_error)
            noise, offset = s.noise_fraction, s.zero_offset_V
        else:
            true = self._world.displacement_at(t) * 1e3 / s.range_mm * (1.0 + s.gain_error)
            noise, offset = s.noise_um * 1e-3 / s.range_mm, s.offset_V
        return s.volts_at_full_scale * (true + noise * float(self._rng.standard_normal())) + offset

    def _input(self, channel: int, t: float) -> float:
        if self._rail:
            return self._rail * 20.0
        s = self._truth
        if self._frozen is not None:
            return self._frozen + s.input_offset_mV * 1e-3
        return self._volts(t) + (s.input_offset_mV + s.input_noise_mV * float(self._rng.standard_normal())) * 1e-3


TWINS = (
    Twin("labjack-amplifier", "hv", AmplifierTruth, Amplifier),
    Twin("labjack-force", "force", AnalogForceTruth, AnalogSensor),
    Twin("labjack-displacement", "displacement", AnalogDisplacementTruth, AnalogSensor),
    Twin("labjack-monitor", "monitor", AnalogMonitorTruth, AnalogSensor),
)
