"""Engine and guard as real processes over pseudo-terminals and slcan: killed, stopped, hung, lost.

What is asserted is what the simulated supply's own output did. Times are generous multiples of what is required (50 ms
and 200 ms): a busy machine must not fail them; `dea-rig benchmark safety` measures the distribution.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import pytest

from rig.base.errors import RigError
from rig.benchmark.stand import Run, Stand
from rig.log.reader import read_log
from rig.safety.guard import AT_ONCE_S
from rig.safety.remote import LEAVE_S
from rig.sim.bench import SimulatedBench
from rig.sim.truth import Fault

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"), pytest.mark.slow]

TRIES = 3
BACK_S = 2.0  # twice what is required
KILLED_S, HUNG_S = 0.5, 1.5  # ten times and seven times what is required


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=30.0) as stand:
        yield stand


@pytest.fixture
def live(stand: Stand) -> Run:
    """A run with voltage on, in its hold. On a machine too busy a run is rightly given up before: then another."""
    for _ in range(TRIES - 1):
        run = stand.start()
        with suppress(RigError):
            stand.wait_until_live(run, 780.0)
            return run
        stand.wait_until_alone(run)
    run = stand.start()
    stand.wait_until_live(run, 780.0)
    return run


def commands(run: Run) -> list[str]:
    """What was commanded of the supply, by a log that was not finished, or was."""
    path = run.log if run.log.exists() else run.log.with_name(run.log.name + ".part")
    return [m.fields["command"] for m in read_log(path).messages("/command") if m.fields["device"] == "hv"]


def off_after(stand: Stand, at: float, seconds: float) -> float:
    """Seconds until the supply was sent to zero; then nothing may send it anywhere else."""
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    driven = stand.off_after(at)
    assert driven is not None
    assert driven.t - at < seconds
    return driven.t - at


def stays_off(stand: Stand, at: float) -> None:
    driven = stand.off_after(at)
    assert driven is not None
    assert all(one.target == 0.0 for one in stand.bench.driven if one.t > driven.t)
    stand.wait(lambda: stand.bench.voltage() < 60.0, "the output's discharge")


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(n, marks=pytest.mark.long) for n in (signal.SIGSEGV, signal.SIGABRT))],
)
def test_engine_killed(stand: Stand, live: Run, number: signal.Signals) -> None:
    at = stand.kill(live.engine, number)
    off_after(stand, at, KILLED_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert "without a shutdown message. The high voltage is off, measured" in live.said
    # The guard's own end of the log outlives the engine: the command, and the measured proof of what came of it.
    part = live.log.with_name(live.log.name + ".part")
    stand.wait(lambda: read_log(part).ended, "the log's end")  # its writer is the last one to go
    assert commands(live)[-1] == "emergency_off"
    last = read_log(part).columns("/hv/sample")["voltage_V"][-2:]
    assert (abs(last) < 60.0).all()


@pytest.mark.slow
def test_the_stage_gets_back_after_a_kill_what_it_had_lent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Stand(tmp_path / "stand", hold_s=0.2) as stand:

        def settings() -> dict[str, int]:
            values: dict[str, int] = stand.do(lambda bench: dict(cast(Any, bench.instruments["stage"])._values))
            return values

        found = settings()
        run = stand.start()
        stand.wait_until_live(run)
        stand.kill(run.engine)
        stand.wait_until_alone(run)
        assert settings()["knob.enable"] == 0 and settings()["maxspeed"] != found["maxspeed"]
        assert len(list((tmp_path / "dea-rig").glob("stage-*.json"))) == 1
        for _ in range(TRIES):
            run = stand.start()
            stand.wait_until_alone(run)
            if run.status == 0:
                break
        assert run.status == 0, run.said
        assert settings() == found
        assert not list((tmp_path / "dea-rig").glob("stage-*.json"))
        told = [m.fields["message"] for m in read_log(run.log).messages("/event") if m.fields["source"] == "stage"]
        assert any("an earlier run was killed and left changed" in text for text in told), told


@pytest.fixture(scope="module")
def slow_stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    """Where the last two millimetres before the film take four seconds, of 20 mm of travel allowed."""
    with Stand(tmp_path_factory.mktemp("slow")) as stand:
        fast = "speed_mm_per_s = 4.0\nthreshold_mN"
        assert fast in stand.protocol.read_text()
        stand.protocol.write_text(stand.protocol.read_text().replace(fast, "speed_mm_per_s = 0.5\nthreshold_mN"))
        yield stand


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, signal.SIGSTOP, pytest.param(signal.SIGUSR1, marks=pytest.mark.long)],
    ids=["killed", "stopped", "busy"],
)
def test_engine_gone_on_the_way_to_contact_leaves_the_stage_within_a_leg(
    slow_stand: Stand, number: signal.Signals
) -> None:
    """Half a second at 0.5 mm/s, and the braking: 0.25 mm. One step of the stage is 0.5 um."""

    def stage(t: float | None = None) -> tuple[float, float]:
        """Its true position and velocity."""
        return slow_stand.do(lambda bench: bench.world.stage.at(bench.now if t is None else t))

    run = slow_stand.start()
    slow_stand.wait(lambda: stage()[0] > 3.15e-3 and 0.4e-3 < stage()[1] < 0.6e-3, "the approach")
    at = slow_stand.kill(run.engine, number)
    slow_stand.wait(lambda: slow_stand.bench.clock.now() > at + 1.0, "a second")
    (position, velocity), (last, still) = stage(at), stage()
    assert velocity == pytest.approx(0.5e-3, rel=1e-3) and still == 0.0
    assert 0.0 < last - position < 0.2515e-3
    if number != signal.SIGKILL:
        assert run.status is None  # it is still there
        slow_stand.kill(run.engine)
    slow_stand.wait_until_alone(run)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGUSR1], ids=["stopped", "busy"])
def test_engine_hung(stand: Stand, live: Run, number: signal.Signals) -> None:
    """Stopped, or in a loop that never comes back (the fork server's handler of SIGUSR1)."""
    at = stand.kill(live.engine, number)
    off_after(stand, at, HUNG_S)
    stays_off(stand, at)
    assert live.status is None  # it is still there
    stand.kill(live.engine)
    stand.wait_until_alone(live)
    assert "silent for" in live.said
    stays_off(stand, at)


def test_engine_that_was_stopped_and_goes_on_gets_no_voltage_any_more(stand: Stand, live: Run) -> None:
    at = stand.kill(live.engine, signal.SIGSTOP)
    off_after(stand, at, HUNG_S)
    stand.kill(live.engine, signal.SIGCONT)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert live.status == 4
    assert "silent for" in live.said
    assert read_log(live.log).outcome["safe"] == "yes"  # type: ignore[index]


def test_guard_killed(stand: Stand, live: Run) -> None:
    at = stand.kill(live.guard)
    off_after(stand, at, HUNG_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert live.status == 4 and "the guard is lost (its process has died)" in live.said
    outcome = read_log(live.log).outcome
    assert outcome is not None and outcome["safe"] == "yes" and outcome["status"] == "fault"
    assert outcome["stage_standing"] == "yes"
    assert commands(live)[-1] == "emergency_off"


def test_guard_that_is_stopped_is_ended_and_replaced_by_the_engine(stand: Stand, live: Run) -> None:
    """Required are 0.3 s; the reason names the guard, not a sensor that nobody asked any more."""
    at = stand.kill(live.guard, signal.SIGSTOP)
    off_after(stand, at, HUNG_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert live.status == 4 and re.search(r"the guard is lost \(its process was stopped", live.said)
    assert read_log(live.log).outcome["safe"] == "yes"  # type: ignore[index]


def test_guard_ignores_signals_that_end_programs(stand: Stand, live: Run) -> None:
    at = stand.bench.clock.now()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        stand.kill(live.guard, number)
    stand.wait(lambda: stand.bench.clock.now() > at + 0.5, "half a second")
    assert stand.off_after(at) is None and live.status is None
    at = stand.kill(live.engine, signal.SIGTERM)  # the engine's own end takes it with it
    stand.wait_until_alone(live)
    assert live.status == 130
    stays_off(stand, at)


def test_engine_and_guard_killed_leave_the_voltage_to_the_hardware(stand: Stand, live: Run) -> None:
    """Stated plainly: nothing in software is left to act. The next start finds the output live and touches nothing."""
    at = stand.kill(live.guard, signal.SIGSTOP)
    stand.kill(live.engine)
    stand.kill(live.guard)
    stand.wait_until_alone(live)
    stand.wait(lambda: stand.bench.clock.now() > at + 1.0, "a second")
    assert stand.off_after(at) is None and stand.bench.voltage() > 780.0
    readme = (Path(__file__).resolve().parents[2] / "README.md").read_text()
    assert "both are killed" in " ".join(readme.split())
    again = stand.start(power_cycle=False)
    stand.wait_until_alone(again)
    assert again.status == 4 and "though nobody switched it on from here" in again.said
    assert stand.off_after(at) is None and stand.bench.voltage() > 780.0


def test_engine_killed_with_a_supply_that_does_not_obey_is_called_not_safe(stand: Stand, live: Run) -> None:
    def stick(bench: SimulatedBench) -> None:
        bench.inject(Fault(role="hv", kind="stuck_on"))

    stand.do(stick)
    at = stand.kill(live.engine)
    stand.wait(lambda: "NOT SAFE" in live.said, "the guard's word")
    assert stand.bench.voltage() > 780.0
    stand.do(lambda bench: setattr(bench.instruments["hv"], "stuck_on", False))
    stand.wait_until_alone(live)  # it was told again meanwhile, and obeys now
    stays_off(stand, at)
    assert "The high voltage is off, measured" in live.said


def test_a_guard_whose_engine_takes_leave_of_a_live_output_stays_and_tries_on(stand: Stand, live: Run) -> None:
    stand.do(lambda bench: bench.inject(Fault(role="hv", kind="stuck_on")))
    at = stand.kill(live.engine, signal.SIGINT)
    stand.kill(live.engine, signal.SIGINT)
    stand.wait(lambda: "dea-rig guard: NOT SAFE" in live.said, "the guard's word")
    # By then the engine has given up; a guard that it dismissed would be gone, or killed for not going.
    stand.wait(lambda: stand.bench.clock.now() > at + AT_ONCE_S + 2 * LEAVE_S + 1.0, "the guard's patience")
    assert stand.bench.voltage() > 780.0
    stand.do(lambda bench: setattr(bench.instruments["hv"], "stuck_on", False))
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert "before the output was measured off" in live.said and "The high voltage is off, measured" in live.said
    outcome = read_log(live.log).outcome
    assert live.status == 4 and outcome is not None
    assert (outcome["safe"], outcome["status"]) == ("NO", "NOT SAFE") and outcome["reason"].startswith("stopped by")


def test_a_bus_that_is_pulled_with_voltage_on_ends_the_run_as_not_safe(stand: Stand, live: Run) -> None:
    at = stand.pull("hv")
    stand.wait(lambda: live.status is not None, "the engine's end")
    assert stand.bench.clock.now() - at < AT_ONCE_S + 5.0
    assert stand.bench.voltage() > 780.0  # no command can reach it
    assert live.status == 4
    outcome = read_log(live.log).outcome
    assert outcome is not None and outcome["safe"] == "NO" and outcome["stage_standing"] == "yes"
    assert "NOT SAFE" in "".join(m.fields["message"] for m in read_log(live.log).messages("/event"))
    at = stand.plug_in("hv")  # the guard has gone on trying
    off_after(stand, at, BACK_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert "The high voltage is off, measured" in live.said


def test_an_adapter_that_is_pulled_and_comes_back_is_found_again_and_the_output_taken_off(
    stand: Stand, live: Run
) -> None:
    """Required is 1 s."""
    at = stand.pull("hv")
    stand.wait(lambda: stand.bench.clock.now() > at + 0.3, "0.3 s")
    at = stand.plug_in("hv")
    off_after(stand, at, BACK_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert live.status == 4 and "is gone" in live.said
    log = read_log(live.log)
    assert log.outcome is not None and log.outcome["safe"] == "yes"
    assert "is open again" in "".join(m.fields["message"] for m in log.messages("/event"))


@pytest.mark.parametrize("first", ["guard killed", "pulled"])
def test_a_guard_killed_while_the_adapter_is_out_leaves_the_engine_to_take_the_output_off(
    stand: Stand, live: Run, first: str
) -> None:
    """No order of the two faults leaves it on once the adapter is back."""
    if first == "pulled":
        stand.pull("hv")
    stand.kill(live.guard)
    if first != "pulled":
        stand.pull("hv")
    now = stand.bench.clock.now()
    stand.wait(lambda: stand.bench.clock.now() > now + 0.3, "0.3 s")
    at = stand.plug_in("hv")
    off_after(stand, at, BACK_S)
    stand.wait_until_alone(live)
    stays_off(stand, at)
    assert live.status == 4


def test_a_second_run_on_the_same_ports_is_refused_and_disturbs_nothing(stand: Stand, live: Run) -> None:
    at = stand.bench.clock.now()
    second = stand.start(power_cycle=False)
    stand.wait(lambda: second.status is not None, "the refusal")
    assert second.status == 4 and "in use" in second.said, second.said
    assert not second.log.exists() and not second.log.with_name(second.log.name + ".part").exists()
    assert live.status is None and stand.off_after(at) is None and stand.bench.voltage() > 780.0
    at = stand.kill(live.engine, signal.SIGINT)
    stand.wait_until_alone(live)
    assert live.status == 130
    stays_off(stand, at)
