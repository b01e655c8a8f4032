"""A curve refuses what identification could not use, and says which field of which curve it was."""

from typing import Any

import numpy as np
import pytest

from calibration.film.curve import Curve, CurveError
from model.material.materials import NAMED
from model.specimen import Specimen

SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])


def curve(**changes: Any) -> Curve:
    fields: dict[str, Any] = {
        "label": "the curve",
        "run": "r",
        "specimen": SPECIMEN,
        "h": np.array([1e-3, 2e-3, 3e-3]),
        "force": np.array([0.01, 0.02, 0.03]),
        "voltage": np.zeros(3),
        "nominal_voltage": 0.0,
        "direction": np.ones(3, dtype=int),
        "force_noise": 5e-3,
    }
    return Curve(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"h": np.array([])}, "no samples"),
        ({"force": np.zeros(2)}, "force has shape"),
        ({"h": np.array([1.0, np.inf, 2.0])}, "h holds an infinite value"),
        ({"direction": np.array([1, 2, 1])}, "direction must be"),
        ({"force_noise": 0.0}, "force_noise is 0.0"),
        ({"force_noise": float("nan")}, "force_noise is nan"),
        ({"force_gain": -1e-3}, "force_gain is -0.001"),
        ({"displacement_zero": float("nan")}, "displacement_zero is nan"),
        ({"nominal_voltage": float("nan")}, "nominal_voltage is nan"),
        ({"h": "abc"}, "h is not a list of numbers"),
    ],
)
def test_unusable_input_is_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(CurveError, match="the curve") as caught:
        curve(**changes)
    assert words in str(caught.value)


def test_missing_and_flagged_samples_are_not_usable() -> None:
    made = curve(force=np.array([0.01, np.nan, 0.03]), flagged=np.array([False, False, True]))
    assert made.usable.tolist() == [True, False, False]


def test_a_curve_does_not_change_with_the_arrays_it_was_made_from() -> None:
    force = np.array([0.01, 0.02, 0.03])
    made = curve(force=force)
    force[0] = 9.0
    assert made.force[0] == 0.01
    with pytest.raises(ValueError, match="read-only"):
        made.force[0] = 1.0


def test_the_noise_of_the_force_does_not_move_a_held_disk_by_the_rigs_compliance() -> None:
    """Readings at rest would lie on a line of the slope -1/compliance: a film of negative stiffness, if believed."""
    rng = np.random.default_rng(5)
    way = np.concatenate([np.linspace(0.0, 6e-3, 100), np.full(400, 6e-3)])
    force = 20.0 * way + 2e-3 * rng.standard_normal(way.size)
    direction = np.repeat([1, 0], [100, 400])
    made = curve(h=way, force=force, voltage=np.zeros(way.size), direction=direction).without_compliance(1e-4)
    assert np.ptp(made.place[100:]) == 0.0
    assert made.place[-1] == pytest.approx(6e-3 - 1e-4 * 0.12, abs=5e-8)
    assert made.h[:100] == pytest.approx(way[:100] - 1e-4 * force[:100], abs=1e-12)
