"""Study files: what to compute of which films, in TOML. The default is Table 1 of Cao & Conn 2018."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

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

    ring_radius_mm: Positive = Field(default=20.0, description="Inner radius of the ring (mm). Typical: 10 to 60.")
    thickness_um: Positive = Field(
        default=40.0, description="Thickness of the film (um) before pre-stretch. Typical: 20 to 1000."
    )
    material: AnyMaterial = Field(
        default="parker-cao2018", description="The film: the name of a known material, or a table [film.material]."
    )

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

    preload_N: Positive = Field(
        default=0.8, description="Force F0 of the spring at displacement 0 (N). Typical: 0.1 to 5."
    )
    stiffness_N_per_mm: Positive = Field(
        default=0.05, description="Stiffness K of the spring (N/mm). Typical: 0.01 to 1."
    )


class MassTable(Table):
    """Case II: ``B = M g``."""

    weight_N: Positive = Field(default=0.25, description="Weight of the mass (N), M g. Typical: 0.05 to 5.")


class AntagonistTable(Table):
    """Case III: a second cone of the same film; the two displacements add up to the spacer."""

    spacer_mm: Positive = Field(
        default=20.0, description="Length of the spacer between the two cones (mm). Typical: 5 to 40."
    )
    voltage_V: float = Field(default=0.0, description="Voltage on the second cone (V).")


class BiasTables(Table):
    """The three biases; Table 1 of the paper when left out."""

    spring: SpringTable = Field(
        default=SpringTable(), description="Case I, a spring; Table 1 of the paper when left out."
    )
    mass: MassTable = Field(default=MassTable(), description="Case II, a mass; Table 1 of the paper when left out.")
    antagonist: AntagonistTable = Field(
        default=AntagonistTable(), description="Case III, a second cone; Table 1 of the paper when left out."
    )

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

    field_V_per_um: Positive | None = Field(
        default=None, description="Field at which a stroke ends (V/um). Absent: the material's strength."
    )
    stretch: float | None = Field(
        default=None,
        gt=1.0,
        description="Stretch at which a stroke ends, pre-stretch included. Absent: the material's largest stretch.",
    )
    voltage_V: Positive | None = Field(default=None, description="Voltage at which a stroke ends (V). Absent: none.")

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

    study: Literal["profiles"] = Field(description="Kind of the study.")
    title: str = Field(default="", description="What the study shows, for its pictures.")
    film: FilmTable = Field(default=FilmTable(), description="What all films of the study share.")
    disk_radii_mm: list[Positive] = Field(
        min_length=1, max_length=20, description="Radii of the disks (mm), one film each."
    )
    prestretch: Stretch = Field(default=1.2, description="Equibiaxial pre-stretch; 1 is none. Typical: 1.05 to 4.")
    displacement_mm: Positive = Field(default=10.0, description="Displacement of the disk (mm).")
    voltages_V: list[Annotated[float, Field(ge=0)]] = Field(
        min_length=1, max_length=20, description="Voltages (V), one curve each."
    )
    show: list[Quantity] = Field(min_length=1, max_length=3, description="Which quantities are drawn.")
    wrinkling: Literal["plain", "tension_field"] = Field(
        default="plain",
        description='"plain": the membrane equations as they are; "tension_field": folded zones carry no hoop stress.',
    )


class MapStudy(Table):
    """Largest stroke and work over a/b and pre-stretch (figures 7 and 8)."""

    study: Literal["map"] = Field(description="Kind of the study.")
    title: str = Field(default="", description="What the study shows, for its pictures.")
    film: FilmTable = Field(default=FilmTable(), description="What all films of the study share.")
    disk_radii_mm: list[Positive] = Field(
        min_length=1, max_length=200, description="Radii of the disks (mm), one film each."
    )
    prestretches: list[Stretch] = Field(
        min_length=1, max_length=50, description="Equibiaxial pre-stretches; 1 is none."
    )
    cases: list[Case] = Field(
        default=list(get_args(Case)),
        min_length=1,
        max_length=3,
        description="Biases: I spring, II mass, III second cone.",
    )
    treatments: list[TreatmentName] = Field(
        default=list(get_args(TreatmentName)),
        min_length=1,
        max_length=3,
        description='Lost tension: "plain" ignores it, "tension" ends the stroke there, "tension_field" has folds.',
    )
    bias: BiasTables = Field(default=BiasTables(), description="The biases; Table 1 of the paper when left out.")
    limits: LimitsTable = Field(default=LimitsTable(), description="What ends a stroke.")
    claims: Literal["cao2018"] | None = Field(
        default=None, description="Whose claims are held against the maps. Absent: none."
    )

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

    study: Literal["boundary"] = Field(description="Kind of the study.")
    title: str = Field(default="", description="What the study shows, for its pictures.")
    film: FilmTable = Field(default=FilmTable(), description="What all films of the study share.")
    disk_radius_mm: Positive = Field(default=4.0, description="Radius of the disk (mm).")
    prestretch: Stretch = Field(default=1.2, description="Equibiaxial pre-stretch; 1 is none. Typical: 1.05 to 4.")
    voltages_V: list[Annotated[float, Field(ge=0)]] = Field(
        min_length=1, max_length=20, description="Voltages (V), one curve each."
    )
    highest_mm: Positive = Field(default=16.0, description="Largest displacement that is drawn (mm).")
    case: Case = Field(default="I", description="Bias: I spring, II mass, III second cone.")
    bias: BiasTables = Field(default=BiasTables(), description="The biases; Table 1 of the paper when left out.")
    limits: LimitsTable = Field(default=LimitsTable(), description="What ends a stroke.")
    wrinkling: Literal["plain", "tension_field"] = Field(
        default="plain",
        description='"plain": the membrane equations as they are; "tension_field": folded zones carry no hoop stress.',
    )


def _rising(values: list[float]) -> list[float]:
    if not values[0] < values[1]:
        raise ValueError(f"the lowest value stands first and the highest second: [{min(values):g}, {max(values):g}]")
    return values


Range = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)]


class BoundsTable(Table):
    """Lowest and highest value of what may be varied; a variable left out stays as the study has it."""

    radius_ratio: Range | None = Field(
        default=None, description="Lowest and highest radius of the disk over that of the ring."
    )
    prestretch: Range | None = Field(default=None, description="Lowest and highest pre-stretch.")
    thickness_um: Range | None = Field(
        default=None, description="Lowest and highest thickness of the film (um) before pre-stretch."
    )
    preload_N: Range | None = Field(
        default=None, description="Lowest and highest force of the spring at displacement 0 (N)."
    )
    stiffness_N_per_mm: Range | None = Field(
        default=None, description="Lowest and highest stiffness of the spring (N/mm)."
    )
    weight_N: Range | None = Field(default=None, description="Lowest and highest weight (N).")
    spacer_mm: Range | None = Field(default=None, description="Lowest and highest length of the spacer (mm).")

    @model_validator(mode="after")
    def _possible(self) -> BoundsTable:
        if self.radius_ratio is not None and not self.radius_ratio[1] < 1.0:
            raise ValueError(
                f"radius_ratio reaches {self.radius_ratio[1]:g}: the disk is smaller than the ring, below 1"
            )
        if self.prestretch is not None and self.prestretch[0] < 1.0:
            raise ValueError(f"prestretch begins at {self.prestretch[0]:g}: 1 is a film that is not stretched")
        return self

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

    study: Literal["optimise"] = Field(description="Kind of the study.")
    title: str = Field(default="", description="What the study shows, for its pictures.")
    film: FilmTable = Field(default=FilmTable(), description="What all films of the study share.")
    case: Case = Field(default="I", description="Bias: I spring, II mass, III second cone.")
    disk_radius_mm: Positive = Field(default=4.0, description="Radius of the disk (mm).")
    prestretch: Stretch = Field(default=1.2, description="Equibiaxial pre-stretch; 1 is none. Typical: 1.05 to 4.")
    treatment: TreatmentName = Field(
        default="tension",
        description='Lost tension: "plain" ignores it, "tension" ends the stroke there, "tension_field" has folds.',
    )
    vary: BoundsTable = Field(description="What may be varied, between which bounds.")
    bias: BiasTables = Field(default=BiasTables(), description="The biases; Table 1 of the paper when left out.")
    limits: LimitsTable = Field(default=LimitsTable(), description="What ends a stroke.")
    start: int = Field(default=64, ge=4, le=4096, description="Points at which the search begins.")
    front: int = Field(default=5, ge=0, le=100, description="Points on the front of stroke against work; 0: none.")
    fit: str | None = Field(
        default=None,
        description="Result of `dea-rig fit -o`, as seen from the study: its film is taken, robustly.",
    )
    coverage: float = Field(
        default=2.0, gt=0.0, le=6.0, description="How many standard uncertainties of the fit the optimum must bear."
    )


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
