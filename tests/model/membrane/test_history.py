"""Films that take time: forces along histories against values of an independent code, and what must hold exactly.

The reference values come from elements of the sixth degree in R and another implicit method of the fourth order; two
resolutions of it agree to 1e-9 of the largest force.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.arrays import Array
from model.material.gent import Gent
from model.material.materials import NAMED, Branch, Material
from model.material.yeoh import Yeoh
from model.membrane.history import History, at_once, solve_histories, solve_history
from model.membrane.march import Course, How, March
from model.membrane.solve import Status, solve, solve_many
from model.membrane.viscous import balance
from model.membrane.viscous_films import Films, Instant, State
from model.specimen import Specimen

PARKER = NAMED["parker-cao2018"]
VHB = Material("vhb", (43560.0, 117.4), (1.445, 4.248), 4.7)


def film(
    branches: Sequence[tuple[float, float]], disk: float = 4e-3, lp: float = 1.2, material: Material = PARKER
) -> Specimen:
    thickness = 500e-6 if material is VHB else 40e-6
    return Specimen(disk, 20e-3, thickness, lp, replace(material, branches=tuple(Branch(*one) for one in branches)))


CASES = {
    "hold-a4-2br": (
        film([(0.1, 1), (0.1, 30)]),
        ([0, 10, 100], [0, 10, 10], [0, 0, 0]),
        (
            [8.823529, 17.647059, 44.117647, 73.529412, 100],
            [0.174014016, 0.21955249, 0.217206552, 0.216274197, 0.215938708],
        ),
    ),
    "hold-1500V-a6": (
        film([(0.5, 0.05), (0.2, 2), (0.1, 100)], 6e-3),
        ([0, 1, 7, 67], [0, 0, 12, 12], [0, 1500, 1500, 1500]),
        (
            [2.16129, 8.645161, 25.935484, 47.548387, 67],
            [0.0213295832, 0.428452214, 0.419118952, 0.41611723, 0.414475493],
        ),
    ),
    "vstep-a4": (
        film([(0.3, 3), (0.2, 30)]),
        ([0, 4, 24, 24.1, 44.1, 44.2, 64.2, 64.3, 84.3], [0] + [8] * 8, [0, 0, 0, 1000, 1000, 1500, 1500, 0, 0]),
        ([5.26875, 24, 44.1, 64.2, 84.3], [0.15232391, 0.144805468, 0.125030689, 0.100708807, 0.142045299]),
    ),
    "tri-1": (
        film([(0.1, 1), (0.1, 30)]),
        ([0, 12, 24, 36, 48], [0, 12, 0, 12, 0], [0] * 5),
        ([5.142857, 12.6, 24.6, 36.6, 48], [0.0721346545, 0.291170732, 0.00628916612, 0.28971975, 0]),
    ),
    "vhb-vstep": (
        film([(2, 3), (1, 100)], 6e-3, 3.0, VHB),
        ([0, 15, 75, 75.5, 195.5, 196, 256], [0] + [15] * 6, [0, 0, 0, 1500, 1500, 0, 0]),
        ([18, 58.181818, 105.5, 195.625, 256], [0.992956148, 0.942115763, 0.789285402, 0.828994569, 0.894975686]),
    ),
}


@pytest.mark.parametrize(("tolerance", "bound"), [(1e-6, 1e-6), (1e-4, 1e-4)])
@pytest.mark.parametrize("name", CASES)
def test_force_agrees_with_an_independent_code(name: str, tolerance: float, bound: float) -> None:
    specimen, (t, h, voltage), (times, wanted) = CASES[name]
    found = solve_history(specimen, t, np.array(h) * 1e-3, voltage, times, tolerance=tolerance)
    error = np.abs(found.force - wanted) / max(wanted)
    assert (error < bound).all()
    assert (error < 3.0 * found.error_estimate + 1e-9).all()
    assert (found.error_estimate < 10.0 * bound).all()
    assert (found.status == Status.TAUT).all()
    assert found.steps > 10


HOLD, STEPS = ([0, 10, 40], [0, 10e-3, 10e-3], [0, 0, 1000]), np.array([4.0, 10.0, 17.0, 40.0])


def test_tension_and_field_come_with_the_force() -> None:
    """At the end of a long hold everything is that of the relaxed film."""
    specimen = film([(0.2, 0.5), (0.1, 2.0)], 5e-3)
    found = solve_history(specimen, [0, 10, 11, 80], [0, 10e-3, 10e-3, 10e-3], [0, 0, 1200, 1200], [80.0])
    elastic = solve(specimen, 10e-3, 1200.0)
    assert found.force[0] == pytest.approx(elastic.force, rel=1e-6)
    assert found.peak_field[0] == pytest.approx(elastic.peak_field, rel=1e-5)
    assert found.min_hoop_stress[0] == pytest.approx(elastic.min_hoop_stress, rel=1e-4)
    assert found.min_meridional_stress[0] == pytest.approx(elastic.min_meridional_stress, rel=1e-4)


@pytest.mark.parametrize(
    ("lp", "voltage", "wanted"), [(1.2, 0.0, 0.235222585), (1.2, 1000.0, 0.211623996), (1.0, 0.0, 0.122301482)]
)
def test_response_at_once_is_that_of_branches_without_prestretch(lp: float, voltage: float, wanted: float) -> None:
    """A film pushed in no time: branches answer like films that were not pre-stretched."""
    found = solve_history(film([(0.2, 1.0), (0.1, 10.0)], lp=lp), [0, 1], [10e-3, 10e-3], [voltage] * 2, [0.0])
    assert found.force[0] == pytest.approx(wanted, rel=1e-8)
    many = at_once(film([(0.2, 1.0), (0.1, 10.0)], lp=lp), [[0.0, 10e-3], [-10e-3, 5e-3]], [voltage], tolerance=1e-8)
    np.testing.assert_allclose(many[0, 1], wanted, rtol=1e-8)
    assert many[0, 0] == 0.0 and many[1, 0] == -many[0, 1] and 0.0 < many[1, 1] < wanted


def test_exact_scalings() -> None:
    (t, h, voltage), times = HOLD, STEPS
    base = film([(0.3, 2.0), (0.1, 20.0)])
    force = solve_history(base, t, h, voltage, times, tolerance=1e-5).force

    def scaled(specimen: Specimen, time: float = 1.0, height: float = 1.0, volts: float = 1.0) -> Array:
        values = [np.array(one) * factor for one, factor in ((t, time), (h, height), (voltage, volts), (times, time))]
        return solve_history(specimen, *values, tolerance=1e-5).force

    m = base.material
    thick = replace(base, thickness=3 * base.thickness)
    large = replace(base, disk_radius=7 * base.disk_radius, ring_radius=7 * base.ring_radius)
    stiff = base.with_material(replace(m, mu=tuple(11 * mu for mu in m.mu)))
    late = base.with_material(replace(m, branches=tuple(Branch(one.ratio, 10 * one.time) for one in m.branches)))
    halves = [Branch(0.15, 2.0), Branch(0.1, 20.0), Branch(0.15, 2.0)]
    split = base.with_material(replace(m, branches=tuple(halves)))
    other = base.with_material(replace(m, branches=m.branches[::-1]))
    none = base.with_material(replace(m, branches=(*m.branches, Branch(0.0, 5.0))))
    np.testing.assert_allclose(scaled(thick, volts=3.0), 3.0 * force, rtol=1e-9)
    np.testing.assert_allclose(scaled(large, height=7.0), 7.0 * force, rtol=1e-9)
    np.testing.assert_allclose(scaled(stiff, volts=11.0**0.5), 11.0 * force, rtol=1e-9)
    np.testing.assert_allclose(scaled(late, time=10.0), force, rtol=1e-9)
    for same in (split, other, none):
        np.testing.assert_allclose(scaled(same), force, rtol=1e-9)


def test_a_film_pushed_to_the_other_side_pulls_back_as_much() -> None:
    (t, h, voltage), times = HOLD, STEPS
    specimen = film([(0.3, 2.0)])
    up, down = (solve_history(specimen, t, side * np.array(h), voltage, times, tolerance=1e-5) for side in (1.0, -1.0))
    np.testing.assert_allclose(down.force, -up.force, rtol=1e-12)


def test_error_falls_with_the_fourth_power_of_the_step() -> None:
    """Steps of one length, halved: errors at the end fall by 16 each time."""
    specimen = film([(0.3, 3.0), (0.2, 15.0)])
    t, h, voltage = np.array([0.0, 8.0]), np.array([2e-3, 10e-3]), np.array([300.0, 800.0])
    exact = solve_history(specimen, t, h, voltage, [8.0], tolerance=1e-9).force[0]
    errors = []
    films = Films.of([specimen], 9)
    for count in (4, 8, 16):
        march = March(films, [Course(t, h, voltage)], How(1e-9))
        for _ in range(count):
            step = march.step(np.array([8.0 / count]))
            march.accept(step, step.ok, step.begin + step.dt)
        errors.append(abs(float(step.answer[0] * films.unit[0]) / exact - 1.0))
    ratios = [before / after for before, after in pairwise(errors)]
    assert min(ratios) > 11.0, errors  # 2^3.5
    assert errors[-1] > 1e-10  # the exact value is far better than what it judges


@pytest.mark.slow
def test_answers_between_steps_and_in_any_order() -> None:
    (t, h, voltage), _ = HOLD, STEPS
    specimen = film([(0.3, 2.0), (0.1, 20.0)])
    dense = np.linspace(0.0, 40.0, 161)
    many = solve_history(specimen, t, h, voltage, dense)
    fine = solve_history(specimen, t, h, voltage, dense[::8], tolerance=1e-8)
    np.testing.assert_allclose(many.force[::8], fine.force, atol=1e-6 * fine.force.max())
    back = solve_history(specimen, t, h, voltage, dense[::-1])
    np.testing.assert_allclose(back.force[::-1], many.force, rtol=1e-12)
    plain = solve_history(specimen, t, h, voltage)
    np.testing.assert_allclose(plain.force, many.force[[0, 40, 160]], rtol=1e-9)
    assert many.force[0] == 0.0 and many.status[0] == Status.TAUT


def test_without_branches_it_is_the_elastic_film() -> None:
    (t, h, voltage), times = HOLD, STEPS
    found = solve_history(film([]), t, h, voltage, times)
    elastic = solve_many(film([]), np.interp(times, t, h), np.interp(times, t, voltage))
    np.testing.assert_allclose(found.force, elastic.force, rtol=1e-6)
    assert found.steps < 30


def test_gent_films_take_time_too() -> None:
    """With long chains and one branch as the neo-Hookean film, an Ogden term with the exponent 2."""
    (t, h, voltage), times = HOLD, STEPS
    ogden = film([(0.4, 3.0)], material=Material("o", (8e4,), (2.0,), 2.0))
    gent = ogden.with_material(replace(ogden.material, alpha=(1e7,), law=Gent))
    one, other = (solve_history(specimen, t, h, 0.5 * np.array(voltage), times) for specimen in (ogden, gent))
    np.testing.assert_allclose(one.force, other.force, rtol=1e-6)


@pytest.mark.slow
def test_dissipation_is_never_negative_and_no_work_is_won_in_a_cycle() -> None:
    t = np.linspace(0.0, 40.0, 401)
    h = 5e-3 - 4e-3 * np.cos(t * np.pi / 10.0)
    found = solve_history(film([(0.5, 2.0)]), t, h, 0.0, tolerance=1e-5)
    cycles = [slice(k, k + 201) for k in (0, 200)]
    work = [float(np.trapezoid(found.force[c], h[c])) for c in cycles]
    assert all(one > 0.0 for one in work)


@pytest.mark.parametrize("lag", [0.0, 0.3, 30.0, 1e9])
def test_stage_is_solved_at_every_point(lag: float) -> None:
    """``x + c P S(x)/2 = u - v*``; c = 0 is the branch at once, c = inf none."""
    films = Films.of([film([(0.2, 1.0), (0.1, 10.0)])], 8)
    shape = (2, 2, *films.grid.radius.shape)
    start = np.full(shape, films.log_prestretch[0])
    c = np.array([lag, 2.0 * lag]).reshape(-1, 1, 1, 1)
    height = 10e-3 / 20e-3
    w = height * films.grid.radius**-0.5
    first = State(np.zeros((films.grid.unknowns, 1)), w * height / (films.grid.once * w).sum(), np.zeros(shape))
    with np.errstate(all="ignore"):
        at = balance(films, Instant(np.array([10e-3]), np.zeros(1)), start, c, first, 1e-7)
    x = at.state.x
    s1, s2, *_ = films.law.derivatives(np.concatenate((x, -x[:1] - x[1:])))
    missed = x + c / 6.0 * np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) - (at.u[:, None] - start)
    assert at.ok.all() and np.abs(missed).max() < 1e-12 * max(1.0, lag)
    if lag == 0.0:
        assert at.lam[0] * films.unit[0] == pytest.approx(0.235222585, rel=1e-8)
    if lag == 1e9:
        assert at.lam[0] * films.unit[0] == pytest.approx(solve(film([]), 10e-3).force, rel=1e-6)


def changed(specimen: Specimen, name: str, which: int, factor: float) -> Specimen:
    """The specimen with one parameter times ``factor``."""
    m = specimen.material

    def of(values: Sequence[float]) -> tuple[float, ...]:
        return tuple(value * (factor if k == which else 1.0) for k, value in enumerate(values))

    if name in ("ratio", "time"):
        values = of([getattr(one, name) for one in m.branches])
        branches = tuple(replace(one, **{name: value}) for one, value in zip(m.branches, values, strict=True))
        return specimen.with_material(replace(m, branches=branches))
    if name in ("mu", "alpha"):
        return specimen.with_material(replace(m, **{name: of(getattr(m, name))}))
    if name == "eps_r":
        return specimen.with_material(replace(m, eps_r=m.eps_r * factor))
    return replace(specimen, **{name: getattr(specimen, name) * factor})


def worst_slope(specimen: Specimen, course: Sequence[object], times: Array, step: float, tolerance: float) -> Array:
    """Largest differences of ``dforce`` to central differences of the fourth order: of the force at its peak, for a
    relative change of one of the parameter."""
    t, h, voltage = course
    found = solve_history(specimen, t, h, voltage, times, tolerance=tolerance, sensitivities=True)  # type: ignore[arg-type]
    assert found.dforce is not None
    m = specimen.material
    many = {"mu": len(m.mu), "alpha": len(m.alpha), "ratio": len(m.branches), "time": len(m.branches)}
    kinds = [(name, k) for name in found.dforce if name != "h" for k in range(many.get(name, 1))]
    shifts = (1.0, -1.0, 2.0, -2.0)
    steps = {"alpha": 0.2 * step, "prestretch": 0.1 * step}  # these bend the force most
    films = [changed(specimen, *kind, 1.0 + steps.get(kind[0], step) * x) for kind in kinds for x in shifts]
    histories = [(t, h, voltage, times)] * len(films)
    push = 1e-3 * step
    histories += [(t, np.asarray(h) + push * x, voltage, times) for x in shifts]
    forces = solve_histories([*films, *[specimen] * 4], histories, tolerance=tolerance)  # type: ignore[arg-type]
    worst = []
    for k, kind in enumerate([*kinds, ("h", 0)]):
        up, down, more, less = (one.force for one in forces[4 * k : 4 * k + 4])
        value = push if kind[0] == "h" else steps.get(kind[0], step) * original(specimen, *kind)
        wanted = (8.0 * (up - down) - (more - less)) / (12.0 * value)
        got = found.dforce[kind[0]]
        got = got[:, kind[1]] if kind[0] in many else got
        size = 10e-3 if kind[0] == "h" else original(specimen, *kind)
        worst.append(float(np.abs(got - wanted).max() * size / np.abs(found.force).max()))
    return np.array(worst)


def original(specimen: Specimen, name: str, which: int) -> float:
    """The value of one parameter."""
    m = specimen.material
    values = {"mu": m.mu, "alpha": m.alpha, "eps_r": (m.eps_r,)}
    values |= {"ratio": tuple(b.ratio for b in m.branches), "time": tuple(b.time for b in m.branches)}
    values |= {"thickness": (specimen.thickness,), "prestretch": (specimen.prestretch,)}
    return values[name][which]


PUSHED = ([0, 2, 4, 4.5, 7], [0, 9e-3, 9e-3, 7e-3, 7e-3], [0, 0, 0, 1200, 1200])


def in_steps(specimens: Sequence[Specimen], sensitivities: bool = False) -> tuple[March, Films]:
    """Films pushed in three equal steps between bends, whatever their parameters."""
    t, h, voltage = (np.array(one, dtype=float) for one in PUSHED)
    films = Films.of(specimens, 7)
    march = March(films, [Course(t, h, voltage)] * len(specimens), How(1e-10, sensitivities))
    for left, right in pairwise(t.tolist()):
        for k in (1, 2, 3):
            step = march.step(np.full(len(specimens), (right - left) / 3.0))
            assert step.ok.all()
            march.accept(step, step.ok, np.full(len(specimens), left + (right - left) * k / 3.0))
        march.turn()
    return march, films


def test_derivatives_are_those_of_the_steps_taken() -> None:
    """With the same steps: viscous strains at the end, by every parameter of the law and the branches."""
    specimen = film([(0.3, 1.0), (0.4, 6.0)], 5e-3)
    kinds = [("mu", 0), ("alpha", 1), ("ratio", 0), ("ratio", 1), ("time", 0), ("time", 1), ("prestretch", 0)]
    columns = {("alpha", 1): 3, ("ratio", 0): 5, ("ratio", 1): 6, ("time", 0): 7, ("time", 1): 8, ("prestretch", 0): 9}
    with np.errstate(all="ignore"):
        march, _ = in_steps([specimen], sensitivities=True)
        moved = [changed(specimen, *kind, 1.0 + 1e-3 * x) for kind in kinds for x in (1.0, -1.0, 2.0, -2.0)]
        others, _ = in_steps(moved)
    assert march.moment.viscous_slopes is not None
    for k, kind in enumerate(kinds):
        up, down, more, less = np.moveaxis(others.moment.viscous[..., 4 * k : 4 * k + 4], -1, 0)
        wanted = (8.0 * (up - down) - (more - less)) / 12e-3
        factor = 1.0 if kind[0] in ("time", "prestretch") else original(specimen, *kind)
        factor /= specimen.material.shear_modulus if kind[0] == "mu" else 1.0
        got = march.moment.viscous_slopes[..., columns.get(kind, 0), 0] * factor
        assert np.abs(got - wanted).max() < 1e-6 * np.abs(wanted).max(), kind


@pytest.mark.slow
def test_derivatives_agree_with_differences() -> None:
    """Of the whole solution, whose steps change with the parameters."""
    times = np.array([1.5, 3.0, 4.2, 7.0])
    worst = worst_slope(film([(0.3, 1.0), (0.4, 6.0)], 5e-3), PUSHED, times, 0.02, 1e-9)
    assert (worst < 1e-6).all(), worst


@pytest.mark.slow
@pytest.mark.parametrize("law", ["gent", "yeoh", "pulled"])
def test_derivatives_of_other_laws_and_of_a_film_pulled_from_the_start(law: str) -> None:
    t, h, voltage = PUSHED
    specimen = film([(0.5, 2.0)], 6e-3)
    if law == "gent":
        specimen = specimen.with_material(replace(specimen.material, mu=(8e4,), alpha=(30.0,), law=Gent))
    elif law == "yeoh":
        specimen = specimen.with_material(replace(specimen.material, mu=(5e4, -500.0, 20.0), alpha=(), law=Yeoh))
    else:
        h = [-4e-3, *h[1:]]
    worst = worst_slope(specimen, (t, h, voltage), np.array([1.5, 4.2, 7.0]), 0.02, 1e-7)
    assert (worst < 1e-5).all(), worst


def test_derivatives_scale_as_the_forces_do() -> None:
    """Moduli and permittivity together scale the force; a branch split in two has two halves of its slopes."""
    t, h, voltage = PUSHED
    whole = film([(0.3, 1.0)], 5e-3)
    halves = whole.with_material(replace(whole.material, branches=(Branch(0.1, 1.0), Branch(0.2, 1.0))))
    one, two = solve_histories([whole, halves], [(t, h, voltage, [1.5, 4.2, 7.0])] * 2, sensitivities=True)
    assert one.dforce is not None and two.dforce is not None
    scaled = one.dforce["mu"] @ np.array(whole.material.mu) + one.dforce["eps_r"] * whole.material.eps_r
    np.testing.assert_allclose(scaled, one.force, rtol=1e-5)
    np.testing.assert_allclose(two.dforce["ratio"], one.dforce["ratio"] * [1.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(two.dforce["time"], one.dforce["time"] * [1 / 3, 2 / 3], rtol=1e-5)
    np.testing.assert_allclose(two.force, one.force, rtol=1e-6)
    np.testing.assert_allclose(two.dforce["h"], one.dforce["h"], rtol=1e-5)


def test_a_branch_of_no_stiffness_has_a_slope() -> None:
    """It adds its share of the force that it would have: with the ratio 0 as with a small one."""
    t, h, voltage = PUSHED
    none, small = (film([(0.2, 3.0), (ratio, 1.0)], 5e-3) for ratio in (0.0, 1e-5))
    one, two = solve_histories([none, small], [(t, h, voltage, [3.0])] * 2, tolerance=1e-5, sensitivities=True)
    assert one.dforce is not None
    assert one.dforce["ratio"][0, 1] > 0.01
    assert one.dforce["time"][0, 1] == 0.0
    assert (two.force - one.force)[0] / 1e-5 == pytest.approx(one.dforce["ratio"][0, 1], rel=0.1)


def test_many_histories_at_once_are_those_alone() -> None:
    """Each has its own steps and end; of unlike films, and one that has no state in its middle."""
    soft = film([(0.2, 1.0)], 6e-3, 1.2, Material("soft", (3e4,), (2.0,), 5.0))
    films = [film([(0.3, 2.0)]), film([(0.1, 1.0), (0.1, 9.0)], 6e-3), soft, film([(0.5, 0.3)], 9e-3)]
    courses = [
        ([0, 3, 9], [0, 8e-3, 8e-3], [0, 0, 900], [1.0, 9.0]),
        ([0, 1], [5e-3, 5e-3], 0.0, [0.0, 0.7]),
        ([0, 5, 15], [0, 5e-3, 5e-3], [0, 0, 6000.0], [4.0, 15.0]),
        ([0, 3, 9], [0, -8e-3, 2e-3], 0.0, [1.0, 9.0]),
    ]
    together = solve_histories(films, courses, tolerance=1e-4)  # type: ignore[arg-type]
    for specimen, course, found in zip(films, courses, together, strict=True):
        alone: History = solve_history(specimen, *course, tolerance=1e-4)  # type: ignore[arg-type]
        largest = float(np.nanmax(np.abs(alone.force)))
        np.testing.assert_allclose(found.force, alone.force, atol=1e-5 * largest)
        assert (found.status == alone.status).all()
        assert abs(found.steps - alone.steps) <= 3


def test_answers_between_solved_states_follow_them() -> None:
    """A thousand answers in a few steps, of films without and with branches, against those asked for one by one."""
    t, h, voltage = PUSHED
    films = [film([], 5e-3), film([(0.3, 1.0)], 5e-3)]
    many = np.linspace(0.0, 7.0, 1001)
    dense = solve_histories(films, [(t, h, voltage, many)] * 2, tolerance=1e-5)
    single = solve_histories(films, [(t, h, voltage, many[7::60])] * 2, tolerance=1e-5)
    for one, two in zip(dense, single, strict=True):
        np.testing.assert_allclose(one.force[7::60], two.force, atol=3e-5 * two.force.max())
        np.testing.assert_allclose(one.peak_field[7::60], two.peak_field, rtol=1e-4, atol=1.0)
        assert (one.error_estimate < 1e-4).all()


@pytest.mark.parametrize(
    ("t", "h", "voltage", "times", "tolerance", "words"),
    [
        ([0.0], [0.0], 0.0, None, 1e-6, "at least two times"),
        ([0.0, 1.0, 1.0], [0.0, 1e-3, 2e-3], 0.0, None, 1e-6, "a jump at 1 s"),
        ([1.0, 1.0], [0.0, 0.0], 0.0, None, 1e-6, "rise"),
        ([0.0, 1.0, 0.5], [0.0, 1e-3, 2e-3], 0.0, None, 1e-6, "rise"),
        ([0.0, np.nan], [0.0, 1e-3], 0.0, None, 1e-6, "rise"),
        ([0.0, 1.0], [0.0, 1e-3, 2e-3], 0.0, None, 1e-6, "h has 3 values, t has 2"),
        ([0.0, 1.0], [0.0, np.inf], 0.0, None, 1e-6, "h holds a value that is not finite"),
        ([0.0, 1.0], [0.0, 1e-3], [0.0], None, 1e-6, "voltage has 1 values"),
        ([0.0, 1.0], [0.0, 1e-3], 0.0, [1.1], 1e-6, "within the history, 0 to 1 s"),
        ([0.0, 1.0], [0.0, 1e-3], 0.0, [-0.1], 1e-6, "within the history"),
        ([0.0, 1.0], [0.0, 1e-3], 0.0, None, 0.9e-10, "tolerance"),
        ([0.0, 1.0], [0.0, 1e-3], 0.0, None, 1.1e-2, "tolerance"),
    ],
)
def test_what_is_no_history_is_refused(
    t: object, h: object, voltage: object, times: object, tolerance: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        solve_history(film([(0.1, 1.0)]), t, h, voltage, times, tolerance=tolerance)  # type: ignore[arg-type]


def test_a_hold_of_no_length_is_none() -> None:
    specimen, times = film([(0.3, 2.0)]), [0.0, 1.0, 2.0]
    twice = solve_history(specimen, [0, 1, 1, 2, 2], [0, 8e-3, 8e-3, 4e-3, 4e-3], 0.0, times, tolerance=1e-3)
    once = solve_history(specimen, [0, 1, 2], [0, 8e-3, 4e-3], 0.0, times, tolerance=1e-3)
    np.testing.assert_array_equal(twice.force, once.force)


@pytest.mark.parametrize(
    ("ratio", "time", "words"),
    [(-1e-9, 1.0, "ratio"), (np.inf, 1.0, "ratio"), (0.1, 0.0, "time"), (0.1, np.nan, "time")],
)
def test_branches_that_are_none_are_refused(ratio: float, time: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Branch(ratio, time)


def test_beyond_pull_in_there_is_a_status_and_no_number() -> None:
    specimen = film([(0.2, 1.0)], 6e-3, 1.2, Material("soft", (3e4,), (2.0,), 5.0))
    found = solve_history(specimen, [0, 5, 15], [0, 5e-3, 5e-3], [0, 0, 6000.0], [4.0, 5.0, 15.0], tolerance=1e-4)
    assert found.status[0] == found.status[1] == Status.TAUT
    assert found.status[2] > Status.WRINKLED
    assert np.isnan(found.force[2]) and np.isnan(found.error_estimate[2]) and np.isnan(found.peak_field[2])


def test_a_move_of_no_time_and_a_hold_of_years() -> None:
    """What comes after a move of a nanosecond is the film pushed at once, and at last the relaxed one."""
    specimen = film([(0.3, 2.0)])
    t, h = [0.0, 1e-9, 4.0, 1e9], [0.0, 8e-3, 8e-3, 8e-3]
    found = solve_history(specimen, t, h, 0.0, tolerance=1e-4)
    assert (found.status == Status.TAUT).all()
    assert found.force[1] == pytest.approx(at_once(specimen, 8e-3), rel=1e-5)
    assert found.force[1] > found.force[2] > found.force[3]
    assert found.force[3] == pytest.approx(solve(specimen, 8e-3).force, rel=1e-4)


def test_a_film_that_its_branches_push_slack_has_a_status_and_no_number() -> None:
    """Pushed, held and pulled back at once, a film without pre-stretch is too long for its frame."""
    specimen = film([(2.0, 1.0)], lp=1.0)
    found = solve_history(specimen, [0, 5, 5.3, 8], [0, 10e-3, 1e-3, 1e-3], 0.0, [4.0, 5.0, 5.3, 8.0], tolerance=1e-5)
    assert (found.status[:2] == Status.TAUT).all() and (found.status[2:] > Status.WRINKLED).all()
    assert np.isfinite(found.force[:2]).all() and np.isnan(found.force[2:]).all()
    assert found.steps + found.rejected < 500  # it does not try for ever


def test_elastic_solutions_do_not_load_it() -> None:
    code = "import sys, model.membrane.solve, calibration.film.identify; print('model.membrane.history' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"
