from rig.log.info import info
from rig.log.writer import LogWriter


def test_one_screen(small):
    text = info(small)
    lines = text.splitlines()
    assert lines[0].startswith(f"{small}: whole")
    assert len(lines) < 50
    (force,) = (line for line in lines if line.startswith("/force/sample"))
    assert force.split() == ["/force/sample", "20", "0", "25.00", "0.0400"]
    assert any(line.split() == ["outcome.reason", "complete"] for line in lines)
    assert any(line.split() == ["lasted", "0.760", "s"] for line in lines)
    assert any(line.split() == ["scene.toml", "16", "bytes"] for line in lines)


def test_a_log_that_was_cut_short_says_so(small, tmp_path):
    part = tmp_path / "a.mcap.part"
    part.write_bytes(small.read_bytes()[:8000])
    text = info(part)
    assert "CUT SHORT" in text
    assert "not recorded" in text
    assert "could not be read" in text


def test_a_damaged_log_says_so(small):
    content = bytearray(small.read_bytes())
    content[content.index(b"zstd") + 60] ^= 1
    small.write_bytes(content)
    text = info(small)
    assert "DAMAGED" in text
    (force,) = (line for line in text.splitlines() if line.startswith("/force/sample"))
    assert int(force.split()[2]) > 0


def test_devices_and_control_characters(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.metadata("run", {"scene": "\x1b[31mred"})
        who = {"t_s": 0.0, "device": "stage", "model": "X", "serial": "\x1b]0,owned\x07", "firmware": "7.14"}
        log.write("/identity", who, 0, 0)
        log.write("/raw/stage/rx", {"t_s": 0.0, "data": b"x"}, 0, 0)
        log.finish({})
    text = info(tmp_path / "a.mcap")
    assert "\x1b" not in text and "\x07" not in text
    assert r"model X, serial \x1b]0,owned\x07" in text
    assert "firmware 7.14" in text
