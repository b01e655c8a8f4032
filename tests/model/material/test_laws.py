"""Every law that there is: its derivatives, its parameters, and the force of a cone made of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from model.arrays import Array
from model.material.gent import Gent
from model.material.law import Law, Parameter, stack
from model.material.laws import find_law, known_laws, register
from model.material.materials import NAMED, Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh
from model.membrane.solve import Status, Wrinkling, solve, solve_many
from model.specimen import Specimen
from tests.model.material.shooting import Cone

# Two films of every law: moduli (Pa) and shape parameters.
FILMS: dict[str, tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]] = {
    "ogden": (((5e3, 3.5e4), (2.5, 5.6)), ((6e4,), (1.7,))),
    "neo_hooke": (((8e4,), ()), ((1.3e5,), ())),
    "mooney_rivlin": (((4e4, 6e3), ()), ((6e4, 1e3), ())),
    "yeoh": (((5e4, -1.5e3, 4e2), ()), ((3e4, 1e3, 1e2), ())),
    "gent": (((7e4,), (25.0,)), ((9e4,), (8.0,))),
}
EVERY = sorted(FILMS)


def material(name: str, which: int = 0, eps_r: float = 2.5) -> Material:
    mu, alpha = FILMS[name][which]
    return Material(name, mu, alpha, eps_r, law=find_law(name))


def film(name: str, which: int = 0, *, disk: float = 4e-3, prestretch: float = 1.3) -> Specimen:
    return Specimen(disk, 20e-3, 60e-6, prestretch, material(name, which))


def law_of(name: str, states: int) -> Law:
    """The two films in turn, so many states; one alone is shared."""
    mu, alpha = (np.array([FILMS[name][0][k] for _ in range(states)]).reshape(states, -1).T for k in (0, 1))
    if states > 1 and name != "ogden":  # the Ogden films differ in the number of terms
        both = [FILMS[name][n % 2] for n in range(states)]
        mu, alpha = (np.array([one[k] for one in both]).reshape(states, -1).T for k in (0, 1))
    elif states > 1:
        factor = 1.0 + 0.2 * (np.arange(states) % 2)
        mu, alpha = mu * factor, alpha * factor
    return find_law(name)(mu, alpha)


def places(states: int) -> Array:
    random = np.random.default_rng(states)
    return stack(random.uniform(-0.2, 0.55, (4, states)), random.uniform(-0.1, 0.4, (4, states)))


def moved(log: Array, d1: float, d2: float) -> Array:
    return stack(log[0] + d1, log[1] + d2)


def test_every_law_of_the_package_is_tested_here() -> None:
    assert {name for name, law in known_laws().items() if law.__module__.startswith("model.")} == set(FILMS)


@pytest.mark.parametrize("states", [1, 2, 3, 40])
@pytest.mark.parametrize("name", EVERY)
def test_derivatives_are_those_of_the_energy(name: str, states: int) -> None:
    law, log, d = law_of(name, states), places(states), 1e-4
    scale = float(np.abs(law.mu).max())

    def energy(d1: float, d2: float) -> Array:
        return law.energy(moved(log, d1, d2))

    t1, t2, h11, h12, h22 = law.derivatives(log)
    here = energy(0, 0)
    for got, wanted in (
        (t1, (energy(d, 0) - energy(-d, 0)) / (2 * d)),
        (t2, (energy(0, d) - energy(0, -d)) / (2 * d)),
        (h11, (energy(d, 0) - 2 * here + energy(-d, 0)) / d**2),
        (h22, (energy(0, d) - 2 * here + energy(0, -d)) / d**2),
        (h12, (energy(d, d) - energy(d, -d) - energy(-d, d) + energy(-d, -d)) / (4 * d**2)),
    ):
        assert got.shape == here.shape
        np.testing.assert_allclose(got, wanted, rtol=2e-5, atol=2e-6 * scale)


@pytest.mark.parametrize("name", EVERY)
def test_the_caller_may_write_into_derivatives(name: str) -> None:
    for states in (1, 3):
        law, log = law_of(name, states), places(states)
        arrays = law.derivatives(log)
        assert not any(np.shares_memory(a, b) for n, a in enumerate(arrays) for b in (*arrays[n + 1 :], log, law.mu))
        first = [array.copy() for array in arrays]
        for array in arrays:
            array -= 1.0
        for again, before in zip(law.derivatives(log), first, strict=True):
            np.testing.assert_array_equal(again, before)


@pytest.mark.parametrize("name", EVERY)
def test_stresses_keep_their_digits_at_tiny_strains(name: str) -> None:
    """At strains of 1e-12 the stress is 4 G L1 + 2 G L2 to the strain's own digits."""
    mu, alpha = FILMS[name][0]
    shear = find_law(name).shear_modulus(mu, alpha)
    law = find_law(name)(np.array(mu)[:, None], np.array(alpha).reshape(-1, 1))
    t1, t2 = (float(x[0]) for x in law.derivatives(stack(np.array([1e-12]), np.array([3e-12])))[:2])
    assert (t1, t2) == pytest.approx((10e-12 * shear, 14e-12 * shear), rel=1e-10)


@pytest.mark.parametrize("name", EVERY)
def test_shear_modulus_is_the_tangent_at_rest(name: str) -> None:
    for mu, alpha in FILMS[name]:
        law = find_law(name)
        of_film = law(np.array(mu)[:, None], np.array(alpha).reshape(-1, 1))
        h11, h12, h22 = (float(x[0]) for x in of_film.derivatives(np.zeros((3, 1)))[2:])
        assert (h11, h12, h22) == pytest.approx((4 * law.shear_modulus(mu, alpha), 2 * h12 / 2, h11))
        assert h12 == pytest.approx(2 * law.shear_modulus(mu, alpha))


@pytest.mark.parametrize("states", [1, 2, 3])
@pytest.mark.parametrize("name", EVERY)
def test_derivatives_by_parameters(name: str, states: int) -> None:
    law, log = law_of(name, states), places(states)
    by_mu, by_alpha = law.by_parameters(log)
    assert len(by_mu) == len(law.mu) and len(by_alpha) == len(law.alpha)

    def stresses(mu: Array, alpha: Array) -> Array:
        return np.array(type(law)(mu, alpha).derivatives(log)[:2])

    for values, by in ((law.mu, by_mu), (law.alpha, by_alpha)):
        for n in range(len(values)):
            step = np.zeros_like(values)
            step[n] = 1e-5 * values[n]
            up, down = (
                (stresses(law.mu + s * step, law.alpha) if values is law.mu else stresses(law.mu, law.alpha + s * step))
                for s in (1.0, -1.0)
            )
            np.testing.assert_allclose(by[n], (up - down) / (2 * step[n]), rtol=1e-6, atol=1e-8 * np.abs(by[n]).max())
    rate1, rate2 = np.random.default_rng(5).normal(size=(2, 4, states))
    for got, by in zip(law.projected(log, rate1, rate2), (by_mu, by_alpha), strict=True):
        np.testing.assert_allclose(got, (rate1 * by[:, 0] + rate2 * by[:, 1]).sum(axis=1), rtol=1e-12)


def test_derivatives_by_parameters_that_a_law_does_not_write_out() -> None:
    """What `Law` itself offers agrees with Ogden's and Gent's own."""
    for name in ("ogden", "gent"):
        law, log = law_of(name, 3), places(3)
        for own, general in zip(law.by_parameters(log), Law.by_parameters(law, log), strict=True):
            np.testing.assert_allclose(own, general, rtol=1e-8, atol=1e-10 * np.abs(own).max())


@pytest.mark.parametrize("name", EVERY)
def test_powers_are_the_same_law(name: str) -> None:
    powers = find_law(name).powers(*FILMS[name][0])
    if powers is None:
        assert name in ("yeoh", "gent")
        with pytest.raises(ValueError, match="no sum of powers"):
            material(name).powers  # noqa: B018
        return
    law = law_of(name, 1)
    terms = Ogden(*(np.array(x)[:, None] for x in powers))
    for got, wanted in zip(law.derivatives(places(1)), terms.derivatives(places(1)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-9)


# --- parameters: bounds, numbers, names


def edges() -> list[tuple[type[Law], int, float, bool]]:
    """Law, number of the parameter, a value at a bound or just beyond, whether it is allowed."""
    found = []
    for law in (known_laws()[name] for name in EVERY):
        for n, p in enumerate(law.parameters(*law.counts(1))):
            for bound, outwards in ((p.lower, -1.0), (p.upper, 1.0)):
                if math.isfinite(bound):
                    found += [(law, n, bound, True), (law, n, bound + outwards * 1e-9 * max(1.0, abs(bound)), False)]
    return found


@pytest.mark.parametrize(("law", "number", "value", "allowed"), edges())
def test_bounds_are_accepted_at_and_refused_beyond(law: type[Law], number: int, value: float, allowed: bool) -> None:
    mu, alpha = FILMS[law.name][1]
    numbers = [*mu, *alpha]
    numbers[number] = value
    split = numbers[: len(mu)], numbers[len(mu) :]
    if allowed:
        law.check(*split)
    else:
        with pytest.raises(ValueError, match="allowed are"):
            law.check(*split)


def test_there_are_bounds_to_test() -> None:
    assert {(law.name, law.names(*law.counts(1))[n]) for law, n, _, _ in edges()} == {("gent", "Jm")}


@pytest.mark.parametrize("name", EVERY)
def test_numbers_that_make_no_film_are_refused(name: str) -> None:
    law = find_law(name)
    mu, alpha = FILMS[name][1]
    for bad_mu, bad_alpha, words in (
        ((), alpha, "moduli"),
        ((*mu, 1e4), alpha, "the law"),
        (mu, (*alpha, 2.0), "the law"),
        ((math.nan, *mu[1:]), alpha, "not finite"),
        (tuple(-m for m in mu), alpha, "shear modulus .* must be positive"),
        (tuple(0.0 for _ in mu), alpha, "shear modulus .* must be positive"),
    ):
        with pytest.raises(ValueError, match=words):
            law.check(bad_mu, bad_alpha)
        with pytest.raises(ValueError, match=f"material 'bad': .*{words}"):
            Material("bad", bad_mu, bad_alpha, 2.0, law=law)


def test_an_exponent_of_zero_is_refused() -> None:
    Ogden.check((1e11,), (1e-6,))
    with pytest.raises(ValueError, match="exponent of zero"):
        Ogden.check((1e11,), (0.9e-6,))


def test_materials_by_the_names_of_their_law() -> None:
    gent = Material.with_law("g", Gent, {"Jm": 40.0, "mu": 5e4}, 3.0, max_stretch=3.0)
    assert (gent.mu, gent.alpha, gent.law, gent.max_stretch) == ((5e4,), (40.0,), Gent, 3.0)
    assert gent.values == {"mu": 5e4, "Jm": 40.0}
    ogden = Material.with_law("o", Ogden, {"mu": [5e3, 3.5e4], "alpha": (2.5, 5.6)}, 1.7)
    assert ogden.values == {"mu1": 5e3, "mu2": 3.5e4, "alpha1": 2.5, "alpha2": 5.6}
    assert ogden.with_value("alpha2", 6.0).alpha == (2.5, 6.0)
    assert gent.with_value("eps_r", 4.0).eps_r == 4.0
    yeoh = Material.with_law("y", Yeoh, {"C1": 1e4, "C2": -1e2, "C3": 10}, 3.0)
    assert yeoh.values == {"C1": 1e4, "C2": -1e2, "C3": 10.0}
    for law, values, words in (
        (Gent, {"mu": 5e4}, "needs Jm"),
        (Gent, {"mu": 5e4, "Jm": 40.0, "alpha": 2.0}, "has no parameter 'alpha'; it has mu, Jm"),
        (Ogden, {"mu": [1e4], "alpha": [2.0, 3.0]}, "mu has 1 and alpha has 2 entries"),
    ):
        with pytest.raises(ValueError, match=words):
            Material.with_law("bad", law, values, 3.0)
    with pytest.raises(ValueError, match="no parameter of the material; it has mu, Jm, eps_r"):
        gent.with_value("alpha1", 2.0)


@pytest.mark.parametrize("name", EVERY)
def test_laws_describe_themselves(name: str) -> None:
    law = find_law(name)
    assert law.name == name and law.title and "W = " in law.description
    for p in law.moduli:
        assert (p.unit, p.key) == ("Pa", f"{p.name}_Pa")
    for p in law.shapes:
        assert (p.unit, p.key) == ("1", p.name)
    for p in (*law.moduli, *law.shapes):
        assert p.description.endswith(".")
        assert p.lower <= p.search[0] < p.search[1] <= p.upper
        assert p.search[0] <= p.start[0] < p.start[1] <= p.search[1]


@pytest.mark.parametrize("name", EVERY)
def test_starting_points_are_films_of_unit_modulus(name: str) -> None:
    law, random = find_law(name), np.random.default_rng(0)
    for terms in (1, 3):
        for _ in range(20):
            shares, alpha = law.draw(random, terms)
            assert (len(shares), len(alpha)) == law.counts(terms)
            mu = (shares / law.weights(alpha)[0]).tolist()
            law.check(mu, alpha.tolist())
            assert law.shear_modulus(mu, alpha.tolist()) == pytest.approx(1.0)


def test_laws_are_found_by_name() -> None:
    assert find_law("gent") is Gent and known_laws()["ogden"] is Ogden
    with pytest.raises(ValueError, match="law 'genti' is not known; known are ogden, neo_hooke, mooney_rivlin, yeoh"):
        find_law("genti")


def test_only_complete_laws_with_a_name_of_their_own_are_registered() -> None:
    class Half(Law):
        name = "half"

    with pytest.raises(TypeError, match="Half lacks derivatives, energy, shear_modulus"):
        register(Half)
    with pytest.raises(TypeError, match="no law"):
        register(Parameter)  # type: ignore[arg-type]

    class Other(NeoHooke):
        name = "gent"

    with pytest.raises(ValueError, match="two laws are called 'gent'"):
        register(Other)
    assert register(Gent) is Gent


# --- films


SLOPES = {
    "neo_hooke": lambda mu, _: lambda i1, i2: (mu[0] / 2, 0.0),
    "mooney_rivlin": lambda mu, _: lambda i1, i2: (mu[0], mu[1]),
    "yeoh": lambda mu, _: lambda i1, i2: (mu[0] + 2 * mu[1] * (i1 - 3) + 3 * mu[2] * (i1 - 3) ** 2, 0.0),
    "gent": lambda mu, alpha: lambda i1, i2: (mu[0] / 2 / (1 - (i1 - 3) / alpha[0]), 0.0),
}


@pytest.mark.parametrize(("which", "h", "voltage"), [(0, 10e-3, 0.0), (1, 8e-3, 1500.0)])
@pytest.mark.parametrize("name", sorted(SLOPES))
def test_force_of_a_cone_agrees_with_shooting(name: str, which: int, h: float, voltage: float) -> None:
    mu, alpha = FILMS[name][which]
    cone = Cone(4e-3, 20e-3, 60e-6, 1.3, SLOPES[name](mu, alpha), 2.5)  # type: ignore[no-untyped-call]
    most = 2.4 if name == "gent" else 8.0
    wanted = cone.force(h, voltage, most)
    specimen = film(name, which)
    one = solve(specimen, h, voltage, tolerance=1e-10)
    assert one.status == Status.TAUT
    assert one.force == pytest.approx(wanted, rel=1e-8)
    many = solve_many([specimen, film(name, 1 - which)], h, voltage, tolerance=1e-10)
    assert many.force[0] == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
def test_gent_with_long_chains_is_neo_hooke(wrinkling: Wrinkling) -> None:
    """To 1e-6 with Jm = 1e6 while I1 - 3 is below one; beyond, by no more than (I1 - 3)/Jm."""
    long = Material("long", (8e4,), (1e6,), 2.5, law=Gent)
    ours = film("neo_hooke", prestretch=1.1)
    h = np.array([2e-3, 5e-3, 7e-3, 14e-3, 20e-3])
    for voltage in (0.0, 1500.0):
        a, b = (
            solve_many(ours.with_material(m), h, voltage, tolerance=1e-9, wrinkling=wrinkling)
            for m in (long, ours.material)
        )
        np.testing.assert_array_equal(a.status, b.status)
        most = np.maximum(1.0, a.max_stretch**2 + 2.0 / a.max_stretch - 3.0)
        there = a.answered
        assert (np.abs(a.force / b.force - 1.0) < 1e-6 * most)[there].all()
        assert there[:3].all() and most[2] == 1.0  # the first three are held to 1e-6
        for x, wanted in zip(h[:3], b.force[:3], strict=True):
            one = solve(ours.with_material(long), x, voltage, tolerance=1e-9, wrinkling=wrinkling)
            assert one.force == pytest.approx(float(wanted), rel=1e-6)


@pytest.mark.parametrize("name", EVERY)
def test_derivatives_of_the_force_by_parameters(name: str) -> None:
    specimen = film(name)
    found = solve_many(specimen, 10e-3, 1500.0, tolerance=1e-11, sensitivities=True)
    assert found.dforce is not None
    m = specimen.material
    by = [*found.dforce["mu"], *found.dforce["alpha"]]
    assert len(by) == len(m.values)
    for (parameter, value), slope in zip(m.values.items(), by, strict=True):
        up, down = (
            solve(
                specimen.with_material(m.with_value(parameter, (1 + s) * value)), 10e-3, 1500.0, tolerance=1e-11
            ).force
            for s in (1e-5, -1e-5)
        )
        assert slope == pytest.approx((up - down) / (2e-5 * value), rel=1e-5)


MIXED = [
    film("ogden", disk=3e-3),
    film("ogden", 1, disk=5e-3),
    film("gent"),
    film("gent", 1),
    film("yeoh", prestretch=1.2),
    film("neo_hooke"),
    film("mooney_rivlin", 1),
]


@pytest.mark.parametrize("sensitivities", [False, True])
@pytest.mark.parametrize(
    "films",
    [
        [MIXED[0]],
        [MIXED[0], replace(MIXED[0], material=replace(MIXED[0].material, mu=(9e3, 5e4)))],
        [MIXED[2], MIXED[3]],
        [MIXED[5], replace(MIXED[5], material=replace(MIXED[5].material, mu=(9.1e4,)))],
        MIXED[:2],
        MIXED[2:5],
        MIXED,
        [MIXED[n % 7] for n in range(25)],
    ],
    ids=["1", "2 ogden", "2 gent", "2 neo-hooke", "2 series", "3", "7", "25"],
)
def test_each_film_of_a_batch_is_solved_with_its_own_parameters(films: list[Specimen], sensitivities: bool) -> None:
    """However many there are, of whatever laws: as solved alone."""
    h = np.linspace(6e-3, 9e-3, len(films))
    voltage = np.where(np.arange(len(films)) % 3 == 1, 0.0, 1200.0)
    found = solve_many(films, h, voltage, tolerance=1e-9, sensitivities=sensitivities)
    for k, one in enumerate(films):
        alone = solve_many(one, h[k], voltage[k], tolerance=1e-9, sensitivities=sensitivities)
        assert found.force[k] == pytest.approx(float(alone.force), rel=1e-8)
        assert found.force[k] == pytest.approx(solve(one, h[k], voltage[k], tolerance=1e-9).force, rel=1e-8)
        if sensitivities:
            assert found.dforce is not None and alone.dforce is not None
            for name, count in (("mu", len(one.material.mu)), ("alpha", len(one.material.alpha))):
                np.testing.assert_allclose(found.dforce[name][k][:count], alone.dforce[name], rtol=1e-5)
                assert np.isnan(found.dforce[name][k][count:]).all()


@pytest.mark.parametrize("jm", [3.0, 6.0, 20.0])
def test_a_gent_film_near_its_longest_is_solved_or_says_that_it_is_not(jm: float) -> None:
    """Towards the largest stretch the force rises without bound; beyond there is no state, and no number."""
    specimen = Specimen(4e-3, 20e-3, 60e-6, 1.2, Material("g", (7e4,), (jm,), 2.5, law=Gent))
    h = np.linspace(1e-3, 60e-3, 60)
    found = solve_many(specimen, h)
    force = found.force[found.answered]
    assert len(force) > 5 and (np.diff(force) > 0).all()
    assert found.answered[: len(force)].all()  # up to some height everywhere, and then nowhere
    assert np.isnan(found.force[~found.answered]).all()
    for x, wanted in zip(h[:3], found.force[:3], strict=True):
        assert solve(specimen, x).force == pytest.approx(float(wanted), rel=1e-7)


def test_named_materials_are_ogden_by_default() -> None:
    assert all(m.law is Ogden for m in NAMED.values())
    assert Material("m", (1e4, 2e3), (), 2.0, law=MooneyRivlin).shear_modulus == 2.4e4
