"""Dimensions of the specimen that are not what they are believed to be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.film.suspects.base import Context, Kind, Shape


def _dimension(field: str, name: str) -> Kind:
    def shapes(context: Context) -> Sequence[Shape]:
        size = np.array([[getattr(curve.specimen, field)] for curve in context.curves])
        return [Shape(name, context.at_nodes(context.by[field] * size))]

    remedy = "measure the " + name.split(" other")[0]
    return Kind(name, "1", 0, 0.05 if field == "thickness" else 0.01, remedy, shapes, part=PARTS[field])


def _unlike(context: Context) -> Sequence[Shape]:
    """One specimen's thickness, where the differences are not fitted along."""
    if "thickness" in context.fitted:
        return []
    films = list(dict.fromkeys(curve.specimen.with_material(context.film) for curve in context.curves))
    found = []
    for film in films[1:]:
        here = np.array([[curve.specimen.with_material(context.film) == film] for curve in context.curves])
        name = f"thickness of {film.name or 'a specimen'} unlike the other's"
        found.append(Shape(name, context.at_nodes(here * context.by["thickness"] * film.thickness)))
    return found


PARTS = {"thickness": "thickness", "prestretch": "pre-stretch", "disk_radius": "disk radius"}
PARTS |= {"ring_radius": "ring radius"}
SUSPECTS = [
    _dimension("thickness", "thickness other than stated"),
    _dimension("prestretch", "pre-stretch other than stated"),
    _dimension("disk_radius", "disk radius other than stated"),
    _dimension("ring_radius", "ring radius other than stated"),
    Kind("thickness that differs between specimens", "1", 0, 0.05, "measure the thickness of every specimen", _unlike),
]
