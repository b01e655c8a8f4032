"""What is true about the simulated bench and the host cannot know: the tables from which ``[simulation]`` is made.

Here is what all instruments of a kind have in common; each simulated instrument (`rig.sim.instruments`) declares its
own keys and its own faults. Every key has a default, so that ``seed = 1`` is a complete table.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from model.material.materials import Material
from model.material.ogden import Ogden
from rig.base.law_tables import any_law, law_table, law_values
from rig.base.table import Table
from rig.sim.wire import ByteWire, FrameWire, TcpWire

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Role = Literal["stage", "force", "displacement", "hv", "monitor"]
Name = Literal["stage", "force", "displacement", "hv", "monitor", "monitor_2", "monitor_3"]
MONITORS: tuple[Name, ...] = ("monitor", "monitor_2", "monitor_3")
ROLES: tuple[Name, ...] = ("stage", "force", "displacement", "hv", *MONITORS)
"""Names of the instruments of a bench, in the order in which they are polled."""


def role_of(name: str) -> str:
    """The role of the instrument of this name."""
    return "monitor" if name in MONITORS else name


LINK_FAULTS = ("delay", "drop", "split", "merge", "duplicate", "corrupt", "silent", "vanish")
SWITCHES = (*LINK_FAULTS, "alert", "reset", "saturate", "freeze", "wrong_status")
"""What any instrument can be told to do wrong, where it means anything for it."""

ONE_PIECE = dict.fromkeys(("split", "merge"), "a CAN frame is one piece")
IN_REACH = {"saturate": "the monitors reach beyond what it can give"}


class Fault(Table):
    """Something that goes wrong at a given time.

    ``kind`` is one of the wire's faults (`LINK_FAULTS`), which act on each message with ``probability``, or one of the
    instrument's own (`InstrumentTruth.faults`).

    alert sends what nobody asked for every ``value`` seconds; with ``value = 0`` one between each command and its
    reply, with ``probability``. Otherwise ``value`` is: seconds for delay and split; amperes drawn beside the film for
    over_current; the part of the voltage that is left for sag; the sign of the rail for saturate; the bit pattern (of
    the shvps: the mode) for wrong_status of force and hv.
    """

    role: Name = Field(description="Instrument that has the fault.")
    kind: str = Field(description="What goes wrong; which faults an instrument can have, its error message lists.")
    at_s: NotNegative = Field(default=0.0, description="When it begins (s after the start).")
    duration_s: Positive | None = Field(default=None, description="How long it lasts (s). Absent: until the end.")
    probability: Fraction = Field(default=1.0, description="Part of the messages that it meets, for the wire's faults.")
    value: float | None = Field(
        default=None,
        description="How much, in a unit that goes with the kind: s for delay and split, A for over_current, the part "
        "that is left for sag, the sign of the rail for saturate, bits for wrong_status. Absent: a typical one.",
    )
    direction: Literal["from_device", "to_device", "both"] = Field(
        default="from_device", description="Which messages it meets, for faults of the wire."
    )

    @property
    def sign(self) -> int:
        """-1 for a negative ``value``, else 1."""
        return -1 if self.value is not None and self.value < 0 else 1


class InstrumentTruth(Table):
    """What every simulated instrument has.

    ``means_nothing`` says of which switches, and why; ``more_faults`` are the instrument's own.
    """

    means_nothing: ClassVar[Mapping[str, str]] = {}
    more_faults: ClassVar[tuple[str, ...]] = ()

    driver: str = Field(description="Which instrument it is; the scene fills it in.")

    @classmethod
    def faults(cls) -> tuple[str, ...]:
        """Everything that can go wrong with it."""
        return tuple(kind for kind in SWITCHES if kind not in cls.means_nothing) + cls.more_faults

    @abstractmethod
    def wire(self) -> ByteWire | FrameWire:
        """The wire between it and the host."""


class LinkTruth(Table):
    """A wire: fixed latency each way, and the line rate."""

    latency_ms: NotNegative = Field(default=0.5, description="Time that every byte takes beside the line rate (ms).")
    baud: int = Field(default=115_200, ge=0, description="Line rate (bit/s); 0: no limit, as on USB.")


class LineTruth(InstrumentTruth):
    """What every simulated instrument on a serial line has."""

    link: LinkTruth = Field(default=LinkTruth(), description="Its serial line.")

    def wire(self) -> ByteWire:
        return ByteWire(self.link.latency_ms * 1e-3, self.link.baud)


class BusTruth(InstrumentTruth):
    """What every simulated instrument on a CAN bus has."""

    means_nothing: ClassVar[Mapping[str, str]] = ONE_PIECE

    bitrate: Literal[125_000, 250_000, 500_000, 1_000_000] = Field(default=125_000, description="Of the bus (bit/s).")
    latency_ms: NotNegative = Field(default=0.5, description="Time that every frame takes beside the bit rate (ms).")

    def wire(self) -> FrameWire:
        return FrameWire(self.latency_ms * 1e-3, self.bitrate)


class NetworkTruth(InstrumentTruth):
    """What every simulated instrument on a network has."""

    latency_ms: NotNegative = Field(default=0.5, description="Time that every message takes, each way (ms).")

    def wire(self) -> TcpWire:
        return TcpWire(self.latency_ms * 1e-3)


class StageTruth(InstrumentTruth):
    """What every simulated stage has: a carriage on a lead screw."""

    start_position_mm: NotNegative = Field(
        default=12.0, description="Where the carriage stands at power-up, not homed (mm)."
    )
    screw_error_um: NotNegative = Field(
        default=2.0, description="Amplitude of the lead screw's periodic error (um). Typical: 1 to 10."
    )
    screw_pitch_mm: Positive = Field(default=6.35, description="Travel per turn of the lead screw (mm).")


class LoadCellTruth(InstrumentTruth):
    """What every simulated load cell has."""

    full_scale_N: Positive = Field(default=0.5, description="Capacity of the load cell (N).")
    gain_error: float = Field(default=0.0, description="Hidden relative error of the sensitivity. Typical: +-0.01.")
    noise_fraction: NotNegative = Field(
        default=0.005, description="Standard deviation of a sample, as a part of full scale."
    )
    clock_drift_ppm: float = Field(default=0.0, description="By how much its sample clock is too fast (ppm).")
    lag_ms: NotNegative = Field(
        default=0.0, description="By how much a sample is older than its time stamp can tell (ms)."
    )
    reboot_s: Positive = Field(default=1.0, description="How long it is silent after power comes back (s).")


class OutputTruth(InstrumentTruth):
    """What every simulated supply has, and what hangs on its output."""

    more_faults: ClassVar[tuple[str, ...]] = ("stuck_on", "breakdown", "over_current", "sag", "lies")

    fall_time_s: Positive = Field(default=0.05, description="Time in which the output falls to zero when cut (s).")
    gain_error: float = Field(
        default=0.0, description="Hidden relative error of set-point and monitor together. Typical: +-0.01."
    )
    film_capacitance_nF: NotNegative = Field(default=0.7, description="Capacitance that the supply charges (nF).")
    capacitance_of_film: bool = Field(
        default=False,
        description="Whether the supply charges the capacitance of the deformed film, by its shape and permittivity; "
        "film_capacitance_nF then counts for nothing.",
    )
    beside_film_nF: NotNegative = Field(
        default=0.0,
        description="Capacitance of cable and output that is charged with the film's (nF), with "
        "capacitance_of_film only.",
    )
    current_gain_error: float = Field(
        default=0.0, description="Hidden relative error of the current monitor. Typical: +-0.01."
    )
    leakage_resistance_GOhm: Positive = Field(default=20.0, description="Resistance of the film, in order (GOhm).")
    arc_resistance_kOhm: Positive = Field(
        default=10.0, description="Resistance of the film once it has broken down (kOhm)."
    )
    start_live_V: NotNegative = Field(default=0.0, description="Output found on at this voltage (V); 0: found off.")


class MonitorTruth(InstrumentTruth):
    """What every simulated instrument has that reads something beside the rig."""

    quantity: Literal["voltage", "temperature", "humidity"] = Field(
        default="voltage", description="What it is connected to; the scene fills it in."
    )
    units_per_number: float = Field(
        default=1000.0, description="What a number of 1 that it reads stands for (V, C, %): 1000 behind a 1000:1 probe."
    )
    temperature_C: float = Field(default=23.0, description="Temperature of the air (degrees Celsius).")
    humidity_percent: Annotated[float, Field(ge=0, le=100)] = Field(
        default=45.0, description="Relative humidity of the air (%)."
    )
    gain_error: float = Field(default=0.0, description="Hidden relative error of probe and meter. Typical: +-0.01.")
    zero_offset: float = Field(default=0.0, description="What it shows too much (V, C, %). Typical: 0 to 2 V.")
    noise: NotNegative = Field(default=0.2, description="Standard deviation of a reading (V, C, %).")


class MaxwellBranch(Table):
    """One branch of the film's relaxation."""

    modulus_ratio: NotNegative = Field(description="Stiffness of the branch relative to the relaxed film.")
    time_s: Positive = Field(description="Relaxation time (s).")


class FilmTruth(Table):
    """The film that is really mounted, where it differs from the scene's guess.

    The parameters of its law are further keys, all of them or none.
    """

    eps_r: Positive | None = Field(default=None, description="Relative permittivity. Absent: as in the scene.")
    breakdown_field_MV_per_m: Positive | None = Field(
        default=None, description="True field at which the film breaks down (MV/m = V/um). Absent: as in the scene."
    )
    maxwell: list[MaxwellBranch] = Field(
        default_factory=list, description="Branches of relaxation beside the relaxed film; none: purely elastic."
    )

    @model_validator(mode="after")
    def _is_a_film(self) -> Self:
        self.material(Material("believed", (1e5,), (2.0,), 1.0))
        return self

    def material(self, believed: Material) -> Material:
        """The film itself; ``believed`` has what is not told here."""
        law, values = law_values(self)
        eps_r = believed.eps_r if self.eps_r is None else self.eps_r
        field = believed.breakdown_field
        if self.breakdown_field_MV_per_m is not None:
            field = self.breakdown_field_MV_per_m * 1e6
        if not values:
            return replace(believed, eps_r=eps_r, breakdown_field=field)
        stretch = believed.max_stretch
        return Material.with_law(believed.name, law, values, eps_r, breakdown_field=field, max_stretch=stretch)


if TYPE_CHECKING:
    AnyFilm = FilmTruth
else:
    AnyFilm = any_law(FilmTruth, optional=True)
OGDEN_FILM = law_table(FilmTruth, Ogden, optional=True)


class RigTruth(Table):
    """What is true about rig and film, whatever instruments are on it.

    Force and displacement of the disk are zero before contact; beyond it the stage's way is shared between film and
    rig, ``stage - contact = displacement + compliance x force``.
    """

    seed: int = Field(description="Of everything random: the same seed gives the same run.")
    contact_position_mm: NotNegative = Field(
        default=40.0, description="Stage position at which the pusher meets the flat disk (mm)."
    )
    rig_compliance_um_per_N: NotNegative = Field(
        default=2.0, description="How far the rig gives way (um/N). Typical: 1 to 20."
    )
    film: AnyFilm = Field(default=OGDEN_FILM(), description="The film that is really mounted.")
