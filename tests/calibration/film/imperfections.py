"""Imperfections of rig and film, each of a given size, for experiments on the independent cone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibration.film.identify import identify
from calibration.film.result import Identification
from model.material.neo_hooke import NeoHooke
from tests.calibration.film.independent import ONE_TERM, Sweep, measured, secant_modulus
from tests.calibration.film.shooting import Array, Cone
from tests.calibration.film.table_road import through_table

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
    """A Maxwell branch as stiff as ``size`` times the film at 0 V, worked out step by step through the run."""
    elastic = Cone(**ONE_TERM).curves((0.0,), 12e-3)[0]

    def make(size: float) -> dict[str, Any]:
        last = {"t": 0.0, "branch": 0.0, "elastic": 0.0}

        def distortion(sweep: Sweep, force: Array) -> Array:
            rest, extra = elastic(sweep.h), np.zeros(force.size)
            for k in range(force.size):
                last["branch"] = (
                    last["branch"] * math.exp(-(sweep.time[k] - last["t"]) / tau) + rest[k] - last["elastic"]
                )
                last["t"], last["elastic"], extra[k] = sweep.time[k], rest[k], last["branch"]
            return force + size * extra

        return {"distortion": distortion}

    return make


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
