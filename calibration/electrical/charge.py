r"""Permittivity of a film from the current that charges it: independent of every force.

While the voltage rises at the displacement h the supply gives

.. math:: i = \varepsilon_r \frac{d}{dt}\bigl(c(h, V)\,V\bigr) + C_p \frac{dV}{dt} + g_1 V + g_3 V^3 + i_0

with c the capacitance of the deformed film for :math:`\varepsilon_r = 1` (`model.membrane.solve.Solution`), C_p that
of cable and output, the film's leakage and the offset of the monitor. It is linear in what is sought. c depends on the
film's law only as far as its shape does; what that may do is a row of the budget, and so is the thickness, to which
the permittivity is proportional. Only rises count: while a film discharges a supply may show no current. What a
polarisation that takes seconds adds counts as leakage here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.membrane.solve import solve
from model.specimen import Specimen

Array = NDArray[np.float64]

ASSUMED_CURRENT_GAIN = 0.01  # relative standard uncertainty, where nobody stated it
ASSUMED_CABLE = 0.05  # of the capacitance beside the film, relative ...
ASSUMED_CABLE_F = 10e-12  # ... and at least
STEADY_PART, STEADY_V = 0.2, 1.0  # a sample belongs to a ramp where the slopes before and after it agree so well
FEWEST = 8  # samples on ramps
NODES = 6  # voltages at which the capacitance is asked for, at each displacement
SAME_M = 20e-6  # displacements this near are one
LAW = 0.3  # relative change of the modulus for the row of the film's shape: a guess may be so far off
PASSES = 2
WEAK = 0.2  # relative uncertainty by current and resolution above which a supply cannot resolve it
REST_S = 3.0  # shortest rest of which a leakage is told
DECAYS = np.geomspace(0.3, 100.0, 25)  # s
DECAY_STEPS = 20  # of Gauss and Newton, from the nearest of them
SLOWEST = 20.0  # of the time at rest: slower decays are as good as straight, and the error says so


class NotResolved(Exception):
    """What is asked for cannot be told from these currents; says why."""


@dataclass(frozen=True, eq=False)
class Charging:
    """Samples of one run in the order of time, SI units: time, voltage, current, displacement, whether it ramps.

    ``run`` is its name, by which the curves of the same run are found.
    """

    specimen: Specimen
    t: Array
    voltage: Array
    current: Array
    h: Array
    ramping: NDArray[np.bool_]
    run: str = ""


@dataclass(frozen=True)
class Known:
    """Standard uncertainties of what the permittivity follows from; relative unless the name says otherwise.

    ``cable_F`` is the capacitance beside the film, ``current_gain`` None where nobody stated it.
    """

    thickness: float
    prestretch: float
    disk_radius: float
    ring_radius: float
    voltage_gain: float = 0.0
    displacement_m: float = 0.0
    current_gain: float | None = None
    cable_F: float = 0.0
    cable_uncertainty_F: float | None = None

    @property
    def cable_error(self) -> float:
        """Standard uncertainty (F) of the capacitance beside the film, assumed where nobody stated it."""
        stated = self.cable_uncertainty_F
        return max(ASSUMED_CABLE * self.cable_F, ASSUMED_CABLE_F) if stated is None else stated

    @property
    def gain_error(self) -> float:
        """Relative standard uncertainty of the current, assumed where nobody stated it."""
        return ASSUMED_CURRENT_GAIN if self.current_gain is None else self.current_gain


@dataclass(frozen=True)
class Leakage:
    """Current that is left of a rest (A) at ``voltage`` (V) and peak ``field`` (V/m), with its standard uncertainty."""

    h: float
    voltage: float
    field: float
    current: float
    standard_uncertainty: float
    duration: float


@dataclass(frozen=True)
class Capacitance:
    """Capacitance of film and cable (F) at a displacement (m), at the mean voltage of its ramps; and by the fit."""

    h: float
    voltage: float
    measured: float
    standard_uncertainty: float
    fitted: float


@dataclass(frozen=True)
class Permittivity:
    """Relative permittivity with its combined standard uncertainty and the parts of it.

    Attributes
    ----------
    budget : dict of str to float
        Parts of the uncertainty, which add in squares.
    resolution : float
        Smallest step of the current's readings (A); 0 where they show none.
    noise : float
        Standard deviation of one reading (A) about the fit.
    samples : int
        On ramps.
    cable : float
        Capacitance beside the film by the fit (F).
    """

    value: float
    standard_uncertainty: float
    budget: Mapping[str, float]
    resolution: float
    noise: float
    samples: int
    cable: float
    capacitances: Sequence[Capacitance]
    leakages: Sequence[Leakage]
    assumed: Mapping[str, float]


@dataclass(frozen=True)
class ByCharge:
    """The permittivity by the charge alone, beside that by the force alone: value and standard uncertainty.

    ``charge`` is None where the supply cannot resolve it; ``left_out`` says why.
    """

    charge: Permittivity | None
    by_force: tuple[float, float] | None
    left_out: str = ""


def charge_as_json(found: Permittivity | ByCharge) -> dict[str, Any]:
    """All numbers, SI units; what is not known is null."""
    values: dict[str, Any] = _finite(asdict(found))
    return values


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def permittivity(data: Sequence[Charging], known: Known) -> Permittivity:
    """The permittivity of the film in ``data``, runs of one specimen.

    Raises
    ------
    NotResolved
        No current is measured, nothing ramps, or the current's resolution and noise leave more than 20 %.
    """
    if not any(np.isfinite(one.current).any() for one in data):
        raise NotResolved("this supply cannot resolve it: it does not measure its current")
    rows = [rows_of(one) for one in data]
    on_ramps = sum(int(np.count_nonzero(one.rises)) for one in rows)
    if on_ramps < FEWEST:
        raise NotResolved(
            f"only {on_ramps} samples of the current lie on rises of the voltage; at least {FEWEST} are needed: use a "
            "slower ramp, more voltages or a faster supply"
        )
    specimen = data[0].specimen
    for _ in range(PASSES):  # the shape under voltage depends a little on the permittivity itself
        fit = _fit(specimen, rows, known.cable_F, known.cable_error)
        if fit.value >= 1.0:
            specimen = specimen.with_material(replace(specimen.material, eps_r=fit.value))
    resolution = resolution_of(np.concatenate([one.current for one in rows]))
    charging = float(np.mean(np.concatenate([one.current[one.rises] for one in rows])))
    parts = {"current noise": fit.error, "cable": fit.cable_error}
    if resolution > 0:
        parts["current resolution"] = fit.value * resolution / math.sqrt(12.0) / abs(charging)
    resolved = math.hypot(fit.error, parts.get("current resolution", 0.0)) / abs(fit.value)
    if not (resolved <= WEAK and fit.value > 0):
        raise NotResolved(
            f"this supply cannot resolve it: currents of {charging * 1e9:.3g} nA, read in steps of "
            f"{resolution * 1e9:.3g} nA with a noise of {fit.noise * 1e9:.3g} nA, leave {resolved:.0%} of the "
            "permittivity. A faster ramp draws more current"
        )
    parts |= {"current gain": known.gain_error * fit.value, "voltage gain": known.voltage_gain * fit.value}
    parts |= _dimensions(specimen, rows, known, fit.value)
    assumed = {} if known.current_gain is not None else {"current gain": ASSUMED_CURRENT_GAIN}
    return Permittivity(
        value=fit.value,
        standard_uncertainty=math.hypot(*parts.values()),
        budget=parts,
        resolution=resolution,
        noise=fit.noise,
        samples=on_ramps,
        cable=fit.cable,
        capacitances=_by_displacement(specimen, rows, fit),
        leakages=[leak for one in data for leak in _leakages(one)],
        assumed=assumed,
    )


@dataclass(frozen=True, eq=False)
class Rows:
    """What goes into the fit of one run: samples on rises, and at rest; ``slope`` is dV/dt, 0 at rest."""

    t: Array
    voltage: Array
    current: Array
    h: Array
    slope: Array
    rises: NDArray[np.bool_]


def rows_of(one: Charging) -> Rows:
    """The samples of a run that lie on steady rises of the voltage, and at rest."""
    t, v = one.t, one.voltage
    good = np.isfinite(t) & np.isfinite(v) & np.isfinite(one.current) & np.isfinite(one.h)
    before, after = np.zeros_like(v), np.zeros_like(v)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(v) / np.diff(t)
    before[1:], after[:-1] = steps, steps
    inner = np.zeros(v.shape, dtype=np.bool_)
    inner[1:-1] = good[1:-1] & good[:-2] & good[2:]
    slope = np.zeros_like(v)
    slope[1:-1] = (v[2:] - v[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
    gap = np.full_like(v, np.inf)
    gap[1:-1] = 0.5 * (t[2:] - t[:-2])
    steady = np.abs(after - before) <= STEADY_PART * np.abs(slope) + STEADY_V / np.maximum(gap, 1e-9) * 0.5
    moves = np.abs(np.gradient(one.h)) > SAME_M if len(one.h) > 1 else np.zeros(v.shape, dtype=np.bool_)
    ramp = one.ramping.copy()
    ramp[1:-1] = one.ramping[:-2] & one.ramping[1:-1] & one.ramping[2:]
    rises = inner & steady & ramp & (slope > 0) & ~moves & (v > 0)
    near_ramp = one.ramping.copy()
    for k in (1, 2):
        near_ramp[k:] |= one.ramping[:-k]
        near_ramp[:-k] |= one.ramping[k:]
    rests = inner & ~near_ramp & ~moves
    use = rises | rests
    return Rows(t[use], v[use], one.current[use], one.h[use], np.where(rises, slope, 0.0)[use], rises[use])


@dataclass(frozen=True)
class _Fit:
    value: float
    error: float
    cable: float
    cable_error: float  # what the uncertainty of the cable's capacitance leaves on the value
    noise: float
    rest: Array  # coefficients of V, V^3, 1


def _fit(specimen: Specimen, rows: Sequence[Rows], cable: float, cable_error: float) -> _Fit:
    """Least squares, with the capacitance of the cable within what is known of it."""
    rate = np.concatenate([_charge_rate(specimen, one) for one in rows])
    slope = np.concatenate([one.slope for one in rows])
    volts = np.concatenate([one.voltage for one in rows])
    current = np.concatenate([one.current for one in rows])
    levels = np.unique(np.round(volts[slope == 0.0] / 50.0))
    top = max(float(np.max(np.abs(volts))), 1.0)
    columns = [rate, slope, volts / top, np.ones_like(volts)]
    if len(levels) > 3:
        columns.insert(3, (volts / top) ** 3)
    design = np.stack(columns, axis=1)
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    sigma = float(np.std(current - design @ (np.linalg.lstsq(design / scale, current, rcond=None)[0] / scale)))
    sigma = max(sigma, 1e-15)
    prior = np.zeros(len(columns))
    prior[1] = 1.0 / cable_error if cable_error > 0 else 1e18
    matrix = np.vstack([design / sigma, prior]) / scale
    wanted = np.append(current / sigma, prior[1] * cable)
    found = np.linalg.lstsq(matrix, wanted, rcond=None)[0] / scale
    covariance = np.linalg.pinv(matrix.T @ matrix) / np.outer(scale, scale)
    residual = current - design @ found
    noise = float(np.sqrt(np.sum(residual**2) / max(len(residual) - len(columns), 1)))
    # With the cable known exactly the samples alone decide; the rest of the variance is the cable's.
    alone = np.delete(design / scale, 1, axis=1) / noise
    bare = np.linalg.pinv(alone.T @ alone)[0, 0] / scale[0] ** 2
    whole = covariance[0, 0] * (noise / sigma) ** 2
    return _Fit(
        float(found[0]),
        math.sqrt(max(float(bare), 0.0)),
        float(found[1]),
        math.sqrt(max(float(whole - bare), 0.0)),
        noise,
        np.delete(found, [0, 1]),
    )


def _charge_rate(specimen: Specimen, rows: Rows) -> Array:
    """d(cV)/dt (F V/s for a permittivity of 1) at every sample: c and its slope by Chebyshev series at each place."""
    found = np.zeros_like(rows.voltage)
    for h, mine in places_of(rows):
        volts = rows.voltage[mine]
        series = _charge(specimen, h, float(np.max(volts)))
        found[mine] = series.deriv()(volts) * rows.slope[mine]
    return found


def _charge(specimen: Specimen, h: float, most: float) -> np.polynomial.Chebyshev:
    """c V over V from 0 to ``most``, for a permittivity of 1: by the shape that the believed film takes."""
    most = max(most, 1.0)
    nodes = 0.5 * most * (1.0 - np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES))
    eps_r = specimen.material.eps_r
    states = [solve(specimen, max(h, 0.0), v, wrinkling="tension_field") for v in nodes.tolist()]
    charge = [s.capacitance() / eps_r * v if s.answered else math.nan for s, v in zip(states, nodes, strict=True)]
    values = np.array(charge)
    known = np.isfinite(values)
    if np.count_nonzero(known) < 3:
        raise NotResolved(f"the model has no state of this film at {h * 1e3:.3g} mm and up to {most:.4g} V")
    return np.polynomial.Chebyshev.fit(nodes[known], values[known], len(nodes[known]) - 1)


def places_of(rows: Rows) -> list[tuple[float, NDArray[np.bool_]]]:
    """Displacements at which there are rises, and which samples belong to each."""
    groups: list[tuple[float, NDArray[np.bool_]]] = []
    left = rows.rises.copy()
    while left.any():
        h = float(np.median(rows.h[left][:5]))
        near = left & (np.abs(rows.h - h) <= 5 * SAME_M)
        if not near.any():
            near = left & (np.arange(len(left)) == int(np.argmax(left)))
        groups.append((float(np.mean(rows.h[near])), near))
        left &= ~near
    return groups


def _dimensions(specimen: Specimen, rows: Sequence[Rows], known: Known, value: float) -> dict[str, float]:
    """What uncertain dimensions, displacements and the film's law do to the value, by the capacitance they change."""
    places = [(h, float(np.max(one.voltage[mine]))) for one in rows for h, mine in places_of(one)]
    places = places[:: max(len(places) // 4, 1)]
    believed = specimen.material

    def mean(film: Specimen, more: float = 0.0) -> float:
        total = 0.0
        for h, volts in places:
            state = solve(film, max(h + more, 0.0), 0.7 * volts, wrinkling="tension_field")
            total += state.capacitance() / film.material.eps_r if state.answered else math.nan
        return total

    base = mean(specimen)
    stiffer = replace(believed, mu=tuple(m * (1.0 + LAW) for m in believed.mu))
    changed = {
        "thickness": (replace(specimen, thickness=specimen.thickness * (1.0 + known.thickness)), 0.0),
        "pre-stretch": (replace(specimen, prestretch=specimen.prestretch * (1.0 + known.prestretch)), 0.0),
        "disk radius": (replace(specimen, disk_radius=specimen.disk_radius * (1.0 + known.disk_radius)), 0.0),
        "ring radius": (replace(specimen, ring_radius=specimen.ring_radius * (1.0 + known.ring_radius)), 0.0),
        "displacement": (specimen, known.displacement_m),
        "shape by the law": (specimen.with_material(stiffer), 0.0),
    }
    parts = {name: abs(base / mean(film, more) - 1.0) * value for name, (film, more) in changed.items()}
    return {name: part for name, part in parts.items() if math.isfinite(part) and part > 0.0}


def resolution_of(current: Array) -> float:
    """Smallest step between readings (A) where they come in few values; 0 where they show no step."""
    values = np.unique(current)
    if len(values) < 2 or len(values) > 0.5 * len(current):
        return 0.0
    return float(np.min(np.diff(values)))


def _by_displacement(specimen: Specimen, rows: Sequence[Rows], fit: _Fit) -> list[Capacitance]:
    """d(CV)/dV at each place where the voltage rose, measured and by the fit."""
    found = []
    for one in rows:
        rate = _charge_rate(specimen, one)
        for h, mine in places_of(one):
            slope = one.slope[mine]
            leak = _rest(fit, rows, one.voltage[mine])
            measured = float(np.sum((one.current[mine] - leak) * slope) / np.sum(slope**2))
            fitted = fit.value * float(np.sum(rate[mine] * slope) / np.sum(slope**2)) + fit.cable
            error = fit.noise / math.sqrt(float(np.sum(slope**2)))
            found.append(Capacitance(h, float(np.mean(one.voltage[mine])), measured, error, fitted))
    return found


def _rest(fit: _Fit, rows: Sequence[Rows], volts: Array) -> Array:
    top = max(max(float(np.max(np.abs(one.voltage))) for one in rows), 1.0)
    x = volts / top
    powers = (x, np.ones_like(x)) if len(fit.rest) == 2 else (x, x**3, np.ones_like(x))
    total: Array = np.sum([a * p for a, p in zip(fit.rest, powers, strict=True)], axis=0)
    return total


def _leakages(one: Charging) -> list[Leakage]:
    """What is left of the current in each rest at a voltage: a constant and an exponential decay by least squares."""
    found = []
    still = ~one.ramping & np.isfinite(one.current) & (one.voltage > STEADY_V * 10)
    moves = np.abs(np.gradient(one.h)) > SAME_M if len(one.h) > 1 else still
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (still & ~moves).astype(np.int8), [0]])))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        t = one.t[begin:end] - one.t[begin]
        if len(t) < FEWEST or t[-1] < REST_S:
            continue
        volts, h = float(np.mean(one.voltage[begin:end])), float(np.mean(one.h[begin:end]))
        state = solve(one.specimen, max(h, 0.0), volts, wrinkling="tension_field")
        current, error = _asymptote(t, one.current[begin:end])
        found.append(Leakage(h, volts, state.peak_field if state.answered else math.nan, current, error, float(t[-1])))
    return found


def _asymptote(t: Array, current: Array) -> tuple[float, float]:
    """The constant of ``a + b exp(-t/tau)`` and its standard uncertainty; of the mean where no decay shows.

    The decay is sought on a grid and brought to its minimum by Gauss and Newton; what is not known of it counts in the
    uncertainty of the constant, and so does what is left at the end of one that outlasts the rest.
    """
    mean, count = float(np.mean(current)), len(t)
    square = float(np.sum((current - mean) ** 2))
    alone = mean, math.sqrt(square / (count - 1) / count)

    def fitted(tau: float) -> tuple[Array, Array, Array]:
        decay = np.exp(-t / tau)
        design = np.stack([np.ones_like(t), decay], axis=1)
        found = np.linalg.lstsq(design, current, rcond=None)[0]
        return np.column_stack([design, decay * t / tau]), found, np.asarray(current - design @ found)

    inside = DECAYS[(2 * t[-1] / count < DECAYS) & (0.5 * t[-1] > DECAYS)].tolist()
    lefts = [float(np.sum(fitted(tau)[2] ** 2)) for tau in inside]
    if not lefts or not min(lefts) < square * (1.0 - 9.0 / (count - 1)):  # by no more than chance
        return alone
    tau = inside[lefts.index(min(lefts))]
    for _ in range(DECAY_STEPS):
        design, found, left = fitted(tau)
        step = float(np.linalg.lstsq(design, left, rcond=None)[0][2] / found[1])  # of ln tau
        tau = min(max(tau * math.exp(max(min(step, 0.5), -0.5)), inside[0]), SLOWEST * t[-1])
    design, found, left = fitted(tau)
    covariance = np.linalg.inv(design.T @ design) * float(left @ left) / max(count - 3, 1)
    # Of a decay that outlasts the rest the end is not seen: what is left of it there is not known better than that.
    unseen = float(found[1] * design[-1, 1]) if tau > 0.5 * t[-1] else 0.0
    return float(found[0]), math.hypot(math.sqrt(float(covariance[0, 0])), unseen)
