"""Pictures of design studies: PNG and SVG, readable at the width of a page and without colour vision."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.report.figures import RC, STYLES
from model.actuator.design import Row
from rig.design.claims import CASES, NAMES, PRINTED, value

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rig.design.run import Boundary

Array = NDArray[np.float64]
LABELS = {"stroke": "normalized stroke d*", "work": "work / mJ"}
SCALES = {"stroke": 1.0, "work": 1e3}


@contextmanager
def drawing(path: Path, rows: int, columns: int, width: float, height: float, **options: Any) -> Iterator[Any]:
    """Axes (rows, columns) to draw on; written as ``path`` with .png and .svg when done."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    with matplotlib.rc_context(RC):
        figure, axes = pyplot.subplots(
            rows, columns, figsize=(width, height), layout="constrained", squeeze=False, **options
        )
        try:
            yield axes
            buffer = BytesIO()
            figure.savefig(buffer, dpi=150, facecolor="white")
            # A palette keeps these few-coloured pictures small.
            Image.open(buffer).convert("RGB").quantize(96).save(path.with_suffix(".png"), optimize=True)
            figure.savefig(path.with_suffix(".svg"), facecolor="white", metadata={"Date": None})
        finally:
            pyplot.close(figure)


def lines(axes: Axes, named: dict[str, tuple[Array, Array]], x_label: str, y_label: str) -> None:
    """Lines by name, each with its own x and y."""
    for (name, (x, y)), (colour, _, dash) in zip(named.items(), _looks(), strict=False):
        axes.plot(x, y, color=colour, linestyle=dash, linewidth=1.5, label=name)
    axes.set(xlabel=x_label, ylabel=y_label)


def _looks() -> Iterator[tuple[str, str, Any]]:
    """The project's styles, and then again with other dashes."""
    for turn in range(4):
        for i, (colour, marker, _) in enumerate(STYLES):
            yield colour, marker, STYLES[(i + turn) % len(STYLES)][2]


def strokes_and_work(rows: Sequence[Row], quantity: str, title: str, path: Path) -> None:
    """Over a/b, a line a pre-stretch, a row of panels a case and a column a treatment; dots are the largest values."""
    cases = [case for case in CASES if any(row.case == case for row in rows)]
    treatments = [t for t in NAMES if any(row.treatment == t for row in rows)]
    prestretches = sorted({row.prestretch for row in rows})
    scale = SCALES[quantity]
    with drawing(
        path,
        len(cases),
        len(treatments),
        2.6 * len(treatments) + 1.0,
        2.1 * len(cases) + 0.8,
        sharex=True,
        sharey="row",
    ) as panels:
        for i, case in enumerate(cases):
            for j, treatment in enumerate(treatments):
                axes = panels[i, j]
                for lp, (colour, marker, dash) in zip(prestretches, _looks(), strict=False):
                    mine = [r for r in rows if (r.case, r.treatment, r.prestretch) == (case, treatment, lp)]
                    x = np.array([row.radius_ratio for row in mine])
                    y = scale * np.array([value(row, quantity) for row in mine])
                    folded = np.array([row.status == "WRINKLED" for row in mine], dtype=bool)  # of none, too
                    axes.plot(x, y, color=colour, linestyle=dash, linewidth=1.4, label=f"λp = {lp:g}")
                    for some, face in ((~folded, colour), (folded, "white")):
                        axes.plot(x[some], y[some], marker, color=colour, markerfacecolor=face, markersize=4)
                for printed in PRINTED:
                    if (printed.case, printed.quantity, printed.times) != (case, quantity, 1) or printed.value is None:
                        continue
                    axes.plot(printed.radius_ratio, scale * printed.value, "*", color="black", markersize=9)
                if i == 0:
                    axes.set_title(NAMES[treatment])
                if i == len(cases) - 1:
                    axes.set_xlabel("radius ratio a/b")
                if j == 0:
                    axes.set_ylabel(f"{case}: {CASES[case]}\n{LABELS[quantity]}")
                axes.set_ylim(bottom=0.0)
        figure = panels[0, 0].figure
        figure.suptitle(f"{title}. Open marks: hoop tension is lost. Stars: largest values printed", fontsize=9.5)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def peaks(rows: Sequence[Row], title: str, path: Path) -> None:
    """Stroke and work over a/b without pre-stretch: a panel a treatment, a line a case (figure 8)."""
    treatments = [t for t in NAMES if any(row.treatment == t for row in rows)]
    with drawing(path, 2, len(treatments), 2.6 * len(treatments) + 1.0, 5.2, sharex=True, sharey="row") as panels:
        for i, quantity in enumerate(("stroke", "work")):
            scale = SCALES[quantity]
            for j, treatment in enumerate(treatments):
                axes = panels[i, j]
                for case, (colour, marker, dash) in zip(CASES, STYLES, strict=False):
                    mine = [row for row in rows if (row.case, row.treatment) == (case, treatment)]
                    x = np.array([row.radius_ratio for row in mine])
                    y = scale * np.array([value(row, quantity) for row in mine])
                    folded = np.array([row.status == "WRINKLED" for row in mine], dtype=bool)  # of none, too
                    axes.plot(x, y, color=colour, linestyle=dash, linewidth=1.5, label=f"{case}: {CASES[case]}")
                    for some, face in ((~folded, colour), (folded, "white")):
                        axes.plot(x[some], y[some], marker, color=colour, markerfacecolor=face, markersize=4.5)
                    for printed in PRINTED:
                        if (printed.case, printed.quantity, printed.times) != (case, quantity, 1) or not printed.value:
                            continue
                        axes.plot(printed.radius_ratio, scale * printed.value, "*", color=colour, markersize=11)
                if i == 0:
                    axes.set_title(NAMES[treatment])
                else:
                    axes.set_xlabel("radius ratio a/b")
                if j == 0:
                    axes.set_ylabel(LABELS[quantity])
                axes.set_ylim(bottom=0.0)
        figure = panels[0, 0].figure
        figure.suptitle(f"{title}. Open marks: hoop tension is lost. Stars: peaks that the paper prints", fontsize=9.5)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def boundary(found: Boundary, title: str, path: Path) -> None:
    """Film curves, bias line and breakdown boundary; a star where a film curve meets the boundary (figure S2)."""
    with drawing(path, 1, 1, 6.0, 4.2) as panels:
        axes = panels[0, 0]
        h = 1e3 * found.h
        shades = np.linspace(0.75, 0.1, len(found.voltages))
        for voltage, force, shade in zip(found.voltages, found.force, shades, strict=True):
            axes.plot(h, force, color=(shade, shade, shade), linewidth=1.2)
            known = np.flatnonzero(np.isfinite(force) & (force < 1.04 * np.nanmax(found.bias)))
            if known.size:
                axes.annotate(
                    f" {voltage:g} V",
                    (h[known[-1]], force[known[-1]]),
                    color=(shade, shade, shade),
                    fontsize=7.5,
                    va="center",
                )
        axes.plot(h, found.breakdown_force, color="#D55E00", linestyle="--", linewidth=1.8, label="breakdown boundary")
        for i, (at, force) in enumerate(found.stars):
            axes.plot(1e3 * at, force, "*", color="#D55E00", markersize=10, label="breakdown" if i == 0 else None)
        axes.plot(h, found.bias, color="#009E73", linewidth=1.8, label="bias")
        s = found.found
        for at, face, name in ((s.rest[0], "white", "rest"), (s.reached[0], "#0072B2", "end of the stroke")):
            force = np.interp(at, found.h, found.bias)
            axes.plot(1e3 * at, force, "o", color="#0072B2", markerfacecolor=face, label=name, zorder=5)
        axes.set(xlabel="displacement h / mm", ylabel="force / N", title=title)
        axes.set_ylim(0.0, 1.05 * float(np.nanmax(found.bias)))
        axes.set_xlim(0.0, 1.08 * float(h[-1]))
        axes.legend(loc="upper center")
