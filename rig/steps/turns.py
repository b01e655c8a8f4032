"""Waits and moves that steps share: generators that the engine's loop resumes once a turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from drivers.roles import DisplacementSample, ForceSample, Sample
from rig.base.errors import FaultError
from rig.steps.base import ALLOWED_S, Turns
from rig.steps.rig import Rig

ARRIVAL_M = 50e-6  # a stage that says it is done must be this near to where it was sent
LEAST_SAMPLES = 10  # for a mean


def wait(rig: Rig, done: Callable[[], bool], limit: float, what: str) -> Turns:
    """Yield until ``done()``; a fault after ``limit`` seconds."""
    end = rig.clock.now() + limit
    while not done():
        if rig.clock.now() > end:
            raise FaultError(f"{what} did not happen within {limit:.0f} s.")
        yield


def pause(rig: Rig, duration: float) -> Turns:
    """Yield for ``duration`` seconds."""
    end = rig.clock.now() + duration
    while rig.clock.now() < end:
        yield


@contextmanager
def listening(rig: Rig, listener: Callable[[Sample], None]) -> Iterator[None]:
    """Within this context every sample is told to ``listener`` as it arrives."""
    rig.listener = listener
    try:
        yield
    finally:
        rig.listener = None


class Readings:
    """A listener that keeps what force sensor and laser read: raw, or as newtons and metres of the film."""

    def __init__(self, rig: Rig, *, raw: bool = False) -> None:
        self.force: list[float] = []
        self.displacement: list[float] = []
        self._rig = rig
        self._raw = raw

    def __call__(self, sample: Sample) -> None:
        if isinstance(sample, ForceSample):
            self.force.append(sample.reading if self._raw else self._rig.recorder.quantity_of(sample))
        elif isinstance(sample, DisplacementSample):
            self.displacement.append(sample.displacement if self._raw else self._rig.recorder.quantity_of(sample))


def mean_of(readings: list[float], role: str) -> tuple[float, float]:
    """Mean and its standard error, taken as independent samples.

    Raises
    ------
    FaultError
        Too few, or one is no number.
    """
    values = np.array(readings)
    if len(values) < LEAST_SAMPLES:
        raise FaultError(
            f"{role}: only {len(values)} samples arrived during the zero step; at least {LEAST_SAMPLES} are needed."
        )
    if not np.isfinite(values).all():
        raise FaultError(f"{role}: the sensor gave no valid value during the zero step; is it in range?")
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values)))


def stand_still(rig: Rig, limit: float) -> Turns:
    """Wait until the stage says that it stands, and for its position there."""
    stage = rig.bench.stage
    yield from wait(rig, lambda: not stage.moving, limit, "The end of the stage's move")
    yield from pause(rig, 2 / rig.scene.stage.poll_rate_Hz)


def halt(rig: Rig) -> Turns:
    """Stop the stage and wait until it says that it stands."""
    rig.stop_stage()
    yield from wait(rig, lambda: not rig.bench.stage.moving, ALLOWED_S, "The stage's standstill")


def go(rig: Rig, h: float, speed: float, limit: float) -> Turns:
    """Move to displacement ``h`` and make sure that the stage says it is there."""
    rig.move_to(h, speed)
    yield from wait(rig, lambda: not rig.bench.stage.moving, limit, "The end of the stage's move")
    yield from arrive(rig, rig.recorder.contact + h)


def arrive(rig: Rig, target: float) -> Turns:
    """Make sure that a stage which says that it stands does so at ``target``, in metres of its own scale."""
    yield from pause(rig, 2 / rig.scene.stage.poll_rate_Hz)
    missed = rig.position - target
    if not abs(missed) <= ARRIVAL_M:
        raise FaultError(
            f"stage: it stands {missed * 1e3:+.3f} mm from where it was sent, and says that it is done. "
            "Did something stop it?"
        )
