"""Wishes of the operator: what a line means, how it gets in from a keyboard and from another terminal."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from threading import Thread

import pytest

from rig.base.errors import ConfigError
from rig.operator.control import Control, Keyboard, Question
from rig.operator.live import LONGEST, LiveRun, live_run, run_directory
from rig.operator.remote import MOST, Remote
from rig.operator.signals import stop_on_signals

USER = os.getuid() if hasattr(os, "getuid") else 0
posix = pytest.mark.skipif(os.name != "posix", reason="terminals and their signals are POSIX")


def test_a_question_says_which_of_how_many_it_is_and_what_may_be_typed() -> None:
    said: list[str] = []
    control = Control(say=said.append)
    control.put(Question("Hang 20 g.", number="3 of 34"))
    assert said[0].startswith("3 of 34: Hang 20 g.\n  -> press Enter")
    assert control.describe()["question"] == "3 of 34: Hang 20 g."
    control.put(Question("Move the stage.", hint="+ or -"))
    assert "-> + or -; or s to stop" in said[1]


def test_a_line_is_a_command_or_the_answer_to_the_open_question() -> None:
    control = Control()
    assert "nothing to continue" in control.take("c", "me") and "p to pause" in control.take("hello", "me")
    control.put(Question("How high?", expected="1500"))
    assert "type 1500" in control.take("150 V", "me") and control.answer is None
    assert control.take(" 1500 ", "me") == "Answered." and control.answer is not None
    control.withdraw()
    control.put(Question("Mounted?"))
    control.take("", "me")
    assert control.answer is not None and control.answer.text == ""
    control.take("pause", "me")
    assert control.pausing == "me"
    assert control.describe()["state"] == "paused"
    control.take("c", "me")
    assert not control.pausing
    control.put(Question("Lid closed?"))
    assert control.describe()["state"] == "asking"
    control.take("s", "me")  # a stop is a stop, whatever is asked
    assert control.count == 1 and control.answer is None and control.describe()["state"] == "ending"


def test_an_unattended_run_is_answered_as_expected_but_stays_paused() -> None:
    control = Control(unattended="--yes")
    control.put(Question("How high?", expected="1500"))
    assert control.answer is not None and (control.answer.text, control.answer.source) == ("1500", "--yes")
    control.ask_pause("me")
    control.poll(1.0)
    assert control.pausing


def test_a_terminal_that_is_gone_does_not_end_a_run() -> None:
    def gone(text: str) -> None:
        raise BrokenPipeError

    Control(say=gone).put(Question("Still there?"))


@posix
def test_the_keyboard_gives_whole_lines_and_never_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = os.openpty()
    keyboard, control = Keyboard(slave), Control()
    assert keyboard.read(control) == []  # the terminal of another session: its keys are not ours
    monkeypatch.setattr(os, "tcgetpgrp", lambda fd: os.getpgrp())
    assert keyboard.read(control) == []
    os.write(master, b"pau")
    assert keyboard.read(control) == []
    os.write(master, b"se\ncontinue\n")
    lines: list[str] = []
    while len(lines) < 2:
        lines += keyboard.read(control)
    assert lines == ["pause", "continue"]
    os.close(master)
    assert keyboard.read(control) == [] == keyboard.read(control)
    os.close(slave)


@posix
def test_ctrl_z_pauses_and_does_not_stop_the_process() -> None:
    control = Control()
    with stop_on_signals(control, control.ask_pause):
        os.kill(os.getpid(), signal.SIGTSTP)
        os.kill(os.getpid(), signal.SIGTTIN)
        os.kill(os.getpid(), signal.SIGTTOU)
    assert "Ctrl-Z" in control.pausing and control.count == 0
    assert signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return run_directory()


@pytest.fixture
def served(folder: Path, tmp_path: Path) -> Iterator[Control]:
    """A control that is polled by a thread of its own, as a run's loop would."""
    done: list[bool] = []
    with closing(Control([Remote(tmp_path / "run.mcap")])) as control:

        def loop() -> None:
            now = 0.0
            while not done:
                now += 1.0
                control.poll(now)

        thread = Thread(target=loop)
        thread.start()
        yield control
        done.append(True)
        thread.join()


def test_another_terminal_finds_the_run_by_itself(served: Control, tmp_path: Path) -> None:
    run = live_run()
    assert run.log == str(tmp_path / "run.mcap") and run == live_run(tmp_path / "run.mcap")
    assert run.send("status")["state"] == "running"
    assert "Pausing" in run.send("pause")["said"] and served.pausing == "another terminal"
    assert "Continuing" in run.send("continue")["said"]
    served.put(Question("How high?", expected="1500"))
    assert run.send("status")["question"] == "How high?"
    assert run.send("1500")["said"] == "Answered."
    assert "Stopping" in run.send("stop")["said"] and served.count == 1
    with pytest.raises(ConfigError, match="No run of yours"):
        live_run(tmp_path / "other.mcap")


def test_who_does_not_know_the_token_or_talks_badly_changes_nothing(served: Control) -> None:
    run = live_run()
    stranger = LiveRun(run.file, run.pid, run.port, "0" * 32, run.log)
    assert "Refused" in stranger.send("stop")["said"]
    lingering = [socket.create_connection(("127.0.0.1", run.port)) for _ in range(MOST + 4)]
    for garbage in (b"\n", b"\xff\xfe\n", b"x" * (4 * LONGEST), b"", run.token.encode() + b"\n"):
        with socket.create_connection(("127.0.0.1", run.port)) as line:
            line.sendall(garbage)
    assert run.send("status")["state"] == "running" and served.count == 0
    for line in lingering:
        line.close()


@posix
def test_the_announcement_is_the_users_alone_and_goes_with_the_run(folder: Path, tmp_path: Path) -> None:
    remote = Remote(tmp_path / "run.mcap")
    (announced,) = folder.iterdir()
    assert announced.stat().st_mode & 0o077 == 0 and folder.stat().st_mode & 0o077 == 0
    remote.close()
    assert not folder.exists()


@posix
@pytest.mark.parametrize("kind", ["open", "link", "file", "another's"])
def test_a_directory_that_is_not_the_users_alone_is_neither_used_nor_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Nobody can make it first: it is found by its owner, and its name cannot be guessed."""
    temporary, runtime = tmp_path / "tmp", tmp_path / "run"
    for one in (temporary, runtime):
        one.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    if Path(f"/run/user/{USER}").is_dir():
        pytest.skip("this system has a directory of its own for it")
    guessed = [runtime / "dea-rig", temporary / f"dea-rig-{USER}", temporary / f"dea-rig-{USER}-first"]
    for place in guessed:
        if kind == "file":
            place.write_text("")
        elif kind == "link":
            place.symlink_to(tmp_path)
        else:
            place.mkdir(mode=0o700)
            if kind == "open":
                place.chmod(0o777)
    if kind == "another's":  # made as 0700, by somebody with another number
        seen = Path.lstat

        def lstat(path: Path) -> os.stat_result:
            found = seen(path)
            return os.stat_result((*found[:4], USER + 1, *found[5:])) if path in guessed else found

        monkeypatch.setattr(Path, "lstat", lstat)
    folder = run_directory()
    assert folder not in guessed and folder.parent == temporary and folder == run_directory()
    assert folder.stat().st_mode & 0o077 == 0 and re.fullmatch(rf"dea-rig-{USER}-\w{{8}}", folder.name)
    with closing(Control([Remote(tmp_path / "run.mcap")])):
        assert [file.name for file in folder.iterdir()] == [f"{os.getpid()}.json"]
    assert not folder.exists() and not (set(temporary.iterdir()) - set(guessed))


def test_what_a_killed_run_left_is_not_taken_for_a_run(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    (folder / "1.json").write_text(json.dumps({"pid": 1, "port": port, "token": "", "log": "x.mcap"}))
    (folder / "2.json").write_text("not JSON")
    with pytest.raises(ConfigError, match="No run of yours is going on"):
        live_run()
    assert not (folder / "1.json").exists()


def test_of_several_runs_one_has_to_be_named(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as hanging:  # it accepts but never answers
        for pid in (1, 2):
            about = {"pid": pid, "port": hanging.getsockname()[1], "token": "", "log": f"/{pid}.mcap"}
            (folder / f"{pid}.json").write_text(json.dumps(about))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("rig.operator.live.REPLY_S", 0.05)
            with pytest.raises(ConfigError, match="name the log"):
                live_run()
            with pytest.raises(ConfigError, match="Use the emergency stop"):
                live_run(Path("/2.mcap")).send("stop")


@pytest.mark.parametrize(
    ("typed", "taken"),
    [
        ("800", True),
        ("800 V", True),
        ("800V", True),
        (" 800  v ", True),
        ("800 kV", False),
        ("8000", False),
        ("80 0", False),
        ("V", False),
        ("", False),
        ("+800", False),
        ("800 V V", False),
    ],
)
def test_a_voltage_may_be_typed_with_its_unit(typed: str, taken: bool) -> None:
    control = Control()
    control.put(Question("High voltage up to 800 V?", expected="800"))
    said = control.take(typed, "the keyboard")
    assert (control.answer is not None) is taken, said


def test_a_word_that_is_asked_for_has_no_unit() -> None:
    control = Control()
    control.put(Question("Take it down?", expected="take down"))
    control.take("take down V", "the keyboard")
    assert control.answer is None
