"""``dea-rig plan``: a protocol that tells most about the film in a given time of the rig, beside the uniform sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.identifiability import expected
from calibration.film.planning import LEAST_DWELL, Dwell, Places, one_term, propose
from calibration.film.propagation import Statement
from calibration.sensors.certificate import Certificate
from model.material.materials import Material
from model.specimen import Specimen
from rig.analysis.film import errors_of
from rig.base.errors import ConfigError, LimitError
from rig.protocol.experiment import certificates_of
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene, load_scene
from rig.steps.approach import Approach
from rig.steps.base import Step
from rig.steps.hold import Hold
from rig.steps.home import Home
from rig.steps.places import grid
from rig.steps.precondition import Precondition
from rig.steps.ramp import Ramp
from rig.steps.return_ import Return
from rig.steps.sweep import Sweep
from rig.steps.voltage import Voltage
from rig.steps.zero import Zero

Array = NDArray[np.float64]

WEIGHTS = (1.0, 3.0, 9.0)  # of the stiffness against the permittivity
SETTLE_S = 1.0  # after a voltage
ZERO_S = 3.0
SPEED_MM_PER_S = 5.0  # between places, where the scene allows it
MOST_SAMPLES = 5_000  # of a curve in the expected uncertainties; more are stood for by less noise


@dataclass(frozen=True)
class Design:
    """A protocol with its duration (s) and what it is expected to tell of the film.

    Relative standard uncertainties by quantity: ``combined`` is all told, ``random`` of noise and zeros alone.
    """

    protocol: Protocol
    duration: float
    combined: dict[str, float]
    random: dict[str, float]


@dataclass(frozen=True)
class Proposal:
    """The planned protocol and the uniform sweep in the same time.

    ``route`` is where the film is held and how long, ``text`` the protocol file. ``wanted`` names what it was made for.
    """

    planned: Design
    sweep: Design
    wanted: tuple[str, ...]
    route: list[Dwell]
    text: str

    @property
    def gain(self) -> float:
        """How many times as long the sweep would have to record for the same uncertainty, noise and zeros alone."""
        return min((self.sweep.random[name] / self.planned.random[name]) ** 2 for name in self.wanted)


def propose_protocol(scene_path: Path, time: float, film: Material | None = None, *, terms: int = 2) -> Proposal:
    """Plan ``time`` seconds of the rig for the scene in ``scene_path``.

    What is best to do depends on the film: ``film`` takes the place of the scene's material where more is known. It
    depends on the model, too: with ``terms = 1`` it is made for the film of one Ogden term like it, and then tells
    little to a fit with two.

    Raises
    ------
    ConfigError, LimitError
        When the scene cannot be used, or the time does not suffice for any two places.
    """
    scene, _ = load_scene(scene_path)
    certificates = certificates_of(scene, scene_path)
    specimen = scene.specimen.specimen()
    specimen = specimen if film is None else specimen.with_material(film)
    if terms == 1 and specimen.material.terms > 1:
        lp = specimen.prestretch
        specimen = specimen.with_material(one_term(specimen.material, (1.1 * lp, 1.4 * lp), lp))
    h, voltage, sweep_h, sweep_v = reachable(scene, specimen)
    fixed = _duration(framed(scene, certificates, [], float(h.max())), scene)
    if not time > fixed + 2.0 * LEAST_DWELL:
        raise LimitError(
            f"{time:.0f} s are not enough: homing, zero, approach, preconditioning and return take {fixed:.0f} s. "
            "Give more time."
        )
    sweep = uniform_sweep(scene, certificates, time, sweep_h, sweep_v)
    curves = recorded(sweep, scene, certificates, specimen)
    stated = expected(curves, specimen.material)
    known = errors_of(scene, certificates)  # of one sample: those of the curves stand for several each
    errors = replace(
        curves[0],
        force_noise=known["force_noise"],
        displacement_noise=known.get("displacement_noise", 0.0),
    )
    places = Places(specimen, h, voltage, scene.rates["force"], errors, stated.stretch)
    wanted = ("stiffness", "eps_r") if (voltage > 0.0).any() else ("stiffness",)
    uniform = _design(sweep, scene, stated, stated.stretch[0])
    best: Proposal | None = None
    for weight in WEIGHTS if len(wanted) > 1 else WEIGHTS[:1]:  # so that neither gains at the other's cost
        places.weight = np.array([weight, 1.0])[: len(wanted)]
        route = propose(places, time - fixed, lambda way: _travel(way, scene))
        if not route:
            continue
        protocol = _trimmed(scene, certificates, route, time)
        check_plan(plan(protocol, scene), scene)
        there = expected(recorded(protocol, scene, certificates, specimen), specimen.material)
        design = _design(protocol, scene, there, stated.stretch[0])
        title = f"# Planned for {scene.specimen.name}: {time / 60:.3g} min of the rig.\n"
        found = Proposal(design, uniform, wanted, route, title + protocol_text(protocol))
        if best is None or found.gain > best.gain:
            best = found
    if best is None:
        raise LimitError(f"{time:.0f} s are not enough to hold the film at two places; give more time.")
    return best


def reachable(scene: Scene, specimen: Specimen) -> tuple[Array, Array, float, float]:
    """Displacements and voltages at which the film may be held; displacement and voltage of the best uniform sweep."""
    places = grid(scene, specimen, sensitivities=True)
    h, voltage, allowed, slopes = places.h, places.voltage, places.allowed, places.states.dforce
    assert slopes is not None
    # A voltage that allows little displacement tells little: the sweep is at the one that tells most.
    here = {level: allowed & (voltage == level) for level in np.unique(voltage) if level > 0.0}
    told = {level: float(np.mean(slopes["eps_r"][rows] ** 2)) for level, rows in here.items() if rows.any()}
    best = max(told, key=lambda level: told[level], default=0.0)
    sweep_h = float(h[allowed & (voltage == best)].max())
    return h[allowed], voltage[allowed], sweep_h, float(best)


def framed(
    scene: Scene, certificates: Mapping[str, Certificate], middle: Sequence[Step], top_h: float, title: str = ""
) -> Protocol:
    """A protocol with ``middle`` as its measuring steps, framed by what every one needs."""
    speed = min(SPEED_MM_PER_S, scene.limits.speed_mm_per_s)
    window = max(4, round(0.25 * scene.rates["force"]))
    noise = certificates["force"].noise / math.sqrt(window)
    return Protocol(
        title=title,
        step=[
            Home(do="home"),
            Zero(do="zero", duration_s=ZERO_S),
            Approach(
                do="approach", speed_mm_per_s=min(0.5, speed), threshold_mN=math.ceil(6e3 * noise), max_travel_mm=10.0
            ),
            Precondition(do="precondition", displacement_mm=_mm(top_h), speed_mm_per_s=speed, cycles=2),
            *middle,
            Return(do="return", speed_mm_per_s=min(2.0, speed)),
        ],
    )


def uniform_sweep(
    scene: Scene, certificates: Mapping[str, Certificate], time: float, top_h: float, top_v: float
) -> Protocol:
    """The uniform sweep of Cao & Conn 2018: up and back at three voltages, as slowly as the time allows."""
    voltages = [0.0, *(float(round(share * top_v / 10.0) * 10.0) for share in (2.0 / 3.0, 1.0))] if top_v else [0.0]

    def at(speed: float) -> Protocol:
        sweep = Sweep(
            do="sweep", displacement_mm=_mm(top_h), speed_mm_per_s=speed, voltages_V=voltages, settle_s=SETTLE_S
        )
        return framed(scene, certificates, [sweep], top_h, "Uniform sweep")

    fast, slow = scene.limits.speed_mm_per_s, 1e-3
    if _duration(at(fast), scene) > time:
        raise LimitError(f"{time:.0f} s are not enough for a sweep at three voltages; give more time.")
    for _ in range(40):
        speed = math.sqrt(fast * slow)
        fast, slow = (speed, slow) if _duration(at(speed), scene) <= time else (fast, speed)
    return at(math.ceil(1e4 * fast) / 1e4)


def _trimmed(scene: Scene, certificates: Mapping[str, Certificate], route: Sequence[Dwell], time: float) -> Protocol:
    """The route as a protocol that takes no longer than ``time``, with what is left of it spent holding."""
    top_h = max(dwell.h for dwell in route)
    for _ in range(3):
        middle = _steps(route, scene)
        protocol = framed(scene, certificates, middle, top_h, f"Planned: {len(route)} holds")
        spare = time - _duration(protocol, scene)
        held = sum(dwell.seconds for dwell in route)
        route = [
            Dwell(dwell.voltage, dwell.h, math.floor(10.0 * dwell.seconds * (1.0 + spare / held)) / 10.0)
            for dwell in route
        ]
    return protocol


def _steps(route: Sequence[Dwell], scene: Scene) -> list[Step]:
    speed = min(SPEED_MM_PER_S, scene.limits.speed_mm_per_s)
    found: list[Step] = []
    h = voltage = 0.0
    for dwell in route:
        there = [Ramp(do="ramp", displacement_mm=_mm(dwell.h), speed_mm_per_s=speed)] if dwell.h != h else []
        changed = dwell.voltage != voltage
        charged = [Voltage(do="voltage", voltage_V=dwell.voltage, settle_s=SETTLE_S)] if changed else []
        # The film is moved at the lower voltage of the two: that it bears.
        found += [*charged, *there] if dwell.voltage < voltage else [*there, *charged]
        found.append(Hold(do="hold", duration_s=max(dwell.seconds, 0.1)))
        h, voltage = dwell.h, dwell.voltage
    return found


def _travel(route: Sequence[Dwell], scene: Scene) -> float:
    """Seconds that moving, ramping and settling take between the places of a route."""
    speed = 1e-3 * min(SPEED_MM_PER_S, scene.limits.speed_mm_per_s)
    ramp = scene.hv.ramp_V_per_s if scene.hv is not None else math.inf
    seconds = h = voltage = 0.0
    for dwell in route:
        seconds += abs(dwell.h - h) / speed
        if dwell.voltage != voltage:
            seconds += abs(dwell.voltage - voltage) / ramp + SETTLE_S
        h, voltage = dwell.h, dwell.voltage
    return seconds + h / speed + voltage / ramp


def _duration(protocol: Protocol, scene: Scene) -> float:
    return sum(action.duration for action in plan(protocol, scene))


def recorded(
    protocol: Protocol, scene: Scene, certificates: Mapping[str, Certificate], specimen: Specimen
) -> list[Curve]:
    """The curves that a run of the protocol will record, one for each voltage, forces left at zero."""
    force, laser = certificates["force"], certificates.get("displacement")
    rate = scene.rates["force"]
    errors = errors_of(scene, certificates)
    parts: dict[float, list[tuple[Array, Array]]] = {}
    for action in plan(protocol, scene):
        if action.record:
            h = np.linspace(*action.h, max(2, round(rate * action.duration)))
            parts.setdefault(action.voltage[1], []).append((h, np.full(h.size, action.direction)))
    curves = []
    for voltage, pieces in parts.items():
        h, direction = (np.concatenate(columns) for columns in zip(*pieces, strict=True))
        every = math.ceil(h.size / MOST_SAMPLES)
        less = math.sqrt(every)
        thinned = {
            **errors,
            "force_noise": errors["force_noise"] / less,
            "displacement_noise": errors.get("displacement_noise", 0.0) / less,
        }
        curves.append(
            Curve(
                label=f"{voltage:g} V",
                run="planned",
                specimen=specimen,
                h=h[::every],
                force=np.zeros(h[::every].size),
                voltage=np.full(h[::every].size, voltage),
                nominal_voltage=voltage,
                direction=direction[::every],
                force_zero=math.hypot(force.noise / math.sqrt(rate * ZERO_S), force.zero_uncertainty),
                displacement_zero=laser.zero_uncertainty if laser is not None else 0.0,
                **thinned,  # type: ignore[arg-type] # keys of CurveErrors
            )
        )
    return curves


def _design(protocol: Protocol, scene: Scene, stated: Statement, stretch: float) -> Design:
    """Uncertainties of the permittivity, and of the stiffness at ``stretch``."""
    curve = stated.stiffness_curve
    at = int(np.argmin(np.abs(np.array(curve.meridional_stretch) - stretch)))
    quantities = {"stiffness": stated.along[at]}
    if "eps_r" in stated.quantities:
        quantities["eps_r"] = stated.quantities["eps_r"]
    random = {
        name: math.hypot(*(quantity.budget.get(part, 0.0) for part in ("noise", "force zero", "displacement zero")))
        / abs(quantity.value)
        for name, quantity in quantities.items()
    }
    combined = {name: quantity.relative for name, quantity in quantities.items()}
    return Design(protocol, _duration(protocol, scene), combined, random)


def _mm(metres: float) -> float:
    return round(1e3 * metres, 2)


def protocol_text(protocol: Protocol) -> str:
    """The protocol as the TOML that `rig.protocol.protocol.load_protocol` reads."""
    lines = [f'title = "{protocol.title}"']
    for step in protocol.step:
        lines += ["", "[[step]]"]
        for key, value in step.model_dump().items():
            lines.append(f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}")
    return "\n".join(lines) + "\n"


def parse_time(text: str, option: str = "--time") -> float:
    """Seconds from ``10min``, ``90 s`` or ``1.5h``.

    Raises
    ------
    ConfigError
        Saying what is allowed.
    """
    number = text.strip().lower()
    for unit, seconds in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        if number.endswith(unit):
            try:
                time = float(number.removesuffix(unit)) * seconds
            except ValueError:
                break
            if 0.0 < time <= 86_400.0:
                return time
            break
    raise ConfigError(f"{option} {text!r}: give a time up to 24 hours with its unit: 10min, 300s or 1.5h.")
