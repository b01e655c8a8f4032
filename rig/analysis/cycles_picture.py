"""Peak force, response and loop area over the cycles of an endurance test, as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.report.figures import RC, STYLES
from rig.analysis.cycles import Cycles

MOST_POINTS = 2000  # of a curve: more cycles are drawn by the mean of as many as there are between two points
ALL_BELOW = 100  # cycles that are drawn one by one


def draw(found: Cycles, path: Path) -> None:
    """Write the picture; its format follows from the file's ending."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    whole, name = found.whole, found.response_name
    moved = name == "stiffness_N_per_m"
    number = whole["cycle"].astype(float)
    response = whole[name] / found.reference * 100.0 if np.isfinite(found.reference) else whole[name]
    words = "response / % of reference" if np.isfinite(found.reference) else f"{name.replace('_', ' ', 1)}"
    curves = (
        ("largest force / N", whole["force_peak_N"]),
        (words, response),
        ("loop area / uJ" if moved else "electric energy / uJ", whole["work_J" if moved else "electric_J"] * 1e6),
    )
    begins = [int(number[whole["log"] == k].min()) for k in range(2, len(found.logs) + 1) if (whole["log"] == k).any()]
    with mpl.rc_context(RC):
        figure = Figure(figsize=(7.2, 6.6), layout="constrained")
        for axes, (label, values) in zip(figure.subplots(3, 1, sharex=True), curves, strict=True):
            axes.plot(*_thinned(number, values), color=STYLES[0][0], lw=1.0, marker=".", ms=3)
            for begin in begins:
                axes.axvline(begin, color="0.6", lw=0.8, ls=":")
            axes.set_ylabel(label)
            axes.set_xscale("log")
        axes.set_xlabel("cycle" + (" (dotted: a run that went on)" if begins else ""))
        figure.savefig(path)


def _thinned(number: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """As many points as a picture can show, evenly over the logarithm of the number: means, of cycles side by side."""
    if len(number) <= MOST_POINTS:
        return number, values
    edges = np.unique(np.geomspace(ALL_BELOW, number.max() + 1.0, MOST_POINTS).astype(np.int64))
    edges = np.concatenate([np.arange(1, ALL_BELOW), edges])
    where = np.searchsorted(number, edges)
    where = np.unique(where[where < len(number)])
    counts = np.diff(np.append(where, len(number)))
    known = np.where(np.isfinite(values), values, 0.0)
    seen = np.add.reduceat(np.isfinite(values).astype(float), where)
    with np.errstate(invalid="ignore"):
        return np.add.reduceat(number, where) / counts, np.add.reduceat(known, where) / seen
