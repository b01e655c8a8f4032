"""Times of a stream without time stamps: jitter, drift, lost blocks, late blocks, wrong rate."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from drivers.sample_clock import SampleClock


def stream(
    *,
    rate_Hz: float = 100.0,
    drift: float = 0.0,
    seconds: float = 30.0,
    lost: tuple[int, ...] | range = (),
    delay: float = 0.0005,
    spikes: float = 0.0,
    stalls: tuple[tuple[float, float], ...] = (),
    poll_s: tuple[float, float] = (0.005, 0.01),
    seed: int = 1,
) -> tuple[list[tuple[float, int]], dict[str, int], SampleClock[int], dict[int, float]]:
    """Stamped samples (sample = its index), counters, the clock, and the true arrival time of each index.

    Sample i is taken at i / rate * (1 - drift) and arrives ``delay`` later, plus an exponential spike of mean 5 ms with
    probability ``spikes``; arrivals keep their order. Polls are spaced at random; none happens during a stall.
    """
    rng = random.Random(seed)
    arrivals: list[tuple[float, int]] = []
    latest = 0.0
    truth: dict[int, float] = {}
    for i in range(round(seconds * rate_Hz)):
        taken = i / rate_Hz * (1 - drift)
        late = delay + (rng.expovariate(1 / 0.005) if rng.random() < spikes else 0.0)
        latest = max(latest, taken + late)
        truth[i] = taken + delay
        if i not in lost:
            arrivals.append((latest, i))
    counters: dict[str, int] = {}
    clock = SampleClock[int](rate_Hz, counters)
    out: list[tuple[float, int]] = []
    now = at = 0.0
    position = 0
    while at < seconds + 1:
        at += rng.uniform(*poll_s)
        now = next((end for start, end in stalls if start <= at < end), at)
        at = now
        block = []
        while position < len(arrivals) and arrivals[position][0] <= now:
            block.append(arrivals[position][1])
            position += 1
        out += clock.feed(now, block)
    return out, counters, clock, truth


def errors_after(out: list[tuple[float, int]], truth: dict[int, float], t: float) -> list[float]:
    return [stamp - truth[i] for stamp, i in out if stamp > t]


def assert_in_order(out: list[tuple[float, int]], truth: dict[int, float]) -> None:
    """Nothing is missing but what may still be held back at the end of the stream."""
    assert [i for _, i in out] == sorted(truth)[: len(out)]
    assert len(out) >= len(truth) - 5


def assert_increasing(out: list[tuple[float, int]]) -> None:
    assert all(b[0] > a[0] for a, b in itertools.pairwise(out))


@pytest.mark.parametrize("drift", [0.0, 100e-6, -100e-6])
def test_times_follow_the_sampling_instants_under_jitter_and_drift(drift: float) -> None:
    out, counters, clock, truth = stream(drift=drift, seconds=60, spikes=0.2)
    assert_in_order(out, truth)
    assert_increasing(out)
    errors = errors_after(out, truth, 10.0)
    # The window holds some 100 polls of a 10 ms period: its least delay is a fraction of a millisecond.
    assert max(abs(e) for e in errors) < 1e-3
    assert counters == {"lost_samples": 0, "gaps": 0, "time_resyncs": 0}
    assert clock.drift == pytest.approx(-drift, abs=60e-6)


def test_neighbours_never_differ_by_a_period_from_the_period_without_an_event() -> None:
    out, counters, _, _ = stream(drift=80e-6, seconds=30, spikes=0.2)
    assert counters["gaps"] == counters["time_resyncs"] == 0
    assert all(0 < b[0] - a[0] < 0.02 for a, b in itertools.pairwise(out))


@pytest.mark.parametrize("missing", [1, 2, 7, 40])
def test_a_lost_block_is_counted_and_left_as_a_gap_where_it_was(missing: int) -> None:
    first = 1500
    out, counters, _, truth = stream(lost=range(first, first + missing))
    assert counters["gaps"] == 1
    assert counters["lost_samples"] == missing
    assert_increasing(out)
    by_index = {i: stamp for stamp, i in out}
    gap = by_index[first + missing] - by_index[first - 1]
    assert gap == pytest.approx((missing + 1) * 0.01, abs=2e-3)
    assert max(abs(e) for e in errors_after(out, truth, 5.0)) < 2e-3


@pytest.mark.parametrize(("missing", "settled_s"), [(4, 8.0), (30, 3.0)])
def test_lost_blocks_at_1_kHz(missing: int, settled_s: float) -> None:
    """A few milliseconds take a window to be noticed, more are left as a gap where they were."""
    lost = range(6000, 6000 + missing)
    out, counters, _, truth = stream(rate_Hz=1000, seconds=12, lost=lost, poll_s=(0.002, 0.004))
    assert counters["lost_samples"] == missing
    assert max(abs(e) for e in errors_after(out, truth, settled_s)) < 1e-3


def test_blocks_that_were_only_late_take_the_gap_back() -> None:
    """For 0.4 s the instrument's side sends at half the rate, and then all that is due."""
    counters: dict[str, int] = {}
    clock = SampleClock[int](100.0, counters)
    sent = seen = most = 0
    for poll in range(1000):
        now = poll * 0.007
        due = 300 + math.floor((now - 3.0) * 50) if 3.0 <= now < 3.4 else math.floor(now * 100)
        block = list(range(sent, max(due, sent)))
        sent += len(block)
        seen += len(clock.feed(now, block))
        most = max(most, counters["lost_samples"])
    assert most > 5
    assert counters == {"lost_samples": 0, "gaps": 0, "time_resyncs": 0}
    assert seen == sent


def test_a_stall_of_the_host_is_no_gap() -> None:
    """The port buffered everything: one late, long block."""
    out, counters, _, truth = stream(stalls=((10.0, 10.7), (20.0, 20.05)))
    assert counters["gaps"] == counters["lost_samples"] == 0
    assert_in_order(out, truth)
    assert max(abs(e) for e in errors_after(out, truth, 5.0)) < 2e-3


def test_no_sample_is_stamped_after_its_arrival() -> None:
    counters: dict[str, int] = {}
    clock = SampleClock[int](100.0, counters)
    rng = random.Random(3)
    now, n = 0.0, 0
    for _ in range(2000):
        now += rng.uniform(0.001, 0.03)
        due = math.floor(now * 100 * 1.0005)
        for stamp, _ in clock.feed(now, list(range(n, due))):
            assert stamp <= now + 1e-6
        n = due


def test_more_samples_than_the_rate_allows_are_counted_not_stamped_into_the_future() -> None:
    counters: dict[str, int] = {}
    clock = SampleClock[int](100.0, counters)
    last = -math.inf
    for poll in range(300):
        now = 0.01 * poll
        for stamp, _ in clock.feed(now, list(range(5))):
            assert last < stamp <= now + 1e-6
            last = stamp
    assert counters["time_resyncs"] > 100
    assert clock.other_rate() == pytest.approx(500.0, rel=0.05)
    assert clock.other_rate() is None  # counted anew


def test_a_stall_alone_is_not_off_rate() -> None:
    _, _, clock, _ = stream(seconds=3, stalls=((1.0, 2.5),))
    assert clock.other_rate() is None


def test_the_first_block_ends_at_its_arrival() -> None:
    clock = SampleClock[str](10.0, {})
    assert clock.feed(5.0, []) == []
    assert clock.other_rate() is None  # the clock need not begin at zero
    assert clock.feed(7.0, ["a", "b", "c"]) == [
        (pytest.approx(6.8), "a"),
        (pytest.approx(6.9), "b"),
        (pytest.approx(7.0), "c"),
    ]


def test_the_time_before_the_first_sample_says_nothing_of_the_rate() -> None:
    """An instrument may be set up long after the clock was started."""
    clock: SampleClock[int] = SampleClock(100.0, {})
    clock.feed(20.0, [])
    assert clock.other_rate() is None
