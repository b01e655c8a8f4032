"""The words of an iseg EDCP module: bits of its registers, and what one channel remembers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

# Module status
KILL, TEMPERATURE, SUPPLY, MODULE_GOOD, EVENT_ACTIVE, SAFETY_LOOP = 1 << 15, 1 << 14, 1 << 13, 1 << 12, 1 << 11, 1 << 10
NO_RAMP, NO_SUM_ERROR, MODULE_INPUT_ERROR, LIMIT_GOOD, HV_ON, FINE = 1 << 9, 1 << 8, 1 << 6, 1 << 5, 1 << 3, 1 << 0
# Module control
SET_KILL, SET_FINE, DO_CLEAR = 1 << 14, 1 << 12, 1 << 6
# Channel status and event status share their bits
V_LIMIT, I_LIMIT, TRIP, INHIBIT, V_BOUNDS, I_BOUNDS = 1 << 15, 1 << 14, 1 << 13, 1 << 12, 1 << 11, 1 << 10
CONSTANT_V, CONSTANT_I, EMERGENCY, ON, INPUT_ERROR, ARC = 1 << 7, 1 << 6, 1 << 5, 1 << 3, 1 << 2, 1 << 1
RAMPING = 1 << 4  # status
END_OF_RAMP = 1 << 4  # event
ON_TO_OFF = 1 << 3  # event
BLOCKING = V_LIMIT | I_LIMIT | TRIP | INHIBIT | EMERGENCY

# Trip actions
FLAG_ONLY, OFF_WITH_RAMP, OFF_AT_ONCE, MODULE_OFF, DISABLED = range(5)


@dataclass
class Channel:
    """What one channel remembers. Only channel 0 has the specimen on its output; the others drive nothing."""

    setpoint: float = 0.0
    current_limit: float = 0.0
    v_bounds: float = 0.0
    i_bounds: float = 0.0
    control: int = 0
    on: bool = False
    emergency: bool = False
    event: int = 0
    mask: int = BLOCKING  # an event blocks only if its bit is set here too
    trip_delay_ms: int = 0
    trip_action: int = DISABLED
    latched: int = 0  # status bits that stay until their event is cleared
    over_since: float = math.inf
    ramping: bool = False
    limiting: bool = False
    more: dict[int, float] = field(default_factory=dict)  # of `rig.sim.instruments.iseg.more`
