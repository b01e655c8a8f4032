"""The scene: which specimen, which instruments, which limits. A TOML file with units in its key names.

A scene pays only for what it names: without ``[hv]`` there is no guard, no CAN and no electrostatics; without
``[displacement]`` the stage's own position is the displacement. Instruments with a port are real hardware (or a
simulated bench in another process); a scene in which no instrument has a port runs on the simulated bench in memory.
"""

from __future__ import annotations

from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from drivers.links.can_link import SHARED
from drivers.registry import of_role, registered
from drivers.settings import CanSettings, InstrumentSettings, MonitorSettings, Positive
from rig.base.errors import ConfigError
from rig.base.table import Table
from rig.base.toml_file import load_table, validate
from rig.scene.instruments import AnyDisplacement, AnyForce, AnyMonitor, AnyStage, AnySupply
from rig.scene.specimen import SpecimenTable
from rig.sim.settings import SimulationSettings
from rig.sim.truth import MONITORS, ROLES
from rig.sim.twins import of_role as twins_of_role
from rig.sim.twins import registered as registered_twins


class LimitsTable(Table):
    """What may never be exceeded, by command or by measurement."""

    force_N: Positive = Field(
        description="Largest force on the load cell, either way (N). Typical: 0.5 to 20, below the cell's rated force.",
        json_schema_extra={"usual": [0.005, 200]},
    )
    displacement_mm: Positive = Field(
        description="Largest displacement of the disk out of the film's plane (mm). Typical: 5 to 50.",
        json_schema_extra={"usual": [0.05, 200]},
    )
    speed_mm_per_s: Positive = Field(
        description="Highest speed of the stage in contact with the film (mm/s). Typical: 1 to 20.",
        json_schema_extra={"usual": [0.01, 500]},
    )
    voltage_V: Positive | None = Field(
        default=None,
        description="Highest voltage (V); needed with [hv]. Typical: 500 to 8000.",
        json_schema_extra={"usual": [10, 30000]},
    )
    current_uA: Positive | None = Field(
        default=None,
        description="Highest current of the supply (uA); needed with a supply that measures it. Typical: 10 to 200.",
        json_schema_extra={"usual": [0.1, 5000]},
    )
    field_V_per_um: Positive | None = Field(
        default=None,
        description="Highest true electric field, voltage over deformed thickness (V/um). Typical: 20 to 100.",
        json_schema_extra={"usual": [0.1, 1000]},
    )
    minimum_hoop_stress_kPa: float = Field(
        default=0.0,
        description="Smallest hoop stress that must remain in the film (kPa); below 0: may wrinkle. Typical: 0 to 10.",
        json_schema_extra={"usual": [-1000, 1000]},
    )
    stored_energy_mJ: Positive = Field(
        default=350.0,
        description="Largest stored energy, 0.5 C V^2 (mJ). 350 is the harmless discharge of EN 50191.",
        json_schema_extra={"usual": [0.001, 350]},
    )
    leakage_uA: Positive = Field(
        default=2.0,
        description="Current beside what charges the film (uA); more in two samples running is a breakdown. "
        "Typical: 0.5 to 10.",
        json_schema_extra={"usual": [0.01, 500]},
    )
    force_model_factor: float = Field(
        default=10.0,
        gt=1.0,
        le=1e6,
        description="How many times less or more than the model of the film says the measured force may change while "
        "the film moves; beyond it the run ends. Default 10: only a frozen load cell, a torn film or a disk that does "
        "not touch is outside. From about 1000 on nothing is judged. Typical: 3 to 10.",
        json_schema_extra={"usual": [1.5, 1e6]},
    )


class BenchTable(Table):
    """A log in place of the instruments: it answers what it was asked when it was recorded, and nothing else."""

    backend: Literal["replay"] = Field(description='"replay": a log answers in place of the instruments.')
    log: str = Field(min_length=1, description="The log (.mcap), as seen from the scene's folder.")


class SessionTable(Table):
    """Who measured what, and in what air: for logs, reports and the list of runs. Nothing is computed from it."""

    operator: str = Field(default="", max_length=100, description='Who runs the rig. Default: "", not said.')
    sample: str = Field(
        default="",
        max_length=200,
        description='What a label of the film says beside the name of the specimen. Default: "", nothing.',
    )
    notes: str = Field(default="", max_length=4000, description='Anything worth knowing later. Default: "", nothing.')
    temperature_C: float | None = Field(
        default=None,
        ge=-50,
        le=200,
        description="Temperature of the air at the film (degrees Celsius), as read. Default: not known. Typical: 18 "
        "to 30.",
        json_schema_extra={"usual": [0, 100]},
    )
    humidity_percent: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="Relative humidity of the air at the film (%), as read. Default: not known. Typical: 20 to 70.",
    )


class Scene(Table):
    """Everything about the bench for one specimen. See the module's docstring."""

    title: str = Field(default="", max_length=200, description="What this bench is for, in words.")
    accept: list[str] = Field(
        default_factory=list,
        max_length=50,
        description='Keys whose unusual values are meant, by name: ["limits.force_N"].',
    )
    on_end: list[Annotated[str, Field(max_length=1000)]] = Field(
        default_factory=list,
        max_length=50,
        description='Program that is started when a run ends, with its arguments: ["mail-me", "lab@example.org"]. No '
        "shell; nobody waits for it. Its environment has DEA_RIG_LOG, DEA_RIG_EXIT_CODE and DEA_RIG_TEXT. Default: "
        "none.",
    )
    specimen: SpecimenTable = Field(description="The film as mounted.")
    limits: LimitsTable = Field(description="What may never be exceeded.")
    session: SessionTable | None = Field(default=None, description="Who measures, and in what air. Absent: not said.")
    stage: AnyStage = Field(description="The linear stage that pushes the disk.")
    force: AnyForce = Field(description="The load cell under or over the disk.")
    displacement: AnyDisplacement | None = Field(
        default=None, description="A displacement sensor at the disk. Absent: the stage's position counts."
    )
    hv: AnySupply | None = Field(
        default=None, description="The high-voltage supply. Absent: no electrostatics, no permittivity."
    )
    monitor: AnyMonitor | None = Field(
        default=None,
        description="A slow reading beside those of the rig. Of the voltage: an independent one, that must agree with "
        "the supply; the output is off only when both say so. Or of the air. Absent: none.",
    )
    monitor_2: AnyMonitor | None = Field(default=None, description="Another one, of another quantity. Absent: none.")
    monitor_3: AnyMonitor | None = Field(default=None, description="A third one. Absent: none.")
    simulation: SimulationSettings | None = Field(
        default=None, description="The simulated bench: the truth behind film and instruments, and their faults."
    )
    bench: BenchTable | None = Field(default=None, description="A log in place of all instruments.")

    @model_validator(mode="before")
    @classmethod
    def _registered(cls, raw: Any) -> Any:
        """A driver of a package that cannot be used: why, rather than that there is none of this name."""
        broken = [*registered().broken, *registered_twins().broken]
        for role in ROLES if broken and isinstance(raw, dict) else ():
            table = raw.get(role)
            if isinstance(table, dict) and str(table.get("driver")) not in of_role(role):
                raise ValueError(f"{role}.driver = {table.get('driver')!r} is not known. {' '.join(broken)}")
        return raw

    @model_validator(mode="before")
    @classmethod
    def _simulate_what_is_named(cls, raw: Any) -> Any:
        """The simulated instruments are those of the scene: their ``driver`` need not be repeated."""
        if not isinstance(raw, dict) or not isinstance(raw.get("simulation"), dict):
            return raw
        simulation = dict(raw["simulation"])
        for role in ROLES:
            table, truth = raw.get(role), simulation.get(role, {})
            if isinstance(table, dict) and isinstance(truth, dict) and str(table.get("driver")) in twins_of_role(role):
                simulation[role] = {"driver": table["driver"], **truth}
                if role in MONITORS and "quantity" in table:
                    simulation[role] = {"quantity": table["quantity"], **simulation[role]}
        return raw | {"simulation": simulation}

    @model_validator(mode="after")
    def _whole(self) -> Self:
        named = [role for role, table in self.instruments.items() if table.connected]
        if named and len(named) < len(self.instruments):
            missing = [role for role in self.instruments if role not in named]
            raise ValueError(f"{', '.join(named)} has a port but {', '.join(missing)} has none; name all or none")
        if named and self.bench is not None:
            raise ValueError(f"{', '.join(named)} has a port, but [bench] names a log in their place: leave one out")
        if not named and self.simulation is None and self.bench is None:
            raise ValueError("no instrument has a port and there is no [simulation] table: nothing to run on")
        for role, table in self.instruments.items():
            if self.simulation is None:
                break
            simulated = self.simulation.truth(role)
            if table.driver not in twins_of_role(role):
                known = ", ".join(twins_of_role(role))
                raise ValueError(
                    f"{role}.driver is {table.driver!r}, which cannot be simulated (simulated can be {known}); name "
                    "the ports and leave [simulation] out"
                )
            if table.driver != simulated.driver:
                raise ValueError(
                    f"{role}.driver is {table.driver!r} but simulation.{role}.driver is {simulated.driver!r}; "
                    f"leave simulation.{role}.driver out"
                )
        self._check_buses()
        self._check_current_limit()
        self._check_monitors()
        if self.hv is None and self.limits.voltage_V is not None:
            raise ValueError("limits.voltage_V is given but there is no [hv] instrument")
        return self

    def _check_buses(self) -> None:
        buses = {role: table for role, table in self.instruments.items() if isinstance(table, CanSettings)}
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

    def _check_monitors(self) -> None:
        seen: dict[str, str] = {}
        for name, table in self.monitors.items():
            if table.quantity in seen:
                raise ValueError(f"{seen[table.quantity]} and {name} both read the {table.quantity}; one is enough")
            seen[table.quantity] = name
        if "voltage" in seen and self.hv is None:
            raise ValueError(f'{seen["voltage"]}.quantity = "voltage", but there is no [hv] instrument')

    @property
    def monitors(self) -> dict[str, MonitorSettings]:
        """The slow readings beside those of the rig, by name."""
        tables = {name: getattr(self, name) for name in MONITORS}
        return {name: table for name, table in tables.items() if table is not None}

    @property
    def second_reading(self) -> str:
        """Name of the monitor that reads the voltage; empty: there is none."""
        return next((name for name, table in self.monitors.items() if table.quantity == "voltage"), "")

    @cached_property
    def instruments(self) -> dict[str, InstrumentSettings]:
        """The instruments that the scene names, by role, in the order in which they are polled."""
        tables = {"stage": self.stage, "force": self.force, "displacement": self.displacement, "hv": self.hv}
        return {role: table for role, table in tables.items() if table is not None} | self.monitors

    @property
    def rates(self) -> dict[str, float]:
        """How often each instrument is to give a sample (Hz), by role."""
        return {role: table.sample_rate for role, table in self.instruments.items()}

    @property
    def breakdowns_are_bounds(self) -> bool:
        """A supply without current shows a breakdown only once its output sags: the voltage before is too high."""
        return self.hv is not None and not self.hv.measures_current

    @property
    def on_real_ports(self) -> bool:
        """True when the instruments are reached through ports, False for the simulated bench in memory."""
        return self.stage.connected

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
