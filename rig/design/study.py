"""Study files: what to compute of which films, in TOML. The default is Table 1 of Cao & Conn 2018."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from model.actuator.bias import Mass, Spring
from model.actuator.design import Recipe, SameFilm, Treatment
from model.actuator.stroke import Criteria
from model.material.materials import NAMED, Material
from model.specimen import Specimen
from rig.base.errors import ConfigError
from rig.base.problems import kind_of_table
from rig.base.table import Table
from rig.base.text_file import read_text
from rig.base.toml_file import validate
from rig.base.toml_text import parse_toml
from rig.scene.specimen import AnyMaterial

Positive = Annotated[float, Field(gt=0)]
Stretch = Annotated[float, Field(ge=1.0, le=6.0)]
TreatmentName = Literal["plain", "tension", "tension_field"]
Case = Literal["I", "II", "III"]
Quantity = Literal["radial_stress", "hoop_stress", "field"]


class FilmTable(Table):
    """What all films of the study share."""

    ring_radius_mm: Positive = 20.0
    thickness_um: Positive = 40.0
    material: AnyMaterial = "parker-cao2018"

    @model_validator(mode="after")
    def _known(self) -> Self:
        if isinstance(self.material, str) and self.material not in NAMED:
            raise ValueError(f"material {self.material!r} is not known; known are {', '.join(sorted(NAMED))}")
        return self

    def film(self, disk_radius_mm: float, prestretch: float) -> Specimen:
        """One film in SI units."""
        if not disk_radius_mm < self.ring_radius_mm:
            raise ConfigError(
                f"A disk of {disk_radius_mm:g} mm does not fit into a ring of {self.ring_radius_mm:g} mm."
            )
        return Specimen(
            disk_radius=disk_radius_mm * 1e-3,
            ring_radius=self.ring_radius_mm * 1e-3,
            thickness=self.thickness_um * 1e-6,
            prestretch=prestretch,
            material=self.known(),
        )

    def known(self) -> Material:
        """The material in SI units."""
        return NAMED[self.material] if isinstance(self.material, str) else self.material.material("film of the study")


class SpringTable(Table):
    """Case I: ``B = F0 - K h``."""

    preload_N: Positive = 0.8
    stiffness_N_per_mm: Positive = 0.05


class MassTable(Table):
    """Case II: ``B = M g``."""

    weight_N: Positive = 0.25


class AntagonistTable(Table):
    """Case III: a second cone of the same film; the two displacements add up to the spacer."""

    spacer_mm: Positive = 20.0
    voltage_V: float = 0.0


class BiasTables(Table):
    """The three biases; Table 1 of the paper when left out."""

    spring: SpringTable = SpringTable()
    mass: MassTable = MassTable()
    antagonist: AntagonistTable = AntagonistTable()

    def recipes(self, cases: list[Case]) -> dict[str, Recipe]:
        """Of the cases wanted, in SI units."""
        every: dict[str, Recipe] = {
            "I": Spring(self.spring.preload_N, self.spring.stiffness_N_per_mm * 1e3),
            "II": Mass(self.mass.weight_N),
            "III": SameFilm(self.antagonist.spacer_mm * 1e-3, self.antagonist.voltage_V),
        }
        return {case: every[case] for case in cases}


class LimitsTable(Table):
    """What ends a stroke; the material's own strength and largest stretch when left out."""

    field_V_per_um: Positive | None = None
    stretch: float | None = Field(default=None, gt=1.0)
    voltage_V: Positive | None = None

    def criteria(self, material: Material) -> Criteria:
        """In SI units.

        Raises
        ------
        ConfigError
            When nothing at all would end a stroke.
        """
        field = material.breakdown_field if self.field_V_per_um is None else self.field_V_per_um * 1e6
        stretch = material.max_stretch if self.stretch is None else self.stretch
        if field is None and self.voltage_V is None:
            raise ConfigError(f"Material {material.name!r} states no dielectric strength: give limits.field_V_per_um.")
        return Criteria(field=field, stretch=stretch, voltage=self.voltage_V)


class ProfilesStudy(Table):
    """Stress and field from disk to ring of some films (figures 5 and 6)."""

    study: Literal["profiles"]
    title: str = ""
    film: FilmTable = FilmTable()
    disk_radii_mm: list[Positive] = Field(min_length=1, max_length=20)
    prestretch: Stretch = 1.2
    displacement_mm: Positive = 10.0
    voltages_V: list[Annotated[float, Field(ge=0)]] = Field(min_length=1, max_length=20)
    show: list[Quantity] = Field(min_length=1, max_length=3)
    wrinkling: Literal["plain", "tension_field"] = "plain"


class MapStudy(Table):
    """Largest stroke and work over a/b and pre-stretch (figures 7 and 8)."""

    study: Literal["map"]
    title: str = ""
    film: FilmTable = FilmTable()
    disk_radii_mm: list[Positive] = Field(min_length=1, max_length=200)
    prestretches: list[Stretch] = Field(min_length=1, max_length=50)
    cases: list[Case] = Field(default=list(get_args(Case)), min_length=1, max_length=3)
    treatments: list[TreatmentName] = Field(default=list(get_args(TreatmentName)), min_length=1, max_length=3)
    bias: BiasTables = BiasTables()
    limits: LimitsTable = LimitsTable()
    claims: Literal["cao2018"] | None = None

    @model_validator(mode="after")
    def _claims_have_their_numbers(self) -> Self:
        if self.claims is not None and (len(self.cases) < 3 or 1.0 not in self.prestretches):
            raise ValueError("claims = cao2018 needs the cases I, II and III, and a pre-stretch of 1")
        return self

    def chosen(self) -> list[Treatment]:
        """The treatments."""
        return [Treatment(name) for name in self.treatments]


class BoundaryStudy(Table):
    """Film curves, bias line and breakdown boundary (the paper's supplement, figure S2)."""

    study: Literal["boundary"]
    title: str = ""
    film: FilmTable = FilmTable()
    disk_radius_mm: Positive = 4.0
    prestretch: Stretch = 1.2
    voltages_V: list[Annotated[float, Field(ge=0)]] = Field(min_length=1, max_length=20)
    highest_mm: Positive = 16.0
    case: Case = "I"
    bias: BiasTables = BiasTables()
    limits: LimitsTable = LimitsTable()
    wrinkling: Literal["plain", "tension_field"] = "plain"


Range = Annotated[list[Positive], Field(min_length=2, max_length=2)]


class BoundsTable(Table):
    """Lowest and highest value of what may be varied; a variable left out stays as the study has it."""

    radius_ratio: Range | None = None
    prestretch: Range | None = None
    thickness_um: Range | None = None
    preload_N: Range | None = None
    stiffness_N_per_mm: Range | None = None
    weight_N: Range | None = None
    spacer_mm: Range | None = None

    def si(self) -> dict[str, tuple[float, float]]:
        """By the model's names, in SI units."""
        found = {}
        for key, (name, scale) in VARIABLES.items():
            bounds: list[float] | None = getattr(self, key)
            if bounds is not None:
                found[name] = (scale * bounds[0], scale * bounds[1])
        return found


VARIABLES = {  # key: name in the model, SI units in one unit of the key
    "radius_ratio": ("radius_ratio", 1.0),
    "prestretch": ("prestretch", 1.0),
    "thickness_um": ("thickness", 1e-6),
    "preload_N": ("preload", 1.0),
    "stiffness_N_per_mm": ("stiffness", 1e3),
    "weight_N": ("weight", 1.0),
    "spacer_mm": ("spacer", 1e-3),
}


class OptimiseStudy(Table):
    """The best actuator of one case within bounds, and the front of stroke against work."""

    study: Literal["optimise"]
    title: str = ""
    film: FilmTable = FilmTable()
    case: Case = "I"
    disk_radius_mm: Positive = 4.0
    prestretch: Stretch = 1.2
    treatment: TreatmentName = "tension"
    vary: BoundsTable
    bias: BiasTables = BiasTables()
    limits: LimitsTable = LimitsTable()
    start: int = Field(default=64, ge=4, le=4096)
    front: int = Field(default=5, ge=0, le=100)
    # What `dea-rig fit -o` wrote: its material takes the film's place, and its uncertainties make the optimum robust.
    fit: str | None = None
    coverage: float = Field(default=2.0, gt=0.0, le=6.0)


Study = ProfilesStudy | MapStudy | BoundaryStudy | OptimiseStudy
KINDS: dict[str, type[Study]] = {
    "profiles": ProfilesStudy,
    "map": MapStudy,
    "boundary": BoundaryStudy,
    "optimise": OptimiseStudy,
}


def load_study(path: Path) -> Study:
    """Parse a study file.

    Raises
    ------
    ConfigError
        Naming file, key, value and what is allowed.
    """
    raw = parse_toml(read_text(path, "study"), "study", str(path))
    study = validate(raw, kind_of_table(raw, "study", KINDS, "study", str(path)), "study", str(path))
    if isinstance(study, OptimiseStudy) and study.fit is not None:  # named as seen from the study's folder
        study = study.model_copy(update={"fit": str(path.parent / study.fit)})
    return study
