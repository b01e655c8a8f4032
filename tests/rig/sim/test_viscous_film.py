"""The simulated film that takes time against reference forces, finer steps and elements, and the elastic film."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from model.material.gent import Gent
from model.material.materials import NAMED, Material
from model.membrane.solve import solve
from model.specimen import Specimen
from rig.sim.viscous_film import ViscousFilm

PARKER = NAMED["parker-cao2018"]
PAPER = Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER)
SMALL_DISK = Specimen(2e-3, 20e-3, 40e-6, 1.2, PARKER)
VHB = Specimen(6e-3, 20e-3, 500e-6, 3.0, Material("vhb", (43560.0, 117.4), (1.445, 4.248), 4.7))
BRANCHES = [(0.3, 1.0), (0.4, 6.0)]


def driven(specimen, branches, course, count, **mesh):
    """Force at the end of every part of a course (times, displacements in mm, voltages), each in equal steps."""
    film = ViscousFilm(specimen, branches, 0.0, **mesh)
    moment, forces = film.rested, []
    for (t0, h0, v0), (t1, h1, v1) in pairwise(zip(*course, strict=True)):
        for k in range(1, count + 1):
            share = k / count
            moment = film.step(moment, (t1 - t0) / count, (h0 + share * (h1 - h0)) * 1e-3, v0 + share * (v1 - v0))
        forces.append(moment.force)
    return np.array(forces)


COURSE = ([0.0, 2.0, 4.0, 4.5, 7.0], [0.0, 9.0, 9.0, 7.0, 7.0], [0.0, 0.0, 500.0, 1200.0, 1200.0])


def test_error_falls_with_the_square_of_the_step():
    exact = driven(PAPER, BRANCHES, COURSE, 64)
    errors = [np.abs(driven(PAPER, BRANCHES, COURSE, count) - exact).max() for count in (4, 8, 16)]
    assert errors[0] / errors[1] > 2.8 and 3.3 < errors[1] / errors[2] < 6.0
    assert errors[2] < 3e-4 * exact.max()


@pytest.mark.parametrize("specimen", [PAPER, SMALL_DISK, VHB])
def test_finer_elements_change_nothing_that_counts(specimen):
    fine = driven(specimen, BRANCHES, COURSE, 4, elements=5, degree=6)
    np.testing.assert_allclose(driven(specimen, BRANCHES, COURSE, 4), fine, rtol=5e-6)


@pytest.mark.parametrize("law", ["ogden", "gent"])
@pytest.mark.parametrize("voltage", [0.0, 1000.0])
def test_relaxed_film_is_the_elastic_one(law, voltage):
    """After a step of a thousand relaxation times; with and without wrinkles."""
    specimen = PAPER
    if law == "gent":
        specimen = PAPER.with_material(Material("g", (8e4,), (30.0,), 2.0, law=Gent))
    force = driven(specimen, BRANCHES, ([0.0, 1.0, 6e3], [0.0, 10.0, 10.0], [0.0, voltage, voltage]), 2)[-1]
    assert force == pytest.approx(solve(specimen, 10e-3, voltage).force, rel=3e-6)


@pytest.mark.parametrize(("prestretch", "voltage"), [(1.0, 0.0), (1.2, 1750.0)])
def test_wrinkled_film_is_that_of_the_tension_field(prestretch, voltage):
    specimen = Specimen(4e-3, 20e-3, 40e-6, prestretch, PARKER)
    elastic = solve(specimen, 4e-3, voltage, wrinkling="tension_field")
    plain = solve(specimen, 4e-3, voltage)
    force = driven(specimen, BRANCHES, ([0.0, 1.0, 6e3], [0.0, 4.0, 4.0], [0.0, 0.0, voltage]), 4)[-1]
    assert force == pytest.approx(elastic.force, rel=2e-3)
    assert elastic.force == plain.force or abs(force - elastic.force) < abs(plain.force - elastic.force)


REFERENCE = {
    "hold-1500V-a6": (
        (Specimen(6e-3, 20e-3, 40e-6, 1.2, PARKER), [(0.5, 0.05), (0.2, 2), (0.1, 100)]),
        ([0, 1, 7, 67], [0, 0, 12, 12], [0, 1500, 1500, 1500]),
        ([67], [0.414475493]),
    ),
    "vstep-a4": (
        (PAPER, [(0.3, 3), (0.2, 30)]),
        ([0, 4, 24, 24.1, 44.1, 44.2, 64.2, 64.3, 84.3], [0] + [8] * 8, [0, 0, 0, 1000, 1000, 1500, 1500, 0, 0]),
        ([24, 44.1, 64.2, 84.3], [0.144805468, 0.125030689, 0.100708807, 0.142045299]),
    ),
    "vhb-vstep": (
        (VHB, [(2, 3), (1, 100)]),
        ([0, 15, 75, 75.5, 195.5, 196, 256], [0] + [15] * 6, [0, 0, 0, 1500, 1500, 0, 0]),
        ([256], [0.894975686]),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFERENCE)
def test_forces_agree_with_an_independent_code_as_the_steps_shrink(name):
    """Of a code that shares nothing with this one, nor with the membrane model: at the ends of its holds."""
    (specimen, branches), course, (times, wanted) = REFERENCE[name]
    errors = []
    for count in (40, 80):
        forces = driven(specimen, branches, course, count)
        found = [forces[course[0].index(t) - 1] for t in times]
        errors.append(np.abs(np.array(found) / wanted - 1.0).max())
    assert errors[1] < 2e-5 and errors[1] < 0.4 * errors[0]
