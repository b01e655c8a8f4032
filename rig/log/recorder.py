"""What the engine knows of the bench right now, and the rows that it writes of it.

Samples come in as the drivers give them; here they become newtons and metres by the sensors' certificates and the
references taken during the run, and each is written with its raw reading beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from drivers.roles import OK, DisplacementSample, ForceSample, HVSample, Identity, MonitorSample, Sample, StageSample
from rig.base.clock import Clock
from rig.base.errors import FaultError
from rig.log import space
from rig.log.errors import LogError
from rig.log.schema import MONITORED, Way

if TYPE_CHECKING:
    from rig.log.process import LogProcess
    from rig.log.writer import LogWriter

Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Gains:
    """Quantity per reading of each sensor, from the certificates; 1.0 for a sensor that states SI itself."""

    force: float = 1.0  # N per `force_unit`
    displacement: float = 1.0
    voltage: float = 1.0
    force_unit: str = "mV/V"  # of the force sensor's readings, as its certificate has it
    stored_zero: float | None = None  # reading of the unloaded force sensor, as stored with its serial number and date
    second: float = 1.0  # of the monitor that reads the voltage


class Recorder:
    """Turns samples into quantities, keeps the newest of each, and writes the log.

    ``force`` and ``displacement`` are NaN until their references are known.
    """

    def __init__(self, log: LogWriter | LogProcess, clock: Clock, gains: Gains, *, has_laser: bool) -> None:
        self._log = log
        self._clock = clock
        self._gains = gains
        self.stage: StageSample | None = None
        self.force_sample: ForceSample | None = None
        self.displacement_sample: DisplacementSample | None = None
        self.hv: HVSample | None = None
        self.monitors: dict[str, MonitorSample] = {}  # the newest, by quantity
        self.force_zero = math.nan
        self.displacement_zero = math.nan
        self.contact = math.nan
        self.speed = 0.0  # of the stage, as last asked for
        self.has_laser = has_laser
        self.turn = 0.0  # when the loop's present turn began
        self.log_failed = False
        self.keeping = True  # whether the log keeps everything: `rig.log.decimation`
        self._told_of_space = False
        self.best_effort = False  # on the way to the safe state a log that fails is no reason to stop

    @property
    def force(self) -> float:
        """Newest force on the film (N)."""
        return math.nan if self.force_sample is None else self.quantity_of(self.force_sample)

    @property
    def displacement(self) -> float:
        """Displacement of the disk (m): by the laser where there is one, else stage position minus contact."""
        if self.has_laser:
            if self.displacement_sample is None:
                return math.nan
            return self.quantity_of(self.displacement_sample)
        return math.nan if self.stage is None else self.stage.position - self.contact

    def quantity_of(self, sample: ForceSample | DisplacementSample) -> float:
        """Newtons or metres of one sample by certificate and reference."""
        if isinstance(sample, ForceSample):
            return self._gains.force * (sample.reading - self.force_zero)
        return self._gains.displacement * (sample.displacement - self.displacement_zero)

    def without_zero(self, sample: DisplacementSample) -> float:
        """Metres of one sample by the certificate, whatever zero the run has taken."""
        return self._gains.displacement * sample.displacement

    def from_stored_zero(self, reading: float) -> float:
        """Newtons of one reading against the stored zero, whatever zero the run has taken; 0 where none is stored."""
        return self._gains.force * (reading - (self._gains.stored_zero or 0.0))

    @property
    def has_stored_zero(self) -> bool:
        """Whether a zero of the force sensor is stored."""
        return self._gains.stored_zero is not None

    def add(self, sample: Sample) -> Sample:
        """Take in one sample, write it, and give it back; a measured voltage comes back by its certificate."""
        if isinstance(sample, HVSample):
            sample = replace(sample, voltage=sample.voltage * self._gains.voltage)
        elif isinstance(sample, MonitorSample) and sample.quantity == "voltage":
            sample = replace(sample, value=sample.value * self._gains.second)
        match sample:  # the most frequent first
            case ForceSample():
                self.force_sample = sample
                self._write(
                    "/force/sample",
                    sample.t,
                    reading=sample.reading,
                    force_N=self.quantity_of(sample),
                    flags=0 if sample.flags == OK else sample.flags.value,
                )
            case StageSample():
                self.stage = sample
                self._write(
                    "/stage/sample",
                    sample.t,
                    position_m=sample.position,
                    moving=sample.moving,
                    referenced=sample.referenced,
                    raw_steps=sample.raw,
                    warnings=" ".join(sample.warnings),
                )
            case DisplacementSample():
                self.displacement_sample = sample
                self._write(
                    "/displacement/sample",
                    sample.t,
                    reading_m=sample.displacement,
                    displacement_m=self.quantity_of(sample),
                    flags=sample.flags.value,
                )
            case HVSample():
                self.hv = sample
                self._write(
                    "/hv/sample",
                    sample.t,
                    voltage_V=sample.voltage,
                    current_A=sample.current,
                    setpoint_V=sample.setpoint,
                    flags=sample.flags.value,
                )
            case MonitorSample():
                self.monitors[sample.quantity] = sample
                shown = dict.fromkeys(MONITORED.values(), math.nan) | {MONITORED[sample.quantity]: sample.value}
                self._write(f"/{sample.role}/sample", sample.t, **shown, flags=sample.flags.value)
        return sample

    def wire(self, role: str, way: Way, data: bytes, t: float) -> None:
        """Write bytes as they were on the wire; ``t`` is the time that the driver was told.

        The time that the message is about is that of the loop's turn: what was read and sent in one turn has it in
        common.
        """
        self._write(f"/raw/{role}/{way}", t, about=self.turn, data=data)

    def command(self, device: str, command: str, argument: str, t: float | None = None) -> None:
        """Write a command, called before it is given; or at ``t`` by another process, which tells it first."""
        self._write(
            "/command", self._clock.now() if t is None else t, device=device, command=command, argument=argument
        )

    def event(self, severity: Severity, source: str, message: str) -> None:
        """Write something that a reader of the log should know."""
        self._write("/event", self._clock.now(), severity=severity, source=source, message=message)

    def operator(self, act: str, text: str, by: str) -> None:
        """Write an act of the operator.

        "is asked", "answers", "pauses", "continues", "stops", "arms", "may be cleared".
        """
        self._write("/operator", self._clock.now(), act=act, text=text, by=by)

    def identity(self, device: str, identity: Identity, settings: Mapping[str, str]) -> None:
        """Write who answered as a device, and what was read back from it."""
        t = self._clock.now()
        self._write(
            "/identity", t, device=device, model=identity.model, serial=identity.serial, firmware=identity.firmware
        )
        for name, value in sorted(settings.items()):
            self._write("/setting", t, device=device, name=name, value=value)

    def certificate_problem(self, device: str, problem: str) -> None:
        """Write what speaks against using a certificate."""
        self._write("/certificate_problem", self._clock.now(), device=device, problem=problem)

    def counters(self, device: str, counters: Mapping[str, int]) -> None:
        """Write what a device has counted; from then on it is only closed."""
        for name, count in sorted(counters.items()) or [("none", 0)]:
            self._write("/counter", self._clock.now(), device=device, name=name, count=count)

    def reference(self, name: str, value: float, standard_uncertainty: float, unit: str) -> None:
        """Write a reference taken during the run (a zero, the contact position)."""
        self._write(
            "/reference",
            self._clock.now(),
            name=name,
            value=value,
            standard_uncertainty=standard_uncertainty,
            unit=unit,
        )

    def result(
        self, step: int, kind: str, outcome: str, name: str, value: float, standard_uncertainty: float, unit: str
    ) -> None:
        """Write what a step has found, in SI units; NaN for an uncertainty that is not known."""
        self._write(
            "/result",
            self._clock.now(),
            step=step,
            kind=kind,
            outcome=outcome,
            name=name,
            value=value,
            standard_uncertainty=standard_uncertainty,
            unit=unit,
        )

    def decision(self, fields: Mapping[str, object]) -> None:
        """Write what a closed loop does next, and why."""
        self._write("/decision", self._clock.now(), about=None, **fields)

    def standing(self, fields: Mapping[str, object]) -> None:
        """Write how well one of the quantities is known that a closed loop is to find."""
        self._write("/standing", self._clock.now(), about=None, **fields)

    def cycle(self, fields: Mapping[str, object]) -> None:
        """Write the summary of a cycle that has ended."""
        self._write("/cycle", self._clock.now(), about=None, **fields)

    def keep(self, keeping: bool, cause: str, before_s: float = 0.0) -> None:
        """From here on write everything, and the last ``before_s`` seconds late; or leave out what cycling repeats."""
        self.keeping = keeping
        self._write("/kept", self._clock.now(), keeping=keeping, before_s=before_s, cause=cause)

    def units(self, force: str) -> None:
        """Write the unit of the force sensor's readings, which have none in their name, and all gains."""
        self._metadata("units", {"/force/sample reading": force})
        gains = {"force": self._gains.force, "displacement": self._gains.displacement, "voltage": self._gains.voltage}
        self._metadata("gains", {name: repr(gain) for name, gain in gains.items()})

    def snapshot(self, cause: str, at: float, before: float, after: float) -> None:
        """Mark the seconds around what went wrong: every sample of theirs is in the log."""
        self.event("info", "engine", f"snapshot from {at - before:.3f} to {at + after:.3f} s")
        times = {"at_s": at, "from_s": max(at - before, 0.0), "to_s": at + after}
        self._metadata("snapshot", {"cause": cause, **{key: f"{value:.3f}" for key, value in times.items()}})

    def _metadata(self, name: str, table: Mapping[str, str]) -> None:
        if self.log_failed:
            return
        try:
            self._log.metadata(name, table)
        except LogError as error:
            self._lost(error)

    def phase(self, fields: Mapping[str, object]) -> None:
        """Write the beginning of an action."""
        self._write("/phase", self._clock.now(), about=None, **fields)

    def target(self, displacement: float, voltage: float, speed: float) -> None:
        """Write where the rig is being sent."""
        self._write("/target", self._clock.now(), displacement_m=displacement, voltage_V=voltage, speed_m_per_s=speed)

    def tick(self, now: float) -> None:
        """Let the log send what is due to its file, and look at the room it has left on its disk."""
        if self.log_failed:
            return
        try:
            free = self._log.tick(now)
        except LogError as error:
            self._lost(error)
            return
        if free is None or free >= space.WARN_FREE:
            return
        left = f"its disk has {free / 1e6:.0f} MB left"
        if not self._told_of_space:
            self._told_of_space = True
            self.event("warning", "log", f"{left}; the run ends when it is less than {space.LEAST_FREE / 1e6:.0f} MB")
        if free < space.LEAST_FREE and not self.best_effort:  # the log itself is sound and can be finished
            full = LogError(self._log.path, left, "The run ended before the disk was full. Free some space.")
            full.exit_code = FaultError.exit_code
            raise full

    def _write(self, topic: str, t: float, *, about: float | None = None, **fields: object) -> None:
        """The first error of the log ends the run; after it the way to the safe state goes on unrecorded."""
        if self.log_failed:
            return
        clock = self._clock
        about_ns = clock.epoch_ns(t if about is None else about)
        fields["t_s"] = t
        try:
            self._log.write(topic, fields, clock.epoch_ns(clock.now()), about_ns)
        except LogError as error:
            self._lost(error)

    def _lost(self, error: LogError) -> None:
        """A log that fails is a fault of the rig; on the way to the safe state it is no reason to stop."""
        self.log_failed = True
        if not self.best_effort:
            error.exit_code = FaultError.exit_code
            raise error
