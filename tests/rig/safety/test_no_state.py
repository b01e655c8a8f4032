"""A film without a stable, determined state at a voltage does not bear it: guard, plan and simulated film say so."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from model.material.materials import Material
from model.membrane import solve as membrane
from model.membrane.solve import Solution, Solutions, Status
from model.specimen import Specimen
from rig.base.errors import LimitError
from rig.protocol import predict
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.safety import limits as safety
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import load_scene
from rig.sim.film import solve_membrane

SCENE, _ = load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")
NONE = (Status.UNSTABLE, Status.NOT_CONVERGED, Status.SLACK)
# Its relaxed law loses convexity at 528 V, at 20 mm.
STIFFENING = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("s", (2e4, 3.0), (1.8, 14.0), 3.0, breakdown_field=1e9))
# Low exponents pull in before they lose tension.
SOFT = Specimen(4e-3, 20e-3, 100e-6, 3.0, Material("soft", (1e5,), (1.3,), 3.0, breakdown_field=1e9))


def _limits() -> Limits:
    return Limits.of(SCENE)


@pytest.mark.parametrize("status", NONE)
@pytest.mark.parametrize("numbers", [float("nan"), 0.0])
def test_the_guard_refuses_whatever_the_numbers_say(
    monkeypatch: pytest.MonkeyPatch, status: Status, numbers: float
) -> None:
    def solve(specimen: Specimen, h: float, voltage: float) -> Solution:
        found = membrane.solve(specimen, h, 0.0)
        return replace(found, voltage=voltage, status=status, peak_field=numbers, min_hoop_stress=1e6, stable=False)

    monkeypatch.setattr(safety, "solve", solve)
    with pytest.raises(LimitError):
        FilmLimits(SCENE.specimen.specimen(), _limits()).check(5e-3, 500.0, "Test")


@pytest.mark.parametrize(("film", "h", "volts"), [(STIFFENING, 20e-3, 545.738), (SOFT, 10e-3, 345.0)])
def test_the_guard_refuses_films_without_a_state(film: Specimen, h: float, volts: float) -> None:
    guarded = FilmLimits(film, _limits())
    with pytest.raises(LimitError):
        guarded.check(h, volts, "Test")
    with pytest.raises(LimitError):
        guarded.check_path(0.5 * h, h, volts)


@pytest.mark.parametrize("status", NONE)
def test_the_plan_refuses_one_such_state_on_the_way(monkeypatch: pytest.MonkeyPatch, status: Status) -> None:
    def solve_many(specimen: Specimen, h: np.ndarray, voltage: np.ndarray) -> Solutions:
        found = membrane.solve_many(specimen, h, voltage)
        states = found.status.copy()
        states.flat[states.size // 2] = status
        return replace(found, status=states)

    steps = [
        {"do": "home"},
        {"do": "zero"},
        {"do": "approach"},
        {"do": "sweep", "displacement_mm": 5.0, "from_mm": 1.0, "speed_mm_per_s": 1.0, "voltages_V": [0.0, 1000.0]},
        {"do": "return", "speed_mm_per_s": 1.0},
    ]
    actions = plan(Protocol.model_validate({"step": steps}), SCENE)
    check_plan(actions, SCENE)
    monkeypatch.setattr(predict, "solve_many", solve_many)
    with pytest.raises(LimitError, match="no taut state"):
        check_plan(actions, SCENE)


@pytest.mark.parametrize(("film", "h", "volts"), [(STIFFENING, 20e-3, 545.738), (SOFT, 10e-3, 345.0)])
def test_the_simulated_film_has_no_state_there(film: Specimen, h: float, volts: float) -> None:
    _, _, found = solve_membrane(film, np.array([h, h]), np.array([0.5 * volts, volts]))
    np.testing.assert_array_equal(found, [True, False])


def test_a_film_that_hangs_slack_is_refused_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search takes up to half a second, in which the guard would be taken for dead."""
    film = SCENE.specimen.specimen()
    guarded = FilmLimits(film, _limits())
    for h, volts in ((0.0, 3000.0), (2e-3, 3000.0), (14e-3, 5000.0)):
        assert membrane.solve(film, max(h, 1e-6), volts).status is Status.SLACK
        with monkeypatch.context() as patch, pytest.raises(LimitError, match="hangs slack"):
            patch.setattr(safety, "solve", None)
            guarded.check(h, volts, "there")
    for h, volts in ((0.0, 0.0), (2e-3, 1000.0), (11e-3, 1500.0)):
        assert not membrane.hangs_slack(film, max(h, 1e-6), volts)
