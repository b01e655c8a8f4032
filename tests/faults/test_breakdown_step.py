"""A breakdown that is wanted is a result: complete, off at once and proven, the values those of the simulated film."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.roles import HVFlag, HVSample
from rig.base.errors import LimitError
from rig.log.reader import read_log
from rig.scene.scene import load_scene
from rig.sim.truth import Fault
from rig.steps.breakdown import Last, Rise, film_at
from tests.protocols import TO_THE_FILM

Tell = Callable[..., Any]  # of conftest.Story
SCENES = Path(str(files("sim_fixtures"))) / "scenes"
HEAD = (
    TO_THE_FILM
    + """[[step]]
do = "ramp"
displacement_mm = 3.0
speed_mm_per_s = 4.0
"""
)
TEST = HEAD + '[[step]]\ndo = "breakdown"\nceiling_V = 1700\n'
AFTER = '[[step]]\ndo = "ramp"\ndisplacement_mm = 2.0\nspeed_mm_per_s = 4.0\n'
WEAK = ("[simulation.film]", "[simulation.film]\nbreakdown_field_MV_per_m = 40.0")


def results(story: Any) -> dict[str, dict[str, Any]]:
    return {m.fields["name"]: m.fields for m in read_log(story.log).messages("/result")}


@pytest.mark.parametrize("rate", [None, pytest.param(100.0, marks=pytest.mark.slow)])
def test_a_breakdown_is_the_result_and_the_output_is_off_at_once(tell: Tell, rate: float | None) -> None:
    text = TEST + (f"rate_V_per_s = {rate}\n" if rate else "") + AFTER
    story = tell(replace=WEAK, protocol=text)
    assert story.error is None and story.outcome.status == "complete" and story.outcome.safe, story.outcome
    assert story.final_output == 0.0 and "emergency_off" in story.control_words
    truth = story.bench.world.film.breakdown_voltage(3e-3)
    found = results(story)
    assert {one["outcome"] for one in found.values()} == {"breakdown"}
    voltage = found["voltage"]
    allowed = 3.0 * voltage["standard_uncertainty"] + 0.01 * truth
    assert abs(voltage["value"] - truth) < allowed < 0.2 * truth
    assert found["field_at_disk"]["value"] == pytest.approx(40e6, rel=0.08)
    assert found["displacement"]["value"] == pytest.approx(3e-3, abs=0.1e-3)
    # Nothing after it is done, and the time around it is marked.
    assert "2 mm" not in "".join(m.fields["label"] for m in read_log(story.log).messages("/phase"))
    assert "snapshot" in read_log(story.log).metadata
    after = [t for t, volts in story.outputs if volts > 60.0]
    assert not after or max(after) < story.end - 0.5


@pytest.mark.parametrize(
    "films",
    [pytest.param(3, marks=pytest.mark.slow), pytest.param(500, marks=[pytest.mark.long, pytest.mark.timeout(7200)])],
)
def test_every_breakdown_is_off_and_proven(tell: Tell, films: int) -> None:
    """Of films of any strength, at any displacement and rate, with arcs of any resistance."""
    rng, broken = np.random.default_rng(11), 0
    while broken < films:
        strength, h = 40.0 * rng.weibull(6.0), rng.uniform(1.0, 6.0)
        rate, arc = rng.uniform(100.0, 500.0), 10.0 ** rng.uniform(1.0, 4.0)
        ramp = f'[[step]]\ndo = "ramp"\ndisplacement_mm = {h:.3f}\nspeed_mm_per_s = 4.0\n'
        story = tell(
            replace=("[simulation.film]", f"[simulation.film]\nbreakdown_field_MV_per_m = {max(strength, 12.0):.4g}"),
            also=("[simulation.hv]", f"[simulation.hv]\narc_resistance_kOhm = {arc:.4g}"),
            protocol=TO_THE_FILM + ramp + f'[[step]]\ndo = "breakdown"\nceiling_V = 1700\nrate_V_per_s = {rate:.4g}\n',
            checked=False,
            quick=True,
        )
        what = (strength, h, rate, arc, story.outcome)
        assert story.outcome.safe and story.outcome.status in ("complete", "limit"), what
        assert story.final_output < 60.0, what
        log = read_log(story.log)
        samples = log.columns("/hv/sample")
        assert (np.abs(samples["voltage_V"][-2:]) < 60.0).all() and not (
            samples["flags"][-2:] & HVFlag.ON.value
        ).any(), what
        (outcome,) = {one["outcome"] for one in results(story).values()} or {"none"}
        if story.bench.world.broken_down:
            broken += 1
            assert outcome == "breakdown" and "emergency_off" in story.control_words, what
            found = results(story)["voltage"]
            truth = story.bench.world.film.breakdown_voltage(h * 1e-3)
            assert abs(found["value"] - truth) < 3.0 * found["standard_uncertainty"] + 0.02 * truth, (
                what,
                found,
                truth,
            )
        story.log.unlink()
        print(broken, flush=True)


@pytest.mark.slow
def test_without_a_current_an_output_that_sags_is_a_breakdown_and_its_voltage_an_upper_bound(tell: Tell) -> None:
    broken = ("[simulation.film]", "[simulation.film]\nbreakdown_field_MV_per_m = 25.0")
    arc = ("[simulation.hv]", "[simulation.hv]\narc_resistance_kOhm = 400.0")
    story = tell(
        scene="other-instruments", replace=broken, also=arc, protocol=TEST.replace("1700", "1200"), checked=False
    )
    assert story.error is None and story.outcome.status == "complete" and story.outcome.safe, story.outcome
    assert story.bench.world.broken_down and story.final_output < 60.0
    found = results(story)
    assert {one["outcome"] for one in found.values()} == {"breakdown"}
    truth = story.bench.world.film.breakdown_voltage(3e-3)
    assert truth <= found["voltage"]["value"] <= 1.15 * truth
    assert found["field_at_disk"]["value"] >= 0.99 * 25e6  # of the model, which has not quite the film's law
    assert all(math.isnan(found[name]["standard_uncertainty"]) for name in ("voltage", "field", "field_at_disk"))
    assert "or below (no current is measured)" in story.outcome.reason


@pytest.mark.parametrize(
    ("samples", "ceiling", "outcome", "value"),
    [
        ([(0.0, 470.0), (0.1, 500.0), (0.25, 10.0), (0.35, 4.0)], 1200.0, "breakdown", 500.0 + 0.15 * 300.0),
        ([(0.0, 470.0), (0.1, 500.0), (0.25, 10.0)], 520.0, "breakdown", 520.0),  # no higher was asked for
        ([(0.0, 470.0), (0.1, 500.0)], 1200.0, "limit", 500.0),  # a film that has borne it
        ([(0.0, 0.0), (0.1, 0.0)], 1200.0, "limit", 0.0),
    ],
)
def test_without_a_current_what_is_written_bounds_what_the_film_bore(
    samples: list[tuple[float, float]], ceiling: float, outcome: str, value: float
) -> None:
    written: dict[str, tuple[float, float]] = {}

    def result(step: int, kind: str, outcome: str, name: str, value: float, uncertainty: float, unit: str) -> None:
        written[name] = value, uncertainty

    scene, _ = load_scene(SCENES / "other-instruments.toml")
    recorder = SimpleNamespace(displacement=3e-3, result=result)
    rig: Any = SimpleNamespace(scene=scene, recorder=recorder, event=lambda *said: None)
    last = Last(rig)
    for t, volts in samples:
        last(HVSample(t, volts, math.nan, 1000.0, HVFlag.ON))
    plan = {"by": None, "kind": "breakdown", "step": 1, "label": "", "h": (3e-3, 3e-3), "voltage": (0.0, ceiling)}
    last.write(Rise(**plan, duration=10.0, rate=300.0, most=300.0, hold=0.0), outcome, 5.0)  # type: ignore[arg-type]
    assert written["voltage"][0] == pytest.approx(value)
    peak, edge, charge = film_at(scene.specimen.specimen(), 3e-3, value)
    assert [written[name][0] for name in ("field", "field_at_disk", "charge")] == pytest.approx([peak, edge, charge])
    known = outcome == "limit" and value > 0.0
    assert all(math.isfinite(written[name][1]) is known for name in ("field", "field_at_disk", "charge"))


def test_a_film_that_bears_the_ceiling_is_censored_there_and_the_run_goes_on(tell: Tell) -> None:
    story = tell(protocol=TEST.replace("1700", "900") + "hold_s = 1.0\n" + AFTER)
    assert story.error is None and story.outcome.status == "complete" and story.outcome.safe
    found = results(story)
    assert {one["outcome"] for one in found.values()} == {"ceiling"}
    assert found["voltage"]["value"] == pytest.approx(900.0, abs=10.0)
    assert "2 mm" in "".join(m.fields["label"] for m in read_log(story.log).messages("/phase"))


def test_a_limit_that_is_met_first_is_a_limit_and_says_so(tell: Tell) -> None:
    story = tell(protocol=TEST, replace=("field_V_per_um = 80.0", "field_V_per_um = 30.0"), checked=False)
    assert isinstance(story.error, LimitError) and story.outcome.status == "limit" and story.outcome.safe
    assert story.final_output == 0.0


def test_a_fault_is_no_result(tell: Tell) -> None:
    def fail(now: float, bench: Any, control: Any) -> None:
        if bench.world.output.at(now)[0] > 500.0:
            bench.inject(Fault.model_validate({"role": "force", "kind": "silent"}))

    story = tell(protocol=TEST, meanwhile=fail)
    assert story.outcome.status == "fault" and not results(story) and story.final_output < 60.0


def test_a_breakdown_elsewhere_is_still_a_fault(tell: Tell) -> None:
    story = tell(replace=WEAK, protocol=HEAD + '[[step]]\ndo = "voltage"\nvoltage_V = 1700\n')
    # As a breakdown or by the limit of the current, whichever sample shows it first.
    assert story.outcome.status in ("fault", "limit") and not results(story)


@pytest.mark.parametrize("more", ["rate_V_per_s = 1000.0\n", ""])
def test_a_rate_above_the_supplys_and_a_ceiling_below_what_is_on_are_refused(tell: Tell, more: str) -> None:
    before = '[[step]]\ndo = "voltage"\nvoltage_V = 1700\n' if not more else ""
    with pytest.raises(LimitError, match="rate_V_per_s" if more else "ceiling_V"):
        tell(protocol=TEST.replace('[[step]]\ndo = "breakdown"', before + '[[step]]\ndo = "breakdown"') + more)


@pytest.mark.parametrize(
    ("seconds", "volts"), [(0.05, 25.0), (0.5, 50.0), (0.55, 75.0), (0.6, 100.0), (1.0, 100.0), (1.02, 110.0)]
)
def test_stairs_rise_at_the_ramp_of_the_supply(seconds: float, volts: float) -> None:
    """Of 100 V/s in stairs of half a second, each climbed at 500 V/s."""
    plan = {"by": None, "kind": "breakdown", "step": 1, "label": "", "h": (0.0, 0.0), "voltage": (0.0, 1e3)}
    rise = Rise(**plan, duration=10.0, rate=100.0, most=500.0, hold=0.0)  # type: ignore[arg-type] # by: no step is asked
    assert rise.rise_in(seconds) == pytest.approx(volts)
    assert np.isnan(rise.rise_in(float("nan")))
