import errno
import os
import stat
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from rig.log import part_file
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.writer import LogWriter

FORCE = {"t_s": 0.0, "reading": 0.5, "force_N": 0.1, "flags": 0}


def write_force(log: LogWriter, k: int) -> None:
    log.write("/force/sample", {**FORCE, "t_s": k * 1e-3}, 1_000_000 * k, 1_000_000 * k)


def test_same_calls_same_bytes(write_log, tmp_path):
    write_log(tmp_path / "a.mcap", 20)
    write_log(tmp_path / "b.mcap", 20)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_nothing_of_the_host_in_the_file(small):
    content = small.read_bytes()
    for fact in (os.uname().nodename, str(small.parent), "mcap-python"):
        assert len(fact) < 4 or fact.encode() not in content  # shorter ones come by chance


def test_the_stock_reader_reads_it(small, samples):
    """The mcap package with its protobuf decoder, which know nothing of this project."""
    with small.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 20 * len(samples)
        seen = dict.fromkeys(samples, 0)
        for decoded in reader.iter_decoded_messages():
            topic = decoded.channel.topic
            assert decoded.message.log_time == decoded.message.publish_time + 7
            for name, value in samples[topic].items():
                assert getattr(decoded.decoded_message, name) == value
            seen[topic] += 1
        assert set(seen.values()) == {20}
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ("scene.toml", b'title = "small"\n')
        assert [record.name for record in reader.iter_metadata()] == ["log", "fields", "run", "outcome"]
    with small.open("rb") as file:
        assert list(StreamReader(file, validate_crcs=True).records)  # checks the data checksum too


def test_every_chunk_stands_alone(small):
    """Each chunk begins with the schema and the channel of all its messages."""
    with small.open("rb") as file:
        chunks = [r for r in StreamReader(file, emit_chunks=True).records if type(r).__name__ == "Chunk"]
    assert len(chunks) > 5
    for chunk in chunks:
        from mcap.stream_reader import breakup_chunk

        schemas, channels = set(), set()
        for record in breakup_chunk(chunk, validate_crc=True):
            match type(record).__name__:
                case "Schema":
                    schemas.add(record.id)
                case "Channel":
                    assert record.schema_id in schemas
                    channels.add(record.id)
                case "Message":
                    assert record.channel_id in channels


def test_only_channels_that_were_written_exist(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        write_force(log, 0)
        log.finish({})
    with path.open("rb") as file:
        assert [c.topic for c in make_reader(file).get_summary().channels.values()] == ["/force/sample"]


def test_part_until_finished(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        write_force(log, 0)
        assert not path.exists()
        assert (tmp_path / "a.mcap.part").exists()
        log.finish({"reason": "complete"})
        assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert log.kept is None
    assert read_log(path).outcome == {"reason": "complete"}


@pytest.mark.parametrize("existing", ["a.mcap", "a.mcap.part"])
def test_nothing_is_overwritten(tmp_path, existing):
    (tmp_path / existing).write_text("precious")
    with pytest.raises(LogError, match=f"{existing}: exists already"):
        LogWriter(tmp_path / "a.mcap")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {existing: "precious"}


def test_a_file_that_appears_meanwhile_is_not_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(LogError, match=r"complete in .*a\.mcap\.part"), LogWriter(path) as log:
        write_force(log, 0)
        path.write_text("precious")
        log.finish({"reason": "complete"})
    assert path.read_text() == "precious"
    assert read_log(tmp_path / "a.mcap.part").whole


def test_an_exception_keeps_what_was_recorded(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(RuntimeError) as caught, LogWriter(path) as log:
        for k in range(10):
            write_force(log, k)
        raise RuntimeError("the stage is on fire")
    part = tmp_path / "a.mcap.part"
    assert caught.value.__notes__ == [f"What was recorded is kept in {part}."]
    assert log.kept == part
    kept = read_log(part)
    assert kept.topics == {"/force/sample": 10}
    assert kept.outcome is None
    with part.open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 10


def test_a_log_without_messages_leaves_no_file(tmp_path):
    with pytest.raises(RuntimeError) as caught, LogWriter(tmp_path / "a.mcap") as log:
        log.attach("scene.toml", "application/toml", b"x")
        raise RuntimeError("no such port")
    assert list(tmp_path.iterdir()) == []
    assert not hasattr(caught.value, "__notes__")


@pytest.mark.parametrize(
    "call",
    [
        lambda log: log.write("/force/sampel", FORCE, 0, 0),
        lambda log: log.write("/force/sample", {**FORCE, "force_N": "1"}, 0, 0),
        lambda log: log.write("/force/sample", {**FORCE, "extra": 1}, 0, 0),
        lambda log: log.write("/force/sample", FORCE, -1, 0),
        lambda log: log.write("/force/sample", FORCE, 0, -1),
        lambda log: log.write("/force/sample", FORCE, 1.5, 0),
        lambda log: log.write("/force/sample", FORCE, True, 0),
        lambda log: log.write("/force/sample", FORCE, 2**63, 0),
        lambda log: log.write("/raw/force/rx", {"t_s": 0.0, "data": bytes(100_000)}, 0, 0),
        lambda log: log.attach("../../etc/passwd", "text/plain", b""),
        lambda log: log.attach(".hidden", "text/plain", b""),
        lambda log: log.attach("", "text/plain", b""),
        lambda log: log.attach("log\n", "text/plain", b""),
        lambda log: log.metadata("log", {}),
        lambda log: log.metadata("run", {"n": 3}),
        lambda log: log.finish({"duration": 3.0}),
    ],
)
def test_bad_input_is_refused_and_poisons_nothing(tmp_path, call):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        write_force(log, 0)
        with pytest.raises(LogError):
            call(log)
        write_force(log, 1)
        log.finish({"reason": "complete"})
    assert read_log(path).whole
    assert read_log(path).topics == {"/force/sample": 2}


def test_after_finish_nothing_can_be_added(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        write_force(log, 0)
        log.finish({})
        for call in (lambda: write_force(log, 1), lambda: log.finish({}), lambda: log.tick(1.0)):
            with pytest.raises(LogError, match="finished"):
                call()


def test_chunks_follow_the_clock(tmp_path):
    """With a turn of the loop every 10 ms, nothing older than 100 ms is only in memory."""
    path = tmp_path / "a.mcap"
    part = tmp_path / "a.mcap.part"
    with LogWriter(path) as log:
        for k in range(300):
            if k != 150:  # a pause of the samples
                write_force(log, 10 * k)
            log.tick(k * 0.01)
            saved = read_log(part).topics.get("/force/sample", 0)
            assert k - saved <= 10
        log.finish({})


def test_a_chunk_never_grows_beyond_what_a_reader_takes(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        for k in range(400):
            log.write("/raw/force/rx", {"t_s": 0.0, "data": os.urandom(10_000)}, k, k)
        log.finish({})  # never ticked
    with path.open("rb") as file:
        sizes = [r.uncompressed_size for r in StreamReader(file, emit_chunks=True).records if hasattr(r, "compression")]
    assert max(sizes) < 512 * 1024
    assert read_log(path).topics == {"/raw/force/rx": 400}


def full_after(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that takes ``limit`` bytes and is then full for a while; space is freed after the first failure."""
    real, state = os.write, {"left": limit, "failed": False}

    def write(fd: int, data: memoryview) -> int:
        if not stat.S_ISREG(os.fstat(fd).st_mode) or state["failed"]:
            return real(fd, data)
        if state["left"] == 0:
            state["failed"] = True
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        n = real(fd, data[: state["left"]])
        state["left"] -= n
        return n

    monkeypatch.setattr(part_file.os, "write", write)


@pytest.mark.parametrize("limit", [13_000, 13_001, 15_277, 21_500])
def test_a_full_disk_ends_the_log_for_good(tmp_path, monkeypatch, limit):
    path = tmp_path / "a.mcap"
    full_after(limit, monkeypatch)
    failures = 0
    with pytest.raises(LogError, match="No space left on device") as caught, LogWriter(path) as log:
        for k in range(5000):
            try:
                write_force(log, k)
                log.tick(k * 1e-3)
            except LogError:
                failures += 1
                if failures == 3:
                    raise
    part = tmp_path / "a.mcap.part"
    assert str(part) in caught.value.__notes__[0]
    assert part.stat().st_size <= limit
    kept = read_log(part)
    assert kept.topics["/force/sample"] > 0
    # the failure took whole records away: the only thing wrong with the file is that it has no end
    assert [(gap.start, gap.reason) for gap in kept.gaps] == [
        (part.stat().st_size, "the file ends here without its end record")
    ]
    assert kept.columns("/force/sample")["t_s"][-1] == pytest.approx((kept.topics["/force/sample"] - 1) * 1e-3)


def test_a_full_disk_at_the_start_leaves_nothing(tmp_path, monkeypatch):
    full_after(10, monkeypatch)
    with pytest.raises(LogError, match="No space left"):
        LogWriter(tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_during_a_write_leaves_no_torn_record(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    real, count = os.write, 0

    def write(fd: int, data: memoryview) -> int:
        nonlocal count
        count += 1
        if count == 8:
            real(fd, data[: len(data) // 2])
            raise KeyboardInterrupt
        return real(fd, data)

    monkeypatch.setattr(part_file.os, "write", write)
    with pytest.raises(KeyboardInterrupt), LogWriter(path) as log:
        for k in range(5000):
            write_force(log, k)
            log.tick(k * 1e-3)
    assert [gap.reason for gap in read_log(tmp_path / "a.mcap.part").gaps] == [
        "the file ends here without its end record"
    ]


@pytest.mark.parametrize("where", ["missing/a.mcap", "file/a.mcap"])
def test_a_place_that_cannot_be_written(tmp_path, where):
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot be made"):
        LogWriter(tmp_path / Path(where))
