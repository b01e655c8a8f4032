"""The ACME bench scale of the simulated bench. It shares no code with its driver: both follow the protocol."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.truth import Fault, LineTruth, LoadCellTruth
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

ANSWER_S = 1e-3


class ScaleTruth(LoadCellTruth, LineTruth):
    """ACME bench scale."""

    more_faults: ClassVar[tuple[str, ...]] = ("drift",)

    driver: Literal["acme-scale"] = Field(default="acme-scale", description="ACME bench scale.")
    serial_number: int = Field(default=4711, description="Serial number that it states.")
    zero_offset_N: float = Field(default=0.002, description="What it shows unloaded (N).")


class Scale:
    """One scale. ``before_reply`` is a fault: called with the time before each answer is sent."""

    def __init__(self, truth: ScaleTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._truth = truth
        self._world = world
        self._wire = wire
        self._rng = rng
        self._line = b""
        self._asleep_until = -math.inf
        self._frozen: float | None = None
        self._saturated = 0
        self._drift_since: float | None = None
        self._answers_nonsense = False
        self.before_reply = None

    @property
    def next_time(self) -> float:
        return math.inf

    def advance(self, t: float) -> None:
        """It does nothing by itself."""

    def receive(self, data: bytes, t: float) -> None:
        if t < self._asleep_until:
            return
        *lines, self._line = (self._line + data).split(b"\r")
        for line in lines:
            self._command(line, t)

    def reset(self, t: float) -> None:
        self._line = b""
        self._asleep_until = t + self._truth.reboot_s

    def freeze(self, t: float, frozen: bool) -> None:
        self._frozen = self._newtons(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        match fault.kind:
            case "drift":
                self._drift_since = t if begins else None
            case "saturate":
                self._saturated = fault.sign if begins else 0
            case _:
                self._answers_nonsense = begins

    def alert(self, t: float) -> None:
        """Somebody presses its print key: the value is sent."""
        self._wire.send(self._value(t), t)

    def _newtons(self, t: float) -> float:
        if self._frozen is not None:
            return self._frozen
        s = self._truth
        true = self._world.force_at(t - s.lag_ms * 1e-3) * (1.0 + s.gain_error) + s.zero_offset_N
        drift = 0.0 if self._drift_since is None else 1e-3 * (t - self._drift_since)
        return true + drift + s.noise_fraction * s.full_scale_N * float(self._rng.standard_normal())

    def _value(self, t: float) -> bytes:
        newtons = self._newtons(t)
        if self._answers_nonsense:
            return b"R,-----\r"
        if self._saturated or abs(newtons) > 1.2 * self._truth.full_scale_N:
            return b"R,OVER\r"
        return f"R,{newtons:+.5f}\r".encode("ascii")

    def _command(self, line: bytes, t: float) -> None:
        if self.before_reply is not None:
            self.before_reply(t)
        if line == b"I":
            self._wire.send(f"I,ACME,{self._truth.serial_number},1.0\r".encode("ascii"), t + ANSWER_S)
        elif line == b"R":
            self._wire.send(self._value(t), t + ANSWER_S)


TWINS = (Twin(driver="acme-scale", role="force", truth=ScaleTruth, make=Scale),)
