"""Currents as data on a capacitance: charges written out by hand, and a flat film whose capacitance is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.electrical import rows as reducing
from calibration.electrical.agreement import AGREE, CONTRADICT, SOFTENED, Charged, Difference
from calibration.electrical.charge import (
    Charging,
    Known,
    NotResolved,
    _asymptote,
    permittivity,
    places_of,
    resolution_of,
    rows_of,
)
from calibration.electrical.rows import charge_slope, currents_of
from model.material.materials import NAMED
from model.specimen import Specimen

Array = NDArray[np.float64]

EPS_0 = 8.8541878128e-12
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, replace(NAMED["parker-cao2018"], eps_r=2.0), "cone")
FLAT = EPS_0 * math.pi * (20e-3**2 - 4e-3**2) * 1.2**2 / 40e-6  # of a permittivity of 1: as thin as it is stretched
CABLE = 0.12e-9
KNOWN = Known(0.02, 0.0, 0.0, 0.0, current_gain=0.01, cable_F=CABLE, cable_uncertainty_F=1e-13)
LEAK, CUBIC, OFFSET = 5e-11, 2e-17, 3e-9  # A/V, A/V3, A
RATE = 100.0  # V/s
PLACES = (0.0, 4e-3)


def capacitance(h: float, volts: Array) -> Array:
    """Of film and cable in the first tests: a quadratic in the voltage, larger farther out."""
    return CABLE + 0.6e-9 * (1.0 + 100.0 * h) * (1.0 + 0.2 * (volts / 900.0) ** 2)


def charged(h: float, volts: Array) -> Array:
    """d(C V)/dV of it."""
    return CABLE + 0.6e-9 * (1.0 + 100.0 * h) * (1.0 + 0.6 * (volts / 900.0) ** 2)


def run(
    slope: object = charged, *, places: tuple[float, ...] = PLACES, noise: float = 0.0, levels: int = 4, seed: int = 1
) -> Charging:
    """Ramps of 3 s between the levels, and rests of 4 s; ten samples a second."""
    columns, t = [], 0.0
    for h in places:
        for k in range(levels):
            for i in range(70):
                rising = i < 30 and k > 0
                volts = 300.0 * k - (RATE * (3.0 - 0.1 * i) if rising else 0.0)
                columns.append((t, volts, h, rising))
                t += 0.1
    at, v, h_all, ramping = np.array(columns).T
    current = LEAK * v + CUBIC * v**3 + OFFSET
    for h in places:
        mine = (h_all == h) & (ramping > 0.0)
        current[mine] += RATE * slope(h, v[mine])  # type: ignore[operator]
    current += noise * np.random.default_rng(seed).standard_normal(at.size)
    return Charging(FILM, at, v, current, h_all, ramping > 0.0, "run")


def test_only_the_inside_of_a_steady_rise_and_rests_away_from_it_count() -> None:
    given = run(levels=2, places=(1e-3,))
    found = rows_of(given)
    assert found.t[found.rises] == pytest.approx(7.0 + 0.1 * np.arange(1, 29))
    assert found.slope[found.rises] == pytest.approx(RATE)
    assert (found.slope[~found.rises] == 0.0).all()
    rests = np.concatenate((np.arange(1, 68), np.arange(102, 139)))  # of 140: two off each ramp, and not the ends
    assert found.t[~found.rises] == pytest.approx(0.1 * rests)


def test_what_falls_moves_or_is_not_known_is_no_rise() -> None:
    given = run(levels=2, places=(1e-3,))
    falling = rows_of(replace(given, voltage=900.0 - given.voltage))
    assert not falling.rises.any()
    moving = rows_of(replace(given, h=1e-4 * np.arange(given.t.size)))
    assert moving.t.size == 0
    holes = given.current.copy()
    holes[80] = np.nan
    left = rows_of(replace(given, current=holes))
    assert np.setdiff1d(rows_of(given).t, left.t) == pytest.approx(given.t[79:82])
    bent = given.voltage.copy()
    bent[85:100] = bent[85] + 2.0 * (bent[85:100] - bent[85])  # twice as fast from one sample on
    unsteady = rows_of(replace(given, voltage=bent))
    assert given.t[85] not in unsteady.t[unsteady.rises]
    assert given.t[84] in unsteady.t[unsteady.rises]


def test_places_are_displacements_that_are_near_each_other() -> None:
    found = places_of(rows_of(run()))
    assert [h for h, _ in found] == pytest.approx(PLACES)
    assert [int(mine.sum()) for _, mine in found] == [84, 84]


def test_the_charge_of_nodes_is_the_derivative_of_a_polynomial() -> None:
    nodes = np.array([50.0, 300.0, 600.0, 880.0])
    volts = np.linspace(10.0, 900.0, 12)
    values = 1.0 + 0.5 * (nodes / 900.0) ** 2 - 0.1 * (nodes / 900.0) ** 3
    slope = 1.0 + 1.5 * (volts / 900.0) ** 2 - 0.4 * (volts / 900.0) ** 3
    assert charge_slope(nodes, volts) @ values == pytest.approx(slope, rel=1e-9)


def test_currents_are_reduced_to_the_capacitance_without_leakage_and_offset() -> None:
    """The true capacitances at the nodes solve the reduced data, whatever leaks; another one by a tenth does not."""
    found = currents_of([run(noise=1e-10)], KNOWN)
    assert found.samples == 2 * 84
    assert found.h == pytest.approx(PLACES)
    assert found.nodes.shape == (2, 4)
    assert ((found.nodes > 0.0) & (found.nodes < 900.0)).all()
    truth = np.concatenate([capacitance(h, nodes) for h, nodes in zip(PLACES, found.nodes, strict=True)])
    left = found.root @ truth - found.target
    assert found.noise == pytest.approx(1e-10, rel=0.1)
    assert float(left @ left) / left.size < 3.0
    assert np.abs(found.root @ (1.1 * truth) - found.target).max() > 100.0
    step = 1e-9  # a reading too high by that on all rises
    given = run(noise=1e-10)
    rises = np.zeros(given.t.size, dtype=np.bool_)
    rises[1:-1] = given.ramping[:-2] & given.ramping[1:-1] & given.ramping[2:]
    higher = currents_of([replace(given, current=given.current + step * rises)], KNOWN)
    change = higher.target * higher.noise - found.target * found.noise
    assert change == pytest.approx(found.step * found.noise * step, abs=1e-3 * step * np.abs(found.step).max() * 1e-10)


def test_errors_that_all_readings_share_are_stated_or_assumed() -> None:
    found = currents_of([run(noise=1e-10)], KNOWN)
    assert found.priors == {"current_gain": 0.01, "cable": 1e-13}
    coarse = run()
    coarse = replace(coarse, current=np.round(coarse.current / 1e-9) * 1e-9)
    priors = currents_of([coarse], replace(KNOWN, current_gain=None, cable_uncertainty_F=None)).priors
    assert priors == {
        "current_gain": 0.01,
        "cable": pytest.approx(0.1 * CABLE, rel=0.2),
        "current_step": pytest.approx(1e-9 / math.sqrt(12.0), rel=1e-6),
    }


def test_places_can_be_left_out_but_not_all() -> None:
    found = currents_of([run(noise=1e-10)], KNOWN)
    less = found.without(np.array([True, False]))
    assert less.h == pytest.approx(PLACES[1:])
    assert less.samples == 84
    with pytest.raises(NotResolved, match="only 0 samples of the current lie on rises"):
        found.without(np.array([True, True]))


def test_a_leak_by_the_cube_of_the_voltage_is_told_from_four_levels_of_rest_on() -> None:
    volts = np.concatenate((np.linspace(0.0, 900.0, 30), np.repeat([0.0, 300.0, 600.0], 9)))
    assert reducing._leaks(volts, 30).shape == (57, 2)
    more = np.append(volts, np.full(9, 900.0))
    columns = reducing._leaks(more, 30)
    assert columns.shape == (66, 3)
    x = more / 900.0
    for one in (x, np.ones_like(x), x**3):
        assert columns @ np.linalg.lstsq(columns, one, rcond=None)[0] == pytest.approx(one, abs=1e-12)


@pytest.mark.parametrize("r", [0.0, 0.6])
def test_readings_that_follow_each_other_count_less(r: float) -> None:
    """Of an autoregressive process of the first order: (1 + r)/(1 - r)."""
    steps = np.random.default_rng(2).standard_normal(4000)
    left = np.zeros(4000)
    for k in range(1, 4000):
        left[k] = r * left[k - 1] + steps[k]
    assert reducing._alike(left) == pytest.approx((1.0 + r) / (1.0 - r), rel=0.12 if r else 1e-12)
    assert reducing._alike(np.zeros(10)) == 1.0


def test_currents_that_say_too_little_are_refused_with_the_figures() -> None:
    nothing = run()
    with pytest.raises(NotResolved, match="does not measure its current"):
        currents_of([replace(nothing, current=np.full_like(nothing.current, np.nan))], KNOWN)
    with pytest.raises(NotResolved, match="only 0 samples"):
        currents_of([replace(nothing, ramping=np.zeros_like(nothing.ramping))], KNOWN)
    with pytest.raises(NotResolved, match=r"currents of [\d.]+ nA on rises.*of the capacitance open"):
        currents_of([run(noise=1e-6)], KNOWN)


def test_steps_of_readings_show_where_they_come_in_few_values() -> None:
    assert resolution_of(np.array([0.0, 2e-9, 2e-9, 6e-9, 0.0, 2e-9, 6e-9, 6e-9])) == 2e-9
    assert resolution_of(np.linspace(0.0, 1.0, 9)) == 0.0
    assert resolution_of(np.full(9, 1e-9)) == 0.0


def test_what_is_left_of_a_decaying_current_is_its_asymptote() -> None:
    """Within what is stated, for decays on and off the grid that they are sought on; the mean where none shows."""
    t = np.arange(0.0, 20.0, 0.1)
    off = []
    for seed, tau in enumerate(np.geomspace(0.7, 8.0, 24)):
        noise = 1e-10 * np.random.default_rng(seed).standard_normal(t.size)
        value, error = _asymptote(t, 4e-9 + 9e-9 * np.exp(-t / tau) + noise)
        off.append((value - 4e-9) / error)
        assert 0.9e-10 / math.sqrt(t.size) < error < 1e-10
    assert max(map(abs, off)) < 3.5
    assert 0.5 < float(np.std(off)) < 1.5
    noise = 1e-11 * np.random.default_rng(3).standard_normal(t.size)
    flat, flat_error = _asymptote(t, 4e-9 + noise)
    assert flat == pytest.approx(float(np.mean(4e-9 + noise)))
    assert flat_error == pytest.approx(1e-11 / math.sqrt(t.size), rel=0.2)


@pytest.mark.parametrize("share", [0.8, 1.6])
def test_the_end_of_a_decay_that_outlasts_the_rest_is_known_no_better_than_what_is_left_of_it(share: float) -> None:
    t = np.linspace(0.0, 10.0, 200)
    decay = 5e-8 * np.exp(-t / (share * t[-1]))
    off = []
    for seed in range(24):
        value, error = _asymptote(t, 1e-8 + decay + 2e-9 * np.random.default_rng(seed).standard_normal(t.size))
        off.append(abs(value - 1e-8) / error)
    assert max(off) < 2.5


def flat(h: float, volts: Array) -> Array:
    """A flat film stays one under voltage, as ring and disk hold it: its capacitance is constant."""
    return np.full_like(volts, 1.7 * FLAT + CABLE)


def test_the_permittivity_of_a_flat_film_is_that_of_a_plate_capacitor() -> None:
    found = permittivity([run(flat, places=(0.0,), noise=1e-10)], KNOWN)
    assert found.value == pytest.approx(1.7, rel=2e-3)
    assert found.cable == pytest.approx(CABLE, rel=1e-2)
    assert found.noise == pytest.approx(1e-10, rel=0.1)
    assert found.samples == 84
    assert found.budget["current gain"] == pytest.approx(0.01 * found.value)
    assert found.budget["thickness"] == pytest.approx(0.02 * found.value, rel=1e-3)
    assert found.standard_uncertainty == pytest.approx(math.hypot(*found.budget.values()))
    (place,) = found.capacitances
    assert place.measured == pytest.approx(1.7 * FLAT + CABLE, rel=5e-3)
    assert place.fitted == pytest.approx(place.measured, rel=5e-3)
    assert place.h == 0.0
    slopes = RATE * math.sqrt(84.0)
    assert place.standard_uncertainty == pytest.approx(found.noise / slopes, rel=1e-6)
    for leak in found.leakages:
        assert leak.current == pytest.approx(LEAK * leak.voltage + CUBIC * leak.voltage**3 + OFFSET, abs=1e-10)
        assert leak.field == pytest.approx(1.44 * leak.voltage / 40e-6, rel=1e-6)
    assert [leak.voltage for leak in found.leakages] == pytest.approx([300.0, 600.0, 900.0])


def test_too_few_samples_on_rises_are_refused_by_their_number() -> None:
    given = run(flat, places=(0.0,), levels=2)
    short = replace(given, ramping=given.ramping & (given.t < 7.85))
    assert int(rows_of(short).rises.sum()) == 7
    with pytest.raises(NotResolved, match="only 7 samples of the current lie on rises of the voltage; at least 8"):
        permittivity([short], KNOWN)
    enough = replace(given, ramping=given.ramping & (given.t < 7.95))
    assert permittivity([enough], KNOWN).samples == 8


def charge_says(
    plain: float, softening: float | None = None, softened: float | None = None, *, apart: bool = True
) -> Charged:
    """Differences in standard uncertainties of 1 %."""
    allowed = None if softening is None else Difference(0.01 * softening, 0.01)
    lost = None if softened is None else (softened, 0.01)
    return Charged(Difference(0.01 * plain, 0.01), allowed, lost, apart, 1e-9, 0.0, 100, [])


@pytest.mark.parametrize(
    ("said", "verdict", "words"),
    [
        (charge_says(2.5), AGREE, "agree"),
        (charge_says(2.6), CONTRADICT, "contradict"),  # 1 % of chance lies at 2.576
        (charge_says(4.0, 1.0, 0.03), SOFTENED, "agree if the film lost 3 %"),
        (charge_says(4.0, 1.0, 0.03, apart=False), SOFTENED, "measure the curve at the first voltage once more"),
        (charge_says(4.0, 3.0, 0.03), CONTRADICT, "contradict"),
        (charge_says(4.0, 1.0, -0.03), CONTRADICT, "no softening explains it"),  # no film grows stronger
        (charge_says(4.0, 1.0, -0.025), SOFTENED, "agree if"),
        (charge_says(1.0, 0.5, -0.03), AGREE, "agree"),
    ],
)
def test_force_and_charge_agree_or_not_by_their_uncertainties(said: Charged, verdict: str, words: str) -> None:
    assert said.verdict == verdict
    assert words in said.words
    assert ("once more" in said.words) is (verdict == SOFTENED and not said.told_apart)
    facts = said.to_dict()
    assert facts["verdict"] == verdict
    assert facts["difference"]["probability"] == pytest.approx(math.erfc(abs(said.plain.deviations) / math.sqrt(2.0)))
    assert (facts["softening_per_curve"] is None) is (said.softened is None)
    assert Difference(0.1, math.inf).deviations == 0.0 and not Difference(0.1, math.inf).significant
