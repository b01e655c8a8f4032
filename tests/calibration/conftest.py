"""Synthetic force-displacement experiments with known truth."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.material.materials import NAMED, Material
from model.membrane.solve import solve_many
from model.specimen import Specimen

PARKER = NAMED["parker-cao2018"]
GUESS = replace(PARKER, name="guess", mu=(2e4,), alpha=(3.0,), eps_r=3.0)  # far from the truth in every parameter

SPEED = 1e-3  # m/s
FORCE_NOISE = 5e-3  # N, 0.5 % of 1 N full scale
EXACT = {
    "displacement_axis": 0.0,
    "voltage_at_film": 0.0,
    "thickness_uncertainty": 0.0,
    "prestretch_uncertainty": 0.0,
    "disk_radius_uncertainty": 0.0,
    "ring_radius_uncertainty": 0.0,
}
ERRORS = {
    "force_gain": 1e-3,
    "force_zero": 2e-4,
    "displacement_gain": 5e-4,
    "displacement_zero": 5e-6,
    "voltage_gain": 1e-3,
}

Array = NDArray[np.float64]
Experiment = Callable[..., list[Curve]]


@lru_cache(maxsize=64)
def _table(specimen: Specimen, highest: float, voltage: float) -> tuple[Array, Array]:
    grid = np.linspace(0.0, highest, 1201)
    return grid, solve_many(specimen, grid, voltage, wrinkling="tension_field").force


def exact_force(specimen: Specimen, h: Array, voltage: float) -> Array:
    """Force at many displacements, from a dense table of the model (its error is far below any noise here)."""
    force = np.interp(h, *_table(specimen, float(h.max()), voltage))
    return np.asarray(force)


def relaxing(
    curves: Sequence[Curve], truth: Material, ratio: float, tau: float, compliance: float = 0.0
) -> list[Curve]:
    """The curves of a viscous film on a rig that gives way, both uncorrected.

    A Maxwell branch of ``ratio`` times the film's stiffness and relaxation time ``tau`` (s) adds
    ``ratio * integral exp(-(t - s)/tau) dF0``, worked out step by step; ``compliance`` (m/N) lengthens the way.
    """
    changed = []
    last = {"": (0.0, 0.0)}  # of each run: time and force of the branch, which the next curve inherits
    for curve in curves:
        elastic = exact_force(curve.specimen.with_material(truth), np.clip(curve.h, 0.0, 12e-3), 0.0)
        time = curve.time if curve.time is not None else np.zeros(curve.h.size)
        before, branch = last.get(curve.run, (float(time[0]), 0.0))
        branch *= float(np.exp(-(time[0] - before) / tau))
        extra = np.zeros(curve.h.size)
        for k in range(1, curve.h.size):
            branch = branch * float(np.exp(-(time[k] - time[k - 1]) / tau)) + ratio * float(elastic[k] - elastic[k - 1])
            extra[k] = branch
        last[curve.run] = (float(time[-1]), branch)
        force = curve.force + extra
        changed.append(replace(curve, force=force, h=curve.h + compliance * force))
    return changed


def make_experiment(
    seed: int = 0,
    *,
    truth: Material = PARKER,
    guess: Material = GUESS,
    voltages: Sequence[float] = (0.0, 1000.0, 1500.0),
    disks: Sequence[float] = (4e-3, 6e-3),
    prestretch: float = 1.2,
    highest: float = 12e-3,
    samples: int = 2000,
    noise: float = FORCE_NOISE,
    errors: dict[str, float] | None = None,
    gains: bool = False,
    exact: bool = True,
) -> list[Curve]:
    """The paper's experiment: up and down at every voltage with every disk.

    Every run has its own errors of zero, drawn from their stated uncertainties; with ``gains`` all runs share drawn
    errors of the gains too.
    """
    random = np.random.default_rng(seed)
    stated = ERRORS if errors is None else errors
    dimensions = EXACT if exact else {}
    draw = {name: size * random.standard_normal() for name, size in stated.items()}
    curves = []
    way = np.arange(samples) * (2 * highest / SPEED / samples)
    for disk in disks:
        specimen = Specimen(disk, 20e-3, 40e-6, prestretch, truth, name=f"cone-{disk * 1e3:.0f}mm")
        force_zero = stated.get("force_zero", 0.0) * random.standard_normal()
        displacement_zero = stated.get("displacement_zero", 0.0) * random.standard_normal()
        for number, voltage in enumerate(voltages):
            up = np.linspace(0.0, highest, samples // 2)
            h = np.concatenate((up, up[::-1]))
            force = exact_force(specimen, h, voltage)
            measured = np.full(samples, voltage)
            if gains:
                force = force * (1.0 + draw["force_gain"])
                measured = measured * (1.0 + draw["voltage_gain"])
                h = h * (1.0 + draw["displacement_gain"])
            curves.append(
                Curve(
                    label=f"a = {disk * 1e3:.0f} mm, {voltage:.0f} V",
                    run=f"run-{disk * 1e3:.0f}mm",
                    specimen=specimen.with_material(guess),
                    h=h + displacement_zero + (5e-6 * random.standard_normal(samples) if stated else 0.0),
                    force=force + force_zero + noise * random.standard_normal(samples),
                    voltage=measured + (0.3 * random.standard_normal(samples) if stated and voltage else 0.0),
                    nominal_voltage=voltage,
                    direction=np.repeat([1, -1], samples // 2),
                    time=way + number * (2 * highest / SPEED + 5.0),
                    force_noise=noise,
                    displacement_noise=5e-6 if stated else 0.0,
                    **(dimensions | stated),
                )
            )
    return curves


@pytest.fixture(scope="session")
def experiment() -> Experiment:
    return make_experiment


@pytest.fixture(scope="session")
def relaxed() -> Experiment:
    return relaxing
