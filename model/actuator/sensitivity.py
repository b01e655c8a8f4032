"""How stroke, work and voltage of an actuator change with its design and its material.

Rest and end of a stroke are roots: of ``F - B`` without voltage, and of ``F - B`` together with the criterion that ends
the stroke. Their derivatives follow from the solver's derivatives of the force; only the criterion's (a largest field
or stress) is differenced, all of it in one batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.actuator.bias import Mass, Spring, forces
from model.actuator.design import Point, SameFilm, Treatment
from model.actuator.equilibrium import Balance, balance, films_of, solve_films, weigh
from model.actuator.stroke import Criteria, Limit, Strokes, quadrature, strokes
from model.arrays import Array
from model.membrane.solve import Solutions, solve_many
from model.specimen import Specimen

STEP = 1e-5  # relative, of the differences of the criterion
TOLERANCE = 1e-9  # of the states they are taken from

FILM = {"radius_ratio": "disk_radius", "prestretch": "prestretch", "thickness": "thickness"}
BIAS = {"preload": Spring, "stiffness": Spring, "weight": Mass, "spacer": SameFilm}


def read(point: Point, name: str) -> float:
    """The value of a design variable or material parameter ("mu1", "alpha2", "eps_r") of a point, SI.

    Raises
    ------
    ValueError : the point has no such quantity
    """
    if name == "radius_ratio":
        return point.film.disk_radius / point.film.ring_radius
    if name in FILM:
        return float(getattr(point.film, name))
    if name in BIAS:
        if not isinstance(point.recipe, BIAS[name]):
            raise ValueError(f"{name} is no quantity of a {type(point.recipe).__name__.lower()}")
        return float(getattr(point.recipe, name))
    material = point.film.material
    if name == "eps_r":
        return material.eps_r
    if name not in material.values:
        known = ", ".join((*FILM, *BIAS, "radius_ratio", "eps_r", *material.values))
        raise ValueError(f"{name!r} is no quantity of the actuator; known are {known}")
    return material.values[name]


def changed(point: Point, values: dict[str, float]) -> Point:
    """The point with other values of some quantities."""
    for name, value in values.items():
        film, recipe = point.film, point.recipe
        read(point, name)
        if name == "radius_ratio":
            film = replace(film, disk_radius=value * film.ring_radius)
        elif name in FILM:
            attribute: dict[str, Any] = {name: value}
            film = replace(film, **attribute)
        elif name in BIAS:
            recipe = replace(recipe, **{name: value})  # type: ignore[type-var]
        else:
            film = film.with_material(film.material.with_value(name, value))
        point = replace(point, film=film, recipe=recipe)
    return point


def _of_film(film: Specimen, found: Solutions, name: str) -> Array:
    """dF/d(name) of solved states of one film."""
    assert found.dforce is not None
    if name == "radius_ratio":
        return found.dforce["disk_radius"] * film.ring_radius
    if name in BIAS:
        return np.zeros(found.shape)
    if name in FILM or name == "eps_r":
        return found.dforce[name]
    at = list(film.material.values).index(name)
    moduli = len(film.material.mu)
    return np.asarray(found.dforce["mu"][..., at] if at < moduli else found.dforce["alpha"][..., at - moduli])


def _of_bias(point: Point, h: Array, name: str) -> Array:
    """dB/d(name) at ``h``."""
    recipe = point.recipe
    if isinstance(recipe, SameFilm):
        found = solve_many(
            point.film,
            recipe.spacer - h,
            recipe.voltage,
            tolerance=TOLERANCE,
            wrinkling=point.treatment.wrinkling,
            sensitivities=True,
        )
        assert found.dforce is not None
        return found.dforce["h"] if name == "spacer" else _of_film(point.film, found, name)
    if name in ("preload", "weight"):
        return np.ones(h.shape)
    if name == "stiffness":
        return -h
    return np.zeros(h.shape)


@dataclass(frozen=True)
class Gradient:
    """Derivatives of a point's stroke (m), work (J) and end voltage (V), by name; NaN where no criterion ends it."""

    stroke: dict[str, float]
    work: dict[str, float]
    voltage: dict[str, float]


def end_criteria(point: Point) -> Criteria:
    """What ends the stroke of a point: tension too, in the treatment of that name."""
    return replace(point.criteria, tension=True) if point.treatment is Treatment.TENSION else point.criteria


def strokes_of(points: Sequence[Point], tolerance: float = 1e-8) -> Strokes:
    """Strokes of points that share treatment and criteria."""
    first = points[0]
    return strokes(
        [point.actuator for point in points],
        end_criteria(first),
        tolerance=tolerance,
        folds_at_work=first.treatment.at_work,
    )


def gradient(point: Point, found: Strokes, index: int, names: Sequence[str]) -> Gradient:
    """Derivatives of stroke ``index`` of ``found``, which belongs to ``point``."""
    rest, reached, voltage = (float(getattr(found, name)[index]) for name in ("rest", "reached", "voltage"))
    nothing = dict.fromkeys(names, float("nan"))
    if found.limit[index] > Limit.VOLTAGE or not reached > rest:
        return Gradient(nothing, nothing, nothing)
    actuator = point.actuator
    one = np.array([rest, reached])[None]
    there = balance([actuator], one, np.array([[0.0, voltage]]), TOLERANCE)
    push = [_of_bias(point, one[0], name) for name in names]
    misfit = np.stack([_of_film(point.film, there.film, name)[0] - p for name, p in zip(names, push, strict=True)])
    rest_by = -misfit[:, 0] / there.stiffness[0, 0]
    by_h, by_voltage, by_names = _criterion(point, reached, voltage, names)
    matrix = np.array([[there.stiffness[0, 1], there.by_voltage[0, 1]], [by_h, by_voltage]])
    reached_by, voltage_by = np.linalg.solve(matrix, -np.stack([misfit[:, 1], by_names]))

    nodes, weights, _ = quadrature()
    h = rest + (reached - rest) * nodes
    way = _work_states(point, h, voltage)
    length = reached - rest
    by_volt = -length * float(np.nan_to_num(way.by_voltage[0]) @ weights)
    work_by = []
    for k, name in enumerate(names):
        rates = _of_bias(point, h, name) - np.nan_to_num(_of_film(point.film, way.film, name)[0])
        work_by.append(
            length * float(rates @ weights) + by_volt * float(voltage_by[k]) + float(way.excess[0, 0] * rest_by[k])
        )
    return Gradient(
        stroke=dict(zip(names, (reached_by - rest_by).tolist(), strict=True)),
        work=dict(zip(names, work_by, strict=True)),
        voltage=dict(zip(names, voltage_by.tolist(), strict=True)),
    )


def _work_states(point: Point, h: Array, voltage: float) -> Balance:
    actuator = point.actuator
    volts = np.full((1, h.size), voltage)
    films = films_of([actuator], h[None])
    film = solve_films(films, h[None], volts, point.treatment.at_work, TOLERANCE)
    return weigh(h[None], volts, film, *forces([actuator.bias], h[None]))


def _criterion(point: Point, h: float, voltage: float, names: Sequence[str]) -> tuple[float, float, Array]:
    """Derivatives of the criterion's value with respect to displacement, voltage and ``names``: central differences."""
    criteria = end_criteria(point)
    films, heights, volts, widths = [], [], [], []

    def add(make: Callable[[float], tuple[Specimen, float, float]], size: float) -> None:
        for sign in (1.0, -1.0):
            film, x, v = make(sign * size)
            films.append(film)
            heights.append(x)
            volts.append(v)
        widths.append(2.0 * size)

    add(lambda d: (point.film, h + d, voltage), STEP * h)
    add(lambda d: (point.film, h, voltage + d), STEP * voltage)
    for name in names:
        value = read(point, name)
        size = STEP * abs(value)
        add(lambda d, name=name, value=value: (changed(point, {name: value + d}).film, h, voltage), size)  # type: ignore[misc]
    found = solve_many(films, np.array(heights), np.array(volts), tolerance=1e-11, wrinkling=point.treatment.wrinkling)
    shear = np.array([film.material.shear_modulus for film in films])
    excess, _ = criteria.excess(found, np.array(volts), shear)
    rates = (excess[::2] - excess[1::2]) / np.array(widths)
    return float(rates[0]), float(rates[1]), rates[2:]
