"""From a follow step to actions: where the model expects the disk to rest at each voltage, and how hard to steer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from model.actuator.equilibrium import Actuator, balance, equilibria
from rig.base.errors import LimitError
from rig.protocol.plan import Action
from rig.scene.scene import Scene
from rig.steps.follow import Follow

# Part of the way to the balance that one cycle goes. With d cycles of delay between a move and the force that shows it
# the loop is stable below 2 sin(pi/(4 d + 2)) of the true stiffness: 0.35 for four cycles, that is 100 ms at 40 Hz.
PART = 0.2
STIFFNESS_POINTS = 33


def actions(number: int, step: Follow, scene: Scene, h: float) -> Iterator[Action]:
    """Release at 0 V, and for every voltage: ramp, release, ramp back, release back. ``h``: where the disk is (m).

    Raises
    ------
    LimitError
        When the model knows no rest within the scene's limits.
    """
    film = scene.specimen.specimen()
    actuator = Actuator(film, step.bias.bias(film))
    speed, ramp = step.speed_mm_per_s * 1e-3, scene.hv.ramp_V_per_s if scene.hv is not None else float("inf")
    top = scene.limits.displacement_mm * 1e-3
    stiffest = _stiffest(actuator, [0.0, *step.voltages_V], top)
    where = f"Step {number} (follow {step.bias.kind})"

    def release(start: float, voltage: float) -> tuple[Action, float]:
        rest = rest_from(actuator, start, voltage, top)
        if rest is None:
            raise LimitError(f"{where}: the model knows no rest at {voltage:g} V within limits.displacement_mm.")
        label = f"{step.bias.kind}, {voltage:g} V: from {start * 1e3:.2f} to {rest * 1e3:.2f} mm expected"
        parameters = {
            "gain": PART / stiffest,
            "rate": step.rate_Hz,
            "settle_time": step.settle_s,
            "average": step.average_s,
            "patience": step.patience_s,
        }
        duration = abs(rest - start) / speed + 2 * step.settle_s + step.average_s
        action = Action(
            number,
            "follow",
            label,
            (start, rest),
            (voltage, voltage),
            duration,
            speed,
            parameters=parameters,
            bias=actuator.bias,
        )
        return action, rest

    def voltage_to(at: float, before: float, after: float) -> Action:
        duration = abs(after - before) / ramp + step.settle_s
        label = f"voltage to {after:g} V, the disk held"
        parameters = {"settle": step.settle_s}
        return Action(number, "voltage", label, (at, at), (before, after), duration, parameters=parameters)

    action, h = release(h, 0.0)
    yield action
    for voltage in step.voltages_V:
        yield voltage_to(h, 0.0, voltage)
        action, h = release(h, voltage)
        yield action
        yield voltage_to(h, voltage, 0.0)
        action, h = release(h, 0.0)
        yield action


def rest_from(actuator: Actuator, start: float, voltage: float, top: float) -> float | None:
    """Where the disk comes to rest (m) when it is let go at ``start``; None where the model knows no such place.

    It goes the way that the excess of forces pushes it, to the first equilibrium.
    """
    low, high = actuator.span
    found = equilibria(actuator, voltage, span=(low, min(high, top))).found
    inside = min(max(start, low), min(high, top))
    at = balance([actuator], np.array([[inside]]), np.array([[voltage]]))
    outward = float(at.excess[0, 0]) < 0.0  # the bias is the stronger one
    ahead = [one.h for one in found if one.stable and (one.h >= inside if outward else one.h <= inside)]
    if not ahead:
        return None
    return min(ahead) if outward else max(ahead)


def _stiffest(actuator: Actuator, voltages: list[float], top: float) -> float:
    """Largest ``dF/dh - dB/dh`` (N/m) over the displacements allowed: no state asks for less caution."""
    low, high = actuator.span
    h = np.linspace(low + 1e-3 * (high - low), min(high, top), STIFFNESS_POINTS)
    grid = np.repeat(h[None], len(voltages), axis=0).reshape(1, -1)
    states = balance([actuator], grid, np.repeat(voltages, len(h))[None])
    stiffness = states.stiffness[states.known & np.isfinite(states.stiffness)]
    largest = float(stiffness.max(initial=-np.inf))
    if not largest > 0.0:
        raise LimitError("follow: with this bias no displacement is stable; the stage cannot play it.")
    return largest
