"""The simulated bench's pair of hands: does what an operator is asked to, with errors as his standards have."""

from __future__ import annotations

import numpy as np

from rig.sim.world import World

TOUCH_N = 0.02  # a dummy is turned towards the pusher until the sensor shows about this


class Operator:
    """Acts on the world. What is wrong with a weight or a meter comes from the seed and stays so."""

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        self._world = world
        self._rng = rng
        self._errors: dict[str, float] = {}

    def hang(self, newtons: float, uncertainty: float, name: str) -> None:
        """Hang the weight ``name`` that nominally pulls with ``newtons``, or take all off at 0."""
        self._world.weight = newtons + uncertainty * self._error_of(name) if newtons > 0 else 0.0

    def mount(self, fixture: str, t: float) -> None:
        """Mount what the pusher meets."""
        world = self._world
        world.fixture = fixture
        if fixture == "dummy":
            world.dummy_at = world.carriage_at(t) - TOUCH_N * world.compliance

    def read_meter(self, relative: float, absolute: float, t: float) -> float:
        """What a reference meter of these standard uncertainties shows (V)."""
        true = self._world.output.at(t)[0]
        scale = 1 + relative * self._error_of("meter scale")
        return true * scale + absolute * float(self._rng.standard_normal())

    def _error_of(self, name: str) -> float:
        if name not in self._errors:
            self._errors[name] = float(self._rng.standard_normal())
        return self._errors[name]
