"""Cases as plain data: answers in order, bad ones told apart."""

from __future__ import annotations

import copy
import json
import math
from typing import Any

import pytest

from rig.analysis.cases import CaseError, solve_cases

GOOD: dict[str, Any] = {
    "id": "paper",
    "a": 4e-3,
    "b": 20e-3,
    "thickness": 40e-6,
    "prestretch": 1.2,
    "h": 10e-3,
    "voltage": 0.0,
    "wrinkling": "plain",
    "material": {"mu": [5e3, 3.5e4], "alpha": [2.5, 5.6], "eps_r": 1.7},
}


def case(**changes: Any) -> dict[str, Any]:
    return copy.deepcopy(GOOD) | changes


def test_an_answer_has_all_its_keys() -> None:
    (answer,) = solve_cases([case(tolerance=1e-10)])
    assert list(answer) == [
        "id",
        "status",
        "F",
        "error_estimate",
        "peak_field",
        "min_hoop_stress",
        "max_stretch",
        "iterations",
    ]
    assert answer["id"] == "paper"
    assert answer["status"] == "taut"
    assert answer["F"] == pytest.approx(0.2156961965381, rel=1e-10)


BAD: list[tuple[Any, str]] = [
    (case(a=30e-3), "disk_radius"),
    (case(h=math.nan), "h = nan"),
    (case(voltage=math.inf), "voltage"),
    (case(thickness=-1.0), "thickness"),
    (case(h="0.01"), "h must be a number"),
    (case(h=True), "h must be a number"),
    (case(h=10**400), "h = 1000"),
    (case(wrinkling="yes"), "wrinkling"),
    (case(tolerance=0.0), "tolerance"),
    (case(hh=1.0), "unknown key 'hh'"),
    ({k: v for k, v in GOOD.items() if k != "b"}, "lacks the key 'b'"),
    (case(material={"mu": [1e4], "alpha": [2.0, 3.0], "eps_r": 2.0}), "one of each"),
    (case(material={"mu": "soft", "alpha": [2.0], "eps_r": 2.0}), "material.mu must be a list"),
    (case(material={"mu": [-1e4], "alpha": [2.0], "eps_r": 2.0}), "shear modulus"),
    (case(material=None), "material must be an object"),
    (7, "the case must be an object"),
]


@pytest.mark.parametrize(("bad", "text"), BAD)
def test_a_bad_case_is_told_and_spoils_no_neighbour(bad: Any, text: str) -> None:
    alone = solve_cases([case()])
    first, middle, last = solve_cases([case(), bad, case()])
    assert middle["status"] == "invalid"
    assert text in middle["message"]
    assert middle["F"] is None
    for answer in (first, last):
        assert answer["status"] == "taut"
        assert answer["F"] == pytest.approx(alone[0]["F"], rel=1e-9)


def test_order_is_kept_across_tolerances_and_treatments() -> None:
    cases = [
        case(id=i, h=(1 + i) * 1e-3, tolerance=10.0 ** -(6 + i % 3), wrinkling=("plain", "tension_field")[i % 2])
        for i in range(12)
    ]
    answers = solve_cases(cases)
    assert [answer["id"] for answer in answers] == list(range(12))
    force = [answer["F"] for answer in answers]
    assert force == sorted(force)


def test_a_state_without_an_answer_says_so_in_valid_json() -> None:
    answers = solve_cases([case(prestretch=1.0, h=1e-3, voltage=2500.0), case()])
    assert answers[0]["status"] == "slack"
    assert answers[0]["F"] is None
    assert "slack" in answers[0]["message"]
    assert json.loads(json.dumps(answers, allow_nan=False)) == answers


def test_extreme_numbers_never_raise_nor_leave_a_number_without_an_answer() -> None:
    sizes = (1e-300, 1e-30, 1e-9, 1.0, 1e30, 1e300)
    cases = [case(**{key: GOOD[key] * size}) for key in ("thickness", "h", "a") for size in sizes]
    cases += [case(voltage=v) for v in (1e-300, 1e-9, 1e9, 1e300)]
    for answer in solve_cases(cases):
        assert answer["status"] in ("taut", "wrinkled", "slack", "unstable", "not_converged", "invalid")
        assert (answer["F"] is None) == (answer["status"] not in ("taut", "wrinkled"))


def test_cases_must_be_a_list() -> None:
    with pytest.raises(CaseError, match="JSON list"):
        solve_cases({"id": 1})


def test_no_cases_no_answers() -> None:
    assert solve_cases([]) == []


def test_a_case_along_a_history() -> None:
    """A value of an independent code; beside it a case that is none, and one without history: the relaxed film."""
    branches = [{"ratio": 0.1, "time_s": 1.0}, {"ratio": 0.1, "time_s": 30.0}]
    material = {"mu": [5e3, 3.5e4], "alpha": [2.5, 5.6], "eps_r": 1.7, "branches": branches}
    geometry = {"a": 4e-3, "b": 20e-3, "thickness": 40e-6, "prestretch": 1.2, "material": material}
    history = {"t": [0, 10, 100], "h": [0, 10e-3, 10e-3], "voltage": [0, 0, 0]}
    along = geometry | {"id": "along", "history": history, "times": [17.647059, 100.0]}
    cases = [
        along,
        along | {"h": 1e-3},
        along | {"history": {"t": [0, 10]}},
        along | {"times": [101.0]},
        along | {"material": material | {"branches": [{"ratio": -0.1, "time_s": 1.0}]}},
        along | {"material": material | {"branches": {"ratio": 0.1}}},
        along | {"material": material | {"branches": [{"ratio": 0.1}]}},
        geometry | {"id": "relaxed", "h": 10e-3},
        {key: value for key, value in along.items() if key != "times"},
        along | {"history": {"t": [0, 10, 100], "h": [0, 10e-3, 10e-3]}, "tolerance": 1e-4},
    ]
    found = solve_cases(cases)
    assert found[0]["status"] == ["taut", "taut"]
    assert found[0]["F"] == pytest.approx([0.21955249, 0.215938708], abs=2.2e-7)
    assert len(found[0]["error_estimate"]) == 2 and max(found[0]["error_estimate"]) < 1e-5
    assert len(found[0]["peak_field"]) == len(found[0]["min_hoop_stress"]) == 2
    for answer, words in zip(
        found[1:7],
        ("unknown key 'h'", "lacks the key 'h'", "within the history", "ratio", "list of objects", "time_s"),
        strict=True,
    ):
        assert answer["status"] == "invalid" and words in answer["message"], answer
    assert found[7]["F"] == pytest.approx(0.2156961965381, rel=1e-7)
    assert found[8]["status"] == "invalid" and "times" in found[8]["message"]
    assert found[9]["F"] == pytest.approx(found[0]["F"], rel=1e-4)


def test_a_case_of_a_free_disk() -> None:
    """A weight that hangs on it is a bias of the kind mass; it sinks towards where the relaxed film carries it."""
    geometry = {key: GOOD[key] for key in ("a", "b", "thickness", "prestretch")}
    material = GOOD["material"] | {"branches": [{"ratio": 0.3, "time_s": 2.0}]}
    free = geometry | {"id": "free", "material": material, "times": [0.0, 1.0, 4.0], "tolerance": 1e-3}
    weight = free | {"history": {"t": [0, 4], "weight": [0.2, 0.2]}}
    mass = free | {"history": {"t": [0, 4]}, "bias": {"kind": "mass", "weight": 0.2}, "wrinkling": "tension_field"}
    bad = [
        weight | {"bias": {"kind": "mass", "weight": 0.2}},
        mass | {"bias": {"kind": "rope"}},
        mass | {"bias": {"kind": "spring", "preload": 0.2}},
        mass | {"bias": [0.2]},
        mass | {"bias": {"kind": "mass", "weight": -1.0}},
        free | {"history": {"t": [0, 4], "weight": [0.2, -0.2]}},
        free | {"history": {"t": [0, 4], "weight": [0.2]}},
    ]
    hangs, pushed, *refused = solve_cases([weight, mass, *bad])
    assert hangs["status"] == ["taut"] * 3 and hangs["F"] == [0.2] * 3
    assert hangs["h"] == pytest.approx(pushed["h"], rel=1e-9)
    assert 8e-3 < hangs["h"][0] < hangs["h"][1] < hangs["h"][2] < 9.63e-3  # the relaxed film is at 9.628 mm
    assert all(0.0 < one < 1e-2 for one in hangs["error_estimate"])
    words = (
        "weight and bias",
        "allowed are mass",
        "lacks the key 'stiffness'",
        "an object",
        "positive",
        "-0.2",
    )
    assert [one["status"] for one in refused] == ["invalid"] * len(bad)
    for one, word in zip(refused, (*words, "h has 1 values"), strict=True):
        assert word in one["message"], one["message"]


def test_derivatives_along_a_history() -> None:
    """A list over the times, of several moduli a list each time; moduli and permittivity together scale the force."""
    branches = [{"ratio": 0.1, "time_s": 1.0}, {"ratio": 0.2, "time_s": 9.0}]
    material = {"mu": [5e3, 3.5e4], "alpha": [2.5, 5.6], "eps_r": 1.7, "branches": branches}
    case = {"id": 1, "a": 4e-3, "b": 20e-3, "thickness": 40e-6, "prestretch": 1.2, "material": material}
    case |= {"history": {"t": [0, 2], "h": [0, 8e-3], "voltage": [0, 800]}, "times": [1.0, 2.0], "tolerance": 1e-4}
    found, wrong = solve_cases([case | {"sensitivities": True}, case | {"sensitivities": 1}])
    assert "dF" not in solve_cases([case])[0]
    slopes = found["dF"]
    assert all(len(value) == 2 for value in slopes.values())
    assert [len(slopes[key][0]) for key in ("mu", "alpha", "ratio", "time")] == [2, 2, 2, 2]
    for k in (0, 1):
        scaled = sum(m * d for m, d in zip(material["mu"], slopes["mu"][k], strict=True)) + 1.7 * slopes["eps_r"][k]
        assert scaled == pytest.approx(found["F"][k], rel=2e-3)
    assert wrong["status"] == "invalid" and "true or false" in wrong["message"]
