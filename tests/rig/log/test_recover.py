import shutil
import subprocess
from pathlib import Path

import pytest
from mcap.reader import make_reader

from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.recover import recover


def test_a_whole_log_loses_nothing(small, tmp_path):
    out = tmp_path / "out.mcap"
    result = recover(small, out)
    assert result.exit_code == 0
    assert "Nothing is missing" in result.report
    before, after = read_log(small), read_log(out)
    assert after.whole
    for topic in before.topics:
        assert list(after.messages(topic)) == list(before.messages(topic))
    assert after.attachments == before.attachments
    assert after.outcome == before.outcome
    assert after.metadata["recovered"]["from"] == "small.mcap"


@pytest.mark.parametrize("which", [0, 1, -1], ids=["first", "second", "last"])
def test_a_bad_chunk_is_skipped_and_stays_visible(small, tmp_path, which):
    content = bytearray(small.read_bytes())
    places = []
    at = content.find(b"\x04\0\0\0zstd")
    while at >= 0 and content[at - 37] == 6:
        places.append(at)
        at = content.find(b"\x04\0\0\0zstd", at + 1)
    content[places[which] + 30] ^= 0x10
    small.write_bytes(content)
    damaged = read_log(small)
    out = tmp_path / "out.mcap"
    result = recover(small, out)
    assert result.exit_code == 3
    assert "messages missing" in result.report or which == -1
    recovered = read_log(out)
    assert recovered.ended and recovered.gaps == ()
    assert recovered.topics == damaged.topics
    assert recovered.missing == damaged.missing  # what is lost is still known to be lost
    with out.open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == sum(recovered.topics.values())


def test_a_log_that_was_cut_short(small, tmp_path):
    content = small.read_bytes()
    part = tmp_path / "run.mcap.part"
    part.write_bytes(content[: len(content) // 2])
    result = recover(part, tmp_path / "out.mcap")
    assert result.exit_code == 3
    assert "Why and how the run ended is not in the log" in result.report
    recovered = read_log(tmp_path / "out.mcap")
    assert recovered.outcome is None
    assert recovered.topics == read_log(part).topics
    again = recover(tmp_path / "out.mcap", tmp_path / "again.mcap")
    assert "recovered-again" in read_log(tmp_path / "again.mcap").metadata
    assert again.exit_code == 3  # the end of the run is still missing


def test_nothing_to_recover(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(5000))
    with pytest.raises(LogError):
        recover(tmp_path / "a.mcap", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_nothing_is_overwritten(small, tmp_path):
    (tmp_path / "out.mcap").write_text("precious")
    with pytest.raises(LogError, match="exists already"):
        recover(small, tmp_path / "out.mcap")
    with pytest.raises(LogError, match="exists already"):
        recover(small, small)
    assert (tmp_path / "out.mcap").read_text() == "precious"


def test_rerun_accepts_what_is_written_and_what_is_recovered(small, tmp_path):
    import rerun_cli

    part = tmp_path / "cut.mcap.part"
    part.write_bytes(small.read_bytes()[:-3000])
    recover(part, tmp_path / "cut.mcap")
    shutil.copy(small, tmp_path / "whole.mcap")
    binary = Path(rerun_cli.__file__).with_name("rerun")
    for name in ("whole.mcap", "cut.mcap"):
        command = [binary, "mcap", "check", "--full", tmp_path / name]
        done = subprocess.run(command, capture_output=True, text=True, env={"CI": "1", "HOME": str(tmp_path)})
        assert done.returncode == 0, done.stderr
        assert "error" not in done.stdout.lower()
        assert done.stdout.count("ok ") >= 10  # a line for every topic
