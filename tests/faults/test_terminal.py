"""``dea-rig run`` at a terminal of its own: Ctrl-C once and often, the terminal gone, from outside by a signal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rig.benchmark.stand import Stand
from rig.log.reader import Log, read_log
from rig.protocol.experiment import SERVED_BY, SERVER

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"), pytest.mark.slow]

# The run becomes the terminal's foreground job, as if started from a shell there.
JOB = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.executable, sys.argv[1:])"


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=30.0) as stand:
        yield stand


class Terminal:
    """A run at a pseudo-terminal, live."""

    def __init__(self, stand: Stand, log: Path) -> None:
        self.stand, self.log = stand, log
        stand.bench.power_cycle()
        ports = log.with_suffix(".json")
        ports.write_text(json.dumps({**stand.bench.ports, SERVED_BY: SERVER}))
        self.master, slave = os.openpty()
        os.set_blocking(self.master, False)
        command = [sys.executable, "-m", "rig", "run", str(stand.scene), str(stand.protocol), "-o", str(log)]
        self.process = subprocess.Popen(
            [sys.executable, "-c", JOB, *command, "--ports", str(ports), "--arm", "--yes"],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
        )
        os.close(slave)
        self.shown = b""

    def wait(self, done: Callable[[], bool], what: str) -> None:
        end = self.stand.bench.clock.now() + 60.0
        while not done():
            self.read()
            assert self.stand.bench.clock.now() < end, f"waited in vain for {what}: {self.shown.decode()[-2000:]}"

    def read(self) -> None:
        try:
            self.shown += os.read(self.master, 65536)
        except OSError:  # nothing there, or no terminal any more
            self.stand.bench.voltage()  # waits a little

    def type(self, keys: bytes) -> float:
        at = self.stand.bench.clock.now()
        os.write(self.master, keys)
        return at

    def end(self) -> Log:
        self.wait(lambda: self.process.poll() is not None, "the run's end")
        return read_log(self.log)


@pytest.fixture
def terminal(stand: Stand, tmp_path: Path) -> Iterator[Terminal]:
    terminal = Terminal(stand, tmp_path / "run.mcap")
    try:
        terminal.wait(lambda: stand.bench.voltage() > 780.0 or terminal.process.poll() is not None, "high voltage")
        assert terminal.process.poll() is None, terminal.shown.decode()
        yield terminal
    finally:
        if terminal.process.poll() is None:
            terminal.process.kill()
        terminal.process.wait(30)
        if terminal.master >= 0:
            os.close(terminal.master)


def words(log: Log) -> list[str]:
    return [m.fields["command"] for m in log.messages("/command") if m.fields["device"] == "hv"]


def check_off(terminal: Terminal, at: float, log: Log) -> None:
    """The supply was sent to zero and nowhere else after it, and the log has the measured proof."""
    stand = terminal.stand
    driven = stand.off_after(at)
    assert driven is not None and stand.bench.voltage() < 60.0
    assert all(one.target == 0.0 for one in stand.bench.driven if one.t > driven.t)
    outcome = log.outcome
    assert outcome is not None and outcome["status"] == "stopped" and outcome["safe"] == "yes"
    assert abs(float(outcome["measured_voltage_V"])) < 60.0


def test_ctrl_c_ramps_down(terminal: Terminal) -> None:
    assert b"What cannot be detected from here" in terminal.shown  # said where high voltage is asked for
    at = terminal.type(b"\x03")
    log = terminal.end()
    check_off(terminal, at, log)
    assert terminal.process.returncode == 130
    assert words(log)[-1] == "switch_off"
    assert b"high voltage off, measured" in terminal.shown


def test_ctrl_c_twelve_times_hastens_and_skips_nothing(terminal: Terminal) -> None:
    at = terminal.type(b"\x03")
    clock = terminal.stand.bench.clock
    for press in range(1, 12):
        while clock.now() < at + 0.02 * press:  # a hand is not so fast; signals closer than this may come as one
            terminal.read()
        if terminal.process.poll() is None:
            terminal.type(b"\x03")
    log = terminal.end()
    check_off(terminal, at, log)
    assert terminal.process.returncode == 130
    assert words(log)[-1] == "emergency_off"
    assert log.outcome["stage_standing"] == "yes"  # type: ignore[index]


def test_the_terminal_is_closed(terminal: Terminal) -> None:
    at = terminal.stand.bench.clock.now()
    os.close(terminal.master)
    terminal.master = -1
    log = terminal.end()
    check_off(terminal, at, log)


# SIGHUP comes when a terminal is closed, above; what takes all of them: tests/rig/operator/test_signals.py.
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, *(pytest.param(n, marks=pytest.mark.long) for n in (signal.SIGHUP, signal.SIGQUIT))]
)
def test_a_signal_from_outside(terminal: Terminal, number: signal.Signals) -> None:
    at = terminal.stand.bench.clock.now()
    terminal.process.send_signal(number)
    log = terminal.end()
    check_off(terminal, at, log)
    assert terminal.process.returncode == 130 and words(log)[-1] == "switch_off"


@pytest.mark.long
def test_the_run_is_killed(terminal: Terminal) -> None:
    """As in `test_processes`, with everything as the command line starts it; so does `test_serial_supply` in CI."""
    stand = terminal.stand
    at = stand.bench.clock.now()
    terminal.process.kill()
    terminal.wait(lambda: stand.off_after(at) is not None, "the output's end")
    terminal.wait(lambda: b"The high voltage is off, measured" in terminal.shown, "the guard's word")
    assert stand.bench.voltage() < 60.0
    assert words(read_log(terminal.log.with_name("run.mcap.part")))[-1] == "emergency_off"
