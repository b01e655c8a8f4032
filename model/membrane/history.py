r"""Films that take time: force of a film with viscous branches along a history of displacement and voltage.

Maxwell branches stand in parallel with the relaxed film (Reese & Govindjee 1998, in logarithmic principal strains).
Branch k has the share ``ratio`` of the relaxed film's law and the relaxation time ``tau``; of the logarithmic stretches
``u_i = ln l_i`` a part ``v_i`` is viscous, and only the rest ``w = u - v`` makes stress:

.. math:: \sigma_i = S_i(u) + \sum_k \beta_k S_i(w^k) - \varepsilon E^2, \qquad
          \dot v_i^k = \frac{1}{2 G \tau_k} \left(S_i - \tfrac{1}{3} (S_1 + S_2)\right)(w^k)

At the start the film is rested in its flat pre-stretched state: ``v = ln lp`` everywhere. At every instant the membrane
is in equilibrium; ``v`` moves at the quadrature points of `model.membrane.ritz`. An L-stable, stiffly accurate method
of the fourth order (Hairer & Wanner, Solving Ordinary Differential Equations II, table IV.6.5) takes the steps. A stage
of it, ``v = v* + g dt dv/dt``, asks at each point for the ``w`` with

    w + c P S(w)/(2 G) = u - v*,    c = g dt/tau,    P = [[2/3, -1/3], [-1/3, 2/3]],

which is the gradient of a convex function: with it the stage is an elastic membrane with another energy, and the
unknowns, Newton's method and the test of stability are those of the elastic film.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import Array
from model.material.law import Derivatives, Evaluations, Film, Law, stack
from model.membrane import refinement, ritz
from model.membrane.output import fine_table
from model.membrane.refinement import ROUND_OFF_TENSION
from model.membrane.ritz import Grid, Index, Problem, State
from model.membrane.solve import Status, solve_many
from model.specimen import Specimen

# The method's coefficients: nodes, matrix, and solution less embedded solution of the third order.
NODES = (1 / 4, 3 / 4, 11 / 20, 1 / 2, 1.0)
MATRIX = (
    (),
    (1 / 2,),
    (17 / 50, -1 / 25),
    (371 / 1360, -137 / 2720, 15 / 544),
    (25 / 24, -49 / 48, 125 / 16, -85 / 12),
)
DIAGONAL = 1 / 4
DEFECT = (-3 / 16, -27 / 32, 25 / 32, 0.0, 1 / 4)

SAFETY = 0.9  # of the step that the error estimate allows
LEAST_FACTOR, MOST_FACTOR = 0.2, 4.0  # of the next step over the last
STEP_SHARE = 0.1  # of the tolerance: error that one step may add, as many steps add up
EMBEDDED_FACTOR = 0.1  # error of a step over the estimate, which is the embedded method's: held to the truth by tests
FIRST_SHARE = 0.02  # of a stretch of the history: its first step
MOST_REJECTED = 40  # steps in a row without success: there is no state
LEAST_STEP = 1e-5  # of the shorter of a stretch of the history and the shortest relaxation time: the same
FLAT = 1e-9  # height over ring radius that stands for the flat film
INNER_STEPS, INNER_CHANGE = 30, 1e-13  # Newton's method for the strain of a branch at a point
MORE_MODES = 2  # than an elastic film of the same tolerance: the viscous strain is a field of its own


@dataclass(frozen=True)
class History:
    """Answers along a history, (times,) each; NaN where ``status`` is neither TAUT nor WRINKLED.

    Attributes
    ----------
    force : F (N), positive when it pushes the disk to positive h
    peak_field : largest true field (V/m)
    min_hoop_stress, min_meridional_stress : smallest true stresses (Pa)
    status : `model.membrane.solve.Status` numbers
    error_estimate : estimated error of the force over the largest force of the history
    steps, rejected : steps of time taken, and tried in vain
    """

    force: Array
    peak_field: Array
    min_hoop_stress: Array
    min_meridional_stress: Array
    status: NDArray[np.int8]
    error_estimate: Array
    steps: int
    rejected: int


class _Stage:
    """The law of a film with branches whose viscous strain follows an implicit stage; stands in for a `Law`.

    law : of the relaxed film, moduli in units of G
    start : ``v*`` of every branch at the points, (2, K, Q, M, S)
    ratio, lag : ``beta`` and ``c``, (K, 1, 1, 1)
    """

    def __init__(self, law: Law, start: Array, ratio: Array, lag: Array) -> None:
        self.law, self.start, self.ratio, self.lag = law, start, ratio, lag
        self.elastic = np.empty(0)  # w at the last evaluation, to begin the next one with

    def take(self, index: Index) -> Self:
        """The law of the states at ``index``."""
        return type(self)(self.law.take(index), self.start[..., index], self.ratio, self.lag)

    def branch(self, log: Array) -> tuple[Array, Derivatives]:
        """Elastic strains ``w`` (2, K, ...) of the branches at log stretches (3, ...), and the law there."""
        total = log[:2, None] - self.start
        half = 0.5 * self.lag
        w = self.elastic if self.elastic.shape == total.shape else total / (1.0 + self.lag)
        for _ in range(INNER_STEPS):
            found = self.law.derivatives(stack(w[0], w[1]))
            s1, s2, h11, h12, h22 = found
            if not self.lag.any():
                return total, self.law.derivatives(stack(total[0], total[1]))
            r1 = total[0] - w[0] - half * (2.0 * s1 - s2) / 3.0
            r2 = total[1] - w[1] - half * (2.0 * s2 - s1) / 3.0
            a11, a12 = 1.0 + half * (2.0 * h11 - h12) / 3.0, half * (2.0 * h12 - h22) / 3.0
            a21, a22 = half * (2.0 * h12 - h11) / 3.0, 1.0 + half * (2.0 * h22 - h12) / 3.0
            over = 1.0 / (a11 * a22 - a12 * a21)
            change = np.array(((a22 * r1 - a12 * r2) * over, (a11 * r2 - a21 * r1) * over))
            size = float(np.abs(change).max(initial=0.0))
            w = w + (change if size < 0.5 else np.clip(change, -0.5, 0.5))
            if not size > INNER_CHANGE:
                break
        self.elastic = w
        return w, self.law.derivatives(stack(w[0], w[1]))

    def derivatives(self, log: Array) -> Derivatives:
        """As `Law.derivatives`, of the film with its branches."""
        t1, t2, h11, h12, h22 = self.law.derivatives(log)
        _, (s1, s2, c11, c12, c22) = self.branch(log)
        half = 0.5 * self.lag
        # C (I + c P C/2)^-1: the two are symmetric matrices, and so is the result.
        a11, a12 = 1.0 + half * (2.0 * c11 - c12) / 3.0, half * (2.0 * c12 - c22) / 3.0
        a21, a22 = half * (2.0 * c12 - c11) / 3.0, 1.0 + half * (2.0 * c22 - c12) / 3.0
        over = self.ratio / (a11 * a22 - a12 * a21)
        t1 += (self.ratio * s1).sum(axis=0)
        t2 += (self.ratio * s2).sum(axis=0)
        h11 += ((c11 * a22 - c12 * a21) * over).sum(axis=0)
        h12 += ((c12 * a11 - c11 * a12) * over).sum(axis=0)
        h22 += ((c22 * a11 - c12 * a12) * over).sum(axis=0)
        return t1, t2, h11, h12, h22


class _NoState(Exception):
    """The film has no stable state here."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of time.

    dt : its length (s)
    viscous, rate, state, lam : viscous strains and their rates, state and dimensionless force at its end
    defect, drift : estimated errors of the dimensionless force, and of the viscous strains on average
    tail : error of the dimensionless force by the number of modes
    """

    dt: float
    viscous: Array
    rate: Array
    state: State
    lam: float
    defect: float
    drift: float
    tail: float


class Stepper:
    """A film on its way through a history."""

    def __init__(self, specimen: Specimen, t: Array, h: Array, voltage: Array, tolerance: float) -> None:
        self.specimen, self.t, self.h, self.voltage = specimen, t, h, voltage
        material = specimen.material
        shear = material.shear_modulus
        branches = [one for one in material.branches if one.ratio > 0.0]
        self.ratio = np.array([one.ratio for one in branches]).reshape(-1, 1, 1, 1)
        self.time = np.array([one.time for one in branches]).reshape(-1, 1, 1, 1)
        self.law = material.law(np.array(material.mu)[:, None] / shear, np.array(material.alpha).reshape(-1, 1))
        self.field = material.permittivity / (specimen.thickness**2 * shear)
        self.unit = 2.0 * math.pi * specimen.ring_radius * specimen.thickness * shear / specimen.prestretch**2
        self.log_prestretch = math.log(specimen.prestretch)
        self.span = math.log(specimen.ring_radius / specimen.disk_radius)
        self.goal = max(1e-7, math.sqrt(0.03 * tolerance))
        self.charged = bool(voltage.any())
        self.count = Evaluations()
        breaks = self.problem(np.array([t[0]]), self.law).cut()
        modes = refinement.first_modes(self.span / (len(breaks) - 1), tolerance) + MORE_MODES
        self.grid = Grid.lay(modes, breaks)
        shape = (2, len(branches), *self.grid.radius.shape)
        self.now = float(t[0])
        self.viscous = np.full(shape, self.log_prestretch)
        self.rate = np.zeros(shape)
        elastic = self.problem(np.array([t[0]]), self.law)
        elastic.height = np.maximum(elastic.height, 1e-3)
        self.state = ritz.guess(elastic, self.grid)
        self.height = elastic.height

    def problem(self, t: Array, law: Law | _Stage) -> Problem:
        """The membrane at the times ``t``, with ``law`` for its film."""
        height = np.abs(np.interp(t, self.t, self.h)) / self.specimen.ring_radius
        field = self.field * np.interp(t, self.t, self.voltage) ** 2 if self.charged else None
        same = np.ones(len(t))
        film = Film(law, field, self.count)  # type: ignore[arg-type] # a stage answers like a law
        return Problem(film, self.log_prestretch * same, self.span * same, np.maximum(height, FLAT))

    def balance(self, t: Array, start: Array, dt: float) -> tuple[refinement.Iterate, _Stage, ritz.Points]:
        """Equilibrium at the times ``t`` with viscous strains ``start`` that follow for ``dt`` times the diagonal.

        Raises
        ------
        _NoState : none that is stable was found
        """
        stage = _Stage(self.law, start, self.ratio, DIAGONAL * dt / self.time)
        problem = self.problem(t, stage)
        state, grid = self.state, self.grid
        if len(t) > 1:
            first = np.zeros(len(t), dtype=np.intp)
            state, grid = state.take(first), grid.take(first)
        begun = State(state.c, state.w * (problem.height / self.height))
        found = refinement.newton(problem, grid, begun, self.goal)
        at = ritz.evaluate(problem, grid, found.state)
        if not (found.ok.all() and np.isfinite(at.law.t1).all()):
            raise _NoState
        return found, stage, at

    def begin(self) -> None:
        """The state at the beginning: branches rested in the flat film."""
        if self.h[0] == 0.0:
            return
        found, _, at = self.balance(np.array([self.now]), self.viscous, 0.0)
        self.state, self.height = found.state, self.problem(np.array([self.now]), self.law).height
        self.rate = self.flow(at.log[:2, None] - self.viscous)

    def flow(self, elastic: Array) -> Array:
        """``dv/dt`` of branches with these elastic strains."""
        s1, s2, *_ = self.law.derivatives(stack(elastic[0], elastic[1]))
        return np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) / (6.0 * self.time)

    def step(self, dt: float) -> Step:
        """A step from now, which `accept` takes. Raises `_NoState`."""
        kept, height = self.state, self.height
        rates: list[Array] = []
        try:
            for node, row in zip(NODES, MATRIX, strict=True):
                start = self.viscous + dt * sum((a * rate for a, rate in zip(row, rates, strict=True)), np.zeros(1))
                here = np.array([self.now + node * dt])
                found, stage, at = self.balance(here, start, dt)
                w, _ = stage.branch(at.log)
                rates.append((at.log[:2, None] - w - start) / (DIAGONAL * dt))
                self.state, self.height = found.state, self.problem(here, self.law).height
            viscous = start + DIAGONAL * dt * rates[-1]
            defect = dt * sum((e * rate for e, rate in zip(DEFECT, rates, strict=True)), np.zeros(1))
            other, _, _ = self.balance(here, viscous - defect, 0.0)
        except _NoState:
            self.state, self.height = kept, height
            raise
        self.state, self.height = kept, height
        lam = float(found.lam[0])
        drift = (self.ratio / (1.0 + self.ratio.sum()) * np.abs(defect)).sum(axis=1)
        # Of a flat film the force is zero whatever the number of modes.
        tail = abs(float(found.tail[0]) * lam) if float(self.problem(here, self.law).height[0]) > FLAT else 0.0
        return Step(dt, viscous, rates[-1], found.state, lam, abs(float(other.lam[0]) - lam), float(drift.mean()), tail)

    def accept(self, step: Step) -> None:
        """Go on to the end of a step."""
        self.now += step.dt
        self.viscous, self.rate, self.state = step.viscous, step.rate, step.state
        self.height = self.problem(np.array([self.now]), self.law).height

    def lost(self, step: Step | None) -> Status:
        """Why there is no state after now: the film hangs slack, is unstable under its voltage, or neither is sure."""
        at = ritz.evaluate(self.problem(np.array([self.now]), self.law), self.grid, self.state)
        if step is not None:
            return Status.NOT_CONVERGED
        if float(at.law.t1.min()) < 0.05 * float(at.law.t1.max()):
            return Status.SLACK
        return Status.UNSTABLE if float(np.interp(self.now, self.t, self.voltage)) != 0.0 else Status.NOT_CONVERGED

    def within(self, step: Step, times: Array) -> Array:
        """Viscous strains at times inside a step, by the cubic through its ends and their rates: (2, K, Q, M, times).

        Its error is of the order of the step's own estimate.
        """
        x = (times - self.now) / step.dt
        rise = step.viscous - self.viscous
        found: Array = self.viscous + x * x * (3.0 - 2.0 * x) * rise
        found += step.dt * x * (1.0 - x) * ((1.0 - x) * self.rate - x * step.rate)
        return found


def solve_history(
    specimen: Specimen,
    t: ArrayLike,
    h: ArrayLike,
    voltage: ArrayLike = 0.0,
    times: ArrayLike | None = None,
    *,
    tolerance: float = 1e-6,
) -> History:
    """Force along a history, from a film rested flat in its pre-stretched state at ``t[0]``.

    Parameters
    ----------
    specimen : the film; its material has the branches
    t : times (s) at which the history bends, rising
    h, voltage : displacement of the disk (m) and voltage (V) there, linear in between
    times : where the answer is wanted, within ``t``; at ``t`` itself when not given
    tolerance : error of the force to aim for, over the largest force of the history: 1e-10 to 1e-2

    Returns
    -------
    History at ``times``, in their order. Where the film has no state any more, a status and NaN from there on.

    Raises
    ------
    ValueError : the history is no history, or times lie outside it
    """
    t, h, voltage, times = _checked(t, h, voltage, times, tolerance)
    found = _Answers(len(times))
    with np.errstate(all="ignore"):
        elastic = solve_many(specimen, h, voltage, tolerance=1e-4).force
        scale = float(np.nanmax(np.abs(elastic), initial=0.0))
        stepper = Stepper(specimen, t, h, voltage, tolerance)
        scale = scale / stepper.unit or 1e-12
        try:
            stepper.begin()
        except _NoState:
            found.end(np.arange(len(times)), Status.NOT_CONVERGED)
            return found.history(1.0, 0, 0)
        found.read(stepper, np.flatnonzero(times == t[0]), times, stepper.viscous, 0.0)
        steps, rejected = _march(stepper, times, found, scale, STEP_SHARE * tolerance)
    return found.history(scale * stepper.unit, steps, rejected)


def _checked(
    t: ArrayLike, h: ArrayLike, voltage: ArrayLike, times: ArrayLike | None, tolerance: float
) -> tuple[Array, Array, Array, Array]:
    t = np.atleast_1d(np.asarray(t, dtype=float))
    if t.ndim != 1 or len(t) < 2:
        raise ValueError("t: a history needs at least two times")
    if not (np.isfinite(t).all() and (np.diff(t) > 0.0).all()):
        raise ValueError("t: the times of a history must be finite and rise")
    values = []
    for name, given in (("h", h), ("voltage", voltage)):
        value = np.asarray(given, dtype=float)
        if value.shape not in ((), t.shape):
            raise ValueError(f"{name} has {value.size} values, t has {t.size}; give one a time")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} holds a value that is not finite")
        values.append(np.broadcast_to(value, t.shape).copy())
    asked = t if times is None else np.atleast_1d(np.asarray(times, dtype=float))
    if not (np.isfinite(asked).all() and (asked >= t[0]).all() and (asked <= t[-1]).all()):
        raise ValueError(f"times must be finite and within the history, {t[0]:g} to {t[-1]:g} s")
    if not 1e-10 <= tolerance <= 1e-2:
        raise ValueError(f"tolerance = {tolerance!r}: allowed are 1e-10 to 1e-2")
    return t, values[0], values[1], asked


def _march(stepper: Stepper, times: Array, found: _Answers, scale: float, allowed: float) -> tuple[int, int]:
    """Step through the history and read the answers on the way; steps taken and rejected."""
    steps = rejected = 0
    error = 0.0
    for left, right in zip(stepper.t[:-1].tolist(), stepper.t[1:].tolist(), strict=True):
        dt = FIRST_SHARE * (right - left)
        shortest = LEAST_STEP * min([right - left, *stepper.time.ravel().tolist()])
        failures = 0
        while stepper.now < right:
            rest = right - stepper.now
            dt = rest if dt > 0.99 * rest else min(dt, max(0.5 * rest, 1e-3 * dt))
            step: Step | None = None
            try:
                step = stepper.step(dt)
                size = max(step.defect / scale, step.drift) / allowed
            except _NoState:
                size = math.inf
            factor = SAFETY * size**-0.25 if 0.0 < size < math.inf else (MOST_FACTOR if size == 0.0 else 0.25)
            factor = min(max(factor, LEAST_FACTOR), MOST_FACTOR)
            if step is None or not size <= 1.0:
                rejected += 1
                failures += 1
                dt *= min(factor, 0.7)
                if failures > MOST_REJECTED or dt < shortest:
                    later = np.flatnonzero(times > stepper.now)
                    found.end(later, stepper.lost(step))
                    return steps, rejected
                continue
            failures = 0
            steps += 1
            error += EMBEDDED_FACTOR * max(step.defect / scale, step.drift)
            end = right if dt == rest else stepper.now + dt
            inside = np.flatnonzero((times > stepper.now) & (times <= end))
            if len(inside):
                viscous = stepper.within(step, times[inside])
                kept = stepper.state, stepper.height
                stepper.state = step.state
                stepper.height = stepper.problem(np.array([end]), stepper.law).height
                found.read(stepper, inside, times, viscous, error + step.tail / scale)
                stepper.state, stepper.height = kept
            stepper.accept(step)
            stepper.now = end
            dt *= factor
    return steps, rejected


class _Answers:
    """The answers while they are being filled, one entry a time."""

    def __init__(self, count: int) -> None:
        names = ("force", "peak_field", "min_hoop_stress", "min_meridional_stress", "error")
        self.real = {name: np.full(count, np.nan) for name in names}
        self.status = np.full(count, Status.NOT_CONVERGED, dtype=np.int8)

    def end(self, index: NDArray[np.intp], status: Status) -> None:
        """No state any more at these times."""
        self.status[index] = status

    def read(self, stepper: Stepper, index: NDArray[np.intp], times: Array, viscous: Array, error: float) -> None:
        """The film at ``times[index]``, with its viscous strains there (2, K, Q, M, times)."""
        if len(index) == 0:
            return
        here = times[index]
        film = stepper.specimen
        shear = film.material.shear_modulus
        h, volts = np.interp(here, stepper.t, stepper.h), np.interp(here, stepper.t, stepper.voltage)
        viscous = np.broadcast_to(viscous, (*viscous.shape[:-1], len(here)))
        if (h == 0.0).all() and bool((viscous == stepper.log_prestretch).all()):
            self._flat(stepper, index, volts)
            return
        try:
            found, _, at = stepper.balance(here, viscous, 0.0)
        except _NoState:
            if len(index) > 1:  # one by one: some may have a state
                for k in range(len(index)):
                    self.read(stepper, index[k : k + 1], times, viscous[..., k : k + 1], error)
            return
        fine = fine_table(stepper.grid.table.modes)

        def largest(values: Array) -> Array:
            inside = np.tensordot(fine, values, 1)
            most: Array = inside.max(axis=(0, 1))
            return most

        hoop, meridional = -largest(-at.law.t2), -largest(-at.law.t1)
        self.real["force"][index] = np.sign(h) * stepper.unit * found.lam
        self.real["peak_field"][index] = np.abs(volts) / film.thickness * np.exp(largest(-at.log[2]))
        self.real["min_hoop_stress"][index] = shear * hoop
        self.real["min_meridional_stress"][index] = shear * meridional
        self.real["error"][index] = error
        self.status[index] = np.where(hoop < ROUND_OFF_TENSION * meridional, Status.WRINKLED, Status.TAUT)

    def _flat(self, stepper: Stepper, index: NDArray[np.intp], volts: Array) -> None:
        """The flat film at rest: the same stress in all directions, and no force."""
        film, log = stepper.specimen, np.full(1, stepper.log_prestretch)
        area = 2.0 * stepper.log_prestretch
        stress = stepper.law.derivatives(stack(log, log))[0] - stepper.field * volts**2 * math.exp(2.0 * area)
        for name in ("min_hoop_stress", "min_meridional_stress"):
            self.real[name][index] = film.material.shear_modulus * stress
        self.real["force"][index] = self.real["error"][index] = 0.0
        self.real["peak_field"][index] = np.abs(volts) / film.thickness * math.exp(area)
        self.status[index] = np.where(stress < 0.0, Status.SLACK, Status.TAUT)
        self.real["force"][index[self.status[index] == Status.SLACK]] = np.nan

    def history(self, scale: float, steps: int, rejected: int) -> History:
        """Everything, the error over the largest force of the history; ``scale`` (N) is that of the relaxed film."""
        force = self.real["force"]
        answered = self.status <= Status.WRINKLED
        largest = max(float(np.abs(force[answered]).max(initial=0.0)), scale)
        return History(
            force=np.where(answered, force, np.nan),
            peak_field=self.real["peak_field"],
            min_hoop_stress=self.real["min_hoop_stress"],
            min_meridional_stress=self.real["min_meridional_stress"],
            status=self.status,
            error_estimate=np.where(answered, self.real["error"] * scale / largest, np.nan),
            steps=steps,
            rejected=rejected,
        )
