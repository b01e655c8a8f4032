"""A film that changes from sweep to sweep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.film.suspects.base import Context, Kind, Shape

NAME = "film that softens from one curve to the next"
FIRST = "film that is stiffer in the first curve than later"
KEY = "softening"
REMEDY = "measure the curve at the first voltage once more at the end"


def _order(context: Context) -> np.ndarray:
    """Number of the curve of each row in its run, from 0, in the order of time where it is known."""
    number = np.zeros((len(context.curves), 1))
    for run in dict.fromkeys(curve.run for curve in context.curves):
        mine = list({id(curve): curve for curve in context.curves if curve.run == run}.values())
        mine.sort(key=lambda curve: 0.0 if curve.time is None else float(curve.time[0]))
        places = {id(curve): k for k, curve in enumerate(mine)}
        for row, curve in enumerate(context.curves):
            if curve.run == run:
                number[row] = places[id(curve)]
    return number


def _softening(context: Context) -> Sequence[Shape]:
    order = _order(context)
    if order.max() == 0.0:
        return []
    shapes = [Shape(NAME, context.at_nodes(-context.force * order))]
    if order.max() > 1.0:
        shapes.append(Shape(FIRST, context.at_nodes(-context.force * (order > 0.0))))
    return shapes


SUSPECTS = [Kind(NAME, "1", 1, 0.03, REMEDY, _softening, key=KEY)]
