import json
import math
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from rig.base.errors import ConfigError, RigError
from rig.cli.app import main
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.writer import LogWriter
from rig.view import recording as view_module
from rig.view import viewer as viewer_module
from rig.view.live import stream
from rig.view.viewer import view

HAS_DRIVER = any(
    Path(folder).is_dir() and any(Path(folder).glob("*.json"))
    for folder in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
)


SCENES = Path(__file__).resolve().parents[3] / "sim_fixtures" / "scenes"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two ramps, at 0 V and at 1000 V, and an event with a control character in it."""
    path = tmp_path / "run.mcap"
    with LogWriter(path) as writer:

        def write(topic: str, t: float, **fields: object) -> None:
            writer.write(topic, {"t_s": t, **fields}, round(t * 1e9), round(t * 1e9))

        writer.attach("scene.toml", "application/toml", (SCENES / "cone-4mm.toml").read_bytes())
        writer.metadata("run", {"scene": "two ramps"})
        write("/event", 0.0, severity="warning", source="force", message="red \x1b[31m alert")
        for k in range(400):
            t = k / 100
            if k % 100 == 0:
                v, direction = 1000.0 * (k >= 200), -1 if k % 200 else 1
                write("/phase", t, step=1 + k // 200, kind="sweep", label="up", cycle=0, direction=direction,
                      voltage_V=v, record=True)  # fmt: skip
            h = 1e-3 * (1.0 - abs(1.0 - t % 2.0))
            write("/force/sample", t, reading=h, force_N=20 * h, flags=0)
            write("/displacement/sample", t, reading_m=h, displacement_m=h, flags=0)
            if k % 10 == 0:
                write("/hv/sample", t, voltage_V=v, current_A=0.0, setpoint_V=v, flags=1)
        writer.finish({"status": "complete"})
    return path


def rerun_binary() -> str:
    import rerun_cli

    return str(Path(rerun_cli.__file__).with_name("rerun"))


@pytest.mark.slow
def test_a_saved_recording_holds_the_log(log, tmp_path):
    """Judged by Rerun's own checker and reader."""
    saved = tmp_path / "run.rrd"
    view(log, save=saved)
    checked = subprocess.run([rerun_binary(), "rrd", "verify", saved], capture_output=True, text=True, env={"CI": "1"})
    assert checked.returncode == 0, checked.stderr

    from rerun.chunk import RrdReader

    forces, entities = [], set()
    for chunk in RrdReader(str(saved)).stream():
        entities.add(chunk.entity_path)
        if chunk.entity_path == "/force" and not chunk.is_static:
            forces += [value[0] for value in chunk.to_record_batch().column("Scalars:scalars").to_pylist()]
    np.testing.assert_array_equal(forces, read_log(log).columns("/force/sample")["force_N"])
    assert {
        "/force",
        "/displacement",
        "/voltage/measured",
        "/voltage/asked",
        "/phases/step",
        "/phases/direction",
        "/phases/voltage",
        "/loop/0_V",
        "/loop/1000_V",
        "/loop/now",
        "/film/surface",
        "/events",
        "/about",
    } <= entities
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.rrd"]


def test_without_hv_there_is_no_voltage(tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path) as writer:
        for k in range(10):
            fields = {"t_s": k / 10, "reading": 0.0, "force_N": 0.1 * k, "flags": 0}
            writer.write("/force/sample", fields, k, k)
            laser = {"t_s": k / 10, "reading_m": 0.0, "displacement_m": 1e-4 * k, "flags": 0}
            writer.write("/displacement/sample", laser, k, k)
        writer.attach("scene.toml", "application/toml", (SCENES / "no-hv.toml").read_bytes())
        writer.finish({})
    view(path, save=tmp_path / "run.rrd")

    from rerun.chunk import RrdReader

    entities = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "run.rrd")).stream()}
    assert {"/film/surface", "/force", "/displacement"} <= entities
    assert not any("voltage" in entity for entity in entities)


def test_a_log_that_grows_is_streamed_as_it_comes(tmp_path):
    """Judged by Rerun's own reader, after the stream has been closed in the midst of the run."""
    import rerun as rr
    from rerun.chunk import RrdReader

    path, kept = tmp_path / "run.mcap", tmp_path / "kept.rrd"

    def write(writer, first, last):
        for k in range(first, last):
            fields = {"t_s": k / 10, "reading": 0.0, "force_N": 0.1 * k, "flags": 0}
            writer.write("/force/sample", fields, round(k * 1e8), round(k * 1e8))
        writer.tick(last / 10 + 1.0)  # what is older than a moment goes into the file
        writer.tick(last / 10 + 2.0)

    with LogWriter(path) as writer:
        write(writer, 0, 20)
        looks = iter(range(4))

        def goes_on():
            look = next(looks, None)
            if look == 2:
                write(writer, 20, 50)
            return look is not None

        recording = rr.RecordingStream("dea_rig")
        recording.save(kept)
        stream(path, recording, goes_on)
        recording.disconnect()
        writer.finish({})
    forces = []
    for chunk in RrdReader(str(kept)).stream():
        if chunk.entity_path == "/force" and not chunk.is_static:
            forces += [value[0] for value in chunk.to_record_batch().column("Scalars:scalars").to_pylist()]
    np.testing.assert_allclose(forces, 0.1 * np.arange(50))


@pytest.mark.slow
def test_a_viewer_that_follows_is_given_the_log(log, tmp_path):
    """Through the viewer's own server, which keeps what it was sent; without a window."""
    kept = tmp_path / "kept.rrd"
    with viewer_module.following(log, tmp_path, "--save", str(kept)) as (viewer, _):
        end = time.monotonic() + 60.0
        while not (kept.exists() and kept.stat().st_size > 10_000):
            assert viewer.poll() is None and time.monotonic() < end
            time.sleep(0.1)


def test_follow_goes_alone(log, tmp_path):
    done = CliRunner().invoke(main, ["view", str(log), "--follow", "--save", str(tmp_path / "x.rrd")])
    assert done.exit_code == 2 and "--follow opens the viewer" in done.output


@pytest.mark.slow
def test_without_a_driver_the_operator_learns_what_to_install(log, tmp_path, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    with pytest.raises(RigError, match="sudo apt install mesa-vulkan-drivers"):
        view(log, screenshot=tmp_path / "run.png")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.slow
@pytest.mark.skipif(not HAS_DRIVER, reason="no Vulkan driver on this machine")
def test_picture_without_display(log, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    picture = tmp_path / "run.png"
    view(log, screenshot=picture)

    from PIL import Image

    with Image.open(picture) as image:
        assert image.size == (1600, 1000)
        colours = np.array([colour for _, colour in image.convert("RGB").getcolors(1 << 20)])
    for name, colour in view_module.SERIES.items():  # drawn lines are blended with what is under them
        assert np.abs(colours - colour).max(axis=1).min() < 16, name


@pytest.mark.slow
@pytest.mark.skipif(not HAS_DRIVER, reason="no Vulkan driver on this machine")
def test_the_viewer_keeps_to_itself(log, tmp_path):
    """It listens on the loopback only, and its telemetry stays off."""
    import psutil

    from rig.base.clock import RealClock

    folder = tmp_path / "work"
    folder.mkdir()
    clock = RealClock()
    port = viewer_module._free_port()
    with viewer_module._viewer(folder, "--headless", "--port", str(port)) as viewer:
        listening: set[str] = set()
        while not listening and clock.now() < 30:
            assert viewer.poll() is None
            clock.sleep_until(clock.now() + 0.2)
            listening = {
                connection.laddr.ip
                for connection in psutil.Process(viewer.pid).net_connections("inet")
                if connection.status == psutil.CONN_LISTEN
            }
        clock.sleep_until(clock.now() + 1.0)
        remote = [c.raddr for c in psutil.Process(viewer.pid).net_connections("inet") if c.raddr]
    assert listening == {"127.0.0.1"}
    assert remote == []
    assert json.loads((folder / "rerun" / "analytics.json").read_text())["analytics_enabled"] is False
    assert not (folder / "rerun" / "analytics").exists()
    assert viewer.returncode is not None


def test_no_display_no_viewer(log, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RigError, match="--screenshot"):
        view(log)


@pytest.mark.parametrize("scene", [None, b"not = a scene"])
def test_without_a_scene_there_is_no_film_but_the_rest(tmp_path, scene):
    path = tmp_path / "bare.mcap"
    with LogWriter(path) as writer:
        if scene is not None:
            writer.attach("scene.toml", "application/toml", scene)
        writer.write("/force/sample", {"t_s": 0.5, "reading": 0.0, "force_N": 0.1, "flags": 0}, 0, 0)
        writer.finish({})
    view(path, save=tmp_path / "run.rrd")

    from rerun.chunk import RrdReader

    entities = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "run.rrd")).stream()}
    assert "/force" in entities and "/film/surface" not in entities


def test_what_is_not_a_log_leaves_nothing(tmp_path):
    (tmp_path / "notes.txt").write_text("force was 3 N\n")
    with pytest.raises(LogError, match="is not a log"):
        view(tmp_path / "notes.txt", save=tmp_path / "a.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_a_place_that_cannot_be_written(log, tmp_path):
    with pytest.raises(ConfigError, match="cannot be written"):
        view(log, save=tmp_path / "missing" / "a.rrd")


@pytest.mark.parametrize("module", ["rig.cli.app", "rig.view.viewer"])
def test_rerun_is_imported_only_when_a_log_is_viewed(module):
    code = f"import sys, {module}; sys.exit(any(name.split('.')[0].startswith('rerun') for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize(
    ("h", "voltage", "when"),
    [
        ([0, 3, 3, 1, 3], [0, 0, 1e3, 1e3, 0], 2),
        ([0, 3, 3, 1], [0, 0, 0, 0], 1),
        ([0, math.nan, 3, 1], [0, math.nan, math.nan, 0], 2),
        ([-3, -1, -2, -4], [0, 0, 0, 0], 1),
        ([math.nan] * 4, [0] * 4, 3),
    ],
)
def test_the_instant_of_the_picture(h, voltage, when):
    """The farthest displacement, at the highest voltage that was on there."""
    run = SimpleNamespace(t=np.arange(len(h)), h=np.array(h, dtype=float), voltage=np.array(voltage, dtype=float))
    assert view_module.best_instant(run) == when


@pytest.mark.parametrize(
    ("low", "high", "first", "last"),
    [
        (0.0, 6.0, 0.0, 6.0),
        (-0.1, 6.1, 0.0, 8.0),
        (-3.0, 3.0, -3.0, 3.0),
        (-3.0, 4.0, -4.0, 4.0),
        (0.0, 0.0, 0.0, 1e-9),
        (0.2, 0.9, 0.0, 1.0),
    ],
)
def test_ticks_enclose_the_values(low, high, first, last):
    ticks = view_module._ticks(np.array([low, high]))
    assert ticks[0] == pytest.approx(first, abs=1e-12)
    assert ticks[-1] == pytest.approx(last, rel=1e-9, abs=1e-9)
    assert 2 <= len(ticks) <= 9
