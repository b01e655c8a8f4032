"""Optimisation studies: the task from a study file and a fit, its tables, CSV rows and picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from model.actuator.design import Point, Treatment
from model.actuator.optimise import Design, Optimum, Task, Uncertain
from model.actuator.stroke import Limit
from rig.analysis.fit_file import read_fit
from rig.base.errors import ConfigError
from rig.design import pictures
from rig.design.study import VARIABLES, OptimiseStudy


def task_of(study: OptimiseStudy) -> Task:
    """The task in SI units.

    Raises
    ------
    ConfigError
        When bounds, bias and film do not go together, or the fit cannot be used.
    """
    film = study.film.film(study.disk_radius_mm, study.prestretch)
    uncertain = None
    if study.fit is not None:
        fitted = read_fit(Path(study.fit), film.material)
        uncertain = Uncertain(fitted.names, fitted.covariance, study.coverage)
        film = film.with_material(fitted.material)
    recipe = study.bias.recipes([study.case])[study.case]
    criteria = study.limits.criteria(film.material)
    point = Point(study.case, film, recipe, Treatment(study.treatment), criteria)
    try:
        return Task(point, study.vary.si(), uncertain)
    except ValueError as error:
        raise ConfigError(f"vary: {error}.") from None


def _row(kind: str, design: Design) -> dict[str, Any]:
    row: dict[str, Any] = {"kind": kind}
    for key, (name, scale) in VARIABLES.items():
        if name in design.values:
            row[key] = design.values[name] / scale
    row |= {
        "stroke_mm": 1e3 * design.stroke,
        "stroke_error_mm": 1e3 * design.stroke_error,
        "work_mJ": 1e3 * design.work,
        "voltage_V": design.voltage,
        "limit": Limit(design.limit).name,
    }
    if design.sure is not None:
        row |= {
            "sure_voltage_V": design.sure.voltage,
            "sure_stroke_mm": 1e3 * design.sure.stroke,
            "sure_work_mJ": 1e3 * design.sure.work,
        }
    return row


def rows(found: Optimum) -> list[dict[str, Any]]:
    """The best, the front, and all designs of the global start."""
    best = [_row(f"largest {name}", design) for name, design in found.best.items()]
    return best + [_row("front", one) for one in found.front] + [_row("start", one) for one in found.tried]


def table(found: Optimum) -> Table:
    """The front, from the largest work to the largest stroke."""
    result = Table(
        title="The front of stroke and work",
        caption=f"{found.solved} designs solved. None in the table is beaten by another in both stroke and work.",
    )
    shown = [_row("", one) for one in found.front]
    for heading in list(shown[0])[1:]:
        result.add_column(heading, justify="left" if heading == "limit" else "right")
    for row in shown:
        result.add_row(*(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in list(row.values())[1:]))
    return result


def draw(found: Optimum, title: str, path: Path) -> None:
    """All designs, and the front."""
    with pictures.drawing(path, 1, 1, 6.0, 4.0) as panels:
        axes = panels[0, 0]
        for some, look, name in (
            (found.tried, {"marker": "o", "linestyle": "", "color": "#bbbbbb", "markersize": 4}, "global start"),
            (found.front, {"marker": "D", "linestyle": "-", "color": "#0072B2", "markersize": 5}, "front"),
        ):
            x = [1e3 * one.counted("stroke") for one in some]
            y = [1e3 * one.counted("work") for one in some]
            axes.plot(x, y, label=name, **look)
        sure = "sure " if found.front[0].sure is not None else ""
        axes.set(xlabel=f"{sure}stroke / mm", ylabel=f"{sure}work / mJ", title=title, xlim=(0, None), ylim=(0, None))
        axes.legend()
