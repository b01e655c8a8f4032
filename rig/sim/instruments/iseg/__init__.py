"""An iseg high-voltage module on CAN that speaks EDCP."""

from __future__ import annotations

from rig.sim.instruments.iseg.module import IsegEDCP
from rig.sim.instruments.iseg.truth import IsegTruth
from rig.sim.twin import Twin

__all__ = ["TWINS", "IsegEDCP", "IsegTruth"]

TWINS = (Twin(driver="iseg-edcp", role="hv", truth=IsegTruth, make=IsegEDCP),)
