"""The film's largest stretch is held by plan, guard and watch: what cannot tear it is allowed, and nothing else."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from model.membrane.solve import Solution, solve
from model.specimen import Specimen
from rig.base.errors import LimitError
from rig.base.toml_file import parse_table
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.safety.limits import FilmLimits, Limits, Line, StretchLimit
from rig.scene.scene import Scene
from tests.protocols import TO_THE_FILM

SCENE = (Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml").read_text()
RAMP = TO_THE_FILM + '[[step]]\ndo = "ramp"\ndisplacement_mm = 8.0\nspeed_mm_per_s = 2.0\n'


def scene(largest: str) -> Scene:
    return parse_table(SCENE.replace("max_stretch = 2.4", largest), Scene, "scene", "test")


def test_a_plan_that_would_tear_the_film_is_refused() -> None:
    stretch = solve(scene("").specimen.specimen(), 8e-3, 0.0).max_stretch
    for largest in (f"max_stretch = {stretch * 1.001}", ""):
        one = scene(largest)
        check_plan(plan(parse_table(RAMP, Protocol, "protocol", "test"), one), one)
    one = scene(f"max_stretch = {stretch * 0.999}")
    with pytest.raises(LimitError, match=r"Step \d \(ramp, .*predicted: stretch .* is outside .*max_stretch"):
        check_plan(plan(parse_table(RAMP, Protocol, "protocol", "test"), one), one)


def test_guard_and_watch_hold_it_at_the_displacement_measured() -> None:
    one = scene("max_stretch = 1.5")
    limits, specimen = Limits.of(one), one.specimen.specimen()
    film, watch = FilmLimits(specimen, limits), StretchLimit(specimen, limits)
    for h, holds in ((5e-3, True), (9e-3, False)):
        assert (solve(specimen, h, 0.0).max_stretch < 1.5) is holds
        for check in (lambda h: film.check(h, 500.0, "Film"), lambda h: watch.check(h, "Film")):
            if holds:
                check(h)
            else:
                with pytest.raises(LimitError, match="Film: stretch"):
                    check(h)
    watch.check(float("nan"), "before contact")
    StretchLimit(scene("").specimen.specimen(), Limits.of(scene(""))).check(1.0, "nothing is known")


def test_straight_lines_are_those_of_numpy_to_the_bit() -> None:
    rng = np.random.default_rng(1)
    for count in (2, 3, 17, 33):
        x = np.sort(rng.uniform(0.0, 0.015, count))
        y = rng.standard_normal(count)
        line = Line(x, y)
        for h in (*rng.uniform(-0.002, 0.017, 100), *x):
            assert line(float(h)) == float(np.interp(h, x, y))


def test_the_capacitance_is_asked_again_once_the_film_has_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two samples of a film at rest the model is not asked, and what it said is right to a thousandth."""
    one = scene("")
    film = FilmLimits(one.specimen.specimen(), Limits.of(one))
    asked: list[tuple[float, float]] = []

    def ask(specimen: Specimen, h: float, volts: float) -> Solution:
        asked.append((h, volts))
        return solve(specimen, h, volts)

    monkeypatch.setattr("rig.safety.limits.solve", ask)
    parallel = film.capacitance(8e-3, 1000.0) - solve(one.specimen.specimen(), 8e-3, 1000.0).capacitance()
    for h, volts in ((8e-3, 1000.0), (8.001e-3, 1000.9), (7.999e-3, 999.1)):
        truth = solve(one.specimen.specimen(), h, volts).capacitance() + parallel
        assert film.capacitance(h, volts) == pytest.approx(truth, rel=1e-3)
    assert asked == [(8e-3, 1000.0)]
    for h, volts in ((8.003e-3, 1000.0), (8.003e-3, 1002.0)):
        truth = solve(one.specimen.specimen(), h, volts).capacitance() + parallel
        assert film.capacitance(h, volts) == pytest.approx(truth, rel=1e-12)
    assert math.isnan(film.capacitance(math.nan, 0.0)) and len(asked) == 4
