"""The way to contact: the stage is never sent further than half a second's travel ahead of where it was measured.

What is asserted is where the simulated stage went. Engines that are really killed: `test_processes.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest

from drivers.links.link import DeviceSilent
from rig.base.clock import VirtualClock
from rig.base.errors import FaultError, StaleData
from rig.log.reader import read_log
from rig.operator.control import Control
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.zaber import ZaberStage
from rig.sim.truth import Fault

Tell = Callable[..., Any]  # of conftest.Story
SPEED = 0.8e-3  # m/s
LEG = 0.5 * SPEED + SPEED**2 / (2 * 0.2)  # m: half a second, and the way to brake at 200 mm/s^2
STEP = 0.49609375e-6  # m: the stage's resolution
START, CONTACT = 36e-3, 40e-3  # m: where the approach begins, and where the film is
PROTOCOL = f"""
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.5
[[step]]
do = "approach"
speed_mm_per_s = {SPEED * 1e3}
threshold_mN = 8.0
max_travel_mm = 8.0
"""


@pytest.fixture
def tell(tell: Tell) -> Tell:
    """With the scenes' own way to the film, and all turns of the loop."""
    return partial(tell, nearer=False, quick=False)


@dataclass
class Way:
    """What the true stage did, at each turn of the loop."""

    t: float
    x: float
    v: float
    end: float  # where it will stand if nobody sends it elsewhere


@pytest.fixture
def ways(monkeypatch: pytest.MonkeyPatch) -> list[Way]:
    """Of the approach, from its first motion to its stop, as it goes on."""
    found: list[Way] = []
    advance = SimulatedBench.advance

    def watched(bench: SimulatedBench, t: float) -> None:
        advance(bench, t)
        stage = bench.world.stage
        x, v = stage.at(t)
        if x >= START - STEP and v >= 0:
            found.append(Way(t, x, v, stage.at(stage.end)[0]))

    monkeypatch.setattr(SimulatedBench, "advance", watched)
    return found


def furthest_ahead(ways: list[Way]) -> float:
    """How far the stage would have gone on at most (m), had the engine died at any turn.

    What the engine sent in a turn is on its way then and shows in one of the next ones.
    """
    return max(later.end - earlier.x for earlier, later in zip(ways, ways[2:], strict=False))


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "accuracy"), [("cone-4mm", 5e-6), ("no-hv", 0.2e-3)])  # by laser, by force alone
def test_legs_find_contact_where_one_motion_does_and_as_soon(
    tell: Tell, ways: list[Way], monkeypatch: pytest.MonkeyPatch, scene: str, accuracy: float
) -> None:
    legs = tell(scene=scene, protocol=PROTOCOL)
    assert furthest_ahead(ways) <= LEG + STEP
    on_the_way = [way for way in ways if START + 0.1e-3 < way.x < CONTACT - 0.1e-3]
    assert len(on_the_way) > 500
    assert all(way.v == pytest.approx(SPEED, rel=1e-3) for way in on_the_way)  # it never stops between legs
    commanded = legs.stage_words.count("move_to")
    assert 10 < commanded < 3 + (max(way.x for way in ways) - START) / (0.3 * LEG)
    ways.clear()
    legs.log.unlink()

    monkeypatch.setattr("rig.steps.approach.LEG_S", 1e9)  # one motion for the whole way
    one = tell(scene=scene, protocol=PROTOCOL)
    assert furthest_ahead(ways) > 7e-3
    assert one.stage_words.count("move_to") == 3
    # It ends where contact was found: there the disk is at displacement zero.
    where = [story.bench.world.stage.at(story.end)[0] for story in (legs, one)]
    assert where[0] == pytest.approx(where[1], abs=STEP * 1.001)
    assert where[0] == pytest.approx(CONTACT, abs=accuracy)
    assert legs.outcome.status == one.outcome.status == "complete"
    assert legs.end <= one.end + 0.05


@pytest.mark.parametrize(("speed", "leg"), [pytest.param(0.1, 0.1e-3, marks=pytest.mark.slow), (5.0, 2.5625e-3)])
def test_a_leg_is_half_a_second_and_the_braking_but_not_much_shorter_than_what_a_stage_resolves(
    tell: Tell, ways: list[Way], speed: float, leg: float
) -> None:
    protocol = PROTOCOL.replace(f"= {SPEED * 1e3}", f"= {speed}")
    story = tell(
        protocol=protocol, replace=("approach_from_mm = 36.0", "approach_from_mm = 39.6") if speed < 1 else None
    )
    assert story.outcome.status == "complete", story.outcome.reason
    towards = [way for way in ways if 0 < way.v <= speed * 1.001e-3]
    assert furthest_ahead(towards) == pytest.approx(leg, rel=0.05)
    travelled = towards[-1].x - towards[0].x
    assert travelled > min(0.9e-3, 3 * leg) and story.stage_words.count("move_to") <= 3 + travelled / (0.3 * leg)


@pytest.mark.slow
def test_an_engine_that_hangs_leaves_the_stage_within_a_leg_and_goes_on_where_it_stands(
    tell: Tell, ways: list[Way], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hung for three seconds, at many moments; then it finds contact where it would have."""
    undisturbed = tell(protocol=PROTOCOL)
    undisturbed.log.unlink()
    ways.clear()
    sleep_until, hung = VirtualClock.sleep_until, list[tuple[Way, Way]]()

    def held_up(clock: VirtualClock, t: float) -> None:
        sleep_until(clock, t)
        if not ways or ways[-1].x < START + (2 * len(hung) + 0.137) * LEG or ways[-1].x > CONTACT - 2 * LEG:
            return
        before = ways[-1]
        sleep_until(clock, clock.now() + 3.0)
        hung.append((before, ways[-1]))

    monkeypatch.setattr(VirtualClock, "sleep_until", held_up)
    story = tell(protocol=PROTOCOL)
    assert len(hung) >= 4
    for before, after in hung:
        assert before.v == pytest.approx(SPEED, rel=1e-3)
        assert after.v == 0.0 and 0.3 * LEG < after.x - before.x <= LEG + STEP
    where = [one.bench.world.stage.at(one.end)[0] for one in (story, undisturbed)]
    assert where[0] == pytest.approx(where[1], abs=2e-6)
    assert story.outcome.status == "complete", story.outcome.reason


def test_no_leg_is_sent_without_news_of_the_force(tell: Tell, ways: list[Way]) -> None:
    def silence(now: float, bench: SimulatedBench, control: Control) -> None:
        if ways and ways[-1].x > START + 1e-3 and not silent:
            silent.append(now)
            bench.inject(Fault(role="force", kind="silent"))

    silent: list[float] = []
    slow = ('driver = "gsv8"', 'driver = "gsv8"\ntimeout_s = 0.6')
    story = tell(meanwhile=silence, protocol=PROTOCOL, replace=slow)
    assert isinstance(story.error, StaleData | DeviceSilent) and "force" in story.outcome.reason
    log = read_log(story.log)
    felt = log.columns("/force/sample")["t_s"][-1]
    moves = [m.fields["t_s"] for m in log.messages("/command") if m.fields["command"] == "move_to"]
    assert moves[-1] <= felt + 0.16 and story.end > felt + 0.6  # at most what the last sample still allowed
    at_silence = next(way.x for way in ways if way.t >= silent[0])
    assert ways[-1].x - at_silence <= 1.5 * LEG


def test_contact_that_is_missed_ends_at_the_travel_allowed(tell: Tell, ways: list[Way]) -> None:
    story = tell(protocol=PROTOCOL.replace("max_travel_mm = 8.0", "max_travel_mm = 2.0"))
    assert isinstance(story.error, FaultError) and "not met within 2 mm of travel" in story.outcome.reason
    assert max(way.end for way in ways) == pytest.approx(START + 2e-3, abs=STEP)
    assert ways[-1].x == pytest.approx(START + 2e-3, abs=STEP)


def test_a_stage_that_somebody_stops_is_not_sent_on(tell: Tell, ways: list[Way]) -> None:
    def stop(now: float, bench: SimulatedBench, control: Control) -> None:
        stage = bench.instruments["stage"]
        assert isinstance(stage, ZaberStage)
        if ways and ways[-1].x > START + 1e-3 and not stopped:
            stopped.append(ways[-1].x)
            stage.receive(b"/1 1 stop\n", now)

    stopped: list[float] = []
    story = tell(meanwhile=stop, protocol=PROTOCOL)
    assert isinstance(story.error, FaultError) and "Did something stop it?" in story.outcome.reason
    assert ways[-1].x - stopped[0] < LEG
    assert ways[-1].v == 0.0
