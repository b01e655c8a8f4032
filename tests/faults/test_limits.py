"""Limits in the lowest layer, fresh data, breakdown: what the simulated hardware did when one of them did not hold.

The plan is not checked beforehand where the rig itself has to refuse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.roles import ForceSample
from rig.base.errors import FaultError, LimitError, StaleData
from rig.base.toml_file import parse_table
from rig.engine.watch import FROZEN_FEWEST, Watch
from rig.log.reader import read_log
from rig.log.recorder import Gains, Recorder
from rig.operator.control import Control
from rig.run.backend import open_bench
from rig.safety.limits import Limits, check_zero
from rig.scene.scene import Scene
from rig.sim.bench import SimulatedBench
from rig.sim.truth import Fault
from tests.protocols import TO_THE_FILM

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
Tell = Callable[..., Any]  # of conftest.Story
CONTACT_MM = 4.0
HEAD = TO_THE_FILM
MOVE_INTO_THE_FIELD_LIMIT = (
    HEAD
    + """
[[step]]
do = "voltage"
voltage_V = 1500
[[step]]
do = "ramp"
displacement_mm = 13.0
speed_mm_per_s = 4.0
"""
)
VOLTAGE_INTO_THE_FIELD_LIMIT = (
    HEAD
    + """
[[step]]
do = "ramp"
displacement_mm = 13.0
speed_mm_per_s = 4.0
[[step]]
do = "voltage"
voltage_V = 1500
"""
)


def inject(role: str, kind: str, **more: Any) -> Callable[[SimulatedBench, Control], None]:
    return lambda bench, control: bench.inject(Fault(role=role, kind=kind, **more))


def furthest_mm(story: Any) -> float:
    """How far beyond contact the stage's true position ever was."""
    return float(max(row for row in read_log(story.log).columns("/stage/sample")["position_m"])) * 1e3 - CONTACT_MM


def test_a_move_into_the_field_limit_is_refused_before_the_stage_moves(tell: Tell) -> None:
    story = tell(protocol=MOVE_INTO_THE_FIELD_LIMIT, checked=False)
    assert isinstance(story.error, LimitError) and "field" in str(story.error), story.error
    assert furthest_mm(story) < 2.0 and story.bench.world.stage.at(story.end)[0] < (CONTACT_MM + 2.0) * 1e-3
    assert max(volts for _, volts in story.outputs) > 1490 and abs(story.final_output) < 60


def test_a_voltage_into_the_field_limit_is_refused_before_the_output_rises(tell: Tell) -> None:
    story = tell(protocol=VOLTAGE_INTO_THE_FIELD_LIMIT, checked=False)
    assert isinstance(story.error, LimitError) and "field" in str(story.error), story.error
    assert furthest_mm(story) > 12.9 and max(volts for _, volts in story.outputs) < 1.0


def test_a_film_that_is_moved_by_somebody_else_is_cut_off_at_its_field_limit(tell: Tell) -> None:
    """The commands were legal; what is measured is not."""

    def push(bench: SimulatedBench, control: Control) -> None:
        now = bench.now
        bench.world.stage.ramp(now, (CONTACT_MM + 30.0) * 1e-3, 20e-3)

    story = tell(push, replace=("field_V_per_um = 80.0", "field_V_per_um = 44.0"))
    assert isinstance(story.error, LimitError) and "Film, as measured: field" in str(story.error), story.error
    assert story.control_words[-1] == "emergency_off" and abs(story.final_output) < 60


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("field_V_per_um = 80.0", "field_V_per_um = 80.0\nstored_energy_mJ = 0.3"),  # 0.73 nF at 1000 V is 0.37 mJ
        ("ramp_V_per_s = 300.0", "ramp_V_per_s = 300.0\nparallel_capacitance_nF = 800.0"),  # 400 mJ
    ],
)
def test_a_voltage_that_would_store_too_much_energy_is_refused(tell: Tell, old: str, new: str) -> None:
    story = tell(replace=(old, new), checked=False)
    assert isinstance(story.error, LimitError) and "stored energy" in str(story.error), story.error
    assert max(volts for _, volts in story.outputs) < 1.0
    with pytest.raises(LimitError, match=r"Step 4 .*stored energy"):
        tell(replace=(old, new))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ramp_V_per_s = 300.0", "ramp_V_per_s = 3000.0", "hv.ramp_V_per_s, for this supply: ramp 3000 V/s"),
        ("current_uA = 50.0", "current_uA = 5000.0", "limits.current_uA, for this supply"),
        (
            "[simulation.hv]",
            "[simulation.hv]\nnominal_voltage_V = 900.0",
            "highest voltage, for this supply: voltage 1000",
        ),
        ("approach_from_mm = 36.0", "approach_from_mm = 160.0", "approach_from_mm, for this stage"),
        ("approach_from_mm = 36.0", "approach_from_mm = 1.0", "Clearance of the return step"),
        ("[simulation.film]", "[simulation.stage]\ntravel_mm = 41.0\n[simulation.film]", "Largest displacement"),
    ],
)
def test_what_the_devices_cannot_do_is_refused_before_anything_moves(
    tell: Tell, old: str, new: str, words: str
) -> None:
    story = tell(replace=(old, new), nearer=False)
    assert isinstance(story.error, LimitError) and words in str(story.error), story.error
    assert not {"home", "move_to"} & set(story.stage_words) and not story.control_words
    assert story.bench.world.stage.at(story.end)[0] == pytest.approx(12e-3)  # where it was switched on


@pytest.mark.parametrize(
    ("role", "kind"),
    [
        *[("force", kind) for kind in ("silent", "freeze", "saturate", "wrong_status")],
        *[("displacement", kind) for kind in ("silent", "freeze", "saturate", "no_value")],
        *[("stage", kind) for kind in ("silent", "freeze")],
    ],
)
def test_without_fresh_data_the_stage_stops_within_two_periods_and_the_time_out_and_the_voltage_ramps_down(
    tell: Tell, role: str, kind: str
) -> None:
    story = tell(inject(role, kind))
    assert story.outcome.status == "fault" and role in story.outcome.reason, story.outcome.reason
    stops = [m.fields["t_s"] for m in read_log(story.log).messages("/command") if m.fields["command"] == "stop"]
    period = {"force": 0.01, "displacement": 0.02, "stage": 0.02}[role]
    # The driver's last good sample may be a period old, and the loop turns every 5 ms. What freezes is noticed by
    # comparison: by the sensor's own noise, or by what the other of stage and laser says.
    noticed = 0.45 if kind == "freeze" and role != "force" else 3 * period + 0.25 + 0.01
    assert min(t for t in stops if t > story.mischief_at) - story.mischief_at <= noticed
    still = story.bench.world.stage.at(story.end)
    assert still[1] == 0.0 and (still[0] - CONTACT_MM * 1e-3) < 6e-3  # on the way it was sent, and not at its end
    assert story.control_words[-1] == "switch_off" and "emergency_off" not in story.control_words
    assert abs(story.final_output) < 60 and story.outcome.safe


@pytest.mark.parametrize(("amperes", "trips"), [(1e-6, False), (5e-6, True)])
def test_a_current_that_charging_does_not_explain_is_a_breakdown_within_two_samples(
    tell: Tell, amperes: float, trips: bool
) -> None:
    """Both are far below the supply's own current limit of 50 uA."""
    story = tell(inject("hv", "over_current", value=amperes))
    assert (isinstance(story.error, FaultError) and "breakdown" in str(story.error)) is trips, story.error
    if not trips:
        return
    log = read_log(story.log)
    samples = log.columns("/hv/sample")
    # A sample's time is half-way between question and answer: that of the first may be the mischief's own.
    excess = samples["t_s"][(samples["t_s"] > story.mischief_at - 0.01) & (samples["current_A"] > 3e-6)]
    off = next(m.fields["t_s"] for m in log.messages("/command") if m.fields["command"] == "emergency_off")
    assert 0.0 <= off - excess[1] < 0.05  # told off with the second of them
    assert abs(story.final_output) < 60
    snapshot = {key: float(log.metadata["snapshot"][key]) for key in ("at_s", "from_s", "to_s")}
    assert "breakdown" in log.metadata["snapshot"]["cause"] and snapshot["at_s"] == pytest.approx(off, abs=0.05)
    for topic in ("/hv/sample", "/force/sample", "/displacement/sample", "/stage/sample"):
        t = log.columns(topic)["t_s"]
        assert t.min() < snapshot["from_s"] == snapshot["at_s"] - 1.0 and t.max() > snapshot["to_s"] - 0.15
        assert snapshot["to_s"] == pytest.approx(snapshot["at_s"] + 1.0)


@pytest.mark.parametrize("kind", ["sag", "breakdown"])
def test_a_sagging_output_is_taken_off_within_two_samples(tell: Tell, kind: str) -> None:
    story = tell(inject("hv", kind))
    assert isinstance(story.error, FaultError | LimitError), story.error
    assert story.control_words[-1] == "emergency_off"
    log = read_log(story.log)
    off = next(m.fields["t_s"] for m in log.messages("/command") if m.fields["command"] == "emergency_off")
    samples = log.columns("/hv/sample")
    sagged = (samples["t_s"] > story.mischief_at) & (samples["t_s"] < off) & (samples["voltage_V"] < 945)
    assert sagged.sum() <= 2


# Force against the stored zero ----------------------------------------------------------------------------------------

LIMIT_N, GAIN = 0.9, 0.5


class NoLog:
    """Where a recorder writes when nobody reads."""

    def write(self, *row: object) -> None: ...


def watch_with(stored_zero: float | None) -> tuple[Watch, Recorder, Limits]:
    scene = parse_table((SCENES / "cone-4mm.toml").read_text(), Scene, "scene", "test")
    bench = open_bench(scene)
    bench.attach(lambda role, way, data, t=0.0: None)
    recorder = Recorder(NoLog(), bench.clock, Gains(force=GAIN, stored_zero=stored_zero), has_laser=True)  # type: ignore[arg-type]
    limits = Limits.of(scene)
    return Watch(bench, recorder, limits, None), recorder, limits


@given(
    stored=st.one_of(st.none(), st.floats(-0.1, 0.1)),
    zeros=st.lists(st.floats(-4.0, 4.0), max_size=5),
    reading=st.one_of(st.floats(-6.0, 6.0), st.sampled_from([math.nan, math.inf, -math.inf])),
)
def test_no_row_of_zero_steps_carries_the_force_limit_away(
    stored: float | None, zeros: list[float], reading: float
) -> None:
    """Whatever zeros are taken, and refused, no force beyond the limit from the stored zero is let pass."""
    watch, recorder, limits = SHARED[stored is not None]
    recorder._gains = Gains(force=GAIN, stored_zero=stored)
    recorder.force_zero = math.nan
    for zero in zeros:
        try:
            check_zero(limits, recorder.from_stored_zero(zero))
        except LimitError:
            continue
        recorder.force_zero = zero
    true = GAIN * (reading - (stored or 0.0))
    allowed = LIMIT_N * (1.0 if stored is not None else 1.25)
    try:
        watch.sample("force", ForceSample(0.0, reading), 0.0)
    except StaleData:
        pass
    except LimitError:
        tared = GAIN * (reading - recorder.force_zero)
        assert not abs(true) <= allowed or not abs(tared) <= LIMIT_N
    else:
        assert abs(true) <= allowed * (1 + 1e-12)


SHARED = {known: watch_with(0.0 if known else None) for known in (True, False)}


def test_a_zero_far_from_the_stored_one_is_refused_though_its_reading_is_small(tell: Tell) -> None:
    story = tell(stored_zero=-0.6)  # the sensor's zero is 0.013 mV/V: 0.3 N from there
    assert isinstance(story.error, LimitError) and "against the stored zero" in str(story.error)
    assert "move_to" not in story.stage_words


def test_how_many_equal_readings_mean_frozen_is_learnt_from_the_sensors_own_noise() -> None:
    watch, _, _ = watch_with(None)
    for coarse, expected in [(1e-9, FROZEN_FEWEST), (0.5, 12)]:
        readings = [round(math.sin(7.0 * k) / coarse) * coarse for k in range(1000)]
        watch.learn("force", readings)
        assert expected <= watch._frozen["force"] <= expected + 12


@pytest.mark.parametrize(
    "scale", [0.0, pytest.param(-1.0, marks=pytest.mark.slow), pytest.param(0.03, marks=pytest.mark.slow)]
)
def test_a_force_that_does_not_follow_the_film_ends_the_run(tell: Tell, scale: float) -> None:
    """A load cell that stands still, or nearly, or goes the other way; its noise is as ever."""

    def freeze(bench: SimulatedBench, control: Control) -> None:
        twin: Any = bench.instruments["force"]
        true, at = twin._bridge, twin._bridge(bench.now)
        twin._bridge = lambda t: at + scale * (true(t) - at)

    story = tell(freeze)
    assert isinstance(story.error, FaultError) and "does not follow the film" in str(story.error), story.error
    assert "limits.force_model_factor = 10" in str(story.error)
    # The stage was stopped on its way, and the voltage is gone.
    assert story.bench.world.stage.at(story.end)[0] - CONTACT_MM * 1e-3 < 5.5e-3
    assert abs(story.final_output) < 60 and story.outcome.safe


@pytest.mark.parametrize("times", [pytest.param(0.25, marks=pytest.mark.slow), 4.0])
def test_a_film_four_times_softer_or_stiffer_than_believed_is_still_a_film(tell: Tell, times: float) -> None:
    def scale(bench: SimulatedBench, control: Control) -> None:
        twin: Any = bench.instruments["force"]
        true, at = twin._bridge, twin._bridge(bench.now)
        twin._bridge = lambda t: at + times * (true(t) - at)

    assert "does not follow" not in str(tell(scale).error)


def test_a_wide_factor_switches_the_comparison_off(tell: Tell) -> None:
    def freeze(bench: SimulatedBench, control: Control) -> None:
        twin: Any = bench.instruments["force"]
        at = twin._bridge(bench.now)
        twin._bridge = lambda t: at

    story = tell(freeze, replace=("[limits]", "[limits]\nforce_model_factor = 1000.0"))
    assert story.error is None, story.error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "old", "new"),
    [
        ("cone-4mm", "max_stretch = 2.4", "max_stretch = 1.3"),
        (
            "no-hv",
            'material = "parker-cao2018"',
            "material = { mu_Pa = [5e3, 35e3], alpha = [2.5, 5.6], max_stretch = 1.3 }",
        ),
    ],
)
def test_a_film_is_not_stretched_beyond_what_it_stands(tell: Tell, scene: str, old: str, new: str) -> None:
    """With high voltage the guard refuses the move; without, the watch ends the run at the displacement measured."""
    ramp = HEAD + '[[step]]\ndo = "ramp"\ndisplacement_mm = 8.0\nspeed_mm_per_s = 2.0\n'
    story = tell(protocol=ramp, checked=False, scene=scene, replace=(old, new), nearer=scene != "no-hv")
    assert isinstance(story.error, LimitError) and "max_stretch" in str(story.error), story.error
    assert story.bench.world.indentation_at(story.end) < 4.2e-3  # 1.3 is reached at 3.8 mm
