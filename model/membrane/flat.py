"""The results of many states while they are being filled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations
from model.membrane.ritz import Grid, Problem, State
from model.membrane.solution import Solutions, Status

Solved = tuple[Problem, Grid, State, Array]  # states, and their force over its unit

REAL = (
    *("force", "peak_field", "peak_field_radius", "min_hoop_stress", "min_meridional_stress", "max_stretch"),
    "error_estimate",
)
WHOLE = ("iterations", "modes")
FLAG = ("stable", "field_exceeded", "stretch_exceeded")
SLOPES = ("h", "voltage", "disk_radius", "ring_radius", "thickness", "prestretch", "eps_r")


class Flat:
    """The results while they are being filled, one entry a state."""

    def __init__(self, states: int, moduli: int, shapes: int, sensitivities: bool, keep: bool) -> None:
        self.real = dict(zip(REAL, np.full((len(REAL), states), np.nan), strict=True))
        self.whole = dict(zip(WHOLE, np.zeros((len(WHOLE), states), dtype=np.intp), strict=True))
        self.flag = dict(zip(FLAG, np.zeros((len(FLAG), states), dtype=np.bool_), strict=True))
        self.status = np.full(states, Status.INVALID, dtype=np.int8)
        self.dforce: dict[str, Array] | None = None
        self.keep = keep
        self.kept: list[tuple[NDArray[np.intp], Solved]] = []
        if sensitivities:
            self.dforce = dict(zip(SLOPES, np.full((len(SLOPES), states), np.nan), strict=True))
            self.dforce |= {"mu": np.full((states, moduli), np.nan), "alpha": np.full((states, shapes), np.nan)}

    def solutions(self, shape: tuple[int, ...], count: Evaluations) -> Solutions:
        dforce = None
        if self.dforce is not None:
            dforce = {name: values.reshape(shape + values.shape[1:]) for name, values in self.dforce.items()}
        return Solutions(
            **{name: values.reshape(shape) for name, values in (self.real | self.whole | self.flag).items()},
            status=self.status.reshape(shape),
            dforce=dforce,
            evaluations=count,
        )
