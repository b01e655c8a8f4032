"""Trapezoidal motion from any state."""

from __future__ import annotations

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


def test_it_follows_the_pieces_and_then_a_ramp():
    path = Path(0.01)
    path.follow(1.0, [(1.0, 0.02), (2.0, 0.0), (1.0, -0.02)])
    assert path.at(0.5) == (0.01, 0.0)
    assert path.at(2.0) == pytest.approx((0.02, 0.02))
    assert path.at(3.0) == pytest.approx((0.04, 0.02))
    assert path.at(9.0) == pytest.approx((0.07, 0.0)) and path.end == pytest.approx(5.0)
    path.ramp(10.0, 0.0, 0.01)
    assert path.at(12.0) == pytest.approx((0.05, -0.01)) and path.end == pytest.approx(17.0)
    assert path.at(18.0) == (0.0, 0.0)


def test_history_is_forgotten_in_time():
    path = Path(0.0)
    for k in range(1000):
        path.ramp(float(k), float(k % 7), 100.0)
    assert len(path._t) < 4 * HISTORY_S
    assert path.at(998.9)[0] == pytest.approx(998 % 7) and path.at(999.9)[0] == pytest.approx(999 % 7)
