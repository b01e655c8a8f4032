"""A CAN load cell and a serial supply without current monitor or trip flags: the same faults, the same safe ends."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from rig.base.errors import FaultError
from rig.log.reader import read_log
from rig.operator.control import Control
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.shvps import Shvps
from rig.sim.truth import Fault
from tests.protocols import TO_THE_FILM

Tell = Callable[..., Any]  # of conftest.Story
AT_ONCE_S = 1.5


@pytest.fixture
def tell_other(tell: Tell) -> Tell:
    return partial(tell, scene="other-instruments")


def inject(role: str, kind: str, **more: Any) -> Callable[[SimulatedBench, Control], None]:
    return lambda bench, stop: bench.inject(Fault(role=role, kind=kind, **more))


@pytest.mark.parametrize("kind", ["breakdown", "over_current", "sag"])
def test_without_a_current_monitor_a_failing_film_shows_in_the_voltage(tell_other: Tell, kind: str) -> None:
    story = tell_other(inject("hv", kind))
    assert isinstance(story.error, FaultError) and "sagged" in str(story.error), story.error
    assert story.error.breakdown
    assert story.outcome.safe and abs(story.final_output) < 60 and story.took < AT_ONCE_S


FINDS_A_BREAKDOWN = {
    "breakdown": 'do = "breakdown"\nceiling_V = 1200\n',
    "cycle": 'do = "cycle"\nwaveform = "square"\nto_V = 800\nperiod_s = 8.0\ncycles = 3\n',
}


def when_live(act: Callable[[SimulatedBench], None]) -> Callable[[float, SimulatedBench, Control], None]:
    done: list[float] = []

    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if not done and bench.world.output.at(now)[0] > 500.0:
            done.append(now)
            act(bench)

    return meanwhile


def test_without_a_current_monitor_a_sag_while_cycling_is_a_breakdown_and_the_result(tell_other: Tell) -> None:
    sag = when_live(lambda bench: bench.inject(Fault(role="hv", kind="sag")))
    protocol = f"{TO_THE_FILM}[[step]]\n{FINDS_A_BREAKDOWN['cycle']}"
    story = tell_other(meanwhile=sag, protocol=protocol)
    assert story.error is None and story.outcome.status == "complete" and story.outcome.safe, story.outcome
    found = [message.fields["outcome"] for message in read_log(story.log).messages("/result")]
    assert found and set(found) == {"breakdown"} and story.final_output < 60


@pytest.mark.parametrize("step", FINDS_A_BREAKDOWN)
def test_a_power_jack_that_falls_out_is_a_fault_and_no_breakdown(tell_other: Tell, step: str) -> None:
    def pull(bench: SimulatedBench) -> None:
        supply = bench.instruments["hv"]
        assert isinstance(supply, Shvps)
        supply.pull_jack(bench.now)

    story = tell_other(meanwhile=when_live(pull), protocol=f"{TO_THE_FILM}[[step]]\n{FINDS_A_BREAKDOWN[step]}")
    assert isinstance(story.error, FaultError) and not story.error.breakdown, story.outcome
    assert "the supply reports fault" in str(story.error)
    assert story.outcome.status == "fault" and story.outcome.safe and story.final_output < 60
    assert not list(read_log(story.log).messages("/result"))


def watch_targets(bench: SimulatedBench, targets: list[float]) -> None:
    """Write down every voltage that the supply is driven to from now on."""
    output = bench.world.output
    drive = output.ramp

    def ramp(t: float, target: float, rate: float) -> None:
        targets.append(target)
        drive(t, target, rate)

    output.ramp = ramp  # type: ignore[method-assign]


def test_lines_doubled_torn_and_late_change_nothing(tell_other: Tell) -> None:
    targets: list[float] = []

    def mischief(bench: SimulatedBench, stop: Control) -> None:
        watch_targets(bench, targets)
        for kind in ("duplicate", "split", "delay"):
            bench.inject(Fault(role="hv", kind=kind, value=0.02, probability=0.2))

    story = tell_other(mischief, quick=False)  # on the scene's own ramp, which takes many set-points
    assert story.error is None, story.error
    assert story.outcome.safe and story.final_output == 0.0
    assert max(targets) <= 1000.5 and len(targets) > 20


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_damaged_answers_never_raise_the_voltage(tell_other: Tell, seed: int) -> None:
    """There is no checksum: whatever a damaged digit says, it must not become a set-point."""
    targets: list[float] = []

    def mischief(bench: SimulatedBench, stop: Control) -> None:
        watch_targets(bench, targets)
        bench.inject(Fault(role="hv", kind="corrupt", probability=0.1))
        stop.ask("a test")  # so that the ramp down is what meets the damage

    story = tell_other(mischief, replace=("seed = 4", f"seed = {seed}"), quick=False)
    assert len(targets) > 10 and max(targets) <= 1000.5
    assert story.final_output < 60


def test_a_supply_found_live_is_reported_and_left_alone(tell_other: Tell) -> None:
    story = tell_other(replace=("[simulation.hv]", "[simulation.hv]\nstart_live_V = 500.0"))
    assert isinstance(story.error, FaultError) and "though nobody switched it on" in story.outcome.reason
    assert story.final_output == pytest.approx(500, abs=5) and not story.outcome.safe
    assert not {"set_voltage", "switch_off", "emergency_off"} & set(story.control_words)


@pytest.mark.parametrize("scene", ["cone-4mm", "other-instruments"])
def test_an_error_during_the_ramp_down_does_not_keep_the_emergency_off_from_being_sent(tell: Tell, scene: str) -> None:
    def mischief(bench: SimulatedBench, stop: Control) -> None:
        stop.ask("a test")
        bench.inject(Fault(role="hv", kind="silent", at_s=bench.now + 0.5))

    story = tell(mischief, scene=scene)
    assert story.outcome.status == "NOT SAFE" and not story.outcome.safe
    words = story.control_words
    assert set(words[words.index("switch_off") + 1 :]) == {"emergency_off"}
    assert abs(story.final_output) < 60
