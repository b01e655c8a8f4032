"""A bench that answers from a log: what an instrument once said to a request, it says to the same request again.

Each instrument's answers come as long after its request as they did then. What it sent by itself comes as long after
the request before it. Requests must come in the order of the log; any other is a `ReplayError`. In real time a question
may come once more or less than then: `rig.replay.served` finds its answer.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, NoReturn

from drivers.links.link import DeviceError
from drivers.recorded import Passed
from drivers.registry import instrument
from drivers.settings import CanSettings
from rig.replay.recording import Recording
from rig.replay.served import Lag, ServedScript
from rig.sim.wire import ByteWire, Frame, FrameWire, WireGone


class ReplayError(DeviceError):
    """A request that the log has no answer to, because it is not the one that was made then."""


class Departure(NamedTuple):
    """Where the requests to an instrument depart from the log.

    Attributes
    ----------
    role, number : str, int
        The instrument, and which of its requests, counted from 1.
    t : float
        When the request was made, or was to be made (s).
    step : str
        What the protocol was doing then.
    recorded, made : bytes or None
        Both requests; None where the log has no further one, or none was made.
    """

    role: str
    number: int
    t: float
    step: str
    recorded: bytes | None
    made: bytes | None

    def __str__(self) -> str:
        recorded = "none, the log ends before" if self.recorded is None else self.recorded.hex(" ")
        made = "none" if self.made is None else self.made.hex(" ")
        return (
            f"request {self.number} to the {self.role} is not the recorded one, at {self.t:.3f} s in {self.step}: "
            f"recorded {recorded}; made {made}"
        )


class _Script:
    """What passed on one wire, gone through request by request. Each write is one whole request."""

    def __init__(self, rows: list[Passed], depart: Callable[[float, bytes], NoReturn]) -> None:
        self.requests = 0
        self._depart = depart
        self._rest = deque(rows)
        self._coming: deque[tuple[float, bytes]] = deque()
        self._release(0.0)

    @property
    def due(self) -> Passed | None:
        """The recorded request that comes next; None at the end of the log."""
        return self._rest[0] if self._rest else None

    def write(self, data: bytes, t: float) -> None:
        """Take a request of the host; raises `ReplayError` where it is not what was sent then."""
        due = self.due
        if due is None or data != due.data:
            self._depart(t, data)
        self._rest.popleft()
        self.requests += 1
        self._release(t - due.t)

    def read(self, t: float) -> list[bytes]:
        """What has arrived at the host by ``t``, in the pieces in which it was read then."""
        arrived = []
        while self._coming and self._coming[0][0] <= t:
            arrived.append(self._coming.popleft()[1])
        return arrived

    @property
    def next_arrival(self) -> float:
        return self._coming[0][0] if self._coming else math.inf

    def _release(self, later: float) -> None:
        """What came before the next request is on its way, so much later than then."""
        while self._rest and not self._rest[0].sent:
            t, _, data = self._rest.popleft()
            self._coming.append((t + later, data))


class _Link:
    """Says whether the link was gone, at a time and after so many requests."""

    def __init__(self, script: _Script | ServedScript, changes: list[tuple[float, int, bool]]) -> None:
        self._script = script
        self._changes = changes

    def check(self, t: float) -> None:
        """Raises `WireGone` where it was."""
        passed = [gone for when, requests, gone in self._changes if when <= t and requests <= self._script.requests]
        if passed and passed[-1]:
            raise WireGone


class _ReplayByteWire(ByteWire):
    """A serial line with a log at its far end."""

    def __init__(self, script: _Script | ServedScript, link: _Link) -> None:
        super().__init__()
        self._script = script
        self._link = link

    def host_write(self, data: bytes, t: float) -> None:
        self._script.write(data, t)
        self._link.check(t)

    def host_read(self, t: float) -> bytes:
        self._link.check(t)
        return b"".join(self._script.read(t))

    @property
    def next_arrival(self) -> float:
        return self._script.next_arrival


class _ReplayFrameWire(FrameWire):
    """A CAN bus with a log at its far end."""

    def __init__(self, script: _Script | ServedScript, link: _Link, bitrate: int) -> None:
        super().__init__(bitrate=bitrate)
        self._script = script
        self._link = link

    def host_write(self, frame: Frame, t: float) -> None:
        self._script.write(frame[0].to_bytes(2, "big") + bytes(frame[1]), t)
        self._link.check(t)

    def host_read(self, t: float) -> list[Frame]:
        self._link.check(t)
        return [(int.from_bytes(row[:2], "big"), row[2:]) for row in self._script.read(t)]

    @property
    def next_arrival(self) -> float:
        return self._script.next_arrival


class ReplayBench:
    """The instruments of a recording, in the place of a `rig.sim.bench.SimulatedBench`.

    Parameters
    ----------
    recording : Recording
    real_time : bool
        Whether the bench is served in real time.

    Attributes
    ----------
    departures : list of Departure
        In the order in which they happened.
    """

    def __init__(self, recording: Recording, *, real_time: bool = False) -> None:
        self.recording = recording
        self.now = 0.0
        self.departures: list[Departure] = []
        self.scripts: dict[str, _Script | ServedScript] = {}
        self._wires: dict[str, ByteWire | FrameWire] = {}
        passed: dict[str, list[Passed]] = {}
        changes: dict[str, list[tuple[float, int, bool]]] = {}
        lag = Lag()
        for row in recording.rows:
            if row.topic.startswith("/raw/"):
                _, _, role, way = row.topic.split("/")
                rows = passed.setdefault(role, [])
                if way in ("rx", "tx"):
                    rows.append(Passed(row.t, way == "tx", row.fields["data"]))
                elif way in ("gone", "back"):
                    changes.setdefault(role, []).append((row.t, sum(one.sent for one in rows), way == "gone"))
        for role, table in recording.experiment.scene.instruments.items():
            rows, depart = passed.get(role, []), partial(self._depart, role)
            script = (
                ServedScript(rows, depart, instrument(role, table.driver).dialect, lag)
                if real_time
                else _Script(rows, depart)
            )
            self.scripts[role] = script
            link = _Link(script, [] if real_time else changes.get(role, []))
            if isinstance(table, CanSettings):
                self._wires[role] = _ReplayFrameWire(script, link, table.bitrate)
            else:
                self._wires[role] = _ReplayByteWire(script, link)

    def departure(self, role: str, t: float, made: bytes | None) -> Departure:
        """That ``made`` was sent at ``t`` where the log has something else."""
        script = self.scripts[role]
        due = script.due
        step = self.recording.step_at(t if due is None else due.t)
        return Departure(role, script.requests + 1, t, step, None if due is None else due.data, made)

    def _depart(self, role: str, t: float, made: bytes) -> NoReturn:
        self.departures.append(self.departure(role, t, made))
        advice = "The bench is a log, and can only answer what was asked then."
        raise ReplayError(role, str(self.departures[-1]), advice)

    @property
    def instruments(self) -> Mapping[str, object]:
        """By role, what stands for the instrument."""
        return self.scripts

    def prepare(self) -> None:
        """Nothing takes long."""

    def wire(self, role: str) -> ByteWire | FrameWire:
        """The wire to the instrument of ``role``; the host uses its ``host_write`` and ``host_read``."""
        return self._wires[role]

    def advance(self, t: float) -> None:
        """Nothing happens by itself but what is on its way already."""
        self.now = t

    def next_time(self) -> float:
        """When something arrives at the host next; inf if nothing will until it asks."""
        return min(script.next_arrival for script in self.scripts.values())
