"""The band in which an output that follows a commanded ramp may be: honest supplies stay inside, others do not."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.safety.commanded import DEVIATION_V, CommandedRamp

RATE = 300.0


@settings(max_examples=200, deadline=None)
@given(
    levels=st.lists(st.integers(0, 30).map(lambda n: 50.0 * n), min_size=1, max_size=5),
    shares=st.lists(st.floats(0.1, 1.0), min_size=5, max_size=5),
    delay=st.floats(0.0, 0.4),
    speed=st.floats(0.85, 1.05),
    noise=st.floats(0.0, 3.0),
)
def test_an_output_that_follows_its_ramps_stays_inside(
    levels: list[float], shares: list[float], delay: float, speed: float, noise: float
) -> None:
    """However often it is sent elsewhere, half way or not, with the delay and gain that a supply may have."""
    t, voltage, aim, shown = 0.0, 1000.0, 1000.0, 1000.0
    for target, share in zip(levels, shares, strict=False):
        ramp = CommandedRamp(t, shown, target, RATE, aim)
        begun, duration = t, share * (abs(target - voltage) / RATE + 1.5)
        while t < begun + duration:
            t += 0.1
            busy = t <= begun + delay
            if not busy:
                aim = target
            step = RATE * speed * 0.1
            voltage += min(max(aim - voltage, -step), step)
            shown = voltage + noise * math.sin(37.0 * t)
            ramp.confirm(t, busy=busy)
            least, most = ramp.band(t)
            assert least <= shown <= most


@pytest.mark.parametrize(("start", "target"), [(0.0, 1000.0), (1000.0, 200.0)])
def test_the_band_closes_about_the_target_when_the_ramp_must_be_over(start: float, target: float) -> None:
    ramp = CommandedRamp(0.0, start, target, RATE, start)
    ramp.confirm(0.1, busy=False)
    assert not ramp.over(abs(target - start) / RATE)
    assert ramp.over(2.0 * abs(target - start) / RATE + 1.0)
    assert ramp.band(100.0) == (target - DEVIATION_V, target + DEVIATION_V)


def test_a_command_that_is_never_confirmed_excuses_nothing_for_ever() -> None:
    ramp = CommandedRamp(0.0, 1000.0, 0.0, RATE, 1000.0)
    for t in range(30):
        ramp.confirm(float(t), busy=True)
    assert ramp.over(29.0) and ramp.band(29.0)[1] == DEVIATION_V


def test_an_output_that_was_on_its_way_up_may_go_on_until_the_command_has_arrived_and_no_longer() -> None:
    ramp = CommandedRamp(0.0, 400.0, 0.0, RATE, 1000.0)
    ramp.confirm(0.1, busy=True)
    assert ramp.band(0.2)[1] > 400.0 + 0.2 * RATE
    ramp.confirm(0.2, busy=False)
    highest = max(ramp.band(0.1 * k)[1] for k in range(100))
    assert highest < 400.0 + 1.2 * RATE + 2 * DEVIATION_V
    assert ramp.over(10.0)
