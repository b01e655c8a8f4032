"""LabJack T4, T7 and T8 on Modbus TCP: an analogue HV amplifier, and sensors with a voltage output.

The presets are values of the makers' data sheets, from memory or from working rigs: hold them against the unit's own.
Whatever they say, a small step proves gain and monitor before the output is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from drivers.instrument import Instrument
from drivers.instruments.labjack.amplifier import Amplifier, LabJackAmplifier
from drivers.instruments.labjack.analog_input import AnalogDisplacement, AnalogForce, AnalogMonitor
from drivers.instruments.labjack.codec import LONGEST
from drivers.instruments.labjack.shared import shared
from drivers.links.link import ByteLink
from drivers.recorded import Dialect, Exchange
from drivers.settings import ForceSettings, MonitorSettings, Positive, SupplySettings, TcpSettings

DC_SLEW_V_PER_US = 1e-3  # of amplifiers whose data sheet states none: slow enough for any

PRESETS = {
    "trek-610e": Amplifier(1000, 1000, 200, 10_000, 2000, 35),
    "trek-609e-6": Amplifier(1000, 1000, 2000, 4000, 20_000, 150),
    "ultravolt-5hva": Amplifier(500, 500, 20, 5000, 200, DC_SLEW_V_PER_US),
    "matsusada-amt-5b20": Amplifier(500, 500, 2000, 5000, 20_000, 360),
}
"""By name: gain (V/V), volts of the output per volt of its monitor, uA per volt of the current monitor, ends of voltage
(V) and current (uA), slew (V/us)."""

_TYPED = tuple(field.name for field in fields(Amplifier) if field.name != "polarity")


class AmplifierSettings(SupplySettings, TcpSettings):
    """An analogue HV amplifier, driven and measured by a LabJack."""

    measures_current: ClassVar[bool] = True
    asks_per_sample: ClassVar[int] = 4

    driver: Literal["labjack-amplifier"] = Field(description="Analogue HV amplifier through a LabJack T4, T7 or T8.")
    preset: Literal["trek-610e", "trek-609e-6", "ultravolt-5hva", "matsusada-amt-5b20"] | None = Field(
        default=None,
        description="Amplifier whose data-sheet values hold for absent keys; check them.",
    )
    gain_V_per_V: Positive | None = Field(default=None, description="Output per input (V/V). Typical: 1000.")
    voltage_monitor_V_per_V: Positive | None = Field(
        default=None, description="Output per volt of the voltage monitor (V/V). Typical: 1000."
    )
    current_monitor_uA_per_V: Positive | None = Field(
        default=None, description="Current per volt of the current monitor (uA/V). Typical: 200."
    )
    full_scale_V: Positive | None = Field(default=None, description="Highest output of the amplifier (V).")
    current_limit_uA: Positive | None = Field(default=None, description="Largest current of the amplifier (uA).")
    slew_V_per_us: Positive | None = Field(default=None, description="Fastest change of the output (V/us).")
    polarity: Literal[1, -1] = Field(default=1, description="-1: a positive input gives a negative output.")
    dac: int = Field(default=0, ge=0, le=1, description="Analogue output that the amplifier's input is on.")
    voltage_ain: int = Field(default=0, ge=0, le=13, description="Analogue input with the voltage monitor.")
    current_ain: int = Field(default=1, ge=0, le=13, description="Analogue input with the current monitor.")
    enable_line: int | None = Field(
        default=None,
        ge=0,
        le=22,
        description="Digital line that enables it; 0: FIO0, 8: EIO0. Absent: there is none.",
    )
    enable_high: bool = Field(
        default=False, description="Whether a high level enables; a line that floats after power-up is high."
    )
    watchdog_s: int = Field(
        default=3,
        ge=1,
        le=60,
        description="The device goes off this long after its last key (s). Typical: 2 to 5.",
    )
    proof_V: float = Field(
        default=50.0, gt=0, le=55, description="Step that proves gain and monitor before the output is used (V)."
    )
    proof_tolerance: float = Field(
        default=0.15, gt=0, le=0.5, description="How far off that step may show, relative. Typical: 0.05 to 0.2."
    )
    poll_rate_Hz: float = Field(
        default=20.0,
        ge=2,
        le=100,
        description="How often monitors are read and the ramp makes a step (Hz).",
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.preset is None and (missing := [key for key in _TYPED if getattr(self, key) is None]):
            raise ValueError(f"{', '.join(missing)} must be given, or a preset; presets are {', '.join(PRESETS)}")
        if self.voltage_ain == self.current_ain:
            raise ValueError("voltage_ain and current_ain are the same input")
        return self

    @property
    def amplifier(self) -> Amplifier:
        """The preset's values with those that the scene gives in their place."""
        typed = {key: getattr(self, key) for key in _TYPED}
        known = {} if self.preset is None else {key: getattr(PRESETS[self.preset], key) for key in _TYPED}
        return Amplifier(
            **{**known, **{key: value for key, value in typed.items() if value is not None}}, polarity=self.polarity
        )


class InputSettings(TcpSettings):
    """A sensor on a LabJack's input. It takes two connections: its sensors share one, the guard has the other."""

    @property
    def shared_place(self) -> tuple[object, ...] | None:
        return (self.host, self.tcp_port)

    def open_shared(self, names: Sequence[str]) -> Sequence[ByteLink]:
        return shared(self.open(" and ".join(names)), len(names))


class AnalogForceSettings(ForceSettings, InputSettings):
    """A force sensor with a voltage output on a LabJack; its certificate corrects the newtons of ``newtons_per_V``."""

    driver: Literal["labjack-force"] = Field(description="Load cell with a voltage output on a LabJack's input.")
    ain: int = Field(default=2, ge=0, le=13, description="Analogue input that it is on.")
    newtons_per_V: float = Field(
        description="Force per volt (N/V), as its conditioner is set; negative if it is inverted."
    )
    rate_Hz: float = Field(default=50.0, gt=0, le=200, description="How often it is read (Hz). Typical: 50.")


class AnalogDisplacementSettings(InputSettings):
    """A displacement sensor with a voltage output on a LabJack."""

    rate_key: ClassVar[str] = "rate_Hz"

    driver: Literal["labjack-displacement"] = Field(
        description="Displacement sensor with a voltage output on a LabJack."
    )
    ain: int = Field(default=3, ge=0, le=13, description="Analogue input that it is on.")
    mm_per_V: float = Field(description="Displacement per volt (mm/V); negative if it is inverted.")
    rate_Hz: float = Field(default=50.0, gt=0, le=200, description="How often it is read (Hz). Typical: 50.")


class AnalogMonitorSettings(MonitorSettings, InputSettings):
    """A high-voltage probe, a thermometer or a hygrometer on an input of a LabJack; ``factor`` is per volt."""

    driver: Literal["labjack-monitor"] = Field(
        description="Probe or sensor with a voltage output on a LabJack's input."
    )
    ain: int = Field(default=4, ge=0, le=13, description="Analogue input that it is on.")


class Frames(Dialect):
    """Requests say how long they are and bear a number, which their answers bear too."""

    def __init__(self) -> None:
        super().__init__(b"")

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        whole = []
        while len(data) >= 6 and len(data) >= (length := 6 + min(int.from_bytes(data[4:6], "big"), LONGEST)):
            whole.append(data[:length])
            data = data[length:]
        return whole, data

    def key(self, request: bytes) -> bytes:
        return request[2:]

    def anew(self, exchange: Exchange, request: bytes) -> tuple[tuple[float, bytes], ...]:
        return tuple(
            (delay, request[:2] + data[2:] if data[:2] == exchange.request.data[:2] else data)
            for delay, data in exchange.answers
        )


INSTRUMENTS = (
    Instrument("labjack-amplifier", "hv", AmplifierSettings, LabJackAmplifier, Frames()),
    Instrument("labjack-force", "force", AnalogForceSettings, AnalogForce, Frames()),
    Instrument("labjack-displacement", "displacement", AnalogDisplacementSettings, AnalogDisplacement, Frames()),
    Instrument("labjack-monitor", "monitor", AnalogMonitorSettings, AnalogMonitor, Frames()),
)
