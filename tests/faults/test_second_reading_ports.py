"""The second reading of the voltage over real processes, pseudo-terminals and TCP: the guard's proof of off needs it.

What is asserted is what the simulated supply's own output did.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from rig.base.errors import RigError
from rig.benchmark.stand import Run, Stand
from rig.log.reader import read_log
from rig.sim.bench import SimulatedBench
from rig.sim.truth import Fault

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"), pytest.mark.slow]

TRIES = 3
METERS = {
    "ascii-stream": '[monitor]\ndriver = "ascii-stream"\nquantity = "voltage"\nrate_Hz = 10.0\ntimeout_s = 2.0\n'
    "[simulation.monitor]\nprint_rate_Hz = 10.0\n",
    "scpi": '[monitor]\ndriver = "scpi"\nquantity = "voltage"\nfactor = 1000.0\nrate_Hz = 5.0\ntimeout_s = 2.0\n',
}


@pytest.fixture(scope="module", params=["scpi", pytest.param("ascii-stream", marks=pytest.mark.long)])
def stand(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=20.0, more=METERS[request.param]) as stand:
        yield stand


@pytest.fixture
def live(stand: Stand) -> Run:
    """A run with voltage on. On a machine too busy a run is rightly given up before: then another."""
    for last in range(TRIES):
        run = stand.start()
        try:
            stand.wait_until_live(run, 780.0)
            return run
        except RigError:
            if last == TRIES - 1:
                raise
            stand.wait_until_alone(run)
    raise AssertionError


def lie(stand: Stand, lies: bool) -> None:
    """Let the supply say that it is off and measure 0 V whatever its output does, and ignore every off; or not."""

    def act(bench: SimulatedBench) -> None:
        bench.instruments["hv"].switch(Fault(role="hv", kind="lies"), lies, bench.now)

    stand.do(act)


def test_a_supply_that_lies_ends_not_safe_and_the_guard_goes_on_until_both_show_off(stand: Stand, live: Run) -> None:
    lie(stand, True)
    stand.wait(lambda: live.status is not None, "the engine's end")
    assert live.status == 4
    assert stand.bench.voltage() > 780.0
    outcome = read_log(live.log).outcome
    assert outcome is not None and outcome["status"] == "NOT SAFE" and outcome["safe"] == "NO"
    last = live.log.with_suffix(".err").read_text().strip().splitlines()[-1]
    assert "NOT SAFE" in last and "(monitor) shows 80" in last.replace("shows 79", "shows 80")
    lie(stand, False)  # it obeys the next off: the guard has gone on, and reads the monitor itself now
    stand.wait_until_alone(live)
    assert stand.bench.voltage() < 60.0
    assert "The high voltage is off, measured" in live.said
    assert "(monitor) shows" in live.said.splitlines()[-1]


def test_a_second_reading_that_dies_prevents_no_off_but_nobody_calls_it_safe(stand: Stand, live: Run) -> None:
    at = stand.bench.clock.now()
    stand.do(lambda bench: bench.inject(Fault(role="monitor", kind="silent", duration_s=3600.0)))
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.wait(lambda: live.status is not None, "the engine's end")
    assert stand.bench.voltage() < 60.0
    assert live.status == 4 and "NOT SAFE" in live.said and "(monitor) has given no value for" in live.said
    os.kill(live.guard, 9)
    stand.wait_until_alone(live)
    stand.do(lambda bench: bench._switch_upset(Fault(role="monitor", kind="silent"), 0, False))
    stand.do(lambda bench: setattr(bench.wire("monitor"), "upset_from_device", None))


@pytest.mark.parametrize("stand", METERS, indirect=True)  # a meter that sends by itself: once in CI
def test_an_engine_that_is_killed_leaves_the_monitor_to_the_guard(stand: Stand, live: Run) -> None:
    at = stand.kill(live.engine)
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.wait_until_alone(live)
    assert stand.bench.voltage() < 60.0
    last = live.said.strip().splitlines()[-1]
    assert "The high voltage is off, measured" in last and "(monitor) shows" in last


def test_a_guard_that_is_killed_leaves_both_to_the_engine(stand: Stand, live: Run) -> None:
    at = stand.kill(live.guard)
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.wait_until_alone(live)
    outcome = read_log(live.log).outcome
    assert live.status == 4 and outcome is not None and outcome["safe"] == "yes"
    assert "(monitor) shows" in outcome["second_reading"]


def test_an_engine_that_is_stopped_leaves_the_monitor_to_the_guard_until_it_goes_on(stand: Stand, live: Run) -> None:
    at = stand.kill(live.engine, signal.SIGSTOP)
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.wait(lambda: stand.bench.voltage() < 60.0, "the output's discharge")
    off = stand.bench.clock.now()
    stand.wait(lambda: stand.bench.clock.now() > off + 6.0, "the guard's judgement")
    assert live.status is None and "NOT SAFE" not in live.said
    stand.kill(live.engine, signal.SIGCONT)
    stand.wait_until_alone(live)
    outcome = read_log(live.log).outcome
    assert live.status == 4 and outcome is not None and outcome["safe"] == "yes"
    assert "(monitor) shows" in outcome["second_reading"] and "NOT SAFE" not in live.said


def test_an_engine_that_is_stopped_beside_a_supply_that_lies_is_called_not_safe_by_the_guard(
    stand: Stand, live: Run
) -> None:
    lie(stand, True)
    at = stand.kill(live.engine, signal.SIGSTOP)
    stand.wait(lambda: "dea-rig guard: NOT SAFE" in live.said, "the guard's word")
    assert stand.bench.voltage() > 780.0 and live.status is None
    assert "(monitor) shows" in live.said
    lie(stand, False)
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.kill(live.engine, signal.SIGCONT)
    stand.wait_until_alone(live)
    assert stand.bench.voltage() < 60.0 and live.status == 4
