"""Parts of the films that take time: how branches flow, by what, and how fast Newton's method converges."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from model.arrays import Array
from model.material.materials import NAMED, Branch, Material
from model.membrane.march import flat_guess
from model.membrane.viscous import balance, flow, flow_slopes
from model.membrane.viscous_films import Films, Instant, Load
from model.specimen import Specimen

TIMES = (0.5, 20.0)
NEO = Material("neo", (6e4,), (2.0,), 3.0, branches=(Branch(0.3, TIMES[0]), Branch(0.2, TIMES[1])))
PARKER = replace(NAMED["parker-cao2018"], branches=NEO.branches)


def films(material: Material) -> Films:
    return Films.of([Specimen(4e-3, 20e-3, 40e-6, 1.2, material)], 3, 1)


def strains(of: Films, seed: int = 3) -> Array:
    """Elastic strains of the branches, (2, K, Q, M, S)."""
    shape = (2, of.branches, *of.grid.radius.shape[:2], 1)
    return np.random.default_rng(seed).uniform(-0.3, 0.3, shape)


def test_a_branch_flows_with_its_deviatoric_stress_over_its_viscosity() -> None:
    """Of a neo-Hookean film, incompressible: ``d(eps_v)/dt = dev(sigma)/(2 eta)`` with ``eta = G tau`` and, over G,
    ``sigma_i = l_i^2 - p`` of which the pressure drops out."""
    of = films(NEO)
    x = strains(of)
    squares = np.exp(2.0 * np.stack((x[0], x[1], -x[0] - x[1])))
    deviator = squares - squares.mean(axis=0)
    rate = flow(of, x)
    for k, time in enumerate(TIMES):
        np.testing.assert_allclose(rate[:, k], deviator[:2, k] / (2.0 * time), rtol=1e-12, atol=1e-14)


def moved(material: Material, column: int, step: float) -> Films:
    """The films with one column of `Films.columns` moved: moduli over G, shape parameters, ln(field), ratios,
    ln(times), ln(pre-stretch), height."""
    n, kinds = len(material.mu) + len(material.alpha), len(material.branches)
    if column < len(material.mu):
        mu = list(material.mu)
        mu[column] += step * material.shear_modulus
        return films(replace(material, mu=tuple(mu)))
    if column < n:
        alpha = list(material.alpha)
        alpha[column - len(material.mu)] += step
        return films(replace(material, alpha=tuple(alpha)))
    branches = list(material.branches)
    which = column - n - 1
    if 0 <= which < kinds:
        branches[which] = replace(branches[which], ratio=branches[which].ratio + step)
    elif kinds <= which < 2 * kinds:
        one = branches[which - kinds]
        branches[which - kinds] = replace(one, time=one.time * np.exp(step))
    return films(replace(material, branches=tuple(branches)))


@pytest.mark.parametrize("material", [NEO, PARKER], ids=["neo", "parker"])
def test_slopes_of_the_flow_are_its_differences(material: Material) -> None:
    of = films(material)
    x, by = strains(of), np.random.default_rng(5).normal(0.0, 1.0, (*strains(of).shape[:-1], of.columns, 1))
    logs = np.concatenate((x, -(x[:1] + x[1:])))
    at: Any = SimpleNamespace(logs=np.concatenate((np.zeros_like(logs[:, :1]), logs), axis=1))
    found = flow_slopes(of, at, by.copy(), flow(of, x))
    assert found.shape == by.shape
    step = 1e-5
    for column in range(of.columns):
        up, down = (flow(moved(material, column, s), x + s * by[..., column, :]) for s in (step, -step))
        wanted = (up - down) / (2.0 * step)
        np.testing.assert_allclose(found[..., column, :], wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


def test_a_free_disk_that_is_at_another_height_is_back_after_one_step() -> None:
    """In the height alone, under a weight that grows evenly with it, the equations are linear: Newton's method is exact
    at once, in the height and in the modes and slopes that follow it."""
    of = films(PARKER)
    weight = Load(np.array([0]), np.array([1.0]), lambda which, h: (0.1 + 5.0 * h, np.full_like(h, 5.0)))
    instant = Instant(np.array([1.0]), np.array([500.0]), weight)
    none = np.zeros_like(strains(of))
    lag = np.full_like(of.time, 1e3)  # slow: the branches have given way
    with np.errstate(all="ignore"):
        found = balance(of, instant, none, lag, flat_guess(of, Instant(np.array([2e-3]), np.zeros(1))), 1e-12, 60)
        assert found.ok.all()
        near = found.state
        assert near.height is not None and near.height[0] > 0.1
        again = balance(of, instant, none, lag, replace(near, height=near.height * 1.02), 0.0, 1).state
    assert again.height is not None
    np.testing.assert_allclose(again.height, near.height, rtol=1e-12)
    for one, other in ((again.c, near.c), (again.w, near.w), (again.x, near.x)):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-10)
