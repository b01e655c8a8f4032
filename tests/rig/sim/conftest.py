"""A simulated bench with a film whose force is known in closed form, and a host that talks to it byte by byte."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from model.material.materials import Material
from model.specimen import Specimen
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings

STIFFNESS = 20.0  # N/m
CUBIC = 4e4  # N/m^3
SOFTENING = 2e-6  # N/(m V^2)
STRENGTH = 80e6  # V/m
THICKNESS = 40e-6


def closed_form(specimen, h, voltage):
    """F = (k - c V^2) h + q h^3, and a peak field of V/T (1 + 1000 h^2)."""
    force = (STIFFNESS - SOFTENING * voltage**2) * h + CUBIC * h**3
    return force, voltage / THICKNESS * (1 + 1000 * h**2), np.ones_like(force, dtype=bool)


def specimen() -> Specimen:
    film = Material("test film", (5e3, 3.5e4), (2.5, 5.6), 1.7, breakdown_field=STRENGTH)
    return Specimen(4e-3, 20e-3, THICKNESS, 1.2, film)


class Host:
    """Talks to one bench; time passes only here."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench = bench
        self.t = 0.0

    def wait(self, seconds: float, step: float = 0.05) -> None:
        """Let time pass and read everything on the way into nothing."""
        end = self.t + seconds
        while self.t < end - 1e-12:
            self.t = min(self.t + step, end)
            self.bench.advance(self.t)
            for role in self.bench.instruments:
                self.bench.wire(role).host_read(self.t)

    def ask(self, role: str, message: bytes, seconds: float = 0.03) -> bytes:
        """Send, wait, and return everything that came."""
        self.bench.wire(role).host_write(message, self.t)
        self.t += seconds
        self.bench.advance(self.t)
        return self.bench.wire(role).host_read(self.t)

    def can(self, text: str, seconds: float = 0.02, role: str = "hv") -> list[str]:
        """Send a frame written as ``201#1208``, or nothing; return what came, written the same way."""
        if text:
            identifier, _, data = text.partition("#")
            self.bench.wire(role).host_write((int(identifier, 16), bytes.fromhex(data)), self.t)
        self.t += seconds
        self.bench.advance(self.t)
        return [f"{i:03x}#{d.hex()}" for i, d in self.bench.wire(role).host_read(self.t)]


MakeHost = Callable[..., Host]


@pytest.fixture
def make_host() -> MakeHost:
    def make(*roles: str, solve: Any = closed_form, **settings: Any) -> Host:
        table = SimulationSettings.model_validate({"seed": 1, **settings})
        return Host(SimulatedBench(table, specimen(), roles, solve=solve))

    return make
