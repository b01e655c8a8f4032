"""What the simulated supply charges: the film by its shape, against closed forms and the film's energy."""

from __future__ import annotations

import math

import pytest

from model.material.materials import EPSILON_0, NAMED
from model.specimen import Specimen
from rig.sim.electrodes import electrodes
from rig.sim.settings import SimulationSettings
from rig.sim.world import World

SETTINGS = SimulationSettings.model_validate(
    {"seed": 1, "hv": {"capacitance_of_film": True, "beside_film_nF": 0.05}, "rig_compliance_um_per_N": 5.0}
)


FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"], "cone")


@pytest.fixture
def world() -> World:
    return World(SETTINGS, SETTINGS.stage, SETTINGS.hv, FILM)


def test_a_flat_film_is_a_plate_capacitor(world: World) -> None:
    film = world.specimen
    table = electrodes(film, world.compliance)
    area = math.pi * (film.ring_radius**2 - film.disk_radius**2)
    thickness = film.thickness / film.prestretch**2
    assert table.capacitance(0.0, 0.0) == pytest.approx(EPSILON_0 * film.material.eps_r * area / thickness, rel=1e-3)
    assert table.error < 1e-3


def test_the_force_of_the_voltage_is_that_of_the_charge(world: World) -> None:
    """dF/dV = -dQ/dh by the film's energy, which the table knows nothing of."""
    film = world.specimen
    table, force = (
        electrodes(film, 0.0),
        World(
            SETTINGS.model_copy(update={"rig_compliance_um_per_N": 0.0}), SETTINGS.stage, SETTINGS.hv, film
        ).film.force,
    )
    h, volts, dh, dv = 6e-3, 1000.0, 1e-4, 5.0
    by_voltage = (force(h, volts + dv) - force(h, volts - dv)) / (2 * dv)
    by_height = (table.capacitance(h + dh, volts) - table.capacitance(h - dh, volts)) * volts / (2 * dh)
    assert by_voltage == pytest.approx(-by_height, rel=0.01)


def test_a_ramp_draws_what_charges_the_film_and_the_cable(world: World) -> None:
    world.stage.rest(0.0, 40e-3 + 5e-3)
    world.output.ramp(1.0, 900.0, 300.0)
    world.advance(2.0)
    t = 2.0
    voltage, rate = world.output.at(t)
    charge = [world.capacitance(t + dt) * world.output.at(t + dt)[0] for dt in (-0.01, 0.01)]
    leak = voltage / world.film_resistance
    assert rate == 300.0
    assert world.current(t) - leak == pytest.approx((charge[1] - charge[0]) / 0.02, rel=1e-3)
    assert world.current(t) - leak > 1.05 * 300.0 * (world.capacitance(t) - 0.05e-9)


def test_a_film_moved_under_voltage_draws_current_too(world: World) -> None:
    world.output.rest(0.0, 800.0)
    world.stage.ramp(1.0, 46e-3, 2e-3)
    world.advance(18.0)
    moving = world.current(18.0) - 800.0 / world.film_resistance
    assert moving > 1e-9
    world.advance(30.0)
    assert world.current(30.0) - 800.0 / world.film_resistance == pytest.approx(0.0, abs=1e-12)
