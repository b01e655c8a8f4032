"""The report of a fit to sheets over time: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.film.result import Quantity
from calibration.report.figures import STYLES, svg
from calibration.report.relaxation_figure import over_time
from calibration.report.sections.base import BADGES, picture
from calibration.rounding import percent, rounded, stated
from calibration.sheet.report import STYLE, TABLE, write_page
from calibration.sheet.timed.predict import ConePrediction
from calibration.sheet.timed.result import SheetTrace, TimedFit

TEMPLATE = (
    STYLE
    + """<h1>A sheet that takes time</h1>
<p>{{ fit.law.title }}{% if fit.law.series %}, {{ fit.mu|length }} term{{ 's' if fit.mu|length > 1 }}{% endif %},
{{ fit.spectrum.branches|length }} branches. The law and its numbers are those of the relaxed sheet.
{{ fit.law.description }}</p>
{% for table in tables %}"""
    + TABLE
    + """{% endfor %}
<ul>{% for word in fit.spectrum.sentences %}<li>{{ word }}</li>{% endfor %}</ul>
{% for title, image, words in figures %}<h2>{{ title }}</h2>
<img src="{{ image }}" alt="{{ words }}"><p>{{ words }}</p>
{% endfor %}
{% if told_against %}<h2>What speaks against it</h2>
<ul>{% for word in told_against %}<li>{{ word }}</li>{% endfor %}</ul>{% endif %}
<h2>What was understood of the tables</h2>
<pre>{% for line in told %}{{ line }}
{% endfor %}</pre>
</body></html>
"""
)


def write_report(path: Path, fit: TimedFit, cones: Sequence[ConePrediction], told: Sequence[str]) -> None:
    """Write the report; the file appears whole or not at all.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    write_page(path, render(fit, cones, told))


def render(fit: TimedFit, cones: Sequence[ConePrediction], told: Sequence[str]) -> str:
    """The page as text."""
    import jinja2

    every = [*fit.tests, *fit.predicted]
    figures = [
        ("Relaxation", picture(_relaxation(every)), "Stress over time in the holds: means of the rows, and the model."),
        ("Stress against stretch", picture(_loops(every)), "Loops measured (markers) and modelled (lines)."),
        ("Residuals", picture(_residuals(every)), "Measured less modelled stress over the largest, against time."),
    ]
    if fit.spectrum.branches:
        words = "Branches with 95 % limits, and the loss factor at small strain that follows from them."
        figures.append(("Spectrum", picture(over_time(fit.spectrum)), words))
    if cones:
        words = "Force of the cone, measured (markers) and as the sheet predicts it (lines)."
        figures.append(("The cone from the sheet", picture(_cones(cones)), words))
    tables = [_quantities(fit), _branches(fit), _tests(fit), _counts(fit), *([_predicted(cones)] if cones else [])]
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(TEMPLATE).render(
        title="Homogeneous tests over time",
        fit=fit,
        tables=[one for one in tables if one["rows"]],
        badges={**BADGES, "not identifiable from this data": "bad", "bounded": "fair", "outside the window": "bad"},
        figures=figures,
        told_against=[word for word in fit.warnings if word not in fit.spectrum.sentences],
        told=told,
    )


def _quantities(fit: TimedFit) -> dict[str, Any]:
    shown: dict[str, Quantity] = {**fit.quantities, "G at once": fit.spectrum.instant}
    rows = []
    for name, one in shown.items():
        factor, unit = (1e-3, "kPa") if one.unit == "Pa" else (1.0, "")
        value, uncertainty = stated(one.value * factor, one.uncertainty * factor)
        shares = ", ".join(f"{part} {one.share(part):.0%}" for part in one.budget if one.share(part) >= 0.01)
        rows.append((name, f"{value} {unit}".strip(), uncertainty, percent(one.relative), shares, one.verdict))
    names = ("quantity", "value", "standard uncertainty", "relative", "from", "verdict")
    return {"title": "Identified", "names": names, "rows": rows, "caption": ""}


def _branches(fit: TimedFit) -> dict[str, Any]:
    rows = []
    for one in fit.spectrum.branches:
        ratio, error = rounded(one.ratio, one.ratio_uncertainty)
        limits, alone = f"{one.times[0]:.3g} to {one.times[1]:.3g}", f"{one.ratio_alone:.2g}"
        rows.append((f"{one.time:.3g}", limits, ratio, error, alone, one.verdict))
    low, high = fit.spectrum.window
    return {
        "title": "Branches",
        "names": (
            "time / s",
            "95 % limits / s",
            "ratio",
            "standard uncertainty",
            "if no further branch hides",
            "verdict",
        ),
        "rows": rows,
        "caption": f"Relaxation times from {low:.2g} s to {high:.3g} s can show in these tests.",
    }


def _tests(fit: TimedFit) -> dict[str, Any]:
    rows = [
        (
            one.name,
            role,
            f"{one.r_squared:.5f}" if one.r_squared > -10.0 else "< -10",
            f"{one.rms / 1e3:.3g} kPa",
            f"{one.rms / one.largest:.2%}",
            f"{float(np.sqrt(np.mean(one.deviation**2))) / 1e3:.3g} kPa",
        )
        for role, tests in (("fitted", fit.tests), ("predicted", fit.predicted))
        for one in tests
    ]
    names = ("test", "role", "R^2", "residual", "over the largest", "noise of the means")
    caption = (
        f"Reduced chi-square {fit.reduced_chi_square:.3g}; steps of time err by {fit.numerical:.1e} of the largest."
    )
    return {"title": "Tests", "names": names, "rows": rows, "caption": caption}


def _counts(fit: TimedFit) -> dict[str, Any]:
    rows = [one.words for one in fit.spectrum.counts]
    caption = "Each branch must lower AICc by 7 and predict what is left out no worse."
    return {
        "title": "How many branches",
        "names": ("branches", "AICc over the least", "left out / noise", "worst part / expected"),
        "rows": rows,
        "caption": caption,
    }


def _predicted(cones: Sequence[ConePrediction]) -> dict[str, Any]:
    rows = [
        (
            one.run,
            f"{one.rms:.2%}",
            f"{one.factor:.4f}",
            f"{one.uncertainty:.2g}",
            "yes" if one.agrees else "no",
            f"{one.rms_scaled:.2%}",
        )
        for one in cones
    ]
    names = (
        "run",
        "difference over the peak",
        "measured / predicted",
        "standard uncertainty",
        "agrees",
        "after factor",
    )
    caption = (
        "The uncertainty is that of the sheet's stiffness and of what is stated of the cone; the rest is the law's."
    )
    return {"title": "The cone from the sheet", "names": names, "rows": rows, "caption": caption}


def _relaxation(traces: Sequence[SheetTrace]) -> str:
    def draw(figure: Any) -> None:
        axes = figure.subplots()
        drawn = 0
        for trace in traces:
            for k in np.unique(trace.segment):
                rows = np.flatnonzero((trace.segment == k) & ~trace.moving[trace.segment])
                if rows.size < 4 or drawn == 2 * len(STYLES):
                    continue
                since = trace.time[rows] - trace.time[rows[0]] + 0.5 * (trace.time[rows[1]] - trace.time[rows[0]])
                colour, marker, dash = STYLES[drawn % len(STYLES)]
                axes.plot(since, trace.measured[rows] / 1e3, marker, ms=3, mfc="white", color=colour)
                label = f"{trace.name}, stretch {trace.stretch[rows[-1]]:.3g}"
                axes.plot(since, trace.model[rows] / 1e3, color=colour, ls=dash, lw=1.5, label=label)
                drawn += 1
        axes.set_xscale("log")
        axes.set_xlabel("time since the sheet stood still / s")
        axes.set_ylabel("nominal stress / kPa")
        if drawn:
            axes.legend(fontsize="small")

    return svg(draw, width=7.2, height=3.6)


def _loops(traces: Sequence[SheetTrace]) -> str:
    kinds = sorted({one.kind for one in traces})

    def draw(figure: Any) -> None:
        for ax, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
            for k, one in enumerate(trace for trace in traces if trace.kind == kind):
                colour, marker, dash = STYLES[k % len(STYLES)]
                ax.plot(one.stretch, one.measured / 1e3, marker, ms=2.5, mfc="white", mew=0.7, color=colour)
                ax.plot(one.stretch, one.model / 1e3, color=colour, ls=dash, lw=1.2, label=one.name)
                ax.plot(one.stretch, one.relaxed / 1e3, color="0.6", lw=0.8)
            ax.set_title(f"{kind} (grey: relaxed)")
            ax.set_xlabel("stretch")
            ax.legend(fontsize="small")

    return svg(draw, width=4.6 * max(1.3, len(kinds)), height=3.6)


def _residuals(traces: Sequence[SheetTrace]) -> str:
    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for k, one in enumerate(traces):
            colour, marker, _ = STYLES[k % len(STYLES)]
            off = 100.0 * (one.measured - one.model) / one.largest
            axes.plot(one.time, off, marker, ms=2.5, mfc="white", mew=0.7, color=colour, label=one.name)
        axes.axhline(0.0, color="black", lw=0.8)
        axes.set_xlabel("time / s")
        axes.set_ylabel("residual over the largest stress / %")
        axes.legend(fontsize="small")

    return svg(draw, width=7.2, height=3.0)


def _cones(cones: Sequence[ConePrediction]) -> str:
    def draw(figure: Any) -> None:
        for ax, one in zip(figure.subplots(1, len(cones), squeeze=False)[0], cones, strict=True):
            ax.plot(1e3 * one.h, one.measured, ".", ms=3, color="#0072B2")
            ax.plot(1e3 * one.h, one.model, "-", lw=0.9, color="#D55E00")
            ax.set_title(one.run, fontsize="small")
            ax.set_xlabel("displacement h / mm")
        figure.axes[0].set_ylabel("force / N")

    return svg(draw, width=4.6 * max(1.3, len(cones)), height=3.4)
