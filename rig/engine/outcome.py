"""How a run ended."""

from __future__ import annotations

import math
from dataclasses import dataclass

NOT_SAFE_STATUS = "NOT SAFE"


@dataclass(frozen=True)
class Outcome:
    """Why the run ended, and the measured state it ended in.

    ``status`` is one of complete, stopped, limit, fault; or NOT SAFE, which is worse than all of them, whenever
    ``safe`` is False. ``reason`` says what ended the run in any case. ``safe`` is True only when the output was
    *measured* below 60 V twice, by the supply and by the second reading where there is one, or when the scene has no
    HV; ``standing`` only when the stage said that it stands. ``second``: what the second reading shows, in words.
    """

    status: str
    reason: str
    safe: bool
    standing: bool
    voltage: float
    force: float
    position: float
    duration: float
    second: str = ""

    @property
    def state(self) -> str:
        """The state of stage and output, in words for the operator."""
        stage = "stage standing" if self.standing else "stage NOT CONFIRMED to stand, it may be moving: cut its power"
        if math.isnan(self.voltage):
            output = "no high voltage in this scene" if self.safe else "high voltage NOT SAFE: never measured"
        else:
            output = (
                f"high voltage {'off, measured' if self.safe else 'NOT SAFE, last measured'} {round(self.voltage)} V"
            )
        return f"{stage}; {output}{f'; {self.second}' if self.second else ''}"

    def as_text(self) -> dict[str, str]:
        """As the log's metadata: text only, units in the names."""
        return {
            "status": self.status,
            "reason": self.reason,
            "safe": "yes" if self.safe else "NO",
            "stage_standing": "yes" if self.standing else "NOT CONFIRMED",
            "measured_voltage_V": f"{self.voltage:.1f}",
            "measured_force_N": f"{self.force:.5f}",
            "stage_position_mm": f"{self.position * 1e3:.4f}",
            "duration_s": f"{self.duration:.3f}",
            **({"second_reading": self.second} if self.second else {}),
        }
