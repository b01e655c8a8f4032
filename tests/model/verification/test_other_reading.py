"""The paper as it may have computed its optima: eq. (4) as printed beside the solver, and with the slip."""

from __future__ import annotations

import numpy as np
import pytest

from model.material.materials import NAMED
from model.membrane.solve import solve_many
from model.specimen import Specimen
from model.verification.other_reading import Films

PARKER = NAMED["parker-cao2018"]


def films(*disks: float, lp: float) -> list[Specimen]:
    return [Specimen(disk, 20e-3, 40e-6, lp, PARKER) for disk in disks]


def test_as_printed_its_forces_are_the_solver_s() -> None:
    some = films(3e-3, 4e-3, 8e-3, lp=1.2)
    h = np.full(3, 10e-3)
    _, force = Films(some, slip=False).at(h)
    np.testing.assert_allclose(force, solve_many(some, h).force, rtol=1e-6)


def test_with_r_undeformed_the_force_hardly_changes_but_for_another_prestretch() -> None:
    _, force = Films(films(4e-3, lp=1.2)).at(np.array([10e-3]))
    assert force[0] == pytest.approx(0.2164, abs=5e-5)  # README; 0.2157 N as printed: r = R at the disk
    assert force[0] / 1.2 == pytest.approx(0.1803, abs=5e-5)  # what an independent code with that slip has


@pytest.mark.slow
def test_strokes_and_works_are_those_of_an_independent_code() -> None:
    """At the a/b that the paper prints, without pre-stretch: table 1's spring, and the mass."""
    flat = films(3e-3, 4e-3, 6e-3, 7e-3, lp=1.0)
    spring = Films(flat).ends(lambda h: 0.8 - 50.0 * h, 80e6)
    mass = Films(flat).ends(lambda h: 0.25 + 0.0 * h, 80e6)
    assert spring.stroke[0] / 20e-3 == pytest.approx(0.0614, abs=1.5e-4)
    assert mass.stroke[1] / 20e-3 == pytest.approx(0.1049, abs=1.5e-4)
    assert 1e3 * spring.work[3] == pytest.approx(0.0745, abs=1.5e-4)
    assert 1e3 * mass.work[2] == pytest.approx(0.1174, abs=1.5e-4)
    plain = Films(flat, slip=False).ends(lambda h: 0.8 - 50.0 * h, 80e6)
    assert plain.stroke[0] / 20e-3 == pytest.approx(0.0553, abs=1.5e-4)
