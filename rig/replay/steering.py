"""The engine led through a recorded run turn by turn, however uneven its turns were.

In virtual time a run goes again as it went. In real time no two turns take the same time, and whether a wait ends in
this turn or the next would be left to chance. So the clock shows, turn by turn, what it showed then; each instrument
is polled in the turns, and told the times, in which something passed on its wire; turns in which nothing did are left
out.

The order is the log's, never that of the clock. Where the engine is to decide something (a command, a phase, a
reference) the clock stands at the time of that decision until it has been taken, and nothing is polled meanwhile. A
decision that comes before its time, because a wait that ended within a turn then ends at its beginning now, lets the
turns before it happen first. The supply is polled up to its next command, and no further before that has been given.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from drivers.links.link import DeviceError
from drivers.roles import Device, HVSupply, Sample
from rig.base.clock import VirtualClock
from rig.bench.bench import Bench
from rig.bench.opening import open_memory
from rig.bench.tap import Tap
from rig.bench.wired import Wired
from rig.engine.engine import SHORTEST_TURN_S
from rig.replay.recording import Recording, Row, counted_device
from rig.scene.scene import Scene

DECISIONS = ("/phase", "/target", "/reference", "/command")
NANOSECONDS = 1e-8  # to which the times of turns are known
TOLERANCE_S = 0.1  # by how much a decision may come sooner or later than then: less than any device is silent for
TOLERANCE_TURNS = round(TOLERANCE_S / SHORTEST_TURN_S)

# The word in the log under which a supply's first call of each command stands.
WORDS = {
    "set_ramp": ("arm", "take_down"),
    "clear": ("clear",),
    "set_voltage": ("set_voltage",),
    "switch_on": ("switch_on",),
    "switch_off": ("switch_off",),
    "emergency_off": ("emergency_off",),
    "give_back": ("give_back",),
}
SUPPLY = ("hv", "hv.settings")


@dataclass
class _Turn:
    """A turn of the loop in which something was read or sent: when it began, and the polls by role."""

    t: float
    polls: dict[str, list[float]] = field(default_factory=dict)


@dataclass
class _Decision:
    """A row that the engine wrote of its own will."""

    t: float
    topic: str
    place: int  # in the log
    waited: int = 0


@dataclass
class _Command:
    """A command to the supply."""

    t: float
    word: str
    waited: int = 0


class Steering:
    """Where in the recorded run the engine is."""

    def __init__(self, recording: Recording) -> None:
        self._entries = deque(_entries(recording))
        self._supply = deque(_supply(recording.rows))
        start = recording.start_ns
        self._taken = deque(
            (_seconds(row.log_ns - start), place)
            for place, row in enumerate(recording.rows)
            if row.topic == "/hv/sample"
        )
        self._turn: _Turn | None = None
        self._in_turn = False

    def next_time(self, wanted: float) -> float:
        """A turn has ended; the time of the next, which would come at ``wanted`` if nothing were known of it."""
        self._in_turn = False
        if not self._entries:
            return wanted
        entry = self._entries[0]
        if isinstance(entry, _Turn):
            # What is decided right after that turn was not due before it, though it may seem so by the turn's time.
            held = len(self._entries) > 1 and isinstance(self._entries[1], _Decision)
            return 0.0 if held else entry.t
        entry.waited += 1
        if entry.waited == 1:
            return entry.t
        if entry.waited > TOLERANCE_TURNS:
            self._entries.popleft()
        return wanted

    def decided(self, topic: str, fields: Mapping[str, Any]) -> list[tuple[str, float]]:
        """The engine writes a row; role and time of the polls that were before that, and have not been yet."""
        if not _is_decision(topic, fields):
            return []
        decision = next((entry for entry in self._entries if isinstance(entry, _Decision)), None)
        if decision is None or decision.topic != topic or decision.t > fields["t_s"] + TOLERANCE_S:
            return []
        before: list[_Turn] = []
        while isinstance(entry := self._entries.popleft(), _Turn):
            before.append(entry)
        after = self._entries[0] if self._entries else None
        if isinstance(after, _Turn) and self._turn is not None and after.t == self._turn.t:
            self._in_turn = False  # decided in the midst of a turn, which goes on
        return [(role, t) for turn in before for role, times in turn.polls.items() for t in times]

    @property
    def turn_began(self) -> float:
        """When this turn began; 0 where nothing is known of it."""
        return self._turn.t if self._in_turn and self._turn is not None else 0.0

    def polls(self, role: str, now: float) -> list[float]:
        """When ``role`` was polled in this turn; ``now``, where the log has ended."""
        if not self._in_turn:
            self._in_turn = True
            entry = self._entries[0] if self._entries else None
            self._turn = entry if isinstance(entry, _Turn) else None
            if self._turn is not None:
                self._entries.popleft()
        if self._turn is None:
            return [] if self._entries else [now]
        return self._turn.polls.pop(role, [])

    # The supply, which may have been polled by its guard's process in a time of its own

    def supply_poll(self, now: float, *, holding: bool) -> float | None:
        """The supply's next poll, if it was before ``now``, or if a sample is to come of it in this very turn."""
        item = self._supply[0] if self._supply else None
        if isinstance(item, _Command):
            if item.t <= now:
                item.waited += 1
            if item.waited > TOLERANCE_TURNS:
                self._supply.popleft()
            return None
        if item is None or (item > now + NANOSECONDS and (holding or not self.sample_taken())):
            return None
        self._supply.popleft()
        return item

    def sample_taken(self) -> bool:
        """Whether the engine took its next sample of the supply in this turn."""
        if not self._taken or not self._entries:
            return bool(self._taken)
        (t, place), coming = self._taken[0], self._entries[0]
        return place < coming.place if isinstance(coming, _Decision) else t < coming.t

    def take_sample(self) -> None:
        self._taken.popleft()

    def supply_polls_before(self, words: Sequence[str]) -> list[float]:
        """When the supply was polled before it was given the next command, if that is one of ``words``."""
        coming = next((item for item in self._supply if isinstance(item, _Command)), None)
        if coming is None or coming.word not in words:
            return []
        times = []
        while isinstance(item := self._supply.popleft(), float):
            times.append(item)
        return times

    @property
    def ended(self) -> bool:
        """Whether all that the log has of the supply has been gone through."""
        return not self._entries and not self._supply


def _seconds(ns: int) -> float:
    return ns * 1e-9


def _is_decision(topic: str, fields: Mapping[str, Any]) -> bool:
    if counted_device(topic, fields):
        return True
    return topic in DECISIONS and fields.get("device", "stage") == "stage"


def _entries(recording: Recording) -> list[_Turn | _Decision]:
    entries: list[_Turn | _Decision] = []
    closed: set[str] = set()
    turn: _Turn | None = None
    for place, row in enumerate(recording.rows):
        about, written = _seconds(row.about_ns - recording.start_ns), _seconds(row.log_ns - recording.start_ns)
        _, topic, *rest = row.topic.split("/")
        if topic == "raw" and rest[0] != "hv" and rest[0] not in closed:
            if turn is None or about != turn.t:
                last = entries[-1] if entries else None
                if isinstance(last, _Turn) and not last.polls and about <= last.t:
                    turn, last.t = last, about  # the turn whose first row was a sample of the supply
                else:
                    turn = _Turn(about)
                    entries.append(turn)
            times = turn.polls.setdefault(rest[0], [])
            if not times or times[-1] != row.t:
                times.append(row.t)
        elif row.topic == "/hv/sample":
            if not entries or written - entries[-1].t > SHORTEST_TURN_S:  # a turn in which nothing else was read
                entries.append(_Turn(written))
        elif _is_decision(row.topic, row.fields) and not closed:
            entries.append(_Decision(row.t, row.topic, place))
            turn = None  # what comes in the same turn comes after it
        if device := counted_device(row.topic, row.fields):
            closed.add(device)
    return entries


def _supply(rows: Sequence[Row]) -> list[float | _Command]:
    """Times of the supply's polls and its commands, in their order."""
    found: list[float | _Command] = []
    for row in rows:
        if row.topic.startswith("/raw/hv/"):
            if not found or found[-1] != row.t:
                found.append(row.t)
        elif row.topic == "/command" and row.fields["device"] in SUPPLY:
            found.append(_Command(row.t, row.fields["command"]))
    return found


class _Clock(VirtualClock):
    """Shows the times of the recorded turns."""

    def __init__(self, steering: Steering, advance: Callable[[float], None]) -> None:
        super().__init__(advance)
        self._steering = steering
        self.show(steering.next_time(0.0))

    def sleep_until(self, t: float) -> None:
        super().sleep_until(self._steering.next_time(t))

    def begin_turn(self) -> None:
        """The first instrument is polled: it is at least so late."""
        super().sleep_until(self._steering.turn_began)

    def show(self, t: float) -> float:
        """Show ``t`` for the time of a poll; returns what was shown before."""
        before, self._now = self._now, t
        return before


class _Steered:
    """An instrument, polled when it was polled then."""

    def __init__(self, role: str, device: Device, steering: Steering, clock: _Clock) -> None:
        self._role = role
        self._device = device
        self._steering = steering
        self._clock = clock
        self._samples: deque[Sample] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def poll(self, now: float) -> Sequence[Sample]:
        times = self._steering.polls(self._role, now)
        self._clock.begin_turn()
        for t in times:
            self.poll_at(t)
        samples = list(self._samples)
        self._samples.clear()
        return samples

    def poll_at(self, t: float) -> None:
        """Poll it as at ``t``; what it says is given with the next poll."""
        before = self._clock.show(t)
        try:
            self._samples += self._device.poll(t)
        finally:
            self._clock.show(before)


class _SteeredSupply(_Steered):
    """The supply: polled in its own time, its samples given when the engine took them."""

    _error: DeviceError | None = None

    def __getattr__(self, name: str) -> Any:
        if name in WORDS:
            try:
                for t in self._steering.supply_polls_before(WORDS[name]):
                    self.poll_at(t)
            except DeviceError as error:
                self._error = error  # told by the next poll, as it was then
        return super().__getattr__(name)

    def poll(self, now: float) -> Sequence[Sample]:
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        self._steering.polls(self._role, now)  # so that the turn is known
        self._clock.begin_turn()
        now = max(now, self._steering.turn_began)
        while (t := self._steering.supply_poll(now, holding=bool(self._samples))) is not None:
            self.poll_at(t)
        if self._steering.ended:
            self.poll_at(now)
        samples = []
        while self._samples and self._steering.sample_taken():
            self._steering.take_sample()
            samples.append(self._samples.popleft())
        return samples


class SteeredBench(Bench):
    """A bench whose clock and polls follow a recording."""

    def __init__(self, scene: Scene, wired: Wired, recording: Recording) -> None:
        self._steering = Steering(recording)
        super().__init__(scene, open_memory(scene, wired, _Clock(self._steering, wired.advance)))

    def attach(self, tap: Tap) -> None:
        super().attach(tap)
        assert isinstance(self.clock, _Clock)
        for role, device in self.devices.items():
            kind = _SteeredSupply if role == "hv" else _Steered
            self.devices[role] = cast("Device", kind(role, device, self._steering, self.clock))
        if self.hv is not None:
            self.hv = cast("HVSupply", self.devices["hv"])

    def decided(self, topic: str, fields: Mapping[str, Any]) -> None:
        """To be told of every row that the engine writes."""
        for role, t in self._steering.decided(topic, fields):
            cast("_Steered", self.devices[role]).poll_at(t)
