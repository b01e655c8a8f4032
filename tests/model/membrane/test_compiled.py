"""The compiled kernel against the path for arrays: the same status and digits, alone or not, whatever it is given."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from model.arrays import Array
from model.kernel.library import load, says
from model.material.gent import Gent
from model.material.materials import NAMED, Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.yeoh import Yeoh
from model.membrane import compiled
from model.membrane.flat import REAL
from model.membrane.solve import Solutions, Status, solve, solve_many
from model.specimen import Specimen
from model.verification.search import draw

pytestmark = pytest.mark.skipif(load() is None, reason=says())

NUMBERS = REAL[:6]
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
# Low exponents pull in before they lose tension.
SOFT = Specimen(4e-3, 20e-3, 100e-6, 3.0, Material("soft", (1e5,), (1.3,), 3.0))


@contextmanager
def no_kernel() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "_kernel", lambda: None)
        yield


def random_films(count: int, seed: int) -> tuple[list[Specimen], Array, Array]:
    """a/b 0.02-0.7, h/b 0.01-1.5, lp 1-2, one to four Ogden terms with negative pairs, fields that leave many taut."""
    random = np.random.default_rng(seed)
    films, voltage = [], []
    for _ in range(count):
        terms = int(random.integers(1, 5))
        sign = np.where(random.random(terms) < 0.2, -1.0, 1.0)
        sign[0] = 1.0
        alpha = sign * random.uniform(1.2, 6.0, terms)
        mu = sign * 10 ** random.uniform(3, 5, terms)
        thickness = 10 ** random.uniform(-5, -4)
        material = Material("random", tuple(mu), tuple(alpha), random.uniform(1.5, 8.0), breakdown_field=50e6)
        ratio = float(np.exp(random.uniform(np.log(0.02), np.log(0.7))))
        films.append(Specimen(0.02 * ratio, 0.02, thickness, random.uniform(1.0, 2.0), material))
        field = np.sqrt(material.shear_modulus / material.permittivity)
        voltage.append(random.uniform(0.0, 0.5) * field * thickness if random.random() < 0.8 else 0.0)
    return films, 0.02 * 10 ** random.uniform(-2, np.log10(1.5), count), np.array(voltage)


def both(*args: object, **keywords: object) -> tuple[Solutions, Solutions]:
    """The answers with the kernel, and those of the path for arrays."""
    with no_kernel():
        arrays = solve_many(*args, **keywords)  # type: ignore[arg-type]
    return solve_many(*args, **keywords), arrays  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "name", "low", "high"),
    [(0, "exp", -700.0, 700.0), (1, "expm1", -40.0, 5.0), (2, "log", -40.0, 5.0), (3, "log1p", -40.0, 5.0)],
)
def test_elementary_functions_err_in_the_last_place_only(kind: int, name: str, low: float, high: float) -> None:
    random = np.random.default_rng(kind)
    x = random.uniform(low, high, 20_000)
    if kind:
        x = np.exp(x)
    if name in ("expm1", "log1p"):
        x[::2] *= -1.0
        x = x[x > -1.0] if name == "log1p" else x[x > -700.0]
    if name == "expm1":
        x = x[x < 700.0]
    library = load()
    assert library is not None
    out = np.empty_like(x)
    pointers = (a.ctypes.data_as(ctypes.c_void_p) for a in (x, out))
    library.dea_kernel_elementary(ctypes.c_int64(kind), ctypes.c_int64(len(x)), *pointers)
    truth = getattr(np, name)(x.astype(np.longdouble))
    assert np.max(np.abs(out - truth) / np.spacing(np.abs(truth.astype(float)))) < 2.5


@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-9])
def test_the_kernel_has_the_digits_of_the_path_for_arrays(wrinkling: str, tolerance: float) -> None:
    films, h, voltage = random_films(60, seed=11)
    h[::3] *= -1.0
    state = {"tolerance": tolerance, "relaxed": wrinkling == "tension_field", "sensitivities": False}
    found = [compiled.solve_one(films[i], h[i], voltage[i], **state) for i in range(60)]
    known = [i for i, one in enumerate(found) if one is not None and one.answered]
    assert len(known) > 30
    some = [films[i] for i in known]
    mine, theirs = both(some, h[known], voltage[known], tolerance=tolerance, wrinkling=wrinkling, sensitivities=True)
    np.testing.assert_array_equal(mine.status, theirs.status)
    assert np.all(mine.answered)
    for name in ("modes", "iterations", "stable", "field_exceeded", "stretch_exceeded"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
    np.testing.assert_allclose(mine.error_estimate, theirs.error_estimate, rtol=0.02)
    for name in NUMBERS:
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-10, atol=1e-9, err_msg=name)
    assert mine.dforce is not None
    assert theirs.dforce is not None
    for name, slopes in theirs.dforce.items():
        size = np.nanmax(np.abs(slopes), axis=-1, keepdims=True) if slopes.ndim > 1 else np.abs(slopes)
        size = np.where(size > 0.0, size, 1.0)  # by the voltage at 0 V
        np.testing.assert_allclose(
            mine.dforce[name] / size, slopes / size, rtol=1e-9, atol=1e-9, err_msg=name, equal_nan=True
        )
    assert 0 < mine.evaluations.electric < mine.evaluations.mechanical <= theirs.evaluations.mechanical


def test_states_followed_from_rest_have_the_status_and_digits_of_the_path_for_arrays() -> None:
    """Soft, deeply wrinkled and slack states, and the last ones before and the first ones beyond pull-in."""
    states = draw(16, seed=1)
    films, voltage = [*states.films, SOFT, SOFT, SOFT], np.append(states.voltage, [330.0, 339.0, 345.0])
    h = np.append(states.h, [10e-3, 10e-3, 10e-3])
    mine, theirs = both(films, h, voltage, tolerance=1e-6)
    left = [
        compiled.solve_one(film, *state, tolerance=1e-6, relaxed=False, sensitivities=False) is None
        for film, *state in zip(films, h.tolist(), voltage.tolist(), strict=True)
    ]
    assert sum(left) <= 1
    np.testing.assert_array_equal(mine.status, theirs.status)
    for status in (Status.TAUT, Status.WRINKLED, Status.UNSTABLE, Status.SLACK):
        assert np.any(mine.status == status), status.name
    np.testing.assert_array_equal(mine.modes, theirs.modes)
    np.testing.assert_array_equal(mine.stable, theirs.stable)
    for name in (*NUMBERS, "error_estimate"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(mine.force, theirs.force, rtol=1e-11)


LAWS = {
    "neo_hooke": (NeoHooke, (6e4,), ()),
    "mooney_rivlin": (MooneyRivlin, (4e4, 8e3), ()),
    "yeoh": (Yeoh, (3e4, -5e2, 40.0), ()),
    "gent": (Gent, (7e4,), (25.0,)),
    "gent, short chains": (Gent, (9e4,), (4.0,)),
}


@pytest.mark.parametrize("name", LAWS)
def test_every_law_has_the_digits_of_the_path_for_arrays(name: str) -> None:
    law, mu, alpha = LAWS[name]
    film = Specimen(4e-3, 20e-3, 60e-6, 1.3, Material(name, mu, alpha, 2.5, law=law))
    h, voltage = np.linspace(1e-3, 12e-3, 8), np.linspace(0.0, 800.0, 8)
    assert all(
        compiled.solve_one(film, *state, tolerance=1e-8, relaxed=True, sensitivities=False) is not None
        for state in zip(h.tolist(), voltage.tolist(), strict=True)
    )
    mine, theirs = both(film, h, voltage, sensitivities=True)
    np.testing.assert_array_equal(mine.status, theirs.status)
    for one in NUMBERS:
        np.testing.assert_allclose(getattr(mine, one), getattr(theirs, one), rtol=1e-11, atol=1e-9, err_msg=one)
    assert mine.dforce is not None
    assert theirs.dforce is not None
    for one, slopes in theirs.dforce.items():
        np.testing.assert_allclose(mine.dforce[one], slopes, rtol=1e-10, err_msg=one)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-9])
def test_wrinkled_films_have_the_digits_of_the_path_for_arrays(tolerance: float) -> None:
    """Folds at the disk, at the ring, at both, all over; with the state itself and every derivative."""
    films, h, voltage = [], [], []
    for disk, lp, mm, volts in (
        *((4.0, 1.0, 12.0, 1400.0), (4.0, 1.0, 4.0, 900.0), (4.0, 1.2, 10.0, 1900.0), (4.0, 1.0, 12.0, 1900.0)),
        *((4.0, 1.0, 9.75, 1500.0), (4.0, 1.0, 9.85, 1500.0)),  # the cuts move so far that they are made anew
        *((2.0, 1.0, 14.0, 1400.0), (8.0, 1.0, 14.0, 1400.0), (8.0, 1.05, 12.0, 1400.0), (4.0, 1.05, 12.0, 1600.0)),
    ):
        films.append(replace(FILM, disk_radius=disk * 1e-3, prestretch=lp))
        h.append(mm * 1e-3)
        voltage.append(volts)
    mine, theirs = both(films, h, voltage, tolerance=tolerance, wrinkling="tension_field", sensitivities=True)
    np.testing.assert_array_equal(mine.status, Status.WRINKLED)
    for name in ("status", "modes", "iterations"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
    for name in NUMBERS:
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-10, atol=1e-6, err_msg=name)
    assert mine.dforce is not None
    assert theirs.dforce is not None
    for name, slopes in theirs.dforce.items():
        np.testing.assert_allclose(mine.dforce[name], slopes, rtol=1e-9, err_msg=name)
    for film, height, volts in zip(films, h, voltage, strict=True):
        one = solve(film, height, volts, tolerance=tolerance, wrinkling="tension_field")
        assert isinstance(one.quick, compiled.One)
        with no_kernel():
            other = solve(film, height, volts, tolerance=tolerance, wrinkling="tension_field", sensitivities=True)
        a, b = one.profile(21), other.profile(21)
        np.testing.assert_array_equal(a.wrinkled, b.wrinkled)
        for name in ("r", "z", "stretch_1", "stretch_2", "stress_1"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_cuts_that_settle_just_in_time_do_not_keep_the_estimate_above_the_tolerance() -> None:
    """They stay where they have settled, so that no more modes would help: ten milliseconds a state elsewhere."""
    film = replace(FILM, prestretch=1.0)
    state = {"tolerance": 1e-6, "relaxed": True, "sensitivities": False}
    for h in np.linspace(9.72e-3, 9.74e-3, 30).tolist():
        one = compiled.solve_one(film, h, 1500.0, **state)
        assert one is not None
        assert one.answered
        assert one.answer.modes <= 7


def test_order_and_company_change_no_bit() -> None:
    films, h, voltage = random_films(30, seed=5)
    found = solve_many(films, h, 0.5 * voltage)
    order = np.random.default_rng(2).permutation(30)
    turned = solve_many([films[i] for i in order], h[order], 0.5 * voltage[order])
    taut = found.status == Status.TAUT
    assert taut.sum() > 15
    for name in (*NUMBERS, "error_estimate"):
        np.testing.assert_array_equal(getattr(turned, name)[taut[order]], getattr(found, name)[order][taut[order]])
    alone = 0
    for i in np.flatnonzero(taut).tolist():
        one = solve(films[i], float(h[i]), 0.5 * float(voltage[i]))
        if isinstance(one.quick, compiled.One):
            alone += 1
            assert [getattr(one, name) for name in NUMBERS] == [getattr(found, name)[i] for name in NUMBERS]
    assert alone > 15


def test_states_solved_in_several_threads_at_once_do_not_mix() -> None:
    films, h, voltage = random_films(40, seed=6)

    def solved(i: int) -> list[object]:
        one = solve(films[i], float(h[i]), 0.5 * float(voltage[i]), tolerance=1e-6, sensitivities=True)
        return [one.status, one.iterations, *(repr(getattr(one, name)) for name in NUMBERS), repr(one.dforce)]

    alone = [solved(i) for i in range(40)]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            assert list(pool.map(solved, range(40))) == alone


@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
def test_states_side_by_side_have_the_bits_that_they_have_alone(wrinkling: str, tolerance: float) -> None:
    """One after the other, two at once, and as many as the processor takes: every number of every state."""
    films, h, voltage = random_films(150, seed=8)
    laws = [Material(name, mu, alpha, 2.5, law=law) for name, (law, mu, alpha) in LAWS.items()]
    films += [replace(FILM, material=laws[i % len(laws)], disk_radius=(1 + i) * 1e-4) for i in range(40)]
    films += [replace(FILM, prestretch=1.0)] * 10
    h = np.concatenate([h, np.linspace(1e-3, 14e-3, 40), np.linspace(10e-3, 14e-3, 10)])
    voltage = np.concatenate([voltage, np.linspace(0.0, 1500.0, 40), np.full(10, 1400.0)])
    which = np.arange(len(films), dtype=np.int64)
    records = b"".join(film.record for film in films)
    found = []
    for lanes in (1, 2, 0):
        task = compiled._task(tolerance, wrinkling == "tension_field", True, compiled.MOST_MODES)
        task = compiled._Task.from_buffer_copy(task)
        task.lanes = lanes
        answers = np.zeros(len(films), dtype=np.dtype(compiled._Answer))
        data = [array.ctypes.data for array in (h, voltage, answers)]
        solver = compiled._kernel().dea_kernel_solve
        solver(ctypes.byref(task), records, len(films), which.ctypes.data, len(films), *data, None)
        found.append(answers)
    for answers in found:  # points are counted once more where a state goes on alone after all
        answers["mechanical"] = answers["electric"] = 0
    for other in found[1:]:
        np.testing.assert_array_equal(other["status"], found[0]["status"])
        for i in np.flatnonzero(found[0]["status"] >= 0).tolist():
            assert other[i].tobytes() == found[0][i].tobytes(), i
    assert np.count_nonzero(found[0]["status"] == Status.TAUT) > 60
    assert np.count_nonzero(found[0]["status"] == Status.WRINKLED) > (3 if wrinkling == "tension_field" else 0)


def test_a_single_state_has_its_profile_and_capacitance_and_slopes() -> None:
    one = solve(FILM, 10e-3, 1500.0, sensitivities=True)
    assert isinstance(one.quick, compiled.One)
    with no_kernel():
        other = solve(FILM, 10e-3, 1500.0, sensitivities=True)
    assert one.capacitance() == pytest.approx(other.capacitance(), rel=1e-12)
    np.testing.assert_allclose(one.profile(11).z, other.profile(11).z, rtol=1e-9, atol=1e-15)
    assert one.dforce is not None
    assert other.dforce is not None
    assert one.dforce.keys() == other.dforce.keys()
    for name, value in other.dforce.items():
        np.testing.assert_allclose(one.dforce[name], value, rtol=1e-9, err_msg=name)


def test_flat_slack_and_impossible_states_have_the_status_of_the_path_for_arrays() -> None:
    soft = Specimen(4e-3, 20e-3, 40e-6, 1.0, NAMED["parker-cao2018"])
    narrow = replace(FILM, disk_radius=1e-4)  # a span of more than one element
    h = [0.0, 10e-3, -10e-3, 1e-3, np.nan, np.inf, 10e-3]
    for film, wrinkling in ((FILM, "plain"), (soft, "tension_field"), (narrow, "plain")):
        v = [500.0, 0.0, 1000.0, 2500.0 if film is soft else 100.0, 0.0, 10.0, np.nan]
        mine, theirs = both(film, h, v, tolerance=1e-6, wrinkling=wrinkling)
        np.testing.assert_array_equal(mine.status, theirs.status)
        np.testing.assert_allclose(mine.force, theirs.force, rtol=1e-9)


def test_films_that_the_kernel_does_not_know_are_left_to_others() -> None:
    many = Material("many", (1e4,) * 9, tuple(np.linspace(2.0, 4.0, 9)), 3.0)
    state = {"tolerance": 1e-8, "relaxed": False, "sensitivities": False}
    assert compiled.solve_one(FILM, 10e-3, 0.0, **state) is not None
    assert compiled.solve_one(replace(FILM, material=many), 10e-3, 0.0, **state) is None
    mine, theirs = both([FILM, replace(FILM, material=many)], 10e-3, 500.0)
    np.testing.assert_allclose(mine.force, theirs.force, rtol=1e-10)


def test_hostile_numbers_get_a_status_and_crash_nothing() -> None:
    """Any bits as a film, a state, a number of terms, an index; a task that makes no sense is refused."""
    random = np.random.default_rng(3)
    solver = compiled._kernel().dea_kernel_solve
    task = compiled._task(1e-8, True, True, compiled.MOST_MODES)
    answers, state = (compiled._Answer * 1)(), compiled._Kept()
    taut = 0
    for _ in range(3000):
        words = np.frombuffer(FILM.record, dtype=np.int64).copy()
        for place in random.integers(0, len(words), random.integers(0, 3)):
            words[place] = random.choice([0, -1, 3, 2**62, random.integers(-(2**62), 2**62)])
        h, v = 10.0 ** random.uniform(-320, 300), 10.0 ** random.uniform(-5, 10)
        which = ctypes.c_int64(int(random.choice([0, 0, 0, -1, 1, 2**62])))
        where = [ctypes.c_double(random.choice(pair)) for pair in ([h, 1e-2, np.nan], [v, 800.0, -np.inf])]
        given = [ctypes.byref(x) for x in (*where, answers, state)]
        assert solver(ctypes.byref(task), words.ctypes.data, 1, ctypes.byref(which), 1, *given) in (0, 1)
        if answers[0].status >= 0:
            taut += 1
            assert answers[0].status in (0, 1, 2, 3, 4)
            assert np.isfinite(answers[0].force) == (answers[0].status <= 1)
            assert answers[0].status > 1 or 0.0 < answers[0].error_estimate <= 1e-8
    assert taut > 50
    for name, value in (("tolerance", np.nan), ("tolerance", 0.0), ("first_modes", (2**40, 4, 4))):
        wrong = compiled._Task.from_buffer_copy(task)
        setattr(wrong, name, value)
        assert solver(ctypes.byref(wrong), FILM.record, 1, ctypes.byref(which), 1, *given) == -1
