"""Sheets and cones predicted from a material with branches, wherever it was identified."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.record import Bins as ConeBins
from calibration.film.branches.record import Record
from calibration.film.branches.response import Relaxed
from calibration.film.curve import Curve
from calibration.film.propagation import FIXED
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError
from calibration.sheet.timed.record import Bins, SheetRecord, steps_of
from calibration.sheet.timed.result import SheetTrace, TimedFit
from calibration.sheet.timed.stress import elastic_parts, nominal
from model.material.materials import Material
from model.membrane.history import solve_histories
from model.membrane.solve import Status, solve_many
from model.specimen import Specimen

Array = NDArray[np.float64]

FINE = 4  # steps of time from bin to bin
TOLERANCE = 1e-4  # of the cone's force, of its peak


def trace_of(bins: Bins, measured: Array, deviation: Array, model: Array, relaxed: Array) -> SheetTrace:
    """Stresses at the bins (Pa), one direction after the other, as a trace."""
    record, count = bins.record, len(bins.directions)
    stretch = np.exp(record.logs(bins.time))
    return SheetTrace(
        name=record.name,
        kind=record.kind,
        time=np.tile(bins.time, count),
        stretch=np.concatenate([stretch[d] for d in bins.directions]),
        measured=measured,
        deviation=deviation,
        model=model,
        relaxed=relaxed,
        segment=np.tile(bins.segment, count),
        moving=record.moving,
    )


def predict_sheets(material: Material, tests: Sequence[HomogeneousTest]) -> list[SheetTrace]:
    """Tests over time, held against a material with or without branches.

    Raises
    ------
    TestsError
        When a test has no time.
    """
    found = []
    law = material.law(np.array(material.mu)[:, None], np.array(material.alpha).reshape(-1, 1))
    ratio = np.array([one.ratio for one in material.branches])
    tau = np.array([one.time for one in material.branches])
    for test in tests:
        record = SheetRecord.of(test)
        bins = record.bins
        times = steps_of(bins, FINE)
        u, mean = record.logs(times), bins.averaging(times)
        relaxed = nominal(law, u, u)
        model = relaxed
        if ratio.size:
            (w,) = elastic_parts(law, np.full(ratio.size, material.shear_modulus), tau, [times], [u])
            model = relaxed + nominal(law, w, np.repeat(u[:, :, None], ratio.size, axis=2)) @ ratio
        rows = list(bins.directions)
        means = [np.stack([mean @ one[d] for d in rows]) for one in (model, relaxed)]
        sides = bins.stress, np.tile(bins.sigma, (len(rows), 1)), *means
        found.append(trace_of(bins, *(one.ravel() for one in sides)))
    return found


@dataclass(frozen=True, eq=False)
class ConePrediction:
    """The force of a cone in one run as the material of a sheet predicts it; ``measured`` and ``model`` in N at times.

    factor : measured over predicted force (least squares), with its standard uncertainty: that of the sheet's stiffness
        and what is stated of the cone's dimensions and force
    """

    run: str
    time: Array
    h: Array
    voltage: Array
    measured: Array
    model: Array
    factor: float
    uncertainty: float

    @property
    def rms(self) -> float:
        """Root of the mean squared difference over the peak of the force."""
        return float(np.sqrt(np.mean((self.measured - self.model) ** 2)) / np.abs(self.measured).max())

    @property
    def rms_scaled(self) -> float:
        """The same with the predicted force times `factor`: what is not a matter of stiffness."""
        off = self.measured - self.factor * self.model
        return float(np.sqrt(np.mean(off**2)) / np.abs(self.measured).max())

    @property
    def agrees(self) -> bool:
        """Whether the factor is 1 within two standard uncertainties."""
        return abs(self.factor - 1.0) <= 2.0 * self.uncertainty

    def to_dict(self) -> dict[str, float | str | bool]:
        """Plain numbers."""
        return {
            "run": self.run,
            "rms_over_peak": self.rms,
            "rms_over_peak_after_factor": self.rms_scaled,
            "measured_over_predicted": self.factor,
            "standard_uncertainty": self.uncertainty,
            "agrees": self.agrees,
        }


def predict_cones(sheet: TimedFit, records: Sequence[Record]) -> list[ConePrediction]:
    """Runs of a cone as the material of a sheet predicts them; the permittivity is that of each cone's own material.

    States that the film does not have are left out.

    Raises
    ------
    TestsError
        When a run holds no state that the film of this sheet has.
    """
    found = []
    for record in records:
        film = record.errors.specimen
        specimen = film.with_material(replace(sheet.material, eps_r=film.material.eps_r))
        _, h, v = record.history
        relaxed = Relaxed(
            specimen.with_material(replace(specimen.material, branches=())), float(h.max()), float(v.max())
        )
        bins = record.bins(relaxed.force)
        model = _force(specimen, record.history, bins)
        known = np.isfinite(model)
        if not known.any():
            raise TestsError(f"{record.run}: the film of this sheet has no state in tension in this run")
        measured, model = bins.force[known], model[known]
        weight = model / float(model @ model)
        slopes = {name: float(weight @ one) for name, one in _by_size(relaxed, bins, known).items()}
        stretch = FIXED * film.prestretch, film.prestretch
        stated = [slopes[name] * size for name, size in _stated(record.errors).items()]
        uncertainty = math.hypot(sheet.stiffness_relative(*stretch), *stated)
        factor = float(measured @ weight)
        at = bins.time[known], bins.h[known], bins.voltage[known]
        found.append(ConePrediction(record.run, *at, measured, model, factor, factor * uncertainty))
    return found


def _force(specimen: Specimen, history: tuple[Array, Array, Array], bins: ConeBins) -> Array:
    """Force (N) at the bins; NaN where the film is not taut or has no state."""
    t, h, v = history
    if specimen.material.branches:
        (found,) = solve_histories([specimen], [(t, h, v, bins.time)], tolerance=TOLERANCE)
        return np.where(found.status == Status.TAUT, found.force, np.nan)
    return solve_many(specimen, bins.h, bins.voltage, tolerance=1e-6).force


def _by_size(relaxed: Relaxed, bins: ConeBins, known: NDArray[np.bool_]) -> dict[str, Array]:
    """Changes of the force (N) by relative changes of what the scene states, of the relaxed film."""
    by = relaxed(bins.h[known], bins.voltage[known])
    found = {name: by[name] for name in ("thickness", "prestretch", "disk_radius", "ring_radius")}
    return found | {"h": by["h"] * bins.h[known], "voltage": by["voltage"] * bins.voltage[known], "force": by["force"]}


def _stated(errors: Curve) -> dict[str, float]:
    """Relative standard uncertainties of a cone's dimensions and sensors."""
    dimensions = ("thickness", "prestretch", "disk_radius", "ring_radius")
    found = {name: float(getattr(errors, f"{name}_uncertainty") or 0.0) for name in dimensions}
    found["h"] = math.hypot(errors.displacement_gain, errors.displacement_axis or 0.0)
    found["voltage"] = math.hypot(errors.voltage_gain, errors.voltage_at_film or 0.0)
    return found | {"force": errors.force_gain}
