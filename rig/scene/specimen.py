"""The specimen of a scene: its film, its dimensions, and how well these are known."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from drivers.settings import NotNegative, Positive
from model.material.materials import NAMED, Material
from model.specimen import Specimen
from rig.base.table import Table


class MaterialTable(Table):
    """Ogden terms in the convention W = sum mu_n/alpha_n (l1^a + l2^a + (l1 l2)^-a - 3), and the permittivity."""

    mu_Pa: list[float] = Field(min_length=1, max_length=6)
    alpha: list[float] = Field(min_length=1, max_length=6)
    eps_r: float = Field(default=1.0, ge=1.0)
    breakdown_V_per_um: Positive | None = None
    max_stretch: float | None = Field(default=None, gt=1.0)
    source: str = ""

    @model_validator(mode="after")
    def _same_length(self) -> Self:
        if len(self.mu_Pa) != len(self.alpha):
            raise ValueError(f"mu_Pa has {len(self.mu_Pa)} terms and alpha {len(self.alpha)}; they must pair up")
        self.material("here")  # whatever else the model refuses
        return self

    def material(self, name: str) -> Material:
        """The same in SI units."""
        field = None if self.breakdown_V_per_um is None else self.breakdown_V_per_um * 1e6
        return Material(
            name=name,
            mu=tuple(self.mu_Pa),
            alpha=tuple(self.alpha),
            eps_r=self.eps_r,
            breakdown_field=field,
            max_stretch=self.max_stretch,
            source=self.source,
        )


class SpecimenTable(Table):
    """The film as mounted. The material is what is believed of it: it plans and guards, the fit starts from it."""

    name: str = Field(pattern=r"^[A-Za-z0-9._-]{1,64}$")
    disk_radius_mm: Positive
    ring_radius_mm: Positive
    thickness_um: Positive
    prestretch: float = Field(ge=1.0, le=6.0)
    material: str | MaterialTable
    # Standard uncertainties of the dimensions; at 0 the results are stated for the dimensions as given.
    disk_radius_uncertainty_mm: NotNegative = 0.0
    thickness_uncertainty_um: NotNegative = 0.0
    prestretch_uncertainty: NotNegative = 0.0
    eccentricity_mm: NotNegative = 0.0  # how far the disk may sit off the ring's centre

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if not self.disk_radius_mm < self.ring_radius_mm:
            raise ValueError("disk_radius_mm must be smaller than ring_radius_mm")
        if not self.eccentricity_mm < self.ring_radius_mm - self.disk_radius_mm:
            raise ValueError("eccentricity_mm must be smaller than the gap between disk and ring")
        if isinstance(self.material, str) and self.material not in NAMED:
            raise ValueError(f"material {self.material!r} is not known; known are {', '.join(sorted(NAMED))}")
        return self

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
