"""Items that an iseg module has beside those that the specimen's voltage hangs on: kept and read back, no more.

Numbers and formats are those of the EDCP manuals as isegcan has them: a channel's ramp priority, its external
resistor and thermometer, limits of the current ramp, power. Set power and temperature coefficient do nothing to a
simulated film; they are there so that other people's clients find what they ask for.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import NamedTuple

from rig.sim.instruments.iseg.words import Channel


class Rated(NamedTuple):
    """What a channel can give: nominal voltage (V) and current (A), and how many channels there are."""

    volts: float
    amperes: float
    channels: int


class Item(NamedTuple):
    """Format, value after power-up, and the ends between which it may be written; none: it is only read."""

    form: str
    first: Callable[[Rated], float]
    ends: Callable[[Rated], tuple[float, float]] | None = None


GROUP_MASK = 0x1006  # of the module: which groups of channels count in its status
POWER_MEASURED = 0x4135
CURRENT_RANGE = 0x4109  # nominal current, and which range is in use

ITEMS = {
    0x4010: Item(">H", lambda rated: 0, lambda rated: (0, rated.channels)),  # priority of the voltage ramp
    0x4108: Item(">f", lambda rated: rated.volts * rated.amperes),  # nominal power
    0x410A: Item(">f", lambda rated: 0.0, lambda rated: (0.0, rated.volts)),  # bottom voltage
    0x4120: Item(">f", lambda rated: 0.0, lambda rated: (-rated.volts, rated.volts)),  # V per K of the VCT option
    0x4121: Item(">f", lambda rated: 25.0, lambda rated: (-273.15, 1000.0)),  # external temperature (C)
    0x4122: Item(">f", lambda rated: 0.0, lambda rated: (0.0, math.inf)),  # external resistor (ohm)
    0x4129: Item(">f", lambda rated: 0.0),  # slowest current ramp (A/s)
    0x4130: Item(">f", lambda rated: 0.2 * rated.amperes),  # fastest current ramp (A/s)
    0x4134: Item(
        ">f", lambda rated: rated.volts * rated.amperes, lambda rated: (0.0, rated.volts * rated.amperes)
    ),  # set power (W)
}


def read(opcode: int, channel: Channel, rated: Rated, volts: float, amperes: float) -> bytes | None:
    """The value of one of these items; None where it is none of them. ``volts``, ``amperes``: as measured."""
    if opcode == POWER_MEASURED:
        return struct.pack(">f", abs(volts * amperes))
    if opcode == CURRENT_RANGE:
        return struct.pack(">fB", rated.amperes, 0)
    item = ITEMS.get(opcode)
    if item is None:
        return None
    value = channel.more.get(opcode, item.first(rated))
    return struct.pack(item.form, int(value) if item.form == ">H" else value)


def write(opcode: int, channel: Channel, data: bytes, rated: Rated) -> bool:
    """Take a new value; False where there is nothing of that number to write, or it is out of range."""
    item = ITEMS.get(opcode)
    if item is None or item.ends is None or len(data) != struct.calcsize(item.form):
        return False
    (value,) = struct.unpack(item.form, data)
    low, high = item.ends(rated)
    if not low <= value <= high:  # NaN fails too
        return False
    channel.more[opcode] = float(value)
    return True
