"""Every way in which a run can end, with a supply that obeys and with one that does not.

An output that was not measured off: exit code 4, status and last line say NOT SAFE, whatever else ended the run. Never
otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from drivers.links.link import DeviceLost
from rig.base.errors import ConfigError, FaultError, LimitError, StaleData
from rig.cli.app import main
from rig.engine import engine as engine_module
from rig.engine.engine import LONGEST_TURN_S, Engine
from rig.engine.teardown import Teardown
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.writer import LogWriter
from rig.run import backend
from rig.sim.bench import SimulatedBench
from tests.protocols import near

FIXTURES = Path(str(files("sim_fixtures")))
PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.3
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 12.0
max_travel_mm = 8.0
[[step]]
do = "voltage"
voltage_V = 800
settle_s = 0.1
[[step]]
do = "hold"
duration_s = 0.5
"""
QUICKER = ("ramp_V_per_s = 300.0", "ramp_V_per_s = 1000.0")


def throw(error: Exception) -> Callable[[Engine], None]:
    def end(engine: Engine) -> None:
        raise error

    return end


def stop(times: int) -> Callable[[Engine], None]:
    def end(engine: Engine) -> None:
        for _ in range(times):
            engine.control.ask("a test")

    return end


def full_disk(engine: Engine) -> None:
    def fail(*_: object, **__: object) -> None:
        raise LogError(Path("run.mcap"), "writing failed (No space left on device); nothing more is written")

    log: Any = engine.recorder._log
    log.write = log.tick = fail


def no_end_of_the_log(engine: Engine) -> None:
    def fail(*_: object) -> None:
        raise LogError(Path("run.mcap"), "cannot be given its name")

    log: Any = engine.recorder._log
    log.finish = fail


# What ends the run, and its exit code when the output was measured off.
ENDS: dict[str, tuple[Callable[[Engine], None], int]] = {
    "the protocol": (lambda engine: None, 0),
    "one signal": (stop(1), 130),
    "two signals": (stop(2), 130),
    "twelve signals": (stop(12), 130),
    "a limit": (throw(LimitError("a limit")), 3),
    "a fault": (throw(FaultError("a fault")), 4),
    "old data": (throw(StaleData("force: silent")), 4),
    "a device lost": (throw(DeviceLost("stage", "the port is gone")), 4),
    "a file": (throw(ConfigError("a file that cannot be used")), 2),
    "a full disk": (full_disk, 4),
    "a log without an end": (no_end_of_the_log, 1),
    "a mistake of ours": (throw(ZeroDivisionError("a mistake")), 1),
    "an operating system's error": (throw(OSError(5, "Input/output error")), 1),
}


class Ending:
    """One run through the command line that is ended in its hold, with 800 V on."""

    def __init__(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch, end: Callable[[Engine], None], stuck: bool
    ) -> None:
        text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
        assert QUICKER[0] in text
        text = near(text).replace(*QUICKER)
        scene, protocol, self.log = folder / "scene.toml", folder / "protocol.toml", folder / "run.mcap"
        scene.write_text(text.replace("../calibrations", str(FIXTURES / "calibrations")))
        protocol.write_text(PROTOCOL)
        self.bench: SimulatedBench | None = None
        simulated = backend.simulated_bench

        def remember(scene: Any) -> SimulatedBench:
            self.bench = simulated(scene)
            return self.bench

        monkeypatch.setattr(backend, "simulated_bench", remember)
        turn, self.done = Engine._turn, False

        def turn_and_end(engine: Engine) -> None:
            turn(engine)
            if not self.done and "hold" in engine._doing:
                self.done = True
                assert self.bench is not None
                if stuck:
                    self.bench.instruments["hv"].stuck_on = True  # type: ignore[attr-defined]
                end(engine)

        monkeypatch.setattr(Engine, "_turn", turn_and_end)
        monkeypatch.setattr(engine_module, "SHORTEST_TURN_S", LONGEST_TURN_S)  # half the turns
        self.result = CliRunner().invoke(main, ["run", str(scene), str(protocol), "-o", str(self.log)])
        assert self.done, self.result.output

    @property
    def output(self) -> float:
        assert self.bench is not None
        return float(self.bench.world.output.at(self.bench.now)[0])

    @property
    def last_line(self) -> str:
        return self.result.output.strip().splitlines()[-1]

    @property
    def status(self) -> str | None:
        if not self.log.exists():
            return None
        outcome = read_log(self.log).outcome
        return None if outcome is None else str(outcome["status"])


LIKE_OTHERS = {"two signals", "a limit", "old data", "a file", "an operating system's error"}  # their own codes: below


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=[pytest.mark.slow] if how in LIKE_OTHERS else []) for how in ENDS]
)
def test_not_safe_is_never_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    run = Ending(tmp_path, monkeypatch, ENDS[how][0], stuck=True)
    assert run.output > 780.0
    assert run.result.exit_code == 4
    assert "NOT SAFE" in run.last_line and "grounding stick" in run.last_line
    assert run.status in (None, "NOT SAFE")
    assert run.status is not None or how in ("a full disk", "a log without an end")


@pytest.mark.parametrize("how", ENDS)
def test_and_never_said_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    end, code = ENDS[how]
    run = Ending(tmp_path, monkeypatch, end, stuck=False)
    assert run.output < 60.0
    assert run.result.exit_code == code
    assert "NOT SAFE" not in run.result.output
    assert run.status != "NOT SAFE"


def test_a_teardown_that_fails_itself_counts_as_not_measured_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a mistake in the teardown")

    monkeypatch.setattr(Teardown, "run", fail)
    run = Ending(tmp_path, monkeypatch, stop(1), stuck=True)
    assert run.result.exit_code == 4 and "NOT SAFE" in run.result.output


def test_every_run_says_first_on_what_bench_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Ending(tmp_path, monkeypatch, stop(1), stuck=False)
    assert run.result.output.splitlines()[0].startswith("SIMULATED: simulated in memory")
    assert read_log(run.log).metadata["run"]["bench"] == "simulated in memory"


def test_logs_are_finished_by_their_writer() -> None:
    """`no_end_of_the_log` replaces a method that exists."""
    assert callable(LogWriter.finish)
