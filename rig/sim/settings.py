"""The ``[simulation]`` table of a scene, made from the registry of simulated instruments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Self, Union

from pydantic import Discriminator, Field, Tag, model_validator

from rig.sim.truth import (
    Fault,
    InstrumentTruth,
    LoadCellTruth,
    MonitorTruth,
    OutputTruth,
    RigTruth,
    StageTruth,
    role_of,
)
from rig.sim.twins import of_role

DEFAULTS = {
    "stage": "zaber",
    "force": "gsv8",
    "displacement": "keyence-lkg",
    "hv": "iseg-edcp",
    "monitor": "scpi",
}
"""Which instrument is simulated where no scene says it, by role."""


def _any_of(role: str) -> Any:
    """The tables of all twins of a role, told apart by ``driver``; without it, it is the default one."""
    tables = {driver: twin.truth for driver, twin in of_role(role).items()}
    if len(tables) == 1:  # nothing to tell apart
        return next(iter(tables.values()))

    def which(table: Any) -> Any:
        if isinstance(table, dict):
            return table.get("driver", DEFAULTS[role])
        return getattr(table, "driver", None)

    tagged = tuple(Annotated[truth, Tag(driver)] for driver, truth in tables.items())
    return Annotated[Union[tagged], Discriminator(which)]  # noqa: UP007 # made at run time


def _default(role: str) -> Any:
    def make() -> InstrumentTruth:
        return of_role(role)[DEFAULTS[role_of(role)]].truth()  # type: ignore[call-arg] # each has a default driver

    return Field(default_factory=make, description=f"The simulated {role.replace('_', ' ')} instrument.")


if TYPE_CHECKING:
    AnyStageTruth = StageTruth
    AnyForceTruth = LoadCellTruth
    AnyDisplacementTruth = InstrumentTruth
    AnyOutputTruth = OutputTruth
    AnyMonitorTruth = MonitorTruth
else:
    AnyStageTruth = _any_of("stage")
    AnyForceTruth = _any_of("force")
    AnyDisplacementTruth = _any_of("displacement")
    AnyOutputTruth = _any_of("hv")
    AnyMonitorTruth = _any_of("monitor")


class SimulationSettings(RigTruth):
    """Everything about the simulated bench that the host cannot know.

    ``driver`` in the instruments' tables says which one it is that is simulated; a scene fills it in.
    """

    stage: AnyStageTruth = _default("stage")
    force: AnyForceTruth = _default("force")
    displacement: AnyDisplacementTruth = _default("displacement")
    hv: AnyOutputTruth = _default("hv")
    monitor: AnyMonitorTruth = _default("monitor")
    monitor_2: AnyMonitorTruth = _default("monitor_2")
    monitor_3: AnyMonitorTruth = _default("monitor_3")
    fault: list[Fault] = Field(default_factory=list, description="What goes wrong, and when.")

    @model_validator(mode="after")
    def _faults_are_possible(self) -> Self:
        for fault in self.fault:
            self.check(fault)
        return self

    def truth(self, role: str) -> InstrumentTruth:
        """The table of the instrument of a role."""
        truth: InstrumentTruth = getattr(self, role)
        return truth

    def check(self, fault: Fault) -> None:
        """Raise ValueError when the instrument that is simulated in the fault's role cannot have it."""
        truth = self.truth(fault.role)
        if fault.kind not in truth.faults():
            why = truth.means_nothing.get(fault.kind, "")
            raise ValueError(
                f"{fault.role} ({truth.driver}) has no fault {fault.kind!r}{f' ({why})' if why else ''}; "
                f"it has {', '.join(truth.faults())}"
            )
