"""``do = "approach"``: the pusher meets the film, and displacement zero is where it does."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.roles import ForceSample, Sample, Stage, StageSample
from model.membrane.solve import solve
from model.specimen import Specimen
from rig.base.errors import FaultError, LimitError
from rig.safety.limits import Limits
from rig.scene.scene import Scene
from rig.steps.base import Action, OnResume, Positive, State, Step, Turns, allowed
from rig.steps.rig import Rig
from rig.steps.turns import Readings, arrive, go, listening, mean_of, pause, wait

FOUND_AFTER = 0.25  # of max_travel, for the estimate of the time left: scenes begin the approach near the film
CONTACT_WINDOW_S = 0.25  # force is averaged over this long before it is held against the contact threshold
CONTACT_SIGMAS = 4.0  # the threshold must exceed the noise of that average this many times
# Towards contact the stage is sent in legs, so that it stops by itself when nobody renews them: never further ahead of
# where it was measured than this and its braking distance. A new target replaces the one under way without a halt, and
# comes so early that a lost command is noticed and given again (0.25 s) before the stage brakes.
LEG_S, LEAST_LEG_M = 0.5, 0.1e-3
RENEWED_WITH = 0.7  # of the leg left


class Approach(Step):
    """Advance slowly until the force says that the pusher has met the film; that is displacement zero."""

    finds_contact: ClassVar[bool] = True
    on_resume: ClassVar[OnResume] = OnResume.IN_CONTACT

    do: Literal["approach"] = Field(description="The kind of step.")
    speed_mm_per_s: Positive = Field(
        default=0.5,
        description="Speed of the stage on the way to contact (mm/s). Slower finds contact more exactly. "
        "Typical: 0.1 to 1.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    threshold_mN: Positive = Field(
        default=5.0,
        description="Force at which the film counts as met (mN), averaged over 0.25 s: at least four times that "
        "average's noise. Typical: 5 to 10.",
        json_schema_extra={"usual": [0.1, 1000]},
    )
    max_travel_mm: Positive = Field(
        default=20.0,
        description="How far to go from the scene's stage.approach_from_mm before the film counts as missing (mm). "
        "Typical: 5 to 20.",
        json_schema_extra={"usual": [0.05, 300]},
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        where = self.where(state.number)
        if state.contact or state.voltage > 0:
            raise LimitError(f"{where} comes in contact or with voltage; put a return step before.")
        if not (state.homed and state.zeroed):
            raise LimitError(f"{where} needs a home and a zero step before it.")
        state.contact = True
        speed, fast = self.speed_mm_per_s * 1e-3, scene.limits.speed_mm_per_s * 1e-3
        start, travel = scene.stage.approach_from_mm * 1e-3, self.max_travel_mm * 1e-3
        yield Approaching(
            by=self,
            step=state.number,
            label="advance to contact",
            duration=start / fast + travel / speed,
            speed=speed,
            threshold=self.threshold_mN * 1e-3,
            start=start,
            fast=fast,
            max_travel=travel,
            force_rate=scene.rates["force"],
        )


@dataclass(frozen=True, kw_only=True)
class Approaching(Action):
    """Advance until the averaged force exceeds the threshold; then work out where it began to rise.

    The stage advances in legs: if this program dies or hangs, it stops by itself at most one `leg` further on.

    With a laser the contact position is where the laser says zero. Without, it is the corner of the line
    ``max(0, k (x - x0))`` through the forces met on the way, each at the stage's position at its own time.

    Attributes
    ----------
    threshold : float
        N, of the averaged force.
    start, max_travel : float
        m of the stage: where approaching begins, and how far it goes on at most.
    fast : float
        m/s, on the way to the start.
    force_rate : float
        Force samples per second that the scene asks for.
    """

    threshold: float
    start: float
    fast: float
    max_travel: float
    force_rate: float

    @property
    def likely(self) -> float:
        """The film is usually met in the first part of the way that is searched for it."""
        slow = self.max_travel / self.speed
        return self.duration - (1.0 - FOUND_AFTER) * slow

    def check(self, specimen: Specimen, limits: Limits, force_noise: float) -> None:
        """The threshold lies above the noise, and below what the film gives within the limits."""
        where = f"Step {self.step} (approach): threshold_mN = {self.threshold * 1e3:g}"
        needed = least_threshold(force_noise, samples_averaged(self.force_rate))
        if not self.threshold >= needed:
            raise LimitError(
                f"{where} is lost in the force noise of the certificate; give at least {needed * 1e3:.2g}."
            )
        if not self.threshold < limits.force.high:
            raise LimitError(f"{where} is not below limits.force_N = {limits.force.high:g}: contact would not be felt.")
        at_limit = solve(specimen, limits.displacement.high, 0.0)
        if at_limit.answered and not self.threshold < at_limit.force:
            raise LimitError(
                f"{where}: by the model the film gives {at_limit.force * 1e3:.3g} mN at limits.displacement_mm = "
                f"{limits.displacement.high * 1e3:g}. It would be pushed beyond that before contact is felt."
            )

    def carry_out(self, rig: Rig) -> Turns:
        n = samples_averaged(rig.bench.force.rate)
        needed = least_threshold(rig.force_noise, n)
        if not self.threshold >= needed:
            raise LimitError(
                f"Step {self.step} (approach): threshold {self.threshold * 1e3:.3g} mN is lost in the force noise; "
                f"give threshold_mN of at least {needed * 1e3:.2g}."
            )
        yield from self._to_start(rig, n)
        way, met = yield from self._to_contact(rig, n)
        yield from wait(rig, lambda: not rig.bench.stage.moving, allowed(0.0), "The stage's standstill")
        recorder = rig.recorder
        if recorder.has_laser:
            recorder.contact, error = yield from _contact_by_laser(rig)
        else:
            times, forces = np.array(met).T
            where = np.interp(times, *np.array(way).T)
            recorder.contact, error = _corner(where, forces)
            if recorder.contact <= where.min():
                raise FaultError("The force rose from the very beginning of the approach: contact was before it.")
        recorder.reference("contact_position", recorder.contact, error, "m")
        yield from go(rig, 0.0, self.speed, allowed(abs(rig.position - recorder.contact) / self.speed))

    def _to_start(self, rig: Rig, n: int) -> Turns:
        """To where approaching begins; nothing may be met on the way there."""
        stage = rig.bench.stage
        newest: deque[float] = deque(maxlen=n)

        def feel(sample: Sample) -> None:
            if isinstance(sample, ForceSample):
                newest.append(rig.recorder.quantity_of(sample))

        def met_already() -> bool:
            return len(newest) == n and not abs(float(np.mean(newest))) <= self.threshold

        with listening(rig, feel):
            rig.move_stage(self.start, self.fast)
            way_there = "The stage's way to where approaching begins"
            yield from wait(rig, lambda: not stage.moving or met_already(), self.allowed_s, way_there)
        if met_already():
            raise FaultError(
                f"The pusher met something before {self.start * 1e3:g} mm, where approaching was to begin. "
                "Give the scene a smaller stage.approach_from_mm."
            )

    def _to_contact(
        self, rig: Rig, n: int
    ) -> Generator[None, None, tuple[list[tuple[float, float]], list[tuple[float, float]]]]:
        """Advance until contact is felt. Gives back (time, position) of the stage and (time, force) on the way."""
        recorder, stage = rig.recorder, rig.bench.stage
        goal = min(self.start + self.max_travel, stage.travel[1])
        way: list[tuple[float, float]] = []
        met: list[tuple[float, float]] = []

        def listen(sample: Sample) -> None:
            if isinstance(sample, StageSample):
                way.append((sample.t, sample.position))
            elif isinstance(sample, ForceSample):
                met.append((sample.t, recorder.quantity_of(sample)))

        with listening(rig, listen):
            length = leg(stage, self.speed)
            target, felt = min(self.start + length, goal), 0
            rig.move_stage(target, self.speed)
            end = rig.clock.now() + self.allowed_s
            while not (mean := _mean_of_last(met, n)) > self.threshold:
                if mean < -self.threshold:
                    raise FaultError(f"The force fell to {mean * 1e3:.1f} mN on the way to contact: its sign is wrong.")
                stands = not stage.moving
                if (stands and target == goal) or rig.clock.now() > end:
                    raise FaultError(
                        f"The film was not met within {self.max_travel * 1e3:g} mm of travel. "
                        "Is the specimen mounted, and the force sensor connected?"
                    )
                if stands:  # the loop was late to renew the leg, or something stopped the stage
                    yield from arrive(rig, target)
                left = target - way[-1][1] if way else length
                if target < goal and left < RENEWED_WITH * length and len(met) > felt:  # only on news of both
                    target, felt = min(way[-1][1] + length, goal), len(met)
                    rig.move_stage(target, self.speed)
                yield
            rig.stop_stage()
        return way, met


def samples_averaged(rate: float) -> int:
    """How many force samples are averaged before the mean is held against the threshold, at ``rate`` in Hz."""
    return max(4, round(CONTACT_WINDOW_S * rate))


def least_threshold(noise: float, n: int) -> float:
    """The least threshold (N) that is seen for certain: ``noise`` is the standard deviation (N) of one of n samples."""
    return CONTACT_SIGMAS * noise / math.sqrt(n)


def leg(stage: Stage, speed: float) -> float:
    """How far ahead of its measured position (m) the stage is sent towards contact at ``speed``."""
    return max(speed * LEG_S, LEAST_LEG_M) + stage.braking_distance(speed)


def _mean_of_last(met: list[tuple[float, float]], n: int) -> float:
    """Mean of the last ``n`` forces; 0 while there are fewer."""
    return float(np.mean([force for _, force in met[-n:]])) if len(met) >= n else 0.0


def _contact_by_laser(rig: Rig) -> Generator[None, None, tuple[float, float]]:
    """Stage position minus laser displacement at a standstill, and its standard error."""
    read = Readings(rig)
    with listening(rig, read):
        yield from pause(rig, 0.5)
    displacement, error = mean_of(read.displacement, "displacement")
    return rig.position - displacement, error


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
