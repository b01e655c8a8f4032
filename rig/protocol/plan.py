"""From protocol steps to actions: what the engine will do, how long it takes, and what the model predicts of it.

Every action goes from one displacement and voltage to another; that is what the limits are checked on before
anything moves, and what the engine then carries out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from rig.base.errors import ConfigError, LimitError
from rig.protocol import protocol as steps
from rig.safety.limits import Limits
from rig.scene.scene import Scene
from rig.steps.follow import Follow

if TYPE_CHECKING:
    from model.actuator.bias import Bias

HOMING_S = 20.0  # only for the estimate: a long-travel stage at its homing speed
REGAIN_SPEED = 2e-3  # m/s, on the way back to where a resumed step begins
POINTS = 13  # displacements per action at which the prediction is made


@dataclass(frozen=True)
class Action:
    """One thing the engine does.

    ``kind`` is the protocol step it came from. ``h`` and ``voltage`` are (before, after) in metres and volts;
    ``speed`` in m/s for moves; ``duration`` is the expected time in seconds. ``record`` is True where the
    samples are data of the film: the fit takes these. ``bias`` is the law that a follow step plays.
    """

    step: int
    kind: str
    label: str
    h: tuple[float, float]
    voltage: tuple[float, float]
    duration: float
    speed: float = 0.0
    cycle: int = 0
    record: bool = False
    parameters: dict[str, float] = field(default_factory=dict)
    bias: Bias | None = None

    @property
    def moves(self) -> bool:
        """Whether the stage moves along the film's axis, from one known displacement to another."""
        return self.speed > 0 and self.h[0] != self.h[1]

    @property
    def direction(self) -> int:
        """+1 loading, -1 unloading, 0 standing."""
        return int(np.sign(self.h[1] - self.h[0])) if self.moves else 0


@dataclass(frozen=True)
class Prediction:
    """The extremes that the model expects during one action, with the scene's guess of the material."""

    peak_force: float
    peak_field: float
    minimum_hoop_stress: float
    stored_energy: float
    status: Status


def plan(protocol: steps.Protocol, scene: Scene) -> list[Action]:
    """All actions of ``protocol`` on ``scene``, in order.

    Raises
    ------
    LimitError
        When the protocol needs what the scene does not have (a voltage without ``[hv]``), or asks for steps in an
        order that cannot work. Numerical limits are checked by `check_plan`.
    """
    return list(_actions(enumerate(protocol.step, start=1), scene))


@dataclass(frozen=True)
class Regain:
    """Back to the displacement (m) and the voltage with which a resumed step begins."""

    h: float
    voltage: float
    speed: float
    do: str = "resume"


def plan_from(protocol: steps.Protocol, scene: Scene, first: int, skipped: Collection[int] = ()) -> list[Action]:
    """The actions from step ``first`` on, with what has to be done again before it.

    Home, zero and approach are done again, and the preconditioning of the film in contact, but for the steps
    ``skipped``; then the displacement and the voltage are regained with which the step begins.

    Raises
    ------
    ConfigError
        There is no such step.
    LimitError
        As `plan`.
    """
    numbered = list(enumerate(protocol.step, start=1))
    whole = plan(protocol, scene)
    if not 1 <= first <= len(numbered):
        raise ConfigError(f"The protocol has no step {first} to go on with.")
    while first <= len(numbered) and isinstance(numbered[first - 1][1], steps.Return):
        first += 1  # the way back has been done again with the reference position
    begin = next((action for action in whole if action.step >= first), None)
    if begin is None:
        raise ConfigError("Nothing but the way back is left to be done of this protocol.")
    done, left = numbered[: first - 1], numbered[first - 1 :]
    since = max((number for number, step in done if isinstance(step, steps.Return)), default=0)
    again: dict[int, steps.Step] = {}
    for kind in (steps.Home, steps.Zero):  # the last of each, wherever it was
        again |= dict([entry for entry in done if isinstance(entry[1], kind)][-1:])
    if any(isinstance(step, steps.Approach) for number, step in done if number > since):
        for number, step in done:
            if number > since and isinstance(step, steps.Approach | steps.Precondition) and number not in skipped:
                again[number] = step
    before: list[tuple[int, steps.Step | Regain]] = sorted(again.items())
    if begin.h[0] > 0 or begin.voltage[0] > 0:
        speed = min(REGAIN_SPEED, scene.limits.speed_mm_per_s * 1e-3)
        before.append((first, Regain(begin.h[0], begin.voltage[0], speed)))
    return list(_actions([*before, *left], scene))


def _actions(numbered: Iterable[tuple[int, steps.Step | Regain]], scene: Scene) -> Iterator[Action]:
    h, v = 0.0, 0.0
    homed = zeroed = contact = False
    ramp_rate = scene.hv.ramp_V_per_s if scene.hv is not None else float("inf")

    def voltage_to(number: int, kind: str, target: float, settle: float) -> Action:
        duration = abs(target - v) / ramp_rate + settle
        label = f"voltage to {target:g} V"
        return Action(number, kind, label, (h, h), (v, target), duration, parameters={"settle": settle})

    def move_to(number: int, kind: str, target: float, speed: float, cycle: int, record: bool) -> Action:
        label = f"{h * 1e3:g} to {target * 1e3:g} mm at {v:g} V"
        duration = abs(target - h) / speed
        return Action(number, kind, label, (h, target), (v, v), duration, speed, cycle, record)

    for number, step in numbered:
        kind = step.do
        wanted = max([*getattr(step, "voltages_V", []), getattr(step, "voltage_V", 0.0)])
        if wanted > 0 and scene.hv is None:
            raise LimitError(f"Step {number} ({kind}) asks for {wanted:g} V, but the scene has no [hv] instrument.")
        if kind in ("precondition", "ramp", "sweep", "voltage") and not contact:
            raise LimitError(f"Step {number} ({kind}) needs the contact position: put an approach step before it.")
        if isinstance(step, steps.Home):
            if contact:
                raise LimitError(f"Step {number} (home) would drive the stage with the specimen in contact.")
            homed = True
            yield Action(number, kind, "find the reference position", (0, 0), (0, 0), HOMING_S)
        elif isinstance(step, steps.Zero):
            if contact:
                raise LimitError(f"Step {number} (zero) must come before the approach, with nothing touching.")
            zeroed = True
            yield Action(
                number,
                kind,
                "average the unloaded sensors",
                (0, 0),
                (0, 0),
                step.duration_s,
                parameters={"duration": step.duration_s},
            )
        elif isinstance(step, steps.Approach):
            if contact or v > 0:
                raise LimitError(
                    f"Step {number} (approach) comes in contact or with voltage; put a return step before."
                )
            if not (homed and zeroed):
                raise LimitError(f"Step {number} (approach) needs a home and a zero step before it.")
            contact = True
            speed, fast = step.speed_mm_per_s * 1e-3, scene.limits.speed_mm_per_s * 1e-3
            start, travel = scene.stage.approach_from_mm * 1e-3, step.max_travel_mm * 1e-3
            yield Action(
                number,
                kind,
                "advance to contact",
                (0, 0),
                (0, 0),
                start / fast + travel / speed,
                speed,
                parameters={
                    "threshold": step.threshold_mN * 1e-3,
                    "start": start,
                    "fast": fast,
                    "max_travel": travel,
                },
            )
        elif isinstance(step, steps.Precondition):
            if v > 0:
                raise LimitError(f"Step {number} (precondition) comes with {v:g} V on; put the voltage to 0 first.")
            top = step.displacement_mm * 1e-3
            for cycle in range(1, step.cycles + 1):
                for target in (top, 0.0):
                    yield move_to(number, kind, target, step.speed_mm_per_s * 1e-3, cycle, record=False)
                    h = target
        elif isinstance(step, steps.Ramp):
            target = step.displacement_mm * 1e-3
            yield move_to(number, kind, target, step.speed_mm_per_s * 1e-3, 0, record=True)
            h = target
        elif isinstance(step, steps.Hold):
            label = f"hold {h * 1e3:g} mm, {v:g} V"
            parameters = {"duration": step.duration_s}
            yield Action(number, kind, label, (h, h), (v, v), step.duration_s, record=contact, parameters=parameters)
        elif isinstance(step, steps.Prompt):
            if v > 0:
                raise LimitError(f"Step {number} (prompt) comes with {v:g} V on; put the voltage to 0 first.")
            yield Action(number, kind, step.text, (h, h), (0, 0), 0.0)
        elif isinstance(step, steps.Voltage):
            yield voltage_to(number, kind, step.voltage_V, step.settle_s)
            v = step.voltage_V
        elif isinstance(step, steps.Sweep):
            start, top, speed = step.from_mm * 1e-3, step.displacement_mm * 1e-3, step.speed_mm_per_s * 1e-3
            if not start < top:
                raise LimitError(f"Step {number} (sweep): from_mm must be smaller than displacement_mm.")
            passes: dict[float, int] = {}
            for level in step.voltages_V:
                if h != start:
                    yield move_to(number, kind, start, speed, 0, record=False)
                    h = start
                if level != v:
                    yield voltage_to(number, kind, level, step.settle_s)
                    v = level
                # A level that comes again goes on counting its cycles.
                first = passes.get(level, 0) + 1
                passes[level] = first + step.cycles - 1
                for cycle in range(first, first + step.cycles):
                    for target in (top, start):
                        yield move_to(number, kind, target, speed, cycle, record=True)
                        h = target
            if v > 0:
                yield voltage_to(number, kind, 0.0, step.settle_s)
                v = 0.0
        elif isinstance(step, Regain):
            if step.h != h:
                yield move_to(number, kind, step.h, step.speed, 0, record=False)
                h = step.h
            if step.voltage > 0:
                yield voltage_to(number, kind, step.voltage, 1.0)
                v = step.voltage
        elif isinstance(step, steps.Return):
            if v > 0:
                yield voltage_to(number, kind, 0.0, 0.0)
                v = 0.0
            target = -step.clearance_mm * 1e-3 if contact else 0.0
            speed = step.speed_mm_per_s * 1e-3
            if contact:
                yield Action(number, kind, "back from the film", (h, target), (0, 0), abs(target - h) / speed, speed)
            h, contact = 0.0, False
        elif isinstance(step, Follow):
            from rig.follow.plan import actions as follow_actions

            if not contact or v > 0:
                raise LimitError(f"Step {number} (follow) begins in contact with the film and at 0 V.")
            for action in follow_actions(number, step, scene, h):
                yield action
                h = action.h[1]
        else:
            from rig.calibrate.plan import actions as calibration_actions

            yield from calibration_actions(number, step, scene, homed=homed, contact=contact)


def predict(action: Action, specimen: Specimen, parallel_capacitance: float = 0.0) -> Prediction:
    """What the model expects during ``action``: extremes over its displacements at both of its voltages."""
    h = np.linspace(max(action.h[0], 0.0), max(action.h[1], 0.0), POINTS if action.moves else 1)
    voltage = np.array(sorted(set(action.voltage)))[:, None]
    states = solve_many(specimen, h, voltage)
    return Prediction(
        peak_force=float(np.max(states.force)),
        peak_field=float(np.max(states.peak_field)),
        minimum_hoop_stress=float(np.min(states.min_hoop_stress)),
        stored_energy=_stored_energy(specimen, float(h.max()), max(action.voltage), parallel_capacitance),
        status=Status(int(np.max(states.status))),
    )


def _stored_energy(specimen: Specimen, h: float, voltage: float, beside: float) -> float:
    """0.5 C V^2 (J) where the film is stretched the most; NaN where the model has no state."""
    if voltage == 0.0:
        return 0.0
    state = solve(specimen, h, voltage)
    return 0.5 * (state.capacitance() + beside) * voltage**2 if state.answered else math.nan


def check_plan(actions: list[Action], scene: Scene) -> list[Prediction]:
    """Predict every action and hold it against the scene's limits.

    Raises
    ------
    LimitError
        Naming the step, the quantity, its value and its limit; NaN fails every limit.
    """
    limits = Limits.of(scene)
    specimen = scene.specimen.specimen()
    predictions = []
    known: dict[object, Prediction] = {}  # a cycle is predicted once
    for action in actions:
        where = f"Step {action.step} ({action.kind}, {action.label})"
        limits.displacement.check(max(action.h), where)
        limits.speed.check(action.speed, where)
        for level in action.voltage:
            limits.voltage.check(level, where)
            if scene.hv is not None and scene.hv.whole_volts and level != round(level):
                raise LimitError(f"{where}: the {scene.hv.driver} supply takes whole volts only.")
        path = (frozenset(action.h), frozenset(action.voltage), action.moves)
        if path not in known:
            known[path] = predict(action, specimen, limits.parallel_capacitance)
        prediction = known[path]
        no_taut_state = f"{where}: the model has no taut state there. {prediction.status.message}"
        if prediction.status not in (Status.TAUT, Status.WRINKLED):
            raise LimitError(no_taut_state)
        limits.force.check(prediction.peak_force, f"{where}, predicted")
        limits.field.check(prediction.peak_field, f"{where}, predicted")
        limits.hoop_stress.check(prediction.minimum_hoop_stress, f"{where}, predicted")
        limits.energy.check(prediction.stored_energy, f"{where}, predicted")
        if prediction.status is Status.WRINKLED:
            raise LimitError(no_taut_state)
        predictions.append(prediction)
    return predictions
