"""Protocol steps that calibrate the bench's instruments. They stand among the steps of `rig.protocol.protocol`.

Every standard is applied rising and falling, several times; each standstill waits ``settle_s`` and then reads for
``average_s``. Positions are the stage's own, because there need be no film.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rig.base.table import Table

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Standards = Annotated[list[NotNegative], Field(min_length=2, max_length=50)]
Cycles = Annotated[int, Field(ge=1, le=20)]


class Averaged(Table):
    """What every series of standstills has."""

    cycles: Cycles = 2
    settle_s: NotNegative = 2.0
    average_s: Positive = 2.0


class Mount(Table):
    """Ask the operator to mount something before the pusher.

    ``film``: the specimen. ``target``: a plate on the pusher, for the laser. ``dummy``: a rigid stop that just touches
    the pusher where it stands. ``none``: nothing that can be touched.
    """

    do: Literal["mount"]
    fixture: Literal["film", "target", "dummy", "none"]


class Weigh(Averaged):
    """Hang weights on the force sensor; 0 means none. ``m g (1 - air/density)`` is what each applies."""

    do: Literal["weigh"]
    weights_g: Standards
    weight_uncertainty_mg: NotNegative = 1.0
    density_kg_per_m3: Positive = 8000.0
    air_density_kg_per_m3: NotNegative = 1.2
    gravity_m_per_s2: Positive = 9.80665
    gravity_uncertainty_m_per_s2: NotNegative = 0.005
    preloads: Annotated[int, Field(ge=0, le=10)] = 1
    creep_s: NotNegative = 0.0  # the heaviest weight is left hanging this long at the end


class Visit(Averaged):
    """Drive the stage to positions and read the laser there. ``accuracy_um`` is the stage's standard uncertainty."""

    do: Literal["visit"]
    positions_mm: Annotated[list[NotNegative], Field(min_length=1, max_length=50)]
    speed_mm_per_s: Positive = 5.0
    accuracy_um: NotNegative = 5.0


class Glide(Table):
    """Move to and fro at several constant speeds: what lags behind shows as a difference between the ways.

    Displacements of the disk when in contact with a film, else positions of the stage.
    """

    do: Literal["glide"]
    from_mm: NotNegative
    to_mm: NotNegative
    speeds_mm_per_s: Annotated[list[Positive], Field(min_length=2, max_length=20)]
    cycles: Cycles = 2

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.from_mm < self.to_mm:
            raise ValueError("from_mm must be smaller than to_mm")
        return self


class Press(Averaged):
    """Press against a rigid dummy in small steps of the stage until ``force_N``, and back again."""

    do: Literal["press"]
    force_N: Positive
    step_um: Positive = 0.5
    speed_mm_per_s: Positive = 0.05
    accuracy_um: NotNegative = 0.2  # standard uncertainty of the stage over so short a way


class Meter(Averaged):
    """Set voltages; the operator types what a reference meter at the output says. The disk must be at rest, at zero."""

    do: Literal["meter"]
    voltages_V: Standards
    meter_relative_uncertainty: NotNegative = 5e-4
    meter_uncertainty_V: NotNegative = 0.5


# Kinds of the actions that they become.
CALIBRATION = ("mount", "weigh", "creep", "visit", "glide", "press", "meter")

Step = Mount | Weigh | Visit | Glide | Press | Meter
