"""Curves of bounded size keep what a screen shows: the extremes of every bin, and the newest value."""

from __future__ import annotations

import numpy as np

from rig.panel.series import MOST_BINS, MOST_POINTS, Binned, Loop


def test_ten_hours_at_1_khz_stay_small_and_keep_every_extreme() -> None:
    trace = Binned()
    seconds = 36000
    for begin in range(0, seconds, 100):
        t = begin + np.arange(0, 100, 0.01)
        value = np.zeros_like(t)
        if begin == 17000:
            value[1234] = 5.0  # one sample of 3.6 million
        trace.add(t, value)
    page = trace.since(-1, 0)
    assert len(page["least"]) == len(page["largest"]) <= MOST_BINS
    assert max(page["largest"]) == 5.0 and min(page["least"]) == 0.0
    place = page["largest"].index(5.0) * page["width"]
    assert abs(place - 17012.34) <= page["width"]
    assert page["width"] * MOST_BINS < 4 * seconds


def test_only_what_is_new_is_sent_until_bins_are_joined() -> None:
    trace = Binned(1.0)
    trace.add(np.array([0.5, 1.5, 2.5]), np.array([1.0, 2.0, 3.0]))
    known = trace.since(-1, 0)
    assert known["least"] == [1.0, 2.0, 3.0]
    trace.add(np.array([2.6, 3.5]), np.array([7.0, 4.0]))
    news = trace.since(known["generation"], 2)
    assert (news["first"], news["least"], news["largest"]) == (2, [3.0, 4.0], [7.0, 4.0])
    trace.add(np.array([float(MOST_BINS)]), np.array([9.0]))
    anew = trace.since(known["generation"], 4)
    assert anew["first"] == 0 and anew["generation"] == 1 and anew["width"] == 2.0
    assert anew["least"][:2] == [1.0, 3.0] and anew["largest"][:2] == [2.0, 7.0] and anew["largest"][-1] == 9.0


def test_what_is_not_finite_is_left_out_and_a_hole_stays_one() -> None:
    trace = Binned(1.0)
    trace.add(np.array([0.5, 1.5, 3.5]), np.array([1.0, np.nan, 4.0]))
    assert trace.since(-1, 0)["least"] == [1.0, None, None, 4.0]
    trace.add(np.array([np.nan, -1.0]), np.array([1.0, 1.0]))
    assert trace.since(-1, 0)["least"] == [1.0, None, None, 4.0]


def test_a_loop_of_any_length_stays_small_and_keeps_its_ends() -> None:
    loop = Loop()
    for k in range(10 * MOST_POINTS):
        loop.add(float(k), 2.0 * k, 0.0)
    loop.add(np.nan, 0.0, 0.0)
    points = loop.since(-1, 0)["points"]
    assert MOST_POINTS / 2 <= len(points) <= MOST_POINTS
    assert points[0] == [0.0, 0.0, 0.0] and points[-1][0] > 9.9 * MOST_POINTS
    assert loop.since(loop.generation, len(points))["points"] == []
