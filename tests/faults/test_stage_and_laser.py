"""Stage and laser drivers on their simulated instruments when things go wrong: more than the matrix of switches says.

The instruments move in virtual time. The film is not asked: nothing here touches it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from drivers.instruments.keyence_lkg import KeyenceLKG
from drivers.instruments.zaber.device import ZaberStage
from drivers.links.link import DeviceError, DeviceRefused, DeviceSilent
from drivers.roles import DisplacementSample, SampleFlag, StageSample
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.zaber import ZaberTruth
from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault
from rig.sim.wire import ByteWire

SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
CONTACT = 2e-3  # m on the stage; the laser sees what goes beyond


class Rig:
    """Stage and laser, set up, the stage with its reference; errors are kept with their time."""

    def __init__(self) -> None:
        settings = SimulationSettings(
            seed=1,
            contact_position_mm=CONTACT * 1e3,
            rig_compliance_um_per_N=0.0,
            stage=ZaberTruth(start_position_mm=0.0, referenced_at_start=True),
        )
        self.bench = SimulatedBench(settings, SPECIMEN, {"stage", "displacement"})
        self.clock = VirtualClock(self.bench.advance)
        self.stage = ZaberStage("stage", self._link("stage"))
        self.laser = KeyenceLKG("laser", self._link("displacement"))
        self.errors: list[tuple[float, DeviceError]] = []
        self.positions: list[StageSample] = []
        self.values: list[DisplacementSample] = []
        self.run(0.2)
        assert self.stage.referenced and self.laser.ready and not self.errors
        self.positions.clear()
        self.values.clear()

    def _link(self, role: str) -> MemoryByteLink:
        wire = self.bench.wire(role)
        assert isinstance(wire, ByteWire)
        return MemoryByteLink(role, wire, self.clock)

    @property
    def t(self) -> float:
        return self.clock.now()

    def true_position(self, t: float) -> float:
        return float(self.bench.world.stage.at(t)[0])

    def inject(self, role: str, kind: str, **keys: object) -> None:
        self.bench.inject(Fault.model_validate({"role": role, "kind": kind, "at_s": self.t} | keys))

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            due = min(self.stage.next_poll, self.laser.next_poll, self.bench.next_time())
            self.clock.sleep_until(min(end, max(due, self.t + 1e-5)))
            for device, samples in ((self.stage, self.positions), (self.laser, self.values)):
                try:
                    samples += device.poll(self.t)  # type: ignore[operator]
                except DeviceError as error:
                    self.errors.append((self.t, error))

    def until_still(self, seconds: float = 20.0) -> None:
        end = self.t + seconds
        while self.stage.moving and self.t < end:
            self.run(0.02)
        assert not self.stage.moving


@pytest.fixture
def rig() -> Rig:
    return Rig()


def kinds(errors: Sequence[tuple[float, DeviceError]]) -> set[type[DeviceError]]:
    return {type(error) for _, error in errors}


# The stage's wire -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["from_device", pytest.param("to_device", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("kind", "value", "counter"),
    [
        ("delay", 0.1, "round_trips"),
        ("delay", 0.4, "unexpected_replies"),
        ("drop", None, "retries"),
        ("split", None, "round_trips"),
        ("merge", None, "retries"),
        ("duplicate", None, "round_trips"),
        ("corrupt", None, "retries"),
    ],
)
def test_bad_wire_to_the_stage_costs_time_but_never_truth(
    rig: Rig, kind: str, value: float | None, counter: str, direction: str
) -> None:
    """Every position is one the stage had at that time; when it is said to stand still, it does, at its target."""
    rig.inject("stage", kind, probability=0.05, value=value, direction=direction)
    begin, counted = rig.t, rig.stage.counters[counter]
    path = [(begin, rig.true_position(begin))]
    for target in (8e-3, 3e-3):
        rig.stage.move_to(target, 5e-3)
        while rig.stage.moving and not rig.errors:
            rig.run(0.01)
            path.append((rig.t, rig.true_position(rig.t)))
        if rig.errors:  # a question lost three times in a row is told, and may end a run, but is no lie
            assert kinds(rig.errors) == {DeviceSilent}
            break
        assert rig.true_position(rig.t) == pytest.approx(target, abs=0.3e-6)
        assert rig.bench.world.stage.at(rig.t)[1] == 0.0
    for sample in rig.positions:
        near = [x for t, x in path if abs(t - sample.t) <= 0.135]  # half of the longest round trip, our steps
        assert min(near) - 1e-6 <= sample.position <= max(near) + 1e-6
    assert len(rig.positions) > 40
    assert rig.stage.counters[counter] > counted


def test_stop_gets_through_to_a_stage_that_cannot_be_heard(rig: Rig) -> None:
    rig.stage.move_to(100e-3, 5e-3)
    rig.run(0.5)
    rig.inject("stage", "silent")
    rig.stage.stop()
    rig.run(0.5)
    assert rig.bench.world.stage.at(rig.t)[1] == 0.0
    assert rig.stage.moving  # nobody has said that it stands still


# The stage itself -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moving_for_s", [0.1, 0.737])
def test_stage_that_restarts_in_the_middle_of_a_move_is_refused_until_homed(rig: Rig, moving_for_s: float) -> None:
    rig.stage.move_to(100e-3, 10e-3)
    rig.run(moving_for_s)
    rig.inject("stage", "reset")
    rig.run(2.0)
    assert any("lost its reference position" in str(error) for _, error in rig.errors)
    assert not rig.stage.referenced and not rig.positions[-1].referenced
    with pytest.raises(DeviceRefused, match="Home it first"):
        rig.stage.move_to(5e-3, 5e-3)
    rig.errors.clear()
    rig.stage.home()
    rig.until_still()
    rig.stage.move_to(5e-3, 5e-3)
    rig.until_still()
    assert rig.true_position(rig.t) == pytest.approx(5e-3, abs=0.3e-6) and not rig.errors


def test_fault_flag_is_told_once(rig: Rig) -> None:
    rig.inject("stage", "wrong_status", duration_s=0.5)
    rig.run(1.0)
    assert ["FS: stalled and stopped" in str(error) for _, error in rig.errors] == [True]
    assert any(sample.warnings == ("FS",) for sample in rig.positions)
    assert not rig.positions[-1].warnings


# The laser ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["from_device", pytest.param("to_device", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("delay", 0.05),
        ("delay", 0.25),
        ("delay", 0.35),
        ("drop", None),
        ("split", None),
        ("merge", None),
        ("duplicate", None),
    ],
)
def test_bad_wire_to_the_laser_never_gives_an_old_value(
    rig: Rig, kind: str, value: float | None, direction: str
) -> None:
    rig.stage.move_to(3e-3, 10e-3)
    rig.until_still()
    rig.run(0.1)
    zero = rig.values[-1].displacement - 1e-3
    rig.values.clear()
    rig.inject("displacement", kind, probability=0.05, value=value, direction=direction)
    rig.stage.move_to(23e-3, 10e-3)  # 1 ms is 10 um
    rig.until_still()
    assert not rig.errors or kinds(rig.errors) == {DeviceSilent}
    assert len(rig.values) > 30
    for sample in rig.values:
        seen = sample.displacement - zero + CONTACT
        # half of the longest round trip, the averaging window, noise
        latest, earliest = rig.true_position(sample.t + 0.051), rig.true_position(sample.t - 0.051 - 13e-3)
        assert earliest - 20e-6 <= seen <= latest + 20e-6


def test_corrupt_laser_values_stay_within_what_the_head_can_see(rig: Rig) -> None:
    """There is no checksum: a digit may change unseen. Everything else is dropped, counted and asked for again."""
    rig.inject("displacement", "corrupt", probability=0.2)
    rig.run(4.0)
    assert all(abs(sample.displacement) <= 0.08 for sample in rig.values if not sample.flags)
    assert rig.laser.counters["bad_grammar"] > 5 and rig.laser.counters["retries"] > 5
    true = 1.25e-3
    right = [abs(sample.displacement - true) < 20e-6 for sample in rig.values]
    assert sum(right) > 0.8 * len(right)


@pytest.mark.parametrize(
    ("kind", "value", "flag"),
    [
        ("saturate", 1.0, SampleFlag.OVER_RANGE),
        ("saturate", -1.0, SampleFlag.UNDER_RANGE),
        ("no_value", None, SampleFlag.NO_VALUE),
    ],
)
def test_laser_that_sees_nothing_says_so_on_every_sample(
    rig: Rig, kind: str, value: float | None, flag: SampleFlag
) -> None:
    rig.inject("displacement", kind, value=value, duration_s=0.5)
    rig.run(0.5)
    flagged = rig.values[2:-2]
    assert len(flagged) > 40
    assert all(sample.flags == flag and sample.displacement != sample.displacement for sample in flagged)
    rig.values.clear()
    rig.run(0.2)
    assert not any(sample.flags for sample in rig.values[1:]) and not rig.errors


# What the stage lends ------------------------------------------------------------------------------------------------


class Found:
    """A stage of two axes with settings of its owner's, told what to do over its wire."""

    def __init__(self, **truth: object) -> None:
        settings = SimulationSettings(
            seed=1,
            rig_compliance_um_per_N=0.0,
            stage=ZaberTruth(start_position_mm=0.0, referenced_at_start=True, axes=2, **truth),  # type: ignore[arg-type]
        )
        self.bench = SimulatedBench(settings, SPECIMEN, {"stage"})
        self.clock = VirtualClock(self.bench.advance)
        self.twin: Any = self.bench.instruments["stage"]
        self.at_first = self.twin_settings()

    def twin_settings(self) -> tuple[dict[str, int], list[dict[str, int]]]:
        return dict(self.twin._values), [dict(other) for other in self.twin.others]

    def connect(self) -> ZaberStage:
        wire = self.bench.wire("stage")
        assert isinstance(wire, ByteWire)
        stage = ZaberStage("stage", MemoryByteLink("stage", wire, self.clock))
        self.run(stage, 0.2)
        assert stage.ready
        return stage

    def run(self, stage: ZaberStage, seconds: float) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            self.clock.sleep_until(min(end, max(stage.next_poll, self.clock.now() + 1e-4)))
            stage.poll(self.clock.now())


@pytest.mark.parametrize("when_set", [False, True])
@pytest.mark.parametrize("confirmed", [True, False])
def test_the_stage_gets_back_what_it_lent_and_other_axes_are_left_alone(when_set: bool, confirmed: bool) -> None:
    found = Found(checksums_when_set=when_set)
    stage = found.connect()
    assert found.twin_settings() == found.at_first  # connecting changes nothing
    stage.move_to(1e-3, 2e-3)
    found.run(stage, 0.2)
    own, others = found.twin_settings()
    assert own["knob.enable"] == 0 and own["maxspeed"] == pytest.approx(6605, abs=2)
    assert own["comm.checksum"] == int(when_set)
    assert others == found.at_first[1]
    if confirmed:
        found.run(stage, 2.0)
        stage.give_back()
        found.run(stage, 0.2)
        assert stage.given_back and found.twin_settings() == found.at_first
    stage.close()
    found.clock.sleep_until(found.clock.now() + 0.1)
    assert found.twin_settings() == found.at_first


def test_a_knob_that_was_disabled_stays_so() -> None:
    found = Found()
    found.twin._values["knob.enable"] = 0
    stage = found.connect()
    stage.move_to(1e-3, 2e-3)
    found.run(stage, 2.0)
    stage.give_back()
    found.run(stage, 0.2)
    stage.close()
    found.clock.sleep_until(found.clock.now() + 0.1)
    assert found.twin._values["knob.enable"] == 0 and found.twin._values["maxspeed"] == found.at_first[0]["maxspeed"]


def test_what_a_killed_run_left_is_given_back_by_the_next_one() -> None:
    found = Found(checksums_when_set=True)
    killed = found.connect()
    killed.move_to(1e-3, 2e-3)
    found.run(killed, 2.0)  # and it is never heard of again
    kept = dict(killed.found)
    stage = found.connect()
    left = stage.resume_found(kept)
    assert left.keys() == {"knob.enable", "maxspeed", "comm.checksum"} and left["knob.enable"] == (0, 1)
    stage.give_back()
    found.run(stage, 0.2)
    assert stage.given_back and found.twin_settings() == found.at_first
    assert found.connect().resume_found(kept) == {}  # what is right again is left alone


@pytest.mark.parametrize("serial", [50_443, 50_444])
def test_two_stages_with_one_address_are_refused_before_anything_moves(serial: int) -> None:
    """By what they answer, or, where both say the same, by answering everything twice."""
    found, other = Found(), Found(serial_number=serial)
    one = found.twin.receive

    def both(data: bytes, t: float) -> None:
        one(data, t)
        other.twin.receive(data, t)

    other.twin._wire = found.twin._wire
    found.twin.receive = both
    with pytest.raises(DeviceRefused, match="two devices have the address 1") as caught:
        found.connect()
    assert ("'50443' and '50444'" in str(caught.value)) is (serial == 50_444)
    assert found.twin_settings() == found.at_first and other.twin_settings() == other.at_first
    assert found.bench.world.stage.at(found.clock.now())[0] == 0.0


@pytest.mark.slow
def test_a_laser_in_another_unit_ends_the_run_before_the_film_is_met(tell: Any) -> None:
    """One that sees the pusher, and shows 4 mm for each."""

    def sees_the_pusher(now: float, bench: SimulatedBench, control: Any) -> None:
        bench.world.fixture = "target"

    story = tell(meanwhile=sees_the_pusher, replace=("gain_error = -3e-4", "gain_error = 3.0"))
    assert "times as much" in str(story.error) and "The film was not met yet" in str(story.error), story.error
    assert story.bench.world.indentation_at(story.end) == 0.0
