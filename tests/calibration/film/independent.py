"""Experiments on the cone of `shooting`, with dimensions, gains and zeros drawn from their stated uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.material.materials import Material
from model.specimen import Specimen
from tests.calibration.film.shooting import Cone

Array = NDArray[np.float64]
ONE_TERM = {"mu": (37_834.0,), "alpha": (5.4985,), "eps_r": 1.7}
STATED = {
    "thickness_uncertainty": 0.05,
    "prestretch_uncertainty": 0.01,
    "disk_radius_uncertainty": 0.0125,
    "ring_radius_uncertainty": 0.0025,
    "voltage_at_film": 0.01,
    "displacement_axis": 0.005,
    "force_gain": 2e-3,
}
NOISE_N = 2e-3
FORCE_ZERO_N, DISPLACEMENT_ZERO_M, DISPLACEMENT_NOISE_M = 2e-4, 5e-6, 2e-6
HIGHEST_M, SPEED_M_PER_S, PAUSE_S = 12e-3, 1e-3, 5.0
VOLTAGES = (0.0, 1000.0, 1500.0)
GUESS = Material(name="guess", mu=(2e4,), alpha=(3.0,), eps_r=3.0)


@dataclass(frozen=True)
class Sweep:
    """One up and down at a voltage: what was done, by the clock of the run."""

    number: int
    voltage: float
    h: Array  # true displacement (m)
    time: Array  # s
    direction: NDArray[np.int8]


Distortion = Callable[[Sweep, Array], Array]  # from the ideal force (N) to what the imperfect rig or film gives


def sweeps(samples: int, voltages: Sequence[float] = VOLTAGES) -> list[Sweep]:
    """The paper's protocol."""
    up = np.linspace(2e-4, HIGHEST_M, samples // 2)
    h = np.concatenate((up, up[::-1]))
    length = 2.0 * HIGHEST_M / SPEED_M_PER_S
    return [
        Sweep(
            k,
            voltage,
            h,
            np.linspace(0.0, length, samples) + k * (length + PAUSE_S),
            np.repeat(np.array([1, -1], dtype=np.int8), samples // 2),
        )
        for k, voltage in enumerate(voltages)
    ]


def draw(random: np.random.Generator, stated: Mapping[str, float]) -> dict[str, float]:
    """Relative errors, drawn from their standard uncertainties."""
    return {name: 1.0 + size * random.standard_normal() for name, size in stated.items()}


@lru_cache(maxsize=4)
def ideal_curves(film: Cone, voltages: tuple[float, ...]) -> list[Callable[[Array], Array]]:
    """Force at every voltage by displacement; experiments that differ by their noise share it."""
    return film.curves(voltages, HIGHEST_M)


def measured(
    random: np.random.Generator,
    *,
    truth: Cone | None = None,
    stated: Mapping[str, float] = STATED,
    errors: Mapping[str, float] | None = None,
    distortion: Distortion = lambda sweep, force: force,
    voltage_of: Callable[[Sweep], Array] | None = None,
    reading_of: Callable[[Array], Array] = lambda h: h,
    samples: int = 240,
    voltages: Sequence[float] = VOLTAGES,
    believed: str = "cone",
    noise: tuple[float, float] = (NOISE_N, DISPLACEMENT_NOISE_M),
    zeros: tuple[float, float] = (FORCE_ZERO_N, DISPLACEMENT_ZERO_M),
) -> list[Curve]:
    """Curves of one run with one film.

    ``stated`` are the relative standard uncertainties that the curves state, ``errors`` the factors of the truth over
    what is believed (drawn, if they are not given). ``voltage_of`` tells the true voltage of every sample where it is
    not that of the supply, ``reading_of`` the sensor's reading at a true displacement. ``noise`` and ``zeros`` are the
    standard deviations of force (N) and displacement (m).
    """
    film = Cone(**ONE_TERM) if truth is None else truth
    nominal = Specimen(film.a, film.b, film.thickness, film.prestretch, GUESS, name=believed)
    wrong = draw(random, stated) if errors is None else {**dict.fromkeys(stated, 1.0), **errors}
    real = film.changed(
        thickness=film.thickness * wrong.get("thickness_uncertainty", 1.0),
        prestretch=film.prestretch * wrong.get("prestretch_uncertainty", 1.0),
        a=film.a * wrong.get("disk_radius_uncertainty", 1.0),
        b=film.b * wrong.get("ring_radius_uncertainty", 1.0),
    )
    force_zero, displacement_zero = (size * random.standard_normal() for size in zeros)
    curves = []
    factor = wrong.get("voltage_at_film", 1.0)
    levels = [one * factor for one in voltages]
    ideal = ideal_curves(real, (*levels, *(0.9 * one for one in levels if voltage_of is not None)))
    for sweep in sweeps(samples, voltages):
        force = ideal[sweep.number](sweep.h)
        if voltage_of is not None and sweep.voltage > 0.0:
            # The force is linear in V^2 over the small change of the voltage.
            less = ideal[sweep.number + len(voltages)](sweep.h)
            square = (voltage_of(sweep) / sweep.voltage) ** 2
            force = force + (square - 1.0) * (force - less) / (1.0 - 0.81)
        force = distortion(sweep, force)
        count = sweep.h.size
        curves.append(
            Curve(
                label=f"{sweep.voltage:.0f} V, sweep {sweep.number}",
                run="run",
                specimen=nominal,
                h=reading_of(sweep.h) * wrong.get("displacement_axis", 1.0)
                + displacement_zero
                + noise[1] * random.standard_normal(count),
                force=force * wrong.get("force_gain", 1.0) + force_zero + noise[0] * random.standard_normal(count),
                voltage=np.full(count, sweep.voltage),
                nominal_voltage=sweep.voltage,
                direction=sweep.direction,
                time=sweep.time,
                force_noise=noise[0],
                displacement_noise=noise[1],
                force_zero=zeros[0],
                displacement_zero=zeros[1],
                **stated,  # type: ignore[arg-type] # uncertainties by their fields
            )
        )
    return curves


def secant_modulus(film: Cone, meridional: float, hoop: float) -> float:
    """Stiffness (Pa) of the cone's film by its definition: the neo-Hookean modulus of the same meridional stress."""
    s1 = film.stresses(np.array([meridional]), np.array([hoop]), np.zeros(1))[0]
    return float(s1[0] * meridional / (meridional**2 - (meridional * hoop) ** -2.0))
