"""What a scene says of an instrument: the base of every instrument's table, with the keys that all have in common.

An instrument declares its keys here once: name with unit, default, range and description. The scene's tables, the
reference page (``dea-rig keys``), the editor's completion and the error messages are all made from them.
"""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

if TYPE_CHECKING:
    from drivers.links.link import ByteLink, FrameLink

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Table(BaseModel):
    """A TOML table: strict types, no unknown keys, no NaN or inf.

    Keys carry their unit (``thickness_um``) and a description; lists are ``list``, never tuples. What checks a table is
    built when the first of its kind is read: most programs read few of the many kinds, and a guard starts sooner.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


class InstrumentSettings(Table):
    """What every instrument has.

    ``rate_key`` is the key that says how often it gives a sample. ``place_keys`` are the keys that name its port or
    bus; without them it is looked for on the simulated bench. ``asks_per_sample`` is how many questions, one after the
    other, a sample takes; 0 for one that streams.
    """

    asks_per_sample: ClassVar[int] = 1

    rate_key: ClassVar[str] = "poll_rate_Hz"
    place_keys: ClassVar[tuple[str, ...]] = ()

    driver: str = Field(description="Which kind of instrument it is.")
    timeout_s: float = Field(
        default=0.25,
        gt=0,
        le=10,
        description="How long to wait for each answer (s). Typical: 0.1 to 0.5.",
    )
    boot_s: float = Field(
        default=10.0,
        ge=0,
        le=60,
        description="How long it may take to start (s): for so long its first answer is waited for. Typical: 2 to 10.",
    )
    serial: str | None = Field(
        default=None,
        description="Serial number that it must state, else the run is refused. Absent: any.",
    )
    certificate: str | None = Field(
        default=None,
        description="Calibration certificate, seen from the scene. Absent: values as stated.",
    )

    _looked_first: bool | None = PrivateAttr(default=None)

    @property
    def connected(self) -> bool:
        """Whether a port or bus is named."""
        return any(getattr(self, key) is not None for key in self.place_keys)

    @property
    def looks_first(self) -> bool:
        """Whether the driver reads what it changes before it does, to put it back: where a device outlives the run."""
        return self.connected if self._looked_first is None else self._looked_first

    def as_recorded(self, sent: Sequence[bytes]) -> None:
        """From now on the driver looks first if it did when ``sent`` was recorded; earlier releases did not."""

    @property
    def sample_rate(self) -> float:
        """How often it is to give a sample (Hz)."""
        return float(getattr(self, self.rate_key))

    @property
    def shared_place(self) -> tuple[object, ...] | None:
        """Sensors with the same one get one connection between them, by `open_shared`; None: each has its own."""
        return None

    def open_shared(self, names: Sequence[str]) -> Sequence[ByteLink | FrameLink]:
        """As `open`, one link for each of the instruments called ``names``; over one connection where they share it."""
        return [self.open(name) for name in names]

    @property
    def two_may_hold(self) -> bool:
        """Whether two processes may have the link at once: one opens it, and the other adopts it or opens it too."""
        return hasattr(socket, "send_fds")

    @abstractmethod
    def open(self, name: str, adopt: Sequence[int] = ()) -> ByteLink | FrameLink:
        """Open the port or bus; sends nothing to the instrument. ``name`` is the instrument's in messages.

        ``adopt`` are the descriptors of one that another process has opened, as the links give them.

        Raises
        ------
        drivers.links.link.DeviceError
            It cannot be opened, or somebody else has it.
        """


class SerialSettings(InstrumentSettings):
    """What every instrument on a serial port has."""

    place_keys: ClassVar[tuple[str, ...]] = ("port",)

    port: str | None = Field(
        default=None,
        min_length=1,
        description='Serial port, e.g. "/dev/ttyUSB0" or "COM3" (`dea-rig devices` lists them), or a device server, '
        '"socket://HOST:PORT" or "rfc2217://HOST:PORT". Absent: simulated.',
    )
    baud: int = Field(default=115_200, gt=0, description="Line rate (bit/s), as set in the instrument.")

    def open(self, name: str, adopt: Sequence[int] = ()) -> ByteLink:
        from drivers.links.device_server import open_line

        assert self.port is not None
        return open_line(name, self.port, self.baud, adopt=adopt)


class CanSettings(InstrumentSettings):
    """What every instrument on a CAN bus has."""

    place_keys: ClassVar[tuple[str, ...]] = ("interface", "can_channel")

    interface: (
        Literal["slcan", "socketcan", "pcan", "vector", "kvaser", "ixxat", "gs_usb", "virtual", "udp_multicast"] | None
    ) = Field(
        default=None,
        description="Kind of CAN adapter, as python-can names it; gs_usb is candleLight. Absent: simulated.",
    )
    can_channel: str | None = Field(
        default=None,
        description='Which adapter of that kind, e.g. "can0" or "/dev/ttyACM0"; given together with interface.',
    )
    bitrate: int = Field(default=125_000, gt=0, description="Bit rate of the bus (bit/s), the same for all on it.")

    @model_validator(mode="after")
    def _pair(self) -> Self:
        if (self.interface is None) != (self.can_channel is None):
            raise ValueError("interface and can_channel belong together: give both or neither")
        return self

    @property
    def two_may_hold(self) -> bool:
        from drivers.links.can_link import SHARED

        return super().two_may_hold if self.interface == "slcan" else self.interface in SHARED

    def open(self, name: str, adopt: Sequence[int] = ()) -> FrameLink:
        from drivers.links.can_link import open_bus

        assert self.interface is not None and self.can_channel is not None
        return open_bus(name, self.interface, self.can_channel, self.bitrate, adopt=adopt)


class TcpSettings(InstrumentSettings):
    """What every instrument on a network has."""

    place_keys: ClassVar[tuple[str, ...]] = ("host",)

    host: str | None = Field(
        default=None,
        min_length=1,
        description='Address of the device, e.g. "192.168.1.207". Absent: simulated.',
    )
    tcp_port: int = Field(default=502, ge=1, le=65_535, description="TCP port on which the device listens.")

    def open(self, name: str, adopt: Sequence[int] = ()) -> ByteLink:
        from drivers.links.tcp_link import TcpLink

        assert self.host is not None
        return TcpLink(name, self.host, self.tcp_port, adopt=adopt)


class StageSettings(InstrumentSettings):
    """What every stage has."""

    poll_rate_Hz: float = Field(
        default=50.0, ge=5, le=200, description="How often the position is asked for (Hz). Typical: 50."
    )
    approach_from_mm: float = Field(
        default=0.0,
        ge=0,
        description="Stage position (mm), short of the film, to which it goes fast and where the slow approach begins.",
        json_schema_extra={"usual": [0.5, 300]},
    )


class ForceSettings(InstrumentSettings):
    """What every force sensor has."""

    rate_key: ClassVar[str] = "rate_Hz"

    certificate: str = Field(
        description="Calibration certificate of the load cell, a TOML file seen from the scene: gain, date, serial."
    )


class SupplySettings(InstrumentSettings):
    """What every high-voltage supply has.

    ``measures_current`` says whether it measures its output current and can limit it; ``whole_volts`` whether it takes
    set-points in whole volts only.
    """

    measures_current: ClassVar[bool]
    whole_volts: ClassVar[bool] = False

    ramp_V_per_s: Positive = Field(
        default=100.0,
        description="How fast the voltage is raised and lowered (V/s). Typical: 50 to 500.",
        json_schema_extra={"usual": [1, 20000]},
    )
    parallel_capacitance_nF: NotNegative = Field(
        default=0.0, description="Capacitance of cable and output beside the film (nF), charged as well."
    )
    parallel_capacitance_uncertainty_nF: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of parallel_capacitance_nF (nF). 0 means exact. Default: 5 % of it "
        "and at least 0.01 nF, assumed.",
    )
    current_uncertainty_percent: NotNegative | None = Field(
        default=None,
        description="Standard uncertainty (k = 1) of the gain of the measured current, % of the reading. 0 means "
        "exact. Default: 1, assumed.",
    )


Quantity = Literal["voltage", "temperature", "humidity"]
MonitorUnit = Literal["V", "kV", "mV", "C", "K", "%"]
MONITOR_UNITS: dict[str, tuple[Quantity, float, float]] = {
    "V": ("voltage", 1.0, 0.0),
    "kV": ("voltage", 1e3, 0.0),
    "mV": ("voltage", 1e-3, 0.0),
    "C": ("temperature", 1.0, 273.15),
    "K": ("temperature", 1.0, 0.0),
    "%": ("humidity", 0.01, 0.0),
}
"""Of each unit: what it measures, its size in V, K or 1, and what 0 of it is there. The usual unit comes first."""
SLOWEST_VOLTAGE_HZ = 1.0


class MonitorSettings(InstrumentSettings):
    """What every instrument has that gives a slow reading beside those of the rig."""

    rate_key: ClassVar[str] = "rate_Hz"

    quantity: Quantity = Field(
        description='What it reads: "voltage" of the output, a second reading that must agree with the supply; off is '
        'only what both show. Or "temperature" or "humidity" of the air at the film, for log and report.'
    )
    unit: MonitorUnit | None = Field(
        default=None,
        description="What the number that it gives is in, once multiplied by factor. Absent: V, C or %, by quantity.",
    )
    factor: float = Field(
        default=1.0,
        description="What the number is multiplied by to give the unit; 1000 of a 1000:1 probe on a voltmeter "
        "(V per V). Not 0.",
    )
    offset: float = Field(default=0.0, description="What is added after that, in the unit. Typical: 0.")
    rate_Hz: float = Field(
        default=5.0,
        ge=0.05,
        le=100,
        description="How often it gives a value (Hz); of a voltage at least 1. Typical: 5.",
    )
    agrees_within_V: Positive = Field(
        default=50.0, description="How far a voltage may be from the supply's own reading (V). Typical: 20 to 100."
    )
    agrees_within_percent: NotNegative = Field(
        default=5.0,
        le=50,
        description="The same as a part of the voltage (%); the larger of the two holds. Typical: 3.",
    )
    lag_s: float = Field(
        default=0.5,
        ge=0,
        le=5,
        description="How much later than the supply it may show a change (s): its filter and its integration time. "
        "Typical: 0.1 to 1.",
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.factor == 0.0:
            raise ValueError("factor must not be 0")
        if self.unit is not None and MONITOR_UNITS[self.unit][0] != self.quantity:
            units = ", ".join(unit for unit, (quantity, _, _) in MONITOR_UNITS.items() if quantity == self.quantity)
            raise ValueError(f"unit = {self.unit!r} is none of a {self.quantity}; those are {units}")
        if self.quantity == "voltage" and self.sample_rate < SLOWEST_VOLTAGE_HZ:
            raise ValueError(f"{self.rate_key} must be at least {SLOWEST_VOLTAGE_HZ:g} Hz for a voltage")
        return self

    @property
    def to_si(self) -> tuple[float, float]:
        """(factor, offset) that make V, K or 1 of the number that the instrument gives."""
        usual = next(unit for unit, (quantity, _, _) in MONITOR_UNITS.items() if quantity == self.quantity)
        _, size, zero = MONITOR_UNITS[self.unit or usual]
        return self.factor * size, self.offset * size + zero
