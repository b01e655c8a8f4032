r"""What the log of a follow step says of stroke and work, beside what the model expects.

At a rest the stage holds; the mean excess of forces that is left, over the stiffness, is the way to the balance:

.. math:: h^* = \bar h + (B(\bar h) - \bar F) / (F' - B')

The stroke at V is h*(V) minus the mean of the rests at 0 V before and after it. The work is the integral of
``B(h) - F`` over the way from one to the other while the disk is let go at V, as Cao & Conn 2018 define it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.sensors.certificate import Certificate
from model.actuator.bias import Bias
from model.actuator.equilibrium import Actuator, balance
from model.material.materials import Material
from rig.analysis.fit_file import FittedFilm, read_fit
from rig.base.errors import DataError
from rig.base.toml_file import parse_table
from rig.log.dataset import Phase, Run, load_run
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.steps.follow import Follow, rest_from

Floats = NDArray[np.float64]

BATCH_S = 0.5  # noise is judged by means over this long: neighbouring samples may share an error
NUDGE = 1e-4  # by this part a parameter is changed to see what depends on it
NODES = 32  # of the quadrature of the expected work


@dataclass(frozen=True)
class Rest:
    """One standstill: where the balance is (m) with its statistical uncertainty, stiffness (N/m), voltage (V)."""

    step: int
    voltage: float
    h: float
    error: float
    stiffness: float
    begin: float
    end: float


@dataclass(frozen=True)
class Stroke:
    """One release under voltage: measured and expected stroke (m) and work (J), with standard uncertainties.

    ``voltage`` is the mean measured one (V). Those of the expected ones are of the film's fit; NaN without a fit.
    """

    step: int
    kind: str
    nominal_voltage: float
    voltage: float
    start: float
    stroke: float
    stroke_uncertainty: float
    work: float
    work_uncertainty: float
    expected_stroke: float
    expected_stroke_uncertainty: float
    expected_work: float
    expected_work_uncertainty: float

    @property
    def deviation(self) -> float:
        """Relative deviation of the measured stroke from the expected one."""
        return self.stroke / self.expected_stroke - 1.0


def strokes(path: Path, fit: Path | None = None) -> list[Stroke]:
    """Every release under voltage in the log.

    Parameters
    ----------
    fit : Path, optional
        Result of `dea-rig fit -o`: the film of the expectation, and how well it is known. The scene's when left out.

    Raises
    ------
    DataError, LogError
        When the log holds no follow step, or not all of one.
    """
    run = load_run(path)
    scene = parse_table(run.scene, Scene, "scene", f"{path} (scene inside)")
    steps = parse_table(run.protocol, Protocol, "protocol", f"{path} (protocol inside)").step
    film = scene.specimen.specimen()
    fitted = None if fit is None else read_fit(fit, film.material)
    film = film if fitted is None else film.with_material(fitted.material)
    certificates = run.certificates
    found: list[Stroke] = []
    for number, step in enumerate(steps, start=1):
        if not isinstance(step, Follow):
            continue
        actuator = Actuator(film, step.bias.bias(film))
        rests = [_rest(run, phase, end, actuator) for phase, end in _phases(run, "rest") if phase.step == number]
        for before, there, after in zip(rests, rests[1:], rests[2:], strict=False):
            if before.voltage == 0.0 == after.voltage and there.voltage > 0.0:
                found.append(_stroke(run, number, step, actuator, (before, there, after), certificates, fitted))
    if not found:
        raise DataError(f"{path}: holds no follow step with a rest under voltage and one at 0 V on either side.")
    return found


def _phases(run: Run, kind: str) -> list[tuple[Phase, float]]:
    pairs = zip(run.phases, run.phases[1:], strict=False)
    return [(phase, after.t) for phase, after in pairs if phase.kind == kind]


def _rest(run: Run, phase: Phase, end: float, actuator: Actuator) -> Rest:
    inside = (run.t >= phase.t) & (run.t < end) & ~run.flagged & np.isfinite(run.h) & np.isfinite(run.force)
    if np.count_nonzero(inside) < 10:
        raise DataError(f"{run.log.path}: too few good samples in the rest at {phase.t:.1f} s.")
    h, force = run.h[inside], run.force[inside]
    mean = float(h.mean())
    voltage = float(run.voltage[inside].mean()) if phase.voltage > 0 else 0.0
    model = balance([actuator], np.array([[mean]]), np.array([[voltage]]))
    stiffness = float(model.stiffness[0, 0])
    away = float(actuator.bias.force(np.asarray(mean))) - float(force.mean())
    if not (math.isfinite(stiffness) and math.isfinite(away)):
        raise DataError(f"{run.log.path}: the model has no stiffness at {mean * 1e3:.2f} mm and {voltage:.0f} V.")
    length = max(1, round(BATCH_S / float(np.median(np.diff(run.t[inside])))))
    error = math.hypot(_error_of_mean(force, length) / abs(stiffness), _error_of_mean(h, length))
    return Rest(phase.step, voltage, mean + away / stiffness, error, stiffness, phase.t, end)


def _error_of_mean(values: Floats, length: int) -> float:
    """Standard error of the mean from means over ``length`` samples."""
    count = len(values) // length
    if count < 4:
        return float(values.std(ddof=1) / math.sqrt(len(values)))
    means = values[: count * length].reshape(count, length).mean(axis=1)
    return float(means.std(ddof=1) / math.sqrt(count))


def _stroke(
    run: Run,
    number: int,
    step: Follow,
    actuator: Actuator,
    rests: tuple[Rest, Rest, Rest],
    certificates: Mapping[str, Certificate],
    fitted: FittedFilm | None,
) -> Stroke:
    before, there, after = rests
    start = 0.5 * (before.h + after.h)
    stroke = there.h - start
    gains = {role: one.gain_uncertainty for role, one in certificates.items()}
    # A force that is wrong by a part moves both rests; what the two do not share is in the stroke.
    force_there, force_start = (float(actuator.bias.force(np.asarray(h))) for h in (there.h, start))
    by_gain = force_there / there.stiffness - force_start / before.stiffness
    drift = abs(before.h - after.h) / math.sqrt(12)  # what changed in the film or the zero between the two rests
    uncertainty = math.hypot(
        there.error,
        math.hypot(before.error, after.error) / 2,
        drift,
        gains.get("displacement", 0.0) * stroke,
        gains.get("force", 0.0) * by_gain,
    )
    released = [phase.t for phase, _ in _phases(run, "release") if phase.step == number and phase.t < there.begin]
    # From while the disk is held at V, before it is let go, to the end of its rest: both ends of the way are in it.
    work, work_noise = _work(run, actuator.bias, released[-1] - step.settle_s, there.end, start, there.h)
    mean_force = 0.5 * (force_there + force_start)
    work_uncertainty = math.hypot(
        work_noise, gains.get("force", 0.0) * mean_force * stroke, gains.get("displacement", 0.0) * work
    )
    expected, uncertain = _expectation(actuator, there.voltage, fitted, step)
    return Stroke(
        step=number,
        kind=step.bias.kind,
        nominal_voltage=float(round(there.voltage, -1)),
        voltage=there.voltage,
        start=start,
        stroke=stroke,
        stroke_uncertainty=uncertainty,
        work=work,
        work_uncertainty=work_uncertainty,
        expected_stroke=expected[0],
        expected_stroke_uncertainty=uncertain[0],
        expected_work=expected[1],
        expected_work_uncertainty=uncertain[1],
    )


def _work(run: Run, bias: Bias, begin: float, end: float, h0: float, h1: float) -> tuple[float, float]:
    """Integral of ``B - F`` (J) over the way from ``h0`` to ``h1``, and its statistical uncertainty.

    The excess is fitted by a parabola in h: over a stroke film and bias are that smooth, and samples that come while
    the disk hardly moves count like the others.
    """
    inside = (run.t >= begin) & (run.t <= end) & ~run.flagged & np.isfinite(run.h) & np.isfinite(run.force)
    h, excess = run.h[inside], bias.force(run.h[inside]) - run.force[inside]
    if len(h) < 10:
        raise DataError(f"{run.log.path}: too few good samples between {begin:.1f} and {end:.1f} s.")
    x = (h - h0) / (h1 - h0)
    columns = np.stack([np.ones_like(x), x, x * x], axis=1)
    inverse = np.linalg.pinv(columns)
    rest = excess - columns @ (inverse @ excess)
    weights = np.array([1.0, 1 / 2, 1 / 3]) @ inverse * (h1 - h0)
    scatter = float(rest @ rest) / max(len(x) - 3, 1)
    return float(weights @ excess), math.sqrt(scatter * float(weights @ weights))


def _expectation(
    actuator: Actuator, voltage: float, fitted: FittedFilm | None, step: Follow
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Stroke and work by the model, and their standard uncertainties by the fit's covariance (first order)."""
    expected = _expected(actuator, voltage)
    if fitted is None:
        return expected, (math.nan, math.nan)
    slopes = []
    for name in fitted.names:
        sides = []
        for sign in (1.0, -1.0):
            film = actuator.film.with_material(_nudged(fitted.material, name, 1.0 + sign * NUDGE))
            sides.append(_expected(Actuator(film, step.bias.bias(film)), voltage))
        width = 2 * NUDGE * _value(fitted.material, name)
        slopes.append([(up - down) / width for up, down in zip(*sides, strict=True)])
    by = np.array(slopes)
    variance = np.einsum("pi,pq,qi->i", by, fitted.covariance, by)
    stroke, work = np.sqrt(np.maximum(variance, 0.0)).tolist()
    return expected, (stroke, work)


def _value(material: Material, name: str) -> float:
    """The parameter ``name`` ("mu1", "alpha1", "eps_r")."""
    return material.eps_r if name == "eps_r" else material.values[name]


def _nudged(material: Material, name: str, factor: float) -> Material:
    """The material with the parameter ``name`` multiplied by ``factor``."""
    return material.with_value(name, factor * _value(material, name))


def _expected(actuator: Actuator, voltage: float) -> tuple[float, float]:
    """Stroke (m) and work (J, Gauss-Legendre) by the model; NaN where it knows no rest."""
    top = actuator.span[1]
    h0 = rest_from(actuator, 0.0, 0.0, top)
    h1 = None if h0 is None else rest_from(actuator, h0, voltage, top)
    if h0 is None or h1 is None:
        return math.nan, math.nan
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    h = 0.5 * (h0 + h1) + 0.5 * (h1 - h0) * nodes
    states = balance([actuator], h[None], np.full((1, NODES), voltage))
    return h1 - h0, float(-states.excess[0] @ weights) * 0.5 * (h1 - h0)
