"""Force, stresses and field of a conical film at a displacement and a voltage, with a status and an error estimate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import Array
from model.material.law import Evaluations, Film, stack, stress
from model.material.materials import EPSILON_0
from model.membrane import compiled, from_rest, ritz, tension_field
from model.membrane.flat import Flat, Solved
from model.membrane.profile import Profile, dense, profile
from model.membrane.refinement import ROUND_OFF_TENSION, Answer, Start, groups, prolonged, refine
from model.membrane.ritz import LONGEST, Grid, Problem
from model.membrane.solution import Solutions, Status
from model.specimen import Specimen

__all__ = ["Solution", "Solutions", "Status", "Wrinkling", "profiles", "solve", "solve_many"]

Wrinkling = Literal["plain", "tension_field"]
BLOCK = 1024  # states solved together: their arrays stay in the processor's cache
# Where the voltage takes more than this share of the meridional stiffness, other branches may be near: such a state is
# followed from rest.
SOFTENING = 0.35
WIDEST = 28.0  # ln(b/a) beyond which the film's R^2 has no place in double precision


@dataclass(frozen=True)
class Solution:
    """The answer to one state; the attributes are those of `Solutions`, as plain numbers."""

    specimen: Specimen
    h: float
    voltage: float
    force: float
    peak_field: float
    peak_field_radius: float
    min_hoop_stress: float
    min_meridional_stress: float
    max_stretch: float
    status: Status
    error_estimate: float
    iterations: int
    modes: int
    stable: bool
    field_exceeded: bool
    stretch_exceeded: bool
    dforce: dict[str, Any] | None = None
    evaluations: Evaluations = field(default_factory=Evaluations, compare=False)
    kept: Solved | None = field(default=None, repr=False, compare=False)
    quick: compiled.One | None = field(default=None, repr=False, compare=False)

    @property
    def answered(self) -> bool:
        """Whether there is a force."""
        return self.status <= Status.WRINKLED

    @property
    def tension_margin(self) -> float:
        """The smaller of the two least stresses (Pa): negative when tension is lost."""
        return min(self.min_hoop_stress, self.min_meridional_stress)

    def profile(self, points: int = 101) -> Profile:
        """Shape, stretches, stresses and field from disk to ring, at ``points`` radii an element.

        Raises
        ------
        ValueError : the state has no answer
        """
        inputs = _Inputs.gather(self.specimen, self.h, self.voltage)
        solved = self._solved(inputs)
        return inputs.profile(np.zeros(1, dtype=np.intp), solved, dense(solved[1], points)).of(0)

    def capacitance(self) -> float:
        r"""Capacitance of the deformed film (F) between electrodes that cover it.

        The film keeps its volume: where its area has grown by :math:`\lambda_1\lambda_2` it is thinner by as much, so
        that

        .. math:: C = \varepsilon \int \frac{dA}{t}
                  = \frac{\varepsilon}{T \lambda_p^2} \int_a^b 2 \pi R (\lambda_1 \lambda_2)^2 dR

        Raises
        ------
        ValueError : the state has no answer
        """
        problem, grid, state, _ = self._solved(_Inputs.gather(self.specimen, self.h, self.voltage))
        film, at = self.specimen, ritz.evaluate(problem, grid, state)
        area = 2.0 * math.pi * film.ring_radius**2 * float((grid.twice * np.exp(-2.0 * at.log[2])).sum())
        return film.material.permittivity / (film.thickness * film.prestretch**2) * area

    def _solved(self, inputs: _Inputs) -> Solved:
        """The state itself, in arrays. Raises ValueError when it has no answer."""
        if self.quick is not None and self.answered:
            problem = _Block(inputs, np.zeros(1, dtype=np.intp), self.evaluations).problem
            return problem, *self.quick.arrays(), np.array([self.quick.lam])
        if self.kept is None:
            raise ValueError(f"no profile: {self.status.message}")
        return self.kept


@dataclass
class _Inputs:
    """The broadcast inputs as flat arrays."""

    shape: tuple[int, ...]
    specimens: list[Specimen]
    which: NDArray[np.intp]  # index of the specimen of each state
    h: Array
    voltage: Array

    @classmethod
    def gather(
        cls, specimen: Specimen | Sequence[Specimen] | NDArray[np.object_], h: ArrayLike, v: ArrayLike
    ) -> _Inputs:
        h_array = np.asarray(h, dtype=float)
        v_array = np.asarray(v, dtype=float)
        shape: tuple[int, ...]
        if isinstance(specimen, Specimen):
            specimens, shape = [specimen], ()
        elif isinstance(specimen, np.ndarray):
            specimens, shape = specimen.ravel().tolist(), specimen.shape
        else:
            specimens, shape = list(specimen), (len(specimen),)
        index = np.arange(len(specimens), dtype=np.intp).reshape(shape)
        shape = np.broadcast(index, h_array, v_array).shape
        which, hh, vv = (_spread(values, shape) for values in (index, h_array, v_array))
        return cls(shape, specimens, which, hh, vv)

    def profile(self, index: NDArray[np.intp], solved: Solved, x: Array) -> Profile:
        """Profiles of the states at ``index`` at places ``x`` (points, S) of ``ln(R/b)``."""
        films = [self.specimens[i] for i in self.which[index]]
        found = profile(
            *solved,
            x,
            ring=np.array([film.ring_radius for film in films]),
            shear=np.array([film.material.shear_modulus for film in films]),
            field=np.abs(self.voltage[index]) / [film.thickness for film in films],
        )
        sign = np.where(self.h[index] < 0.0, -1.0, 1.0)[:, None]
        return replace(found, z=sign * found.z, slope=sign * found.slope)

    def blocks(self, wanted: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
        """States to solve together: with or without voltage, of like spans, and as many as stay in the cache."""
        index = np.flatnonzero(np.isfinite(self.h) & np.isfinite(self.voltage) & wanted)
        charged = self.voltage[index] != 0.0
        groups = [index] if charged.all() or not charged.any() else [index[~charged], index[charged]]
        of_film = np.log([s.ring_radius / s.disk_radius for s in self.specimens])
        laws = {s.material.law for s in self.specimens}
        if len(laws) > 1:
            of_law = np.array([list(laws).index(s.material.law) for s in self.specimens])
            groups = [group[of_law[self.which[group]] == k] for group in groups for k in range(len(laws))]
        for group in groups:
            spans = of_film[self.which[group]]
            if len(self.specimens) > 1:
                order = np.argsort(spans, kind="stable")
                group, spans = group[order], spans[order]
            pieces = np.ceil(spans / LONGEST)
            cuts = np.flatnonzero(np.diff(pieces)) + 1
            for part in np.split(group, cuts):
                for start in range(0, len(part), BLOCK):
                    yield part[start : start + BLOCK]


def _spread(values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Values broadcast to a shape, flat."""
    if values.shape != shape:
        spread = np.empty(shape, dtype=values.dtype)
        spread[...] = values
        values = spread
    return values.ravel()


def _padded(materials: Sequence[tuple[float, ...]], fill: float) -> Array:
    """Parameters of films of one law, (parameters, films): a series of fewer terms is filled up."""
    terms = max(map(len, materials))
    if any(len(values) < terms for values in materials):
        materials = [values + (fill,) * (terms - len(values)) for values in materials]
    return np.array(materials, dtype=float).reshape(len(materials), terms).T


def solve_many(
    specimen: Specimen | Sequence[Specimen] | NDArray[np.object_],
    h: ArrayLike,
    voltage: ArrayLike = 0.0,
    *,
    tolerance: float = 1e-8,
    wrinkling: Wrinkling = "plain",
    sensitivities: bool = False,
) -> Solutions:
    """Solve many states at once.

    Parameters
    ----------
    specimen : one film, or a sequence or object array of films, broadcast with the others
    h, voltage : displacement of the disk (m) and voltage (V), broadcast to a shape S
    tolerance : relative error of the force to aim for, 1e-12 to 1e-2
    wrinkling : "plain", the paper's equations whatever the hoop stress, beyond the slack voltage too as long as a
        stable state with tension along the film is found (WRINKLED); or "tension_field", the relaxed energy
    sensitivities : also give ``dforce``

    Returns
    -------
    Solutions of shape S. A state without an answer has a status that says so and NaN; it never raises.
    """
    return _solve(_Inputs.gather(specimen, h, voltage), tolerance, wrinkling, sensitivities)[0]


def profiles(
    specimen: Specimen | Sequence[Specimen] | NDArray[np.object_],
    h: ArrayLike,
    voltage: ArrayLike = 0.0,
    points: int = 101,
    *,
    tolerance: float = 1e-4,
    wrinkling: Wrinkling = "plain",
) -> Profile:
    """The profiles of many states at even steps of ln R, (states, points); NaN where there is no answer.

    Parameters as in `solve_many`; the tolerance, of the force, is for drawing.
    """
    inputs = _Inputs.gather(specimen, h, voltage)
    found = Profile.blank(len(inputs.h), points)
    share = np.linspace(1.0, 0.0, points)[:, None]
    with np.errstate(all="ignore"):
        for index, solved in _solve(inputs, tolerance, wrinkling, False, keep=True)[1]:
            found.put(index, inputs.profile(index, solved, -share * solved[0].span))
    return found


def _check(tolerance: float, wrinkling: str) -> None:
    if not 1e-12 <= tolerance <= 1e-2:
        raise ValueError(f"tolerance = {tolerance!r}: allowed are 1e-12 to 1e-2")
    if wrinkling not in ("plain", "tension_field"):
        raise ValueError(f'wrinkling = {wrinkling!r}: allowed are "plain" and "tension_field"')


def _solve(
    inputs: _Inputs, tolerance: float, wrinkling: Wrinkling, sensitivities: bool, keep: bool = False
) -> tuple[Solutions, list[tuple[NDArray[np.intp], Solved]]]:
    """The solutions, and with ``keep`` the states themselves."""
    _check(tolerance, wrinkling)
    solved = None
    if not keep:
        states = inputs.specimens, inputs.which, inputs.h, inputs.voltage
        relaxed = wrinkling == "tension_field"
        solved = compiled.solve_states(*states, tolerance=tolerance, relaxed=relaxed, sensitivities=sensitivities)
    if solved is None:
        materials = [specimen.material for specimen in inputs.specimens]
        result, count = Flat.blank(len(inputs.h), materials, sensitivities, keep), Evaluations()
        wanted = np.ones(len(inputs.h), dtype=np.bool_)
    else:
        result, count, wanted = solved
    if wanted.any():
        with np.errstate(all="ignore"):
            for index in inputs.blocks(wanted):
                _Block(inputs, index, count).solve(result, tolerance, wrinkling, sensitivities)
    return result.solutions(inputs.shape, count), result.kept


def solve(
    specimen: Specimen,
    h: float,
    voltage: float = 0.0,
    *,
    tolerance: float = 1e-8,
    wrinkling: Wrinkling = "plain",
    sensitivities: bool = False,
) -> Solution:
    """Solve one state: `solve_many` for scalars, with the profiles at hand."""
    _check(tolerance, wrinkling)
    h, voltage, relaxed = float(h), float(voltage), wrinkling == "tension_field"
    one = compiled.solve_one(specimen, h, voltage, tolerance=tolerance, relaxed=relaxed, sensitivities=sensitivities)
    if one is not None:
        solution = object.__new__(Solution)  # attribute after attribute takes half as long as the kernel
        object.__setattr__(solution, "__dict__", one.attributes(specimen, h, voltage, sensitivities))
        return solution
    inputs = _Inputs.gather(specimen, h, voltage)
    many, kept = _solve(inputs, tolerance, wrinkling, sensitivities, keep=True)
    return Solution(
        specimen=specimen,
        h=h,
        voltage=voltage,
        force=float(many.force),
        peak_field=float(many.peak_field),
        peak_field_radius=float(many.peak_field_radius),
        min_hoop_stress=float(many.min_hoop_stress),
        min_meridional_stress=float(many.min_meridional_stress),
        max_stretch=float(many.max_stretch),
        status=Status(int(many.status)),
        error_estimate=float(many.error_estimate),
        iterations=int(many.iterations),
        modes=int(many.modes),
        stable=bool(many.stable),
        field_exceeded=bool(many.field_exceeded),
        stretch_exceeded=bool(many.stretch_exceeded),
        dforce=None
        if many.dforce is None
        else {k: v if k in ("mu", "alpha") else float(v) for k, v in many.dforce.items()},
        evaluations=many.evaluations,
        kept=kept[0][1] if kept else None,
    )


def hangs_slack(specimen: Specimen, h: float, voltage: float) -> bool:
    """Whether no tension can hold the film, at once and without a solution: for those who must not wait.

    Sufficient, not necessary: the film, stretched like a straight cone both ways, would push outwards.
    """
    if not (math.isfinite(h) and math.isfinite(voltage)) or voltage == 0.0:
        return False
    found = compiled.hangs_slack(specimen, h, voltage)
    if found is not None:
        return found
    return bool(_Block(_Inputs.gather(specimen, h, voltage), np.zeros(1, np.intp), Evaluations()).slack()[0])


class _Block:
    """Some of the states, in dimensionless form, and the way back to SI."""

    def __init__(self, inputs: _Inputs, index: NDArray[np.intp], count: Evaluations) -> None:
        self.index = index
        self.h, self.voltage = inputs.h[index], inputs.voltage[index]
        used, pick = np.unique(inputs.which[index], return_inverse=True)
        films = [inputs.specimens[i] for i in used.tolist()]
        materials = [s.material for s in films]
        self.moduli, self.shapes = np.array([(len(m.mu), len(m.alpha)) for m in materials], dtype=np.intp)[pick].T
        numbers = np.array(
            [
                (
                    s.disk_radius,
                    s.ring_radius,
                    s.thickness,
                    s.prestretch,
                    m.shear_modulus,
                    m.eps_r,
                    m.breakdown_field or math.inf,
                    m.max_stretch or math.inf,
                )
                for s, m in zip(films, materials, strict=True)
            ]
        ).reshape(len(films), 8)[pick]
        self.a, self.b, self.t, self.lp, self.shear, self.eps_r, self.strength, self.elongation = numbers.T
        mu = _padded([m.mu for m in materials], 0.0)
        alpha = _padded([m.alpha for m in materials], 1.0)
        if len(films) > 1:
            mu, alpha = mu[:, pick], alpha[:, pick]
        charged = bool(np.any(self.voltage))
        film = Film(
            law=materials[0].law(mu / (self.shear if len(films) > 1 else self.shear[:1]), alpha),
            field=EPSILON_0 * self.eps_r * (self.voltage / self.t) ** 2 / self.shear if charged else None,
            count=count,
        )
        # The flat film is the limit of a vanishing height: solve there, then give zero force.
        height = np.where(self.h == 0.0, 1e-9, np.abs(self.h) / self.b)
        self.problem = Problem(film, np.log(self.lp), np.log(self.b / self.a), height)

    def solve(self, result: Flat, tolerance: float, wrinkling: Wrinkling, sensitivities: bool) -> None:
        """Solve the block and write what comes out."""
        index, problem = np.arange(len(self.index)), self.problem
        if problem.span.max() > WIDEST:
            result.status[self.index] = Status.NOT_CONVERGED
            return
        relaxed = wrinkling == "tension_field"
        if problem.film.field is not None:
            slack = self.slack()
            # The plain equations may still have a state with compression around and tension along the film.
            result.status[self.index[slack]] = Status.SLACK
            if slack.any() and relaxed:
                index = np.flatnonzero(~slack)
                if len(index) == 0:
                    return
                problem = problem.take(index)
        breaks = problem.cut()
        folded: list[tuple[NDArray[np.intp], Start]] = []
        answers: list[Answer] = []
        steps = np.zeros(len(index), dtype=np.intp)
        missed = []
        kind, modes = groups(problem.span / (len(breaks) - 1), tolerance)
        for one in np.unique(kind).tolist():
            some = np.flatnonzero(kind == one)
            part = problem if len(some) == len(index) else problem.take(some)
            grid = Grid.lay(modes[one], breaks[:, some])
            start, first = Start(grid, ritz.guess(part, grid)), len(folded)
            found, left, spent = refine(
                part, tolerance, start, sensitivities=sensitivities, folded=folded if relaxed else None
            )
            steps[some] += spent
            missed.append(some[left])
            folded[first:] = [(some[index], begin) for index, begin in folded[first:]]
            for answer in found:
                answer.index = some[answer.index]
            answers += found
        lost = np.concatenate(missed)
        doubtful = [] if relaxed else [lost]
        none = [np.zeros(len(answer.index), dtype=np.bool_) for answer in answers]
        folds = [x.hoop < ROUND_OFF_TENSION * x.meridional for x in (a.extremes for a in answers)] if relaxed else none
        for answer, wrinkled, soft in zip(answers, folds, self.doubtful(index, answers, folds), strict=True):
            doubtful.append(answer.index[soft & ~wrinkled])
            if wrinkled.any():
                folded.append((answer.index[wrinkled], Start(answer.grid, answer.state).take(wrinkled)))
            self.place(result, index, answer, ~(soft | wrinkled))
        if relaxed:

            def relax(some: NDArray[np.intp], begin: Start | None) -> NDArray[np.intp]:
                answers, lost, spent = tension_field.solve(
                    problem.take(some), tolerance, sensitivities=sensitivities, begin=begin
                )
                steps[some] += spent
                for answer in answers:
                    answer.index = some[answer.index]
                none = [np.zeros(len(answer.index), dtype=np.bool_) for answer in answers]
                for answer, soft in zip(answers, self.doubtful(index, answers, none), strict=True):
                    doubtful.append(answer.index[soft])
                    self.place(result, index, answer, ~soft)
                return some[lost]

            # Folds begin where the plain equations put them; what this does not settle begins with a search.
            some = np.concatenate([lost, *(relax(*begun) for begun in folded)])
            doubtful.append(relax(some, None) if len(some) else some)
        some = np.concatenate(doubtful)
        if len(some):
            self.follow(result, index, problem, some, steps, tolerance, relaxed, sensitivities)
        result.whole["iterations"][self.index[index]] = steps

    def doubtful(
        self,
        index: NDArray[np.intp],
        answers: list[Answer],
        others: list[NDArray[np.bool_]],
    ) -> list[NDArray[np.bool_]]:
        """Which answers may not be on the branch from rest; ``others`` are not asked about."""
        soft: list[NDArray[np.bool_]] = []
        taut: list[tuple[NDArray[np.bool_], NDArray[np.intp], Answer]] = []
        for answer, other in zip(answers, others, strict=True):
            x = answer.extremes
            these = ~((x.softening <= SOFTENING) & (x.meridional > 0.0))
            soft.append(these)
            asked = np.flatnonzero(these & (x.meridional > 0.0) & ~other)
            if len(asked) and answer.state.relaxed is None:  # soft wrinkled ones are followed, every one
                taut.append((these, asked, answer.take(asked)))
        if taut:
            end = Start.join([prolonged(Start(part.grid, part.state), from_rest.CHECK_MODES) for _, _, part in taut])
            which = np.concatenate([part.index for _, _, part in taut])
            lam = np.concatenate([part.lam for _, _, part in taut])
            good = from_rest.connected(self.problem.take(index[which]), end, lam)
            for these, asked, _ in taut:
                these[asked] = ~good[: len(asked)]
                good = good[len(asked) :]
        return soft

    def follow(
        self,
        result: Flat,
        index: NDArray[np.intp],
        problem: Problem,
        some: NDArray[np.intp],
        steps: NDArray[np.intp],
        tolerance: float,
        relaxed: bool,
        sensitivities: bool,
    ) -> None:
        """Solve states for which a cold start may have missed, or jumped from, the branch that starts at rest."""
        to = self.index[index[some]]
        slack = result.status[to] == Status.SLACK
        answers, ended = from_rest.solve(
            problem.take(some), tolerance, slack, relaxed=relaxed, sensitivities=sensitivities
        )
        steps[some] += ended.steps
        failed = np.where(ended.unstable, Status.UNSTABLE, Status.NOT_CONVERGED)
        result.status[to] = np.where(slack, Status.SLACK, failed)
        for answer in answers:
            answer.index = some[answer.index]
            self.place(result, index, answer, answer.extremes.meridional > 0.0)

    def slack(self) -> NDArray[np.bool_]:
        """Where the film, stretched like a straight cone, would push outwards: no tension can hold it."""
        p = self.problem
        cone = p.height / -np.expm1(-p.span)
        log = p.log_prestretch + 0.5 * np.log1p(cone * cone)
        tension: Array = stress(p.film, stack(log, log)).t1
        return tension < 0.0

    def place(self, result: Flat, index: NDArray[np.intp], answer: Answer, these: NDArray[np.bool_]) -> None:
        """Write ``these`` of an answer's states in SI units; ``index``: the answer's numbers to the block's."""
        if not these.all():
            if not these.any():
                return
            answer = answer.take(these)
        where = index[answer.index]
        to = self.index[where]
        if result.keep:
            result.kept.append((to, (self.problem.take(where), answer.grid, answer.state, answer.lam)))
        h, v, t, shear, lp, b = (x[where] for x in (self.h, self.voltage, self.t, self.shear, self.lp, self.b))
        sign = np.sign(h)
        scale = 2.0 * np.pi * b * t * shear / lp**2
        force = scale * answer.lam * sign
        x = answer.extremes
        result.real["force"][to] = force
        result.real["peak_field"][to] = np.abs(v) / t * np.exp(x.log_area)
        result.real["peak_field_radius"][to] = x.radius * b
        result.real["min_hoop_stress"][to] = shear * x.hoop
        result.real["min_meridional_stress"][to] = shear * x.meridional
        result.real["max_stretch"][to] = np.exp(x.log_stretch)
        result.real["error_estimate"][to] = answer.error
        result.whole["modes"][to] = answer.grid.table.modes
        result.flag["stable"][to] = True
        result.flag["field_exceeded"][to] = result.real["peak_field"][to] > self.strength[where]
        result.flag["stretch_exceeded"][to] = result.real["max_stretch"][to] > self.elongation[where]
        folded = x.hoop < ROUND_OFF_TENSION * x.meridional
        if answer.state.relaxed is not None:
            folded |= answer.state.relaxed.any(axis=(0, 1))
        result.status[to] = np.where(folded, Status.WRINKLED, Status.TAUT)
        d = answer.derivatives
        if d is None or result.dforce is None:
            return
        f = result.dforce
        scale = scale * sign
        slope = 2.0 * np.pi * t * shear / lp**2 * d.height
        f["h"][to] = slope
        f["prestretch"][to] = (scale * d.log_prestretch - 2.0 * force) / lp
        f["eps_r"][to] = scale * d.log_field / self.eps_r[where]
        f["voltage"][to] = np.where(v != 0.0, 2.0 * scale * d.log_field / np.where(v != 0.0, v, 1.0), 0.0)
        f["thickness"][to] = (force - 2.0 * scale * d.log_field) / t
        f["disk_radius"][to] = -scale * d.span / self.a[where]
        f["ring_radius"][to] = (force - h * slope + scale * d.span) / b
        for name, values, given in (("mu", scale / shear * d.mu, self.moduli), ("alpha", scale * d.alpha, self.shapes)):
            absent = np.arange(len(values))[:, None] >= given[where]
            f[name][to, : len(values)] = np.where(absent, np.nan, values).T
