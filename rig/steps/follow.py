"""``do = "follow"``: the stage in place of a spring, a mass or a second cone, around the real film."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from drivers.roles import DisplacementSample, ForceSample, Sample
from model.actuator.bias import Bias
from model.actuator.equilibrium import Actuator, balance, equilibria
from rig.base.errors import FaultError, LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, Positive, State, Step, Turns, write_phase
from rig.steps.bias_laws import BiasLaw
from rig.steps.moves import ChangeVoltage, ramp_duration
from rig.steps.rig import Rig
from rig.steps.turns import listening, pause

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

# Part of the way to the balance that one cycle goes. With d cycles of delay between a move and the force that shows it
# the loop is stable below 2 sin(pi/(4 d + 2)) of the true stiffness: 0.35 for four cycles, that is 100 ms at 40 Hz.
PART = 0.2
STIFFNESS_POINTS = 33
SIGMAS = 2.0  # the mean excess must be zero within this many of its standard errors to be called a rest ...
NEAR_N = 0.3e-3  # ... or within this
POINTS = 129  # at which the law is solved before the disk is let go
STILL_M = 20e-6  # and the stage must not have gone further than this between the halves of the settling time


class Follow(Step):
    """Let the disk go against a bias law: at rest without voltage, then released at each voltage and back.

    The stage does what the bias would: in each of ``rate_Hz`` cycles a second it moves by a part of the way that would
    make force of the law and measured force equal.
    """

    needs_contact: ClassVar[bool] = True

    do: Literal["follow"] = Field(description="The kind of step.")
    bias: BiasLaw = Field(description="The bias that the stage plays: a table with kind and that kind's keys.")
    voltages_V: list[Positive] = Field(
        min_length=1,
        max_length=50,
        description="Voltages in turn (V); between two of them the film rests at 0 V.",
        json_schema_extra={"usual": [5, 30000]},
    )
    rate_Hz: float = Field(
        default=40.0,
        ge=5.0,
        le=100.0,
        description="Cycles of the loop per second (Hz). Lower where the stage swings. Typical: 20 to 50.",
    )
    speed_mm_per_s: Positive = Field(
        default=1.0,
        description="Largest speed of the disk (mm/s). Typical: 0.5 to 2.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    settle_s: Positive = Field(
        default=1.0,
        description="How long force and law must agree for a rest (s). Typical: 1 to 5.",
        json_schema_extra={"usual": [0.01, 10000]},
    )
    average_s: Positive = Field(default=5.0, description="How long to measure each rest (s). Typical: 2 to 10.")
    patience_s: Positive = Field(default=60.0, description="After this long without a rest the run ends (s).")

    @property
    def highest_voltage(self) -> float:
        return max(self.voltages_V)

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        """Release at 0 V, and for every voltage: ramp, release, ramp back, release back."""
        if state.voltage > 0:
            raise LimitError(f"{self.where(state.number)} begins in contact with the film and at 0 V.")
        film = scene.specimen.specimen()
        actuator = Actuator(film, self.bias.bias(film))
        gain = PART / _stiffest(actuator, [0.0, *self.voltages_V], scene.limits.displacement_mm * 1e-3)
        yield self._release(state, scene, actuator, gain)
        for voltage in self.voltages_V:
            yield self._voltage(state, scene, voltage)
            yield self._release(state, scene, actuator, gain)
            yield self._voltage(state, scene, 0.0)
            yield self._release(state, scene, actuator, gain)

    def _release(self, state: State, scene: Scene, actuator: Actuator, gain: float) -> Following:
        rest = rest_from(actuator, state.h, state.voltage, scene.limits.displacement_mm * 1e-3)
        if rest is None:
            raise LimitError(
                f"Step {state.number} (follow {self.bias.kind}): the model knows no rest at {state.voltage:g} V within "
                "limits.displacement_mm."
            )
        start, state.h = state.h, rest
        speed = self.speed_mm_per_s * 1e-3
        return Following(
            by=self,
            step=state.number,
            label=f"{self.bias.kind}, {state.voltage:g} V: from {start * 1e3:.2f} to {rest * 1e3:.2f} mm expected",
            h=(start, rest),
            voltage=(state.voltage, state.voltage),
            duration=abs(rest - start) / speed + 2 * self.settle_s + self.average_s,
            speed=speed,
            bias=actuator.bias,
            gain=gain,
            rate=self.rate_Hz,
            settle=self.settle_s,
            average=self.average_s,
            patience=self.patience_s,
        )

    def _voltage(self, state: State, scene: Scene, target: float) -> ChangeVoltage:
        before, state.voltage = state.voltage, target
        return ChangeVoltage(
            by=self,
            step=state.number,
            kind="voltage",
            label=f"voltage to {target:g} V, the disk held",
            h=(state.h, state.h),
            voltage=(before, target),
            duration=ramp_duration(scene, before, target) + self.settle_s,
            settle=self.settle_s,
        )


@dataclass(frozen=True, kw_only=True)
class Following(Action):
    """Follow the law until the disk rests; then hold and average.

    In every cycle the stage's set-point moves by ``gain (B(h) - F)``, F the mean force since the last one, but never
    faster than the action's speed. What is measured while the stage holds still is the rest: the mean excess that is
    left says how far it is from the balance.

    Attributes
    ----------
    bias : Bias
        The law B(h).
    gain : float
        m/N.
    rate : float
        Cycles per second (Hz).
    settle, average, patience : float
        s.
    """

    bias: Bias
    gain: float
    rate: float
    settle: float
    average: float
    patience: float

    def carry_out(self, rig: Rig) -> Turns:
        write_phase(rig, self, "release", self.label)
        yield from self._until_rest(rig)
        write_phase(rig, self, "rest", self.label)
        yield from pause(rig, self.average)
        write_phase(rig, self, "rested", self.label)

    def _until_rest(self, rig: Rig) -> Turns:
        recorder, clock = rig.recorder, rig.clock
        low, high = max(self.bias.reach[0], 0.0), min(self.bias.reach[1], rig.limits.displacement.high)
        law = _tabulated(self.bias, low, high)
        period = 1.0 / self.rate
        cycles = max(8, round(self.settle * self.rate))
        force: list[float] = []
        displacement: list[float] = []
        excess: deque[float] = deque(maxlen=cycles)
        goals: deque[float] = deque(maxlen=cycles)

        def listen(sample: Sample) -> None:
            if isinstance(sample, ForceSample) and not sample.flags:
                force.append(recorder.quantity_of(sample))
            elif isinstance(sample, DisplacementSample) and not sample.flags:
                displacement.append(recorder.quantity_of(sample))

        goal = rig.position - recorder.contact
        end = clock.now() + self.patience
        due = clock.now()
        with listening(rig, listen):
            while not _at_rest(excess, goals, cycles):
                if clock.now() > end:
                    raise self._no_rest(excess, goals)
                if clock.now() < due or not force:
                    yield
                    continue
                due = max(due + period, clock.now())
                h = float(np.mean(displacement)) if displacement else recorder.displacement
                away = float(law(min(max(h, low), high))) - float(np.mean(force))
                force.clear()
                displacement.clear()
                if not math.isfinite(away):
                    raise FaultError(f"{self.label}: no force of the law, or none measured, at {h * 1e3:.3f} mm.")
                reach = self.speed * period
                goal = min(max(goal + min(max(self.gain * away, -reach), reach), low), high)
                excess.append(away)
                goals.append(goal)
                rig.move_to(goal, self.speed)
                yield

    def _no_rest(self, excess: deque[float], goals: deque[float]) -> FaultError:
        swing = float(np.ptp(goals)) if goals else math.nan
        left = float(np.mean(excess)) if excess else math.nan
        return FaultError(
            f"{self.label}: no rest within {self.patience:g} s: the force is {left * 1e3:+.2f} mN from its law, and "
            f"the stage swings by {swing * 1e3:.2f} mm. Give the step a lower rate_Hz or speed, or more patience_s."
        )


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
