"""Studies carried out: numbers computed, pictures and CSV written, what to print returned."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from model.actuator import design
from model.actuator.design import Point, Row, Treatment
from model.actuator.optimise import optimise
from model.actuator.stroke import Limit, Strokes, strokes
from model.membrane.profile import Profile
from model.membrane.solve import Solution, solve, solve_many
from model.stability.limits import breakdown_voltage
from rig.base.errors import ConfigError
from rig.base.outputs import check_new
from rig.design import best, pictures
from rig.design import compare as shooting
from rig.design.claims import Claims, judge
from rig.design.hypothesis import hypothesis_rows
from rig.design.output import claim_rows, map_rows, read_csv, write_csv
from rig.design.study import BoundaryStudy, MapStudy, OptimiseStudy, ProfilesStudy, Study
from rig.design.tables import claim_tables, map_table

if TYPE_CHECKING:
    from rich.console import RenderableType

Array = NDArray[np.float64]
Progress = Callable[[float, float, str], None]
PROFILE_POINTS = 201
CURVE_POINTS = 80
# Of a map that is there already: what must be the same for it to be the map of this study.
SAME = ("case", "treatment", "disk_radius_mm", "ring_radius_mm", "thickness_um", "prestretch", "stroke_mm", "voltage_V")
QUANTITIES = {  # label, scale, attribute of a profile
    "radial_stress": ("radial stress σ1 / kPa", 1e-3, "stress_1"),
    "hoop_stress": ("hoop stress σ2 / kPa", 1e-3, "stress_2"),
    "field": ("true field E / (V/µm)", 1e-6, "field"),
}


@dataclass
class Outcome:
    """What a study gave: files, and what to show on the terminal."""

    files: list[Path] = field(default_factory=list)
    show: list[RenderableType] = field(default_factory=list)
    claims: Claims | None = None


def run_study(
    study: Study, name: str, out: Path, executor: Executor | None, progress: Progress, *, compare: bool = False
) -> Outcome:
    """Carry out a study and write ``name``.csv, .png and .svg, and what else it makes, into the folder ``out``.

    ``compare``: time the paper's method on a sample of a map too. A map that is there already is not computed again
    then: only the sample is.

    Raises
    ------
    ConfigError
        When a file is there already, or a film of the study cannot be solved.
    """
    if compare and isinstance(study, MapStudy) and (out / f"{name}.csv").exists():
        return Outcome(show=_compared_later(study, out / f"{name}.csv", progress))
    files = [out / file for file in _files(study, name)]
    out.mkdir(parents=True, exist_ok=True)
    check_new(*files)
    if isinstance(study, ProfilesStudy):
        outcome = _profiles(study, out / name, progress)
    elif isinstance(study, BoundaryStudy):
        outcome = _boundary(study, out / name, progress)
    elif isinstance(study, OptimiseStudy):
        outcome = _best(study, out / name, executor, progress)
    else:
        outcome = _map(study, out / name, executor, progress, compare)
    outcome.files = files
    return outcome


def _files(study: Study, name: str) -> list[str]:
    if isinstance(study, MapStudy):
        parts = [name] if len(study.prestretches) == 1 else [f"{name}_stroke", f"{name}_work"]
        claims = [f"{name}_claims.csv"] if study.claims else []
        return [f"{name}.csv", *claims, *(f"{part}{end}" for part in parts for end in (".png", ".svg"))]
    return [f"{name}.csv", f"{name}.png", f"{name}.svg"]


# ---- profiles: figures 5 and 6


@dataclass(frozen=True)
class Curve:
    """One film of a profiles study."""

    name: str
    solution: Solution
    profile: Profile


def profile_curves(study: ProfilesStudy) -> list[Curve]:
    """Every disk at every voltage, solved as sharply as can be: a profile errs by more than its force.

    Raises
    ------
    ConfigError
        When a film has no answer, with its status.
    """
    found = []
    for radius in study.disk_radii_mm:
        film = study.film.film(radius, study.prestretch)
        for voltage in study.voltages_V:
            state = solve(film, study.displacement_mm * 1e-3, voltage, tolerance=1e-12, wrinkling=study.wrinkling)
            name = f"a = {radius:g} mm" if len(study.disk_radii_mm) > 1 else f"V = {voltage:g} V"
            if len(study.disk_radii_mm) > 1 and len(study.voltages_V) > 1:
                name += f", {voltage:g} V"
            if not state.answered:
                raise ConfigError(f"{name}: {state.status.message} There is nothing to show.")
            found.append(Curve(name, state, state.profile(PROFILE_POINTS)))
    return found


def _profiles(study: ProfilesStudy, path: Path, progress: Progress) -> Outcome:
    progress(0.0, 1.0, "films from disk to ring")
    found = profile_curves(study)
    rows = [
        {
            "disk_radius_mm": 1e3 * curve.solution.specimen.disk_radius,
            "voltage_V": curve.solution.voltage,
            "R_mm": 1e3 * float(p.R[i]),
            "r_mm": 1e3 * float(p.r[i]),
            "z_mm": 1e3 * float(p.z[i]),
            "stretch_1": float(p.stretch_1[i]),
            "stretch_2": float(p.stretch_2[i]),
            "radial_stress_kPa": 1e-3 * float(p.stress_1[i]),
            "hoop_stress_kPa": 1e-3 * float(p.stress_2[i]),
            "field_V_per_um": 1e-6 * float(p.field[i]),
            "wrinkled": bool(p.wrinkled[i]),
            "status": curve.solution.status.name,
            "force_relative_error": curve.solution.error_estimate,
        }
        for curve in found
        for p in (curve.profile,)
        for i in range(len(p.R))
    ]
    write_csv(path.with_suffix(".csv"), rows)
    with pictures.drawing(path, 1, len(study.show), 3.6 * len(study.show) + 0.4, 3.4) as panels:
        for axes, quantity in zip(panels[0], study.show, strict=True):
            label, scale, name = QUANTITIES[quantity]
            pictures.lines(
                axes,
                {c.name: (1e3 * c.profile.r, scale * getattr(c.profile, name)) for c in found},
                "current radius r / mm",
                label,
            )
        figure = panels[0, 0].figure
        figure.suptitle(study.title or path.name, fontsize=9.5)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
    return Outcome(show=[profile_table(found)])


def profile_table(found: list[Curve]) -> RenderableType:
    """Extremes of every film of a profiles study."""
    from rich.table import Table

    table = Table(title="Extremes from disk to ring")
    for heading in ("film", "status", "force / N", "error", "peak field / (V/µm)", "at R / mm", "least hoop / kPa"):
        table.add_column(heading, justify="left" if heading in ("film", "status") else "right")
    for curve in found:
        s = curve.solution
        table.add_row(
            curve.name,
            s.status.name,
            f"{s.force:.6f}",
            f"{s.error_estimate:.0e}",
            f"{s.peak_field * 1e-6:.3f}",
            f"{s.peak_field_radius * 1e3:.2f}",
            f"{s.min_hoop_stress * 1e-3:.1f}",
        )
    return table


# ---- breakdown boundary: figure S2


@dataclass(frozen=True)
class Boundary:
    """Force against displacement at some voltages, the bias, and where the film breaks down; NaN: no answer."""

    h: Array
    voltages: list[float]
    force: Array  # (voltages, h)
    status: NDArray[np.int8]
    bias: Array
    breakdown_voltage: Array
    breakdown_force: Array
    stars: list[tuple[float, float]]  # where a film curve meets the boundary
    found: Strokes


def boundary(study: BoundaryStudy) -> Boundary:
    """The construction of the supplement: where the bias line meets the boundary the stroke ends."""
    film = study.film.film(study.disk_radius_mm, study.prestretch)
    treatment = Treatment.TENSION_FIELD if study.wrinkling == "tension_field" else Treatment.PLAIN
    recipe = study.bias.recipes([study.case])[study.case]
    criteria = study.limits.criteria(film.material)
    if criteria.field is None:
        raise ConfigError("A breakdown boundary needs a dielectric strength: give limits.field_V_per_um.")
    actuator = Point(study.case, film, recipe, treatment, criteria).actuator
    h = np.linspace(0.0, study.highest_mm * 1e-3, CURVE_POINTS + 1)[1:]
    volts = np.array(study.voltages_V)
    curves = solve_many(film, h[None, :], volts[:, None], wrinkling=study.wrinkling)
    edge = breakdown_voltage(film, h, criteria.field, wrinkling=study.wrinkling)
    stars = []
    for voltage in volts:
        gap = edge.voltage - voltage
        for i in np.flatnonzero(np.isfinite(gap[1:] * gap[:-1]) & (gap[1:] * gap[:-1] < 0.0)):
            share = gap[i] / (gap[i] - gap[i + 1])
            at = float(h[i] + share * (h[i + 1] - h[i]))
            stars.append((at, solve(film, at, float(voltage), wrinkling=study.wrinkling).force))
    return Boundary(
        h=h,
        voltages=study.voltages_V,
        force=curves.force,
        status=curves.status,
        bias=actuator.bias.force(h),
        breakdown_voltage=edge.voltage,
        breakdown_force=edge.force,
        stars=stars,
        found=strokes([actuator], criteria),
    )


def _boundary(study: BoundaryStudy, path: Path, progress: Progress) -> Outcome:
    progress(0.0, 1.0, "film curves and boundary")
    b = boundary(study)
    rows = []
    for i, h in enumerate(b.h):
        row: dict[str, Any] = {"h_mm": 1e3 * float(h)}
        row |= {f"force_at_{v:g}_V_N": float(b.force[k, i]) for k, v in enumerate(b.voltages)}
        row |= {f"status_at_{v:g}_V": int(b.status[k, i]) for k, v in enumerate(b.voltages)}
        row |= {
            "bias_N": float(b.bias[i]),
            "breakdown_voltage_V": float(b.breakdown_voltage[i]),
            "breakdown_force_N": float(b.breakdown_force[i]),
        }
        rows.append(row)
    write_csv(path.with_suffix(".csv"), rows)
    pictures.boundary(b, study.title or path.name, path)
    found = b.found
    limit = Limit(int(found.limit[0]))
    text = (
        f"rest {1e3 * found.rest[0]:.4f} mm, stroke {1e3 * found.stroke[0]:.4f} mm to "
        f"{1e3 * found.reached[0]:.4f} mm at {found.voltage[0]:.1f} V. {limit.message}"
    )
    return Outcome(show=[text])


# ---- maps: figures 7 and 8


def _map(study: MapStudy, path: Path, executor: Executor | None, progress: Progress, compare: bool) -> Outcome:
    wanted = map_points(study)
    swept = design.sweep(wanted, executor=executor, progress=lambda done, total: progress(done, total, "actuators"))
    rows = swept.rows
    write_csv(path.with_suffix(".csv"), map_rows(rows))
    title = study.title or path.name
    if len(study.prestretches) == 1:
        pictures.peaks(rows, title, path)
    else:
        for quantity in ("stroke", "work"):
            part = path.with_name(f"{path.name}_{quantity}")
            pictures.strokes_and_work(rows, quantity, title, part)
    outcome = Outcome(show=[map_table(rows)])
    if study.claims is not None:
        progress(len(rows), len(rows), "as the paper may have computed it")
        outcome.claims = judge([*rows, *hypothesis_rows(wanted)])
        write_csv(path.with_name(f"{path.name}_claims.csv"), claim_rows(outcome.claims))
        outcome.show += claim_tables(outcome.claims)
    if compare:
        chosen = [(wanted[i], rows[i]) for i in shooting.sample(wanted, [row.limit for row in rows])]
        outcome.show += _compared(chosen, len(rows), swept.seconds, progress)
    return outcome


def _compared(
    chosen: Sequence[tuple[Point, Row]], actuators: int, seconds: float, progress: Progress
) -> list[RenderableType]:
    """The sample by the paper's method, beside ours."""
    if not chosen:
        return ["No stroke of the plain equations ends in breakdown: nothing to compare with the paper's method."]
    shots = shooting.compare(chosen, lambda done, total: progress(done, total, "the paper's method"))
    return [shooting.comparison_table(shots, actuators, seconds)]


def _compared_later(study: MapStudy, csv: Path, progress: Progress) -> list[RenderableType]:
    """The comparison of a map that was computed before: only the sample is computed again, and held against it."""
    wanted = map_points(study)
    there = read_csv(csv)
    of_another = ConfigError(
        f"{csv}: it is not the map of this study. Move it away, or name another folder with --out."
    )
    if len(there) != len(wanted) or not {"limit", "stroke_mm"} <= there[0].keys():
        raise of_another
    indexes = shooting.sample(wanted, [row["limit"] for row in there])
    again = design.sweep([wanted[i] for i in indexes])
    for i, row in zip(indexes, again.rows, strict=True):
        for key, value in map_rows([row])[0].items():
            if key in SAME and not _same(there[i].get(key, ""), value):
                raise of_another
    return _compared(
        [(wanted[i], row) for i, row in zip(indexes, again.rows, strict=True)], len(indexes), again.seconds, progress
    )


def _same(text: str, value: object) -> bool:
    """Whether the cell of a map is this value, to the digits that the solver promises."""
    if not isinstance(value, float):
        return text == str(value)
    try:
        return math.isclose(float(text), value, rel_tol=1e-6)
    except ValueError:
        return False


def map_points(study: MapStudy) -> list[Point]:
    """The points of a map."""
    films = [study.film.film(a, lp) for lp in study.prestretches for a in study.disk_radii_mm]
    criteria = study.limits.criteria(study.film.known())
    return design.points(films, study.bias.recipes(study.cases), study.chosen(), criteria)


# ---- the best actuator


def _best(study: OptimiseStudy, path: Path, executor: Executor | None, progress: Progress) -> Outcome:
    found = optimise(
        best.task_of(study),
        start=study.start,
        front=study.front,
        executor=executor,
        progress=lambda share, what: progress(share, 1.0, what),
    )
    write_csv(path.with_suffix(".csv"), best.rows(found))
    best.draw(found, study.title or path.name, path)
    return Outcome(show=[best.table(found)])
