"""Homogeneous tests: published parameters on published data, joint fits, cross-mode prediction, strict reading."""

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.sheet.fit import cross_prediction, fit_tests
from calibration.sheet.problem import SheetProblem, nominal_stress, r_squared
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError
from model.material.gent import Gent
from rig.importing.sheet_table import read_sheet_tests

# Published test data, kept beside the project; without it the tests on it are skipped.
DATA = next(
    (up / "shared/data" for up in Path(__file__).resolve().parents if (up / "shared/data").is_dir()), Path("none")
)
OGDEN_1972 = ((0.63e6, 0.0012e6, -0.01e6), (1.3, 5.0, -2.0))  # Treloar's rubber, in this convention


@pytest.fixture(scope="module")
def treloar() -> list[HomogeneousTest]:
    if not DATA.is_dir():
        pytest.skip("Treloar's published data is not there")
    return [load_test(DATA / f"treloar1944_{kind}.csv") for kind in ("uniaxial", "equibiaxial", "pure_shear")]


@pytest.fixture(scope="module")
def kawabata() -> HomogeneousTest:
    if not DATA.is_dir():
        pytest.skip("Kawabata's published data is not there")
    return load_test(DATA / "kawabata1981_biaxial.csv")


def load_test(path: Path) -> HomogeneousTest:
    """The one test in a table."""
    (test,) = read_sheet_tests([path]).tests
    return test


def sheet(kind: str, l1: list[float], l2: list[float]) -> HomogeneousTest:
    first = np.array(l1)
    return HomogeneousTest(kind, kind, first, np.array(l2), np.zeros_like(first), np.full_like(first, np.nan))


def test_stress_of_a_neo_hookean_sheet_in_closed_form() -> None:
    stretch = np.array([1.0, 1.3, 2.0, 0.7])
    for l2, expected in (
        (stretch**-0.5, stretch - stretch**-2),
        (stretch, stretch - stretch**-5),
        (np.ones(4), stretch - stretch**-3),
    ):
        test = sheet("x", list(stretch), list(l2))
        np.testing.assert_allclose(nominal_stress((1e5,), (2.0,), test), 1e5 * expected, atol=1e-8)


def test_published_parameters_explain_the_published_data(treloar: list[HomogeneousTest]) -> None:
    found = [r_squared(*OGDEN_1972, test) for test in treloar]
    assert found == pytest.approx([0.974, 0.997, 0.998], abs=6e-4)


def test_joint_fit_of_treloars_data(treloar: list[HomogeneousTest], kawabata: HomogeneousTest) -> None:
    fit = fit_tests(treloar, terms=3, predict=[kawabata])
    assert fit.r_squared["treloar1944_uniaxial"] >= 0.996
    assert fit.r_squared["treloar1944_equibiaxial"] >= 0.998
    assert fit.r_squared["treloar1944_pure_shear"] >= 0.998
    assert fit.prediction["kawabata1981_biaxial"] > 0.95  # another rubber, another laboratory, two directions
    assert fit.others == []
    assert fit.quantities["G"].relative < 0.15  # relative weights see another stiffness at small strains


def test_joint_fit_with_relative_weights_lands_near_the_published_set(treloar: list[HomogeneousTest]) -> None:
    fit = fit_tests(treloar, terms=3, weighting="relative")
    assert fit.mu == pytest.approx((-0.00711e6, 0.647e6, 0.00109e6), rel=0.05)
    assert fit.alpha == pytest.approx((-2.158, 1.243, 5.106), rel=0.01)


def test_uniaxial_data_alone_are_called_insufficient(treloar: list[HomogeneousTest]) -> None:
    """The best fit to them predicts equibiaxial data absurdly, and other sets fit as well."""
    fit = cross_prediction(treloar[:2], terms=3, starts=12)["treloar1944_uniaxial"]
    assert fit.r_squared["treloar1944_uniaxial"] > 0.998
    assert fit.prediction["treloar1944_equibiaxial"] < 0.5
    assert fit.others
    assert any("fit as well" in warning for warning in fit.warnings)
    assert any("not predicted" in warning for warning in fit.warnings)
    assert any("not determined" in warning and "mu1" in warning for warning in fit.warnings)


def test_biaxial_table_is_fitted_with_its_residuals(kawabata: HomogeneousTest) -> None:
    fit = fit_tests([kawabata], terms=2, starts=6)
    assert fit.r_squared["kawabata1981_biaxial"] > 0.998
    residuals = np.array(fit.residuals["kawabata1981_biaxial"])
    assert residuals.size == kawabata.measured.size
    assert np.abs(residuals).max() < 0.1 * kawabata.measured.max()


def test_known_terms_are_recovered_within_their_stated_uncertainty() -> None:
    random = np.random.default_rng(5)
    l1, l2 = (np.ravel(x) for x in np.meshgrid(np.linspace(1.05, 3.0, 14), np.linspace(1.0, 2.5, 9)))
    exact = HomogeneousTest("known", "biaxial", l1, l2, np.zeros_like(l1), np.zeros_like(l1))
    stress = nominal_stress((5e3, 3.5e4), (2.5, 5.6), exact)
    stress *= 1.0 + 0.01 * random.standard_normal(stress.size)
    noisy = HomogeneousTest("known", "biaxial", l1, l2, *np.split(stress, 2))
    fit = fit_tests([noisy], terms=2, starts=8, weighting="relative")
    for name, truth in (("mu1", 5e3), ("mu2", 3.5e4), ("alpha1", 2.5), ("alpha2", 5.6), ("G", 104_250.0)):
        quantity = fit.quantities[name]
        assert abs(quantity.value - truth) < 3.5 * quantity.uncertainty, name
    assert fit.quantities["alpha2"].budget["scatter"] < 0.05 * fit.alpha[1]


def test_analytic_jacobian_against_finite_differences(treloar: list[HomogeneousTest]) -> None:
    problem = SheetProblem(treloar, 3, "balanced")
    x = np.array([0.02, 0.9, 0.1, -1.7, 1.4, 4.6])
    jacobian = problem.jacobian(x)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        numeric = (problem.residual(x + step) - problem.residual(x - step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], numeric, rtol=1e-6, atol=1e-8 * np.abs(jacobian[:, k]).max())


def test_json_is_plain(treloar: list[HomogeneousTest]) -> None:
    fit = fit_tests(treloar, terms=1, starts=2)
    assert json.loads(fit.to_json()) == json.loads(json.dumps(fit.to_dict()))


GOOD = "# kind: uniaxial\nstretch,nominal_stress_kPa\n1.1,20\n1.2,40\n1.3,60\n"


def test_units_and_kind_are_read(tmp_path: Path) -> None:
    path = tmp_path / "film.csv"
    path.write_text(GOOD)
    test = load_test(path)
    assert test.kind == "uniaxial"
    assert test.stress1.tolist() == [20e3, 40e3, 60e3]
    assert test.stretch2 == pytest.approx(test.stretch1**-0.5)


def test_kind_is_read_from_the_published_files(treloar: list[HomogeneousTest], kawabata: HomogeneousTest) -> None:
    assert [test.kind for test in (*treloar, kawabata)] == ["uniaxial", "equibiaxial", "pure shear", "biaxial"]


def test_too_few_data_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "film.csv"
    path.write_text(GOOD)
    with pytest.raises(TestsError, match="cannot determine"):
        fit_tests([load_test(path)], terms=2)


def test_stresses_that_nothing_can_be_fitted_to_are_named() -> None:
    stretch = np.array([1.1, 1.2, 1.3, 1.4, 1.5])
    for stress, words in ((np.full(5, 7e3), "all stresses are 7000 Pa"), (-stretch, "tension has to be positive")):
        test = HomogeneousTest("flat", "uniaxial", stretch, stretch**-0.5, stress, np.full(5, np.nan))
        with pytest.raises(TestsError, match=f"flat: .*{words}"):
            fit_tests([test], terms=1)


def test_a_test_given_twice_and_rows_repeated_shrink_nothing(treloar: list[HomogeneousTest]) -> None:
    uniaxial = treloar[0]
    repeated = HomogeneousTest(
        "repeated", "uniaxial", *(np.repeat(column, 5) for column in (uniaxial.stretch1, uniaxial.stretch2)),
        *(np.repeat(column, 5) for column in (uniaxial.stress1, uniaxial.stress2)),
    )  # fmt: skip
    once = fit_tests([uniaxial], terms=2).quantities
    for tests in ([uniaxial, uniaxial], [repeated]):
        again = fit_tests(tests, terms=2)
        for name, quantity in once.items():
            assert again.quantities[name].value == pytest.approx(quantity.value, rel=1e-4)
            assert again.quantities[name].uncertainty >= 0.99 * quantity.uncertainty
        assert any("given before" in warning for warning in again.warnings)


def test_correlated_residuals_widen_what_is_stated() -> None:
    """A law that cannot bend as the sheet does leaves a wave; counted as noise it would promise ten times too much."""
    stretch = np.linspace(1.0, 3.0, 400)
    exact = HomogeneousTest("x", "uniaxial", stretch, stretch**-0.5, np.zeros(400), np.full(400, np.nan))
    stress = nominal_stress((4e4, 3e3), (1.5, 5.0), exact)
    test = HomogeneousTest("wave", "uniaxial", stretch, stretch**-0.5, stress, np.full(400, np.nan))
    fit = fit_tests([test], terms=1)
    judged = fit.tests["wave"]
    assert judged.correlation > 20.0
    off = abs(fit.quantities["G"].value - 0.5 * (4e4 * 1.5 + 3e3 * 5.0))
    assert off < 3.0 * fit.quantities["G"].uncertainty
    assert fit.quantities["G"].verdict != "identified"
    assert any("lack of fit" in warning for warning in fit.warnings)
    assert any("small strains" in warning for warning in fit.warnings)


def test_a_term_of_the_other_sign_is_told_with_the_reason() -> None:
    stretch = np.linspace(1.0, 2.5, 60)
    exact = HomogeneousTest("x", "uniaxial", stretch, stretch**-0.5, np.zeros(60), np.full(60, np.nan))
    stress = nominal_stress((9e4, -9e3), (2.0, 3.2), exact)
    stress += np.random.default_rng(3).normal(0.0, 20.0, 60)
    fit = fit_tests([HomogeneousTest("odd", "uniaxial", stretch, stretch**-0.5, stress, np.full(60, np.nan))], terms=2)
    assert any("other sign" in warning and "excluded" in warning for warning in fit.warnings)


def independent_best(tests: list[HomogeneousTest], terms: int, relative: bool) -> float:
    """The least sum of squares by differential evolution over exponents and SciPy's own non-negative least squares."""
    from scipy.optimize import differential_evolution, nnls

    measured = np.concatenate([test.stress1[np.isfinite(test.stress1)] for test in tests])
    if relative:
        weight = 1.0 / np.maximum(np.abs(measured), 0.01 * np.abs(measured).max())
    else:
        weight = np.concatenate(
            [np.full(t.stress1.size, 1.0 / np.linalg.norm(t.stress1 - t.stress1.mean())) for t in tests]
        )
    l1 = np.concatenate([test.stretch1 for test in tests])
    l3 = 1.0 / (l1 * np.concatenate([test.stretch2 for test in tests]))

    def cost(u: np.ndarray) -> float:
        alpha = np.sign(u) * 0.05 * (30.0 / 0.05) ** np.abs(u)
        columns = weight[:, None] * np.sign(alpha) * (l1[:, None] ** alpha - l3[:, None] ** alpha) / l1[:, None]
        norms = np.linalg.norm(columns, axis=0)
        return float(nnls(columns / norms, weight * measured)[1] ** 2)

    bounds = [(-1.0, 1.0)] * terms
    return min(
        float(differential_evolution(cost, bounds, seed=k, popsize=16, maxiter=150, tol=1e-10, polish=True).fun)
        for k in (1, 2)
    )


@pytest.mark.parametrize("relative", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("treloar1944_uniaxial", marks=pytest.mark.slow),
        "vhb4910_uniaxial_equilibrium_hossain2012",
        pytest.param("treloar1944_equibiaxial", marks=pytest.mark.slow),
    ],
)
def test_the_optimum_is_the_best_that_an_independent_search_finds(name: str, relative: bool) -> None:
    if not DATA.is_dir():
        pytest.skip("the published data are not there")
    test = load_test(DATA / f"{name}.csv")
    terms = 3 if test.stretch1.size > 10 else 2
    fit = fit_tests([test], terms=terms, weighting="relative" if relative else "balanced")
    assert fit.cost <= 1.001 * independent_best([test], terms, relative)


@pytest.mark.parametrize(
    "files",
    [
        pytest.param(
            ["treloar1944_uniaxial", "treloar1944_equibiaxial", "treloar1944_pure_shear"], marks=pytest.mark.slow
        ),
        pytest.param(["kawabata1981_biaxial"], marks=pytest.mark.slow),
        ["vhb4910_uniaxial_equilibrium_hossain2012"],
    ],
)
@pytest.mark.parametrize("terms", [1, 2])
def test_what_is_identified_stands_under_another_weighting(files: list[str], terms: int) -> None:
    if not DATA.is_dir():
        pytest.skip("the published data are not there")
    tests = [load_test(DATA / f"{name}.csv") for name in files]
    fits = {
        weighting: fit_tests(tests, terms=terms, weighting=weighting).quantities
        for weighting in ("balanced", "relative", "absolute")
    }
    for one in fits.values():
        for name, quantity in one.items():
            if quantity.verdict == "identified":
                for other in fits.values():
                    assert abs(other[name].value - quantity.value) <= 2.0 * quantity.uncertainty, name


def test_what_is_fixed_is_held_and_the_rest_is_found() -> None:
    """Two terms of which one exponent is known; a shape that the law has not is refused; signs can be forbidden."""
    stretch = np.linspace(1.05, 2.5, 20)
    stress = 3e4 * (stretch**2 - stretch**-1) / stretch + 200.0 * (stretch**6.5 - stretch**-3.25) / stretch
    nothing = np.full(stretch.size, np.nan)
    test = HomogeneousTest("exact", "uniaxial", stretch, stretch**-0.5, stress, nothing)
    found = fit_tests([test], terms=2, fixed={"alpha1": 6.5})
    assert found.alpha[0] == 6.5 and found.alpha[1] == pytest.approx(2.0, rel=1e-3)
    assert found.mu == pytest.approx((200.0, 3e4), rel=1e-3)
    assert set(found.quantities) == {"mu1", "mu2", "alpha2", "G"} and found.to_dict()["fixed"] == {"alpha1": 6.5}
    both = fit_tests([test], terms=2, fixed={"alpha1": 2.0, "alpha2": 6.5})
    assert both.mu == pytest.approx((3e4, 200.0), rel=1e-6)
    gent = fit_tests([test], law=Gent, fixed={"Jm": 30.0})
    assert gent.alpha == (30.0,) and set(gent.quantities) == {"mu", "G"}
    with pytest.raises(TestsError, match="cannot fix alpha3; what can be fixed is alpha1, alpha2"):
        fit_tests([test], terms=2, fixed={"alpha3": 2.0})
    with pytest.raises(TestsError, match=r"it lies between 0\.05 and 30"):
        fit_tests([test], terms=1, fixed={"alpha1": 40.0})
    falling = HomogeneousTest("falls", "uniaxial", stretch, stretch**-0.5, 5e4 * (1.0 - stretch**-3), nothing)
    assert fit_tests([falling], terms=1).alpha[0] < 0.0
    assert fit_tests([falling], terms=1, negative_exponents=False).alpha[0] > 0.0


def test_the_share_of_the_variance_that_a_law_without_stress_explains_is_negative() -> None:
    """Stresses of 1, 2 and 3 kPa about a mean of 2: 1 - 14/2."""
    stretch, stress = np.array([1.1, 1.2, 1.3]), np.array([1e3, 2e3, 3e3])
    test = HomogeneousTest("three", "uniaxial", stretch, stretch**-0.5, stress, np.full(3, np.nan))
    assert r_squared((0.0,), (2.0,), test) == pytest.approx(-6.0)
