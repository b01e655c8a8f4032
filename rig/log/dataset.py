"""One run as aligned arrays: what happened, on the time base of the force samples."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from rig.log.contents import certificates_in
from rig.log.errors import LogError
from rig.log.reader import Columns, Log, read_tables

if TYPE_CHECKING:
    from calibration.film.curve import Curve
    from calibration.sensors.certificate import Certificate
    from model.specimen import Specimen

Floats = NDArray[np.float64]

# Values are interpolated between neighbouring samples only; a hole longer than this many sample periods stays one.
LONGEST_PERIODS = 3.0

JOINING = ("ramp", "hold")

_TOPICS = ("/force/sample", "/displacement/sample", "/stage/sample", "/hv/sample")


class Phase(NamedTuple):
    """What began at ``t`` (s): a part of protocol step ``step``."""

    t: float
    step: int
    kind: str
    label: str
    cycle: int
    direction: int
    voltage: float
    record: bool


class Reference(NamedTuple):
    """A zero or a position taken at ``t`` (s), with its standard uncertainty in the same ``unit``."""

    t: float
    name: str
    value: float
    standard_uncertainty: float
    unit: str


class SpecimenErrors(TypedDict, total=False):
    """What is known of a specimen; see `calibration.film.curve.Curve`, which assumes what is left out."""

    thickness_uncertainty: float
    prestretch_uncertainty: float
    disk_radius_uncertainty: float
    ring_radius_uncertainty: float
    displacement_axis: float
    voltage_at_film: float
    batch: str
    eccentricity: float


class CurveErrors(SpecimenErrors, total=False):
    """The uncertainties of `calibration.film.curve.Curve`, which explains them."""

    force_noise: float  # must be there when a curve is made
    displacement_noise: float
    force_gain: float
    force_zero: float
    displacement_zero: float
    displacement_gain: float
    voltage_gain: float
    compliance_uncertainty: float
    lag_uncertainty: float


@dataclass(frozen=True, eq=False)
class Run:
    """One log, aligned. Arrays have one row per force sample; NaN marks what is not known at that instant.

    Attributes
    ----------
    log : rig.log.reader.Log
        Where it is from, with gaps, metadata and outcome.
    t : ndarray
        Time of the force sample, seconds since the start of the run, rising.
    force : ndarray
        Force on the film (N). NaN before the force zero was taken.
    h : ndarray
        Out-of-plane displacement of the film (m): by the laser where the log has one, else the stage's position
        minus the contact position. NaN before the reference was taken and inside gaps.
    voltage : ndarray
        Measured voltage (V); zeros when the scene has no HV supply.
    flagged : ndarray of bool
        Force samples that the instrument itself called bad.
    phase : ndarray of int
        Index into ``phases`` of what was going on; -1 before the first.
    phases, references : list
        In the order of time.
    """

    log: Log
    t: Floats
    force: Floats
    h: Floats
    voltage: Floats
    flagged: NDArray[np.bool_]
    phase: NDArray[np.intp]
    phases: list[Phase]
    references: list[Reference]
    force_per_reading: float  # N per unit of the reading, as applied during the run; NaN when no force was recorded

    @property
    def has_laser(self) -> bool:
        """Whether displacement was measured by a sensor of its own."""
        return "/displacement/sample" in self.log.topics

    @property
    def has_hv(self) -> bool:
        """Whether there was an HV supply."""
        return "/hv/sample" in self.log.topics

    @property
    def scene(self) -> str:
        """The text of the scene file."""
        return self._text("scene.toml")

    @property
    def protocol(self) -> str:
        """The text of the protocol file."""
        return self._text("protocol.toml")

    @property
    def certificates(self) -> dict[str, Certificate]:
        """The certificates of the sensors in use, by role."""
        return certificates_in(self.log)

    def reference(self, name: str, t: float = np.inf) -> Reference | None:
        """The newest reference of that name taken before ``t``."""
        found = [reference for reference in self.references if reference.name == name and reference.t <= t]
        return found[-1] if found else None

    def curves(
        self, specimen: Specimen, joining: Collection[str] = JOINING, **errors: Unpack[CurveErrors]
    ) -> list[Curve]:
        """The recorded parts as curves ready for identification: one per step, voltage and cycle.

        Ramps and holds, and whatever else is ``joining``, that follow each other at one voltage are one curve.

        Parameters
        ----------
        specimen : model.specimen.Specimen
            As the scene describes it.
        joining : collection of str
            Kinds of phases that are one curve with those before and after; `rig.steps.registry.joining` knows them.
        **errors : float
            Uncertainties for every curve. Those of the force zero and of the displacement zero come from the log's
            references unless they are given.
        """
        from calibration.film.curve import Curve

        parts: dict[tuple[int, float, int], list[int]] = {}
        start: Phase | None = None  # of the ramps and holds that are going on
        for index, phase in enumerate(self.phases):
            loose = phase.record and phase.kind in joining
            if not loose or start is None or start.voltage != phase.voltage:
                start = phase if loose else None
            if phase.record:
                step = start.step if start is not None else phase.step
                parts.setdefault((step, phase.voltage, phase.cycle), []).append(index)
        curves = []
        directions = np.array([phase.direction for phase in self.phases], dtype=np.int8)
        first = np.searchsorted(self.phase, np.arange(len(self.phases) + 1))  # rows are in the order of the phases
        for (step, voltage, cycle), indexes in parts.items():
            rows = np.concatenate([np.arange(first[index], first[index + 1]) for index in indexes])
            if rows.size:
                label = f"{specimen.name or self.log.path.stem}, {voltage:g} V, step {step}" + (
                    f", cycle {cycle}" if cycle else ""
                )
                direction = directions[self.phase[rows]]
                curves.append(
                    Curve(
                        label=label,
                        run=self.log.path.name,
                        specimen=specimen,
                        h=self.h[rows],
                        force=self.force[rows],
                        voltage=self.voltage[rows],
                        nominal_voltage=voltage,
                        direction=direction,
                        time=self.t[rows],
                        flagged=self.flagged[rows],
                        **{**self._zero_errors(float(self.t[rows[0]])), **errors},  # type: ignore[arg-type] # keys as above
                    )
                )
        return curves

    def _zero_errors(self, t: float) -> dict[str, float]:
        found: dict[str, float] = {}
        force_zero = self.reference("force_zero", t)
        if force_zero is not None:
            found["force_zero"] = abs(self.force_per_reading) * force_zero.standard_uncertainty
        zero = self.reference("displacement_zero" if self.has_laser else "contact_position", t)
        if zero is not None:
            found["displacement_zero"] = zero.standard_uncertainty
        return found

    def _text(self, name: str) -> str:
        attachment = self.log.attachments.get(name)
        if attachment is None:
            raise LogError(self.log.path, f"has no {name} inside that can be read", "Give the file itself.")
        return attachment.data.decode(errors="replace")


def load_run(path: Path, latency: Mapping[str, float] | None = None) -> Run:
    """The run in the log at ``path``.

    Parameters
    ----------
    latency : mapping of str to float, optional
        Seconds by which the time stamps of a role ("force", "displacement", "stage", "hv") come late, as measured;
        they are taken off. By default what the certificates in the log say; {} leaves the times as recorded.

    Raises
    ------
    rig.log.errors.LogError
        The log cannot be read, holds no force samples, or a certificate that is none.
    """
    log, tables = read_tables(path, (*_TOPICS, "/phase", "/reference"))
    if "/force/sample" not in log.topics:
        raise LogError(path, "holds no force samples", "There is nothing to align.")
    if latency is None:
        latency = {role: certificate.lag for role, certificate in certificates_in(log).items()}
    late = {role: seconds for role, seconds in latency.items() if seconds}
    times = {topic: tables[topic]["t_s"] - late.pop(topic.split("/")[1], 0.0) for topic in _TOPICS}
    if late:
        raise ValueError(f"latency of {', '.join(late)}; roles are force, displacement, stage, hv")
    phases = _without_interrupted([Phase(*row) for row in _rows_by_time(tables["/phase"])])
    references = [Reference(*row) for row in _rows_by_time(tables["/reference"])]

    force = tables["/force/sample"]
    order = np.argsort(times["/force/sample"], kind="stable")
    t = times["/force/sample"][order]
    newton, reading = force["force_N"][order], force["reading"][order]
    h_topic = "/displacement/sample" if "/displacement/sample" in log.topics else "/stage/sample"
    if "/hv/sample" in log.topics:
        voltage = interpolate(t, times["/hv/sample"], tables["/hv/sample"]["voltage_V"])
    else:
        voltage = np.zeros_like(t)
    return Run(
        log=log,
        t=t,
        force=newton,
        h=interpolate(t, times[h_topic], _displacement(h_topic, tables[h_topic], references)),
        voltage=voltage,
        flagged=force["flags"][order] != 0,
        phase=np.searchsorted([phase.t for phase in phases], t, side="right") - 1,
        phases=phases,
        references=references,
        force_per_reading=_force_gain(log, newton, reading - _newest(t, references, "force_zero")),
    )


def _without_interrupted(phases: list[Phase]) -> list[Phase]:
    """What the operator's pause interrupted was done again afterwards; its first part is no data of the film."""
    followers = [*(phase.kind for phase in phases[1:]), ""]
    return [
        phase._replace(record=False) if follower == "pause" else phase
        for phase, follower in zip(phases, followers, strict=False)
    ]


def interpolate(t: Floats, sample_t: Floats, values: Floats) -> Floats:
    """``values`` at times ``t``, linear between neighbouring samples.

    A sample exactly at ``t`` stands for itself. NaN outside the samples, beside a sample that is NaN, and where the
    neighbours are more than `LONGEST_PERIODS` sample periods (their median) apart.
    """
    order = np.argsort(sample_t, kind="stable")
    sample_t, values = sample_t[order], values[order]
    result = np.full(t.shape, np.nan)
    if sample_t.size < 2:
        return result
    longest = LONGEST_PERIODS * float(np.median(np.diff(sample_t)))
    left = np.clip(np.searchsorted(sample_t, t, side="right") - 1, 0, sample_t.size - 2)
    gap = sample_t[left + 1] - sample_t[left]
    weight = np.divide(t - sample_t[left], gap, out=np.full_like(t, np.nan), where=gap > 0)
    between = (weight > 0.0) & (weight < 1.0) & (gap <= longest)
    result[between] = ((1.0 - weight) * values[left] + weight * values[left + 1])[between]
    for row, side in ((weight == 0.0, left), (weight == 1.0, left + 1)):
        result[row] = values[side[row]]
    return result


def _displacement(topic: str, table: Columns, references: list[Reference]) -> Floats:
    if topic == "/displacement/sample":
        return np.where(table["flags"] == 0, table["displacement_m"], np.nan)
    contact = _newest(table["t_s"], references, "contact_position")
    return np.asarray(table["position_m"] - contact, dtype=np.float64)


def _newest(t: Floats, references: list[Reference], name: str) -> Floats:
    """The value of the newest reference of that name at each time; NaN before the first."""
    found = [reference for reference in references if reference.name == name]
    values = np.array([np.nan, *(reference.value for reference in found)])
    return values[np.searchsorted([reference.t for reference in found], t, side="right")]


def _force_gain(log: Log, force: Floats, net_reading: Floats) -> float:
    """Newtons per unit of the reading, as the log states it; of older logs, as it shows in the samples."""
    try:
        return float(log.metadata["gains"]["force"])
    except (KeyError, ValueError):
        return _gain(force, net_reading)


def _gain(force: Floats, net_reading: Floats) -> float:
    """Newtons per unit of the reading as applied: the ratio at the sample with the largest net reading."""
    usable = np.flatnonzero(np.isfinite(force) & np.isfinite(net_reading) & (net_reading != 0))
    if not usable.size:
        return float("nan")
    largest = usable[np.argmax(np.abs(net_reading[usable]))]
    return float(force[largest] / net_reading[largest])


def _rows_by_time(table: Columns) -> list[tuple[Any, ...]]:
    fields = [column.tolist() for name, column in table.items() if name not in ("log_ns", "publish_ns")]
    return sorted(zip(*fields, strict=True), key=lambda row: row[0])
