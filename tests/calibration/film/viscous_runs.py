"""Runs of a simulated film that takes time, as records and curves of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from calibration.film.branches.record import Record, records_of_curves
from calibration.film.curve import Curve
from model.material.materials import Material
from model.specimen import Specimen
from rig.sim.viscous_film import ViscousFilm
from tests.calibration.film.viscous_cone import Trace, ViscousCone

GUESS = Material(name="guess", mu=(2e4,), alpha=(3.0,), eps_r=2.5)
EXACT = dict.fromkeys(
    (
        "thickness_uncertainty",
        "prestretch_uncertainty",
        "disk_radius_uncertainty",
        "ring_radius_uncertainty",
        "displacement_axis",
        "voltage_at_film",
    ),
    0.0,
)
ONE_TERM = {"mu": (37_834.0,), "alpha": (5.4985,), "eps_r": 1.7}

# times (s), displacements (m) and voltages (V) of the bends, and (begin, end, voltage) of the recorded parts
History = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[tuple[float, float, float], ...]]


def paper(voltages: Sequence[float] = (0.0, 1000.0, 1500.0), hold: float = 0.0, speed: float = 1e-3) -> History:
    """Up to 12 mm and down again at every voltage, held at the top; 5 s between."""
    t, h, v, parts = [0.0], [0.0], [0.0], []
    move = 12e-3 / speed
    for voltage in voltages:
        if voltage:
            t, h, v = [*t, t[-1] + 5.0], [*h, 0.0], [*v, voltage]
        begin = t[-1]
        for length, place in ((move, 12e-3), (hold, 12e-3), (move, 0.0)):
            if length:
                t, h, v = [*t, t[-1] + length], [*h, place], [*v, voltage]
        parts.append((begin, t[-1], voltage))
    return tuple(t), tuple(h), tuple(v), tuple(parts)


@lru_cache(maxsize=8)
def solved(cone: ViscousCone, history: History) -> Trace:
    """The answer of the simulated bench's film, good to 1e-5 of the peak; experiments that differ by noise share it.

    The linear elements of `ViscousCone` err by some 1e-4: as much as is stated of what a long record tells.
    """
    t, h, voltage, _ = history
    material = Material("truth", cone.mu, cone.alpha, cone.eps_r)
    specimen = Specimen(cone.a, cone.b, cone.thickness, cone.prestretch, material)
    film = ViscousFilm(specimen, list(cone.branches) or [(0.0, 1.0)], 0.0)
    at = cone.times(t, moves=160)
    places, volts = np.interp(at, t, h), np.interp(at, t, voltage)
    now, force = film.untouched(float(volts[0])), np.zeros(at.size)
    for k in range(1, at.size):
        now = film.step(now, float(at[k] - at[k - 1]), float(places[k]), float(volts[k]))
        force[k] = now.force
    return Trace(at, places, volts, force)


def run(
    cone: ViscousCone,
    history: History,
    seed: int,
    *,
    believed: Specimen | None = None,
    noise: tuple[float, float, float] = (1e-3, 2e-6, 2.0),
    zeros: tuple[float, float] = (2e-4, 5e-6),
    rate: float = 100.0,
    name: str = "run",
    stated: Mapping[str, float] = EXACT,
) -> list[Curve]:
    """Curves of one run; the whole record follows from them. ``noise`` of force, displacement and voltage."""
    random = np.random.default_rng(seed)
    t, h, v, parts = history
    trace = solved(cone, history)
    at = np.arange(0.3 / rate, t[-1], 1.0 / rate)
    place, volts = np.interp(at, t, h), np.interp(at, t, v)
    force = trace.at(at) + noise[0] * random.standard_normal(at.size) + zeros[0] * random.standard_normal()
    read = place + noise[1] * random.standard_normal(at.size) + zeros[1] * random.standard_normal()
    volts = volts + noise[2] * random.standard_normal(at.size) * (volts > 0.0)
    film = believed or Specimen(cone.a, cone.b, cone.thickness, cone.prestretch, GUESS, name="cone")
    speed = np.diff(h) / np.diff(t)
    direction = np.sign(speed[np.clip(np.searchsorted(t, at) - 1, 0, speed.size - 1)]).astype(np.int8)
    found = []
    for begin, end, voltage in parts:
        rows = (at >= begin) & (at < end)
        found.append(
            Curve(
                label=f"{voltage:g} V",
                run=name,
                specimen=film,
                h=read[rows],
                force=force[rows],
                voltage=volts[rows],
                nominal_voltage=voltage,
                direction=direction[rows],
                force_noise=noise[0],
                displacement_noise=noise[1],
                force_zero=zeros[0],
                displacement_zero=zeros[1],
                time=at[rows],
                **dict(stated),
            )
        )
    return found


def records(curves: Sequence[Curve]) -> list[Record]:
    """Whole runs."""
    return records_of_curves([replace(curve) for curve in curves])
