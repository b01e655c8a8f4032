"""The scene: which specimen, which instruments, which limits. A TOML file with units in its key names.

A scene pays only for what it names: without ``[hv]`` there is no guard, no CAN and no electrostatics; without
``[displacement]`` the stage's own position is the displacement. Instruments with a port are real hardware (or a
simulated bench in another process); a scene in which no instrument has a port runs on the simulated bench in memory.
"""

from __future__ import annotations

from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from drivers.links.can_link import SHARED
from model.material.materials import NAMED, Material
from model.specimen import Specimen
from rig.base.errors import ConfigError
from rig.base.table import Table
from rig.base.toml_file import load_table, validate
from rig.sim.settings import TWINS, SimulationSettings

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


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


class LimitsTable(Table):
    """What may never be exceeded, by command or by measurement."""

    force_N: Positive
    displacement_mm: Positive
    speed_mm_per_s: Positive
    voltage_V: Positive | None = None
    current_uA: Positive | None = None
    field_V_per_um: Positive | None = None
    minimum_hoop_stress_kPa: float = 0.0
    stored_energy_mJ: Positive = 350.0  # 0.5 C V^2; EN 50191 names this as the harmless discharge
    leakage_uA: Positive = 2.0  # beside the current that charges the film; more in two samples running is a breakdown


class SerialTable(Table):
    """What every instrument on a serial port has."""

    port: str | None = Field(default=None, min_length=1)
    timeout_s: float = Field(default=0.25, gt=0, le=10)
    serial: str | None = None
    certificate: str | None = None


class ZaberTable(SerialTable):
    """A Zaber stage on its ASCII protocol."""

    driver: Literal["zaber"]
    baud: int = Field(default=115200, gt=0)
    device: int = Field(default=1, ge=1, le=99)
    axis: int = Field(default=1, ge=1, le=9)
    poll_rate_Hz: float = Field(default=50.0, ge=5, le=200)
    full_step_um: Positive = 31.75  # travel per full motor step: screw pitch over steps a turn, 6.35 mm / 200
    approach_from_mm: float = Field(default=0.0, ge=0)  # stage position, short of the film, where approaching begins


class GSV8Table(SerialTable):
    """An ME-Messsysteme GSV-8 with a strain-gauge force sensor; its certificate turns mV/V into newtons."""

    driver: Literal["gsv8"]
    baud: int = Field(default=230400, gt=0)
    channel: int = Field(default=1, ge=1, le=8)
    rate_Hz: float = Field(default=100.0, gt=0, le=2000)
    frame_type: Literal["float32", "int24", "int16"] = "float32"
    # Float values are the signal in input ranges times the amplifier's user scale ("range"), or the signal in mV/V
    # times it. Integers reach their end at int_full_scale input ranges. The range itself is asked of the amplifier
    # unless it is given here.
    user_scale_of: Literal["range", "mV/V"] = "range"
    int_full_scale: float = Field(default=1.05, ge=0.5, le=2)
    input_range_mV_per_V: float | None = Field(default=None, gt=0, le=1000)
    certificate: str


class KeyenceTable(SerialTable):
    """A Keyence LK-G laser displacement sensor on RS-232."""

    driver: Literal["keyence-lkg"]
    baud: int = Field(default=115200, gt=0)
    output: int = Field(default=1, ge=1, le=2)
    poll_rate_Hz: float = Field(default=50.0, ge=5, le=200)
    unit_mm: Positive = 1.0  # of the controller's display: 0.001 when it is set to micrometres
    limit_mm: Positive = 80.0  # what the head can show at most; more is not believed


class ShvpsTable(SerialTable):
    """The shvps supply of dielectric-elastomer labs on a serial port. Whole volts; it does not measure its current."""

    measures_current: ClassVar[bool] = False
    whole_volts: ClassVar[bool] = True
    driver: Literal["shvps"]
    baud: int = Field(default=115200, gt=0)
    ramp_V_per_s: Positive = 100.0
    parallel_capacitance_nF: NotNegative = 0.0  # of cable and output, beside the film
    poll_rate_Hz: float = Field(default=10.0, gt=0, le=20)


class CanTable(Table):
    """What every instrument on a CAN bus has."""

    interface: Literal["slcan", "socketcan", "pcan", "vector", "virtual", "udp_multicast"] | None = None
    can_channel: str | None = None
    bitrate: int = Field(default=125_000, gt=0)
    timeout_s: float = Field(default=0.25, gt=0, le=10)
    serial: str | None = None
    certificate: str | None = None

    @model_validator(mode="after")
    def _pair(self) -> Self:
        if (self.interface is None) != (self.can_channel is None):
            raise ValueError("interface and can_channel belong together: give both or neither")
        return self


class CiA404Table(CanTable):
    """A load cell on CANopen by device profile CiA 404; its certificate corrects the newtons that it states."""

    driver: Literal["cia404"]
    node: int = Field(default=1, ge=1, le=127)
    channel: int = Field(default=1, ge=1, le=199)
    rate_Hz: float = Field(default=100.0, gt=0, le=1000)
    # For a device that states neither newtons nor mV/V: what its values are, once multiplied by the factor.
    unit: Literal["N", "mV/V"] | None = None
    factor: float = 1.0
    limit_N: Positive = 1e4  # no larger reading is believed; set it to some times the capacity of the cell
    certificate: str

    @model_validator(mode="after")
    def _factor_has_a_unit(self) -> Self:
        if self.unit is None and self.factor != 1.0:
            raise ValueError("factor is given without unit: say what the values are, multiplied by it")
        if self.factor == 0.0:
            raise ValueError("factor must not be 0")
        return self


class IsegTable(CanTable):
    """One channel of an iseg supply that speaks EDCP on CAN."""

    measures_current: ClassVar[bool] = True
    whole_volts: ClassVar[bool] = False
    driver: Literal["iseg-edcp"]
    module: int = Field(default=0, ge=0, le=63)
    channel: int = Field(default=0, ge=0, le=23)
    ramp_V_per_s: Positive = 100.0
    parallel_capacitance_nF: NotNegative = 0.0  # of cable and output, beside the film
    max_ramp_percent_per_s: float = Field(default=20.0, gt=0, le=100)  # of nominal; what the module takes at most
    poll_rate_Hz: float = Field(default=10.0, gt=0, le=50)


Instrument = ZaberTable | GSV8Table | CiA404Table | KeyenceTable | IsegTable | ShvpsTable


class BenchTable(Table):
    """A log in place of the instruments: it answers what it was asked when it was recorded, and nothing else."""

    backend: Literal["replay"]
    log: str = Field(min_length=1)


class Scene(Table):
    """Everything about the bench for one specimen. See the module's docstring."""

    title: str = ""
    specimen: SpecimenTable
    limits: LimitsTable
    stage: ZaberTable
    force: Annotated[GSV8Table | CiA404Table, Field(discriminator="driver")]
    displacement: KeyenceTable | None = None
    hv: Annotated[IsegTable | ShvpsTable, Field(discriminator="driver")] | None = None
    simulation: SimulationSettings | None = None
    bench: BenchTable | None = None

    @model_validator(mode="before")
    @classmethod
    def _simulate_what_is_named(cls, raw: Any) -> Any:
        """The simulated instruments are those of the scene: their ``driver`` need not be repeated."""
        if not isinstance(raw, dict) or not isinstance(raw.get("simulation"), dict):
            return raw
        simulation = dict(raw["simulation"])
        for role, drivers in TWINS.items():
            table, truth = raw.get(role), simulation.get(role, {})
            if isinstance(table, dict) and isinstance(truth, dict) and table.get("driver") in drivers:
                simulation[role] = {"driver": table["driver"], **truth}
        return raw | {"simulation": simulation}

    @model_validator(mode="after")
    def _whole(self) -> Self:
        named = [role for role, table in self.instruments.items() if is_connected(table)]
        if named and len(named) < len(self.instruments):
            missing = [role for role in self.instruments if role not in named]
            raise ValueError(f"{', '.join(named)} has a port but {', '.join(missing)} has none; name all or none")
        if named and self.bench is not None:
            raise ValueError(f"{', '.join(named)} has a port, but [bench] names a log in their place: leave one out")
        if not named and self.simulation is None and self.bench is None:
            raise ValueError("no instrument has a port and there is no [simulation] table: nothing to run on")
        for role in TWINS:
            table = self.instruments.get(role)
            simulated = getattr(self.simulation, role, None)
            if table is not None and simulated is not None and table.driver != simulated.driver:
                raise ValueError(
                    f"{role}.driver is {table.driver!r} but simulation.{role}.driver is {simulated.driver!r}; "
                    f"leave simulation.{role}.driver out"
                )
        self._check_buses()
        self._check_current_limit()
        if self.hv is None and self.limits.voltage_V is not None:
            raise ValueError("limits.voltage_V is given but there is no [hv] instrument")
        return self

    def _check_buses(self) -> None:
        buses = {role: table for role, table in self.instruments.items() if isinstance(table, CanTable)}
        for (one, first), (other, second) in combinations(buses.items(), 2):
            if first.interface is None or (first.interface, first.can_channel) != (
                second.interface,
                second.can_channel,
            ):
                continue
            both = f"{one} and {other} both name the CAN channel {first.can_channel!r}"
            if first.interface not in SHARED:
                raise ValueError(
                    f"{both}, but an adapter of interface {first.interface!r} serves one instrument only, so that "
                    "nothing stands between the supply and its guard; give each an adapter of its own, or use one that "
                    'the operating system shares: interface = "socketcan"'
                )
            if first.bitrate != second.bitrate:
                raise ValueError(f"{both}, at {first.bitrate} and {second.bitrate} bit/s; one bus has one bit rate")

    def _check_current_limit(self) -> None:
        if self.hv is None:
            return
        if self.limits.voltage_V is None or (self.hv.measures_current and self.limits.current_uA is None):
            wanted = "limits.voltage_V and limits.current_uA" if self.hv.measures_current else "limits.voltage_V"
            raise ValueError(f"a scene with [hv] must give {wanted}")
        if not self.hv.measures_current and self.limits.current_uA is not None:
            raise ValueError(
                f"limits.current_uA is given, but the {self.hv.driver} supply does not measure its current, so nothing "
                "could hold it to that limit; leave the limit out and limit the current by hardware"
            )

    @cached_property
    def instruments(self) -> dict[str, Instrument]:
        """The instruments that the scene names, by role, in the order in which they are polled."""
        tables = {"stage": self.stage, "force": self.force, "displacement": self.displacement, "hv": self.hv}
        return {role: table for role, table in tables.items() if table is not None}

    @property
    def rates(self) -> dict[str, float]:
        """How often each instrument is to give a sample (Hz), by role."""
        return {
            role: table.rate_Hz if isinstance(table, GSV8Table | CiA404Table) else table.poll_rate_Hz
            for role, table in self.instruments.items()
        }

    @property
    def on_real_ports(self) -> bool:
        """True when the instruments are reached through ports, False for the simulated bench in memory."""
        return is_connected(self.stage)

    def with_ports(self, ports: dict[str, dict[str, Any]]) -> Scene:
        """The same scene with the ports that ``dea-rig sim`` printed.

        Raises
        ------
        ConfigError
            When a role is missing from ``ports`` or a port's keys are not those of the instrument.
        """
        raw = self.model_dump(exclude_none=True, exclude={"bench"})
        for role in self.instruments:
            if role not in ports:
                raise ConfigError(f"The ports name no {role!r}; they name {', '.join(sorted(ports)) or 'nothing'}.")
            raw[role].update(ports[role])
        return validate(raw, Scene, "scene", "scene with these ports")


def is_connected(table: Table) -> bool:
    """Whether this instrument's table names a port or bus."""
    return getattr(table, "port", None) is not None or getattr(table, "interface", None) is not None


def load_scene(path: Path) -> tuple[Scene, str]:
    """The scene in ``path`` and its exact text.

    Raises
    ------
    ConfigError
        Naming file, key, value and what is allowed.
    """
    scene, text = load_table(path, Scene, "scene")
    if scene.bench is not None:  # a log is named as seen from the scene, like certificates
        log = scene.bench.model_copy(update={"log": str(path.parent / scene.bench.log)})
        scene = scene.model_copy(update={"bench": log})
    return scene, text
