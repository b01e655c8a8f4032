"""The closed loop: the stage moves until the film's measured force is the bias's at the measured displacement."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from drivers.roles import DisplacementSample, ForceSample, Sample
from rig.actions import Turns, listening, pause
from rig.base.errors import FaultError
from rig.protocol.plan import Action

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

    from model.actuator.bias import Bias
    from rig.engine.engine import Engine

SIGMAS = 2.0  # the mean excess must be zero within this many of its standard errors to be called a rest ...
NEAR_N = 0.3e-3  # ... or within this
POINTS = 129  # at which the law is solved before the disk is let go
STILL_M = 20e-6  # and the stage must not have gone further than this between the halves of the settling time


def carry_out(engine: Engine, action: Action) -> Turns:
    """Follow the law until the disk rests; then hold and average.

    In every cycle the stage's set-point moves by ``gain (B(h) - F)``, F the mean force since the last one, but never
    faster than the action's speed. What is measured while the stage holds still is the rest: the mean excess that is
    left says how far it is from the balance.
    """
    have, recorder, clock = action.parameters, engine.recorder, engine.clock
    assert action.bias is not None
    low, high = max(action.bias.reach[0], 0.0), min(action.bias.reach[1], engine.limits.displacement.high)
    law = _tabulated(action.bias, low, high)
    period = 1.0 / have["rate"]
    cycles = max(8, round(have["settle_time"] * have["rate"]))
    force: list[float] = []
    displacement: list[float] = []
    excess: deque[float] = deque(maxlen=cycles)
    goals: deque[float] = deque(maxlen=cycles)

    def listen(sample: Sample) -> None:
        if isinstance(sample, ForceSample) and not sample.flags:
            force.append(recorder.quantity_of(sample))
        elif isinstance(sample, DisplacementSample) and not sample.flags:
            displacement.append(recorder.quantity_of(sample))

    assert recorder.stage is not None
    goal = recorder.stage.position - recorder.contact
    end = clock.now() + have["patience"]
    due = clock.now()
    _phase(engine, action, "release")
    with listening(engine, listen):
        while not _at_rest(excess, goals, cycles):
            if clock.now() > end:
                swing = float(np.ptp(goals)) if goals else math.nan
                left = float(np.mean(excess)) if excess else math.nan
                raise FaultError(
                    f"{action.label}: no rest within {have['patience']:g} s: the force is "
                    f"{left * 1e3:+.2f} mN from its law, and the stage swings by {swing * 1e3:.2f} mm. Give the step a "
                    "lower rate_Hz or speed, or more patience_s."
                )
            if clock.now() < due or not force:
                yield
                continue
            due = max(due + period, clock.now())
            h = float(np.mean(displacement)) if displacement else recorder.displacement
            away = float(law(min(max(h, low), high))) - float(np.mean(force))
            force.clear()
            displacement.clear()
            if not math.isfinite(away):
                raise FaultError(f"{action.label}: no force of the law, or none measured, at {h * 1e3:.3f} mm.")
            reach = action.speed * period
            goal = min(max(goal + min(max(have["gain"] * away, -reach), reach), low), high)
            excess.append(away)
            goals.append(goal)
            engine.move_to(goal, action.speed)
            yield
    _phase(engine, action, "rest")
    yield from pause(engine, have["average"])
    _phase(engine, action, "rested")


def _tabulated(bias: Bias, low: float, high: float) -> CubicSpline:
    """The law as a smooth curve: a second cone takes longer to solve than a cycle lasts."""
    from scipy.interpolate import CubicSpline

    h = np.linspace(low, high, POINTS)
    force = bias.force(h)
    known = np.isfinite(force)
    if np.count_nonzero(known) < 4:
        raise FaultError("The bias has no law where the disk can go.")
    return CubicSpline(h[known], force[known], extrapolate=False)


def _at_rest(excess: deque[float], goals: deque[float], cycles: int) -> bool:
    """Whether the newest cycles were a rest: no force left over on average, and no way gone."""
    if len(excess) < cycles:
        return False
    values, way = np.array(excess), np.array(goals)
    error = float(values.std(ddof=1)) / math.sqrt(cycles)
    half = cycles // 2
    moved = abs(float(way[:half].mean() - way[half:].mean()))
    noise = float(way.std(ddof=1)) / math.sqrt(half)
    return abs(float(values.mean())) <= max(SIGMAS * error, NEAR_N) and moved <= max(STILL_M, SIGMAS * noise)


def _phase(engine: Engine, action: Action, kind: str) -> None:
    engine.recorder.phase(
        {
            "step": action.step,
            "kind": kind,
            "label": action.label,
            "cycle": 0,
            "direction": 0,
            "voltage_V": action.voltage[1],
            "record": False,
        }
    )
