"""Figures of the report, as SVG text: readable on paper and without colour vision."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.agreement import Charged
from calibration.film.curve import Curve
from calibration.film.identify import secant_modulus
from calibration.film.reduction import Selection, reference_voltage
from calibration.film.result import Identification
from model.material.materials import Material
from model.membrane.solve import solve_many

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

# Okabe & Ito's colours that can be told apart with any colour vision, and a marker and a dash for black and white.
STYLES = (
    ("#0072B2", "o", "-"),
    ("#D55E00", "s", "--"),
    ("#009E73", "^", "-."),
    ("#CC79A7", "D", ":"),
    ("#E69F00", "v", (0, (5, 1, 1, 1, 1, 1))),
    ("#56B4E9", "P", (0, (1, 1))),
)
BINS = 24
COMPLIANCE_ROUNDS = 3  # rounds after which force and giving way agree; each is off by a few per cent of the one before
RC: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "svg.hashsalt": "dea-rig",
    "savefig.dpi": 200,
}


def by_specimen(curves: Sequence[Curve]) -> dict[str, list[int]]:
    """Indexes of the curves of every specimen, by a title that says which it is."""
    groups: dict[str, list[int]] = {}
    for index, curve in enumerate(curves):
        s = curve.specimen
        title = (
            f"{s.name or 'specimen'}\na = {s.disk_radius * 1e3:g} mm, b = {s.ring_radius * 1e3:g} mm, "
            f"T = {s.thickness * 1e6:g} µm, λp = {s.prestretch:g}"
        )
        groups.setdefault(title, []).append(index)
    return groups


def model_force(identification: Identification, curve: Curve, h: Array, voltage: float) -> Array:
    """Force (N) that the identified film gives at measured displacements ``h`` (m), where the disk stands still.

    The errors of the rig that were found are in it: a rig that gives way holds the disk back by compliance times force.
    """
    found = {name: zero.value for name, zero in identification.nuisance.items()}
    film = curve.specimen.with_material(identification.material)
    place = h + found.get(f"displacement zero of {curve.run}", 0.0)
    gives = found.get("compliance of the rig", 0.0) if curve.compliance_uncertainty > 0.0 else 0.0
    force: Array = solve_many(film, place, voltage, wrinkling=identification.wrinkling).force
    for _ in range(COMPLIANCE_ROUNDS if gives else 0):
        force = solve_many(film, place - gives * force, voltage, wrinkling=identification.wrinkling).force
    return force + found.get(f"force zero of {curve.run}", 0.0)


def residual_force(identification: Identification, curve: Curve, selection: Selection) -> tuple[Array, Array]:
    """Displacement (m) of the used samples and their force minus the model's (N), the lag found taken off."""
    used = selection.used
    grid = np.linspace(selection.low, selection.high, 200)
    force = model_force(identification, curve, grid, reference_voltage(curve, used))
    h, lag = curve.place[used], identification.nuisance.get(f"lag of {curve.run}")
    late = 0.0 if lag is None else lag.value * curve.velocity[used] * np.interp(h, grid, np.gradient(force, grid))
    return h, curve.force[used] - np.interp(h, grid, force) + late


def force_displacement(identification: Identification, curves: Sequence[Curve], selections: Sequence[Selection]) -> str:
    """The paper's figure 4: one panel a specimen, measured and modelled force at every voltage."""
    groups = by_specimen(curves)
    styles = _styles(curves)

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for number, (ax, (title, members)) in enumerate(zip(axes, groups.items(), strict=True)):
            drawn = set()
            for index in members:
                curve, selection = curves[index], selections[index]
                colour, marker, dash = styles[abs(curve.nominal_voltage)]
                used, left = selection.used, ~selection.used
                ax.plot(
                    curve.h[used] * 1e3, curve.force[used], ".", color=colour, ms=1.2, alpha=0.3, mew=0, rasterized=True
                )
                ax.plot(curve.h[left] * 1e3, curve.force[left], "x", color="#999999", ms=3, mew=0.6, rasterized=True)
                for direction, fill in ((1, colour), (0, colour), (-1, "white")):
                    rows = selection.used & (curve.direction == direction)
                    h, force, _ = _binned(curve.h[rows], curve.force[rows])
                    ax.plot(h * 1e3, force, marker, ms=4, mfc=fill, mec=colour, mew=0.9, ls="none", zorder=3)
                key = (curve.run, curve.nominal_voltage)
                if key not in drawn and selection.used.any():
                    drawn.add(key)
                    grid = np.linspace(selection.low, selection.high, 120)
                    force = model_force(identification, curve, grid, reference_voltage(curve, selection.used))
                    ax.plot(grid * 1e3, force, color=colour, ls=dash, lw=1.6, zorder=4)
            ax.set_title(f"({chr(97 + number)}) {title}")
            ax.set_xlabel("displacement h / mm")
        axes[0].set_ylabel("force F / N")
        axes[0].legend(handles=_legend(styles), loc="upper left")

    return svg(draw, width=4.2 * len(groups) if len(groups) > 1 else 5.4, height=3.7)


def residuals(identification: Identification, curves: Sequence[Curve], selections: Sequence[Selection]) -> str:
    """Measured minus modelled force against displacement, lags taken off, one panel a specimen and voltage."""
    groups = by_specimen(curves)
    voltages = sorted({abs(curve.nominal_voltage) for curve in curves})
    styles = _styles(curves)

    def draw(figure: Any) -> None:
        axes = figure.subplots(len(voltages), len(groups), sharex="col", sharey=True, squeeze=False)
        largest = 0.0
        for column, members in enumerate(groups.values()):
            for row, voltage in enumerate(voltages):
                ax = axes[row, column]
                for index in members:
                    if abs(curves[index].nominal_voltage) == voltage and selections[index].used.any():
                        panel = (ax, identification, curves[index], selections[index], styles[voltage])
                        largest = max(largest, _residual_panel(*panel))
                ax.axhline(0.0, color="black", lw=0.8, zorder=2)
                ax.set_title(f"{list(groups)[column].splitlines()[0]}, {voltage:g} V")
        for ax in axes[-1]:
            ax.set_xlabel("displacement h / mm")
        for ax in axes[:, 0]:
            ax.set_ylabel("residual / mN")
        axes[0, 0].set_ylim(-1.15 * largest, 1.15 * largest)
        figure.align_ylabels()

    return svg(draw, width=4.2 * max(len(groups), 1.3), height=0.7 + 1.75 * len(voltages))


def stiffness(identification: Identification, truth: Material | None) -> str:
    """Secant shear modulus against stretch, and its 95 % band enlarged."""
    curve = identification.stiffness_curve
    stretch, value = np.array(curve.meridional_stretch), np.array(curve.secant_modulus)
    band = 196.0 * np.array(curve.uncertainty) / value
    at, best = identification.stretch[0], identification.quantities["stiffness"]
    hidden = None if truth is None else np.array([secant_modulus(truth, float(s), curve.hoop_stretch) for s in stretch])

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        left.plot(stretch, value * 1e-3, color="#0072B2", lw=1.6, label="identified")
        right.fill_between(stretch, -band, band, color="#56B4E9", alpha=0.4, lw=0, label="95 % interval")
        right.axhline(0.0, color="#0072B2", lw=1.6)
        if hidden is not None:
            left.plot(stretch, hidden * 1e-3, color="black", lw=1.2, ls="--", label="truth of the simulation")
            right.plot(stretch, 100.0 * (hidden / value - 1.0), color="black", lw=1.2, ls="--")
        left.plot(at, best.value * 1e-3, "o", color="#D55E00", ms=5, label=f"best determined, at {at:.2f}")
        right.errorbar(at, 0.0, 196.0 * best.relative, fmt="o", color="#D55E00", ms=5, capsize=3)
        reach = min(20.0, 4.0 * float(np.median(band)))
        right.set_ylim(-reach, reach)
        left.set_title("(a) identified stiffness")
        right.set_title("(b) difference from it")
        left.set_ylabel("secant shear modulus / kPa")
        right.set_ylabel("difference / %")
        for ax in (left, right):
            ax.set_xlabel(f"meridional stretch $\\lambda_1$ (hoop stretch {curve.hoop_stretch:.3g})")
            ax.legend(loc="upper left")

    return svg(draw, width=8.4, height=3.2)


def capacitance(found: Charged) -> str:
    """Measured and modelled d(CV)/dV of film and cable over the displacement, and their difference below."""

    def draw(figure: Any) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        order = np.argsort([one.h for one in found.capacitances])
        places = [found.capacitances[k] for k in order]
        h = np.array([one.h for one in places]) * 1e3
        measured, fitted, error = (
            np.array([getattr(one, name) for one in places]) * 1e12
            for name in ("measured", "fitted", "standard_uncertainty")
        )
        colour, marker, _ = STYLES[0]
        upper.plot(h, fitted, "--", color=STYLES[1][0], marker="x", ms=5, lw=1.2, label="force and charge together")
        upper.errorbar(h, measured, error, fmt=marker, color=colour, ms=4, capsize=2, lw=0.9, label="measured")
        upper.set_ylabel("d(CV)/dV / pF")
        upper.legend(loc="upper left")
        lower.axhline(0.0, color="#777777", lw=0.8)
        lower.errorbar(
            h, 100.0 * (measured / fitted - 1.0), 100.0 * error / fitted, fmt=marker, color=colour, ms=4, capsize=2,
            lw=0.9,
        )  # fmt: skip
        lower.set_ylabel("measured less fit / %")
        lower.set_xlabel("displacement h / mm")

    return svg(draw, width=5.4, height=4.2)


def _styles(curves: Sequence[Curve]) -> dict[float, tuple[str, str, Any]]:
    voltages = sorted({abs(curve.nominal_voltage) for curve in curves})
    return {voltage: STYLES[k % len(STYLES)] for k, voltage in enumerate(voltages)}


def _binned(h: Array, y: Array) -> tuple[Array, Array, Array]:
    """Means of ``h`` and ``y`` in bins of equal width, and the standard error of the latter."""
    if h.size == 0:
        return h, y, y
    edges = np.linspace(h.min(), np.nextafter(h.max(), np.inf), BINS + 1)
    which = np.clip(np.searchsorted(edges, h, side="right") - 1, 0, BINS - 1)
    count = np.bincount(which, minlength=BINS)
    filled = count > 0
    mean_h = np.bincount(which, h, BINS)[filled] / count[filled]
    mean_y = np.bincount(which, y, BINS)[filled] / count[filled]
    square = np.bincount(which, y**2, BINS)[filled] / count[filled]
    error = np.sqrt(np.maximum(square - mean_y**2, 0.0) / np.maximum(count[filled] - 1, 1))
    return mean_h, mean_y, error


def _residual_panel(
    ax: Axes, identification: Identification, curve: Curve, selection: Selection, style: tuple[str, str, Any]
) -> float:
    """Draw the bin means of one curve's residuals; the largest of them (mN), two standard errors included."""
    colour, marker, _ = style
    used = selection.used
    h, residual = residual_force(identification, curve, selection)
    residual *= 1e3
    largest = 0.0
    for direction, fill, side in ((1, colour, -1.0), (0, colour, 0.0), (-1, "white", 1.0)):
        rows = curve.direction[used] == direction
        at, mean, error = _binned(h[rows], residual[rows])
        if at.size:
            place = 1e3 * (at + 0.004 * side * (selection.high - selection.low))  # side by side, not on top
            ax.errorbar(place, mean, 2 * error, fmt=marker, ms=3.5, mfc=fill, mec=colour, ecolor=colour, elinewidth=0.9)
            largest = max(largest, float((np.abs(mean) + 2 * error).max()))
    return largest


def _legend(styles: dict[float, tuple[str, str, Any]]) -> list[Any]:
    handles = [
        _line(color=colour, marker=marker, ls=dash, ms=4, lw=1.6, label=f"{voltage:g} V")
        for voltage, (colour, marker, dash) in styles.items()
    ]
    handles.append(_line(color="#555555", marker="o", ls="none", ms=4, label="measured, loading (mean)"))
    handles.append(_line(color="#555555", marker="o", mfc="white", ls="none", ms=4, label="measured, unloading (mean)"))
    handles.append(_line(color="#555555", lw=1.6, label="model"))
    handles.append(_line(color="#999999", marker="x", ls="none", ms=4, label="left out"))
    return handles


def _line(**style: Any) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], **style)


def svg(draw: Any, *, width: float, height: float) -> str:
    """Make a figure of the given size (inches), and return it as SVG text that is the same each time."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()
