"""The ``[simulation]`` table of a scene: the hidden truth about film, rig and instruments, and their faults.

Every key has a default, so that ``seed = 1`` is a complete table. Keys carry their unit.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rig.table import Table

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Role = Literal["stage", "force", "displacement", "hv"]

LINK_FAULTS = ("delay", "drop", "split", "merge", "duplicate", "corrupt", "silent", "vanish")
DEVICE_FAULTS: dict[str, tuple[str, ...]] = {
    "stage": ("alert", "reset", "freeze", "wrong_status"),
    "force": ("reset", "saturate", "freeze", "wrong_status"),
    "displacement": ("alert", "reset", "saturate", "freeze", "no_value", "wrong_status"),
    "hv": (
        "reset",
        "freeze",
        "wrong_status",
        "stuck_on",
        "breakdown",
        "over_current",
        "sag",
        "interlock",
        "inhibit",
    ),
}


class Fault(Table):
    """Something that goes wrong at a given time.

    ``kind`` is one of the wire's faults (delay, drop, split, merge, duplicate, corrupt, silent, vanish), which act
    on each message with ``probability``, or one of the instrument's own (`DEVICE_FAULTS`).

    alert sends unsolicited lines every ``value`` seconds; with ``value = 0`` one between each command and its reply,
    with ``probability``. Otherwise ``value`` is: seconds for delay and split; amperes drawn beside the film for
    over_current; the part of the voltage that is left for sag; the sign of the rail for saturate; the bit pattern for
    wrong_status of force and hv.
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
        allowed = LINK_FAULTS + DEVICE_FAULTS[self.role]
        if self.role == "hv":
            allowed = tuple(kind for kind in allowed if kind not in ("split", "merge"))  # a CAN frame is one piece
        if self.kind not in allowed:
            raise ValueError(f"{self.role} has no fault {self.kind!r}; it has {', '.join(allowed)}")
        return self


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


class StageTruth(Table):
    """Zaber X-LSQ150B-E01 on ASCII."""

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


class ForceTruth(Table):
    """Strain-gauge cell on an ME-Messsysteme GSV-8."""

    serial_number: int = 14_209_876
    channel: Annotated[int, Field(ge=1, le=8)] = 1
    full_scale_N: Positive = 0.5
    sensitivity_mV_per_V: Positive = Field(default=2.0, description="nominal output at full scale")
    gain_error: float = Field(default=0.0, description="hidden relative error of the sensitivity")
    zero_offset_mV_per_V: float = 0.013
    noise_fraction: NonNegative = Field(default=0.005, description="standard deviation of a sample, of full scale")
    input_range_mV_per_V: Positive = Field(default=3.5, description="input range at 5 V bridge supply")
    raw_range_factor: Positive = Field(default=1.05, description="largest raw number, in input ranges")
    stored_rate_Hz: Positive = Field(default=100.0, description="rate at which it streams after power-up")
    clock_drift_ppm: float = 0.0
    reboot_s: Positive = 1.0
    link: LinkTruth = LinkTruth(latency_ms=1.0, baud=0)


class DisplacementTruth(Table):
    """Keyence LK-G152 laser triangulation head."""

    range_mm: Positive = 40.0
    offset_mm: float = 1.25
    gain_error: float = Field(default=0.0, description="hidden relative error of the scale")
    noise_um: NonNegative = Field(default=0.5, description="standard deviation of a reading as averaged at power-up")
    resolution_um: Positive = 0.1
    averaging_code: Annotated[int, Field(ge=0, le=9)] = Field(default=4, description="4^code samples, as in SW,OC")
    sampling_code: Annotated[int, Field(ge=0, le=5)] = Field(default=1, description="20, 50, 100, 200, 500, 1000 us")
    answer_ms: NonNegative = 1.0
    link: LinkTruth = LinkTruth()


class HVTruth(Table):
    """iseg EDCP module on CAN with one channel, and what hangs on its output."""

    serial_number: int = 484_216
    module: Annotated[int, Field(ge=0, le=63)] = 0
    channels: Annotated[int, Field(ge=1, le=16)] = 1
    bitrate: Literal[125_000, 250_000] = 125_000
    latency_ms: NonNegative = 0.5
    nominal_voltage_V: Positive = 6000.0
    nominal_current_mA: Positive = 1.0
    ramp_percent_per_s: Positive = Field(default=10.0, description="voltage ramp at power-up, of nominal")
    max_ramp_percent_per_s: Positive = 20.0
    fall_time_s: Positive = Field(default=0.05, description="time in which the output falls to zero when cut")
    gain_error: float = Field(default=0.0, description="hidden relative error of set-point and monitor together")
    voltage_noise_V: NonNegative = 0.3
    current_noise_nA: NonNegative = 5.0
    film_capacitance_nF: NonNegative = 0.7
    leakage_resistance_GOhm: Positive = 20.0
    arc_resistance_kOhm: Positive = 10.0
    voltage_limit_percent: Positive = Field(default=100.0, description="hardware limit, of nominal")
    current_limit_percent: Positive = Field(default=100.0, description="hardware limit, of nominal")
    logon_period_s: Positive = 5.0
    start_live_V: NonNegative = Field(default=0.0, description="output found on at this voltage; 0: found off")


class SimulationSettings(Table):
    """Everything about the simulated bench that the host cannot know.

    ``contact_position_mm`` is the stage position at which the pusher meets the flat disk. Force and displacement of
    the disk are zero before; beyond it the stage's way is shared between film and rig,
    ``stage - contact = displacement + compliance x force``.
    """

    seed: int
    contact_position_mm: NonNegative = 40.0
    rig_compliance_um_per_N: NonNegative = 2.0
    film: FilmTruth = FilmTruth()
    stage: StageTruth = StageTruth()
    force: ForceTruth = ForceTruth()
    displacement: DisplacementTruth = DisplacementTruth()
    hv: HVTruth = HVTruth()
    fault: list[Fault] = Field(default_factory=list)
