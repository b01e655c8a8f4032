"""What a stage, a force sensor, a displacement sensor, an HV supply and a monitor can do, and the samples they give.

A driver is polled: ``poll(now)`` reads what has arrived, sends what is due, and returns the new samples. It never
blocks and never asks the time itself. After construction a driver first runs its set-up dialogue; ``ready`` is True
when that has ended. It raises a `drivers.links.link.DeviceError` when the operator must act. Corrupted input is dropped
and counted in ``counters``, never returned as a sample.

SI units throughout: metres, newtons, volts, amperes, seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Flag, auto
from typing import Protocol, runtime_checkable

from drivers.settings import Quantity


class SampleFlag(Flag):
    """What is wrong with a sample. ``SampleFlag(0)`` means nothing is known to be wrong."""

    OVER_RANGE = auto()
    UNDER_RANGE = auto()
    NO_VALUE = auto()
    SENSOR_ERROR = auto()


OK = SampleFlag(0)


class HVFlag(Flag):
    """State of an HV channel, in words that every supply can be translated to."""

    ON = auto()
    RAMPING = auto()
    VOLTAGE_LIMIT = auto()
    CURRENT_LIMIT = auto()
    TRIPPED = auto()
    INHIBITED = auto()
    EMERGENCY_OFF = auto()
    INTERLOCK_OPEN = auto()
    ARC = auto()
    FAULT = auto()


@dataclass(frozen=True, slots=True)
class StageSample:
    """Position of the stage at time ``t``; ``raw`` in the device's own steps."""

    t: float
    position: float
    moving: bool
    referenced: bool
    raw: int
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ForceSample:
    """Reading of a force sensor in its own unit (``ForceSensor.reading_unit``); NaN when there is no value."""

    t: float
    reading: float
    flags: SampleFlag = OK


@dataclass(frozen=True, slots=True)
class DisplacementSample:
    """Displacement in metres as the sensor states it; NaN when there is no value."""

    t: float
    displacement: float
    flags: SampleFlag = OK


@dataclass(frozen=True, slots=True)
class HVSample:
    """Measured voltage and current of the output, with the set-point read back from the device.

    The current is NaN when there is no value, and always where the supply does not measure it.
    """

    t: float
    voltage: float
    current: float
    setpoint: float
    flags: HVFlag


@dataclass(frozen=True, slots=True)
class MonitorSample:
    """A slow reading beside those of the rig: volts, kelvin, or part of saturation (0 to 1), as ``quantity`` says.

    ``role`` is the name of the instrument that gave it; the value is NaN when there is none.
    """

    t: float
    role: str
    quantity: Quantity
    value: float
    flags: SampleFlag = OK


Sample = StageSample | ForceSample | DisplacementSample | HVSample | MonitorSample


@dataclass(frozen=True, slots=True)
class Identity:
    """Who answered: as the device states it, empty where it does not."""

    model: str = ""
    serial: str = ""
    firmware: str = ""


class Device(Protocol):
    """What the engine needs of every device.

    ``next_poll`` is the clock time at which the device wants to be polled next; polling earlier does no harm.
    ``settings`` holds what was read back from the device, for the log. ``counters`` counts dropped bytes, bad
    checksums, retries and the like.
    """

    name: str
    identity: Identity
    settings: dict[str, str]
    counters: dict[str, int]

    @property
    def ready(self) -> bool: ...

    @property
    def next_poll(self) -> float: ...

    def poll(self, now: float) -> Sequence[Sample]: ...

    def close(self) -> None: ...


class Stage(Device, Protocol):
    """A linear stage. Commands are queued and sent at once or at the next poll.

    ``moving`` is True from the moment a motion command is queued until a reply that follows its acceptance says
    the stage stands still. ``travel`` is (lowest, highest) position in metres as the device allows it. Moving an
    unreferenced stage raises `DeviceRefused`.
    """

    @property
    def travel(self) -> tuple[float, float]: ...

    @property
    def moving(self) -> bool: ...

    @property
    def referenced(self) -> bool: ...

    def braking_distance(self, speed: float) -> float:
        """How far it goes on (m) when it brakes from ``speed`` (m/s)."""
        ...

    def home(self) -> None: ...

    def move_to(self, position: float, speed: float) -> None: ...

    def stop(self) -> None:
        """Decelerate to a standstill; overtakes everything queued."""
        ...


@runtime_checkable
class GivesBack(Protocol):
    """A device that changes settings of its own for what it is told to do, and puts them back.

    ``found`` holds them as set-up found them, by name; set-up itself changes none. ``given_back`` is True while the
    device has confirmed that all of them are as in ``found``; `close` puts back the rest without waiting.
    """

    @property
    def found(self) -> Mapping[str, float]: ...

    @property
    def given_back(self) -> bool: ...

    def resume_found(self, found: Mapping[str, float]) -> Mapping[str, tuple[float, float]]:
        """Take over what an earlier run found that ended without giving it back: by name what is now and was before.

        Nothing, where the device shows that somebody has put it right since.
        """
        ...

    def give_back(self) -> None:
        """Put every setting back to what was found, after what is queued."""
        ...


@runtime_checkable
class Remarking(Protocol):
    """A device with something to say that the operator should know, and that ends nothing."""

    def remarks(self) -> list[str]:
        """What is new since the last call, as sentences without their full stop."""
        ...


class ForceSensor(Device, Protocol):
    """A force sensor that streams at ``rate`` hertz in ``reading_unit`` ("mV/V" for a strain-gauge bridge)."""

    reading_unit: str

    @property
    def rate(self) -> float: ...


class DisplacementSensor(Device, Protocol):
    """A displacement sensor polled or streaming at ``rate`` hertz."""

    @property
    def rate(self) -> float: ...


class Monitor(Device, Protocol):
    """A reading beside those of the rig, ``rate`` times a second: of ``quantity``."""

    quantity: Quantity

    @property
    def rate(self) -> float: ...


@runtime_checkable
class Renewed(Protocol):
    """A supply with a watchdog that takes the output off by itself some time after the last `renew`.

    Only the code that decides on the output calls it, each time it has decided.
    """

    def renew(self) -> None: ...


@runtime_checkable
class OwnTrip(Protocol):
    """A supply that takes its output off by itself, when it is told beforehand what is too much."""

    def arm_trip(self, volts: float, amperes: float) -> None:
        """Report a voltage that is ``volts`` away from the set-point; trip when more than ``amperes`` are drawn."""
        ...


class HVSupply(Device, Protocol):
    """One channel of a high-voltage supply. Constructing and polling it changes no output.

    Every write is read back; a set-point that does not come back as written raises `DeviceRefused`.

    ``measures_current`` says whether it measures its output current and can limit it. Where it does not, every sample's
    current is NaN and `set_current_limit` raises `DeviceRefused`.
    """

    measures_current: bool

    @property
    def nominal(self) -> tuple[float, float]:
        """(volts, amperes) the channel can give at most."""
        ...

    @property
    def fastest_ramp(self) -> float:
        """The fastest ramp it takes (V/s)."""
        ...

    @property
    def busy(self) -> bool:
        """True while a command is waiting to be sent or verified."""
        ...

    def set_ramp(self, volts_per_second: float) -> None: ...

    def set_current_limit(self, amperes: float) -> None: ...

    def set_voltage(self, volts: float) -> None:
        """New set-point; the output ramps there if the channel is on."""
        ...

    def switch_on(self) -> None: ...

    def switch_off(self) -> None:
        """Ramp the output down to zero and switch the channel off."""
        ...

    def emergency_off(self) -> None:
        """Take the output off at once; latched until `clear`. Overtakes everything queued."""
        ...

    def clear(self) -> None:
        """Clear latched events and the emergency-off state. Leaves the channel off."""
        ...
