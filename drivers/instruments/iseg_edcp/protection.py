"""The supply's own trip, and everything that arming changes in it: set when armed, put back as found.

A channel that draws more than its set current for `TRIP_DELAY_MS` switches itself off without a ramp; a module with one
channel has its kill enabled as well, which does the same at once (of a module with more, kill would act on channels
that are somebody else's). The bounds make the channel report a voltage away from its set-point. For the current the set
value itself is the bound: manuals differ in whether bounds count from it or from zero, and this one is right for both.
A module that does not have one of these items, or does not take it, is used without it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.dialogue import Ask
from drivers.instruments.iseg_edcp import codec as edcp
from drivers.instruments.iseg_edcp.codec import ModuleControl, Value, write
from drivers.instruments.iseg_edcp.exchange import ATTEMPTS, Exchange, Script, value_of
from drivers.links.link import DeviceSilent

TRIP_DELAY_MS = 20
OFF_WITHOUT_RAMP = 2
KILL = "kill"
ITEMS = {
    "ramp_percent_per_s": edcp.MODULE_RAMP,
    "current_limit_A": edcp.SET_CURRENT,
    "voltage_bounds_V": edcp.VOLTAGE_BOUNDS,
    "current_bounds_A": edcp.CURRENT_BOUNDS,
    "trip_delay_ms": edcp.TRIP_DELAY,
    "trip_action": edcp.TRIP_ACTION,
    KILL: edcp.MODULE_CONTROL,
}


class Protection:
    """What of one channel was changed: ``found`` before, ``present`` now, by the keys of `ITEMS`."""

    def __init__(self, module: int, channel: int) -> None:
        self.found: dict[str, float] = {}
        self.present: dict[str, float] = {}
        self._module, self._channel = module, channel

    def changed(self, key: str, before: float, now: float) -> None:
        """A setting was changed by a command of the rig."""
        self.found.setdefault(key, before)
        self.present[key] = now

    @property
    def given_back(self) -> bool:
        """Whether everything is as it was found, read back."""
        return all(_same(self.present.get(key, math.nan), value) for key, value in self.found.items())

    def resume(self, found: Mapping[str, float]) -> None:
        """Another program found it so, and changed it."""
        self.found = {key: value for key, value in found.items() if key in ITEMS}
        self.present = {}

    def arm(self, volts: float, amperes: float, *, alone: bool) -> Script[dict[str, str]]:
        """Set bounds about the set-points, trip and, for a channel that is ``alone``, kill; gives what became of it."""
        wanted = {
            "voltage_bounds_V": volts,
            "current_bounds_A": amperes,
            "trip_delay_ms": TRIP_DELAY_MS,
            "trip_action": OFF_WITHOUT_RAMP,
            **({KILL: 1.0} if alone else {}),
        }
        settings = {}
        for key, value in wanted.items():
            before = yield from self._read(key)
            if before is None:
                settings[key] = "the module does not have it"
                continue
            self.found.setdefault(key, before)
            self.present[key] = math.nan
            taken = yield from self._put(key, value)
            settings[key] = f"{value:.9g}" if taken else "the module does not take it"
        return settings

    def give_back(self) -> Script[list[str]]:
        """Put back everything that is not as it was found; gives the keys that the module did not take."""
        refused = []
        for key, value in self.found.items():
            if not _same(self.present.get(key, math.nan), value) and not (yield from self._put(key, value)):
                refused.append(key)
        return refused

    def _put(self, key: str, value: float) -> Script[bool]:
        item = ITEMS[key]
        channel = self._channel if item.per_channel else None
        sent: Value = value if item.format == "f" else int(value)
        for _ in range(ATTEMPTS):
            if key == KILL:  # one bit of a word whose others are not ours
                word = yield from self._ask(Exchange(item, None))
                if not isinstance(word, int):
                    return False
                word &= ~(ModuleControl.KILL | ModuleControl.CLEAR)
                sent = word | (ModuleControl.KILL if value else 0)
            frame = write(self._module, item, sent, channel)
            back = _own(key, (yield from self._ask(Exchange(item, channel, (frame,)))))
            if back is not None and _same(back, value):
                self.present[key] = value
                return True
        return False

    def _read(self, key: str) -> Script[float | None]:
        item = ITEMS[key]
        return _own(key, (yield from self._ask(Exchange(item, self._channel if item.per_channel else None))))

    def _ask(self, exchange: Exchange) -> Script[Value | None]:
        """None where there is no such item: not having it means not answering."""
        try:
            return value_of((yield Ask(exchange, repeat=False)))
        except DeviceSilent:
            return None


def _own(key: str, value: Value | None) -> float | None:
    if not isinstance(value, float | int):
        return None
    return float(bool(int(value) & ModuleControl.KILL)) if key == KILL else float(value)


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-12)
