"""The solver in extreme states: a grid of families, what it says of each, and whether its error estimate is honest.

Every state is solved in both treatments of wrinkling. It counts as a fault when a call raises or warns, when a number
is NaN though the status promises an answer, and when a force is off by more than ten times its own error estimate,
judged by `model.verification.reference`.
"""

from __future__ import annotations

import csv
import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from model.material.materials import NAMED, Material
from model.membrane import solve as membrane
from model.membrane.solve import Status
from model.specimen import Specimen
from rig.benchmark.cases import Case, Generator, log_uniform, random_case, slack_voltage, solve_reference

if TYPE_CHECKING:
    from rich.console import RenderableType

Progress = Callable[[float, str], None]  # share done, what is being done

TOLERANCE = 1e-8
LIMIT = 10.0  # a true error above this many estimates is a fault
RESOLVED = 2e-12  # the reference and a force in floating point are not known better than this


@dataclass(frozen=True)
class Row:
    """One family.

    ``missed`` counts states without an answer though the reference has one, ``unverified`` the opposite.
    """

    family: str
    states: int
    counts: dict[str, int]
    checked: int
    missed: int
    unverified: int
    median_ratio: float  # true error of the force over its estimate
    worst_ratio: float
    worst_error: float  # relative
    beyond_tolerance: int  # states
    beyond_three_estimates: int  # states
    faults: list[str]
    missed_states: list[str]


@dataclass(frozen=True)
class Report:
    """What the benchmark of extremes found."""

    full: bool
    tolerance: float
    rows: list[Row]

    @property
    def faults(self) -> list[str]:
        """All of them, each with its family."""
        return [f"{row.family}: {fault}" for row in self.rows for fault in row.faults]


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None) -> Report:
    """Solve the grid (about 400 states, full: more than 5000); write ``extremes.json``, ``.csv`` and ``.png``."""
    report = measure(560 if full else 40, full=full, progress=progress)
    save(report, out_dir)
    return report


def measure(
    states: int,
    *,
    full: bool = False,
    families: Sequence[str] | None = None,
    progress: Progress = lambda share, what: None,
) -> Report:
    """``states`` states of every family (or of those named)."""
    rows = []
    chosen = list(FAMILIES) if families is None else list(families)
    for i, name in enumerate(chosen):
        progress(i / len(chosen), name)
        rng = np.random.default_rng([i, 1972])
        rows.append(_row(name, [FAMILIES[name](rng, k / max(states - 1, 1)) for k in range(states)]))
    return Report(full, TOLERANCE, rows)


def save(report: Report, out_dir: Path) -> None:
    """Write the report as JSON, CSV and a picture."""
    from rig.benchmark import plot

    out_dir.mkdir(parents=True, exist_ok=True)
    rows = [asdict(row) for row in report.rows]
    for row in rows:
        for key, value in row.items():
            if isinstance(value, float) and not math.isfinite(value):
                row[key] = None
    text = json.dumps({"full": report.full, "tolerance": report.tolerance, "rows": rows}, indent=1, allow_nan=False)
    (out_dir / "extremes.json").write_text(text + "\n", encoding="utf-8")
    with (out_dir / "extremes.csv").open("w", encoding="utf-8", newline="") as file:
        counts = [status.name for status in Status]
        plain = [key for key in rows[0] if key not in ("counts", "faults", "missed_states")]
        writer = csv.writer(file)
        writer.writerow([*plain, *counts, "faults"])
        for row in rows:
            writer.writerow(
                [*(row[key] for key in plain), *(row["counts"].get(name, 0) for name in counts), len(row["faults"])]
            )
    plot.extreme_states(report, out_dir / "extremes.png")


# ---- families: each gives a state for a generator and a place ``u`` from 0 to 1 in the range that it is about

PARKER = NAMED["parker-cao2018"]
RING = 20e-3
FILM = 40e-6


def _small_disk(rng: Generator, u: float) -> Case:
    film = Specimen(RING * 10 ** (-5 + 3.5 * u), RING, FILM, float(rng.choice([1.0, 1.1, 1.3])), PARKER)
    h = RING * log_uniform(rng, 0.05, 1.0)
    return Case(film, h, float(rng.choice([0.0, 0.3])) * slack_voltage(film, h))


def _unstretched(rng: Generator, u: float) -> Case:
    h = 1e-9 * (3 * RING / 1e-9) ** u
    return Case(Specimen(RING * log_uniform(rng, 0.02, 0.7), RING, FILM, 1.0, PARKER), h, 0.0)


def _overhang(rng: Generator, u: float) -> Case:
    film = Specimen(RING * log_uniform(rng, 0.1, 0.5), RING, FILM, 1.0, NAMED["treloar-ogden1972"])
    return Case(film, RING * (1.0 + 3.0 * u), 0.0)


def _exponents(rng: Generator, u: float) -> Case:
    alpha = -20.0 + 18.8 * 2 * u if u < 0.5 else 1.2 + 18.8 * 2 * (u - 0.5)
    material = Material("one term", (2e5 / alpha,), (alpha,), 3.0)
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, FILM, float(rng.uniform(1.0, 1.5)), material)
    h = RING * log_uniform(rng, 0.02, 1.5)
    return Case(film, h, float(rng.choice([0.0, 0.4])) * slack_voltage(film, h))


def _thickness(rng: Generator, u: float) -> Case:
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, 1e-6 * 1000**u, float(rng.uniform(1.0, 1.5)), PARKER)
    h = RING * log_uniform(rng, 0.02, 1.0)
    return Case(film, h, float(rng.uniform(0.0, 0.8)) * slack_voltage(film, h))


def _modulus(rng: Generator, u: float) -> Case:
    shear = 1e2 * 1e7**u
    scale = shear / PARKER.shear_modulus
    material = Material("scaled", tuple(scale * mu for mu in PARKER.mu), PARKER.alpha, PARKER.eps_r)
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, FILM, float(rng.uniform(1.0, 1.5)), material)
    h = RING * log_uniform(rng, 0.02, 1.0)
    return Case(film, h, float(rng.uniform(0.0, 0.8)) * slack_voltage(film, h))


def _voltage(rng: Generator, u: float) -> Case:
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, FILM, float(rng.uniform(1.0, 1.5)), PARKER)
    h = RING * log_uniform(rng, 0.1, 1.0)
    return Case(film, h, 3.0 * u * slack_voltage(film, h))


def _near_equal(rng: Generator, u: float) -> Case:
    alpha, gap = float(rng.uniform(1.5, 6.0)), 10 ** (-12.0 + 11.0 * u)
    share = float(rng.choice([0.5, 10.0]))  # equal halves, or a large difference of opposite terms
    material = Material(
        "two close terms", (1e5 * share / alpha, 1e5 * (1.0 - share) / alpha), (alpha, alpha * (1 + gap)), 3.0
    )
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, FILM, float(rng.uniform(1.0, 1.5)), material)
    h = RING * log_uniform(rng, 0.02, 1.0)
    return Case(film, h, float(rng.choice([0.0, 0.4])) * slack_voltage(film, h))


def _wrinkled(rng: Generator, u: float) -> Case:
    film = Specimen(RING * log_uniform(rng, 0.05, 0.5), RING, FILM, float(rng.choice([1.0, 1.05, 1.1])), PARKER)
    h = RING * float(rng.uniform(0.2, 1.0))
    return Case(film, h, (0.5 + 0.45 * u) * slack_voltage(film, h))


def _anything(rng: Generator, u: float) -> Case:
    return random_case(rng, disk=(0.02, 0.7), height=(0.01, 1.5), charge=1.0)


FAMILIES: dict[str, Callable[[Generator, float], Case]] = {
    "disk down to 1e-5 of the ring": _small_disk,
    "no pre-stretch, h from 1 nm to 3 b": _unstretched,
    "rubber pulled to h = 4 b, overhanging": _overhang,
    "exponents from -20 to 20": _exponents,
    "thickness from 1 µm to 1 mm": _thickness,
    "shear modulus from 100 Pa to 1 GPa": _modulus,
    "voltage up to 3 x slack": _voltage,
    "nearly equal exponents": _near_equal,
    "close to and beyond loss of tension": _wrinkled,
    "anything, 1 to 3 terms": _anything,
}


# ---- judging


def _row(name: str, cases: list[Case]) -> Row:
    faults: list[str] = []
    for wrinkling in ("plain", "tension_field"):
        found = _solve(cases, wrinkling, faults)
    if found is None:
        return Row(name, len(cases), {}, 0, 0, 0, math.nan, math.nan, math.nan, 0, 0, faults, [])
    answered = found.status <= Status.WRINKLED
    truth = solve_reference(cases, "tension_field")
    both = answered & truth.converged
    error = np.abs(found.force[both] / truth.force[both] - 1.0)
    estimate = found.error_estimate[both]
    ratio = np.maximum(error - RESOLVED, 0.0) / np.maximum(estimate, 1e-300)
    for i in np.flatnonzero(both)[ratio > LIMIT]:
        off = abs(found.force[i] / truth.force[i] - 1.0)
        faults.append(f"force off by {off:.1e}, estimated {found.error_estimate[i]:.1e}: {_describe(cases[i])}")
    return Row(
        family=name,
        states=len(cases),
        counts={status.name: n for status, n in sorted(Counter(Status(int(s)) for s in found.status).items())},
        checked=int(both.sum()),
        missed=int((~answered & truth.converged).sum()),
        unverified=int((answered & ~truth.converged).sum()),
        median_ratio=float(np.median(ratio)) if both.any() else math.nan,
        worst_ratio=float(ratio.max()) if both.any() else math.nan,
        worst_error=float(error.max()) if both.any() else math.nan,
        beyond_tolerance=int((error > TOLERANCE + RESOLVED).sum()),
        beyond_three_estimates=int((ratio > 3.0).sum()),
        faults=faults,
        missed_states=[_describe(cases[i]) for i in np.flatnonzero(~answered & truth.converged)],
    )


def _solve(cases: list[Case], wrinkling: membrane.Wrinkling, faults: list[str]) -> membrane.Solutions | None:
    """Solve all cases in one call; note what raises, what warns, and what is NaN without saying so."""
    specimens = [case.specimen for case in cases]
    h, voltage = np.array([case.h for case in cases]), np.array([case.voltage for case in cases])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = membrane.solve_many(specimens, h, voltage, tolerance=TOLERANCE, wrinkling=wrinkling)
        except Exception as problem:
            faults.append(f"{wrinkling}: {type(problem).__name__}: {problem}")
            return None
    answered = found.status <= Status.WRINKLED
    numbers = (
        found.force,
        found.peak_field,
        found.min_hoop_stress,
        found.min_meridional_stress,
        found.max_stretch,
        found.error_estimate,
    )
    silent: NDArray[np.bool_] = answered & ~np.all(np.isfinite(numbers), axis=0)
    faults += [
        f"{wrinkling}: a number is missing without a status: {_describe(cases[i])}" for i in np.flatnonzero(silent)
    ]
    return found


def _describe(case: Case) -> str:
    film = case.specimen
    m = film.material
    terms = ", ".join(f"({mu:.6g}, {alpha:.6g})" for mu, alpha in zip(m.mu, m.alpha, strict=True))
    return (
        f"a {film.disk_radius:.6g} b {film.ring_radius:.6g} T {film.thickness:.6g} lp {film.prestretch:.6g} "
        f"h {case.h:.6g} V {case.voltage:.6g} (mu, alpha) {terms} eps_r {m.eps_r:.4g}"
    )


# ---- showing


def render(report: Report) -> RenderableType:
    """A table for the terminal, and every fault."""
    from rich.console import Group
    from rich.table import Table

    table = Table(
        title=f"Extreme states, tension field, tolerance {report.tolerance:.0e}",
        caption="Ratios: true error of the force over its estimate, judged by the reference formulation. "
        "Missed: the reference has an answer and the solver none; unverified: the opposite.",
    )
    table.add_column("family")
    for heading in ("states", *(s.name.lower().replace("_", " ") for s in Status), "checked", "unverified", "missed"):
        table.add_column(heading, justify="right")
    for heading in ("median ratio", "worst ratio", "worst error", "> tolerance", "> 3 estimates", "faults"):
        table.add_column(heading, justify="right")
    for row in report.rows:
        table.add_row(
            row.family,
            str(row.states),
            *(str(row.counts.get(status.name, "")) for status in Status),
            str(row.checked),
            str(row.unverified or ""),
            str(row.missed or ""),
            f"{row.median_ratio:.1g}",
            f"{row.worst_ratio:.2g}",
            f"{row.worst_error:.0e}",
            str(row.beyond_tolerance or ""),
            str(row.beyond_three_estimates or ""),
            str(len(row.faults) or ""),
        )
    faults = report.faults
    lines = [f"{len(faults)} faults" if faults else "No exception, no warning, no silent NaN, no dishonest estimate."]
    return Group(table, *lines, *faults[:20], *([f"and {len(faults) - 20} more"] if len(faults) > 20 else []))
