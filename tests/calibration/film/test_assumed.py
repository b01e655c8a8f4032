"""No input is exact by silence: what is assumed, what a batch shares, and what would help most."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.film.assumed import PRESTRETCH, RADIUS_M, THICKNESS
from calibration.film.curve import Curve
from calibration.film.identifiability import expected
from calibration.film.identify import identify
from calibration.film.measurement import assumed_parts, most_useful
from model.material.materials import Material

Experiment = Callable[..., list[Curve]]
ONE_TERM = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)
SILENT = {"thickness_uncertainty": None, "prestretch_uncertainty": None, "disk_radius_uncertainty": None}
SILENT |= {"ring_radius_uncertainty": None, "voltage_at_film": None, "displacement_axis": None}


def one_film(experiment: Experiment, **options: object) -> list[Curve]:
    return experiment(seed=3, truth=ONE_TERM, guess=ONE_TERM, samples=200, disks=(4e-3,), **options)


def test_what_is_not_stated_is_assumed_and_marked(experiment: Experiment) -> None:
    (curve,) = one_film(experiment, voltages=(0.0,), exact=False)
    assert (curve.thickness_uncertainty, curve.prestretch_uncertainty) == (THICKNESS, PRESTRETCH) == (0.05, 0.01)
    assert curve.disk_radius_uncertainty == pytest.approx(RADIUS_M / 4e-3) == pytest.approx(0.0125)
    assert curve.ring_radius_uncertainty == pytest.approx(0.0025)
    assert (curve.voltage_at_film, curve.displacement_axis) == (0.01, 0.005)
    assert curve.assumed == set(SILENT)


@pytest.mark.parametrize("name", SILENT)
def test_zero_means_exact_and_a_stated_value_is_no_longer_assumed(experiment: Experiment, name: str) -> None:
    (curve,) = one_film(experiment, voltages=(0.0,), exact=False)
    for value in (0.0, 0.02):
        stated = replace(curve, **{name: value})
        assert getattr(stated, name) == value
        assert stated.assumed == set(SILENT) - {name}
    assert replace(curve, label="another").assumed == set(SILENT)


def test_assumed_inputs_are_rows_of_the_budget_and_exact_ones_are_not(experiment: Experiment) -> None:
    silent = expected(one_film(experiment, exact=False), ONE_TERM).quantities["eps_r"]
    assert silent.budget["thickness"] == pytest.approx(0.05 * silent.value, rel=1e-6)
    assert silent.budget["voltage at the film"] == pytest.approx(0.02 * silent.value, rel=1e-6)
    assert {"pre-stretch", "disk radius", "ring radius", "displacement axis"} < set(silent.budget)
    assert sum(silent.share(part) for part in silent.budget) == pytest.approx(1.0)
    exact = expected(one_film(experiment), ONE_TERM).quantities["eps_r"]
    assert not {"thickness", "pre-stretch", "disk radius", "voltage at the film"} & set(exact.budget)


def test_the_verdict_is_by_the_combined_figure_with_the_one_given_the_dimensions_beside_it(
    experiment: Experiment,
) -> None:
    quantity = expected(one_film(experiment, exact=False), ONE_TERM).quantities["stiffness"]
    assert quantity.relative > 0.05 > quantity.conditional / quantity.value
    assert (quantity.verdict, quantity.conditional_verdict) == ("weakly identified", "identified")


def two_films(experiment: Experiment, **changes: object) -> list[Curve]:
    curves = experiment(seed=3, truth=ONE_TERM, guess=ONE_TERM, samples=200, exact=False)
    return [replace(curve, prestretch_uncertainty=0.0, disk_radius_uncertainty=0.0, **changes) for curve in curves]


def test_specimens_of_one_batch_share_the_error_of_their_thickness(experiment: Experiment) -> None:
    def part(curves: list[Curve]) -> float:
        quantity = expected(curves, ONE_TERM).quantities["eps_r"]
        return quantity.budget["thickness"] / quantity.value

    one_batch = part(two_films(experiment, batch="sheet 7"))
    two = [replace(curve, batch=f"sheet {curve.specimen.disk_radius}") for curve in two_films(experiment)]
    assert one_batch == pytest.approx(0.05, rel=1e-6)
    assert part(two) == pytest.approx(0.05 / np.sqrt(2.0), rel=0.02)
    assert part(two) < part(two_films(experiment)) < one_batch  # nobody said


def test_a_difference_of_thickness_between_two_sheets_is_found_and_one_sheet_has_none(experiment: Experiment) -> None:
    """One of the films is 4 % thicker than believed: T x 1.04 at the same field gives 1.04 times the force at 0 V."""
    curves = two_films(experiment, batch="")
    thick = [
        replace(curve, specimen=replace(curve.specimen, thickness=curve.specimen.thickness / 1.04))
        if curve.run == "run-6mm"
        else curve
        for curve in curves
    ]
    found = identify(thick, terms=1, starts=1)
    difference = found.nuisance["thickness of cone-6mm"].value - found.nuisance["thickness of cone-4mm"].value
    assert difference == pytest.approx(0.04, abs=0.006)
    assert not found.likely
    together = identify([replace(curve, batch="one") for curve in thick], terms=1, starts=1)
    assert not any(name.startswith("thickness of") for name in together.nuisance)
    assert together.likely


def test_a_film_of_42_um_that_is_believed_40_is_within_its_combined_uncertainty(experiment: Experiment) -> None:
    curves = [
        replace(curve, specimen=replace(curve.specimen, thickness=curve.specimen.thickness / 1.05))
        for curve in one_film(experiment, exact=False)
    ]
    found = identify(curves, terms=1, starts=1)
    for name, truth in (("eps_r", 1.7), ("G", ONE_TERM.shear_modulus)):
        quantity = found.quantities[name]
        assert abs(quantity.value / truth - 1.0) > 0.03
        assert abs(quantity.value - truth) < 2.0 * quantity.uncertainty
        assert abs(quantity.value - truth) > 2.0 * quantity.conditional


def test_the_thickness_is_what_to_measure_next_until_it_is_known(experiment: Experiment) -> None:
    curves = one_film(experiment, exact=False)
    quantities = expected(curves, ONE_TERM).quantities
    best = most_useful(quantities, curves)
    assert best is not None and best.part == "thickness" and best.assumed
    assert (best.now, best.then) == (0.05, 0.01)
    measured = [replace(curve, thickness_uncertainty=best.then) for curve in curves]
    then = expected(measured, ONE_TERM).quantities
    for name, (now, promised) in best.relative.items():
        assert quantities[name].relative == pytest.approx(now)
        assert then[name].relative == pytest.approx(promised, rel=0.02)  # as promised
    after = most_useful(then, measured)
    assert after is not None and after.part != "thickness"
    assert "thickness" not in assumed_parts(measured)
    exact = one_film(experiment, errors={})
    assert most_useful(expected(exact, ONE_TERM).quantities, exact) is None


def test_stiffness_at_a_fixed_stretch_can_be_compared_between_terms(experiment: Experiment) -> None:
    curves = one_film(experiment)
    one, two = (identify(curves, terms=terms, starts=1) for terms in (1, 2))
    assert one.fixed_stretch == two.fixed_stretch == (1.5, 1.2)
    values = [found.quantities["stiffness_fixed"] for found in (one, two)]
    assert abs(values[0].value - values[1].value) < 3.0 * values[1].uncertainty
    other = identify(curves, terms=1, starts=1, fixed_stretch=(1.4, 1.1))
    assert other.fixed_stretch == (1.4, 1.1)
    assert other.quantities["stiffness_fixed"].value < one.quantities["stiffness_fixed"].value
