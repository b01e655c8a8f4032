"""Reduced curves carry the same information as their samples; samples that the model cannot describe are left out."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.problem import NODES
from calibration.film.reduction import (
    Block,
    NodeModel,
    chebyshev_nodes,
    correlation_time,
    interpolation_matrix,
    noise_ratio,
    reduce,
    select,
)
from model.material.materials import NAMED, Material
from model.membrane.solve import Status, solve_many
from model.specimen import Specimen

PARKER = NAMED["parker-cao2018"]
SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER)


def plain_curve(h: np.ndarray, force: np.ndarray, voltage: float = 0.0, specimen: Specimen = SPECIMEN) -> Curve:
    return Curve(
        label="c",
        run="r",
        specimen=specimen,
        h=h,
        force=force,
        voltage=np.full(h.size, voltage),
        nominal_voltage=voltage,
        direction=np.ones(h.size, dtype=int),
        force_noise=5e-3,
    )


def test_interpolation_is_exact_for_polynomials_and_at_the_nodes() -> None:
    nodes = chebyshev_nodes(-1.0, 3.0, 8)
    points = np.concatenate((np.linspace(-1.0, 3.0, 37), nodes))
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.3, -0.1, 0.02, 0.01, -0.003])
    np.testing.assert_allclose(interpolation_matrix(nodes, points) @ polynomial(nodes), polynomial(points), rtol=1e-12)


@pytest.mark.parametrize("voltage", [0.0, 1500.0])
def test_the_nodes_follow_a_curve_of_the_model_far_below_the_noise(voltage: float) -> None:
    nodes = chebyshev_nodes(0.0, 12e-3, NODES)
    h = np.linspace(0.0, 12e-3, 200)
    interpolated = interpolation_matrix(nodes, h) @ solve_many(SPECIMEN, nodes, voltage).force
    assert np.abs(interpolated - solve_many(SPECIMEN, h, voltage).force).max() < 0.1 * 5e-3 / np.sqrt(1e5 / NODES)


def test_reduction_preserves_chi_square_exactly() -> None:
    """For any curve of the model, the reduced chi-square is that of all samples, summed the plain way."""
    random = np.random.default_rng(1)
    h = random.uniform(0.5e-3, 12e-3, 700)
    nodes = chebyshev_nodes(0.5e-3, 12e-3, 16)
    at = solve_many(SPECIMEN, nodes, 0.0, sensitivities=True)
    assert at.dforce is not None
    curve = plain_curve(h, solve_many(SPECIMEN, h, 0.0).force + 5e-3 * random.standard_normal(h.size))
    curve = replace(curve, direction=np.where(random.random(h.size) < 0.5, 1, -1), displacement_noise=5e-5)
    selection = select([curve], PARKER)[0]
    model = NodeModel(at.force, at.dforce["h"], at.dforce["voltage"])
    blocks = reduce(curve, selection.used, nodes, 0.0, model)
    assert [block.samples for block in blocks] == [(curve.direction == 1).sum(), (curve.direction == -1).sum()]
    matrix = interpolation_matrix(nodes, h)
    sigma = np.hypot(5e-3, 5e-5 * (matrix @ at.dforce["h"]))
    for trial in (at.force, 1.1 * at.force, np.zeros(16)):
        direct = float((((curve.force - matrix @ trial) / sigma) ** 2).sum())
        reduced = sum(float(((b.root @ trial - b.target) ** 2).sum()) + b.floor for b in blocks)
        assert reduced == pytest.approx(direct, rel=1e-10)


def held(places: tuple[float, ...], samples: int, noise: float, seed: int) -> Curve:
    """A film held at some displacements, which the sensor reads with noise."""
    random = np.random.default_rng(seed)
    h = np.repeat(places, samples)
    curve = plain_curve(
        h + noise * random.standard_normal(h.size),
        np.repeat(solve_many(SPECIMEN, list(places), 0.0).force, samples) + 5e-3 * random.standard_normal(h.size),
    )
    # Between two places the film moves: one sample each that is not held.
    direction = np.where(np.arange(h.size) % samples == 0, 1, 0)
    return replace(curve, direction=direction, displacement_noise=noise)


def test_while_the_disk_is_held_the_mean_of_the_readings_is_its_place() -> None:
    curve = held((3e-3, 8e-3, 10e-3), 400, 5e-6, 1)
    for k, place in enumerate((3e-3, 8e-3, 10e-3)):
        rows = slice(400 * k + 1, 400 * (k + 1))
        assert np.ptp(curve.place[rows]) == 0.0
        assert curve.place[400 * k + 1] == pytest.approx(place, abs=4 * 5e-6 / np.sqrt(399))
    assert (curve.place[::400] == curve.h[::400]).all()
    moving = replace(curve, direction=np.zeros(curve.h.size, dtype=int))  # called a hold, but it is none
    assert (moving.place == moving.h).all()
    lost = curve.h.copy()
    lost[5] = np.nan
    assert np.isnan(replace(curve, h=lost).place[5])
    assert np.isfinite(replace(curve, h=lost).place[6])


@pytest.mark.slow
def test_noise_of_the_displacement_of_a_held_film_is_no_misfit() -> None:
    """Reading a held disk with noise makes no film seem wrong: chi-square of the truth is its degrees of freedom."""
    places = (3e-3, 8e-3, 10e-3)
    nodes = chebyshev_nodes(3e-3, 10e-3, NODES)
    at = solve_many(SPECIMEN, nodes, 0.0, sensitivities=True)
    assert at.dforce is not None
    model = NodeModel(at.force, at.dforce["h"], at.dforce["voltage"])
    misfit, freedom = 0.0, 0
    for seed in range(40):
        curve = held(places, 400, 5e-5, seed)
        (block,) = [one for one in reduce(curve, curve.usable, nodes, 0.0, model) if one.way == 0]
        assert block.root.shape == (len(places), NODES)  # three places tell three forces
        misfit += float(((block.root @ at.force - block.target) ** 2).sum())
        freedom += len(places)
    assert abs(misfit - freedom) < 3.0 * np.sqrt(2.0 * freedom)


def test_samples_are_carried_to_one_voltage() -> None:
    """A supply that drifts by 2 % leaves no more misfit than one that does not."""
    h = np.linspace(0.5e-3, 12e-3, 400)
    voltage = 1500.0 * (1.0 + 0.02 * np.sin(np.linspace(0.0, 25.0, h.size)))
    force = np.array([float(solve_many(SPECIMEN, x, v).force) for x, v in zip(h, voltage, strict=True)])
    curve = replace(plain_curve(h, force, 1500.0), voltage=voltage)
    selection = select([curve], PARKER)[0]
    mean = float(np.sqrt(np.mean(voltage**2)))
    nodes = chebyshev_nodes(0.5e-3, 12e-3, 16)
    at = solve_many(SPECIMEN, nodes, mean, sensitivities=True)
    assert at.dforce is not None
    model = NodeModel(at.force, at.dforce["h"], at.dforce["voltage"])
    (block,) = reduce(curve, selection.used, nodes, mean, model)
    without = NodeModel(at.force, at.dforce["h"], np.zeros(16))
    (uncorrected,) = reduce(curve, selection.used, nodes, mean, without)
    assert np.sqrt(block.floor / h.size) < 0.01  # of a standard deviation of the noise
    assert uncorrected.floor > 100 * block.floor


@pytest.mark.slow
def test_wrinkled_samples_are_left_out_and_counted() -> None:
    """Without pre-stretch the film loses hoop tension well below 1900 V (onset near 48 MV/m at h = 12 mm)."""
    specimen = replace(SPECIMEN, prestretch=1.0)
    h = np.linspace(0.2e-3, 14e-3, 500)
    curve = plain_curve(h, np.zeros(h.size), 1500.0, specimen)
    status = solve_many(specimen, h, 1500.0).status
    assert (status != Status.TAUT).any(), "the example must hold wrinkled states"
    selection = select([curve], PARKER)[0]
    assert not (selection.used & (status != Status.TAUT)).any()
    assert sum(selection.excluded.values()) == h.size - selection.used.sum()
    assert selection.excluded.get("wrinkled", 0) > 0
    lost = (status == Status.TAUT).sum() - selection.used.sum()
    assert lost <= 2 * h.size / 32, "at most one step of the grid is given away on either side"


def test_a_part_without_a_state_at_the_voltage_of_its_own_samples_is_left_out() -> None:
    """Close to the slack voltage of the flat film: the curve's mean is below it, that of the first few above."""
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("soft", (22143.514,), (7.2158711,), 3.133153))
    h = np.concatenate([np.linspace(5.02e-5, 5.03e-5, 5), np.linspace(0.3e-3, 4e-3, 200)])
    curve = plain_curve(h, np.zeros(h.size), 1500.0, film)
    voltage = np.full(h.size, 1499.8)
    voltage[:5] = 1504.0
    mean = float(np.sqrt(np.mean(voltage**2)))
    assert np.isfinite(solve_many(film, h[0], mean).force) and not np.isfinite(solve_many(film, h[0], 1504.0).force)
    selection = select([replace(curve, voltage=voltage)], film.material)[0]
    for part in selection.parts:
        at = float(np.sqrt(np.mean(voltage[part.used] ** 2)))
        assert np.isfinite(solve_many(film, [part.low, part.high], at).force).all()
    assert sum(selection.excluded.values()) == h.size - selection.used.sum()
    assert selection.excluded["no state at the voltage of these samples"] == 5


def test_of_a_part_without_a_state_at_one_end_the_rest_is_kept() -> None:
    """The wrinkled part was recorded at more voltage than the taut one: at its beginning the film hangs slack then."""
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("film", (37834.0,), (5.4985,), 1.7))
    h = np.concatenate([np.linspace(0.1e-3, 3e-3, 300), np.linspace(3e-3, 14e-3, 200)])
    voltage = np.repeat((2000.0, 2400.0), (300, 200))
    curve = replace(plain_curve(h, np.zeros(h.size), 2200.0, film), voltage=voltage)
    selection = select([curve], film.material, "tension_field")[0]
    last = selection.parts[-1]
    at = float(np.sqrt(np.mean(voltage[last.used] ** 2)))
    assert 3.2e-3 < last.low < 7e-3 and last.high == 14e-3
    assert np.isfinite(solve_many(film, [last.low, last.high], at, wrinkling="tension_field").force).all()
    assert 0 < selection.excluded["no state at the voltage of these samples"] < 200
    assert sum(selection.excluded.values()) == h.size - selection.used.sum()


def test_samples_without_value_flagged_before_contact_or_off_voltage_are_counted_apart() -> None:
    h = np.linspace(-1e-3, 12e-3, 131)  # ten below zero, one at it
    curve = plain_curve(h, np.zeros(h.size), 1000.0)
    force, voltage, flagged = curve.force.copy(), curve.voltage.copy(), np.zeros(h.size, dtype=bool)
    force[20] = np.nan
    flagged[[30, 31]] = True
    voltage[40:45] = 700.0
    curve = replace(curve, force=force, voltage=voltage, flagged=flagged, displacement_zero=1e-5)
    selection = select([curve], PARKER)[0]
    assert selection.excluded == {
        "flagged by an instrument": 2,
        "without a value": 1,
        "away from the nominal voltage": 5,
        "before contact": 11,
    }
    assert selection.used.sum() == 131 - 19


def noise_block(noise: np.ndarray) -> Block:
    rows, zeros = np.arange(noise.size), np.zeros((16, 16))
    return Block(rows, 1, np.ones_like(noise), zeros, zeros, np.zeros(16), float(noise @ noise), noise)


def test_scatter_and_correlation_of_the_noise_are_measured() -> None:
    random = np.random.default_rng(3)
    white = [noise_block(random.standard_normal(5000)) for _ in range(4)]
    ratio, freedom = noise_ratio(white)
    assert freedom == 4 * (5000 - 16)
    assert ratio == pytest.approx(1.0, abs=4 * np.sqrt(2 / freedom))
    assert correlation_time(white) == 1.0
    coloured = []
    for _ in range(4):
        x = np.empty(5000)
        x[0] = random.standard_normal()
        for k, kick in enumerate(np.sqrt(1 - 0.6**2) * random.standard_normal(4999)):
            x[k + 1] = 0.6 * x[k] + kick
        coloured.append(noise_block(x))
    assert correlation_time(coloured) == pytest.approx((1 + 0.6) / (1 - 0.6), rel=0.15)
