"""The plan against the scene's limits: each is accepted at what the model expects, and refused just below."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from model.membrane.history import at_once, solve_history
from model.membrane.solve import solve, solve_many
from rig.base.errors import LimitError
from rig.base.toml_file import validate
from rig.protocol import predict
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene, load_scene

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
STEPS = [
    {"do": "home"},
    {"do": "zero"},
    {"do": "approach"},
    {"do": "sweep", "displacement_mm": 5.0, "from_mm": 1.0, "speed_mm_per_s": 1.5, "voltages_V": [0.0, 1500.0]},
    {"do": "return", "speed_mm_per_s": 1.5},
]
VOLTS = 1500.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "cone-4mm.toml")[0]


def check(scene: Scene, **limits: Any) -> None:
    raw = scene.model_dump(exclude_none=True)
    raw["limits"] |= {"speed_mm_per_s": 1.5, **limits}
    raw["accept"] = [f"limits.{key}" for key in limits]
    other = validate(raw, Scene, "scene", "test")
    protocol = Protocol.model_validate({"step": STEPS})
    check_plan(plan(protocol, other), other)


def expected(scene: Scene) -> dict[str, tuple[float, str]]:
    """By the model asked directly: for each limit the value that this protocol reaches, and the limit's name."""
    film = scene.specimen.specimen()
    h = [1e-3 + k * 4e-3 / 400 for k in range(401)]
    states = [solve_many(film, h, [volts] * 401) for volts in (0.0, VOLTS)]
    at_top = solve(film, 5e-3, VOLTS)
    assert scene.hv is not None
    beside = scene.hv.parallel_capacitance_nF * 1e-9
    energy = 0.5 * (at_top.capacitance() + beside) * VOLTS**2
    return {
        "force_N": (max(float(one.force.max()) for one in states), "force"),
        "displacement_mm": (5.0, "displacement"),
        "speed_mm_per_s": (1.5, "speed"),
        "voltage_V": (VOLTS, "voltage"),
        "field_V_per_um": (max(float(one.peak_field.max()) for one in states) * 1e-6, "field"),
        "stored_energy_mJ": (energy * 1e3, "stored energy"),
    }


@pytest.mark.parametrize(
    "key", ["force_N", "displacement_mm", "speed_mm_per_s", "voltage_V", "field_V_per_um", "stored_energy_mJ"]
)
def test_each_limit_is_kept(scene: Scene, key: str) -> None:
    value, name = expected(scene)[key]
    check(scene, **{key: value * (1 + 1e-6)})
    with pytest.raises(LimitError, match=rf"Step \d .*{name} .* is outside"):
        check(scene, **{key: value * (1 - 1e-3)})


def test_the_least_hoop_stress_is_kept(scene: Scene) -> None:
    film = scene.specimen.specimen()
    h = [1e-3 + k * 4e-3 / 400 for k in range(401)]
    least = min(float(solve_many(film, h, [volts] * 401).min_hoop_stress.min()) for volts in (0.0, VOLTS)) * 1e-3
    assert least > 1.0
    check(scene, minimum_hoop_stress_kPa=least * (1 - 1e-6))
    with pytest.raises(LimitError, match=r"Step 4 \(sweep.*hoop stress .* is outside the limit \(at least"):
        check(scene, minimum_hoop_stress_kPa=least * (1 + 1e-3))


def test_nan_fails_every_limit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    made = predict.predict
    for name in ("peak_force", "peak_field", "minimum_hoop_stress", "stored_energy"):

        def spoilt(*arguments: Any, name: str = name) -> Any:
            return replace(made(*arguments), **{name: float("nan")})

        monkeypatch.setattr(predict, "predict", spoilt)
        with pytest.raises(LimitError, match="is outside"):
            check(scene)


def test_a_film_that_takes_time_is_expected_as_stiff_as_it_is_at_once(scene: Scene) -> None:
    """Its largest force is that of branches that were not stretched before: more than (1 + ratio) times at times."""
    raw = scene.model_dump(exclude_none=True)
    raw["specimen"]["material"]["branches"] = [{"ratio": 0.2, "time_s": 1.0}, {"ratio": 0.1, "time_s": 10.0}]
    viscous = validate(raw, Scene, "scene", "test")
    film = viscous.specimen.specimen()
    largest = float(at_once(film, 5e-3))
    relaxed = float(solve(film, 5e-3).force)
    assert largest > 1.02 * relaxed
    slow = solve_history(film, [0.0, 1e-4, 1.0], [0.0, 5e-3, 5e-3], 0.0, [1e-4], tolerance=1e-5).force[0]
    assert largest == pytest.approx(slow, rel=1e-3)
    check(scene, force_N=relaxed * (1 + 1e-5))
    check(viscous, force_N=largest * (1 + 1e-5))
    with pytest.raises(LimitError, match="force"):
        check(viscous, force_N=largest * (1 - 1e-4))
