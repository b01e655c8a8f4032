"""When an answer may come, by how long the ones before it have taken: nobody need look sooner.

An answer that comes in pieces, or behind the acknowledgement of an adapter, then wakes the guard's loop once.
"""

from __future__ import annotations

from drivers.roles import HVSupply

SOONEST_PART = 0.9  # of the shortest trip of late: an answer that comes sooner is seen then
FORGETS_S = 1e-4  # by so much the shortest trip grows with each longer one


class Expected:
    """The answers of one supply. Nothing is expected late before its trips are known."""

    def __init__(self, supply: HVSupply) -> None:
        self._supply = supply
        self._trips = 0
        self._shortest = 0.0
        self._asked = 0.0
        self._awaits = False

    def after(self, polled: float, awaits: bool) -> float:
        """When the answer may come at the earliest, after the poll at ``polled``, and whether one is awaited since."""
        trips = self._supply.counters.get("round_trips", 0)
        if trips != self._trips:
            self._trips, self._shortest = trips, min(polled - self._asked, self._shortest + FORGETS_S)
            self._asked = polled
        elif not self._awaits:
            self._asked = polled
        self._awaits = awaits
        return self._asked + SOONEST_PART * self._shortest
