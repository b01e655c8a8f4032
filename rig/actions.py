"""How each action of a plan is carried out: generators that the engine's loop resumes once a turn.

An action gives commands through the engine and yields until what it waits for has happened; the loop polls the
instruments and checks the limits between two turns. An action that takes much longer than planned is a fault.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.roles import DisplacementSample, ForceSample, HVFlag, Sample, Stage, StageSample
from rig.base.errors import FaultError, LimitError
from rig.calibrate.steps import CALIBRATION
from rig.engine.watch import check_zero
from rig.operator.control import Question
from rig.protocol.plan import Action
from rig.safety.guard import SAFE_VOLTAGE, TRIP, GuardState, flag_names

if TYPE_CHECKING:
    from rig.engine.engine import Engine

Turns = Generator[None, None, None]

PATIENCE = 1.5  # an action may take this many times its planned duration, and GRACE_S more
GRACE_S = 10.0
CONTACT_WINDOW_S = 0.25  # force is averaged over this long before it is held against the contact threshold
CONTACT_SIGMAS = 4.0  # the threshold must exceed the noise of that average this many times
HOMING_LIMIT_S = 90.0
ARRIVAL_M = 50e-6  # a stage that says it is done must be this near to where it was sent
# Towards contact the stage is sent in legs, so that it stops by itself when nobody renews them: never further ahead of
# where it was measured than this and its braking distance. A new target replaces the one under way without a halt, and
# comes so early that a lost command is noticed and given again (0.25 s) before the stage brakes.
LEG_S, LEAST_LEG_M = 0.5, 0.1e-3
RENEWED_WITH = 0.7  # of the leg left


def carry_out(engine: Engine, action: Action) -> Turns:
    """The generator that carries out ``action``."""
    if action.kind in CALIBRATION:
        from rig.calibrate.actions import carry_out as calibrate

        return calibrate(engine, action)
    if action.bias is not None:
        from rig.follow.actions import carry_out as follow

        return follow(engine, action)
    return _BY_KIND.get(action.kind, _move_or_voltage)(engine, action)


def _wait(engine: Engine, done: Callable[[], bool], limit: float, what: str) -> Turns:
    """Yield until ``done()``; a fault after ``limit`` seconds."""
    end = engine.clock.now() + limit
    while not done():
        if engine.clock.now() > end:
            raise FaultError(f"{what} did not happen within {limit:.0f} s.")
        yield


def pause(engine: Engine, duration: float) -> Turns:
    end = engine.clock.now() + duration
    while engine.clock.now() < end:
        yield


@contextmanager
def listening(engine: Engine, listener: Callable[[Sample], None]) -> Iterator[None]:
    """Within this context every sample is told to ``listener`` as it arrives."""
    engine.listener = listener
    try:
        yield
    finally:
        engine.listener = None


def _patience(action: Action) -> float:
    return action.duration * PATIENCE + GRACE_S


def _home(engine: Engine, action: Action) -> Turns:
    stage = engine.bench.stage
    engine.command("stage", "home", "")
    engine.recorder.speed = 0.0  # the device's own, not known here
    stage.home()
    yield from _wait(engine, lambda: not stage.moving, HOMING_LIMIT_S, "The end of the stage's homing")
    if not stage.referenced:
        raise FaultError("stage: homing ended, but the stage still reports no reference position.")


def _zero(engine: Engine, action: Action) -> Turns:
    """Mean of every unloaded sensor and its standard error, taken as independent samples."""
    recorder = engine.recorder
    force: list[float] = []
    laser: list[float] = []

    def listen(sample: Sample) -> None:
        if isinstance(sample, ForceSample):
            force.append(sample.reading)
        elif isinstance(sample, DisplacementSample):
            laser.append(sample.displacement)

    with listening(engine, listen):
        yield from pause(engine, action.parameters["duration"])
    zero, error = _mean(force, "force")
    check_zero(engine.limits, recorder.from_stored_zero(zero))
    recorder.force_zero = zero
    engine.learn("force", force)
    engine.learn("displacement", laser)
    engine.force_noise = error * math.sqrt(len(force)) * engine.gains.force
    recorder.reference("force_zero", recorder.force_zero, error, engine.bench.force.reading_unit)
    if recorder.has_laser:
        recorder.displacement_zero, error = _mean(laser, "displacement")
        recorder.reference("displacement_zero", recorder.displacement_zero, error, "m")


def _mean(readings: list[float], role: str) -> tuple[float, float]:
    values = np.array(readings)
    if len(values) < 10:
        raise FaultError(f"{role}: only {len(values)} samples arrived during the zero step; at least 10 are needed.")
    if not np.isfinite(values).all():
        raise FaultError(f"{role}: the sensor gave no valid value during the zero step; is it in range?")
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values)))


def _approach(engine: Engine, action: Action) -> Turns:
    """Advance until the averaged force exceeds the threshold; then work out where it began to rise.

    The stage advances in legs: if this program dies or hangs, it stops by itself at most one `leg` further on.

    With a laser the contact position is where the laser says zero. Without, it is the corner of the line
    ``max(0, k (x - x0))`` through the forces met on the way, each at the stage's position at its own time.
    """
    recorder, stage = engine.recorder, engine.bench.stage
    threshold = action.parameters["threshold"]
    n = max(4, round(CONTACT_WINDOW_S * engine.bench.force.rate))
    needed = CONTACT_SIGMAS * engine.force_noise / math.sqrt(n)
    if not threshold >= needed:
        raise LimitError(
            f"Step {action.step} (approach): threshold {threshold * 1e3:.3g} mN is lost in the force noise; "
            f"give threshold_mN of at least {needed * 1e3:.2g}."
        )
    start = action.parameters["start"]
    newest: deque[float] = deque(maxlen=n)

    def feel(sample: Sample) -> None:
        if isinstance(sample, ForceSample):
            newest.append(recorder.quantity_of(sample))

    def met_already() -> bool:
        return len(newest) == n and not abs(float(np.mean(newest))) <= threshold

    with listening(engine, feel):
        engine.move_stage(start, action.parameters["fast"])
        way_there = "The stage's way to where approaching begins"
        yield from _wait(engine, lambda: not stage.moving or met_already(), _patience(action), way_there)
    if met_already():
        raise FaultError(
            f"The pusher met something before {start * 1e3:g} mm, where approaching was to begin. "
            "Give the scene a smaller stage.approach_from_mm."
        )
    goal = min(start + action.parameters["max_travel"], stage.travel[1])
    way: list[tuple[float, float]] = []  # time and position of the stage
    met: list[tuple[float, float]] = []  # time and force

    def listen(sample: Sample) -> None:
        if isinstance(sample, StageSample):
            way.append((sample.t, sample.position))
        elif isinstance(sample, ForceSample):
            met.append((sample.t, recorder.quantity_of(sample)))

    with listening(engine, listen):
        length = leg(stage, action.speed)
        target, felt = min(start + length, goal), 0
        engine.move_stage(target, action.speed)
        end = engine.clock.now() + _patience(action)
        while not (mean := _mean_of_last(met, n)) > threshold:
            if mean < -threshold:
                raise FaultError(f"The force fell to {mean * 1e3:.1f} mN on the way to contact: its sign is wrong.")
            stands = not stage.moving
            if (stands and target == goal) or engine.clock.now() > end:
                raise FaultError(
                    f"The film was not met within {action.parameters['max_travel'] * 1e3:g} mm of travel. "
                    "Is the specimen mounted, and the force sensor connected?"
                )
            if stands:  # the loop was late to renew the leg, or something stopped the stage
                yield from _arrive(engine, target)
            left = target - way[-1][1] if way else length
            if target < goal and left < RENEWED_WITH * length and len(met) > felt:  # only on news of both
                target, felt = min(way[-1][1] + length, goal), len(met)
                engine.move_stage(target, action.speed)
            yield
        engine.stop_stage()
    yield from _wait(engine, lambda: not stage.moving, GRACE_S, "The stage's standstill")
    if recorder.has_laser:
        recorder.contact, error = yield from _contact_by_laser(engine)
    else:
        times, forces = np.array(met).T
        where = np.interp(times, *np.array(way).T)
        recorder.contact, error = _corner(where, forces)
        if recorder.contact <= where.min():
            raise FaultError("The force rose from the very beginning of the approach: contact was before it.")
    recorder.reference("contact_position", recorder.contact, error, "m")
    assert recorder.stage is not None
    back = abs(recorder.stage.position - recorder.contact)
    yield from _go(engine, 0.0, action.speed, back / action.speed * PATIENCE + GRACE_S)


def leg(stage: Stage, speed: float) -> float:
    """How far ahead of its measured position (m) the stage is sent towards contact at ``speed``."""
    return max(speed * LEG_S, LEAST_LEG_M) + stage.braking_distance(speed)


def _mean_of_last(met: list[tuple[float, float]], n: int) -> float:
    """Mean of the last ``n`` forces; 0 while there are fewer."""
    return float(np.mean([force for _, force in met[-n:]])) if len(met) >= n else 0.0


def _contact_by_laser(engine: Engine) -> Generator[None, None, tuple[float, float]]:
    """Stage position minus laser displacement at a standstill, and its standard error."""
    laser: list[float] = []
    recorder = engine.recorder

    def listen(sample: Sample) -> None:
        if isinstance(sample, DisplacementSample):
            laser.append(recorder.quantity_of(sample))

    with listening(engine, listen):
        yield from pause(engine, 0.5)
    displacement, error = _mean(laser, "displacement")
    assert recorder.stage is not None
    return recorder.stage.position - displacement, error


def _corner(x: NDArray[np.float64], force: NDArray[np.float64]) -> tuple[float, float]:
    """Least-squares corner x0 of ``max(0, k (x - x0))``, with a standard error from the residual's curvature."""
    candidates = np.linspace(x.min(), x.max(), 401)[:-1]
    ramp = np.maximum(x[:, None] - candidates, 0.0)
    norm = np.einsum("ij,ij->j", ramp, ramp)
    slope = np.maximum(force @ ramp, 0.0) / np.maximum(norm, 1e-30)
    cost = ((force[:, None] - slope * ramp) ** 2).sum(axis=0)
    best = int(np.argmin(cost))
    variance = cost[best] / max(len(x) - 2, 1)
    # One standard error is where the sum of squares has risen by one variance.
    inside = candidates[cost <= cost[best] + variance]
    step = candidates[1] - candidates[0]
    return float(candidates[best]), float(max(np.ptp(inside) / 2, step))


def _hold(engine: Engine, action: Action) -> Turns:
    yield from pause(engine, action.parameters["duration"])


def _move_or_voltage(engine: Engine, action: Action) -> Turns:
    if "settle" in action.parameters:
        yield from set_voltage(engine, action)
    elif action.moves:
        yield from _move(engine, action)


def _move(engine: Engine, action: Action) -> Turns:
    yield from _go(engine, action.h[1], action.speed, _patience(action))


def stand_still(engine: Engine, action: Action) -> Turns:
    """Wait until the stage says that it stands, and for its position there."""
    stage = engine.bench.stage
    yield from _wait(engine, lambda: not stage.moving, _patience(action), "The end of the stage's move")
    yield from pause(engine, 2 / engine.bench.scene.stage.poll_rate_Hz)


def _go(engine: Engine, h: float, speed: float, limit: float) -> Turns:
    """Move to displacement ``h`` and make sure that the stage says it is there."""
    stage, recorder = engine.bench.stage, engine.recorder
    engine.move_to(h, speed)
    yield from _wait(engine, lambda: not stage.moving, limit, "The end of the stage's move")
    yield from _arrive(engine, recorder.contact + h)


def _arrive(engine: Engine, target: float) -> Turns:
    """Make sure that a stage which says that it stands does so at ``target``, in metres of its own scale."""
    yield from pause(engine, 2 / engine.bench.scene.stage.poll_rate_Hz)
    assert engine.recorder.stage is not None
    missed = engine.recorder.stage.position - target
    if not abs(missed) <= ARRIVAL_M:
        raise FaultError(
            f"stage: it stands {missed * 1e3:+.3f} mm from where it was sent, and says that it is done. "
            "Did something stop it?"
        )


def set_voltage(engine: Engine, action: Action) -> Turns:
    """Ramp and wait for the *measured* voltage to arrive, then settle."""
    yield from _ramp_to(engine, action.voltage[1], _patience(action))
    yield from pause(engine, action.parameters["settle"])


def _ramp_to(engine: Engine, target: float, limit: float) -> Turns:
    """Ramp, and wait until the measured voltage is there. A guard that is SAFE needs the operator's confirmation."""
    guard = engine.guard
    if guard is not None and guard.state is GuardState.SAFE:
        if target == 0.0:
            return  # off and measured so: nothing to arm for
        yield from confirm_voltage(engine)
    tolerance = max(10.0, 0.01 * target)
    engine.request_voltage(target)

    def arrived() -> bool:
        sample = engine.recorder.hv
        return (
            sample is not None
            and HVFlag.RAMPING not in sample.flags
            and math.isclose(sample.setpoint, target, rel_tol=1e-5, abs_tol=1e-3)  # it is single precision there
            and abs(sample.voltage - target) <= tolerance
        )

    yield from _wait(engine, arrived, limit, f"The measured voltage's arrival at {target:g} V")


def _prompt(engine: Engine, action: Action) -> Turns:
    """Ask the operator; whoever is asked may touch the rig, so the voltage is off and latched before."""
    yield from take_down(engine, "the operator is asked")
    yield from engine.ask(Question(action.label))


def confirm_voltage(engine: Engine) -> Turns:
    """The second key: the operator types the highest voltage. Nothing is asked while his last word still holds."""
    highest = engine.highest_voltage
    if engine.arming.allows(highest):
        return
    engine.arming.withdraw()
    yield from _clear_faults(engine)
    words = f"High voltage up to {highest:g} V. Lid closed, interlock closed, nobody touching the specimen?"
    said = yield from engine.ask(Question(words, expected=f"{highest:g}"))
    engine.arming.confirm(highest, f"{said}")


def _clear_faults(engine: Engine) -> Turns:
    """What the supply has latched (an earlier emergency off, a trip) is cleared only when the operator says so."""
    guard = engine.guard
    if guard is None or guard.last is None or not guard.last.flags & TRIP:
        return
    words = f"hv: the supply has latched: {flag_names(guard.last.flags & TRIP)}."
    if engine.control.unattended:
        raise FaultError(f"{words} Nobody is there to find the cause and remove it; nothing was cleared.")
    words += " Cause found and removed?"
    said = yield from engine.ask(Question(words, expected="clear"))
    guard.clear_faults(str(said))
    last = guard.last
    yield from _wait(engine, lambda: guard.last is not last and guard.last is not None, GRACE_S, "A new measurement")


def choose_about_live_output(engine: Engine) -> Turns:
    """A supply found live is reported and left alone; the operator may choose to have it taken down."""
    guard = engine.guard
    assert guard is not None
    if guard.last is None or (abs(guard.last.voltage) < SAFE_VOLTAGE and HVFlag.ON not in guard.last.flags):
        return
    found = f"hv: the output is live, measured {guard.last.voltage:.0f} V, though nobody switched it on from here."
    engine.recorder.event("warning", "hv", found)
    said = engine.take_down
    if not said:
        if engine.control.unattended:
            return  # nobody can choose: the run ends with the output as it was found
        answer = yield from engine.ask(Question(f"{found} Nothing was changed. Ramp it down to zero?", "take down"))
        said = str(answer)
    limit = guard.ramp_duration * PATIENCE + GRACE_S
    guard.take_down(f"found live; {said}")
    yield from _until_off(engine, limit)


def take_down(engine: Engine, cause: str) -> Turns:
    """Ramp the voltage down, latch, and yield until it has been measured off.

    The operator's word is used up in any case: from here on somebody may touch the rig.
    """
    engine.arming.withdraw()
    guard = engine.guard
    if guard is None or guard.state is GuardState.SAFE:
        return
    limit = guard.ramp_duration * PATIENCE + GRACE_S
    guard.ramp_off(cause)
    yield from _until_off(engine, limit)


def _until_off(engine: Engine, limit: float) -> Turns:
    guard = engine.guard
    assert guard is not None

    def off() -> bool:
        return guard.output_is_safe and guard.last is not None and HVFlag.ON not in guard.last.flags

    yield from _wait(engine, off, limit, "The supply's way to zero")
    assert guard.last is not None
    engine.event("hv", f"off, measured {guard.last.voltage:.1f} V")


def rest(engine: Engine, action: Action) -> Turns:
    """The operator's pause: stage standing, voltage measured off, until he continues; then back to where ``action``
    begins, with its voltage, so that it can be carried out anew. He may ask for another pause on the way back."""
    while True:
        engine.stop_stage()
        yield from _wait(engine, lambda: not engine.bench.stage.moving, GRACE_S, "The stage's standstill")
        yield from take_down(engine, "the operator's pause")
        engine.control.say("Paused: the stage stands" + (", the voltage is off." if engine.guard is not None else "."))
        while engine.control.pausing:
            yield
        engine.event("operator", "continues")
        with closing(_regain(engine, action)) as turns:
            for _ in turns:
                yield
                if engine.control.pausing:
                    engine.event("operator", f"paused again by {engine.control.pausing}")
                    break
            else:
                return


def _regain(engine: Engine, action: Action) -> Turns:
    """Voltage and displacement with which ``action`` begins."""
    voltage, hv = action.voltage[0], engine.bench.scene.hv
    if hv is not None and voltage > 0 and (action.voltage[1] > 0 or action.moves):
        yield from _ramp_to(engine, voltage, voltage / hv.ramp_V_per_s * PATIENCE + GRACE_S)
    if action.moves and action.kind != "return":
        way = abs(action.h[0] - engine.recorder.displacement)
        yield from _go(engine, action.h[0], action.speed, way / action.speed * PATIENCE + GRACE_S)


def _return(engine: Engine, action: Action) -> Turns:
    if "settle" in action.parameters:
        yield from set_voltage(engine, action)
        return
    yield from _move(engine, action)
    engine.recorder.contact = math.nan


_BY_KIND: dict[str, Callable[[Engine, Action], Turns]] = {
    "home": _home,
    "zero": _zero,
    "approach": _approach,
    "hold": _hold,
    "prompt": _prompt,
    "return": _return,
}
