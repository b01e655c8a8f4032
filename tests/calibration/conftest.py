"""Synthetic force-displacement experiments with known truth."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.curve import Curve
from model.materials import NAMED, Material
from model.membrane import solve_many
from model.specimen import Specimen

PARKER = NAMED["parker-cao2018"]
GUESS = replace(PARKER, name="guess", mu=(2e4,), alpha=(3.0,), eps_r=3.0)  # far from the truth in every parameter

FORCE_NOISE = 5e-3  # N, 0.5 % of 1 N full scale
ERRORS = {
    "force_gain": 1e-3,
    "force_zero": 2e-4,
    "displacement_gain": 5e-4,
    "displacement_zero": 5e-6,
    "voltage_gain": 1e-3,
}

Array = NDArray[np.float64]
Experiment = Callable[..., list[Curve]]


def exact_force(specimen: Specimen, h: Array, voltage: float) -> Array:
    """Force at many displacements, from a dense table of the model (its error is far below any noise here)."""
    grid = np.linspace(0.0, float(h.max()), 1201)
    force = np.interp(h, grid, solve_many(specimen, grid, voltage).force)
    return np.asarray(force)


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
) -> list[Curve]:
    """The paper's experiment: up and down at every voltage with every disk.

    Every run has its own errors of zero, drawn from their stated uncertainties; with ``gains`` all runs share drawn
    errors of the gains too.
    """
    random = np.random.default_rng(seed)
    stated = ERRORS if errors is None else errors
    draw = {name: size * random.standard_normal() for name, size in stated.items()}
    curves = []
    for disk in disks:
        specimen = Specimen(disk, 20e-3, 40e-6, prestretch, truth, name=f"cone-{disk * 1e3:.0f}mm")
        force_zero = stated.get("force_zero", 0.0) * random.standard_normal()
        displacement_zero = stated.get("displacement_zero", 0.0) * random.standard_normal()
        for voltage in voltages:
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
                    force_noise=noise,
                    displacement_noise=5e-6 if stated else 0.0,
                    **stated,
                )
            )
    return curves


@pytest.fixture(scope="session")
def experiment() -> Experiment:
    return make_experiment
