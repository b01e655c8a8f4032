"""Runs of the cone of `shooting` whose supply tells its current: capacitances by shooting, in one more integral.

Nothing here comes from `model`. The voltage rises to its level at a few displacements, between sweeps, and rests there;
the current is the derivative of the charge, with leakage, cable and what the supply's monitor makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.charge import Charging, Known
from calibration.film.curve import Curve
from tests.calibration.film.independent import GUESS, ONE_TERM, draw, measured
from tests.calibration.film.shooting import EPS_0, STEPS, Cone

Array = NDArray[np.float64]
STATED = {
    "thickness_uncertainty": 0.02,
    "prestretch_uncertainty": 0.005,
    "disk_radius_uncertainty": 0.0125,
    "ring_radius_uncertainty": 0.0025,
    "voltage_at_film": 2e-3,
    "displacement_axis": 0.005,
    "force_gain": 2e-3,
}
GAIN, CABLE_F, CABLE_ERROR_F, LEAK_OHM, OFFSET_A = 0.01, 0.12e-9, 0.01e-9, 2e10, 2e-9
NOISE_A, STEP_A, RATE_V_PER_S, PERIOD_S = 5e-9, 1e-9, 200.0, 0.1
PLACES_M = (1e-3, 5e-3, 9e-3)
LEVELS = (0.0, 1000.0, 1500.0)


@dataclass(frozen=True)
class Supply:
    """The monitor of the current: its hidden gain and what is stated of it."""

    gain: float = 1.0
    noise: float = NOISE_A
    step: float = STEP_A


def capacitance(film: Cone, h: Array | float, voltage: Array | float) -> Array:
    """Capacitances (F) at displacements (m) and voltages (V), one array, by the shooting's own states."""
    h, volts = (np.array(one, dtype=float) for one in np.broadcast_arrays(h, voltage))
    force, field = film.forces(h, volts), volts / film.thickness
    # Stretch along the meridian at the disk, first that of a straight cone; with it the ring's hoop stretch is right.
    l1 = film.prestretch * (1.0 + 0.6 * (np.hypot(1.0, h / (film.b - film.a)) - 1.0)) + 0.01
    for _ in range(30):
        ends = film._shoot(np.stack((np.concatenate((l1, l1 + 1e-7)), np.tile(force, 2))), np.tile(field, 2))[0]
        miss = ends[: l1.size] - film.prestretch
        if np.abs(miss).max() < 1e-9:
            break
        l1 = l1 - np.clip(miss * 1e-7 / (ends[l1.size :] - ends[: l1.size]), -0.1 * l1, 0.1 * l1)
    else:
        raise AssertionError(f"the shooting did not converge: {np.abs(miss).max()}")
    pull = force * film.prestretch / (2.0 * math.pi * film.thickness)
    return _area(film, l1, pull, field) * EPS_0 * film.eps_r / film.thickness / film.prestretch**2


def _area(film: Cone, l1: Array, pull: Array, field: Array) -> Array:
    """The integral of 2 pi R (l1 l2)^2 dR from the disk to the ring (m2), by Runge-Kutta steps along ln R."""

    def slope(at: float, y: Array) -> Array:
        radius = math.exp(at)
        s1, s2, w11, w12 = film.stresses(y[0], y[1], field)
        cosine = np.sqrt(1.0 - np.clip(pull / (radius * s1), -0.999999, 0.999999) ** 2)
        by2 = y[0] * cosine - y[1]
        return np.stack(((s2 * cosine - s1 - w12 * by2) / w11, by2, 2.0 * math.pi * (radius * y[0] * y[1]) ** 2))

    state = np.stack((l1, np.full(l1.size, film.prestretch), np.zeros(l1.size)))
    x, step = math.log(film.a), math.log(film.b / film.a) / STEPS
    for _ in range(STEPS):
        k1 = slope(x, state)
        k2 = slope(x + step / 2, state + step / 2 * k1)
        k3 = slope(x + step / 2, state + step / 2 * k2)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + step, state + step * k3))
        x += step
    return np.asarray(state[2])


def experiment(
    seed: int,
    *,
    errors: Mapping[str, float] | None = None,
    softening: float = 0.0,
    supply: Supply | None = None,
    levels: Sequence[float] = LEVELS,
    places: Sequence[float] = PLACES_M,
    noise: float = 2e-3,
) -> tuple[list[Curve], list[Charging], Known]:
    """Curves and currents of one run; dimensions and gains are drawn from what is stated unless they are given.

    ``softening`` is the part of its force that the film loses from each sweep to the next.
    """
    random = np.random.default_rng(seed)
    wrong = draw(random, STATED) if errors is None else {**dict.fromkeys(STATED, 1.0), **errors}
    curves = measured(
        random,
        stated=STATED,
        errors=wrong,
        distortion=lambda sweep, force: force * (1.0 - softening) ** sweep.number,
        voltages=levels,
        noise=(noise, 2e-6),
    )
    cone = Cone(**ONE_TERM)  # type: ignore[arg-type] # its fields
    real = cone.changed(
        thickness=cone.thickness * wrong["thickness_uncertainty"],
        prestretch=cone.prestretch * wrong["prestretch_uncertainty"],
        a=cone.a * wrong["disk_radius_uncertainty"],
        b=cone.b * wrong["ring_radius_uncertainty"],
    )
    monitor = supply or Supply(1.0 + (GAIN * random.standard_normal() if errors is None else 0.0))
    cable = CABLE_F + (CABLE_ERROR_F * random.standard_normal() if errors is None else 0.0)
    charging = _charging(random, real, curves[0], wrong, monitor, cable, levels, places)
    known = Known(
        thickness=STATED["thickness_uncertainty"],
        prestretch=STATED["prestretch_uncertainty"],
        disk_radius=STATED["disk_radius_uncertainty"],
        ring_radius=STATED["ring_radius_uncertainty"],
        voltage_gain=STATED["voltage_at_film"],
        displacement_m=5e-6,
        current_gain=GAIN,
        cable_F=CABLE_F,
        cable_uncertainty_F=CABLE_ERROR_F,
    )
    return curves, [charging], known


def _charging(
    random: np.random.Generator,
    real: Cone,
    like: Curve,
    wrong: Mapping[str, float],
    monitor: Supply,
    cable: float,
    levels: Sequence[float],
    places: Sequence[float],
) -> Charging:
    rows, t = [], 0.0
    top = max(levels) * wrong["voltage_at_film"]
    nodes = 0.5 * top * (1.0 - np.cos((2 * np.arange(6) + 1) * np.pi / 12))
    grid = capacitance(real, np.repeat(places, 6), np.tile(nodes, len(places))).reshape(-1, 6)
    for h, values in zip(places, grid, strict=True):
        charge = np.polynomial.Chebyshev.fit(nodes, (values + cable) * nodes, 5, domain=[0, top])
        slope = charge.deriv()
        volts = 0.0
        for level in levels[1:]:
            rise = (level - volts) / RATE_V_PER_S
            for k in range(round((rise + 4.0) / PERIOD_S)):
                since = k * PERIOD_S
                now = min(volts + RATE_V_PER_S * since, level)
                film = now * wrong["voltage_at_film"]
                rate = RATE_V_PER_S * wrong["voltage_at_film"] if 0.0 < since < rise else 0.0
                current = float(slope(film)) * rate + film / LEAK_OHM + OFFSET_A
                rows.append((t + since, now, current, h, since < rise))
            t += rise + 4.0
            volts = level
        t += 5.0
    table = np.array(rows)
    current = table[:, 2] * monitor.gain + monitor.noise * random.standard_normal(len(table))
    if monitor.step:
        current = np.round(current / monitor.step) * monitor.step
    h = table[:, 3] * wrong["displacement_axis"]
    return Charging(
        like.specimen.with_material(GUESS), table[:, 0], table[:, 1], current, h, table[:, 4] > 0.5, run=like.run
    )
