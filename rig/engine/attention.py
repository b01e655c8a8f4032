"""Which instruments a turn of the loop has to poll, and the wait for the next turn.

On real ports the system says where something has come. An instrument that awaits an answer is polled when it has come,
and wakes the loop; one that has nothing to do, and has sent nothing, is left alone. On a bench in memory nothing comes
between two turns, and all are polled in each.
"""

from __future__ import annotations

import math
import select
from collections import Counter
from collections.abc import Sequence

from drivers.dialogue import LOOK_AGAIN_S
from rig.bench.bench import Bench

STREAM_S = 0.003  # what streams, or has come unasked, is read again after so long: not in two turns that are close
LONGEST_S = 0.01  # who awaits an answer, or cannot say when he wishes to be polled, is polled after so long ...
TOGETHER_S = 0.0025  # who wishes to be polled may be put off so long, to be polled in one turn with others
IDLE_S = 0.05  # ... and who has nothing to do until a time that he tells; whatever the system says


class Attention:
    """Of one bench, whose devices have been attached.

    ``puts_off``: by how much a turn may be put off (s); nothing on a bench in memory.
    """

    def __init__(self, bench: Bench) -> None:
        self._clock = bench.clock
        self._devices = bench.devices
        self._all = list(bench.devices)
        self._descriptors = {role: found for role in self._all if (found := bench.descriptor(role)) is not None}
        self._polled = dict.fromkeys(self._all, -math.inf)
        users = Counter(self._descriptors.values())
        self._shared = any(count > 1 for count in users.values())
        # An answer on a connection of several may have been read already, by another of them.
        self._links = {role: one for role, one in self._descriptors.items() if bench.has_link(role) and users[one] == 1}
        self._watched = sorted(set(self._descriptors.values()))
        self.puts_off = TOGETHER_S if self._descriptors else 0.0

    def wanted(self, now: float) -> Sequence[str]:
        """The roles to be polled in the turn that begins ``now``, in the order of the bench."""
        if not self._descriptors:
            return self._all
        try:
            came = set(select.select(self._watched, [], [], 0)[0])
        except (OSError, ValueError):  # one was closed; its instrument says so when it is polled
            return self._all
        roles = [role for role in self._all if self._wants(role, now, came)]
        if self._shared:  # instruments on one connection read for each other, of which the system knows nothing
            together = {self._descriptors[role] for role in roles if role in self._descriptors}
            return [role for role in self._all if role in roles or self._descriptors.get(role) in together]
        return roles

    def _wants(self, role: str, now: float, came: set[int]) -> bool:
        descriptor = self._descriptors.get(role)
        if descriptor is None:
            return True
        polled, wish = self._polled[role], self._devices[role].next_poll
        if wish == polled + LOOK_AGAIN_S and role in self._links:
            return descriptor in came or not now - polled < LONGEST_S
        if now >= wish:
            return True
        longest = STREAM_S if descriptor in came else IDLE_S if now < wish else LONGEST_S  # NaN is no time
        return not now - polled < longest

    def polled(self, role: str, now: float) -> None:
        """To be told of each poll, and the time that the device was told."""
        self._polled[role] = now

    def next(self) -> tuple[float, list[int]]:
        """When a turn is due if nothing comes before, and by what descriptors answers are awaited.

        Who only looks for an answer is known by what `drivers.dialogue.Dialogue.next_poll` says then, to the digit.
        """
        due, awaited = math.inf, []
        for role, device in self._devices.items():
            wish = device.next_poll
            if wish != self._polled[role] + LOOK_AGAIN_S:
                wish += self.puts_off
            elif role in self._links:
                awaited.append(self._links[role])
                continue
            if wish < due:
                due = wish
        return due, awaited

    def wait(self, earliest: float, due: float, awaited: Sequence[int]) -> None:
        """Return at ``due``; as soon as an answer has come, but not before ``earliest``."""
        clock = self._clock
        clock.sleep_until(earliest if awaited else due)
        left = due - clock.now() if awaited else 0.0
        if left > 0:
            try:
                select.select(awaited, [], [], left)
            except (OSError, ValueError):  # one was closed; its instrument says so when it is polled
                clock.sleep_until(due)
