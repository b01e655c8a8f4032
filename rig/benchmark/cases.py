"""Films and states for the benchmarks, drawn with a fixed seed so that every run sees the same ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.material.materials import NAMED, Material
from model.specimen import Specimen
from model.verification.reference import Reference, reference

Generator = np.random.Generator


@dataclass(frozen=True)
class Case:
    """One state to solve: a film, a displacement (m) and a voltage (V)."""

    specimen: Specimen
    h: float
    voltage: float


def solve_reference(cases: Sequence[Case], wrinkling: str = "plain") -> Reference:
    """Reference values of all cases."""
    return reference(
        [case.specimen for case in cases],
        [case.h for case in cases],
        [case.voltage for case in cases],
        wrinkling=wrinkling,
    )


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """Equal chance for every decade."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_material(rng: Generator, shear: float | None = None) -> Material:
    """One to three Ogden terms; a third of those with several get a term of negative modulus and exponent."""
    terms = int(rng.integers(1, 4))
    alpha = rng.uniform(1.3, 8.0, terms)
    share = rng.uniform(0.1, 1.0, terms)
    if terms > 1 and rng.random() < 1 / 3:
        alpha[-1] = -rng.uniform(1.5, 5.0)
        share[-1] *= 0.3
    modulus = log_uniform(rng, 1e4, 1e6) if shear is None else shear
    mu = 2 * modulus * share / share.sum() / alpha
    return Material("random", tuple(mu.tolist()), tuple(alpha.tolist()), float(rng.uniform(1.5, 8.0)))


def slack_voltage(specimen: Specimen, h: float) -> float:
    """Voltage (V) at which a film stretched equally, as far as a straight cone of height ``h``, carries no tension.

    A scale for voltages, at hand without solving anything; pull-in and loss of hoop tension come below it.
    """
    slope = h / (specimen.ring_radius - specimen.disk_radius)
    stretch = specimen.prestretch * np.hypot(1.0, slope) ** 0.5
    stretch = max(stretch, 1.0 + 1e-12)
    m = specimen.material
    stress = sum(mu * (stretch**al - stretch ** (-2 * al)) for mu, al in zip(m.mu, m.alpha, strict=True))
    return float(specimen.thickness * np.sqrt(max(stress, 0.0) / m.permittivity) / stretch**2)


def random_case(rng: Generator, *, disk: tuple[float, float], height: tuple[float, float], charge: float) -> Case:
    """A random film and state; ``disk`` and ``height`` are ranges over the ring radius, ``charge`` of slack voltage."""
    ring = log_uniform(rng, 5e-3, 0.1)
    specimen = Specimen(
        ring * log_uniform(rng, *disk),
        ring,
        log_uniform(rng, 1e-5, 5e-4),
        float(rng.uniform(1.0, 2.0)),
        random_material(rng),
    )
    h = ring * log_uniform(rng, *height)
    voltage = 0.0 if rng.random() < 0.25 else slack_voltage(specimen, h) * float(rng.uniform(0.0, charge))
    return Case(specimen, h, voltage)


def paper_cases() -> list[Case]:
    """States of Cao & Conn 2018, figures 4 to 6."""
    parker = NAMED["parker-cao2018"]
    return [
        Case(Specimen(a * 1e-3, 20e-3, 40e-6, 1.2, parker), h * 1e-3, voltage)
        for a, h, voltage in ((4, 10, 1500.0), (4, 10, 0.0), (2, 10, 1500.0), (6, 12, 1000.0), (8, 5, 0.0))
    ]


def taut_cases(count: int) -> tuple[list[Case], Reference]:
    """Taut states with their reference values: those of the paper, then random ones."""
    rng = np.random.default_rng(20180618)
    pool = paper_cases()
    while len(pool) < 2 * count + 8:
        pool.append(random_case(rng, disk=(0.05, 0.6), height=(0.05, 1.0), charge=0.8))
    found = solve_reference(pool)
    taut = np.flatnonzero(found.converged & (found.min_hoop_stress > 0))[:count]
    picked = Reference(*(getattr(found, name)[taut] for name in Reference.__dataclass_fields__))
    return [pool[i] for i in taut], picked
