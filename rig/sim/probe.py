"""What a second reading sees, whatever instrument gives it: the output through a probe, or the air at the film."""

from __future__ import annotations

import numpy as np

from rig.sim.truth import MonitorTruth
from rig.sim.world import World


class Probe:
    """Gives the number that the instrument reads."""

    def __init__(self, truth: MonitorTruth, world: World, rng: np.random.Generator) -> None:
        self._truth, self._world, self._rng = truth, world, rng

    def number(self, t: float) -> float:
        """What is read at time ``t``: volts, degrees Celsius or per cent, over ``units_per_number``."""
        s = self._truth
        match s.quantity:
            case "voltage":
                true = self._world.output.at(t)[0]
            case "temperature":
                true = s.temperature_C
            case _:
                true = s.humidity_percent
        shown = true * (1.0 + s.gain_error) + s.zero_offset + s.noise * float(self._rng.standard_normal())
        return shown / s.units_per_number
