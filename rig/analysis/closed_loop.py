"""``dea-rig run --until``: the protocol of a closed loop, and whether what is wanted can be reached at all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.film.curve import Curve
from calibration.film.identifiability import expected
from calibration.film.planning import Places
from calibration.film.propagation import Statement
from calibration.rounding import percent
from calibration.sensors.certificate import Certificate
from rig.analysis.film import errors_of
from rig.analysis.learning import believed_film
from rig.analysis.proposal import framed, protocol_text, recorded, uniform_sweep
from rig.base.errors import ConfigError
from rig.protocol.experiment import certificates_of
from rig.scene.scene import Scene, load_scene
from rig.steps.learn import Learn
from rig.steps.places import connected
from rig.steps.wanted import BY_TIME, Wanted, parse_wanted

DAY_S = 86_400.0
TRIED_S = np.geomspace(20.0, DAY_S, 15)  # of holding, for the estimate of how long it takes
SURE = 0.9  # of what is best by the film believed: only a wish below it is refused, for the film may be another
WAYS = 1.5  # times the time of holding that ways, waits and fits take along, roughly


@dataclass(frozen=True)
class Outlook:
    """What is expected of one wish, by the film believed: relative standard uncertainties.

    ``best`` is in a day of the rig, ``then`` in the time given, ``seconds`` roughly how long it takes (inf: longer
    than a day). ``part`` is the largest part that stays, with its relative size.
    """

    wanted: Wanted
    best: float
    then: float
    seconds: float
    part: tuple[str, float]


def closed_loop(scene_path: Path, until: str, at_most_s: float, terms: int) -> tuple[str, list[Outlook]]:
    """The protocol file, and what is expected of each wish.

    Raises
    ------
    ConfigError
        The wish is not understood, or not even a day of the rig would reach it; says what is best.
    LimitError
        The scene allows no places to measure at.
    """
    scene, _ = load_scene(scene_path)
    certificates = certificates_of(scene, scene_path)
    try:
        wanted = parse_wanted(until)
    except ValueError as error:
        raise ConfigError(f"--until: {error}.") from None
    if scene.hv is None and any(one.name == "eps_r" for one in wanted):
        raise ConfigError(f"--until {until!r}: {scene_path} has no [hv] instrument, so eps_r cannot be measured.")
    step = Learn(do="learn", until=until, at_most_min=at_most_s / 60.0, terms=terms)
    top = connected(scene, scene.specimen.specimen())[0.0][-1]
    protocol = framed(scene, certificates, [step], top, f"Until {', '.join(map(str, wanted))}")
    found = outlooks(scene, certificates, wanted, at_most_s, terms)
    lost = [one for one in found if one.best * SURE > one.wanted.relative]
    if lost:
        lines = "\n".join(
            f"  {one.wanted}: best in a day of the rig {percent(one.best)}, in the time given {percent(one.then)}. "
            f"Largest part that time does not change: {one.part[0]}, {percent(one.part[1])}."
            for one in lost
        )
        raise ConfigError(
            f"--until cannot be reached on {scene_path}, by the film that its material describes:\n{lines}\n"
            "  Ask for less; state that input better in the scene or calibrate it; or ask only for what time changes: "
            f'"{lost[0].wanted.name} {100 * lost[0].wanted.relative:g} % noise and zeros". Nothing was touched.'
        )
    return protocol_text(protocol), found


def outlooks(
    scene: Scene, certificates: Mapping[str, Certificate], wanted: Sequence[Wanted], at_most_s: float, terms: int
) -> list[Outlook]:
    """What is expected of each wish with the scene's film; time of holding at the best places, ways counted roughly."""
    specimen = believed_film(scene.specimen.specimen(), terms)
    grid = connected(scene, specimen)
    top_v = max(grid)
    sweep = uniform_sweep(scene, certificates, 600.0, grid[top_v][-1], top_v)
    curves = recorded(sweep, scene, certificates, specimen)
    stated = expected(curves, specimen.material)
    places = Places(
        specimen,
        np.concatenate([np.array(h) for h in grid.values()]),
        np.repeat(list(grid), [len(h) for h in grid.values()]),
        scene.rates["force"],
        of_one_sample(curves[0], scene, certificates),
        stated.stretch,
    )
    return [_outlook(one, stated, places, at_most_s) for one in wanted]


def of_one_sample(curve: Curve, scene: Scene, certificates: Mapping[str, Certificate]) -> Curve:
    """The curve with the noise of single samples: those of planned ones stand for several each."""
    known = errors_of(scene, certificates)
    return replace(curve, force_noise=known["force_noise"], displacement_noise=known.get("displacement_noise", 0.0))


def _outlook(wanted: Wanted, stated: Statement, places: Places, at_most_s: float) -> Outlook:
    quantity = stated.quantities[wanted.name]
    _, stays = wanted.of(quantity.value, quantity.budget)
    parts = {part: wanted.of(quantity.value, {part: size})[0] for part, size in quantity.budget.items()}
    part = max((one for one in parts if one not in BY_TIME), key=lambda one: parts[one], default="nothing")
    which = ("stiffness", "eps_r").index(wanted.name)
    places.weight = np.full(len(places.wanted), 1e-3)
    places.weight[which] = 1.0
    by_time = []
    for seconds in TRIED_S:
        shares = places.shared(float(seconds), range(places.h.size))[1]
        information = places.prior + (places.rows * shares[:, None]).T @ places.rows
        variance = places.wanted[which] @ np.linalg.solve(information, places.wanted[which])
        by_time.append(math.hypot(stays, math.sqrt(float(variance))))
    reached = [float(t) for t, one in zip(TRIED_S, by_time, strict=True) if one <= wanted.relative]
    then = float(np.interp(math.log(max(at_most_s / WAYS, TRIED_S[0])), np.log(TRIED_S), by_time))
    return Outlook(wanted, by_time[-1], then, WAYS * reached[0] if reached else math.inf, (part, parts.get(part, 0.0)))


def said(found: Sequence[Outlook], at_most_s: float) -> list[str]:
    """What the operator should know before the run begins."""
    lines = []
    for one in found:
        if one.seconds <= at_most_s:
            minutes = f"{one.seconds / 60:.2g} min" if one.seconds >= 60 else f"{one.seconds:.0f} s"
            lines.append(f"{one.wanted}: expected after about {minutes} of measuring.")
        else:
            lines.append(
                f"{one.wanted}: hardly within the time given; {percent(one.then)} are expected by then. "
                "The run ends when the time is out and says what it has reached."
            )
    return lines
