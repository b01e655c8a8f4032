"""The recorded bytes through today's drivers: every sample that comes out must be the recorded one, bit for bit.

A driver knows the world by the bytes that it reads, the time of each poll, and the commands that it is given. All
three are in the log, in the order in which they happened, so that a driver fed with them gives the same samples again.
Its requests must be the recorded ones too: an answer means nothing without its question.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn, cast

from drivers.instrument import MONITORS
from drivers.links.link import DeviceError
from drivers.roles import GivesBack, HVSupply, OwnTrip, Renewed, Stage
from drivers.settings import CanSettings
from rig.bench.bench import Bench
from rig.bench.opening import open_memory
from rig.log import schema
from rig.log.recorder import Recorder
from rig.protocol.experiment import gains_of
from rig.replay.recording import Recording, Row, counted_device, numbers
from rig.scene.scene import Scene
from rig.sim.wire import ByteWire, Frame, FrameWire, WireGone

if TYPE_CHECKING:
    from rig.log.writer import LogWriter

SAMPLES = {f"/{role}/sample": role for role in schema.ROLES}
MOST_BYTES = 64  # of a stream, in a report
# The supply's bytes and commands are written by the process that guards it, its samples and events by the engine: their
# order in the log is not that in which they happened. Supplies say nothing in closing.
GUARDED = "hv"
LATE_S = 1.0  # a sample may stand this far from its bytes


@dataclass(frozen=True)
class Difference:
    """Where today's drivers first depart from the log.

    Attributes
    ----------
    role, kind : str
        Whose; "sample", "request", or "poll" when the driver fails altogether.
    t : float
        Time of the poll (s).
    step : str
        What the protocol was doing.
    offset : int
        Where in all that the instrument sent the bytes begin that came since its last sample; a CAN frame counts as
        the log has it, with two bytes for its identifier.
    data : bytes
        Those bytes.
    recorded, decoded : str
        What the log has, and what comes out today.
    """

    role: str
    kind: str
    t: float
    step: str
    offset: int
    data: bytes
    recorded: str
    decoded: str

    def __str__(self) -> str:
        end = self.offset + len(self.data)
        more = " ..." if len(self.data) > MOST_BYTES else ""
        return (
            f"{self.role}: the first {self.kind} that differs is at {self.t:.6f} s, in {self.step}, "
            f"from bytes {self.offset} to {end} of what the instrument sent\n"
            f"  bytes     {self.data[:MOST_BYTES].hex(' ') or '(none)'}{more}\n"
            f"  recorded  {self.recorded}\n"
            f"  today     {self.decoded}"
        )


@dataclass(frozen=True)
class Verification:
    """``samples`` and ``requests`` were equal, by role; ``difference`` is None when all of them were."""

    recording: Recording
    samples: dict[str, int]
    requests: dict[str, int]
    until: float
    difference: Difference | None

    @property
    def exit_code(self) -> int:
        """0 all equal; 3 equal as far as the log is whole; 1 different."""
        return 1 if self.difference is not None else 3 if self.recording.problem else 0

    @property
    def report(self) -> str:
        counts = ", ".join(f"{role} {n}" for role, n in self.samples.items())
        path = self.recording.log.path
        if self.difference is not None:
            return f"{path}: DIFFERENT. {self.difference}\nEqual before that: samples of {counts}."
        requests = sum(self.requests.values())
        text = f"{path}: every sample comes out as recorded, bit for bit: {counts}; so do {requests} requests."
        if self.recording.problem:
            text += f"\nVerified up to {self.until:.3f} s, no further: {self.recording.problem}."
        return text


def verify(recording: Recording) -> Verification:
    """Feed what was recorded to today's drivers and compare."""
    return _Verifier(recording).run()


class _Fed:
    """Gives what it is fed, keeps what is sent, and is gone when it was.

    ``takes``: how many requests of the coming poll pass before the link is found gone; None where it is not.
    """

    gone: bool

    def __init__(self) -> None:
        super().__init__()
        self.arrived: list[bytes] = []
        self.sent: list[bytes] = []
        self.takes: int | None = None

    def _read(self) -> list[bytes]:
        if self.gone:
            raise WireGone
        data, self.arrived = self.arrived, []
        return data

    def _keep(self, data: bytes) -> None:
        self.sent.append(data)
        if self.takes is not None and len(self.sent) > self.takes:
            self.gone, self.takes = True, None
        if self.gone:
            raise WireGone


class _FedByteWire(_Fed, ByteWire):
    """Bytes, as they were read and sent."""

    def host_read(self, t: float) -> bytes:
        return b"".join(self._read())

    def host_write(self, data: bytes, t: float) -> None:
        self._keep(data)


class _FedFrameWire(_Fed, FrameWire):
    """The same for frames, each as the log has it."""

    def host_read(self, t: float) -> list[Frame]:
        return [(int.from_bytes(row[:2], "big"), row[2:]) for row in self._read()]

    def host_write(self, frame: Frame, t: float) -> None:
        self._keep(frame[0].to_bytes(2, "big") + frame[1])


class _Desk:
    """A bench with nothing on its wires but what is fed."""

    def __init__(self, scene: Scene) -> None:
        self.wires = {
            role: _FedFrameWire() if isinstance(table, CanSettings) else _FedByteWire()
            for role, table in scene.instruments.items()
        }

    def wire(self, role: str) -> ByteWire | FrameWire:
        return self.wires[role]

    def advance(self, t: float) -> None:
        """Nothing happens by itself."""


class _Rows:
    """Takes the place of a log: the newest row that a recorder wrote."""

    def __init__(self) -> None:
        self.newest: tuple[str, bytes] = ("", b"")

    def write(self, topic: str, fields: dict[str, Any], log_ns: int, publish_ns: int) -> None:
        self.newest = topic, schema.encode(topic, fields)


@dataclass
class _Stream:
    """What is known of one instrument while the log is gone through.

    ``arrived``, ``sent``, ``back`` and ``gone`` (its link), and ``failed`` belong to the poll in the making, at ``t``.
    ``since`` is what arrived since the last sample, from ``offset`` on; it begins anew with the next poll after a
    sample (``fresh``).
    """

    t: float = math.nan
    arrived: list[bytes] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    back: bool = False
    gone: bool = False
    failed: bool = False
    decoded: deque[bytes] = field(default_factory=deque)
    recorded: deque[Row] = field(default_factory=deque)
    since: bytearray = field(default_factory=bytearray)
    offset: int = 0
    fresh: bool = True
    error: str = ""
    counted: bool = False
    samples: int = 0
    requests: int = 0


class _Different(Exception):
    def __init__(self, difference: Difference) -> None:
        self.difference = difference


class _Verifier:
    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        scene = recording.experiment.scene
        self._desk = _Desk(scene)
        self._bench = Bench(scene, open_memory(scene, self._desk))
        self._rows = _Rows()
        self._recorder = Recorder(
            cast("LogWriter", self._rows),
            self._bench.clock,
            gains_of(recording.experiment.certificates),
            has_laser=scene.displacement is not None,
        )
        self._streams = {role: _Stream() for role in scene.instruments}
        self._commands = commands(self._bench)
        self._until = 0.0

    def run(self) -> Verification:
        self._bench.attach(lambda role, way, data, t: None)
        difference = None
        try:
            for row in self._recording.rows:
                self._take(row)
            for role in self._streams:
                self._end(role)
        except _Different as found:
            difference = found.difference
        return Verification(
            self._recording,
            {role: stream.samples for role, stream in self._streams.items()},
            {role: stream.requests for role, stream in self._streams.items()},
            self._until,
            difference,
        )

    def _take(self, row: Row) -> None:
        self._until = max(self._until, row.t)
        device = counted_device(row.topic, row.fields)
        if device in self._streams and device != GUARDED:  # what comes after that is said in closing
            self._poll(device)
            self._streams[device].counted = True
        match row.topic.split("/")[1:]:
            case ["raw", role, way] if role in self._streams:
                self._on_wire(role, way, row.t, row.fields["data"])
            case [role, "sample"] if role in self._streams:
                if role != GUARDED:
                    self._poll(role)
                self._streams[role].recorded.append(row)
                self._compare(role)
            case ["command"] if _commanded(row) in self._streams:
                self._poll(_commanded(row))
                self._command(row.fields)
            case ["event"] if row.fields["source"] in self._streams and row.fields["source"] != GUARDED:
                self._poll(row.fields["source"])
            case ["reference"]:
                self._reference(row.fields["name"], row.fields["value"])

    def _on_wire(self, role: str, way: str, t: float, data: bytes) -> None:
        """Everything read in a poll was read before anything was sent in it."""
        stream = self._streams[role]
        over = stream.failed or t != stream.t or (way in ("rx", "back") and stream.sent)
        if over and not stream.counted:
            self._poll(role)
        stream.t = t
        match way:
            case "rx":
                stream.arrived.append(data)
            case "tx":
                stream.sent.append(data)
            case "back":
                stream.back = True
            case "gone":
                stream.gone = True
            case "failed":
                stream.failed = True

    def _poll(self, role: str) -> None:
        """Let today's driver do what was done in the poll that has been gathered."""
        stream = self._streams[role]
        if not (stream.arrived or stream.sent or stream.back or stream.gone or stream.failed):
            return
        wire = self._desk.wires[role]
        self._arrive(stream)
        wire.arrived, stream.arrived = stream.arrived, []
        wire.gone = wire.gone and not stream.back
        if stream.gone:  # found so by the last request, or else by reading
            wire.gone, wire.takes = not stream.sent, len(stream.sent) - 1 if stream.sent else None
        failed, stream.back, stream.gone, stream.failed = stream.failed, False, False, False
        device = self._bench.devices[role]
        if isinstance(device, Renewed):  # the guard called it all the time
            device.renew()
        while True:
            try:
                samples = device.poll(stream.t)
                break
            except DeviceError as error:
                # The recorded poll ended with it. An older log does not say so: there, a poll that left no trace had
                # raised it if more was asked.
                if failed or wire.sent == stream.sent or str(error) == stream.error:
                    samples = []
                    break
                stream.error = str(error)
            except Exception as error:  # a broken codec may fail in any way
                raise self._different(role, "poll", "it went on", f"the driver fails: {error!r}") from error
        for sample in samples:
            self._recorder.add(sample)
            stream.decoded.append(self._rows.newest[1])
        self._compare_requests(role)
        self._compare(role)

    def _arrive(self, stream: _Stream) -> None:
        if stream.fresh:
            stream.offset += len(stream.since)
            stream.since.clear()
            stream.fresh = False
        for data in stream.arrived:
            stream.since += data

    def _compare_requests(self, role: str) -> None:
        stream, wire = self._streams[role], self._desk.wires[role]
        recorded, stream.sent = stream.sent, []
        sent, wire.sent = wire.sent, []
        if sent != recorded:
            first = next(n for n in range(len(sent) + 1) if sent[n : n + 1] != recorded[n : n + 1])
            why = f" (the driver says: {stream.error})" if stream.error else ""
            raise self._different(role, "request", _hex(recorded[first:]), _hex(sent[first:]) + why)
        stream.requests += len(sent)

    def _compare(self, role: str) -> None:
        """Hold what was decoded against what was recorded, as far as there is both."""
        stream = self._streams[role]
        while stream.decoded and stream.recorded:
            decoded, row = stream.decoded.popleft(), stream.recorded.popleft()
            recorded = _in_words(row.topic, row.payload)
            if decoded != row.payload:
                raise self._different(role, "sample", recorded, _in_words(row.topic, decoded))
            stream.samples += 1
            stream.fresh = True
        if stream.recorded and stream.t - stream.recorded[0].t > LATE_S:
            self._miss(role)

    def _miss(self, role: str) -> NoReturn:
        stream = self._streams[role]
        why = f": the driver says: {stream.error}" if stream.error else ""
        row = stream.recorded[0]
        raise self._different(role, "sample", _in_words(row.topic, row.payload), f"no sample{why}")

    def _command(self, fields: dict[str, Any]) -> None:
        command = self._commands.get((fields["device"], fields["command"]))
        if command is None:
            return
        try:
            command(numbers(fields["argument"]))
        except DeviceError as error:
            self._streams[fields["device"].removesuffix(schema.SETTINGS)].error = str(error)

    def _reference(self, name: str, value: float) -> None:
        match name:
            case "force_zero":
                self._recorder.force_zero = value
            case "displacement_zero":
                self._recorder.displacement_zero = value

    def _end(self, role: str) -> None:
        stream = self._streams[role]
        if stream.counted and self._recording.log.outcome is not None:
            self._bench.devices[role].close()
            self._compare_requests(role)
        else:
            self._poll(role)
        # The guard writes what it measures after the engine's end; of a monitor no bytes then.
        if stream.recorded and not ((role == GUARDED or role in MONITORS) and self._recording.problem):
            self._miss(role)
        # A guard in a process of its own polls on after the engine has taken its last sample.
        if stream.decoded and not self._recording.problem and (role != GUARDED or self._recording.in_virtual_time):
            topic = next(topic for topic, of in SAMPLES.items() if of == role)
            raise self._different(role, "sample", "no sample", _in_words(topic, stream.decoded[0]))

    def _different(self, role: str, kind: str, recorded: str, decoded: str) -> _Different:
        stream = self._streams[role]
        step = self._recording.step_at(stream.t)
        return _Different(Difference(role, kind, stream.t, step, stream.offset, bytes(stream.since), recorded, decoded))


def commands(bench: Bench) -> dict[tuple[str, str], Callable[[Sequence[float]], None]]:
    """What the commands of a log mean, by device and word."""

    def arm(values: Sequence[float]) -> None:
        supply().set_ramp(values[0])
        if len(values) > 1:
            supply().set_current_limit(values[1])
        if len(values) > 2:
            cast(OwnTrip, supply()).arm_trip(values[2], values[1])

    def take_down(values: Sequence[float]) -> None:
        supply().set_ramp(values[0])
        supply().switch_off()

    def supply() -> HVSupply:
        assert bench.hv is not None
        return bench.hv

    def stage() -> Stage:
        return bench.stage

    def lender(role: str) -> GivesBack:
        return cast(GivesBack, bench.devices[role])

    def resume_found(role: str, values: Sequence[float]) -> None:
        lender(role).resume_found(dict(zip(lender(role).found, values, strict=True)))

    def give_back(role: str, values: Sequence[float]) -> None:
        lender(role).give_back()

    lent = [role for role in bench.scene.instruments if role != GUARDED]
    return {
        ("stage", "home"): lambda values: stage().home(),
        ("stage", "move_to"): lambda values: stage().move_to(values[0], values[1]),
        ("stage", "stop"): lambda values: stage().stop(),
        **{(role, "resume_found"): partial(resume_found, role) for role in lent},
        **{(role, "give_back"): partial(give_back, role) for role in lent},
        ("hv", "arm"): arm,
        ("hv", "take_down"): take_down,
        ("hv", "clear"): lambda values: supply().clear(),
        ("hv", "set_voltage"): lambda values: supply().set_voltage(values[0]),
        ("hv", "switch_on"): lambda values: supply().switch_on(),
        ("hv", "switch_off"): lambda values: supply().switch_off(),
        ("hv.settings", "give_back"): lambda values: cast(GivesBack, supply()).give_back(),
        ("hv", "emergency_off"): lambda values: supply().emergency_off(),
    }


def _commanded(row: Row) -> str:
    return str(row.fields["device"]).removesuffix(schema.SETTINGS)


def _in_words(topic: str, payload: bytes) -> str:
    return ", ".join(f"{name} {value!r}" for name, value in schema.decode(topic, payload).items())


def _hex(messages: Sequence[bytes]) -> str:
    return messages[0].hex(" ") if messages else "no request"
