"""Error against run time: the membrane solver and every method of comparison, over their tolerances, on many states.

Times are processor time of one process, so that what else runs on the machine matters little, and mean something only
as ratios within one run: every method solves one state before any goes on to the next, in several rounds, and the least
time counts; the ratios that are quoted are measured side by side (`rig.benchmark.ratios`). References come from
`model.verification.reference`, which does not compete.
"""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from time import process_time  # what work costs; when things happen is the clock's business
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from model.kernel.library import says
from model.material.materials import NAMED
from model.membrane import solve as membrane
from model.specimen import Specimen
from model.verification import baselines
from model.verification.baselines import Result
from model.verification.reference import Reference, reference
from rig.benchmark.cases import Case, taut_cases
from rig.benchmark.histories import Along, along_histories
from rig.benchmark.histories import table as along_table
from rig.benchmark.ratios import Job, Ratio, lines, measured

if TYPE_CHECKING:
    from rich.console import RenderableType

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]  # share done, what is being done

OURS = "dea-rig"
BATCH = "dea-rig, batch of different films"
ONE_FILM = "dea-rig, batch of states of one film"
WANTED = 1e-6  # error of the force at which speeds are compared
NINE_OF_TEN = 0.9
ROUNDS = 5  # of the ratios
WRONG = 1e-2  # a force further off than this is no answer
OCTAVE = "Octave ode15s shooting"

TOLERANCES: dict[str, tuple[float, ...]] = {
    OURS: (1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10),
    OCTAVE: (1e-4, 1e-5, 1e-6),
    "BDF shooting": (1e-4, 1e-5, 1e-6, 1e-7),
    "Radau shooting": (1e-4, 1e-5, 1e-6, 1e-8),
    "LSODA shooting": (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10),
    "RK45 shooting": (1e-4, 1e-5, 1e-6, 1e-7, 1e-8),
    "DOP853 shooting": (1e-3, 1e-4, 3e-5, 1e-5, 1e-6, 1e-8, 1e-10),
    "solve_bvp in R": (1e-3, 1e-4, 3e-5, 1e-5, 1e-6, 1e-8),
    "solve_bvp in ln R": (1e-3, 1e-4, 3e-5, 1e-5, 1e-6, 1e-8),
    "Chebyshev in R": (1e-3, 1e-5, 1e-7, 1e-9),
    "Chebyshev in ln R": (1e-3, 1e-5, 1e-7, 1e-9),
}
SLOW = {OCTAVE: 3, "BDF shooting": 6, "Radau shooting": 6}  # states that they get in a quick run
SHOOTING = ("LSODA shooting", "RK45 shooting", "DOP853 shooting", "BDF shooting", "Radau shooting")


@dataclass(frozen=True)
class Spread:
    """Of one quantity over the cases."""

    median: float
    nine_of_ten: float
    largest: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        known = np.array([v for v in values if math.isfinite(v)])
        if known.size == 0:
            return cls(math.nan, math.nan, math.nan)
        return cls(float(np.median(known)), float(np.quantile(known, NINE_OF_TEN)), float(known.max()))


@dataclass(frozen=True)
class Point:
    """One method at one tolerance, cold single solves.

    ``seconds`` of one solve; ``force`` and ``field`` are relative errors, ``hoop`` is the error of the least hoop
    stress over the shear modulus; ``failures`` are cases without an answer, or with a force more than 1 % off.
    """

    method: str
    tolerance: float
    cases: int
    failures: int
    seconds: Spread
    force: Spread
    field: Spread
    hoop: Spread
    evaluations: float  # median


@dataclass(frozen=True)
class Speed:
    """Time per solve in one way of working, at the loosest tolerance that keeps nine of ten forces within 1e-6."""

    mode: str
    method: str
    tolerance: float
    seconds: float
    error: float  # of the force, nine of ten


@dataclass(frozen=True)
class Scaling:
    """A batch of so many states."""

    states: int
    seconds: float
    peak_memory_MB: float  # allocated while solving


@dataclass(frozen=True)
class Report:
    """What the solver benchmark found; see `render` and the files that `run` writes."""

    full: bool
    cases: int
    points: list[Point]
    speeds: list[Speed]
    ratios: list[Ratio]
    scaling: list[Scaling]
    one_off: dict[str, float]  # seconds
    environment: dict[str, str]
    notes: list[str] = field(default_factory=list)
    along: list[Along] = field(default_factory=list)  # films that take time, along histories


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None) -> Report:
    """Measure, and write ``solver.json``, ``.csv``, ``.png``, ``_speed.png`` and ``_ratios.txt`` into ``out_dir``."""
    report = measure(cases=150 if full else 24, full=full, rounds=3 if full else 2, progress=progress)
    save(report, out_dir)
    return report


def save(report: Report, out_dir: Path) -> None:
    """Write the report as JSON, CSV and pictures."""
    from rig.benchmark import plot

    out_dir.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_plain(asdict(report)), indent=1, allow_nan=False)
    (out_dir / "solver.json").write_text(text + "\n", encoding="utf-8")
    with (out_dir / "solver.csv").open("w", encoding="utf-8", newline="") as file:
        rows = [_flat(asdict(point)) for point in report.points]
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    (out_dir / "solver_ratios.txt").write_text(ratio_lines(report) + "\n", encoding="utf-8")
    plot.work_precision(report, out_dir / "solver.png")
    plot.speeds(report, out_dir / "solver_speed.png")


def _plain(value: object) -> object:
    """NaN and inf have no place in JSON: null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _flat(row: dict[str, object]) -> dict[str, object]:
    out: dict[str, object] = {}
    for key, value in row.items():
        if isinstance(value, dict):
            out |= {f"{key}_{name}": item for name, item in value.items()}
        else:
            out[key] = value
    return out


# ---- measuring


@dataclass
class _Cell:
    """One method at one tolerance on one state."""

    seconds: float = math.inf
    result: Result | None = None


Cells = dict[tuple[str, float], dict[int, _Cell]]  # by method and tolerance, then by number of the state


def measure(
    cases: int,
    *,
    full: bool = False,
    methods: Sequence[str] | None = None,
    batch: int = 1000,
    rounds: int = 3,
    details: bool = True,
    progress: Progress = lambda share, what: None,
) -> Report:
    """The benchmark on ``cases`` states; ``methods`` names those to run beside ours (all by default).

    ``details`` are curves, wrinkled films, cost against number of states, and one-off costs.
    """
    notes: list[str] = []
    environment = _environment()
    chosen = [OURS, *(baselines.BASELINES if methods is None else methods)]
    if OCTAVE in chosen and baselines.octave_available() is None:
        chosen.remove(OCTAVE)
        notes.append("octave-cli is not on PATH: the stand-in for the paper's MATLAB was not run.")
    progress(0.0, "reference values")
    states, truth = taut_cases(cases)
    cells = _cold(states, chosen, full, rounds, lambda share, what: progress(0.05 + 0.7 * share, what))
    points = [_point(method, tolerance, found, states, truth) for (method, tolerance), found in cells.items()]
    progress(0.75, "batches")
    points += _batch_points(states, truth, batch)
    progress(0.8, "force-displacement curves")
    speeds = [s for method in (*chosen, BATCH) if (s := _speed(points, method)) is not None]
    speeds += _sweeps(states, chosen) if details else []
    progress(0.9, "ratios")
    good = {s.method: s.tolerance for s in speeds if s.mode in ("cold single", "batch") and s.error <= WANTED}
    ratios = _ratios(states, good, speeds, batch, 9 if full else ROUNDS)
    ratios += _wrinkled(batch, ROUNDS) if details else []
    progress(0.95, "cost against number of states, one-off costs")
    scaling = _scaling((10, 100, 1000, 10_000, *((100_000,) if full else ()))) if details else []
    return Report(
        full=full,
        cases=len(states),
        points=points,
        speeds=speeds,
        ratios=ratios,
        scaling=scaling,
        one_off=_one_off() if details else {},
        environment={**environment, "load after": _load()},
        notes=notes,
        along=along_histories(full) if details else [],
    )


def _solve(method: str, case: Case, tolerance: float) -> Result:
    if method != OURS:
        return baselines.BASELINES[method](case.specimen, case.h, case.voltage, tolerance)
    found = membrane.solve(case.specimen, case.h, case.voltage, tolerance=tolerance)
    good = found.status is membrane.Status.TAUT
    return Result(found.force, found.peak_field, found.min_hoop_stress, good, found.status.message, found.iterations)


def _cold(states: Sequence[Case], chosen: Sequence[str], full: bool, rounds: int, progress: Progress) -> Cells:
    """Single solves from scratch, state by state: what disturbs the machine disturbs all methods alike."""
    cells: Cells = {(method, tolerance): {} for method in chosen for tolerance in TOLERANCES[method]}
    for method in chosen:
        _solve(method, states[0], TOLERANCES[method][0])  # imports and caches are one-off costs
    for turn in range(rounds):
        for i, case in enumerate(states):
            progress((turn + i / len(states)) / rounds, f"single solves, round {turn + 1} of {rounds}")
            for (method, tolerance), found in cells.items():
                some = SLOW.get(method)
                if some is not None and (turn > 0 or i >= (5 * some if full else some)):
                    continue
                cell = found.setdefault(i, _Cell())
                for _ in range(1 if some else 2):
                    begun = process_time()
                    cell.result = _solve(method, case, tolerance)
                    elapsed = process_time() - begun
                    own = cell.result.seconds
                    cell.seconds = min(cell.seconds, elapsed if own is None else own)
    return cells


def _point(method: str, tolerance: float, found: dict[int, _Cell], states: Sequence[Case], truth: Reference) -> Point:
    seconds, force, peak, hoop, evaluations = [], [], [], [], []
    for i, cell in found.items():
        case, result = states[i], cell.result
        if result is None or not result.ok:
            continue
        error = float(abs(result.force / truth.force[i] - 1.0))
        if not error <= WRONG:
            continue
        seconds.append(cell.seconds)
        evaluations.append(float(result.evaluations))
        force.append(error)
        hoop.append(
            float(abs(result.min_hoop_stress - truth.min_hoop_stress[i])) / case.specimen.material.shear_modulus
        )
        if case.voltage > 0:
            peak.append(float(abs(result.peak_field / truth.peak_field[i] - 1.0)))
    return Point(
        method,
        tolerance,
        len(found),
        len(found) - len(force),
        Spread.of(seconds),
        Spread.of(force),
        Spread.of(peak),
        Spread.of(hoop),
        float(np.median(evaluations)) if evaluations else math.nan,
    )


def _batch_points(states: Sequence[Case], truth: Reference, batch: int) -> list[Point]:
    """The same states in one call, over and over until they make a batch; time is per state."""
    n = len(states)
    specimens, h, voltage = _several(states, batch)
    points = []
    for tolerance in TOLERANCES[OURS]:
        best = math.inf
        for _ in range(5):
            begun = process_time()
            found = membrane.solve_many(specimens, h, voltage, tolerance=tolerance)
            best = min(best, process_time() - begun)
        cells = {
            i: _Cell(
                best / len(specimens),
                Result(
                    float(found.force[i]),
                    float(found.peak_field[i]),
                    float(found.min_hoop_stress[i]),
                    bool(found.status[i] == membrane.Status.TAUT),
                    "",
                    int(found.iterations[i]),
                ),
            )
            for i in range(n)
        }
        points.append(_point(BATCH, tolerance, cells, states, truth))
    return points


def _several(states: Sequence[Case], batch: int) -> tuple[list[Specimen], Array, Array]:
    """Specimens, h (m) and voltages (V): every state has a film and a material of its own, as in a fit or a design."""
    several = [states[i % len(states)] for i in range(max(batch, len(states)))]
    specimens = [replace(case.specimen, material=replace(case.specimen.material)) for case in several]
    return specimens, np.array([case.h for case in several]), np.array([case.voltage for case in several])


def _speed(points: Sequence[Point], method: str) -> Speed | None:
    """At the loosest tolerance that does; failing that, at the tightest."""
    mine = [point for point in points if point.method == method and point.failures <= 0.1 * point.cases]
    if not mine:
        return None
    good = [point for point in mine if point.force.nine_of_ten <= WANTED]
    point = good[0] if good else mine[-1]
    mode = "batch" if method == BATCH else "cold single"
    return Speed(mode, method, point.tolerance, point.seconds.median, point.force.nine_of_ten)


def _sweeps(states: Sequence[Case], chosen: Sequence[str]) -> list[Speed]:
    """Force-displacement curves at each film's voltage, one solve after the other or in one call."""
    speeds = []
    films = states[:3]
    judged = np.linspace(0.8, 1.0, 8)  # of the height; these points are in every curve
    truths = [reference(case.specimen, judged * case.h, case.voltage).force for case in films]
    methods = {"dea-rig, curve of 50 points": (_curve_ours, 50), ONE_FILM: (_curve_ours, 1002)}
    if "DOP853 shooting" in chosen:
        methods["DOP853 shooting, each from the last, curve of 50 points"] = (_curve_shooting, 50)
    for name, (curve, count) in methods.items():
        every = (count - 1) // 7
        for tolerance in (1e-4, 1e-5, 1e-6, 1e-7):
            times, errors = [], []
            for case, force in zip(films, truths, strict=True):
                h = np.linspace(0.8, 1.0, count) * case.h
                best = math.inf
                for _ in range(2):
                    begun = process_time()
                    found = curve(case, h, tolerance)
                    best = min(best, process_time() - begun)
                times.append(best / h.size)
                errors.append(np.abs(found[::every] / force - 1.0))
            error = float(np.quantile(np.nan_to_num(np.concatenate(errors), nan=np.inf), NINE_OF_TEN))
            if error <= WANTED:
                speeds.append(
                    Speed("batch" if name == ONE_FILM else "sweep", name, tolerance, float(np.median(times)), error)
                )
                break
    return speeds


def _curve_ours(case: Case, h: Array, tolerance: float) -> Array:
    return membrane.solve_many(case.specimen, h, case.voltage, tolerance=tolerance).force


def _curve_shooting(case: Case, h: Array, tolerance: float) -> Array:
    start = None
    forces = []
    for height in h:
        found = baselines.explicit_shooting(case.specimen, float(height), case.voltage, tolerance, start=start)
        start = found.start
        forces.append(found.force)
    return np.array(forces)


def _ratios(
    states: Sequence[Case], good: dict[str, float], speeds: Sequence[Speed], batch: int, rounds: int
) -> list[Ratio]:
    """Against the best of each kind of rival, each at the loosest tolerance (``good``) that gives what is wanted."""
    if OURS not in good:
        return []
    single = {s.method: s.seconds for s in speeds if s.mode == "cold single" and s.method in good}
    names = [name for name in single if name.startswith("solve_bvp")]
    shooting = [name for name in SHOOTING if name in single]
    others = [name for name in single if name != OURS]
    names += [min(group, key=lambda name: single[name]) for group in (shooting, others) if group]
    names = list(dict.fromkeys(names))

    def jobs(method: str, some: Sequence[Case]) -> list[Job]:
        return [partial(_solve, method, case, good[method]) for case in some]

    ratios = [
        measured(f"one film alone, against {name}", jobs(name, states), jobs(OURS, states), rounds) for name in names
    ]
    if BATCH in good:
        specimens, h, voltage = _several(states, batch)
        together = partial(membrane.solve_many, specimens, h, voltage, tolerance=good[BATCH])
        for name in names:
            what = f"{len(specimens)} different films together, against {name}"
            ratios.append(measured(what, jobs(name, states), [together], rounds, states=len(specimens), repeats=1))
    return ratios


def _wrinkled(batch: int, rounds: int) -> list[Ratio]:
    """A tension-field state over a taut one of the same film, both at the same tolerance, alone and in a batch.

    Nothing where a force misses what is wanted.
    """
    film = Specimen(4e-3, 20e-3, 40e-6, 1.0, NAMED["parker-cao2018"])
    taut = replace(film, prestretch=1.2)
    h, voltage = 12e-3, 1500.0
    heights = np.linspace(0.8, 1.0, batch) * h
    pair = (film, taut)

    def alone(specimen: Specimen) -> membrane.Solution:
        return membrane.solve(specimen, h, voltage, tolerance=WANTED, wrinkling="tension_field")

    def several(specimen: Specimen) -> membrane.Solutions:
        return membrane.solve_many(specimen, heights, voltage, tolerance=WANTED, wrinkling="tension_field")

    for specimen in pair:
        known = float(reference(specimen, h, voltage, wrinkling="tension_field").force[0])
        if not abs(alone(specimen).force / known - 1.0) <= WANTED:
            return []
    first, second = ([partial(job, specimen) for specimen in pair] for job in (alone, several))
    return [
        measured("wrinkled film over taut one, time alone", first[:1], first[1:], rounds, repeats=5),
        measured(f"wrinkled film over taut one, time {batch} together", second[:1], second[1:], rounds),
    ]


def _scaling(counts: Sequence[int]) -> list[Scaling]:
    """Time and memory of batches of growing size."""
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
    rows = []
    for count in counts:
        h = np.linspace(2e-3, 15e-3, count)
        best = math.inf
        for _ in range(3 if count <= 10_000 else 1):
            begun = process_time()
            membrane.solve_many(film, h, 1000.0)
            best = min(best, process_time() - begun)
        tracemalloc.start()
        try:
            membrane.solve_many(film, h, 1000.0)
            memory = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        rows.append(Scaling(count, best, memory / 1e6))
    return rows


_FRESH = """
from time import process_time
begun = process_time()
{imports}
imported = process_time()
{first}
print(imported - begun, process_time() - imported)
"""
_FILM = "Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED['parker-cao2018'])"


def _one_off() -> dict[str, float]:
    """Seconds, in a fresh interpreter: imports, and the first solve, which also fills caches."""
    jobs = {
        "dea-rig": ("from model.membrane.solve import solve", f"solve({_FILM}, 10e-3, 1500.0)"),
        "SciPy (DOP853 shooting)": (
            "import scipy.integrate, scipy.optimize\n"
            "from model.verification.baselines import explicit_shooting as solve",
            f"solve({_FILM}, 10e-3, 1500.0, 1e-6)",
        ),
    }
    out = {}
    for name, (imports, first) in jobs.items():
        common = "\nfrom model.material.materials import NAMED\nfrom model.specimen import Specimen"
        done = subprocess.run(
            [sys.executable, "-c", _FRESH.format(imports=imports + common, first=first)],
            capture_output=True,
            text=True,
            check=True,
        )
        imported, solved = (float(v) for v in done.stdout.split())
        out[f"{name}: import"] = imported
        out[f"{name}: first solve"] = solved
    return out


def _environment() -> dict[str, str]:
    import scipy

    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "processors": str(os.cpu_count()),
        "membrane solver": says(),
        "load before": _load(),
    }


def _load() -> str:
    """Processes that wanted a processor in the last minute; Windows does not tell."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


# ---- showing


def render(report: Report) -> RenderableType:
    """Tables for the terminal."""
    from rich.console import Group
    from rich.table import Table

    table = Table(
        title=f"Error against run time: {report.cases} taut states, cold single solves",
        caption="Median over the states, worst of nine in ten after the dash. Force and field: relative. "
        "Hoop: least hoop stress over the shear modulus.",
    )
    for heading in ("method", "tolerance", "states", "failed", "ms", "force", "field", "hoop"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    last = ""
    for point in report.points:
        if point.method != last:
            table.add_section()
        table.add_row(
            point.method if point.method != last else "",
            f"{point.tolerance:.0e}",
            str(point.cases),
            str(point.failures or ""),
            f"{1e3 * point.seconds.median:.3g}",
            *(f"{s.median:.0e} - {s.nine_of_ten:.0e}" for s in (point.force, point.field, point.hoop)),
        )
        last = point.method
    speed = Table(title="Time per solve, where possible with nine of ten forces within 1e-6")
    for heading in ("way of working", "method", "tolerance", "us", "error"):
        speed.add_column(heading, justify="left" if heading in ("way of working", "method") else "right")
    for s in report.speeds:
        speed.add_row(s.mode, s.method, f"{s.tolerance:.0e}", f"{1e6 * s.seconds:.3g}", f"{s.error:.0e}")
    size = Table(title="Cost against number of states (tolerance 1e-8)")
    for heading in ("states", "s", "us per state", "peak memory / MB"):
        size.add_column(heading, justify="right")
    for row in report.scaling:
        size.add_row(
            f"{row.states}", f"{row.seconds:.3g}", f"{1e6 * row.seconds / row.states:.3g}", f"{row.peak_memory_MB:.1f}"
        )
    one_off = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in report.one_off.items())
    texts = [
        ratio_lines(report),
        f"One-off costs, not counted above: {one_off}." if one_off else "",
        *report.notes,
    ]
    return Group(table, speed, size, along_table(report.along), *(text for text in texts if text))


def ratio_lines(report: Report) -> str:
    """The ratios and their conditions, as quoted in the README."""
    setting = ", ".join(f"{name} {value}" for name, value in report.environment.items())
    return lines(
        report.ratios,
        [
            f"{report.cases} taut films; each method at the loosest tolerance with nine of ten forces within 1e-6,",
            "wrinkled and taut film both at tolerance 1e-6; seconds of processor.",
            f"On: {setting}.",
        ],
    )
