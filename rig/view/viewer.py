"""A log in the Rerun viewer, or a picture of it. Only this room knows Rerun.

The viewer is started as a process of its own, listens on 127.0.0.1 only, and keeps its settings in a directory that is
removed afterwards, so that its telemetry is off without touching the operator's own settings.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rig.base.clock import RealClock
from rig.base.errors import ConfigError, RigError
from rig.base.text import printable
from rig.log.dataset import Run, load_run
from rig.log.errors import LogError
from rig.log.follow import growing
from rig.view.live import stream
from rig.view.recording import TIMELINE, best_instant, write_recording

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

WINDOW = "1600x1000"
MEMORY = "1GB"  # of a viewer that follows: what is older goes
PICTURE_S = 120.0  # on a machine without a graphics card


def view(log_path: Path, *, save: Path | None = None, screenshot: Path | None = None) -> None:
    """Open a log in the viewer, or write a Rerun recording and a picture instead.

    Parameters
    ----------
    log_path : Path
        A log, finished or not.
    save : Path, optional
        Write a Rerun recording (``.rrd``) there.
    screenshot : Path, optional
        Write a picture (``.png``) there; needs no display, but a Vulkan driver.

    Raises
    ------
    rig.log.errors.LogError
        The log cannot be read.
    ConfigError, RigError
        A file cannot be written, there is no display, or the viewer failed.
    """
    run = load_run(log_path)
    with tempfile.TemporaryDirectory(prefix="dea-rig-view-") as name:
        folder = Path(name)
        recording = folder / f"{log_path.name.removesuffix('.mcap')}.rrd"
        write_recording(run, recording)
        if screenshot is not None:
            _take_picture(run, recording, screenshot, folder)
        if save is not None:
            _place(recording, save)
        if save is None and screenshot is None:
            _open_viewer(recording, folder)


def follow(log_path: Path) -> None:
    """Open a viewer that shows a log as it grows; ends with the viewer. The run does not wait for it.

    Raises
    ------
    rig.log.errors.LogError
        The log cannot be read.
    RigError
        There is no display, or the viewer failed.
    """
    _need_display()
    growing(log_path)
    with tempfile.TemporaryDirectory(prefix="dea-rig-view-") as name:
        with following(log_path, Path(name)) as (viewer, _):
            code = viewer.wait()
        if code != 0:
            raise RigError(f"The viewer ended with code {code}. Its last words: {_last_words(Path(name))}")


@contextmanager
def following(log_path: Path, folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A viewer, its port, and a thread that sends it what is added to the log."""
    os.environ.setdefault("RUST_LOG", "off")  # a window that is closed is no error
    import rerun as rr

    port = _free_port()
    with _viewer(folder, "--hide-welcome-screen", "--memory-limit", MEMORY, "--port", str(port), *options) as viewer:
        recording = rr.RecordingStream("dea_rig", recording_id=log_path.name)
        closing = threading.Event()

        def send() -> None:
            while not _listens(port):
                if closing.wait(0.1) or viewer.poll() is not None:
                    return
            recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
            with suppress(LogError):
                stream(log_path, recording, lambda: not closing.is_set() and viewer.poll() is None)

        sender = threading.Thread(target=send, name="view: log", daemon=True)
        sender.start()
        try:
            yield viewer, port
        finally:
            closing.set()
            sender.join(5.0)
            recording.disconnect()


def _need_display() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RigError("There is no display here. Use --screenshot FILE.png or --save FILE.rrd.")


def _open_viewer(recording: Path, folder: Path) -> None:
    _need_display()
    with _viewer(folder, "--port", "auto", str(recording)) as viewer:
        code = viewer.wait()
    if code != 0:
        raise RigError(f"The viewer ended with code {code}. Its last words: {_last_words(folder)}")


def _take_picture(run: Run, recording: Path, target: Path, folder: Path) -> None:
    """Show the recording in a viewer without a window, at the instant of the largest displacement."""
    from rerun.experimental import ViewerClient

    port = _free_port()
    arguments = ("--headless", "--hide-welcome-screen", "--window-size", WINDOW, "--port", str(port), str(recording))
    clock = RealClock()
    with _viewer(folder, *arguments) as viewer:
        client = None
        while client is None or not _shown(client):
            if viewer.poll() is not None:
                raise RigError(_why_no_picture(_last_words(folder)))
            if not clock.now() < PICTURE_S:
                raise RigError(
                    f"The viewer did not show the log within {PICTURE_S:.0f} s; the machine may be too busy."
                )
            clock.sleep_until(clock.now() + 0.2)
            with suppress(ConnectionError, RuntimeError):
                client = client or ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.set_time(TIMELINE, duration=best_instant(run), play_state="paused")
        clock.sleep_until(clock.now() + 1.0)  # for the views to settle and the viewer's own notices to vanish
        picture = folder / "picture.png"
        client.save_screenshot(str(picture))
        complaints = [report.summary for view in client.get_state().views for report in view.reports]
    if complaints:
        raise RigError(f"The viewer could not show everything: {'; '.join(complaints)}")
    _place(picture, target)


def _shown(client: ViewerClient) -> bool:
    try:
        state = client.get_state()
    except (ConnectionError, RuntimeError):
        return False
    return bool(state.recordings) and not state.loading


@contextmanager
def _viewer(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's own binary as a child process, ended with the block; its messages go to a file in ``folder``."""
    import rerun_cli

    binary = Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")
    settings = folder / "rerun"
    settings.mkdir(exist_ok=True)
    telemetry = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(settings / "analytics.json"),
        "data_dir_path": str(settings / "analytics"),
    }
    (settings / "analytics.json").write_text(json.dumps(telemetry))
    environment = {**os.environ, "XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder), "RUST_LOG": "error"}
    command = [str(binary), "--bind", "127.0.0.1", *arguments]
    with (folder / "messages.txt").open("wb") as messages:
        viewer = subprocess.Popen(command, env=environment, stdout=messages, stderr=messages, stdin=subprocess.DEVNULL)
        try:
            yield viewer
        finally:
            viewer.terminate()
            try:
                viewer.wait(10.0)
            except subprocess.TimeoutExpired:
                viewer.kill()
                viewer.wait()


def _last_words(folder: Path) -> str:
    """What the viewer said, from where it gave up if it did, without colours and control characters."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", (folder / "messages.txt").read_text(errors="replace"))
    panic = text.find("panicked at")
    words = text[panic:].splitlines()[:2] if panic >= 0 else text.splitlines()[-3:]
    return printable(" ".join(words))


def _why_no_picture(messages: str) -> str:
    if re.search("adapter|vulkan|wgpu|render", messages, re.IGNORECASE):
        return (
            "A picture needs a graphics driver, and this machine offers none. On Debian or Ubuntu a driver that needs "
            f"no graphics card is installed by: sudo apt install mesa-vulkan-drivers (the viewer said: {messages})"
        )
    return f"The viewer ended before the picture was made. Its last words: {messages}"


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _place(made: Path, target: Path) -> None:
    """Copy a finished file to where it was asked for; it appears whole or not at all."""
    part = target.with_name(target.name + ".part")
    try:
        shutil.copyfile(made, part)
        part.replace(target)
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror}.") from None
