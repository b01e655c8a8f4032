"""The specimen of a scene: its film, its dimensions, and how well these are known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.settings import NotNegative, Positive
from model.material.materials import NAMED, Branch, Material
from model.specimen import Specimen
from rig.base.law_tables import any_law, law_values
from rig.base.table import Table
from rig.base.unusual import slip_of

USUAL_MODULUS_PA = (500.0, 2e7)  # of elastomers, from gels to hard rubber


def _usual(modulus: float) -> bool:
    return USUAL_MODULUS_PA[0] <= modulus <= USUAL_MODULUS_PA[1]


class BranchTable(Table):
    """One Maxwell branch of a film that takes time, beside the relaxed film."""

    ratio: NotNegative = Field(
        description="Its stiffness over that of the relaxed film. Typical: 0.02 to 2.",
        json_schema_extra={"usual": [0.001, 20]},
    )
    time_s: Positive = Field(
        description="Its relaxation time (s). Typical: 0.1 to 300.", json_schema_extra={"usual": [1e-4, 1e6]}
    )


class MaterialTable(Table):
    """What is believed of the film; the parameters of its law are further keys, made from `model.material.laws`."""

    eps_r: float = Field(
        default=1.0,
        ge=1.0,
        description="Relative permittivity. Typical: 2 to 8; default 1.",
        json_schema_extra={"usual": [1, 50]},
    )
    breakdown_V_per_um: Positive | None = Field(
        default=None,
        description="True field at which the film breaks down (V/um). Typical: 30 to 200. Absent: unknown.",
        json_schema_extra={"usual": [1, 1000]},
    )
    max_stretch: float | None = Field(
        default=None,
        gt=1.0,
        description="Largest stretch the film stands, pre-stretch included: what is planned, commanded and measured is "
        "held below it, by the model. Absent: unknown.",
        json_schema_extra={"usual": [1, 20]},
    )
    branches: list[BranchTable] = Field(
        default_factory=list,
        max_length=8,
        description="What relaxes beside the relaxed film that the law describes. With them `check` expects the force "
        "of a film pushed in no time where that is larger. Default: none, the film is elastic.",
    )
    source: str = Field(default="", description="Where the numbers come from, for reports.")

    @model_validator(mode="after")
    def _is_a_film(self) -> Self:
        self.material("")  # whatever the model refuses
        return self

    def unusual(self) -> Iterator[tuple[str, str]]:
        """What is hardly meant of its law: see `rig.base.unusual`."""
        law, values = law_values(self)
        modulus = self.material("").shear_modulus
        keys = {p.name: p.key for p in law.parameters(*law.counts(1))}
        if not _usual(modulus):
            moduli = " and ".join(f"{key} = {getattr(self, key)}" for key in keys.values() if key.endswith("_Pa"))
            units = {"kPa": 1e3, "MPa": 1e6}
            meant = next((unit for unit, factor in units.items() if _usual(modulus * factor)), "")
            hint = (f"Are they in {meant}? " if meant else "") + "They belong in Pa: 33e3 for 33 kPa."
            yield (
                "shear_modulus",
                f"{moduli}: the shear modulus at small strain is then {modulus:.4g} Pa; usual are "
                f"{USUAL_MODULUS_PA[0]:g} to {USUAL_MODULUS_PA[1]:g} Pa. {hint}",
            )
        if {"mu", "alpha"} <= values.keys():
            yield from self._falling_terms(values)

    @staticmethod
    def _falling_terms(values: Mapping[str, float | list[float]]) -> Iterator[tuple[str, str]]:
        """Terms that soften the film as it is stretched: possible beside others, but mostly a wrong sign."""
        pairs = zip(np.atleast_1d(values["mu"]), np.atleast_1d(values["alpha"]), strict=True)
        for number, (mu, alpha) in enumerate(pairs, 1):
            if mu * alpha < 0:
                text = f"mu_Pa {number} = {mu:g} with alpha {number} = {alpha:g}: both usually have the same sign."
                yield "mu_Pa", text

    def material(self, name: str) -> Material:
        """The same in SI units."""
        law, values = law_values(self)
        field = None if self.breakdown_V_per_um is None else self.breakdown_V_per_um * 1e6
        film = Material.with_law(
            name, law, values, self.eps_r, breakdown_field=field, max_stretch=self.max_stretch, source=self.source
        )
        branches = tuple(Branch(one.ratio, one.time_s) for one in self.branches)
        return replace(film, branches=branches) if branches else film


if TYPE_CHECKING:
    AnyMaterial = str | MaterialTable
else:
    AnyMaterial = any_law(MaterialTable, str)


class SpecimenTable(Table):
    """The film as mounted. The material is what is believed of it: it plans and guards, the fit starts from it."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9._-]{1,64}$",
        description="Name of this one specimen, for logs and reports: 1 to 64 letters, digits, points, _ and -.",
    )
    disk_radius_mm: Positive = Field(
        description="Radius of the rigid disk in the middle (mm). Typical: 2 to 15.",
        json_schema_extra={"usual": [0.2, 100]},
    )
    ring_radius_mm: Positive = Field(
        description="Inner radius of the ring that holds the film (mm). Typical: 10 to 60.",
        json_schema_extra={"usual": [1, 300]},
    )
    thickness_um: Positive = Field(
        description="Thickness of the film (um) before pre-stretch. Typical: 20 to 1000.",
        json_schema_extra={"usual": [1, 5000]},
    )
    prestretch: float = Field(
        ge=1.0,
        le=6.0,
        description="Equibiaxial pre-stretch, stretched over original length; 1 is none. Typical: 1.05 to 4.",
        json_schema_extra={"usual": [1, 6]},
    )
    material: AnyMaterial = Field(
        description="What is believed of the film: the name of a known material, or a table [specimen.material]."
    )
    batch: str = Field(
        default="",
        max_length=64,
        description="The sheet that the film was cut from, by any name. Specimens of one batch share the error of "
        'their thickness. Default: "", not known.',
    )
    thickness_uncertainty_um: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of thickness_um, um, before pre-stretch. 0 means exact. Default: "
        "5 % of the thickness, assumed. Typical: 0.2 to 2.",
    )
    prestretch_uncertainty: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of prestretch, in its own unit. 0 means exact. Default: 1 % of the "
        "pre-stretch, assumed. Typical: 0.002 to 0.02.",
    )
    disk_radius_uncertainty_mm: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of disk_radius_mm, mm. 0 means exact. Default: 0.05 mm, assumed.",
    )
    ring_radius_uncertainty_mm: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of ring_radius_mm, mm. 0 means exact. Default: 0.05 mm, assumed.",
    )
    eccentricity_mm: NotNegative = Field(
        default=0.0,
        description="How far the disk may sit off the centre of the ring, mm, as a standard uncertainty. Default: 0.",
    )
    displacement_axis_uncertainty_percent: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of the displacement beside that of the sensor's certificate, % of "
        "the reading: the cosine between sensor and stage, and the gain where there is no certificate. 0 means exact. "
        "Default: 0.5, assumed.",
    )
    voltage_at_film_uncertainty_percent: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of the voltage at the film beside that of the supply's certificate, "
        "% of the reading: losses in leads and electrodes, and the gain where there is no certificate. 0 means exact. "
        "Default: 1, assumed.",
    )

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if not self.disk_radius_mm < self.ring_radius_mm:
            raise ValueError(self._disk_in_ring())
        if not self.eccentricity_mm < self.ring_radius_mm - self.disk_radius_mm:
            raise ValueError("eccentricity_mm must be smaller than the gap between disk and ring")
        if isinstance(self.material, str) and self.material not in NAMED:
            raise ValueError(f"material {self.material!r} is not known; known are {', '.join(sorted(NAMED))}")
        self._stands_its_prestretch()
        return self

    def _stands_its_prestretch(self) -> None:
        known = self.material
        largest = NAMED[known].max_stretch if isinstance(known, str) else known.max_stretch
        if largest is not None and not self.prestretch < largest:
            raise ValueError(
                f"prestretch = {self.prestretch:g}, but the material's max_stretch, pre-stretch included, is "
                f"{largest:g}: the film would tear when it is mounted"
            )

    def _disk_in_ring(self) -> str:
        """What is wrong when the disk does not fit into the ring, and what was probably meant."""
        lengths = {"disk_radius_mm": self.disk_radius_mm, "ring_radius_mm": self.ring_radius_mm}
        hints = [hint for key, value in lengths.items() if (hint := slip_of(type(self), key, value))]
        told = " and ".join(f"{key} = {value:g}" for key, value in lengths.items())
        return f"{told}, but disk_radius_mm must be smaller than ring_radius_mm. " + (
            " ".join(hints) or "Were the two swapped?"
        )

    def specimen(self) -> Specimen:
        """The specimen in SI units."""
        known = self.material
        material = NAMED[known] if isinstance(known, str) else known.material(f"{self.name} (scene)")
        return Specimen(
            disk_radius=self.disk_radius_mm * 1e-3,
            ring_radius=self.ring_radius_mm * 1e-3,
            thickness=self.thickness_um * 1e-6,
            prestretch=self.prestretch,
            material=material,
            name=self.name,
        )
