"""Where a run stands, in numbers: what its status line shows."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Status:
    """One look at a run. NaN: not known now, or not there.

    Attributes
    ----------
    step, steps : int
        Which step of the protocol, and how many it has.
    done : float
        Part of the plan that is done, 0 to 1.
    left : float
        Seconds that the rest should take by the plan.
    label : str
        What is being done, or what the operator is waited for.
    force, displacement, voltage, current, field : float
        N, m, V, A, V/m; measured but for the field, which is the model's at the measured displacement and voltage.
    second : float
        Second reading of the voltage (V).
    nearest : str
        The limit that is nearest.
    nearest_part : float
        What part of that limit is used up.
    """

    step: int
    steps: int
    done: float
    left: float
    label: str
    force: float = math.nan
    displacement: float = math.nan
    voltage: float = math.nan
    current: float = math.nan
    field: float = math.nan
    nearest: str = ""
    nearest_part: float = math.nan
    second: float = math.nan

    def line(self, width: int, before: str = "") -> str:
        """On one line of at most ``width`` characters, cut between words; ``before`` says on what bench."""
        whole = f"{100 * self.done:.0f} %"
        parts = [f"step {self.step} of {self.steps}", f"{whole}, {minutes(self.left)} left", self.numbers, self.label]
        words = " | ".join(part for part in [before, *parts] if part).split(" ")
        line = words[0][:width]
        for word in words[1:]:
            if len(line) + 1 + len(word) > width:
                break
            line = f"{line} {word}"
        return line.rstrip(" |")

    def measured(self, t: float) -> dict[str, float]:
        """What is measured now, the unit in the names, with the run's time ``t`` (s)."""
        return {
            "t_s": t,
            "force_N": self.force,
            "displacement_m": self.displacement,
            "voltage_V": self.voltage,
            "current_A": self.current,
        }

    @property
    def numbers(self) -> str:
        """What is measured, and the nearest limit."""
        values = (
            (self.force, 1.0, "N", 3),
            (self.displacement, 1e3, "mm", 2),
            (self.voltage, 1.0, "V", 0),
            (self.current, 1e6, "uA", 1),
            (self.field, 1e-6, "V/um", 1),
        )
        known = [
            f"{round(value * scale, digits) + 0.0:.{digits}f} {unit}"
            for value, scale, unit, digits in values
            if math.isfinite(value)
        ]
        if math.isfinite(self.second):
            known.append(f"second reading {round(self.second) + 0.0:.0f} V")
        if self.nearest and math.isfinite(self.nearest_part):
            known.append(f"{self.nearest} at {100 * self.nearest_part:.0f} % of its limit")
        return ", ".join(known)


def minutes(seconds: float) -> str:
    """A time as an operator reads it: 45 s, 3 min 05 s, 2 h 10 min."""
    if not math.isfinite(seconds):
        return "unknown time"
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
