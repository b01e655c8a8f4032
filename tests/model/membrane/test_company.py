"""What a state gets does not depend on the states that it is solved with, nor on their order."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from model.membrane.solve import solve, solve_many

_spec = importlib.util.spec_from_file_location("films_of_company", Path(__file__).with_name("films.py"))
assert _spec is not None
assert _spec.loader is not None
films = importlib.util.module_from_spec(_spec)
sys.modules["films_of_company"] = films
_spec.loader.exec_module(films)

COUNT = 8
STATED = 1e-12  # relative: what remains is the order in which a processor adds


@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
def test_order_and_company_change_nothing(wrinkling: str) -> None:
    cases = films.random_cases(COUNT, seed=7)
    voltage = 1.3 * cases.voltage
    found = solve_many(cases.films, cases.h, voltage, tolerance=1e-6, wrinkling=wrinkling)
    order = np.random.default_rng(1).permutation(COUNT)
    turned = solve_many(
        [cases.films[i] for i in order], cases.h[order], voltage[order], tolerance=1e-6, wrinkling=wrinkling
    )
    half = solve_many(cases.films[::2], cases.h[::2], voltage[::2], tolerance=1e-6, wrinkling=wrinkling)
    for other, of in ((turned, order), (half, np.arange(0, COUNT, 2))):
        np.testing.assert_array_equal(other.status, found.status[of])
        np.testing.assert_array_equal(other.modes, found.modes[of])
        for name in ("force", "peak_field", "max_stretch"):
            np.testing.assert_allclose(getattr(other, name), getattr(found, name)[of], rtol=STATED, err_msg=name)
    for i in range(0, COUNT, 4):
        film, h, v = cases.films[i], float(cases.h[i]), float(voltage[i])
        alone = solve_many([film], [h], [v], tolerance=1e-6, wrinkling=wrinkling)
        assert alone.status[0] == found.status[i]
        np.testing.assert_allclose(alone.force[0], found.force[i], rtol=STATED)
        one = solve(film, h, v, tolerance=1e-6, wrinkling=wrinkling)
        assert one.status == found.status[i]
        if one.answered:
            assert abs(one.force / found.force[i] - 1.0) <= one.error_estimate + found.error_estimate[i]
