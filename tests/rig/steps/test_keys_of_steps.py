"""Every key of every step: its default, its bounds, and which part of the plan it moves - exactly that part.

The tables here are written by hand from the manual, so that neither a default nor a bound moves unnoticed; that no key
is missing from them is held against the registry.
"""

from __future__ import annotations

from dataclasses import fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from rig.base.errors import LimitError
from rig.protocol.plan import plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import load_scene
from rig.steps import registry

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
BEFORE: dict[str, list[dict[str, Any]]] = {
    "nothing": [],
    "homed": [{"do": "home"}],
    "referenced": [{"do": "home"}, {"do": "zero"}],
    "contact": [{"do": "home"}, {"do": "zero"}, {"do": "approach"}],
    "raised": [
        {"do": "home"},
        {"do": "zero"},
        {"do": "approach"},
        {"do": "ramp", "displacement_mm": 1.0, "speed_mm_per_s": 1.0},
        {"do": "voltage", "voltage_V": 100.0},
    ],
}
SPRING = {"kind": "spring", "preload_N": 0.3, "stiffness_N_per_mm": 0.02}
STIFFER = {"kind": "spring", "preload_N": 0.3, "stiffness_N_per_mm": 0.03}

# By step: what comes before it, and the least that it needs.
LEAST: dict[str, tuple[str, dict[str, Any]]] = {
    "home": ("nothing", {}),
    "zero": ("nothing", {}),
    "approach": ("referenced", {}),
    "precondition": ("contact", {"displacement_mm": 4.0, "speed_mm_per_s": 1.0}),
    "ramp": ("contact", {"displacement_mm": 4.0, "speed_mm_per_s": 1.0}),
    "hold": ("raised", {"duration_s": 3.0}),
    "prompt": ("nothing", {"text": "Close the lid."}),
    "voltage": ("contact", {"voltage_V": 500.0}),
    "sweep": ("contact", {"displacement_mm": 4.0, "speed_mm_per_s": 1.0, "voltages_V": [0.0, 500.0]}),
    "relax": ("contact", {"displacements_mm": [2.0, 4.0], "speed_mm_per_s": 5.0, "hold_s": 30.0, "voltage_V": 500.0}),
    "breakdown": ("contact", {"ceiling_V": 1500.0}),
    "cycle": ("contact", {"to_mm": 4.0, "period_s": 20.0, "cycles": 100, "waveform": "trapezoid"}),
    "learn": ("contact", {"until": "eps_r 0.5 %"}),
    "return": ("raised", {}),
    "follow": ("contact", {"bias": SPRING, "voltages_V": [500.0]}),
    "mount": ("nothing", {"fixture": "none"}),
    "weigh": ("nothing", {"weights_g": [0.0, 20.0], "creep_s": 5.0}),
    "visit": ("homed", {"positions_mm": [10.0, 12.0]}),
    "glide": ("homed", {"from_mm": 1.0, "to_mm": 3.0, "speeds_mm_per_s": [1.0, 2.0]}),
    "press": ("homed", {"force_N": 0.5}),
    "meter": ("nothing", {"voltages_V": [0.0, 500.0]}),
    "jog": ("nothing", {"moves": ["20", "+1"]}),
}
DEFAULTS: dict[str, dict[str, Any]] = {
    "home": {},
    "zero": {"duration_s": 2.0},
    "approach": {"speed_mm_per_s": 0.5, "threshold_mN": 5.0, "max_travel_mm": 20.0},
    "precondition": {"cycles": 3, "valid_for_min": 60.0},
    "ramp": {},
    "hold": {},
    "prompt": {},
    "voltage": {"settle_s": 1.0},
    "sweep": {"from_mm": 0.0, "voltages_V": [0.0], "cycles": 1, "settle_s": 1.0},
    "relax": {"voltage_V": 0.0, "voltage_after": 0.5},
    "breakdown": {"rate_V_per_s": None, "hold_s": 0.0},
    "cycle": {
        "waveform": "triangle",
        "from_mm": 0.0,
        "to_mm": None,
        "from_V": 0.0,
        "to_V": None,
        "rest_share": 0.25,
        "cycles": None,
        "hours": None,
        "keep_every": 0,
        "reference_cycle": 10,
        "stop_below_percent": None,
        "stop_above_percent": None,
        "stop_leakage_nA": None,
    },
    "learn": {"at_most_min": 60.0, "speed_mm_per_s": 5.0, "settle_s": 1.0, "terms": 2},
    "return": {"speed_mm_per_s": 2.0, "clearance_mm": 2.0},
    "follow": {"rate_Hz": 40.0, "speed_mm_per_s": 1.0, "settle_s": 1.0, "average_s": 5.0, "patience_s": 60.0},
    "mount": {},
    "weigh": {
        "cycles": 2,
        "settle_s": 2.0,
        "average_s": 2.0,
        "weight_uncertainty_mg": 1.0,
        "density_kg_per_m3": 8000.0,
        "air_density_kg_per_m3": 1.2,
        "gravity_m_per_s2": 9.80665,
        "gravity_uncertainty_m_per_s2": 0.005,
        "preloads": 1,
        "creep_s": 0.0,
    },
    "visit": {"cycles": 2, "settle_s": 2.0, "average_s": 2.0, "speed_mm_per_s": 5.0, "accuracy_um": 5.0},
    "glide": {"cycles": 2},
    "press": {
        "cycles": 2,
        "settle_s": 2.0,
        "average_s": 2.0,
        "step_um": 0.5,
        "speed_mm_per_s": 0.05,
        "accuracy_um": 0.2,
    },
    "meter": {
        "cycles": 2,
        "settle_s": 2.0,
        "average_s": 2.0,
        "meter_relative_uncertainty": 5e-4,
        "meter_uncertainty_V": 0.5,
    },
    "jog": {"moves": [], "step_mm": 0.1, "speed_mm_per_s": 1.0},
}
# Another value of a key, and what of the actions it moves: names of fields; "number" of actions.
MOVES: dict[str, dict[str, tuple[Any, set[str]]]] = {
    "home": {},
    "zero": {"duration_s": (3.0, {"duration"})},
    "approach": {
        "speed_mm_per_s": (0.4, {"duration", "speed"}),
        "threshold_mN": (6.0, {"threshold"}),
        "max_travel_mm": (10.0, {"duration", "max_travel"}),
    },
    "precondition": {
        "displacement_mm": (3.0, {"label", "h", "duration"}),
        "speed_mm_per_s": (0.5, {"duration", "speed"}),
        "cycles": (2, {"number"}),
        "valid_for_min": (10.0, set()),
    },
    "ramp": {
        "displacement_mm": (3.0, {"label", "h", "duration"}),
        "speed_mm_per_s": (0.5, {"duration", "speed"}),
    },
    "hold": {"duration_s": (4.0, {"duration"})},
    "prompt": {"text": ("Open the lid.", {"label"})},
    "voltage": {
        "voltage_V": (600.0, {"label", "voltage", "duration"}),
        "settle_s": (2.0, {"duration", "settle"}),
    },
    "sweep": {
        "displacement_mm": (3.0, {"label", "h", "duration"}),
        "from_mm": (1.0, {"number"}),  # a way there; more in a test of its own
        "speed_mm_per_s": (0.5, {"duration", "speed"}),
        "voltages_V": ([0.0, 600.0], {"label", "voltage", "duration"}),
        "cycles": (2, {"number"}),
        "settle_s": (2.0, {"duration", "settle"}),
    },
    "relax": {
        "displacements_mm": ([2.0, 3.0], {"label", "h", "duration"}),
        "speed_mm_per_s": (4.0, {"duration", "speed"}),
        "hold_s": (40.0, {"duration"}),
        "voltage_V": (600.0, {"label", "voltage", "duration"}),
        "voltage_after": (0.4, {"duration"}),
    },
    "breakdown": {
        "ceiling_V": (1600.0, {"label", "voltage", "duration"}),
        "rate_V_per_s": (100.0, {"label", "duration", "rate"}),
        "hold_s": (5.0, {"duration", "hold"}),
    },
    "cycle": {
        "waveform": ("triangle", {"speed", "rise_s"}),
        "from_mm": (1.0, {"number"}),  # a way there
        "to_mm": (3.0, {"label", "h", "speed"}),
        "from_V": (10.0, {"number"}),
        "to_V": (700.0, {"label", "voltage"}),
        "period_s": (30.0, {"label", "duration", "speed", "rise_s"}),
        "rest_share": (0.3, {"speed", "rise_s"}),
        "cycles": (50, {"label", "duration"}),
        "hours": (2.0, {"label", "duration"}),
        "keep_every": (7, set()),  # of the log, not of the plan
        "reference_cycle": (20, set()),
        "stop_below_percent": (80.0, set()),
        "stop_above_percent": (120.0, set()),
        "stop_leakage_nA": (50.0, set()),
    },
    "learn": {  # the ways that it may go carry the step itself
        "until": ("eps_r 1 %", {"label", "ways"}),
        "at_most_min": (30.0, {"duration", "ways"}),
        "speed_mm_per_s": (2.0, {"speed_between", "ways"}),
        "settle_s": (2.0, {"ways"}),
        "terms": (1, {"ways"}),  # of the fits
    },
    "return": {
        "speed_mm_per_s": (1.0, {"duration", "speed"}),
        "clearance_mm": (3.0, {"h", "duration"}),
    },
    "follow": {
        "bias": (STIFFER, {"label", "h", "duration", "bias", "gain"}),
        "voltages_V": ([600.0], {"label", "voltage", "h", "duration"}),
        "rate_Hz": (20.0, {"rate"}),
        "speed_mm_per_s": (0.5, {"duration", "speed"}),
        "settle_s": (2.0, {"duration", "settle"}),
        "average_s": (6.0, {"duration", "average"}),
        "patience_s": (30.0, {"patience"}),
    },
    "mount": {"fixture": ("dummy", {"label", "fixture"})},
    "weigh": {
        "weights_g": ([0.0, 30.0], {"label", "applied"}),
        "cycles": (3, {"number"}),
        "settle_s": (3.0, {"duration", "settle"}),
        "average_s": (3.0, {"duration", "average"}),
        "weight_uncertainty_mg": (2.0, {"applied_error"}),
        "density_kg_per_m3": (8400.0, {"applied", "applied_error"}),
        "air_density_kg_per_m3": (1.1, {"applied", "applied_error"}),
        "gravity_m_per_s2": (9.81, {"applied", "applied_error"}),
        "gravity_uncertainty_m_per_s2": (0.001, set()),
        "preloads": (2, {"number"}),
        "creep_s": (6.0, {"duration", "average"}),
    },
    "visit": {
        "positions_mm": ([10.0, 13.0], {"label", "position", "duration"}),
        "cycles": (3, {"number"}),
        "settle_s": (3.0, {"duration", "settle"}),
        "average_s": (3.0, {"duration", "average"}),
        "speed_mm_per_s": (4.0, {"duration", "speed"}),
        "accuracy_um": (3.0, {"applied_error"}),
    },
    "glide": {
        "from_mm": (0.5, {"label", "start", "goal", "duration"}),
        "to_mm": (3.5, {"label", "start", "goal", "duration"}),
        "speeds_mm_per_s": ([1.0, 3.0], {"label", "speed", "duration"}),
        "cycles": (3, {"number"}),
    },
    "press": {
        "force_N": (0.6, {"label", "force"}),
        "step_um": (0.6, {"length"}),
        "speed_mm_per_s": (0.06, {"speed"}),
        "accuracy_um": (0.3, {"applied_error"}),
        "cycles": (3, {"cycles", "duration"}),
        "settle_s": (3.0, {"duration", "settle"}),
        "average_s": (3.0, {"duration", "average"}),
    },
    "meter": {
        "voltages_V": ([0.0, 600.0], {"label", "voltage", "duration"}),
        "cycles": (3, {"number"}),
        "settle_s": (3.0, {"duration", "settle"}),
        "average_s": (3.0, {"duration", "average"}),
        "meter_relative_uncertainty": (1e-3, {"relative_error"}),
        "meter_uncertainty_V": (0.6, {"applied_error"}),
    },
    "jog": {
        "moves": (["21", "read"], {"label", "move", "duration"}),
        "step_mm": (0.2, {"length"}),
        "speed_mm_per_s": (2.0, {"speed"}),
    },
}
# Keys that exclude each other: what else is given where one of these is.
BY_VOLTAGE, BY_TIME = {"to_mm": None, "to_V": 600.0}, {"cycles": None, "hours": 1.0}
INSTEAD: dict[tuple[str, str], dict[str, Any]] = {
    ("cycle", "from_V"): BY_VOLTAGE,
    ("cycle", "to_V"): BY_VOLTAGE,
    ("cycle", "hours"): BY_TIME,
}
TINY = 1e-9
# Values that are just allowed, and values just beyond.
NOT_NEGATIVE, POSITIVE = ([0.0], [-TINY]), ([TINY], [0.0, -1.0])
CYCLES, CALIBRATION_CYCLES = ([1, 1000], [0, 1001, 1.5]), ([1, 20], [0, 21])
STANDARDS = ([[0.0, 1.0], [0.0] * 50], [[1.0], [0.0] * 51, [0.0, -TINY]])
AVERAGED = {"cycles": CALIBRATION_CYCLES, "settle_s": NOT_NEGATIVE, "average_s": POSITIVE}
BOUNDS: dict[str, dict[str, tuple[list[Any], list[Any]]]] = {
    "home": {},
    "zero": {"duration_s": POSITIVE},
    "approach": {"speed_mm_per_s": POSITIVE, "threshold_mN": POSITIVE, "max_travel_mm": POSITIVE},
    "precondition": {
        "displacement_mm": POSITIVE,
        "speed_mm_per_s": POSITIVE,
        "cycles": CYCLES,
        "valid_for_min": NOT_NEGATIVE,
    },
    "ramp": {"displacement_mm": NOT_NEGATIVE, "speed_mm_per_s": POSITIVE},
    "hold": {"duration_s": POSITIVE},
    "prompt": {"text": (["x", "x" * 200, "[red]"], ["", "x" * 201, "a\nb", "\x1b[31m", "\x7f"])},
    "voltage": {"voltage_V": NOT_NEGATIVE, "settle_s": NOT_NEGATIVE},
    "sweep": {
        "displacement_mm": POSITIVE,
        "from_mm": NOT_NEGATIVE,
        "speed_mm_per_s": POSITIVE,
        "voltages_V": ([[0.0], [0.0] * 100], [[], [0.0] * 101, [-TINY]]),
        "cycles": CYCLES,
        "settle_s": NOT_NEGATIVE,
    },
    "relax": {
        "displacements_mm": ([[0.0], [float(n) for n in range(50)]], [[], [1.0, 1.0], [float(n) for n in range(51)]]),
        "speed_mm_per_s": POSITIVE,
        "hold_s": POSITIVE,
        "voltage_V": NOT_NEGATIVE,
        "voltage_after": ([TINY, 1.0 - TINY], [0.0, 1.0]),
    },
    "breakdown": {"ceiling_V": POSITIVE, "rate_V_per_s": POSITIVE, "hold_s": NOT_NEGATIVE},
    "cycle": {
        "waveform": (["triangle", "trapezoid", "square"], ["sine", "saw", ""]),  # no stage follows a sine
        "from_mm": ([0.0, 4.0 - TINY], [-TINY, 4.0]),
        "to_mm": POSITIVE,
        "from_V": ([0.0, 600.0 - TINY], [-TINY, 600.0]),
        "to_V": POSITIVE,
        "period_s": POSITIVE,
        "rest_share": ([TINY, 0.5 - TINY], [0.0, 0.5]),
        "cycles": ([1, 10**9], [0, 10**9 + 1, 1.5]),
        "hours": ([20.0 / 3600.0 + TINY], [0.0, 20.0 / 3600.0 - 1e-6]),
        "keep_every": ([0, 10**9], [-1, 10**9 + 1]),
        "reference_cycle": ([1, 10**6], [0, 10**6 + 1]),
        "stop_below_percent": ([TINY, 100.0 - TINY], [0.0, 100.0]),
        "stop_above_percent": ([100.0 + TINY, 1000.0 - TINY], [100.0, 1000.0]),
        "stop_leakage_nA": POSITIVE,
    },
    "learn": {
        "until": (
            ["eps_r 0.5 %", "eps_r 0.5 %, stiffness 1 %", "stiffness 1e-3 % noise and zeros", "EPS_R 50 %"],
            ["", "eps_r", "eps_r 0.5", "eps_r 0 %", "eps_r -1 %", "esp_r 1 %", "eps_r 1 %, eps_r 2 %", "eps_r 51 %"],
        ),
        "at_most_min": ([1.0, 1440.0], [1.0 - TINY, 1440.1]),
        "speed_mm_per_s": POSITIVE,
        "settle_s": NOT_NEGATIVE,
        "terms": ([1, 3], [0, 4, 1.5]),
    },
    "return": {"speed_mm_per_s": POSITIVE, "clearance_mm": NOT_NEGATIVE},
    "follow": {
        "bias": ([SPRING, {"kind": "mass", "weight_N": TINY}], [{"kind": "lever"}, {"kind": "mass", "weight_N": 0.0}]),
        "voltages_V": ([[TINY], [1.0] * 50], [[], [1.0] * 51, [0.0]]),
        "rate_Hz": ([5.0, 100.0], [4.999, 100.001]),
        "speed_mm_per_s": POSITIVE,
        "settle_s": POSITIVE,
        "average_s": POSITIVE,
        "patience_s": POSITIVE,
    },
    "mount": {"fixture": (["film", "target", "dummy", "none"], ["spring", ""])},
    "weigh": {
        **AVERAGED,
        "weights_g": STANDARDS,
        "weight_uncertainty_mg": NOT_NEGATIVE,
        "density_kg_per_m3": POSITIVE,
        "air_density_kg_per_m3": NOT_NEGATIVE,
        "gravity_m_per_s2": POSITIVE,
        "gravity_uncertainty_m_per_s2": NOT_NEGATIVE,
        "preloads": ([0, 10], [-1, 11]),
        "creep_s": NOT_NEGATIVE,
    },
    "visit": {
        **AVERAGED,
        "positions_mm": ([[0.0], [1.0] * 50], [[], [1.0] * 51, [-TINY]]),
        "speed_mm_per_s": POSITIVE,
        "accuracy_um": NOT_NEGATIVE,
    },
    "glide": {
        "from_mm": ([0.0, 3.0 - TINY], [-TINY, 3.0]),
        "to_mm": ([1.0 + TINY], [1.0]),
        "speeds_mm_per_s": ([[1.0, 1.0], [1.0] * 20], [[1.0], [1.0] * 21, [1.0, 0.0]]),
        "cycles": CALIBRATION_CYCLES,
    },
    "press": {
        **AVERAGED,
        "force_N": POSITIVE,
        "step_um": POSITIVE,
        "speed_mm_per_s": POSITIVE,
        "accuracy_um": NOT_NEGATIVE,
    },
    "meter": {
        **AVERAGED,
        "voltages_V": STANDARDS,
        "meter_relative_uncertainty": NOT_NEGATIVE,
        "meter_uncertainty_V": NOT_NEGATIVE,
    },
    "jog": {
        "moves": ([[], ["home"] * 200, ["+.5", "-2", "20."]], [["home"] * 201, [""], ["up"], ["1e3"], ["1,5"]]),
        "step_mm": POSITIVE,
        "speed_mm_per_s": POSITIVE,
    },
}
KEYS = [(do, key) for do, keys in MOVES.items() for key in keys]


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENES / "cone-4mm.toml")[0]


def actions_of(do: str, scene: Any, **changes: Any) -> list[Any]:
    """The actions of one step; those of the steps before it are left out."""
    before, keys = LEAST[do]
    steps = [*BEFORE[before], {"do": do, **keys, **changes}]
    return [one for one in plan(Protocol.model_validate({"step": steps}), scene) if one.step == len(steps)]


def moved(before: list[Any], after: list[Any]) -> set[str]:
    """Which fields of any action differ."""
    if len(before) != len(after):
        return {"number"}
    found = set()
    for one, other in zip(before, after, strict=True):
        assert type(one) is type(other)
        found |= {f.name for f in fields(one) if f.name != "by" and getattr(one, f.name) != getattr(other, f.name)}
    return found


def test_no_step_and_no_key_is_forgotten_here() -> None:
    for table in (LEAST, DEFAULTS, MOVES, BOUNDS):
        assert table.keys() == registry.OWN.keys()
    for do, step in registry.OWN.items():
        keys = step.model_fields.keys() - {"do"}
        assert MOVES[do].keys() == BOUNDS[do].keys() == keys
        assert keys == DEFAULTS[do].keys() | (LEAST[do][1].keys() - DEFAULTS[do].keys())


@pytest.mark.parametrize("do", registry.OWN)
def test_every_key_is_described_with_its_unit(do: str) -> None:
    units = ("mm", "mN", "um", "_V", "_s", "_g", "Hz", "_N", "_min", "_mg")
    for key, field in registry.OWN[do].model_fields.items():
        text = field.description or ""
        assert text.endswith(".") and len(text) > 15, key
        if key.endswith(units):
            assert "(" in text, f"{key}: no unit in its description"


@pytest.mark.parametrize("do", registry.OWN)
def test_each_default_is_the_documented_one(do: str) -> None:
    step = registry.OWN[do].model_validate({"do": do, **LEAST[do][1]})
    given = LEAST[do][1].keys() - DEFAULTS[do].keys()
    left_out = {key: value for key, value in step.model_dump().items() if key not in given and key != "do"}
    changed = {key: LEAST[do][1][key] for key in LEAST[do][1].keys() & DEFAULTS[do].keys()}
    assert left_out == {**DEFAULTS[do], **changed}
    assert {key for key, field in registry.OWN[do].model_fields.items() if field.is_required()} == given | {"do"}


@pytest.mark.parametrize(("do", "key"), KEYS)
def test_each_key_moves_its_part_of_the_plan_and_no_other(do: str, key: str, scene: Any) -> None:
    value, expected = MOVES[do][key]
    instead = INSTEAD.get((do, key), {})
    before, after = actions_of(do, scene, **instead), actions_of(do, scene, **{**instead, key: value})
    if "number" in expected:
        assert len(before) != len(after)
    else:
        assert moved(before, after) == expected


@pytest.mark.parametrize(("do", "key"), KEYS)
def test_each_bound_is_accepted_at_and_refused_beyond(do: str, key: str) -> None:
    step, least = registry.OWN[do], LEAST[do][1] | INSTEAD.get((do, key), {})
    good, bad = BOUNDS[do][key]
    for value in good:
        step.model_validate({"do": do, **least, key: value})
    for value in bad:
        with pytest.raises(ValidationError):
            step.model_validate({"do": do, **least, key: value})
    with pytest.raises(ValidationError):
        step.model_validate({"do": do, **least, key: float("nan")})


def test_a_sweep_begins_every_pass_where_from_mm_says(scene: Any) -> None:
    moves = actions_of("sweep", scene, from_mm=1.5, cycles=2)
    assert [one.h for one in moves if one.record] == [(1.5e-3, 4e-3), (4e-3, 1.5e-3)] * 4
    first = moves[0]
    assert (first.h, first.record, first.voltage) == ((0.0, 1.5e-3), False, (0.0, 0.0))


def test_a_level_that_comes_again_goes_on_counting_its_cycles(scene: Any) -> None:
    moves = actions_of("sweep", scene, voltages_V=[0.0, 500.0, 0.0], cycles=2)
    counted = [(one.voltage[0], one.cycle) for one in moves if one.record and one.direction > 0]
    assert counted == [(0.0, 1), (0.0, 2), (500.0, 1), (500.0, 2), (0.0, 3), (0.0, 4)]


@pytest.mark.parametrize("do", registry.OWN)
def test_the_facts_of_a_step_are_those_of_its_actions(do: str, scene: Any) -> None:
    step, actions = registry.OWN[do], actions_of(do, scene)
    assert any(one.record for one in actions) is step.records
    assert all(one.by.kind == do for one in actions)
    assert max(level for one in actions for level in one.voltage) <= max(actions[0].by.highest_voltage, 100.0)
    asks = {"prompt", "mount", "weigh", "jog"}  # whoever is asked to do something there touches the rig
    assert step.hands is (do in asks)
    assert step.needs_contact is (
        do in {"precondition", "ramp", "voltage", "sweep", "relax", "breakdown", "cycle", "follow", "learn"}
    )
    assert step.finds_contact is (do == "approach")


@pytest.mark.parametrize("do", [do for do, step in registry.OWN.items() if step.needs_contact])
def test_what_needs_contact_is_refused_without(do: str, scene: Any) -> None:
    step = {"do": do, **LEAST[do][1]}
    with pytest.raises(LimitError, match=r"Step 3 .* needs the contact position: put an approach step before it"):
        plan(Protocol.model_validate({"step": [*BEFORE["referenced"], step]}), scene)
    back = [*BEFORE["contact"], {"do": "return"}, step]
    with pytest.raises(LimitError, match="needs the contact position"):
        plan(Protocol.model_validate({"step": back}), scene)


@pytest.mark.parametrize("do", ["mount", "weigh", "visit", "press", "meter", "home", "zero", "approach"])
def test_what_must_not_come_in_contact_is_refused_there(do: str, scene: Any) -> None:
    with pytest.raises(LimitError, match=f"Step 4 .{do}. "):
        plan(Protocol.model_validate({"step": [*BEFORE["contact"], {"do": do, **LEAST[do][1]}]}), scene)


@pytest.mark.parametrize("do", ["visit", "glide", "press"])
def test_what_needs_the_stages_reference_is_refused_without(do: str, scene: Any) -> None:
    with pytest.raises(LimitError, match=r"Step 1 .* needs a home step before it"):
        plan(Protocol.model_validate({"step": [{"do": do, **LEAST[do][1]}]}), scene)


@pytest.mark.parametrize("do", ["precondition", "prompt", "follow"])
def test_what_begins_at_0_V_is_refused_under_voltage(do: str, scene: Any) -> None:
    with pytest.raises(LimitError, match=r"Step 6 "):
        plan(Protocol.model_validate({"step": [*BEFORE["raised"], {"do": do, **LEAST[do][1]}]}), scene)
