"""Trapezoidal motion from any state."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.sim.path import HISTORY_S, Path, trapezoid


@given(
    x=st.floats(-50, 50),
    v=st.floats(-30, 30),
    target=st.floats(-50, 50),
    speed=st.floats(1, 30),
    acceleration=st.floats(1, 300),
)
def test_it_gets_there_within_its_limits(x, v, target, speed, acceleration):
    pieces = trapezoid(x, v, target, speed, acceleration)
    top = max(abs(v), speed)
    for duration, a in pieces:
        assert duration >= 0 and abs(a) in (0.0, acceleration)
        x, v = x + (v + 0.5 * a * duration) * duration, v + a * duration
        assert abs(v) <= top + 1e-9
    assert x == pytest.approx(target, abs=1e-9) and v == pytest.approx(0, abs=1e-9)


def test_one_sample_is_as_good_as_many():
    path = Path(0.01)
    path.follow(1.0, trapezoid(0.01, 0.0, 0.06, 0.013, 0.2))
    path.ramp(3.0, 0.0, 0.005)
    t = np.linspace(0, 20, 997)
    together = path.sample(t)
    assert all(path.sample(t[i : i + 1])[0] == together[i] for i in range(len(t)))
    assert together == pytest.approx([path.at(time)[0] for time in t], abs=1e-15)


def test_history_is_forgotten_in_time():
    path = Path(0.0)
    for k in range(1000):
        path.ramp(float(k), float(k % 7), 100.0)
    assert len(path._t) < 4 * HISTORY_S
    assert path.sample(np.array([998.9, 999.9])) == pytest.approx([998 % 7, 999 % 7])
