"""One force-displacement curve at one voltage, with all that identification must know about its errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from model.specimen import Specimen

from calibration.film.assumed import assumed_uncertainties

Array = NDArray[np.float64]

HELD = 2.0  # times its noise: a displacement that scatters no more did not move
BEND, FEWEST = 0.05, 4  # part of a way off a straight line that is a change of speed; samples that make a line
UNCERTAINTIES = (
    "displacement_noise",
    "force_gain",
    "force_zero",
    "displacement_zero",
    "displacement_gain",
    "voltage_gain",
    "displacement_axis",
    "voltage_at_film",
    "thickness_uncertainty",
    "prestretch_uncertainty",
    "disk_radius_uncertainty",
    "ring_radius_uncertainty",
    "compliance_uncertainty",
    "eccentricity",
    "lag_uncertainty",
)


class CurveError(ValueError):
    """A curve that cannot be used; the message names the curve and the field."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """Samples of force against displacement, taken at one nominal voltage in one run, in the order of time.

    SI units. ``nan`` in ``h``, ``force`` or ``voltage`` marks a sample without that value; such samples, and those
    with ``flagged`` set, are left out of a fit and counted.

    Parameters
    ----------
    label : str
        What the curve is called in tables and figures, e.g. ``"a = 4 mm, 1000 V"``.
    run : str
        Which log it is from. The errors of the force zero and of the displacement zero are shared inside a run.
    specimen : model.specimen.Specimen
        Geometry as measured; its material is the starting guess only.
    h, force : ndarray, shape (n,)
        Displacement of the disk (m) and the force that pulls it out of plane (N), zeros already taken off.
    voltage : ndarray, shape (n,)
        Voltage at each sample (V), measured or nominal; zeros where there is no HV in the scene.
    nominal_voltage : float
        The voltage the protocol asked for (V). 0 in every curve of a data set means: no permittivity in the fit.
    direction : ndarray of int, shape (n,)
        +1 loading, -1 unloading, 0 neither (a hold).
    force_noise, displacement_noise : float
        Standard deviation of one sample (N, m), independent from sample to sample.
    force_gain, displacement_gain, voltage_gain : float
        Relative standard uncertainties of the instruments' gains; the same error in all curves of a fit.
    force_zero, displacement_zero : float
        Standard uncertainties of the zeros that were taken off (N, m); the same error in all curves of a run.
    displacement_axis, voltage_at_film : float, optional
        Relative standard uncertainties of what no certificate knows: the cosine between sensor and stage, what leads
        and electrodes lose. The same error in all curves of a fit. Where they are not given they are assumed
        (`calibration.film.assumed`); 0 means exact.
    thickness_uncertainty, prestretch_uncertainty, disk_radius_uncertainty, ring_radius_uncertainty : float, optional
        Relative standard uncertainties of the specimen's own dimensions, assumed where they are not given; 0 means
        exact. Which specimens share an error: see `part`.
    batch : str
        The sheet that the film was cut from: specimens of one batch share the error of their thickness.
    compliance_uncertainty : float
        Standard uncertainty of the rig's compliance (m/N) where ``h`` is the stage's way, already corrected by the
        compliance that is believed; 0 where a sensor on the disk measures ``h``. One rig: the same in all curves.
    eccentricity : float
        Standard uncertainty of the distance of the disk's centre from the ring's (m).
    lag_uncertainty : float
        Standard uncertainty (s) of how far the force is behind the displacement: force read at ``t`` is that of where
        the disk was a lag before. The same error in all curves of a run; it bears on curves with ``time``.
    time : ndarray, shape (n,), optional
        When each sample was taken, on the clock of its run (s). With it a viscous film can be told from other errors.
    flagged : ndarray of bool, shape (n,), optional
        Samples that an instrument itself called bad.
    assumed : frozenset of str
        Which uncertainties nobody stated; it is filled in here.
    """

    label: str
    run: str
    specimen: Specimen
    h: Array
    force: Array
    voltage: Array
    nominal_voltage: float
    direction: NDArray[np.int8]
    force_noise: float
    displacement_noise: float = 0.0
    force_gain: float = 0.0
    force_zero: float = 0.0
    displacement_zero: float = 0.0
    displacement_gain: float = 0.0
    voltage_gain: float = 0.0
    displacement_axis: float | None = None
    voltage_at_film: float | None = None
    thickness_uncertainty: float | None = None
    prestretch_uncertainty: float | None = None
    disk_radius_uncertainty: float | None = None
    ring_radius_uncertainty: float | None = None
    batch: str = ""
    compliance_uncertainty: float = 0.0
    eccentricity: float = 0.0
    lag_uncertainty: float = 0.0
    time: Array | None = None
    flagged: NDArray[np.bool_] | None = None
    assumed: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        n = np.size(self.h)
        if n == 0:
            raise CurveError(f"curve {self.label!r}: it has no samples")
        for name in ("h", "force", "voltage"):
            column = self._column(name, np.float64, n)
            if np.isinf(column).any():
                raise CurveError(f"curve {self.label!r}: {name} holds an infinite value; mark a missing value by nan")
        if not np.isin(self.direction, (-1, 0, 1)).all():
            raise CurveError(f"curve {self.label!r}: direction must be +1 (loading), -1 (unloading) or 0 (neither)")
        self._column("direction", np.int8, n)
        if self.time is not None and not np.isfinite(self._column("time", np.float64, n)).all():
            raise CurveError(f"curve {self.label!r}: time holds a value that is not finite")
        if self.flagged is None:
            object.__setattr__(self, "flagged", np.zeros(n, dtype=np.bool_))
        self._column("flagged", np.bool_, n)
        if not math.isfinite(self.nominal_voltage):
            raise CurveError(f"curve {self.label!r}: nominal_voltage is {self.nominal_voltage}, not a voltage")
        if not 0.0 < self.force_noise < math.inf:
            raise CurveError(
                f"curve {self.label!r}: force_noise is {self.force_noise} N; it must be positive, for it is the weight "
                "of every sample. The certificate of the force sensor states it"
            )
        usual = assumed_uncertainties(self.specimen)
        silent = {name for name in usual if getattr(self, name) is None}
        for name in silent:
            object.__setattr__(self, name, usual[name])
        still = {name for name in self.assumed if getattr(self, name) == usual.get(name)}  # after dataclasses.replace
        object.__setattr__(self, "assumed", frozenset(silent | still))
        for name in UNCERTAINTIES:
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise CurveError(f"curve {self.label!r}: {name} is {value}; a standard uncertainty is 0 or more")

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Samples that have all three values and no flag of an instrument; shape (n,)."""
        usable: NDArray[np.bool_] = np.isfinite(self.h) & np.isfinite(self.force) & np.isfinite(self.voltage)
        return usable if self.flagged is None else usable & ~self.flagged

    def part(self, dimension: str) -> str:
        """Whose ``dimension`` it is: curves that name the same part share its error.

        The thickness is that of the batch, or else of the specimen, and the pre-stretch that of the specimen; disks and
        rings are told apart by their radii.
        """
        s = self.specimen
        if dimension == "disk_radius":
            return f"the disk of {1e3 * s.disk_radius:g} mm"
        if dimension == "ring_radius":
            return f"the ring of {1e3 * s.ring_radius:g} mm"
        if dimension == "thickness" and self.batch:
            return f"batch {self.batch}"
        return s.name or f"the specimen of {1e6 * s.thickness:g} um on a disk of {1e3 * s.disk_radius:g} mm"

    @cached_property
    def place(self) -> Array:
        """Displacement (m) of every sample as well as it is known: while the disk is held, the mean of the readings.

        A model evaluated at each reading would follow its noise although the force does not, and so seem to be wrong
        (regression with an error in the abscissa; Fuller 1987). In motion readings spread far wider than their noise.
        """
        place = self.h.copy()
        for rows in self._stretches(0):
            if rows.size > 1 and np.std(self.h[rows]) <= HELD * self.displacement_noise:
                place[rows] = self.h[rows].mean()
        place.setflags(write=False)
        return place

    def without_compliance(self, compliance: float) -> Curve:
        """The curve with the way that a rig of ``compliance`` (m/N) gives taken off the displacement.

        Where the disk is held it is taken from the mean force: the noise of the single readings would pass for motion
        against the force, as of a film of negative stiffness. Held is what the film, at its mean stiffness, would
        answer with less force than the noise.
        """
        force = self.force.copy()
        for rows in self._stretches(0):
            mean = float(force[rows].mean())
            if np.std(self.h[rows]) * abs(mean) <= self.force_noise * abs(self.h[rows].mean()):
                force[rows] = mean
        return replace(self, h=self.h - compliance * force)

    @cached_property
    def velocity(self) -> Array:
        """How fast the disk moves (m/s); 0 while it is held, and without ``time``.

        The slope of a straight line through the readings from turn to turn, or to where the speed changes.
        """
        velocity = np.zeros(self.h.size)
        if self.time is not None:
            for stretch in (*self._stretches(1), *self._stretches(-1)):
                travel = abs(float(self.h[stretch[-1]] - self.h[stretch[0]]))
                for rows in self._straight(self.time, stretch, max(BEND * travel, 5.0 * self.displacement_noise)):
                    time, h = self.time[rows], self.h[rows]
                    if np.ptp(time) > 0.0:
                        time = time - time.mean()
                        velocity[rows] = (time @ h) / (time @ time)
        velocity.setflags(write=False)
        return velocity

    def _straight(self, time: Array, rows: NDArray[np.intp], allowed: float) -> Iterator[NDArray[np.intp]]:
        """Pieces of a stretch that are straight in time but for ``allowed`` (m), by Ramer, Douglas and Peucker."""
        t, h = time[rows] - time[rows[0]], self.h[rows]
        if rows.size >= 2 * FEWEST and t[-1] > 0.0:
            off = np.abs(h - h[0] - (h[-1] - h[0]) * t / t[-1])
            bend = int(off.argmax())
            if off[bend] > allowed and FEWEST <= bend <= rows.size - FEWEST:
                yield from self._straight(time, rows[:bend], allowed)
                yield from self._straight(time, rows[bend:], allowed)
                return
        yield rows

    def _stretches(self, direction: int) -> Iterator[NDArray[np.intp]]:
        """The usable samples of every uninterrupted stretch in one direction; not those without any."""
        edges = np.flatnonzero(np.diff(np.concatenate(([0], (self.direction == direction).astype(np.int8), [0]))))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            rows = start + np.flatnonzero(self.usable[start:stop])
            if rows.size:
                yield rows

    def _column(self, name: str, dtype: Any, n: int) -> NDArray[Any]:
        """Replace a field by a read-only copy of itself as an array of n numbers."""
        try:
            column = np.array(getattr(self, name), dtype=dtype)
        except (TypeError, ValueError) as error:
            raise CurveError(f"curve {self.label!r}: {name} is not a list of numbers") from error
        if column.shape != (n,):
            raise CurveError(f"curve {self.label!r}: {name} has shape {column.shape}, and h has {n} samples")
        column.setflags(write=False)
        object.__setattr__(self, name, column)
        return column
