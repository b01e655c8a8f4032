"""The probability plot of breakdowns: on its axes a Weibull distribution is a straight line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.breakdown.intervals import WeibullFit
from calibration.breakdown.sample import Sample
from calibration.breakdown.study import Study
from calibration.report.figures import RC, STYLES
from rig.analysis.breakdown_table import Breakdowns

SHOWN = {"V": ("voltage / kV", 1e-3), "V/m": ("field / (V/um)", 1e-6)}
SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 0.9, 0.99)


def draw(table: Breakdowns, study: Study, path: Path) -> None:
    """Write the picture; its format follows from the file's ending.

    Values at other areas are brought to the reference area by the fit. Heights are median ranks of the product-limit
    estimate (Kaplan and Meier 1958): (i - 0.3) / (n + 0.4), with i adjusted for censored specimens (Johnson 1964).
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    label, factor = SHOWN[table.unit]
    groups = table.groups if study.group_fits and table.groups is not None else ["all"] * len(table.names)
    fits = study.group_fits if table.groups is not None and study.group_fits else {"all": study.weibull}
    with mpl.rc_context(RC):
        figure = Figure(figsize=(6.4, 4.6), layout="constrained")
        axes = figure.subplots()
        axes.set_xscale("log")
        for name, (colour, marker, dash) in zip(dict.fromkeys(groups), STYLES * len(set(groups)), strict=False):
            part = table.sample.part(np.array(groups) == name)
            shape = fits[name].shape.value if name in fits else study.weibull.shape.value
            values = part.value * part.area ** (1.0 / shape) * factor
            ranks = median_ranks(Sample(values, part.failed, part.area))
            axes.plot(
                values[part.failed], weibit(ranks), marker, color=colour, ms=5, ls="", label=f"{name}: broke down"
            )
            if not part.failed.all():
                low = np.full(int((~part.failed).sum()), weibit(SHARES[0]))
                axes.plot(values[~part.failed], low, "|", color=colour, ms=12, ls="", label=f"{name}: survived (ticks)")
            if name in fits:
                _line(axes, fits[name], factor, colour, dash)
        axes.set_yticks([float(weibit(share)) for share in SHARES], [f"{share * 100:g} %" for share in SHARES])
        axes.set_ylim(float(weibit(0.009)), float(weibit(0.995)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.set_xlabel(label + ("" if table.reference_area is None else f" at {table.reference_area * 1e6:.3g} mm2"))
        axes.set_ylabel("broken down")
        axes.legend(title="lines: Weibull fits; bars: 95 % intervals", title_fontsize=8, loc="upper left")
        figure.savefig(path)


def _line(axes: object, fit: WeibullFit, factor: float, colour: str, dash: object) -> None:
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    ends = weibit(np.array([0.009, 0.995]))
    axes.plot(fit.scale.value * np.exp(ends / fit.shape.value) * factor, ends, ls=dash, color=colour, lw=1.2)
    for estimate, share in ((fit.scale, 1 - np.exp(-1)), (fit.low_quantile, 0.1)):
        ends = np.array([estimate.profile.low, estimate.profile.high]) * factor
        axes.plot(ends, [float(weibit(share))] * 2, color=colour, lw=3, alpha=0.35, solid_capstyle="butt")


def weibit(share: float | Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """ln(-ln(1 - share)): linear in ln t for a Weibull distribution."""
    return np.asarray(np.log(-np.log1p(-np.asarray(share, float))))


def median_ranks(sample: Sample) -> NDArray[np.float64]:
    """Heights of the failures, in the order of the sample; a survivor counts after the failures at its value."""
    order = np.lexsort((~sample.failed, sample.value))
    n, rank = len(order), 0.0
    heights = np.full(n, np.nan)
    for place, i in enumerate(order):
        if sample.failed[i]:
            rank += (n + 1 - rank) / (n + 1 - place)
            heights[i] = (rank - 0.3) / (n + 0.4)
    return np.asarray(heights[sample.failed])
