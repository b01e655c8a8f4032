"""Random histories of random films: what the solver states of its error, against the simulated bench's own film."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.arrays import Array
from model.material.gent import Gent
from model.material.materials import NAMED, Branch, Material
from model.membrane.history import solve_histories
from model.membrane.solve import Status
from model.specimen import Specimen
from rig.sim.viscous_film import ViscousFilm

SPARE = 0.2  # of what is stated: so exact must the simulated film be to judge it


def drawn(random: np.random.Generator) -> tuple[Specimen, tuple[Array, Array, Array], Array]:
    """A film with one to three branches, a piecewise linear history, and times to ask at."""
    vhb = random.random() < 0.2
    prestretch = random.uniform(2.0, 3.5) if vhb else random.uniform(1.05, 1.5)
    count = int(random.integers(1, 4))
    branches = tuple(
        Branch(math.exp(random.uniform(*np.log((0.02, 2.0)))), math.exp(random.uniform(*np.log((0.05, 1000.0)))))
        for _ in range(count)
    )
    material = NAMED["parker-cao2018"]
    if vhb:
        material = Material("vhb", (43560.0, 117.4), (1.445, 4.248), 4.7)
    elif random.random() < 0.5:
        material = Material("one", (random.uniform(3e4, 1e5),), (random.uniform(1.5, 6.0),), random.uniform(1.5, 4.0))
    elif random.random() < 0.5:
        material = Material("gent", (random.uniform(3e4, 1e5),), (random.uniform(30.0, 120.0),), 2.5, law=Gent)
    material = replace(material, branches=branches)
    thickness = 500e-6 if vhb else random.uniform(30e-6, 120e-6)
    specimen = Specimen(random.uniform(2e-3, 9e-3), 20e-3, thickness, prestretch, material)
    parts = int(random.integers(2, 6))
    t, h, voltage = [0.0], [0.0], [0.0]
    scale = 25e6 * thickness / prestretch**2
    for k in range(parts):
        t.append(t[-1] + math.exp(random.uniform(*np.log((0.2, 60.0)))))
        h.append(h[-1] if k and random.random() < 0.4 else random.uniform(1e-3, 14e-3))
        voltage.append(voltage[-1] if random.random() < 0.6 else random.uniform(0.0, scale))
    if random.random() < 0.2:  # a hold of no length
        bend = int(random.integers(1, len(t)))
        for one in (t, h, voltage):
            one.insert(bend, one[bend])
    times = np.sort(np.concatenate((t, random.uniform(0.0, t[-1], 3))))  # some of them twice
    return specimen, (np.array(t), np.array(h), np.array(voltage)), times


def simulated(specimen: Specimen, course: tuple[Array, Array, Array], times: Array, fine: float) -> Array:
    """Force of the simulated bench's film at ``times``: steps grow after every bend, by a share ``fine`` of the way."""
    t, h, voltage = (one[np.concatenate((np.diff(course[0]) > 0.0, [True]))] for one in course)
    film = ViscousFilm(specimen, [(one.ratio, one.time) for one in specimen.material.branches], 0.0)
    stops = np.unique(np.concatenate((t, times)))
    moment, found = film.rested, {0.0: 0.0}
    shortest = min(one.time for one in specimen.material.branches)
    for left, right in pairwise(stops.tolist()):
        bend = t[np.searchsorted(t, left, side="right") - 1]
        part = np.searchsorted(t, left, side="right")
        moving = (h[part] != h[part - 1]) or (voltage[part] != voltage[part - 1])
        now = left
        while now < right:
            dt = fine * max(now - bend, 0.1 * min(shortest, t[part] - bend))
            if moving:
                dt = min(dt, 0.15 * fine * (t[part] - bend))
            end = right if now + dt > right * (1.0 - 1e-12) else now + dt
            moment = film.step(moment, end - now, float(np.interp(end, t, h)), float(np.interp(end, t, voltage)))
            now = end
        found[right] = moment.force if moment.found == "taut" and not moment.wrinkled.any() else math.nan
    return np.array([found[float(one)] for one in times])


def judged(count: int, seed: int, tolerances: tuple[float, ...]) -> tuple[int, int, list[str]]:
    """Answers compared, those whose error is beyond three times what is stated, and which."""
    random = np.random.default_rng(seed)
    cases = [drawn(random) for _ in range(count)]
    compared = beyond = 0
    told = []
    for number, tolerance in enumerate(tolerances):
        mine = cases[number :: len(tolerances)]
        histories = [(*course, times) for _, course, times in mine]
        answers = solve_histories([specimen for specimen, _, _ in mine], histories, tolerance=tolerance)
        for (specimen, course, times), found in zip(mine, answers, strict=True):
            taut = found.status == Status.TAUT
            if not taut.any():
                continue
            peak = np.abs(found.force[taut]).max()
            fine, before = 0.2, simulated(specimen, course, times, 0.4)
            while True:
                exact = simulated(specimen, course, times, fine)
                own = np.abs(exact - before) / 3.0 / peak  # of the second order; a third is left after Richardson
                best = exact + (exact - before) / 3.0
                if not (own > SPARE * found.error_estimate).any() or fine < 0.02:
                    break
                fine, before = 0.5 * fine, exact
            here = taut & np.isfinite(best)
            wrong = here & (np.abs(found.force - best) / peak > 3.0 * found.error_estimate)
            compared, beyond = compared + int(here.sum()), beyond + int(wrong.any())
            if wrong.any():
                ratio = np.abs(found.force - best) / peak / found.error_estimate
                told.append(
                    f"{tolerance:g}: {ratio[here].max():.2g} of {found.error_estimate[here].max():.2g}, {specimen}"
                )
    return compared, beyond, told


@pytest.mark.slow
def test_what_is_stated_of_the_error_is_so() -> None:
    compared, beyond, told = judged(12, 1, (1e-3, 1e-4))
    assert compared > 50
    assert beyond == 0, told


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_what_is_stated_of_the_error_is_so_of_300_histories() -> None:
    compared, beyond, told = judged(300, 2, (1e-3, 1e-4, 1e-5))
    assert compared > 1200
    assert beyond <= 3, told
