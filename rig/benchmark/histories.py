"""Work and precision of films that take time: the implicit solver against shooting within a solver of ODEs."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from model.material.materials import NAMED, Branch
from model.specimen import Specimen

if TYPE_CHECKING:
    from rich.table import Table

# A ramp of 10 s and a hold. Forces (N) of a code that shares nothing with this project, to 1e-9 of the largest.
FILM = Specimen(
    4e-3, 20e-3, 40e-6, 1.2, replace(NAMED["parker-cao2018"], branches=(Branch(0.1, 1.0), Branch(0.1, 30.0)))
)
COURSE = (np.array([0.0, 10.0, 100.0]), np.array([0.0, 10e-3, 10e-3]), np.zeros(3))
TIMES = np.array([8.823529, 17.647059, 44.117647, 73.529412, 100.0])
FORCES = np.array([0.174014016, 0.21955249, 0.217206552, 0.216274197, 0.215938708])
OURS, SHOOTING = "solve_history", "shooting within solve_ivp"


@dataclass(frozen=True)
class Along:
    """One method at one tolerance: seconds of processor, and the largest error over the largest force."""

    method: str
    tolerance: float
    seconds: float
    error: float  # NaN where it failed


def along_histories(full: bool) -> list[Along]:
    """Both methods from the loosest tolerance on."""
    from model.membrane.history import solve_history
    from model.verification.baselines.history_shooting import history_by_shooting

    rows = []
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)[: 5 if full else 4]:
        start = time.process_time()
        force = solve_history(FILM, *COURSE, TIMES, tolerance=tolerance).force
        rows.append(_row(OURS, tolerance, start, force.tolist()))
    for tolerance in (1e-4, 1e-5)[: 2 if full else 1]:
        start = time.process_time()
        shot = history_by_shooting(FILM, *COURSE, TIMES, tolerance)
        rows.append(_row(SHOOTING, tolerance, start, shot.tolist()))
    return rows


def _row(method: str, tolerance: float, start: float, force: list[float]) -> Along:
    seconds = time.process_time() - start
    error = float(np.abs(np.array(force) - FORCES).max() / FORCES.max())
    return Along(method, tolerance, seconds, error if math.isfinite(error) else math.nan)


def table(rows: Sequence[Along]) -> Table:
    """For the terminal."""
    from rich.table import Table

    found = Table(title="A film with two branches, pushed in 10 s and held for 90 s")
    for heading in ("method", "tolerance", "s", "error"):
        found.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        error = f"{row.error:.0e}" if math.isfinite(row.error) else "failed"
        found.add_row(row.method, f"{row.tolerance:.0e}", f"{row.seconds:.3g}", error)
    return found
