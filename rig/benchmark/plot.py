"""Pictures of the benchmarks."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rig.benchmark.extremes import Report as Extremes
    from rig.benchmark.fit import Report as Fits
    from rig.benchmark.solver import Report as Precision

# Colours of Okabe & Ito (2008), which colour-blind readers tell apart; one family of methods shares a colour.
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILLION, PURPLE, GREY = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
    "#999999",
)
LOOK: dict[str, tuple[str, str, str]] = {  # colour, marker, line
    "Octave ode15s shooting": (ORANGE, "s", "-"),
    "BDF shooting": (VERMILLION, "v", "-"),
    "Radau shooting": (VERMILLION, "^", "--"),
    "LSODA shooting": (SKY, "v", ":"),
    "RK45 shooting": (SKY, "^", "--"),
    "DOP853 shooting": (BLUE, "D", "-"),
    "solve_bvp in R": (GREEN, "P", "--"),
    "solve_bvp in ln R": (GREEN, "X", "-"),
    "Chebyshev in R": (PURPLE, "<", "--"),
    "Chebyshev in ln R": (PURPLE, ">", "-"),
}


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(rows, columns, figsize=(width, height), layout="constrained", **options)


def _finish(figure: Any, path: Path) -> None:
    from matplotlib import pyplot
    from PIL import Image

    buffer = BytesIO()
    figure.savefig(buffer, dpi=110)
    pyplot.close(figure)
    # A palette keeps these few-coloured pictures small.
    Image.open(buffer).convert("RGB").quantize(96).save(path, optimize=True)


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, which="major", color="#e3e3e3", linewidth=0.8)
    axes.set_axisbelow(True)


def work_precision(report: Precision, path: Path) -> None:
    """Error against time, log-log, one line a method and one panel a quantity."""
    figure, panels = _figure(13.0, 5.4, 1, 3, sharex=True, sharey=True)
    known = list(dict.fromkeys(point.method for point in report.points))
    methods = [method for method in known if method not in LOOK] + [method for method in known if method in LOOK]
    quantities = (("force", "Force"), ("field", "Peak electric field"), ("hoop", "Least hoop stress"))
    for axes, (name, title) in zip(panels, quantities, strict=True):
        for method in methods:
            points = [point for point in report.points if point.method == method]
            x = [1e3 * point.seconds.median for point in points]
            y = [max(getattr(point, name).median, 1e-15) for point in points]
            ours = method not in LOOK
            colour, marker, line = LOOK.get(method, (BLACK, "o", "-" if method == methods[0] else "--"))
            axes.plot(
                x,
                y,
                color=colour,
                marker=marker,
                linestyle=line,
                label=method,
                linewidth=2.8 if ours else 1.5,
                markersize=7.5 if ours else 5.5,
                markerfacecolor="white" if ours and line == "--" else colour,
                zorder=5 if ours else 2,
            )
        axes.set(xscale="log", yscale="log", title=title, xlabel="time per solve / ms")
        axes.set_ylim(1e-15, 1e-2)
        _tidy(axes)
    panels[0].set_ylabel("median error (stress: over shear modulus)")
    panels[2].annotate(
        "better",
        xy=(0.62, 0.80),
        xytext=(0.78, 0.92),
        xycoords="axes fraction",
        arrowprops={"arrowstyle": "->", "color": "#555555"},
        color="#555555",
    )
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False)
    figure.suptitle(
        f"Error against run time, median over {report.cases} taut films. Each mark is one tolerance of one method; "
        "black: this project"
    )
    _finish(figure, path)


def speeds(report: Precision, path: Path) -> None:
    """Time per solve at an error of 1e-6, one bar a method and way of working."""
    rows = sorted(report.speeds, key=lambda speed: -speed.seconds)
    figure, axes = _figure(10.0, 1.1 + 0.34 * len(rows))
    alone = {"cold single": ", one state"}
    for i, speed in enumerate(rows):
        amount = 1e6 * speed.seconds
        axes.barh(i, amount, color=BLUE if speed.method.startswith("dea-rig") else "#bbbbbb")
        text = f"{amount / 1000:.3g} ms" if amount >= 1000 else f"{amount:.3g} µs"
        if speed.error > 1e-6:
            text += f" (error {speed.error:.0e})"
        axes.text(amount * 1.1, i, text, va="center")
    axes.set_yticks(range(len(rows)), [f"{speed.method}{alone.get(speed.mode, '')}" for speed in rows])
    known = [1e6 * speed.seconds for speed in rows]
    axes.set(xscale="log", xlabel="time per solve / µs (logarithmic)")
    axes.set_xlim(0.4 * min(known, default=1.0), 30 * max(known, default=1.0))
    figure.suptitle("Time per solve, with nine of ten forces within 1e-6 (blue: this project)")
    _tidy(axes)
    axes.grid(False, axis="y")
    _finish(figure, path)


STATUS_LOOK: dict[str, str] = {
    "TAUT": BLUE,
    "WRINKLED": SKY,
    "SLACK": "#d9d9d9",
    "UNSTABLE": ORANGE,
    "NOT_CONVERGED": VERMILLION,
    "INVALID": "#777777",
}


def extreme_states(report: Extremes, path: Path) -> None:
    """What became of the states of every family, and how the true error compares with the estimate."""
    rows = report.rows[::-1]
    figure, (left, right) = _figure(12.5, 1.6 + 0.42 * len(rows), 1, 2, sharey=True, width_ratios=(3, 2))
    lowest = 1e-3
    for i, row in enumerate(rows):
        begin = 0.0
        for status, colour in STATUS_LOOK.items():
            share = 100.0 * row.counts.get(status, 0) / row.states
            left.barh(i, share, left=begin, color=colour, edgecolor="white", label=status if i == 0 else None)
            if share >= 6:
                dark = status in ("TAUT", "NOT_CONVERGED", "INVALID")
                left.text(
                    begin + share / 2,
                    i,
                    str(row.counts[status]),
                    ha="center",
                    va="center",
                    color="white" if dark else "black",
                    fontsize=8,
                )
            begin += share
        if row.checked:
            median, worst = max(row.median_ratio, lowest), max(row.worst_ratio, lowest)
            first = i == len(rows) - 1
            right.plot([median, worst], [i, i], color=GREY, linewidth=1.5, zorder=1)
            right.plot(median, i, "o", color=BLUE, label="median (0.001 or less on the edge)" if first else None)
            right.plot(worst, i, "D", color=VERMILLION, label="worst state" if first else None)
    left.set_yticks(range(len(rows)), [row.family for row in rows])
    left.set(xlabel="share of the states / % (numbers: states)", xlim=(0, 100))
    left.set_title("What the solver says of each state", loc="left", pad=14)
    handles, labels = left.get_legend_handles_labels()
    seen = [k for k, status in enumerate(labels) if any(row.counts.get(status) for row in rows)]
    wording = [labels[k].lower().replace("_", " ") for k in seen]
    figure.legend([handles[k] for k in seen], wording, loc="outside lower left", ncols=len(seen), frameon=False)
    right.axvline(1.0, color=BLACK, linewidth=1)
    right.axvline(10.0, color=VERMILLION, linewidth=1, linestyle="--")
    right.text(1.0, len(rows) - 0.4, "as estimated ", ha="right", va="bottom", fontsize=8)
    right.text(10.0, len(rows) - 0.4, " limit: 10", ha="left", va="bottom", color=VERMILLION, fontsize=8)
    right.set(xscale="log", xlabel="true error / estimated error of the force", ylim=(-0.6, len(rows) + 0.2))
    right.set_xlim(0.6 * lowest, max(60.0, 2 * right.get_xlim()[1]))
    right.set_title("Is the error estimate honest?", loc="left", pad=14)
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=2, frameon=False)
    total, checked = sum(row.states for row in rows), sum(row.checked for row in rows)
    figure.suptitle(f"The solver in {total} extreme states; {checked} answers judged by the reference formulation")
    _tidy(left)
    _tidy(right)
    left.grid(False, axis="y")
    _finish(figure, path)


def _decades(values: list[float]) -> tuple[float, float]:
    """Whole decades around the values: a logarithmic axis whose labels do not crowd."""
    return 10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values) * 1.01))


def _histories(axes: Axes, report: Fits) -> None:
    """Fits of a film that takes time: the largest error, over what noise leaves uncertain, against their time."""
    stated = report.histories.stated
    looks = zip(
        dict.fromkeys(row.method for row in report.histories.rows), (BLACK, SKY, VERMILLION), "o^s", strict=False
    )
    for method, colour, marker in looks:
        mine = [row for row in report.histories.rows if row.method == method]
        errors = [max(row.error[name] / one for name, one in stated.items()) for row in mine]
        axes.plot([row.seconds for row in mine], errors, color=colour, marker=marker, label=method)
    axes.set(xscale="log", yscale="log", title="A film that takes time", xlabel="time of a fit / s")
    axes.set_ylabel("largest error / uncertainty by noise")
    axes.set_xlim(*_decades([row.seconds for row in report.histories.rows]))
    axes.set_ylim(1e-3, 1.0)
    axes.legend(frameon=False, fontsize=8)
    _tidy(axes)


def fits(report: Fits, path: Path) -> None:
    """Error of the film against compute time, compute time against samples, error against the time of the rig."""
    figure, panels = _figure(15.0, 7.4, 2, 4)
    look = {"reduced, analytic Jacobian": (BLACK, "o"), "reduced, finite differences": (VERMILLION, "s")}
    titles = {"G": "Shear modulus G", "alpha": "Exponent alpha", "eps_r": "Permittivity eps_r"}
    swept = [point for point in report.points if point.samples == report.swept]
    for axes, (name, title) in zip(panels[0][:3], titles.items(), strict=True):
        for method, (colour, marker) in look.items():
            mine = [point for point in swept if point.method == method]
            x, y = [1e3 * point.seconds for point in mine], [max(point.error[name], 1e-12) for point in mine]
            axes.plot(x, y, color=colour, marker=marker, label=method)
            for point, at, error in zip(mine, x, y, strict=True):
                if point.tolerance in (1e-3, 1e-5):
                    label = f"{point.tolerance:.0e}"
                    axes.annotate(label, (at, error), xytext=(5, 4), textcoords="offset points", fontsize=8)
        axes.set(xscale="log", yscale="log", title=title, xlabel="time of a fit / ms", ylim=(1e-9, 1e-3))
        axes.set_xlim(*_decades([1e3 * point.seconds for point in swept]))
        _tidy(axes)
    panels[0][0].set_ylabel("error against finer numerics\n(marks: solver tolerance)")
    panels[0][0].legend(frameon=False)
    left = panels[0][3]
    for method, colour, marker in (
        ("reduced, analytic Jacobian", BLACK, "o"),
        ("every sample, analytic", SKY, "^"),
    ):
        mine = [point for point in report.points if point.method == method and point.samples != report.swept]
        label = {BLACK: "a few states a curve", SKY: "a state for every sample"}[colour]
        left.plot([p.samples for p in mine], [p.states for p in mine], color=colour, marker=marker, label=label)
    left.set(ylim=_decades([point.states for point in report.points]))
    left.set(xscale="log", yscale="log", title="Cost", xlabel="samples a curve", ylabel="membrane states of a fit")
    left.legend(frameon=False)
    _tidy(left)
    for axes, name in zip(panels[1][:3], titles, strict=True):
        for protocol, colour, marker in (("uniform sweep", GREY, "s"), ("planned", BLUE, "o")):
            rows = [one for one in report.rig if one.protocol == protocol]
            x = [one.duration / 60 for one in rows]
            axes.plot(x, [100 * one.error[name] for one in rows], color=colour, marker=marker, label=protocol)
            stated = [100 * one.stated[name] for one in rows]
            axes.plot(x, stated, color=colour, linestyle="--", label=f"{protocol}, as stated")
        axes.set(xscale="log", yscale="log", title=f"{titles[name]}, on the rig", xlabel="time of the rig / min")
        axes.set_ylim(*_decades([v for one in report.rig for v in (100 * one.error[name], 100 * one.stated[name])]))
        ticks = sorted({round(one.duration / 60) for one in report.rig})
        axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        axes.set_xticks([], minor=True)
        _tidy(axes)
    panels[1][0].set_ylabel("error / %, noise and zeros")
    panels[1][0].legend(frameon=False, fontsize=8)
    _histories(panels[1][3], report)
    runs = report.rig[0].runs if report.rig else 0
    figure.suptitle(
        f"Error of the identified film against time: on the computer, and on the rig ({runs} experiments each)"
    )
    _finish(figure, path)
