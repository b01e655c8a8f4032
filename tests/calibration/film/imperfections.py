"""Imperfections of rig and film, each of a given size, for experiments on the independent cone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from calibration.film.identify import identify
from calibration.film.result import Identification
from model.material.neo_hooke import NeoHooke
from tests.calibration.film.independent import HIGHEST_M, ONE_TERM, Sweep, measured, secant_modulus, sweeps
from tests.calibration.film.shooting import Array, Cone
from tests.calibration.film.table_road import through_table
from tests.calibration.film.viscous_cone import ViscousCone

# What a careful laboratory states, and the gain of the force that tables of other rigs are read with.
STATED = dict.fromkeys(("prestretch_uncertainty", "disk_radius_uncertainty", "force_gain"), 0.005)
STATED |= {"thickness_uncertainty": 0.02, "ring_radius_uncertainty": 0.002}
STATED |= {"voltage_at_film": 0.002, "displacement_axis": 0.002}
FINE = (5e-5, 2e-7)  # noise of force (N) and displacement (m) with which clean experiments count as identified


@dataclass(frozen=True)
class Imperfection:
    """An imperfection: what a size of it does to an experiment, and how the fit should call it.

    ``film`` is the film that has it (one Ogden term if not said), ``fit`` are options of the fit.
    """

    name: str
    make: Callable[[float], dict[str, Any]]
    film: Cone = field(default_factory=lambda: Cone(**ONE_TERM))
    fit: Mapping[str, Any] = field(default_factory=dict)
    voltages: tuple[float, ...] = (0.0, 1000.0, 1500.0)


def force_of(change: Callable[[Sweep, Array, float], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"distortion": lambda sweep, force: change(sweep, force, size)}


def volts_of(loss: Callable[[Sweep], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"voltage_of": lambda sweep: sweep.voltage * (1.0 - size * loss(sweep))}


def film_of(field: str) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"truth": Cone(**ONE_TERM).changed(**{field: size})}


def viscous(tau: float) -> Callable[[float], dict[str, Any]]:
    """A Maxwell branch as stiff as ``size`` times the film: what it adds to the force through the whole run."""
    return lambda size: {"distortion": lambda sweep, force: force + _added(tau, size)(sweep.time)}


@lru_cache(maxsize=8)
def _added(tau: float, size: float) -> Callable[[Array], Array]:
    """By the time of the run, from finite elements of a film at the protocol's voltages."""
    t, h, volts = [], [], []
    for sweep in sweeps(3):  # its ends and its top
        t += [sweep.time[0], sweep.time.mean(), sweep.time[-1]]
        h += [sweep.h[0], HIGHEST_M, sweep.h[-1]]
        volts += 3 * [sweep.voltage]
    film = ViscousCone(branches=((size, tau),), **ONE_TERM)
    trace = film.history(t, h, volts)
    added = trace.force - replace(film, branches=()).forces(trace.t, trace.h, trace.voltage)
    return lambda time: np.interp(time, trace.t, added)


def reading(change: Callable[[Array, float], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"reading_of": lambda h: change(h, size)}


def bowed(h: Array, size: float) -> Array:
    return h + size * 4.0 * h / 12e-3 * (1.0 - h / 12e-3)


def dimension(name: str) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"errors": {name: 1.0 + size}}


GENT = Cone(mu=(5e4,), alpha=(2.0,), eps_r=2.5)
LENGTH = 3 * 24.0 + 2 * 5.0  # s, of the run
IMPERFECTIONS = [
    Imperfection("drift of the force zero, linear", force_of(lambda s, f, a: f + a * s.time / LENGTH)),
    Imperfection(
        "drift of the force zero, thermal", force_of(lambda s, f, a: f - a * np.expm1(-4.0 * s.time / LENGTH))
    ),
    Imperfection("friction in the guide of the disk", force_of(lambda s, f, a: f + a * s.direction)),
    Imperfection("film that softens from one curve to the next", force_of(lambda s, f, a: f * (1.0 - a * s.number))),
    Imperfection("viscous film with a relaxation time near 1 s", viscous(1.0)),
    Imperfection("viscous film with a relaxation time near 30 s", viscous(30.0)),
    Imperfection("viscous film with a relaxation time near 300 s", viscous(300.0)),
    Imperfection("bowed characteristic of the displacement sensor", reading(bowed)),
    Imperfection("displacement gain", reading(lambda h, a: h * (1.0 + a))),
    Imperfection("laser off the axis of the stage", reading(lambda h, a: h * (1.0 + a))),
    Imperfection("loss of voltage that grows with the voltage", volts_of(lambda s: 0.0 * s.h + s.voltage / 1500.0)),
    Imperfection("loss of voltage that grows with stretch", volts_of(lambda s: s.h / 12e-3)),
    Imperfection("loss of voltage that grows with time", volts_of(lambda s: s.time / LENGTH)),
    Imperfection("permittivity that falls with stretch", film_of("stretch_loss")),
    Imperfection("permittivity that changes with the field", film_of("field_gain")),
    Imperfection("pre-stretch other than stated", dimension("prestretch_uncertainty")),
    Imperfection("disk radius other than stated", dimension("disk_radius_uncertainty")),
    Imperfection("ring radius other than stated", dimension("ring_radius_uncertainty")),
    Imperfection("thickness other than stated", dimension("thickness_uncertainty")),
    Imperfection("constant loss of voltage", volts_of(lambda s: 1.0 + 0.0 * s.h)),
    Imperfection(
        "law that stiffens unlike the fitted one (as Gent's does)",
        lambda size: {"truth": GENT.changed(jm=1.0 / size)},
        GENT,
        {"law": NeoHooke},
        (0.0, 1000.0),
    ),
]


def experiment(
    imperfection: Imperfection | None, size: float, seed: int, folder: Path, **options: Any
) -> tuple[Identification, dict[str, float]]:
    """One experiment by the road of tables, with dimensions, gains and zeros drawn from what is stated.

    With it the errors of permittivity and stiffness in combined standard uncertainties.
    """
    one = imperfection or Imperfection("none", lambda size: {})
    made = {"stated": STATED, "zeros": (2e-3, 2e-5), "samples": 200, "truth": one.film, "voltages": one.voltages}
    made |= options | (one.make(size) if size else {})
    curves = through_table(measured(np.random.default_rng(seed), **made), made["stated"], folder)
    found = identify(curves, terms=1, starts=1, **one.fit)
    truth = {"eps_r": made["truth"].eps_r, "stiffness": secant_modulus(made["truth"], *found.stretch)}
    quantities = {name: found.quantities[name] for name in truth}
    return found, {name: (one.value - truth[name]) / one.uncertainty for name, one in quantities.items()}
