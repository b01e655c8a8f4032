"""Creep of an actuator's disk: against elements of the simulated bench, and limits and scalings that hold exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring, Tabulated
from model.actuator.creep import creep, creep_many
from model.actuator.equilibrium import Actuator, equilibria
from model.arrays import Array
from model.material.materials import NAMED, Branch, Material
from model.membrane.history import at_once
from model.membrane.solve import Status
from model.specimen import Specimen
from rig.sim.viscous_film import ViscousFilm

PARKER = NAMED["parker-cao2018"]
TWO = [(0.3, 1.0), (0.2, 30.0)]


def film(branches: Sequence[tuple[float, float]], lp: float = 1.2) -> Specimen:
    return Specimen(4e-3, 20e-3, 40e-6, lp, replace(PARKER, branches=tuple(Branch(*one) for one in branches)))


SPRING, MASS = Spring(0.8, 50.0), Mass(0.25)
HOLD, STEP = ([0.0, 1.0, 60.0, 60.5, 2000.0], [0.0, 0.0, 0.0, 1000.0, 1000.0]), [0.0, 1.0, 60.0, 60.5, 2000.0]
EVERY = [MASS, SPRING, Bistable(10e-3, 0.15, 60.0, 1.5e6), Antagonist(film([]), 20e-3)]
EVERY.append(Tabulated(tuple(np.linspace(0, 15e-3, 16)), tuple(0.8 - 50 * np.linspace(0, 15e-3, 16))))


@pytest.mark.slow
def test_at_once_and_in_the_end_it_is_where_films_are_that_take_no_time() -> None:
    specimen = film(TWO)
    many = creep_many([Actuator(specimen, bias) for bias in EVERY], [(*HOLD, STEP, 1.0)] * len(EVERY), tolerance=1e-3)
    for bias, found in zip(EVERY, many, strict=True):
        (least, *_) = equilibria(Actuator(film([]), bias), 1000.0).stable
        assert (found.status == Status.TAUT).all()
        assert at_once(specimen, found.h[:1])[0] == pytest.approx(found.force[0], rel=1e-5)
        assert found.h[-1] == pytest.approx(least.h, rel=5e-4)
        np.testing.assert_allclose(found.force, bias.force(found.h), rtol=1e-9)
        assert (np.diff(found.h) > 0.0).all()  # it creeps away from the film, and faster under voltage


def test_without_branches_it_is_where_the_actuator_is() -> None:
    found = creep(Actuator(film([]), SPRING), [0.0, 1.0, 2.0], [0.0, 0.0, 1000.0], tolerance=1e-4)
    for h, voltage in ((found.h[0], 0.0), (found.h[2], 1000.0)):
        assert h == pytest.approx(equilibria(Actuator(film([]), SPRING), voltage).stable[0].h, rel=1e-6)


@pytest.mark.parametrize("weight", [1e-12, 1e-9, 1e-5])
def test_under_a_weight_of_nearly_nothing_the_film_is_a_flat_membrane(weight: float) -> None:
    """Of the nominal tension N = T s/lp^2 of the flat film: h = W ln(b/a) / (2 pi N)."""
    specimen = film(TWO)
    found = creep(Actuator(specimen, Mass(weight)), [0.0, 1.0, 2.0], tolerance=1e-6)
    stress = sum(mu * (1.2**al - 1.2 ** (-2.0 * al)) for mu, al in zip(PARKER.mu, PARKER.alpha, strict=True))
    flat = weight * np.log(5.0) / (2.0 * np.pi * 40e-6 / 1.2**2 * stress)
    assert found.status.tolist() == [Status.TAUT] * 3
    np.testing.assert_allclose(found.h, flat, rtol=1e-7)
    assert (found.error_estimate <= 1e-6).all()


def simulated(spring: Spring, specimen: Specimen, t: Sequence[float], voltage: Sequence[float], steps: int) -> Array:
    """Displacement at ``t`` of the simulated bench's film on a soft rig, whose compliance is the spring."""
    branches = [(one.ratio, one.time) for one in specimen.material.branches]
    bench = ViscousFilm(specimen, branches, 1.0 / spring.stiffness)
    stage = spring.preload / spring.stiffness
    moment = bench.step(bench.rested, 1e-7, stage, 0.0)
    found = [stage - moment.force / spring.stiffness]
    for k in range(1, len(t)):
        share = np.linspace(0.0, 1.0, steps + 1) ** 2  # short after every bend
        for before, after in pairwise(share):
            volts = float(voltage[k - 1] + after * (voltage[k] - voltage[k - 1]))
            moment = bench.step(moment, float((after - before) * (t[k] - t[k - 1])), stage, volts)
        assert moment.found == "taut"
        found.append(stage - moment.force / spring.stiffness)
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("bias", [SPRING, Spring(200.25, 20000.0), Spring(0.3, 1e-3)], ids=["spring", "stiff", "mass"])
def test_creep_agrees_with_the_simulated_film_on_a_soft_rig(bias: Spring) -> None:
    """A stage that stands still behind a compliance is a spring; a very soft one is a mass."""
    t, voltage = [0.0, 2.0, 40.0, 41.0, 60.0], [0.0, 0.0, 0.0, 900.0, 900.0]
    specimen = film([(0.4, 1.5), (0.2, 20.0)])
    coarse, fine = (simulated(bias, specimen, t, voltage, steps) for steps in (10, 20))
    exact = fine + (fine - coarse) / 3.0  # of the second order
    found = creep(Actuator(specimen, bias), t, voltage, tolerance=1e-4)
    assert np.abs(fine - coarse).max() / 3.0 < 1e-4 * exact.max()
    assert np.abs(found.h - exact).max() < (1e-4 + 3.0 * found.error_estimate.max()) * exact.max()
    assert np.ptp(exact) > 2e-6  # there is some creep to see
    if bias.stiffness == 1e-3:
        mass = creep(Actuator(specimen, Mass(0.3)), t, voltage, tolerance=1e-4)
        np.testing.assert_allclose(mass.h, found.h, rtol=1e-3)


@pytest.mark.slow
def test_exact_scalings() -> None:
    base, (t, voltage), weight = film(TWO), (np.array([0.0, 5.0, 6.0, 20.0]), np.array([0.0, 0.0, 900.0, 900.0])), 0.2
    h = creep(Actuator(base, Mass(weight)), t, voltage, tolerance=1e-3).h
    material = base.material

    def scaled(specimen: Specimen, load: float, time: float = 1.0, volts: float = 1.0) -> Array:
        return creep(Actuator(specimen, Mass(load * weight)), time * t, volts * voltage, tolerance=1e-3).h

    thick = replace(base, thickness=3 * base.thickness)
    large = replace(base, disk_radius=7 * base.disk_radius, ring_radius=7 * base.ring_radius)
    stiff = base.with_material(replace(material, mu=tuple(11 * mu for mu in material.mu)))
    late = base.with_material(replace(material, branches=(Branch(0.3, 10.0), Branch(0.2, 300.0))))
    split = base.with_material(replace(material, branches=(Branch(0.2, 30.0), Branch(0.15, 1.0), Branch(0.15, 1.0))))
    np.testing.assert_allclose(scaled(thick, 3.0, volts=3.0), h, rtol=1e-9)
    np.testing.assert_allclose(scaled(large, 7.0), 7.0 * h, rtol=1e-9)
    np.testing.assert_allclose(scaled(stiff, 11.0, volts=11.0**0.5), h, rtol=1e-9)
    np.testing.assert_allclose(scaled(late, 1.0, time=10.0), h, rtol=1e-9)
    np.testing.assert_allclose(scaled(split, 1.0), h, rtol=1e-9)


@pytest.mark.slow
def test_a_mass_is_put_on_and_taken_off() -> None:
    """A film with pre-stretch is flat again at once; one without is too long for its ring, and hangs."""
    t, share = [0.0, 1.0, 50.0, 50.1, 60.0, 61.0, 80.0], [0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0]
    taut, loose = (Actuator(film(TWO, lp), Mass(0.2)) for lp in (1.2, 1.0))
    found = creep(taut, t, share=share, tolerance=1e-3)
    assert (found.status == Status.TAUT).all()
    assert (found.h[[0, 3, 4]] == 0.0).all() and found.h[1] < found.h[2]
    assert found.h[1] < found.h[5] < found.h[6] < found.h[2]  # it has not forgotten, and is held for a shorter time
    np.testing.assert_allclose(found.force, 0.2 * np.array(share))
    hangs = creep(loose, t, share=share, tolerance=1e-3)
    assert (hangs.status[:3] == Status.TAUT).all() and (hangs.status[3:] == Status.SLACK).all()
    assert np.isnan(hangs.h[3:]).all() and np.isnan(hangs.error_estimate[3:]).all()


@pytest.mark.slow
def test_a_disk_that_jumps_has_a_status_and_no_number() -> None:
    specimen = film(TWO, 1.0)
    times = [0.0, 100.0, 1000.0]
    bistable = Actuator(specimen, EVERY[2], "plain")
    found = creep(bistable, [0.0, 200.0, 1000.0], [1500.0, 1500.0, 2000.0], times, tolerance=1e-3)
    assert (found.status[:2] <= Status.WRINKLED).all() and found.status[2] == Status.UNSTABLE
    assert np.isnan(found.h[2])
    soft = film(TWO).with_material(Material("soft", (3e4,), (2.0,), 5.0, branches=film(TWO).material.branches))
    pulled = creep(Actuator(soft, Mass(0.05)), [0.0, 1.0, 20.0], [0.0, 0.0, 6000.0], tolerance=1e-3)
    assert pulled.status[1] == Status.TAUT and pulled.status[2] > Status.WRINKLED and np.isnan(pulled.h[2])
    heavy = creep(Actuator(film(TWO), Mass(1e6)), [0.0, 1.0], tolerance=1e-3)
    assert (heavy.status > Status.WRINKLED).all() and np.isnan(heavy.h).all()


CHANGES: dict[str, tuple[Callable[[Specimen, float], Specimen], Callable[[Bias, float], Bias]]] = {
    "load": (lambda one, s: one, lambda bias, s: Spring(0.8 * s, 50.0 * s)),
    "thickness": (lambda one, s: replace(one, thickness=one.thickness * s), lambda bias, s: bias),
    "prestretch": (lambda one, s: replace(one, prestretch=one.prestretch * s), lambda bias, s: bias),
    "eps_r": (lambda one, s: one.with_material(replace(one.material, eps_r=1.7 * s)), lambda bias, s: bias),
    "time": (
        lambda one, s: one.with_material(replace(one.material, branches=(Branch(0.3, s), Branch(0.2, 30.0)))),
        lambda bias, s: bias,
    ),
    "ratio": (
        lambda one, s: one.with_material(replace(one.material, branches=(Branch(0.3 * s, 1.0), Branch(0.2, 30.0)))),
        lambda bias, s: bias,
    ),
    "mu": (lambda one, s: one.with_material(replace(one.material, mu=(5e3 * s, 3.5e4))), lambda bias, s: bias),
    "alpha": (lambda one, s: one.with_material(replace(one.material, alpha=(2.5 * s, 5.6))), lambda bias, s: bias),
}


@pytest.mark.slow
def test_derivatives_are_those_of_the_displacement() -> None:
    t, voltage, times = [0.0, 1.0, 3.0, 4.0, 9.0], [0.0, 0.0, 0.0, 1000.0, 1000.0], [0.0, 0.5, 3.0, 9.0]
    specimen = film(TWO)
    found = creep(Actuator(specimen, SPRING), t, voltage, times, tolerance=1e-6, sensitivities=True)
    assert found.dh is not None and found.dforce is None
    value = {"load": 1.0, "thickness": 40e-6, "prestretch": 1.2, "eps_r": 1.7, "time": 1.0, "ratio": 0.3, "mu": 5e3}
    value["alpha"] = 2.5
    actuators = [
        Actuator(of_film(specimen, s), of_bias(SPRING, s))
        for of_film, of_bias in CHANGES.values()
        for s in (1.0 + 1e-3, 1.0 - 1e-3)
    ]
    moved = [one.h for one in creep_many(actuators, [(t, voltage, times, 1.0)] * len(actuators), tolerance=1e-7)]
    for number, name in enumerate(CHANGES):
        central = (moved[2 * number] - moved[2 * number + 1]) / 2e-3
        own = found.dh[name] if found.dh[name].ndim == 1 else found.dh[name][:, 0]
        np.testing.assert_allclose(own * value[name], central, rtol=1e-4, atol=2e-8, err_msg=name)


def test_bad_questions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"share = -0\.1"):
        creep(Actuator(film(TWO), MASS), [0.0, 1.0], share=[1.0, -0.1])
    with pytest.raises(ValueError, match="antagonist: its film has branches"):
        creep(Actuator(film(TWO), Antagonist(film(TWO), 20e-3)), [0.0, 1.0])
    with pytest.raises(ValueError, match="at least two times"):
        creep(Actuator(film(TWO), MASS), [0.0])
