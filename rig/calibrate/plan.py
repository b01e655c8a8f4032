"""From calibration steps to actions of the engine, each held against the scene's limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rig.base.errors import LimitError
from rig.calibrate import steps
from rig.protocol.plan import Action
from rig.scene.scene import Scene

OPERATOR_S = 10.0  # for the estimate: what an operator takes to do what he is asked
PRESS_STEPS = 20  # for the estimate: how many steps pressing a dummy takes
STILL = NOTHING = (0.0, 0.0)


def actions(number: int, step: steps.Step, scene: Scene, *, homed: bool, contact: bool) -> Iterator[Action]:
    """The actions of one calibration step.

    Raises
    ------
    LimitError
        When a standard is beyond the scene's limits, or the step comes where it cannot work.
    """
    kind = step.do
    where = f"Step {number} ({kind})"
    if contact and not isinstance(step, steps.Glide):
        raise LimitError(f"{where} must not come in contact with the film: put a return step before it.")
    if isinstance(step, steps.Visit | steps.Glide | steps.Press) and not homed:
        raise LimitError(f"{where} needs a home step before it.")
    match step:
        case steps.Mount():
            yield Action(number, kind, f"mount: {step.fixture}", STILL, NOTHING, OPERATOR_S)
        case steps.Weigh():
            yield from _weigh(number, step, scene)
        case steps.Visit():
            yield from _visit(number, step, scene)
        case steps.Glide():
            yield from _glide(number, step, scene, contact)
        case steps.Press():
            _check_speed(where, step.speed_mm_per_s, scene)
            if not step.force_N <= scene.limits.force_N:
                raise LimitError(f"{where}: force_N is beyond limits.force_N.")
            parameters = {
                **_averaging(step),
                "force": step.force_N,
                "step": step.step_um * 1e-6,
                "cycles": float(step.cycles),
                "applied_error": step.accuracy_um * 1e-6,
            }
            duration = PRESS_STEPS * (step.settle_s + step.average_s) * step.cycles
            speed = step.speed_mm_per_s * 1e-3
            yield Action(number, kind, f"to {step.force_N:g} N", STILL, NOTHING, duration, speed, parameters=parameters)
        case steps.Meter():
            yield from _meter(number, step, scene)


def _weigh(number: int, step: steps.Weigh, scene: Scene) -> Iterator[Action]:
    buoyed = step.gravity_m_per_s2 * (1 - step.air_density_kg_per_m3 / step.density_kg_per_m3)
    heaviest = max(step.weights_g)
    force = heaviest * 1e-3 * buoyed
    if not force <= scene.limits.force_N:
        raise LimitError(f"Step {number} (weigh): {heaviest:g} g pull with {force:.3g} N, and limits.force_N is less.")

    def hang(kind: str, mass: float, duration: float, cycle: int, direction: int) -> Action:
        parameters = {
            **_averaging(step),
            "applied": mass * 1e-3 * buoyed,
            "applied_error": step.weight_uncertainty_mg * 1e-6 * buoyed if mass > 0 else 0.0,
            "direction": float(direction),
        }
        if kind == "creep":
            parameters["average"] = duration
        duration += OPERATOR_S
        return Action(number, kind, f"{mass:g} g", STILL, NOTHING, duration, cycle=cycle, parameters=parameters)

    each = step.settle_s + step.average_s
    for _ in range(step.preloads):
        yield hang("weigh", heaviest, each, 0, 0)
        yield hang("weigh", 0.0, each, 0, 0)
    for cycle, direction, mass in series(step.weights_g, step.cycles):
        yield hang("weigh", mass, each, cycle, direction)
    if step.creep_s > 0:
        yield hang("creep", heaviest, step.creep_s, 0, 0)
        yield hang("weigh", 0.0, each, 0, 0)


def _visit(number: int, step: steps.Visit, scene: Scene) -> Iterator[Action]:
    _check_speed(f"Step {number} (visit)", step.speed_mm_per_s, scene)
    before = 0.0
    for cycle, direction, position in series(step.positions_mm, step.cycles):
        duration = abs(position - before) / step.speed_mm_per_s + step.settle_s + step.average_s
        before = position
        parameters = {
            **_averaging(step),
            "position": position * 1e-3,
            "applied_error": step.accuracy_um * 1e-6,
            "direction": float(direction),
        }
        label, speed = f"{position:g} mm", step.speed_mm_per_s * 1e-3
        yield Action(number, "visit", label, STILL, NOTHING, duration, speed, cycle, parameters=parameters)


def _glide(number: int, step: steps.Glide, scene: Scene, contact: bool) -> Iterator[Action]:
    where = f"Step {number} (glide)"
    if contact and not step.to_mm <= scene.limits.displacement_mm:
        raise LimitError(f"{where}: {step.to_mm:g} mm is beyond limits.displacement_mm.")
    for speed in step.speeds_mm_per_s:
        _check_speed(where, speed, scene)
        duration = (step.to_mm - step.from_mm) / speed
        for cycle in range(1, step.cycles + 1):
            for start, goal, direction in ((step.from_mm, step.to_mm, 1), (step.to_mm, step.from_mm, -1)):
                parameters = {
                    "start": start * 1e-3,
                    "goal": goal * 1e-3,
                    "direction": float(direction),
                    "contact": float(contact),
                }
                label = f"{speed:g} mm/s to {goal:g} mm"
                yield Action(
                    number, "glide", label, STILL, NOTHING, duration, speed * 1e-3, cycle, parameters=parameters
                )


def _meter(number: int, step: steps.Meter, scene: Scene) -> Iterator[Action]:
    if scene.hv is None:
        raise LimitError(f"Step {number} (meter) needs an [hv] instrument in the scene.")
    before = 0.0
    for cycle, direction, level in [*series(step.voltages_V, step.cycles), (0, 0, 0.0)]:
        duration = abs(level - before) / scene.hv.ramp_V_per_s + step.settle_s + step.average_s + OPERATOR_S
        parameters = {
            **_averaging(step),
            "direction": float(direction),
            "relative": step.meter_relative_uncertainty,
            "absolute": step.meter_uncertainty_V,
        }
        voltage = (before, level)
        before = level
        yield Action(number, "meter", f"{level:g} V", STILL, voltage, duration, cycle=cycle, parameters=parameters)


def _averaging(step: steps.Averaged) -> dict[str, float]:
    return {"settle": step.settle_s, "average": step.average_s}


def series(standards: Sequence[float], cycles: int) -> list[tuple[int, int, float]]:
    """(cycle, direction, standard): each cycle rising through all of them, then falling."""
    rising = sorted(set(standards))
    return [
        (cycle, direction, one)
        for cycle in range(1, cycles + 1)
        for direction, order in ((1, rising), (-1, rising[::-1]))
        for one in order
    ]


def _check_speed(where: str, speed: float, scene: Scene) -> None:
    if not speed <= scene.limits.speed_mm_per_s:
        raise LimitError(f"{where}: {speed:g} mm/s is beyond limits.speed_mm_per_s.")
