"""Logs that were cut, flipped, or made to harm: what was written, with a list of gaps, or LogError."""

from __future__ import annotations

import functools
import io
import json
import random
import resource
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.exceptions import McapError
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from rig.log import schema
from rig.log.errors import LogError
from rig.log.export import export
from rig.log.info import info
from rig.log.reader import Log, read_log
from rig.log.recover import recover
from rig.log.writer import LogWriter

Rows = list[tuple[str, int, int, int, bytes]]  # topic, sequence number, times, payload


def rows(log: Log) -> Rows:
    """Every message of the log, bit for bit."""
    return [(message[0].topic, *message[1:]) for message in log.raw_messages() if message is not None]


def is_part_of(found: Rows, truth: Rows) -> bool:
    """Whether ``found`` is ``truth`` with messages left out, and nothing else."""
    rest = iter(truth)
    return all(message in rest for message in found)


def use(path: Path) -> None:
    """What the commands make of a log: a result, or `LogError` and no output."""
    for ending in (".mcap", ".csv", ".parquet", ".topic.csv"):
        out = path.with_name(f"out{ending}")
        try:
            if ending == ".mcap":
                assert "\x1b" not in info(path)
                recovery = recover(path, out)
                assert "\x1b" not in recovery.report
                again = read_log(out)
                assert again.ended and not again.gaps and recovery.exit_code in (0, 3)
            else:
                export(path, out, "/raw/force/rx" if "topic" in ending else None)
            out.unlink()
        except LogError:
            assert not out.exists() and not list(path.parent.glob("out*.part"))


class Reading:
    """Reads damaged copies of a log: nothing wrong may come out, and nothing may be missing unsaid."""

    def __init__(self, path: Path, copy: Path) -> None:
        self.whole = read_log(path)
        self.truth = rows(self.whole)
        self.results: list[str] = []
        self.seconds = 0.0
        self.octets = 0
        self._copy = copy

    def check(self, content: bytes) -> int:
        """Read ``content``; the number of messages that came out."""
        self._copy.write_bytes(content)
        began = time.process_time()
        try:
            log = read_log(self._copy)
        except LogError:
            log = None
        self.seconds += time.process_time() - began
        self.octets += len(content)
        if log is None:
            self.results.append("refused")
            return 0
        found = rows(log)
        assert is_part_of(found, self.truth)
        assert sum(log.topics.values()) == len(found)
        if len(found) < len(self.truth):
            assert log.gaps or log.missing
        for name, attachment in log.attachments.items():
            assert self.whole.attachments[name] == attachment
        whole = self.whole
        same = found == self.truth and log.attachments == whole.attachments and log.metadata == whole.metadata
        assert same or not log.whole
        self.results.append("same" if same else "less")
        if len(self.results) % 50 == 0:  # the same messages, decoded; and what stands on them
            use(self._copy)
            for topic in log.topics:
                payloads = [payload for of, _, _, _, payload in found if of == topic]
                assert [schema.encode(topic, m.fields) for m in log.messages(topic)] == payloads
                for column in log.columns(topic).values():
                    assert len(column) == len(payloads)
        return len(found)

    def __str__(self) -> str:
        share = self.seconds / (self.octets / 2**20)
        return f"{len(self.results)} damaged logs, {share:.2f} s of processor time per MiB"


@pytest.fixture
def reading(tmp_path: Path) -> Iterator[tuple[Reading, bytes]]:
    """Damaged copies of a log of two chunks, two kinds of instrument data, an event, an attachment."""
    path = tmp_path / "small.mcap"
    with LogWriter(path) as log:
        log.attach("scene.toml", "application/toml", b'title = "small"\n')
        for k in range(4):
            t, ns = 0.06 * k, 10**18 + 60_000_000 * k
            log.write("/force/sample", {"t_s": t, "reading": 0.1 * k, "force_N": -t, "flags": k}, ns, ns)
            log.write("/raw/force/rx", {"t_s": t, "data": bytes([k, 0xFF, 6, 0])}, ns, ns)
            log.tick(t)
        log.write("/event", {"t_s": t, "severity": "info", "source": "test", "message": "é"}, ns, ns)
        log.finish({"status": "complete"})
    found = Reading(path, tmp_path / "damaged.mcap")
    yield found, path.read_bytes()
    if found.results:
        print(found)
        assert found.seconds < 20.0 * found.octets / 2**20  # 2 s per MiB; ten times that on the slowest machine


def every(n: int, step: int) -> Iterator[int]:
    """All of ``range(n)`` in steps that differ by chance, so that no structure hides between them."""
    rng = random.Random(7)
    at = 0
    while at < n:
        yield at
        at += rng.randint(1, 2 * step - 1)


def complete_messages(content: bytes) -> int:
    """Messages in the complete chunks of a file that was cut, by the mcap package."""
    count = 0
    try:
        for item in StreamReader(io.BytesIO(content), emit_chunks=True).records:
            if isinstance(item, Chunk):
                count += sum(isinstance(inner, Message) for inner in breakup_chunk(item))
    except (McapError, struct.error):
        pass
    return count


STEPS = [
    pytest.param(23, id="some"),
    pytest.param(7, id="more", marks=pytest.mark.slow),
    pytest.param(1, id="all", marks=pytest.mark.long),
]


@pytest.mark.parametrize("step", STEPS)
def test_cut_anywhere(reading, step):
    read, content = reading
    for n in every(len(content), step):
        found = read.check(content[:n])
        assert read.results[-1] == "refused" or found == complete_messages(content[:n])
    assert {"refused", "less"} <= set(read.results)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("mask", [0x01, 0x80])
def test_flip_anywhere(reading, step, mask):
    read, content = reading
    flipped = bytearray(content)
    for at in every(len(content), step):
        flipped[at] ^= mask
        read.check(bytes(flipped))
        flipped[at] ^= mask
    assert {"same", "less"} <= set(read.results)
    # one flip must not cost the whole log, but for those in its first bytes
    assert read.results.count("refused") <= 8


def test_a_damaged_chunk_costs_only_itself(reading, tmp_path):
    read, good = reading
    content = bytearray(good)
    content[content.index(b"zstd") + 40] ^= 1
    copy = tmp_path / "a.mcap"
    copy.write_bytes(content)
    log = read_log(copy)
    assert [gap.reason for gap in log.gaps] in (
        ["a chunk that cannot be decompressed"],
        ["a chunk whose checksum does not match"],
    )
    assert log.missing == {"/force/sample": 3, "/raw/force/rx": 3}
    assert {topic: read.whole.topics[topic] - log.missing.get(topic, 0) for topic in log.topics} == log.topics
    assert log.outcome == {"status": "complete"}


# Files made to harm. Each must be read or refused within 2 s and 64 MiB above its size.


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def chunk(content: bytes, *, size: int | None = None, compression: bytes = b"zstd", data: bytes | None = None) -> bytes:
    if data is None:
        data = zstandard.compress(content) if compression == b"zstd" else content
    size = len(content) if size is None else size
    head = struct.pack("<QQQI", 0, 0, size, zlib.crc32(content)) + text(compression)
    return record(6, head + struct.pack("<Q", len(data)) + data)


def described(topic: str = "/force/sample") -> bytes:
    name, data = schema.schema_name(topic).encode(), schema.schema_data(topic)
    return record(3, struct.pack("<H", 1) + text(name) + text(b"protobuf") + text(data)) + record(
        4, struct.pack("<HH", 1, 1) + text(topic.encode()) + text(b"protobuf") + text(b"")
    )


def message(payload: bytes, sequence: int = 1, channel: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, sequence, 1, 1) + payload)


MAGIC = b"\x89MCAP0\r\n"
HEAD = MAGIC + record(1, text(b"") + text(b"evil"))
FORCE = schema.encode("/force/sample", {"t_s": 0.0, "reading": 0.0, "force_N": 1.0, "flags": 0})
GOOD = chunk(described() + message(FORCE))


@functools.cache
def bomb(size: int, of: bytes = bytes(1)) -> bytes:
    """A zstd frame of ``size`` bytes that repeat ``of``; one byte as blocks of repetition, which costs no time."""
    if len(of) == 1:
        most = 1 << 17
        blocks = [struct.pack("<I", most << 3 | 1 << 1)[:3] + of] * (size // most - 1)
        last = struct.pack("<I", most << 3 | 1 << 1 | 1)[:3] + of
        return b"\x28\xb5\x2f\xfd\x00\x50" + b"".join(blocks) + last
    out = io.BytesIO()
    with zstandard.ZstdCompressor(level=1).stream_writer(out, closefd=False) as stream:
        block = of * (1024 * 1024 // len(of))
        for _ in range(size // len(block)):
            stream.write(block)
    return out.getvalue()


def stock_metadata_with_evil_names() -> bytes:
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start()
    number = writer.register_schema("x", "protobuf", b"")
    channel = writer.register_channel("../../etc/\x1b[31mpasswd", "protobuf", number)
    writer.add_message(channel, 0, b"x" * 30, 0)
    writer.add_attachment(0, 0, "../../../etc/passwd", "text/plain", b"root")
    writer.add_metadata("log", {"schema_version": str(schema.SCHEMA_VERSION), "\x1b[31m": "red"})
    writer.finish()
    return out.getvalue()


CLAIM = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + bytes(20)  # a zstd frame's head with its content size

# Made only when a test asks: all of them take seconds and 100 MB.
HOSTILE: dict[str, Callable[[], bytes]] = {
    "bomb of 1 GiB": lambda: HEAD + chunk(b"", size=2**30, data=bomb(2**30)) + GOOD,
    "bomb that declares 100 bytes": lambda: HEAD + chunk(bytes(100), data=bomb(2**30)) + GOOD,
    "frame that claims 1 TiB": lambda: HEAD + chunk(b"", size=100, data=CLAIM) + GOOD,
    "many bombs within the cap": lambda: HEAD + chunk(bytes(2**24), size=2**24) * 500 + GOOD,
    "a million empty messages": lambda: HEAD + chunk(described() + record(5, b"") * 1_000_000) + GOOD,
    "half a million short messages": lambda: HEAD + chunk(described() + message(b"") * 500_000) + GOOD,
    "messages of length 5": lambda: HEAD + chunk(described() + record(5, b"12345")) + GOOD,
    "message beyond the chunk": lambda: HEAD + chunk(described() + struct.pack("<BQ", 5, 2**40) + bytes(40)) + GOOD,
    "zero tail of 16 MiB": lambda: HEAD + GOOD + bytes(2**24),
    "opcode zero": lambda: HEAD + bytes(9) + GOOD,
    "length 2^63": lambda: HEAD + struct.pack("<BQ", 6, 2**63) + GOOD,
    "length 2^64 - 1": lambda: HEAD + struct.pack("<BQ", 9, 2**64 - 1) + GOOD,
    "inner length 2^62": lambda: HEAD + record(9, bytes(24) + struct.pack("<Q", 2**62) + bytes(9)) + GOOD,
    "unknown compression": lambda: HEAD + chunk(described() + message(FORCE), compression=b"evil") + GOOD,
    "lz4": lambda: HEAD + chunk(described() + message(FORCE), compression=b"lz4") + GOOD,
    "text that is not UTF-8": lambda: HEAD + record(0xC, text(b"\xff\xfe") + text(b"")) + GOOD,
    "channel nowhere described": lambda: HEAD + chunk(message(FORCE, channel=9)) + GOOD,
    "message outside a chunk": lambda: HEAD + described() + message(FORCE) + GOOD,
    "70000 channels": lambda: HEAD + chunk(b"".join(described() for _ in range(2)) + b"".join(
        record(4, struct.pack("<HH", k, 1) + text(b"/x%d" % k) + text(b"") + text(b"")) for k in range(60_000))) + GOOD,
    "100000 attachments": lambda: HEAD + b"".join(
        record(9, body + struct.pack("<I", zlib.crc32(body))) for body in (
            bytes(16) + text(b"%d" % k) + text(b"") + struct.pack("<Q", 0) for k in range(100_000))) + GOOD,
    "100000 broken landmarks": lambda: HEAD + b"\x06\xff\xff\xff\x00\x00\x00\x00\x00" * 200_000 + GOOD,
    "100000 damaged chunks": lambda: HEAD + chunk(b"", size=9, data=b"") * 100_000 + GOOD,
    "chunk inside chunk": lambda: HEAD + chunk(GOOD) + GOOD,
    "times beyond 2^63": lambda: HEAD + chunk(
        described() + record(5, struct.pack("<HIQQ", 1, 1, 2**63, 0) + FORCE)) + GOOD,
    "payload that is not a message": lambda: HEAD + chunk(described() + message(b"\xff" * 20)) + GOOD,
    "evil names": stock_metadata_with_evil_names,
    "header only": lambda: HEAD,
    "8 million one-byte messages": lambda: HEAD + chunk(b"", size=2**28, data=bomb(2**28, message(b"x"))) + GOOD,
    "2000 indexes of one large chunk": lambda: HEAD + chunk(b"", size=2**28, data=bomb(2**28)) + GOOD
    + record(15, bytes(4))
    + record(8, struct.pack("<QQQQ", 0, 0, len(HEAD), 2**20) + bytes(4 + 8) + text(b"zstd") + bytes(16)) * 2000
    + record(2, bytes(20)) + MAGIC,
    "footer that points to 2^63": lambda: HEAD + GOOD + record(15, bytes(4))
    + record(2, struct.pack("<QQI", 2**63, 2**63, 0)) + MAGIC,
    "magic only": lambda: MAGIC,
    "empty": lambda: b"",
    "random": lambda: MAGIC + random.Random(1).randbytes(2_000_000),
}  # fmt: skip
LARGE = {"zero tail of 16 MiB", "100000 attachments", "100000 broken landmarks", "100000 damaged chunks", "random"}
TAKE_SECONDS = {"100000 attachments", "100000 broken landmarks", "100000 damaged chunks"}


@functools.cache
def made(name: str) -> bytes:
    return HOSTILE[name]()


READ = """
import json, sys, time
from pathlib import Path
from rig.log import schema
from rig.log.errors import LogError
from rig.log.reader import read_log


def peak_mib():
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


schema.encode("/command", {"t_s": 0.0, "device": "", "command": "", "argument": ""})  # load protobuf
costs = {}
for path in sorted(Path(sys.argv[1]).iterdir()):
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before, began = peak_mib(), time.process_time()
    try:
        log = read_log(path)
        what = [sum(1 for topic in log.topics for _ in log.messages(topic)), len(log.gaps)]
    except LogError as error:
        what = str(error)
    costs[path.name] = [what, time.process_time() - began, peak_mib() - before]
print(json.dumps(costs))
"""


Cost = tuple[Any, float, float, float]  # what came of it, processor seconds, peak MiB above before, size in MiB
GROUPS = [[name for name in HOSTILE if (name in TAKE_SECONDS) is slow] for slow in (False, True)]


def slow_if(slow: bool) -> Any:
    return (pytest.mark.slow,) if slow else ()


@pytest.fixture(scope="module")
def hostile_cost(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Cost]:
    """``hostile_cost(name)`` of a file, which is read in one process with all that take about as long."""
    quick, lengthy = (functools.cache(lambda of=of: costs(tmp_path_factory.mktemp("hostile"), of)) for of in GROUPS)
    return lambda name: (lengthy if name in TAKE_SECONDS else quick)()[name]


def costs(folder: Path, names: list[str]) -> dict[str, Cost]:
    sizes = {}
    for number, name in enumerate(names):
        sizes[name] = (folder / f"{number:03}.mcap").write_bytes(made(name)) / 2**20
    assert {name for name, size in sizes.items() if size >= 1.0} == LARGE & set(names)
    done = subprocess.run(
        [sys.executable, "-c", READ, folder],
        capture_output=True,
        text=True,
        timeout=110,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31)),
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return {name: (*found[f"{number:03}.mcap"], sizes[name]) for number, name in enumerate(names)}


@pytest.mark.parametrize("name", [pytest.param(name, marks=slow_if(name in TAKE_SECONDS)) for name in HOSTILE])
def test_hostile(name, hostile_cost):
    what, seconds, mebibytes, size = hostile_cost(name)
    assert seconds < 2.0 + 2.0 * size
    assert mebibytes < 64.0 + size
    if not isinstance(what, str):
        n, gaps = what
        assert gaps > 0
        if made(name).endswith(GOOD) and name != "100000 damaged chunks":
            assert n >= 1  # the sound chunk behind the evil one is found


MANY = {"a million empty messages", "half a million short messages"}  # the reader's own test has them too


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=slow_if(name in MANY)) for name in HOSTILE if name not in LARGE]
)
def test_commands_on_hostile_logs(name, tmp_path):
    path = tmp_path / "evil.mcap"
    path.write_bytes(made(name))
    use(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evil.mcap"]


def test_names_from_a_log_are_data(tmp_path):
    """A foreign log may name its attachments and topics as it likes; nothing is done with the names."""
    path = tmp_path / "evil.mcap"
    path.write_bytes(made("evil names"))
    log = read_log(path)
    assert list(log.attachments) == ["../../../etc/passwd"]
    assert log.topics == {}
    assert log.unknown == {"../../etc/\x1b[31mpasswd": 1}
