"""The film's largest stretch is held by plan, guard and watch: what cannot tear it is allowed, and nothing else."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from model.membrane.solve import solve
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
