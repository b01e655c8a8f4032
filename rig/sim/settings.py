"""The ``[simulation]`` table of a scene: the hidden truth about film, rig and instruments, and their faults.

Every key has a default, so that ``seed = 1`` is a complete table. Keys carry their unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from rig.base.table import Table

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Role = Literal["stage", "force", "displacement", "hv"]

LINK_FAULTS = ("delay", "drop", "split", "merge", "duplicate", "corrupt", "silent", "vanish")
SWITCHES = (*LINK_FAULTS, "alert", "reset", "saturate", "freeze", "wrong_status")
"""What any instrument can be told to do wrong, where it means anything for it."""


class InstrumentTruth(Table):
    """What every simulated instrument has.

    ``means_nothing`` says of which switches, and why; ``more_faults`` are the instrument's own.
    """

    means_nothing: ClassVar[Mapping[str, str]] = {}
    more_faults: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def faults(cls) -> tuple[str, ...]:
        """Everything that can go wrong with it."""
        return tuple(kind for kind in SWITCHES if kind not in cls.means_nothing) + cls.more_faults


class Fault(Table):
    """Something that goes wrong at a given time.

    ``kind`` is one of the wire's faults (`LINK_FAULTS`), which act on each message with ``probability``, or one of the
    instrument's own (`InstrumentTruth.faults`).

    alert sends what nobody asked for every ``value`` seconds; with ``value = 0`` one between each command and its
    reply, with ``probability``. Otherwise ``value`` is: seconds for delay and split; amperes drawn beside the film for
    over_current; the part of the voltage that is left for sag; the sign of the rail for saturate; the bit pattern (of
    the shvps: the mode) for wrong_status of force and hv.
    """

    role: Role
    kind: str
    at_s: NonNegative = 0.0
    duration_s: Positive | None = Field(default=None, description="absent: until the end of the run")
    probability: Fraction = 1.0
    value: float | None = None
    direction: Literal["from_device", "to_device", "both"] = "from_device"

    @model_validator(mode="after")
    def _kind_fits_role(self) -> Self:
        allowed = dict.fromkeys(kind for twin in TWINS[self.role].values() for kind in twin.faults())
        if self.kind not in allowed:
            raise ValueError(f"{self.role} has no fault {self.kind!r}; it has {', '.join(allowed)}")
        return self


ONE_PIECE = dict.fromkeys(("split", "merge"), "a CAN frame is one piece")
IN_REACH = {"saturate": "the monitors reach beyond what it can give"}


class MaxwellBranch(Table):
    """One branch of the film's relaxation: stiffness relative to the relaxed film, and relaxation time."""

    modulus_ratio: NonNegative
    time_s: Positive


class FilmTruth(Table):
    """The film that is really mounted, where it differs from the scene's guess. Ogden, W = sum mu/al (l^al ... - 3)."""

    mu_Pa: list[float] | None = None
    alpha: list[float] | None = None
    eps_r: Positive | None = None
    breakdown_field_MV_per_m: Positive | None = None
    maxwell: list[MaxwellBranch] = Field(default_factory=list)

    @model_validator(mode="after")
    def _ogden_terms_pair_up(self) -> Self:
        if (self.mu_Pa is None) != (self.alpha is None):
            raise ValueError("mu_Pa and alpha come together")
        if self.mu_Pa is not None and self.alpha is not None and len(self.mu_Pa) != len(self.alpha):
            raise ValueError(f"mu_Pa has {len(self.mu_Pa)} terms and alpha has {len(self.alpha)}")
        return self


class LinkTruth(Table):
    """A wire: fixed latency each way, and the line rate (0: no limit, as on USB)."""

    latency_ms: NonNegative = 0.5
    baud: Annotated[int, Field(ge=0)] = 115_200


class StageTruth(InstrumentTruth):
    """Zaber X-LSQ150B-E01 on ASCII."""

    means_nothing: ClassVar[Mapping[str, str]] = {"saturate": "a position ends at the travel's limits"}

    driver: Literal["zaber"] = "zaber"
    serial_number: int = 50_443
    device_address: Annotated[int, Field(ge=1, le=99)] = 1
    microstep_um: Positive = 0.49609375
    travel_mm: Positive = 151.498
    start_position_mm: NonNegative = Field(default=12.0, description="where the carriage stands at power-up, not homed")
    referenced_at_start: bool = False
    screw_error_um: NonNegative = Field(default=2.0, description="amplitude of the lead screw's periodic error")
    screw_pitch_mm: Positive = 6.35
    default_speed_mm_per_s: Positive = 20.0
    max_speed_mm_per_s: Positive = 100.0
    acceleration_mm_per_s2: Positive = 200.0
    homing_speed_mm_per_s: Positive = 10.0
    reboot_s: Positive = 0.5
    unhomed_reject: str = Field(default="BADDATA", description="reject word for a move before homing")
    link: LinkTruth = LinkTruth()


class LoadCellTruth(InstrumentTruth):
    """What every simulated load cell has."""

    full_scale_N: Positive = 0.5
    gain_error: float = Field(default=0.0, description="hidden relative error of the sensitivity")
    noise_fraction: NonNegative = Field(default=0.005, description="standard deviation of a sample, of full scale")
    clock_drift_ppm: float = 0.0
    lag_ms: NonNegative = Field(default=0.0, description="by which a sample is older than its time stamp can tell")
    reboot_s: Positive = 1.0


class ForceTruth(LoadCellTruth):
    """Strain-gauge cell on an ME-Messsysteme GSV-8."""

    means_nothing: ClassVar[Mapping[str, str]] = {"alert": "it streams: nothing that it sends was asked for"}

    driver: Literal["gsv8"] = "gsv8"
    serial_number: int = 14_209_876
    channel: Annotated[int, Field(ge=1, le=8)] = 1
    sensitivity_mV_per_V: Positive = Field(default=2.0, description="nominal output at full scale")
    zero_offset_mV_per_V: float = 0.013
    input_range_mV_per_V: Positive = Field(default=3.5, description="input range at 5 V bridge supply")
    raw_range_factor: Positive = Field(default=1.05, description="largest raw number, in input ranges")
    stored_rate_Hz: Positive = Field(default=100.0, description="rate at which it streams after power-up")
    link: LinkTruth = LinkTruth(latency_ms=1.0, baud=0)


class CiA404Truth(LoadCellTruth):
    """Load cell on CANopen, device profile CiA 404; it states newtons or millinewtons itself."""

    means_nothing: ClassVar[Mapping[str, str]] = ONE_PIECE

    driver: Literal["cia404"]
    serial_number: int = 77_120
    node: Annotated[int, Field(ge=1, le=127)] = 5
    inputs: Annotated[int, Field(ge=1, le=4)] = Field(default=1, description="analogue inputs; the others are open")
    channel: Annotated[int, Field(ge=1, le=4)] = Field(default=1, description="the input with the load cell")
    bitrate: Literal[125_000, 250_000, 500_000, 1_000_000] = 125_000
    latency_ms: NonNegative = 0.5
    unit: Literal["N", "mN"] = "N"
    decimals: Annotated[int, Field(ge=0, le=6)] = Field(default=4, description="of the integer process values")
    zero_offset_N: float = 0.004
    overload_factor: Positive = Field(default=1.2, description="end of the measuring range, in full scales")
    tare_fraction: Fraction = Field(default=0.2, description="largest value that autozero takes, of full scale")
    conversion_rate_Hz: Positive = 1000.0
    stored_event_time_ms: Annotated[int, Field(ge=0, le=65_535)] = Field(default=100, description="1800h:5 at power-up")
    heartbeat_ms: Annotated[int, Field(ge=0, le=65_535)] = 0

    @model_validator(mode="after")
    def _channel_exists(self) -> Self:
        if self.channel > self.inputs:
            raise ValueError(f"channel is {self.channel}, but there are only {self.inputs} inputs")
        return self


class DisplacementTruth(InstrumentTruth):
    """Keyence LK-G152 laser triangulation head."""

    more_faults: ClassVar[tuple[str, ...]] = ("no_value",)

    driver: Literal["keyence-lkg"] = "keyence-lkg"
    range_mm: Positive = 40.0
    offset_mm: float = 1.25
    gain_error: float = Field(default=0.0, description="hidden relative error of the scale")
    noise_um: NonNegative = Field(default=0.5, description="standard deviation of a reading as averaged at power-up")
    resolution_um: Positive = 0.1
    averaging_code: Annotated[int, Field(ge=0, le=9)] = Field(default=4, description="4^code samples, as in SW,OC")
    sampling_code: Annotated[int, Field(ge=0, le=5)] = Field(default=1, description="20, 50, 100, 200, 500, 1000 us")
    answer_ms: NonNegative = 1.0
    lag_ms: NonNegative = Field(default=0.0, description="by which a reading is older than its averaging time tells")
    link: LinkTruth = LinkTruth()


class OutputTruth(InstrumentTruth):
    """What every simulated supply has, and what hangs on its output."""

    more_faults: ClassVar[tuple[str, ...]] = ("stuck_on", "breakdown", "over_current", "sag")

    fall_time_s: Positive = Field(default=0.05, description="time in which the output falls to zero when cut")
    gain_error: float = Field(default=0.0, description="hidden relative error of set-point and monitor together")
    film_capacitance_nF: NonNegative = 0.7
    leakage_resistance_GOhm: Positive = 20.0
    arc_resistance_kOhm: Positive = 10.0
    start_live_V: NonNegative = Field(default=0.0, description="output found on at this voltage; 0: found off")


class HVTruth(OutputTruth):
    """iseg EDCP module on CAN with one channel."""

    means_nothing: ClassVar[Mapping[str, str]] = ONE_PIECE | IN_REACH
    more_faults: ClassVar[tuple[str, ...]] = (*OutputTruth.more_faults, "interlock", "inhibit")

    driver: Literal["iseg-edcp"] = "iseg-edcp"
    serial_number: int = 484_216
    module: Annotated[int, Field(ge=0, le=63)] = 0
    channels: Annotated[int, Field(ge=1, le=16)] = 1
    bitrate: Literal[125_000, 250_000] = 125_000
    latency_ms: NonNegative = 0.5
    nominal_voltage_V: Positive = 6000.0
    nominal_current_mA: Positive = 1.0
    ramp_percent_per_s: Positive = Field(default=10.0, description="voltage ramp at power-up, of nominal")
    max_ramp_percent_per_s: Positive = 20.0
    voltage_noise_V: NonNegative = 0.3
    current_noise_nA: NonNegative = 5.0
    voltage_limit_percent: Positive = Field(default=100.0, description="hardware limit, of nominal")
    current_limit_percent: Positive = Field(default=100.0, description="hardware limit, of nominal")
    logon_period_s: Positive = 5.0


class ShvpsTruth(OutputTruth):
    """shvps, the peta-pico-Voltron single-channel supply of dielectric-elastomer labs, on a serial port."""

    means_nothing: ClassVar[Mapping[str, str]] = IN_REACH | {"alert": "it never speaks unasked"}

    driver: Literal["shvps"]
    board: Annotated[str, Field(pattern=r"^[ -~]{1,32}$")] = "HVPS 7"
    maximum_voltage_V: Annotated[int, Field(ge=1, le=10_000)] = 5000
    slew_V_per_s: Positive = Field(default=20_000.0, description="how fast the regulated output rises")
    largest_current_uA: Positive = Field(default=200.0, description="what the converter can give at most")
    voltage_noise_V: NonNegative = 0.7
    reading_period_s: Positive = Field(default=0.01, description="of the board's own voltage measurement")
    answer_ms: NonNegative = 1.0
    reboot_s: Positive = 2.0
    power_jack: bool = True
    link: LinkTruth = LinkTruth()


# Which instruments there are to be simulated in each role; the first is the default.
TWINS: dict[str, dict[str, type[InstrumentTruth]]] = {
    "stage": {"zaber": StageTruth},
    "force": {"gsv8": ForceTruth, "cia404": CiA404Truth},
    "displacement": {"keyence-lkg": DisplacementTruth},
    "hv": {"iseg-edcp": HVTruth, "shvps": ShvpsTruth},
}


def _twin(default: str) -> Discriminator:
    """Tells by the key ``driver`` which instrument a table describes; without it, the first of its role."""
    return Discriminator(lambda t: t.get("driver", default) if isinstance(t, dict) else getattr(t, "driver", default))


AnyForceTruth = Annotated[Annotated[ForceTruth, Tag("gsv8")] | Annotated[CiA404Truth, Tag("cia404")], _twin("gsv8")]
AnyHVTruth = Annotated[Annotated[HVTruth, Tag("iseg-edcp")] | Annotated[ShvpsTruth, Tag("shvps")], _twin("iseg-edcp")]


class SimulationSettings(Table):
    """Everything about the simulated bench that the host cannot know.

    ``contact_position_mm`` is the stage position at which the pusher meets the flat disk. Force and displacement of
    the disk are zero before; beyond it the stage's way is shared between film and rig,
    ``stage - contact = displacement + compliance x force``. ``driver`` in the instruments' tables says which one it is
    that is simulated; a scene fills it in.
    """

    seed: int
    contact_position_mm: NonNegative = 40.0
    rig_compliance_um_per_N: NonNegative = 2.0
    film: FilmTruth = FilmTruth()
    stage: StageTruth = StageTruth()
    force: AnyForceTruth = ForceTruth()
    displacement: DisplacementTruth = DisplacementTruth()
    hv: AnyHVTruth = HVTruth()
    fault: list[Fault] = Field(default_factory=list)

    @model_validator(mode="after")
    def _faults_are_possible(self) -> Self:
        for fault in self.fault:
            self.check(fault)
        return self

    def check(self, fault: Fault) -> None:
        """Raise ValueError when the instrument that is simulated in the fault's role cannot have it."""
        truth: StageTruth | AnyForceTruth | DisplacementTruth | AnyHVTruth = getattr(self, fault.role)
        if fault.kind not in truth.faults():
            why = truth.means_nothing.get(fault.kind, "")
            raise ValueError(
                f"{fault.role} ({truth.driver}) has no fault {fault.kind!r}{f' ({why})' if why else ''}; "
                f"it has {', '.join(truth.faults())}"
            )
