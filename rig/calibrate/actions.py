"""How calibration actions are carried out: generators that the engine's loop resumes once a turn.

Each standstill leaves in the log a phase ``standstill``, labelled with its standard, and a reference ``applied`` with
what was applied and its own standard uncertainty; each way of a glide leaves a phase ``way``. `rig.analysis.sensors`
needs nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

import numpy as np

from drivers.roles import ForceSample, Sample
from rig.actions import Turns, listening, pause, set_voltage, stand_still, take_down
from rig.base.errors import FaultError
from rig.operator.control import Question
from rig.protocol.plan import Action
from rig.sim.operator import Operator

if TYPE_CHECKING:
    from rig.engine.engine import Engine

MOST_STEPS = 200  # of a dummy pressed: more means that it gives way, or is not there
FIXTURES = {
    "film": "Mount the specimen.",
    "target": "Fix the target plate to the pusher, in the laser's range, so that nothing touches it.",
    "dummy": "Mount the rigid dummy and turn its screw until it just touches the pusher where it stands.",
    "none": "Clear the way before the pusher: nothing may touch it or the force sensor.",
}


def carry_out(engine: Engine, action: Action) -> Turns:
    """The generator that carries out a calibration action."""
    return _BY_KIND[action.kind](engine, action)


def _mount(engine: Engine, action: Action) -> Turns:
    fixture = action.label.removeprefix("mount: ")
    yield from take_down(engine, "the operator's hands come near")
    yield from _ask(engine, FIXTURES[fixture], lambda hands: hands.mount(fixture, engine.clock.now()))


def _weigh(engine: Engine, action: Action) -> Turns:
    have = action.parameters
    yield from _hang(engine, action)
    yield from pause(engine, have["settle"])
    _begin(engine, action, action.label)
    engine.recorder.reference("applied", have["applied"], have["applied_error"], "N")
    yield from pause(engine, have["average"])
    _end(engine, action)


def _creep(engine: Engine, action: Action) -> Turns:
    yield from _hang(engine, action)
    _phase(engine, action, "creeping", action.label, 0)
    yield from pause(engine, action.parameters["average"])
    _end(engine, action)


def _hang(engine: Engine, action: Action) -> Turns:
    have = action.parameters
    yield from take_down(engine, "the operator's hands come near")
    newtons, error = have["applied"], have["applied_error"]
    text = "Take all weights off the force sensor." if newtons == 0 else f"Hang {action.label} on the force sensor."
    yield from _ask(engine, text, lambda hands: hands.hang(newtons, error, action.label))


def _visit(engine: Engine, action: Action) -> Turns:
    have = action.parameters
    engine.move_stage(have["position"], action.speed)
    yield from stand_still(engine, action)
    yield from pause(engine, have["settle"])
    _begin(engine, action, action.label)
    assert engine.recorder.stage is not None
    engine.recorder.reference("applied", engine.recorder.stage.position, have["applied_error"], "m")
    yield from pause(engine, have["average"])
    _end(engine, action)


def _glide(engine: Engine, action: Action) -> Turns:
    have = action.parameters
    in_contact = have["contact"] > 0
    go: Callable[[float, float], None] = engine.move_to if in_contact else engine.move_stage
    if have["direction"] > 0:
        go(have["start"], action.speed)
        yield from stand_still(engine, action)
    _phase(engine, action, "way", action.label, int(have["direction"]))
    go(have["goal"], action.speed)
    yield from stand_still(engine, action)
    _end(engine, action)


def _press(engine: Engine, action: Action) -> Turns:
    have, recorder = action.parameters, engine.recorder
    force: list[float] = []

    def listen(sample: Sample) -> None:
        if isinstance(sample, ForceSample):
            force.append(recorder.quantity_of(sample))

    def stand(direction: int, cycle: int) -> Turns:
        yield from pause(engine, have["settle"])
        assert recorder.stage is not None
        at = recorder.stage.position
        force.clear()
        _phase(engine, action, "standstill", f"{at * 1e6:.2f} um", direction, cycle)
        recorder.reference("applied", at, have["applied_error"], "m")
        with listening(engine, listen):
            yield from pause(engine, have["average"])
        _end(engine, action)
        if len(force) < 2:
            raise FaultError("force: no samples arrived while the dummy was pressed.")

    def step_to(position: float) -> Turns:
        engine.move_stage(position, action.speed)
        yield from stand_still(engine, action)

    assert recorder.stage is not None
    start = recorder.stage.position
    for cycle in range(1, int(have["cycles"]) + 1):
        taken = 0
        yield from stand(1, cycle)
        # The next step is taken only if, by what the last ones cost, it stays below the force asked for.
        first, rise = float(np.mean(force)), 0.0
        last = first
        while last + rise < have["force"]:
            taken += 1
            if taken > MOST_STEPS:
                raise FaultError(f"The dummy was pressed {MOST_STEPS} steps without reaching {have['force']:g} N.")
            yield from step_to(start + taken * have["step"])
            yield from stand(1, cycle)
            now = float(np.mean(force))
            rise, last = max(now - last, (now - first) / taken), now
        for down in range(taken - 1, -1, -1):
            yield from step_to(start + down * have["step"])
            yield from stand(-1, cycle)


def _meter(engine: Engine, action: Action) -> Turns:
    have = action.parameters
    yield from set_voltage(engine, action)
    if have["direction"] == 0:
        return
    _begin(engine, action, action.label)
    yield from pause(engine, have["average"])
    relative, absolute = have["relative"], have["absolute"]
    answer = yield from _ask(
        engine,
        f"Read the reference meter (about {action.voltage[1]:g} V) and type its voltage in V.",
        lambda hands: hands.read_meter(relative, absolute, engine.clock.now()),
    )
    try:
        volts = float(answer.replace(",", "."))
    except ValueError:
        raise FaultError(f"The reference meter's voltage was to be typed in V; {answer!r} is not a number.") from None
    engine.recorder.reference("applied", volts, absolute, "V")
    _end(engine, action)


def _ask(engine: Engine, text: str, by_hand: Callable[[Operator], object]) -> Generator[None, None, str]:
    """Ask the operator; on the simulated bench in memory its own pair of hands does it at once."""
    simulated = engine.bench.simulated
    if simulated is None:
        answer = yield from engine.ask(Question(text))
        return answer.text
    done = by_hand(simulated.operator)
    engine.event("operator", f"asked: {text}; done by the simulated operator" + ("" if done is None else f": {done}"))
    return "" if done is None else str(done)


def _begin(engine: Engine, action: Action, label: str) -> None:
    _phase(engine, action, "standstill", label, int(action.parameters["direction"]))


def _end(engine: Engine, action: Action) -> None:
    _phase(engine, action, action.kind, "done", 0)


def _phase(engine: Engine, action: Action, kind: str, label: str, direction: int, cycle: int | None = None) -> None:
    engine.recorder.phase(
        {
            "step": action.step,
            "kind": kind,
            "label": label,
            "cycle": action.cycle if cycle is None else cycle,
            "direction": direction,
            "voltage_V": action.voltage[1],
            "record": False,
        }
    )


_BY_KIND: dict[str, Callable[[Engine, Action], Turns]] = {
    "mount": _mount,
    "weigh": _weigh,
    "creep": _creep,
    "visit": _visit,
    "glide": _glide,
    "press": _press,
    "meter": _meter,
}
