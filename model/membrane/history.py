r"""Films that take time: force of a film with viscous branches along a history of displacement and voltage.

Maxwell branches stand in parallel with the relaxed film (Reese & Govindjee 1998, in logarithmic principal strains).
Branch k has the share ``ratio`` of the relaxed film's law and the relaxation time ``tau``; of the logarithmic stretches
``u_i = ln l_i`` a part ``v_i`` is viscous, and only the rest ``x = u - v`` makes stress:

.. math:: \sigma_i = S_i(u) + \sum_k \beta_k S_i(x^k) - \varepsilon E^2, \qquad
          \dot v_i^k = \frac{1}{2 G \tau_k} \left(S_i - \tfrac{1}{3} (S_1 + S_2)\right)(x^k)

At the start the film is rested in its flat pre-stretched state: ``v = ln lp`` everywhere. At every instant the membrane
is in equilibrium (`model.membrane.viscous`); steps of time are those of `model.membrane.march`. Where many answers are
wanted within a step, they are polynomials through a few solved ones.

Derivatives come from the same factored matrices: those of the viscous strains are carried from step to step, with the
steps' lengths held.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import Array
from model.material.materials import Branch
from model.membrane import refinement, ritz
from model.membrane.march import Course, How, Step, Trail, flat_guess, march
from model.membrane.output import fine_table
from model.membrane.refinement import ROUND_OFF_TENSION
from model.membrane.solve import Status, Wrinkling, solve_many
from model.membrane.viscous import Balance, balance, slopes
from model.membrane.viscous_films import Films, Instant, PushLaw, unpack
from model.specimen import Specimen

MORE_MODES = 2  # than an elastic film of the same tolerance: the viscous strain is a field of its own
FEW = 5  # answers within a step that are solved each; of more, so many are solved at first
MOST_NODES = 65
LEAST_SCALE = 1e-12  # dimensionless force or height over which errors are meant where there is none
CHUNK = 256  # states that are solved at once
LEAST_SHARE = 0.05  # of the tolerance: no less is stated of an error, for between steps it is not that of their ends
PEAK, HOOP, MERIDIONAL, FOLDED, ROWS = 1, 2, 3, 4, 5  # rows of an answer, after the force; how many before derivatives
FOLDED_PIECES = (3, 6)  # times as many elements for folded films, for an answer to judge the other by and for it


@dataclass(frozen=True)
class History:
    """Answers along a history, (times,) each; NaN where ``status`` is neither TAUT nor WRINKLED.

    Attributes
    ----------
    force : F (N), positive when it pushes the disk to positive h
    h : displacement of the disk (m)
    peak_field : largest true field (V/m)
    min_hoop_stress, min_meridional_stress : smallest true stresses (Pa)
    status : `model.membrane.solve.Status` numbers
    error_estimate : estimated error of the force over the largest force of the history; of a free disk that of its
        displacement over the largest
    steps, rejected : steps of time taken, and tried in vain
    dforce : derivatives of the force by "mu" (times, moduli), "alpha" (times, shape parameters), "eps_r" (times,),
        "ratio", "time" (times, branches), "thickness", "prestretch", and "h", a shift of the whole history of
        displacement; None unless asked for
    dh : of a free disk in its place the derivatives of the displacement, "load" (m over the load's relative change) in
        place of "h"
    """

    force: Array
    h: Array
    peak_field: Array
    min_hoop_stress: Array
    min_meridional_stress: Array
    status: NDArray[np.int8]
    error_estimate: Array
    steps: int
    rejected: int
    dforce: dict[str, Array] | None = None
    dh: dict[str, Array] | None = None


def solve_history(
    specimen: Specimen,
    t: ArrayLike,
    h: ArrayLike,
    voltage: ArrayLike = 0.0,
    times: ArrayLike | None = None,
    *,
    tolerance: float = 1e-6,
    sensitivities: bool = False,
    wrinkling: Wrinkling = "plain",
) -> History:
    """Force along a history, from a film rested flat in its pre-stretched state at ``t[0]``.

    Parameters
    ----------
    specimen : the film; its material has the branches
    t : times (s) at which the history bends, rising
    h, voltage : displacement of the disk (m) and voltage (V) there, linear in between
    times : where the answer is wanted, within ``t``; at ``t`` itself when not given
    tolerance : error of the force to aim for, over the largest force of the history: 1e-10 to 1e-2
    sensitivities : also give ``dforce``, for about twice the cost; their error is some tolerances, relative
    wrinkling : "plain": the plain equations even where the hoop stress is negative; "tension_field": the relaxed
        energy, of which the natural width makes all stress, that of the branches too. Both say WRINKLED there

    Returns
    -------
    History at ``times``, in their order. Where the film has no state any more, a status and NaN from there on.

    Raises
    ------
    ValueError : the history is no history, or times lie outside it
    """
    found = solve_histories(
        [specimen], [(t, h, voltage, times)], tolerance=tolerance, sensitivities=sensitivities, wrinkling=wrinkling
    )
    return found[0]


def solve_histories(
    specimens: Sequence[Specimen],
    histories: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike | None]],
    *,
    tolerance: float = 1e-6,
    sensitivities: bool = False,
    wrinkling: Wrinkling = "plain",
    push: PushLaw | None = None,
) -> list[History]:
    """`solve_history` of many films at once: each takes its own steps, for a fraction of the cost apart.

    Parameters
    ----------
    specimens : the films, one a history
    histories : ``(t, h, voltage, times)`` of each, as in `solve_history`
    tolerance, sensitivities, wrinkling : as in `solve_history`
    push : the loads of disks that are free to move, force (N) and slope (N/m) by the film's number and h (m), not
        negative; ``h`` of the histories is then the share of it, 0 or more (`model.actuator.creep`)

    Returns
    -------
    A `History` each. Company changes the forces by less than the tolerance.

    Raises
    ------
    ValueError : a history is none
    """
    if len(specimens) != len(histories):
        raise ValueError(f"{len(specimens)} specimens and {len(histories)} histories; give one history a specimen")
    checked = [_checked(*one, tolerance) for one in histories]
    if not sensitivities:
        specimens = [_bare(one) for one in specimens]
    how = How(tolerance, sensitivities, push, wrinkling == "tension_field")
    courses, times = [course for course, _ in checked], [asked for _, asked in checked]
    with np.errstate(all="ignore"):
        largest = _elastic(specimens, courses) if push is None else np.zeros(len(specimens))
        company = _Company(specimens, courses, times, largest, how)
        for modes, pieces, mine in _alike(specimens, tolerance):
            answers, folded = company.solve(mine, modes, pieces)
            for k, answer in zip(mine, answers, strict=True):
                company.answers[k] = answer
            if folded:
                for k, answer in zip(folded, company.solve_folded(folded, modes, pieces), strict=True):
                    company.answers[k] = answer
    return [company.history(k) for k in range(len(specimens))]


class _Company:
    """Histories that are solved together, by their numbers."""

    def __init__(
        self,
        specimens: Sequence[Specimen],
        courses: Sequence[Course],
        times: Sequence[Array],
        largest: Array,
        how: How,
    ) -> None:
        self.specimens, self.courses, self.times, self.largest, self.how = specimens, courses, times, largest, how
        self.answers: dict[int, _Answer] = {}

    def history(self, k: int) -> History:
        """The answers of history ``k`` with their units."""
        how, push = self.how, self.how.push
        if push is not None:
            how = replace(how, push=lambda which, h: push(np.full_like(which, k), h))
        return self.answers[k].history(self.specimens[k], self.courses[k], self.times[k], how)

    def solve(self, mine: Sequence[int], modes: int, pieces: int) -> tuple[list[_Answer], list[int]]:
        """Answers of ``mine``, and those that were folded at some time."""
        films = Films.of([self.specimens[k] for k in mine], modes, pieces)
        courses, times = [self.courses[k] for k in mine], [self.times[k] for k in mine]
        scale = np.where(self.largest[mine] > 0.0, self.largest[mine] / films.unit, LEAST_SCALE)
        how, push, numbers = self.how, self.how.push, np.array(mine)
        if push is not None:
            how = replace(how, push=lambda which, h: push(numbers[which], h))
        trail = march(films, courses, scale, how)
        answers = [_Answer.empty(len(one), films.columns if how.sensitivities else 0) for one in times]
        unit = films.unit if push is None else films.ring
        for place, answer in enumerate(answers):
            answer.scale = float(trail.scale[place] * unit[place])
            answer.steps = int(trail.taken[place]), int(trail.rejected[place])
            answer.lost = trail.lost.get(place)
        _Reader(films, courses, trail, times, answers, how).read()
        return answers, [k for k, folded in zip(mine, trail.folded.tolist(), strict=True) if folded]

    def solve_folded(self, mine: Sequence[int], modes: int, pieces: int) -> list[_Answer]:
        """Answers of folded films, with many elements as their edges are anywhere in them: those of the finer ones.

        They err by less than they differ from those of fewer elements.
        """
        (coarse, _), (fine, _) = (self.solve(mine, modes, pieces * many) for many in FOLDED_PIECES)
        for rough, answer, k in zip(coarse, fine, mine, strict=True):
            unit = self.specimens[k].ring_radius if self.how.push is not None else _unit(self.specimens[k])
            off = np.abs(rough.rows[0] - answer.rows[0]) * unit / answer.scale
            largest = float(np.nanmax(off, initial=0.0))
            answer.error += np.where(np.isfinite(off), np.maximum(off, 0.3 * largest), largest)
        return fine


AT_ONCE_PARTS = (1, 8)  # of the way from the flat film to a state, all at once or in so many


def at_once(specimen: Specimen, h: ArrayLike, voltage: ArrayLike = 0.0, *, tolerance: float = 1e-6) -> Array:
    """Force (N) of a rested film that is pushed in no time, at arrays of displacement (m) and voltage (V).

    Its branches have not begun to relax, and answer like films without pre-stretch: the largest force that the film can
    have there after any way from rest that only pushes. NaN where it has no state.
    """
    h, voltage = np.broadcast_arrays(np.asarray(h, dtype=float), np.asarray(voltage, dtype=float))
    [(modes, _, _)] = _alike([_bare(specimen)], tolerance)
    force = np.full(h.size, np.nan)
    with np.errstate(all="ignore"):
        for parts in AT_ONCE_PARTS:
            left = np.flatnonzero(np.isnan(force))
            if not len(left):
                break
            films = Films.of([_bare(specimen)], modes).take(np.zeros(len(left), dtype=np.intp))
            rest = films.log_prestretch * np.ones((2, films.branches, *films.grid.radius.shape))
            height, volts, state = h.ravel()[left] / parts, voltage.ravel()[left] / parts, None
            for part in range(1, parts + 1):
                instant = Instant(part * height, part * volts)
                state = flat_guess(films, instant) if state is None else state
                at = balance(films, instant, rest, np.zeros_like(films.time), state, How(tolerance).goal)
                state = at.state
            force[left] = np.where(at.ok, instant.side * films.unit * at.lam, np.nan)
    return np.where(h == 0.0, 0.0 * force.reshape(h.shape), force.reshape(h.shape))


def _checked(
    t: ArrayLike, h: ArrayLike, voltage: ArrayLike, times: ArrayLike | None, tolerance: float
) -> tuple[Course, Array]:
    t = np.atleast_1d(np.asarray(t, dtype=float))
    if t.ndim != 1 or len(t) < 2:
        raise ValueError("t: a history needs at least two times")
    if not (np.isfinite(t).all() and (np.diff(t) >= 0.0).all()):
        raise ValueError("t: the times of a history must be finite and rise")
    values = []
    for name, given in (("h", h), ("voltage", voltage)):
        value = np.asarray(given, dtype=float)
        if value.shape not in ((), t.shape):
            raise ValueError(f"{name} has {value.size} values, t has {t.size}; give one a time")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} holds a value that is not finite")
        values.append(np.broadcast_to(value, t.shape).copy())
    again = np.flatnonzero(np.diff(t) == 0.0)
    if any((value[again] != value[again + 1]).any() for value in values) or len(again) == len(t) - 1:
        raise ValueError(f"t: the times of a history must rise; a jump at {t[again[0]]:g} s needs a time of its own")
    asked = t if times is None else np.atleast_1d(np.asarray(times, dtype=float))
    if not (np.isfinite(asked).all() and (asked >= t[0]).all() and (asked <= t[-1]).all()):
        raise ValueError(f"times must be finite and within the history, {t[0]:g} to {t[-1]:g} s")
    if not 1e-10 <= tolerance <= 1e-2:
        raise ValueError(f"tolerance = {tolerance!r}: allowed are 1e-10 to 1e-2")
    rising = np.concatenate((np.diff(t) > 0.0, [True]))  # a hold of no length is none
    return Course(t[rising], *(value[rising] for value in values)), asked


def _bare(specimen: Specimen) -> Specimen:
    """The film without branches that are none."""
    branches: tuple[Branch, ...] = tuple(one for one in specimen.material.branches if one.ratio > 0.0)
    if len(branches) == len(specimen.material.branches):
        return specimen
    return specimen.with_material(replace(specimen.material, branches=branches))


def _elastic(specimens: Sequence[Specimen], courses: Sequence[Course]) -> Array:
    """Largest force (N) of each relaxed film where its course bends."""
    films = np.empty(sum(len(one.t) for one in courses), dtype=np.object_)
    films[:] = [specimen for specimen, one in zip(specimens, courses, strict=True) for _ in one.t]
    h, voltage = (np.concatenate([getattr(one, name) for one in courses]) for name in ("h", "voltage"))
    force = np.abs(solve_many(films, h, voltage, tolerance=1e-4).force)
    ends = np.cumsum([len(one.t) for one in courses])[:-1]
    return np.array([float(np.nanmax(one, initial=0.0)) for one in np.split(force, ends)])


def _unit(specimen: Specimen) -> float:
    """N of the dimensionless force."""
    shear = specimen.material.shear_modulus
    return 2.0 * np.pi * specimen.ring_radius * specimen.thickness * shear / specimen.prestretch**2


def _alike(specimens: Sequence[Specimen], tolerance: float) -> list[tuple[int, int, list[int]]]:
    """Films that can be solved together: the modes and elements that they take, and their numbers."""
    found: dict[tuple[object, ...], list[int]] = {}
    for k, one in enumerate(specimens):
        material = one.material
        span = np.log(one.ring_radius / one.disk_radius)
        pieces = ritz.elements(np.array([span]))
        modes = refinement.first_modes(span / pieces, tolerance) + MORE_MODES
        kind = (material.law, len(material.mu), len(material.alpha), len(material.branches), pieces, modes)
        found.setdefault(kind, []).append(k)
    return [(kind[-1], kind[-2], mine) for kind, mine in found.items()]  # type: ignore[misc]


@dataclass(slots=True)
class _Answer:
    """The answers of one history while they are being filled.

    rows : dimensionless force, or height of a free disk, largest field over that of the flat film's unit, least hoop
        and meridional stress, whether it is folded, and the derivatives of the first, (ROWS + P, times)
    lost : the time after which there is no state, and why
    """

    rows: Array
    error: Array
    status: NDArray[np.int8]
    scale: float = 1.0
    steps: tuple[int, int] = (0, 0)
    lost: tuple[float, Status] | None = None

    @classmethod
    def empty(cls, count: int, columns: int) -> _Answer:
        status = np.full(count, Status.NOT_CONVERGED, dtype=np.int8)
        return cls(np.full((ROWS + columns, count), np.nan), np.full(count, np.nan), status)

    def fill(self, asked: NDArray[np.intp], rows: Array, error: Array | float) -> None:
        """Take over solved answers."""
        self.rows[:, asked] = rows
        self.error[asked] = error
        wrinkled = (rows[HOOP] < ROUND_OFF_TENSION * rows[MERIDIONAL]) | (rows[FOLDED] > 0.5)
        status = np.where(wrinkled, Status.WRINKLED, Status.TAUT)
        self.status[asked] = np.where(np.isfinite(rows[0]), status, Status.NOT_CONVERGED)

    def history(self, specimen: Specimen, course: Course, times: Array, how: How) -> History:
        """Everything with its units, the error over the largest answer of the history."""
        if self.lost is not None:
            self.status[times > self.lost[0]] = self.lost[1]
        answered = self.status <= Status.WRINKLED
        shear, unit = specimen.material.shear_modulus, _unit(specimen)
        h, volts = np.interp(times, course.t, course.h), np.interp(times, course.t, course.voltage)
        rows = np.where(answered, self.rows, np.nan)
        dforce = dh = None
        if how.push is None:
            side = np.where(h < 0.0, -1.0, 1.0)
            force = np.where(answered & (h == 0.0), 0.0, side * unit * rows[0])
            if how.sensitivities:
                dforce = _with_units(specimen, force, side * unit * rows[ROWS:])
        else:
            number, share = np.zeros(len(times), dtype=np.intp), h
            h = np.where(answered & (share == 0.0), 0.0, specimen.ring_radius * rows[0])
            force = np.where(answered, share * how.push(number, h)[0], np.nan)
            if how.sensitivities:
                dh = _with_units_free(specimen, specimen.ring_radius * rows[ROWS:])
        largest = max(float(np.nanmax(np.abs(force if how.push is None else h), initial=0.0)), self.scale)
        return History(
            force=force,
            h=h,
            peak_field=np.abs(volts) / specimen.thickness * np.exp(rows[PEAK]),
            min_hoop_stress=shear * rows[HOOP],
            min_meridional_stress=shear * rows[MERIDIONAL],
            status=self.status,
            error_estimate=np.where(answered, self.error * self.scale / largest + LEAST_SHARE * how.tolerance, np.nan),
            steps=self.steps[0],
            rejected=self.steps[1],
            dforce=dforce,
            dh=dh,
        )


def _columns(specimen: Specimen, rows: Array) -> tuple[dict[str, Array], Array, Array, Array]:
    """Rows of `Films.columns` by the parameter's name and over its unit; those of ln(field), ln(lp) and the last."""
    material, n, k = specimen.material, len(specimen.material.mu), len(specimen.material.branches)
    shapes = len(material.alpha)
    mu, alpha, field, ratio, time, prestretch, last = np.split(rows, np.cumsum([n, shapes, 1, k, k, 1]))
    named = {
        "mu": mu.T / material.shear_modulus,
        "alpha": alpha.T,
        "eps_r": field[0] / material.eps_r,
        "ratio": ratio.T,
        "time": time.T / np.array([one.time for one in material.branches]),
    }
    return named, field[0], prestretch[0], last[0]


def _with_units(specimen: Specimen, force: Array, rows: Array) -> dict[str, Array]:
    """Derivatives of the force (N over the parameter's unit) from those of the columns in `Films.columns`, in N."""
    named, field, prestretch, height = _columns(specimen, rows)
    return named | {
        "thickness": (force - 2.0 * field) / specimen.thickness,
        "prestretch": (prestretch - 2.0 * force) / specimen.prestretch,
        "h": height,
    }


def _with_units_free(specimen: Specimen, rows: Array) -> dict[str, Array]:
    """The same of a free disk's displacement (m): a film of more force moves like one under less load."""
    named, field, prestretch, load = _columns(specimen, rows)
    return named | {
        "thickness": (-load - 2.0 * field) / specimen.thickness,
        "prestretch": (prestretch + 2.0 * load) / specimen.prestretch,
        "load": load,
    }


@dataclass(slots=True)
class _Job:
    """States to solve within one step of a film: shares ``x`` of the step, for the answers ``asked``."""

    film: int
    step: Step
    column: int
    x: Array
    asked: NDArray[np.intp]
    x_asked: Array


class _Reader:
    """Reads the answers from the steps of a march."""

    def __init__(
        self,
        films: Films,
        courses: Sequence[Course],
        trail: Trail,
        times: Sequence[Array],
        answers: Sequence[_Answer],
        how: How,
    ) -> None:
        self.films, self.courses, self.trail, self.times = films, courses, trail, times
        self.answers, self.how = answers, how

    def read(self) -> None:
        """Fill every answer."""
        nodes = FEW
        jobs = self._jobs()
        while jobs:
            again = []
            for job, rows, ok in self._solved(jobs):
                answer, error = self.answers[job.film], float(job.step.error[job.column])
                if job.x is job.x_asked:
                    answer.fill(job.asked, np.where(ok, rows, np.nan), error)
                elif not ok.all():
                    again.append(replace(job, x=job.x_asked))
                else:
                    found, missed = _between(rows, job.x_asked)
                    if missed > self.how.tolerance * self.trail.scale[job.film] and nodes < MOST_NODES:
                        again.append(replace(job, x=_lobatto(2 * nodes - 1)))
                    else:
                        answer.fill(job.asked, found, error + missed / self.trail.scale[job.film])
            jobs, nodes = again, 2 * nodes - 1

    def _jobs(self) -> list[_Job]:
        """Every step that has answers in it."""
        taken: list[list[tuple[Step, int]]] = [[] for _ in self.answers]
        for step in self.trail.steps:
            for column in np.flatnonzero(step.ok).tolist():
                taken[int(step.which[column])].append((step, column))
        jobs = []
        for film, (mine, times) in enumerate(zip(taken, self.times, strict=True)):
            start = self.courses[film].t[0]
            at_start = np.flatnonzero(times == start)
            if len(at_start) and self.trail.lost.get(film, (start, 0))[0] >= start:
                x = np.zeros(len(at_start))
                jobs.append(_Job(film, self.trail.begin, film, x, at_start, x))
            ends = np.array([float(step.begin[c] + step.dt[c]) for step, c in mine])
            if len(ends) and film not in self.trail.lost:
                ends[-1] = self.courses[film].t[-1]
            place = np.searchsorted(ends, times)
            place[times == start] = len(ends)
            order = np.argsort(place, kind="stable")
            bounds = np.searchsorted(place[order], np.arange(len(ends) + 1))
            for k, (step, column) in enumerate(mine):
                asked = order[bounds[k] : bounds[k + 1]]
                if len(asked):
                    x = (times[asked] - step.begin[column]) / step.dt[column]
                    jobs.append(_Job(film, step, column, x if len(x) <= FEW else _lobatto(FEW), asked, x))
        return jobs

    def _solved(self, jobs: Sequence[_Job]) -> Iterator[tuple[_Job, Array, NDArray[np.bool_]]]:
        """Rows of an answer (ROWS + P, nodes) of every job, and where there is one."""
        some: list[_Job] = []
        size = 0
        for k, job in enumerate(jobs):
            some.append(job)
            size += len(job.x)
            if size >= CHUNK or k + 1 == len(jobs):
                rows, ok = self._states(some)
                cuts = np.cumsum([len(one.x) for one in some])[:-1]
                yield from zip(some, np.split(rows, cuts, axis=1), np.split(ok, cuts), strict=True)
                some, size = [], 0

    def _states(self, jobs: Sequence[_Job]) -> tuple[Array, NDArray[np.bool_]]:
        count = [len(job.x) for job in jobs]
        films = self.films.take(np.repeat([job.film for job in jobs], count))
        x = np.concatenate([job.x for job in jobs])

        def gather(name: str, end: str) -> Array:
            values = [getattr(getattr(job.step, end), name)[..., job.column] for job in jobs]
            found: Array = np.repeat(np.stack(values, axis=-1), count, axis=-1)
            return found

        dt = np.repeat([job.step.dt[job.column] for job in jobs], count)
        t = np.repeat([job.step.begin[job.column] for job in jobs], count) + x * dt
        owner = np.repeat(np.arange(len(jobs)), count)
        h, voltage = np.empty((2, len(x)))
        for k, job in enumerate(jobs):
            course = self.courses[job.film]
            h[owner == k] = np.interp(t[owner == k], course.t, course.h)
            voltage[owner == k] = np.interp(t[owner == k], course.t, course.voltage)
        instant = self.how.instant(np.repeat([job.film for job in jobs], count), h, voltage)
        viscous = _hermite(x, dt, *(gather(name, end) for end in ("before", "after") for name in ("viscous", "rate")))
        p0, p1 = gather("packed", "before"), gather("packed", "after")
        middle = np.repeat(np.stack([job.step.middle[..., job.column] for job in jobs], axis=-1), count, axis=-1)
        packed = p0 + x * (p1 - p0 + 2.0 * (1.0 - x) * (2.0 * middle - p0 - p1))
        state = unpack(films, instant, packed)
        state.w = np.where(state.w > 0.0, state.w, unpack(films, instant, p1).w)
        at = balance(films, instant, viscous, np.zeros_like(films.time), state, self.how.goal)
        rows = _outputs(at, films)
        if jobs[0].step.before.viscous_slopes is not None:
            names = ("viscous_slopes", "rate_slopes")
            start = _hermite(x, dt, *(gather(name, end) for end in ("before", "after") for name in names))
            rows += list(slopes(at, instant, start).answer)
        return np.array(rows), at.ok


def _outputs(at: Balance, films: Films) -> list[Array]:
    """The first rows of an answer; between the points where nothing is folded, as then they are smooth."""
    folded = at.folded
    fine = fine_table(films.grid.table.modes)

    def largest(values: Array) -> Array:
        most: Array = np.tensordot(fine, values, 1).max(axis=(0, 1))
        return np.where(folded, values.max(axis=(0, 1)), most)

    law = at.points.law
    return [at.answer, largest(-at.points.log[2]), -largest(-law.t2), -largest(-law.t1), folded.astype(float)]


def _hermite(x: Array, dt: Array, first: Array, first_rate: Array, last: Array, last_rate: Array) -> Array:
    """The cubic through both ends of a step and their rates, at the shares ``x`` of it.

    Its error is of the order of the step's own estimate.
    """
    found = first + x * x * (3.0 - 2.0 * x) * (last - first)
    found += dt * x * (1.0 - x) * ((1.0 - x) * first_rate - x * last_rate)
    return found


@lru_cache(maxsize=16)
def _lobatto(count: int) -> Array:
    """Chebyshev's points on [0, 1], ends included."""
    nodes: Array = 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / (count - 1))
    return nodes


def _between(rows: Array, x: Array) -> tuple[Array, float]:
    """Polynomials through the values (rows, nodes) at Chebyshev's points, at ``x``; and the error of the first."""
    count = rows.shape[1]
    angle = np.pi * np.arange(count) / (count - 1)
    basis = np.cos(np.outer(np.arange(count), np.pi - angle))
    basis[:, [0, -1]] *= 0.5
    c = (2.0 / (count - 1)) * rows @ basis.T
    c[:, [0, -1]] *= 0.5
    found: Array = c @ np.cos(np.outer(np.arange(count), np.arccos(np.clip(2.0 * x - 1.0, -1.0, 1.0))))
    return found, float(max(abs(c[0, -1]), 0.1 * abs(c[0, -2])))
