"""Logs that were cut, flipped, or made to harm: what was written, with a list of gaps, or LogError."""

from __future__ import annotations

import io
import json
import random
import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
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
from rig.log.reader import Log, read_log
from rig.log.writer import LogWriter

Contents = dict[str, list[tuple[int, int, bytes]]]


def contents(log: Log) -> Contents:
    """Every message of the log, encoded again, so that NaN compares."""
    return {
        topic: [(m.log_ns, m.publish_ns, schema.encode(topic, m.fields)) for m in log.messages(topic)]
        for topic in log.topics
    }


def is_part_of(found: Contents, truth: Contents) -> bool:
    """Whether ``found`` is ``truth`` with messages left out, and nothing else."""
    for topic, messages in found.items():
        rest = iter(truth.get(topic, []))
        if not all(message in rest for message in messages):
            return False
    return True


def check_damaged(path: Path, whole: Log, truth: Contents) -> str:
    """Read a damaged copy of ``whole``: nothing wrong may come out, and nothing may be missing unsaid."""
    try:
        log = read_log(path)
        found = contents(log)
    except LogError:
        return "refused"
    assert is_part_of(found, truth)
    for topic, messages in truth.items():
        for name, column in log.columns(topic).items():
            assert len(column) == len(found.get(topic, [])), name
        if len(found.get(topic, [])) < len(messages):
            assert log.gaps or log.missing
    for name, attachment in log.attachments.items():
        assert whole.attachments[name] == attachment
    same = found == truth and log.attachments == whole.attachments and log.metadata == whole.metadata
    assert same or not log.whole
    return "same" if same else "less"


@pytest.fixture(scope="module")
def fixture(tmp_path_factory: pytest.TempPathFactory, write_log_module: Any) -> tuple[Path, Log, Contents]:
    path = tmp_path_factory.mktemp("log") / "small.mcap"
    write_log_module(path, 6)
    log = read_log(path)
    return path, log, contents(log)


@pytest.fixture(scope="module")
def write_log_module() -> Any:
    def write(path: Path, n: int) -> None:
        with LogWriter(path) as log:
            log.attach("scene.toml", "application/toml", b'title = "small"\n')
            for k in range(n):
                t, ns = 0.04 * k, 10**18 + 40_000_000 * k
                log.write("/force/sample", {"t_s": t, "reading": 0.1 * k, "force_N": -t, "flags": k}, ns, ns)
                log.write("/raw/force/rx", {"t_s": t, "data": bytes([k, 0xFF, 6, 0])}, ns, ns)
                if k % 2:
                    event = {"t_s": t, "severity": "info", "source": "test", "message": f"{k}"}
                    log.write("/event", event, ns, ns)
                log.tick(t)
            log.finish({"status": "complete"})

    return write


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


STEPS = [pytest.param(23, id="some"), pytest.param(1, id="all", marks=pytest.mark.slow)]


@pytest.mark.parametrize("step", STEPS)
def test_cut_anywhere(fixture, tmp_path, step):
    path, whole, truth = fixture
    content = path.read_bytes()
    copy = tmp_path / "cut.mcap"
    results = []
    for n in every(len(content), step):
        copy.write_bytes(content[:n])
        results.append(check_damaged(copy, whole, truth))
        if results[-1] != "refused":
            assert sum(read_log(copy).topics.values()) == complete_messages(content[:n])
    assert {"refused", "less"} <= set(results)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("mask", [0x01, 0x80])
def test_flip_anywhere(fixture, tmp_path, step, mask):
    path, whole, truth = fixture
    content = bytearray(path.read_bytes())
    copy = tmp_path / "flipped.mcap"
    results = []
    for at in every(len(content), step):
        content[at] ^= mask
        copy.write_bytes(content)
        content[at] ^= mask
        results.append(check_damaged(copy, whole, truth))
    assert {"same", "less"} <= set(results)
    # one flip must not cost the whole log, but for those in its first bytes
    assert results.count("refused") <= 8


def test_a_damaged_chunk_costs_only_itself(fixture, tmp_path):
    path, whole, _ = fixture
    content = bytearray(path.read_bytes())
    content[content.index(b"zstd") + 40] ^= 1
    copy = tmp_path / "a.mcap"
    copy.write_bytes(content)
    log = read_log(copy)
    assert [gap.reason for gap in log.gaps] in (
        ["a chunk that cannot be decompressed"],
        ["a chunk whose checksum does not match"],
    )
    assert log.missing == {"/force/sample": 3, "/raw/force/rx": 3, "/event": 1}
    assert {topic: whole.topics[topic] - n for topic, n in log.missing.items()} == log.topics
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


def bomb(size: int) -> bytes:
    out = io.BytesIO()
    with zstandard.ZstdCompressor(level=1).stream_writer(out, closefd=False) as stream:
        block = bytes(1024 * 1024)
        for _ in range(size // len(block)):
            stream.write(block)
    return out.getvalue()


def stock_metadata_with_evil_names() -> bytes:
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start()
    number = writer.register_schema("x", "protobuf", b"")
    channel = writer.register_channel("../../etc/passwd", "protobuf", number)
    writer.add_message(channel, 0, b"x" * 30, 0)
    writer.add_attachment(0, 0, "../../../etc/passwd", "text/plain", b"root")
    writer.add_metadata("log", {"\x1b[31m": "red"})
    writer.finish()
    return out.getvalue()


CLAIM = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + bytes(20)  # a zstd frame's head with its content size

HOSTILE: dict[str, bytes] = {
    "bomb of 1 GiB": HEAD + chunk(b"", size=2**30, data=bomb(2**30)) + GOOD,
    "bomb that declares 100 bytes": HEAD + chunk(bytes(100), data=bomb(2**30)) + GOOD,
    "frame that claims 1 TiB": HEAD + chunk(b"", size=100, data=CLAIM) + GOOD,
    "many bombs within the cap": HEAD + chunk(bytes(2**24), size=2**24) * 500 + GOOD,
    "a million empty messages": HEAD + chunk(described() + record(5, b"") * 1_000_000) + GOOD,
    "half a million short messages": HEAD + chunk(described() + message(b"") * 500_000) + GOOD,
    "messages of length 5": HEAD + chunk(described() + record(5, b"12345")) + GOOD,
    "message beyond the chunk": HEAD + chunk(described() + struct.pack("<BQ", 5, 2**40) + bytes(40)) + GOOD,
    "zero tail of 16 MiB": HEAD + GOOD + bytes(2**24),
    "opcode zero": HEAD + bytes(9) + GOOD,
    "length 2^63": HEAD + struct.pack("<BQ", 6, 2**63) + GOOD,
    "length 2^64 - 1": HEAD + struct.pack("<BQ", 9, 2**64 - 1) + GOOD,
    "inner length 2^62": HEAD + record(9, bytes(24) + struct.pack("<Q", 2**62) + bytes(9)) + GOOD,
    "unknown compression": HEAD + chunk(described() + message(FORCE), compression=b"evil") + GOOD,
    "lz4": HEAD + chunk(described() + message(FORCE), compression=b"lz4") + GOOD,
    "text that is not UTF-8": HEAD + record(0xC, text(b"\xff\xfe") + text(b"")) + GOOD,
    "channel nowhere described": HEAD + chunk(message(FORCE, channel=9)) + GOOD,
    "message outside a chunk": HEAD + described() + message(FORCE) + GOOD,
    "70000 channels": HEAD + chunk(b"".join(described() for _ in range(2)) + b"".join(
        record(4, struct.pack("<HH", k, 1) + text(b"/x%d" % k) + text(b"") + text(b"")) for k in range(60_000))) + GOOD,
    "100000 attachments": HEAD + b"".join(
        record(9, body + struct.pack("<I", zlib.crc32(body))) for body in (
            bytes(16) + text(b"%d" % k) + text(b"") + struct.pack("<Q", 0) for k in range(100_000))) + GOOD,
    "100000 broken landmarks": HEAD + b"\x06\xff\xff\xff\x00\x00\x00\x00\x00" * 200_000 + GOOD,
    "100000 damaged chunks": HEAD + chunk(b"", size=9, data=b"") * 100_000 + GOOD,
    "chunk inside chunk": HEAD + chunk(GOOD) + GOOD,
    "times beyond 2^63": HEAD + chunk(described() + record(5, struct.pack("<HIQQ", 1, 1, 2**63, 0) + FORCE)) + GOOD,
    "payload that is not a message": HEAD + chunk(described() + message(b"\xff" * 20)) + GOOD,
    "evil names": stock_metadata_with_evil_names(),
    "header only": HEAD,
    "random": MAGIC + random.Random(1).randbytes(2_000_000),
}  # fmt: skip

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


@pytest.fixture(scope="module")
def hostile_costs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Any, float, float, float]]:
    """For each file: what came of it, processor seconds, peak MiB above before, its size in MiB."""
    folder = tmp_path_factory.mktemp("hostile")
    for number, content in enumerate(HOSTILE.values()):
        (folder / f"{number:03}.mcap").write_bytes(content)
    done = subprocess.run(
        [sys.executable, "-c", READ, folder],
        capture_output=True,
        text=True,
        timeout=110,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31)),
    )
    assert done.returncode == 0, done.stderr
    costs = json.loads(done.stdout)
    return {
        name: (*costs[f"{number:03}.mcap"], len(content) / 2**20)
        for number, (name, content) in enumerate(HOSTILE.items())
    }


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile(name, hostile_costs):
    what, seconds, mebibytes, size = hostile_costs[name]
    assert seconds < 2.0 + 2.0 * size
    assert mebibytes < 64.0 + size
    if not isinstance(what, str):
        n, gaps = what
        assert gaps > 0
        if HOSTILE[name].endswith(GOOD) and name != "100000 damaged chunks":
            assert n >= 1  # the sound chunk behind the evil one is found


def test_names_from_a_log_are_data(tmp_path):
    """A foreign log may name its attachments and topics as it likes; nothing is done with the names."""
    path = tmp_path / "evil.mcap"
    path.write_bytes(HOSTILE["evil names"])
    log = read_log(path)
    assert list(log.attachments) == ["../../../etc/passwd"]
    assert log.topics == {}
    assert log.unknown == {"../../etc/passwd": 1}
