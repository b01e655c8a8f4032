"""What a fit to the rest says of a part of the records that was left out, for models that are linear."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.film.branches import spectrum
from calibration.film.branches.counting import (
    aicc,
    free_columns,
    further_times,
    grid,
    hidden,
    left_out,
    misfit,
    numbers,
    searched,
    shifted,
    shows_from,
    unknown_columns,
)
from calibration.film.branches.result import FoundBranch, Known, LeftOut, blind_times

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Line:
    """A problem and its fit: linear columns, and a zero with a prior as the last number."""

    columns: Array
    stretches: NDArray[np.intp]
    data: Array

    @property
    def jacobian(self) -> Array:
        zero = np.ones((self.data.size, 1))
        columns = np.concatenate((self.columns, zero), axis=1)
        return np.concatenate((columns, np.eye(1, columns.shape[1], columns.shape[1] - 1)))

    @property
    def x(self) -> Array:
        return np.linalg.lstsq(self.jacobian, np.append(self.data, 0.0), rcond=None)[0]

    @property
    def residual(self) -> Array:
        found: Array = np.append(self.columns @ self.x[:-1] + self.x[-1] - self.data, self.x[-1])
        return found

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    window = (0.1, 10.0)
    independent = 100.0

    def count(self, x: Array) -> int:
        return 0

    def bounds(self, x: Array) -> tuple[Array, Array]:
        return np.full(x.size, -np.inf), np.full(x.size, np.inf)

    def varied(self, x: Array) -> NDArray[np.bool_]:
        return np.ones(x.size, dtype=np.bool_)


STRETCHES = np.repeat(np.arange(4), 25)
TIME = np.linspace(0.0, 1.0, 100)
COLUMNS = np.stack((np.exp(-TIME), TIME**2, np.maximum(TIME - 0.7, 0.0)), axis=1)  # the last part alone tells of one


def judged(seed: int, wrong: Array | float = 0.0, stated: float = 1.0) -> LeftOut:
    noise = np.random.default_rng(seed).standard_normal(TIME.size) / stated
    made = Line(COLUMNS, STRETCHES, COLUMNS @ [300.0, 200.0, 500.0] + noise + wrong)
    return left_out(made, made)


def test_what_is_left_out_is_judged_by_noise_and_by_what_the_rest_can_tell() -> None:
    """The right model misses parts by many times their noise, as the rest hardly tells of them, and is no worse."""
    found = [judged(seed) for seed in range(60)]
    assert np.mean([one.noise for one in found]) > 1.5
    assert np.mean([one.expected for one in found]) < 1.3
    assert sum(not one.explained for one in found) <= 1


def test_a_part_that_goes_another_way_is_not_explained() -> None:
    bent = np.where(STRETCHES == 1, 6.0 * np.sin(40.0 * TIME), 0.0)
    for seed in range(20):
        assert not judged(seed, bent).explained
        assert judged(seed, bent).expected > 2.0


@pytest.mark.parametrize("stated", [0.6, 0.1])
def test_noise_that_is_stated_too_small_is_no_lack_of_the_law(stated: float) -> None:
    assert sum(not judged(seed, stated=stated).explained for seed in range(20)) <= 1


def test_a_part_that_goes_another_way_is_not_excused_by_noise_that_is_stated_too_small() -> None:
    bent = np.where(STRETCHES == 1, 10.0 * np.sin(40.0 * TIME), 0.0)
    for seed in range(10):
        assert not judged(seed, bent, stated=0.6).explained


def test_several_parts_that_go_another_way_do_not_excuse_each_other() -> None:
    squares = [(50, 50.0 * one) for one in (9.0, 1.1, 0.9, 8.0, 1.0, 1.2, 9.5, 1.0)]
    found = LeftOut.judged(2.0, squares, misfit=30.0)
    assert not found.explained
    assert found.expected > 2.5


WINDOW = (0.02, 200.0)


@pytest.mark.parametrize(("angle", "least", "most"), [(0.01, 0.1, 0.9), (0.3, 0.02, 0.2), (1.5, 1e-4, 3e-3)])
def test_a_hidden_branch_shifts_by_what_it_looks_like_and_the_data_allow(
    angle: float, least: float, most: float
) -> None:
    """A shape that is the found one's but for an angle: unseen it shifts that fully; seen, not to be there, hardly."""
    along, other = np.eye(100)[:2] * 30.0
    made = Line(along[:, None], STRETCHES, 2.0 * along)
    free = np.array([True, False])
    shape = np.atleast_2d(np.append(math.cos(angle) * along + math.sin(angle) * other, 0.0))
    rows = hidden(made, free, shape, 1.0)
    shift, near = shifted(-np.append(along, 0.0) / (along @ along), np.array([0.1]), rows)
    assert near == 0.1
    assert least < shift < most


def test_the_verdict_is_that_of_the_combined_figure() -> None:
    log_time = Known(math.log(2.0), 0.01)
    sure, shaken = (
        FoundBranch.judged(Known(1.0, 0.01, one, 0.1), log_time, WINDOW, explained=True) for one in (0.1, 0.2)
    )
    assert (sure.verdict, sure.hidden) == ("identified", 0.0)
    assert (shaken.verdict, shaken.hidden) == ("bounded", 0.1)
    assert shaken.ratio_alone == 0.01
    assert shaken.ratio_uncertainty == pytest.approx(math.hypot(0.01, 0.2))
    unsure = FoundBranch.judged(Known(1.0, 0.3, 0.2, 0.1), log_time, WINDOW, explained=True)
    assert (unsure.verdict, unsure.hidden) == ("bounded", 0.0)


class Fits:
    """A joint fit of which only the order of the questions matters; its points are numbers of branches."""

    def __init__(self) -> None:
        self.kept = np.ones(3, dtype=np.bool_)
        self.within = self.kept
        self.state = (None, None, self.kept)

    def fit(self, start: object) -> object:
        return start


@pytest.mark.parametrize(
    ("gains", "earned", "number"),
    [
        ({1: 500.0, 2: 900.0}, {2}, 2),  # one explains much and predicts badly, as where two are missing
        ({1: 500.0, 2: 900.0, 3: 950.0}, {3}, 0),  # but no more than one is passed over
        ({1: 20.0, 2: 900.0}, {2}, 0),  # one that explains little ends the search
        ({1: 500.0, 2: 900.0, 3: 8.0}, {1, 2}, 2),
        ({1: 500.0, 2: 900.0, 3: 990.0}, {1, 3}, 3),
    ],
)
def test_a_branch_that_predicts_badly_alone_is_passed_over_once(
    monkeypatch: pytest.MonkeyPatch, gains: dict[int, float], earned: set[int], number: int
) -> None:
    monkeypatch.setattr(spectrum, "_fitted", lambda joint, points, number: number if number in gains else None)
    monkeypatch.setattr(spectrum, "gain", lambda joint, fewer, more, scale: gains[more])
    monkeypatch.setattr(spectrum, "pays", lambda joint, fewer, more: (1.0, more in earned))
    counting = spectrum._Counting(Fits(), 0, None)  # type: ignore[arg-type]
    assert [one.point for one in counting.fits] == list(range(number + 1))


def test_a_part_counts_as_many_numbers_as_it_alone_tells_less() -> None:
    """The last part alone tells of one column: of its 25 numbers, one is spent on that. By fits to the rest."""
    wave = np.where(STRETCHES == 3, 3.0 * np.cos(60.0 * TIME), 0.0)
    columns = np.stack((COLUMNS[:, 0], COLUMNS[:, 1], np.where(STRETCHES == 3, 1.0 - TIME, 0.0)), axis=1)
    made = Line(columns, STRETCHES, columns @ [300.0, 200.0, 500.0] + wave)
    rest = Line(columns[STRETCHES < 3], STRETCHES[STRETCHES < 3], made.data[STRETCHES < 3])
    parts = [(25 - 1, made.cost - rest.cost)]
    for k in range(3):
        mine = ~np.isin(STRETCHES, k)
        other = Line(columns[mine], STRETCHES[mine], made.data[mine])
        parts.append((25, made.cost - other.cost))
    found, expected = left_out(made, made), LeftOut.judged(1.0, parts, misfit(made, made))
    assert found.expected == pytest.approx(expected.expected, rel=1e-6)
    assert found.chance == pytest.approx(expected.chance, rel=1e-4)


def test_the_criterion_is_that_of_hurvich_and_tsai() -> None:
    """AICc = chi^2 + 2 k + 2 k (k + 1)/(n - k - 1), of 3 numbers (the zero is an error) and 100 samples."""
    made = Line(COLUMNS, STRETCHES, COLUMNS @ [3.0, 2.0, 5.0] + np.random.default_rng(1).standard_normal(100))
    assert numbers(made, made) == 3
    assert aicc(made, made, 1.0) == pytest.approx(made.cost + 6.0 + 24.0 / 96.0)
    assert aicc(made, made, 2.0) == pytest.approx(made.cost / 2.0 + 6.0 + 24.0 / 96.0)


def test_a_misfit_is_none_within_chance_and_grows_with_neighbours_that_err_together() -> None:
    random = np.random.default_rng(2)
    right = Line(COLUMNS, STRETCHES, random.standard_normal(100))
    assert misfit(right, right) == 1.0
    alone = Line(COLUMNS, STRETCHES, 3.0 * random.standard_normal(100))
    data = alone.residual[:100]
    assert misfit(alone, alone) == pytest.approx(float(data @ data) / (100 - 3))
    pairs = Line(COLUMNS, STRETCHES, np.repeat(3.0 * random.standard_normal(50), 2))
    data = pairs.residual[:100]
    ratio = float(data @ data) / (100 - 3)
    rho = float(data[1:] @ data[:-1]) / float(data @ data)
    assert misfit(pairs, pairs) == pytest.approx(ratio * (1.0 + 2.0 * rho), rel=1e-9)


class Branched(Line):
    """Of its four numbers a ratio and a time: bounded, and the ratio at 0 in one of two cases."""

    at = 1.0

    @property
    def x(self) -> Array:
        return np.array([1.0, self.at, 2.0, 0.3])

    def count(self, x: Array) -> int:
        return 1

    def bounds(self, x: Array) -> tuple[Array, Array]:
        return np.array([-np.inf, 0.0, -1.0, -np.inf]), np.array([np.inf, 20.0, 2.0, np.inf])


def test_a_number_at_its_bound_is_not_free_but_a_time_at_the_end_of_the_search_is_no_knowledge() -> None:
    made = Branched(COLUMNS, STRETCHES, TIME)
    assert free_columns(made, made).tolist() == [True, True, False, True]
    assert unknown_columns(made, made).tolist() == [True, True, True, True]
    assert numbers(made, made) == 2
    gone = Branched(COLUMNS, STRETCHES, TIME)
    object.__setattr__(gone, "at", 0.0)
    assert free_columns(gone, gone).tolist() == [True, False, False, True]
    assert unknown_columns(gone, gone).tolist() == [True, False, False, True]  # without the branch it has no time


def test_times_that_are_tried_and_those_that_may_hide() -> None:
    """Four a decade over the window of two decades; hidden ones 1.3 decades on, half a decade off what was found."""
    made = Line(COLUMNS, STRETCHES, TIME)
    assert grid(made, 0.0) == pytest.approx(np.geomspace(0.1, 10.0, 9))
    assert grid(made, 1.3)[-1] == pytest.approx(10.0**2.3)
    assert np.exp(searched((0.3, 20.0))) == pytest.approx([0.1, 200.0])
    found = further_times(made, np.array([1.0]), 50.0)
    assert np.abs(np.log10(found)).min() == pytest.approx(0.5)
    assert {round(float(one), 4) for one in found} >= {round(10.0**-0.5, 4), round(10.0**0.5, 4), 0.1}
    assert found.max() <= 50.0
    assert further_times(made, np.array([0.2]), 50.0).min() > 0.2  # none below the window


def test_a_branch_shows_from_the_size_that_would_earn_its_place_in_95_of_100() -> None:
    """A shape of norm n beside what is free: (sqrt(7 + 4) + 1.645)/n; one that lies in it never shows."""
    along, other = np.eye(100)[:2] * 40.0
    made = Line(along[:, None], STRETCHES, 2.0 * along)
    free = np.array([True, False])
    rows = np.append(np.stack((other, along + 0.5 * other, along, 0.1 * other)), np.zeros((4, 1)), axis=1)
    needed = (math.sqrt(11.0) + 1.6449) / 40.0
    assert shows_from(made, free, rows, 1.0) == pytest.approx([needed, 2.0 * needed, math.inf, math.inf])
    assert shows_from(made, free, rows[:1], 4.0) == pytest.approx([2.0 * needed])


def test_times_that_look_like_stiffness_and_those_that_are_too_quick() -> None:
    """A usual branch has a ratio of 0.1; from a third of the window on, and below 3 % of it, in steps of 1, 2, 5."""
    alone = [(0.1, 0.6), (0.2, 0.51), (0.25, 0.5), (1.0, 0.9), (4.0, 0.1), (6.0, 0.11), (20.0, math.inf)]
    assert blind_times(alone, 10.0) == (10.0, 0.2)
    assert blind_times([(5.0, 0.2)], 10.0) == (5.0, 0.0)
    assert blind_times([(1.0, 0.05)], 10.0) == (100.0, 0.0)
