"""One film on its rig: disk, ring, thickness, pre-stretch, material."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from model.kernel import film
from model.material.materials import Material


@dataclass(frozen=True)
class Specimen:
    """An annular film, pre-stretched equally in both directions and clamped to a disk and a ring.

    Parameters
    ----------
    disk_radius, ring_radius : a and b of the pre-stretched flat film (m)
    thickness : T before any stretch (m)
    prestretch : lp, the same in both directions
    material : the film
    name : what to call it in reports
    """

    disk_radius: float
    ring_radius: float
    thickness: float
    prestretch: float
    material: Material
    name: str = ""

    def __post_init__(self) -> None:
        label = f"specimen {self.name!r}" if self.name else "specimen"
        for name in ("disk_radius", "ring_radius", "thickness", "prestretch"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{label}: {name} = {value!r}; it must be positive and finite")
            object.__setattr__(self, name, float(value))
        if not self.disk_radius < self.ring_radius:
            raise ValueError(
                f"{label}: disk_radius = {self.disk_radius:g} m must be less than ring_radius = {self.ring_radius:g} m"
            )
        if not isinstance(self.material, Material):
            raise TypeError(f"{label}: material must be a Material, not {type(self.material).__name__}")

    @cached_property
    def record(self) -> bytes:
        """The film as the compiled kernel reads it."""
        return film.record((self.disk_radius, self.ring_radius, self.thickness, self.prestretch), self.material)

    def with_material(self, material: Material) -> Specimen:
        """The same geometry and pre-stretch with another material."""
        return replace(self, material=material)
