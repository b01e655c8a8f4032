"""Figures of a film that takes time: relaxation, spectrum, loss and hysteresis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.result import Spectrum, Trace
from calibration.report.figures import STYLES, svg

Array = NDArray[np.float64]
LONGEST = 6  # holds that are drawn


def loss_factor(spectrum: Spectrum, frequency: Array) -> Array:
    """G''/G' at small strain over frequency (Hz): of ``1 + sum ratio i w time/(1 + i w time)``."""
    turn = 2j * np.pi * frequency[:, None] * np.array([one.time for one in spectrum.branches])
    ratio = np.array([one.ratio for one in spectrum.branches])
    modulus = 1.0 + (ratio * turn / (1.0 + turn)).sum(axis=1)
    return np.asarray(modulus.imag / modulus.real)


def holds(trace: Trace) -> list[NDArray[np.intp]]:
    """Rows of the holds, the longest first."""
    found = [np.flatnonzero(trace.segment == k) for k in np.unique(trace.segment) if not trace.moving[k]]
    found = [rows for rows in found if rows.size > 3]
    return sorted(found, key=lambda rows: -float(np.ptp(trace.time[rows])))


def relaxation(traces: Sequence[Trace]) -> str:
    """Force over the time since the disk stood still, measured and modelled, and what is left over."""

    def draw(figure: Any) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        drawn = 0
        for trace in traces:
            for rows in holds(trace):
                if drawn == LONGEST:
                    break
                begin = trace.time[rows[0]] - 0.5 * (trace.time[rows[1]] - trace.time[rows[0]])
                since = trace.time[rows] - begin
                colour, marker, dash = STYLES[drawn % len(STYLES)]
                label = f"{1e3 * trace.h[rows].mean():.3g} mm, {trace.voltage[rows].mean():.0f} V, from {begin:.0f} s"
                drawn += 1
                last = trace.model[rows][-1]
                scale = 100.0 / last if last else 100.0
                upper.plot(since, scale * (trace.measured[rows] - last), marker, ms=3, mfc="white", color=colour)
                upper.plot(since, scale * (trace.model[rows] - last), color=colour, ls=dash, lw=1.5, label=label)
                left = 1e3 * (trace.measured[rows] - trace.model[rows])
                lower.errorbar(since, left, 2e3 * trace.deviation[rows], fmt=marker, ms=3, color=colour, elinewidth=0.8)
        lower.axhline(0.0, color="black", lw=0.8)
        upper.set_xscale("log")
        upper.set_ylabel("force over its last value / %")
        lower.set_ylabel("residual / mN")
        lower.set_xlabel("time since the disk stood still or the voltage changed / s")
        if drawn:
            upper.legend(loc="best")

    return svg(draw, width=7.2, height=4.6)


def over_time(spectrum: Spectrum) -> str:
    """The branches with their uncertainties, and the loss that follows from them."""
    low, high = spectrum.window

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        for k, one in enumerate(spectrum.branches):
            colour, marker, _ = STYLES[k % len(STYLES)]
            beside = [[max(0.0, one.time - one.times[0])], [one.times[1] - one.time]]
            above = [[max(0.0, one.ratio - one.ratios[0])], [one.ratios[1] - one.ratio]]
            left.errorbar(
                [one.time], [one.ratio], above, beside, fmt=marker, color=colour, capsize=3, label=one.verdict
            )
            left.vlines(one.time, 0.0, one.ratio, color=colour, lw=2.0)
        left.axvspan(low, high, color="#eef3f8", lw=0, label="times that the record can show")
        left.set_xscale("log")
        left.set_xlim(0.3 * low, 3.0 * high)
        left.set_ylim(0.0, 1.5 * left.get_ylim()[1])  # room for the legend
        left.set_xlabel("relaxation time / s")
        left.set_ylabel("ratio to the relaxed film")
        left.set_title("(a) branches, 95 % limits")
        left.legend(loc="upper left")
        frequency = np.geomspace(0.1 / high, 1.0 / low, 200)
        right.plot(frequency, loss_factor(spectrum, frequency), color="#0072B2", lw=1.6)
        right.axvspan(1.0 / (2.0 * np.pi * high), 1.0 / (2.0 * np.pi * low), color="#eef3f8", lw=0)
        right.set_xscale("log")
        right.set_xlabel("frequency / Hz")
        right.set_ylabel("loss factor at small strain")
        right.set_title("(b) loss that follows from them")

    return svg(draw, width=8.4, height=3.2)


def hysteresis(traces: Sequence[Trace]) -> str:
    """Force less that of the relaxed film over displacement, measured and predicted: the loop."""

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, len(traces), squeeze=False)[0]
        for ax, trace in zip(axes, traces, strict=True):
            volts = np.round(trace.voltage / max(float(trace.voltage.max()), 1.0), 2)
            for k, level in enumerate(np.unique(volts)[:: max(1, np.unique(volts).size // 5)]):
                rows = volts == level
                colour, marker, dash = STYLES[k % len(STYLES)]
                extra = 1e3 * (trace.measured - trace.relaxed), 1e3 * (trace.model - trace.relaxed)
                ax.plot(1e3 * trace.h[rows], extra[0][rows], marker, ms=2.5, mfc="white", mew=0.7, color=colour)
                broken = np.where(rows, extra[1], np.nan)
                label = f"{np.median(trace.voltage[rows]):.0f} V"
                ax.plot(1e3 * trace.h, broken, color=colour, ls=dash, lw=1.2, label=label)
            ax.set_title(trace.run)
            ax.set_xlabel("displacement h / mm")
            ax.legend(loc="best")
        axes[0].set_ylabel("force less that of the relaxed film / mN")

    return svg(draw, width=4.6 * max(len(traces), 1.3), height=3.4)
