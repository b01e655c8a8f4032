"""Actions that several steps are made of: a move of the disk, and a change of the voltage."""

from __future__ import annotations

from dataclasses import dataclass

from rig.scene.scene import Scene
from rig.steps.base import Action, State, Step, Turns
from rig.steps.output import ramp_to
from rig.steps.rig import Rig
from rig.steps.turns import go, pause


@dataclass(frozen=True, kw_only=True)
class Move(Action):
    """The disk from one displacement to another at constant speed and voltage."""

    def carry_out(self, rig: Rig) -> Turns:
        if self.moves:
            yield from go(rig, self.h[1], self.speed, self.allowed_s)


@dataclass(frozen=True, kw_only=True)
class ChangeVoltage(Action):
    """Ramp and wait for the *measured* voltage to arrive, then ``settle`` seconds; the disk stays where it is."""

    settle: float

    def carry_out(self, rig: Rig) -> Turns:
        yield from ramp_to(rig, self.voltage[1], self.allowed_s)
        yield from pause(rig, self.settle)


def move_to(by: Step, state: State, target: float, speed: float, *, cycle: int = 0, record: bool = False) -> Move:
    """The move from where the plan stands to displacement ``target`` (m) at ``speed`` (m/s)."""
    start, state.h = state.h, target
    label = f"{start * 1e3:g} to {target * 1e3:g} mm at {state.voltage:g} V"
    return Move(
        by=by,
        step=state.number,
        label=label,
        h=(start, target),
        voltage=(state.voltage, state.voltage),
        duration=abs(target - start) / speed,
        speed=speed,
        cycle=cycle,
        record=record,
    )


def voltage_to(by: Step, state: State, scene: Scene, target: float, settle: float) -> ChangeVoltage:
    """The ramp from the voltage at which the plan stands to ``target`` (V)."""
    before, state.voltage = state.voltage, target
    return ChangeVoltage(
        by=by,
        step=state.number,
        label=f"voltage to {target:g} V",
        h=(state.h, state.h),
        voltage=(before, target),
        duration=ramp_duration(scene, before, target) + settle,
        settle=settle,
    )


def ramp_duration(scene: Scene, before: float, after: float) -> float:
    """Seconds that the supply takes from ``before`` to ``after`` (V); 0 where the scene has none."""
    return abs(after - before) / scene.hv.ramp_V_per_s if scene.hv is not None else 0.0
