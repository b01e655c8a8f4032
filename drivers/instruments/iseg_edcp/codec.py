"""HV supplies of iseg: EDCP (Enhanced Device Control Protocol) on classic CAN with 11-bit identifiers.

Identifier ``0x200 | module << 3 | direction``: direction 1 is a read request, 0 is data. A host's write and a module's
answer therefore look exactly alike; an answer is recognised only as the one that a pending read request asked for.
Data begin with a 16-bit operation code, then for channel items the channel, then the value, big-endian::

    201# 41 06 00              read nominal voltage of channel 0 of module 0
    200# 41 06 00 45 BB 80 00  the module answers 6000 V
    200# 41 00 00 44 BB 80 00  the host writes set-point 1500 V; there is no acknowledgement, so it is read back
    201# D8 <status> <type>    an unregistered module announces itself;  200# D8 01 registers it

A registered module stays quiet while it is addressed at least once a minute. That is no watchdog: nothing says that the
output goes off when the host dies. Sources: isegcan 0.7.0 and drvAsynCan (operation codes), iseg manuals EHQ-1 (module
bits), HPS (channel bits), EHQ 9005-F (log-on, kill).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag
from typing import NamedTuple

from drivers.links.link import CanFrame
from drivers.roles import HVFlag, Identity


class Item(NamedTuple):
    """One entry of the module's object table: operation code, value format, whether it belongs to a channel."""

    code: int
    format: str
    per_channel: bool
    title: str


def _module(code: int, form: str, title: str) -> Item:
    return Item(code, form, False, title)


def _channel(code: int, form: str, title: str) -> Item:
    return Item(code, form, True, title)


MODULE_STATUS = _module(0x1000, "H", "module status")
MODULE_CONTROL = _module(0x1001, "H", "module control")
MODULE_EVENTS = _module(0x1002, "H", "module event status")
MODULE_RAMP = _module(0x1100, "f", "voltage ramp")
TEMPERATURE = _module(0x1106, "f", "module temperature")
SERIAL_NUMBER = _module(0x1200, "I", "serial number")
FIRMWARE_RELEASE = _module(0x1201, "I", "firmware release")
FIRMWARE_NAME = _module(0x1203, "4s", "firmware name")
CHANNEL_COUNT = _module(0x1208, "B", "number of channels")
CHANNEL_STATUS = _channel(0x4000, "H", "channel status")
CHANNEL_CONTROL = _channel(0x4001, "H", "channel control")
CHANNEL_EVENTS = _channel(0x4002, "H", "channel event status")
TRIP_DELAY = _channel(0x4005, "H", "trip delay")
TRIP_ACTION = _channel(0x4006, "B", "trip action")
SET_VOLTAGE = _channel(0x4100, "f", "voltage set-point")
SET_CURRENT = _channel(0x4101, "f", "current set-point")
MEASURED_VOLTAGE = _channel(0x4102, "f", "measured voltage")
MEASURED_CURRENT = _channel(0x4103, "f", "measured current")
VOLTAGE_BOUNDS = _channel(0x4104, "f", "voltage bounds")
CURRENT_BOUNDS = _channel(0x4105, "f", "current bounds")
NOMINAL_VOLTAGE = _channel(0x4106, "f", "nominal voltage")
NOMINAL_CURRENT = _channel(0x4107, "f", "nominal current")

ITEMS = {
    item.code: item
    for item in (
        MODULE_STATUS,
        MODULE_CONTROL,
        MODULE_EVENTS,
        MODULE_RAMP,
        TEMPERATURE,
        SERIAL_NUMBER,
        FIRMWARE_RELEASE,
        FIRMWARE_NAME,
        CHANNEL_COUNT,
        CHANNEL_STATUS,
        CHANNEL_CONTROL,
        CHANNEL_EVENTS,
        TRIP_DELAY,
        TRIP_ACTION,
        SET_VOLTAGE,
        SET_CURRENT,
        MEASURED_VOLTAGE,
        MEASURED_CURRENT,
        VOLTAGE_BOUNDS,
        CURRENT_BOUNDS,
        NOMINAL_VOLTAGE,
        NOMINAL_CURRENT,
    )
}


class ModuleStatus(IntFlag):
    """Item 1000. The "good" bits are 1 when all is well."""

    KILL_ENABLED = 1 << 15
    TEMPERATURE_GOOD = 1 << 14
    SUPPLY_GOOD = 1 << 13
    MODULE_GOOD = 1 << 12
    EVENT_ACTIVE = 1 << 11
    SAFETY_LOOP_GOOD = 1 << 10
    NO_RAMP = 1 << 9
    NO_SUM_ERROR = 1 << 8
    INPUT_ERROR = 1 << 6
    HARDWARE_VOLTAGE_LIMIT_GOOD = 1 << 5
    NEEDS_SERVICE = 1 << 4
    HV_ON = 1 << 3
    FINE_ADJUSTMENT = 1 << 0


class ModuleControl(IntFlag):
    """Item 1001."""

    KILL = 1 << 14
    ADJUSTMENT = 1 << 12
    CLEAR = 1 << 6


class ChannelStatus(IntFlag):
    """Item 4000."""

    VOLTAGE_LIMIT = 1 << 15
    CURRENT_LIMIT = 1 << 14
    TRIP = 1 << 13
    EXTERNAL_INHIBIT = 1 << 12
    VOLTAGE_BOUNDS = 1 << 11
    CURRENT_BOUNDS = 1 << 10
    ARC_ERROR = 1 << 9
    LOW_RANGE = 1 << 8
    CONSTANT_VOLTAGE = 1 << 7
    CONSTANT_CURRENT = 1 << 6
    EMERGENCY_OFF = 1 << 5
    RAMPING = 1 << 4
    ON = 1 << 3
    INPUT_ERROR = 1 << 2
    ARC = 1 << 1


class ChannelEvents(IntFlag):
    """Item 4002. Bits latch and are cleared by writing 1."""

    VOLTAGE_LIMIT = 1 << 15
    CURRENT_LIMIT = 1 << 14
    TRIP = 1 << 13
    EXTERNAL_INHIBIT = 1 << 12
    VOLTAGE_BOUNDS = 1 << 11
    CURRENT_BOUNDS = 1 << 10
    CONSTANT_VOLTAGE = 1 << 7
    CONSTANT_CURRENT = 1 << 6
    EMERGENCY_OFF = 1 << 5
    END_OF_RAMP = 1 << 4
    ON_TO_OFF = 1 << 3
    INPUT_ERROR = 1 << 2


class ChannelControl(IntFlag):
    """Item 4001."""

    EMERGENCY_OFF = 1 << 5
    ON = 1 << 3


# The bits of the channel control that this program sets and clears; the others are somebody else's and stay as found.
OWN_CONTROL = int(ChannelControl.ON | ChannelControl.EMERGENCY_OFF)

# Events that keep the channel from being switched on until they are cleared.
BLOCKING = (
    ChannelEvents.VOLTAGE_LIMIT
    | ChannelEvents.CURRENT_LIMIT
    | ChannelEvents.TRIP
    | ChannelEvents.EXTERNAL_INHIBIT
    | ChannelEvents.EMERGENCY_OFF
)

TRIP_ACTIONS = {
    0: "flag only",
    1: "off with ramp",
    2: "off without ramp",
    3: "whole module off",
    4: "disabled",
}

# To all modules on the bus: emergency off of all channels. Needs no registration and gets no answer.
EMERGENCY_OFF_ALL = CanFrame(0x004, bytes.fromhex("E80060010020"))

Value = float | int | bytes


@dataclass(frozen=True, slots=True)
class Data:
    """A value: answer of the module, or some host's write."""

    item: Item
    channel: int | None
    value: Value


@dataclass(frozen=True, slots=True)
class LogOn:
    """An unregistered module announces itself, with its general status and type."""

    status: int
    type: int


Message = Data | LogOn


def _id(module: int, direction: int) -> int:
    return 0x200 | module << 3 | direction


def _head(item: Item, channel: int | None) -> bytes:
    if item.per_channel != (channel is not None):
        raise ValueError(f"{item.title} {'needs a' if item.per_channel else 'has no'} channel")
    return struct.pack(">H", item.code) + (b"" if channel is None else bytes((channel,)))


def read_request(module: int, item: Item, channel: int | None = None) -> CanFrame:
    """Ask for the value of an item."""
    return CanFrame(_id(module, 1), _head(item, channel))


def read_many(module: int, item: Item, channels: Iterable[int]) -> CanFrame:
    """Ask for the item of several channels (0 to 15); one single-channel answer comes for each."""
    if not item.per_channel:
        raise ValueError(f"{item.title} belongs to the module, not to a channel")
    mask = sum(1 << c for c in set(channels))
    return CanFrame(_id(module, 1), struct.pack(">HHB", item.code + 0x2000, mask, 0))


def write(module: int, item: Item, value: Value, channel: int | None = None) -> CanFrame:
    """Write an item. There is no acknowledgement."""
    return CanFrame(_id(module, 0), _head(item, channel) + struct.pack(">" + item.format, value))


def log_on(module: int) -> CanFrame:
    """Register the module with this host."""
    return CanFrame(_id(module, 0), b"\xd8\x01")


def log_off(module: int) -> CanFrame:
    """Release the module; it announces itself again."""
    return CanFrame(_id(module, 0), b"\xd8\x00")


def identity(serial: Value | None, release: Value | None, name: Value | None) -> Identity:
    """From the items serial number, firmware release and firmware name; None where the module does not say."""
    text = "".join(chr(b) for b in name if 0x20 < b < 0x7F) if isinstance(name, bytes) else ""
    return Identity(
        model=f"iseg {text}" if text else "iseg EDCP",
        serial=f"{serial:d}" if isinstance(serial, int) else "",
        firmware=".".join(str(b) for b in release.to_bytes(4, "big")) if isinstance(release, int) else "",
    )


class Decoder:
    """Frames of one module to messages. Never raises.

    Counters: ``foreign_frames`` (other identifiers), ``foreign_requests`` (read requests: another host on the bus,
    or an interface that returns its own frames), ``bad_frames`` (unknown operation code or wrong length).
    """

    def __init__(self, module: int, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        for key in ("foreign_frames", "foreign_requests", "bad_frames"):
            self.counters.setdefault(key, 0)
        self._data_id = _id(module, 0)
        self._request_id = _id(module, 1)

    def feed(self, frame: CanFrame) -> Message | None:
        """The frame's message; None (and counted) when it is not for us or makes no sense."""
        if frame.id == self._request_id:
            if len(frame.data) == 3 and frame.data[0] == 0xD8:
                return LogOn(frame.data[1], frame.data[2])
            self.counters["foreign_requests"] += 1
            return None
        if frame.id != self._data_id:
            self.counters["foreign_frames"] += 1
            return None
        item = ITEMS.get(int.from_bytes(frame.data[:2], "big")) if len(frame.data) > 2 else None
        if item is not None:
            head = 3 if item.per_channel else 2
            if len(frame.data) == head + struct.calcsize(">" + item.format):
                (value,) = struct.unpack_from(">" + item.format, frame.data, head)
                return Data(item, frame.data[2] if item.per_channel else None, value)
        self.counters["bad_frames"] += 1
        return None


# What a channel's own status says of why this channel is off. A limit that it is at is no reason: a trip may follow.
CHANNEL_ERRORS = HVFlag.TRIPPED | HVFlag.ARC | HVFlag.INHIBITED | HVFlag.EMERGENCY_OFF

STATUS_BIT_5 = ("unused", "limit good", "input error")
"""What bit 5 of the module status may mean, by the class of the module."""


def hv_flags(status: ChannelStatus, events: ChannelEvents, module: ModuleStatus, bit_5: str = "unused") -> HVFlag:
    """What a channel's status, its latched events and its module's status mean for any supply.

    Latched events that block the channel count as present until they are cleared. ``bit_5``, one of `STATUS_BIT_5`,
    says what bit 5 of the module status means: "hardware voltage limit good" on distributor modules with current
    mirror, an input error (1 = bad) on some others; it is reserved on most.
    """
    limit_bit = module & ModuleStatus.HARDWARE_VOLTAGE_LIMIT_GOOD
    bit_5_is_bad = (bit_5 == "limit good" and not limit_bit) or (bit_5 == "input error" and bool(limit_bit))
    flags = HVFlag(0)
    for flag, present in (
        (HVFlag.ON, status & ChannelStatus.ON),
        (HVFlag.RAMPING, status & ChannelStatus.RAMPING),
        (
            HVFlag.VOLTAGE_LIMIT,
            status & (ChannelStatus.VOLTAGE_LIMIT | ChannelStatus.VOLTAGE_BOUNDS)
            or events & ChannelEvents.VOLTAGE_LIMIT,
        ),
        (
            HVFlag.CURRENT_LIMIT,
            status & (ChannelStatus.CURRENT_LIMIT | ChannelStatus.CURRENT_BOUNDS | ChannelStatus.CONSTANT_CURRENT)
            or events & ChannelEvents.CURRENT_LIMIT,
        ),
        (HVFlag.TRIPPED, status & ChannelStatus.TRIP or events & ChannelEvents.TRIP),
        (HVFlag.INHIBITED, status & ChannelStatus.EXTERNAL_INHIBIT or events & ChannelEvents.EXTERNAL_INHIBIT),
        (HVFlag.EMERGENCY_OFF, status & ChannelStatus.EMERGENCY_OFF or events & ChannelEvents.EMERGENCY_OFF),
        (HVFlag.ARC, status & (ChannelStatus.ARC | ChannelStatus.ARC_ERROR)),
        (HVFlag.INTERLOCK_OPEN, ~module & ModuleStatus.SAFETY_LOOP_GOOD),
        (
            HVFlag.FAULT,
            status & ChannelStatus.INPUT_ERROR
            or bit_5_is_bad
            or ~module & (ModuleStatus.TEMPERATURE_GOOD | ModuleStatus.SUPPLY_GOOD | ModuleStatus.MODULE_GOOD),
        ),
    ):
        if present:
            flags |= flag
    return flags
