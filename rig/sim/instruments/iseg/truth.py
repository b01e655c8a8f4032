"""What is true about a simulated iseg module and the host cannot know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from rig.sim.truth import IN_REACH, ONE_PIECE, BusTruth, NotNegative, OutputTruth, Positive


class IsegTruth(OutputTruth, BusTruth):
    """iseg EDCP module on CAN; the film is on its first channel."""

    means_nothing: ClassVar[Mapping[str, str]] = ONE_PIECE | IN_REACH
    more_faults: ClassVar[tuple[str, ...]] = (*OutputTruth.more_faults, "interlock", "inhibit")

    driver: Literal["iseg-edcp"] = Field(default="iseg-edcp", description="iseg supply on CAN.")
    serial_number: int = Field(default=484_216, description="Serial number that it states.")
    module: int = Field(default=0, ge=0, le=63, description="Its module number.")
    channels: int = Field(default=1, ge=1, le=16, description="How many channels it has.")
    bitrate: Literal[125_000, 250_000] = Field(default=125_000, description="Of the bus (bit/s).")
    nominal_voltage_V: Positive = Field(default=6000.0, description="Nominal voltage of a channel (V).")
    nominal_current_mA: Positive = Field(default=1.0, description="Nominal current of a channel (mA).")
    ramp_percent_per_s: Positive = Field(default=10.0, description="Voltage ramp at power-up (% of nominal per s).")
    max_ramp_percent_per_s: Positive = Field(default=20.0, description="Fastest voltage ramp (% of nominal per s).")
    voltage_noise_V: NotNegative = Field(default=0.3, description="Standard deviation of a voltage reading (V).")
    current_noise_nA: NotNegative = Field(default=5.0, description="Standard deviation of a current reading (nA).")
    voltage_limit_percent: Positive = Field(default=100.0, description="Hardware voltage limit (% of nominal).")
    current_limit_percent: Positive = Field(default=100.0, description="Hardware current limit (% of nominal).")
    limit_good_bit: bool = Field(
        default=False, description="Whether bit 5 of its status says that the hardware limit is good; most say nothing."
    )
    negative: bool = Field(default=False, description="Whether its channels give negative voltages.")
    logon_period_s: Positive = Field(default=5.0, description="How often it announces itself, not registered (s).")
