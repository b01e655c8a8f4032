"""The results of many states while they are being filled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations
from model.material.materials import Material
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


@dataclass(slots=True)
class Flat:
    """The results while they are being filled, one entry a state."""

    real: dict[str, Array]
    whole: dict[str, NDArray[np.intp]]
    flag: dict[str, NDArray[np.bool_]]
    status: NDArray[np.int8]
    dforce: dict[str, Array] | None = None
    keep: bool = False
    kept: list[tuple[NDArray[np.intp], Solved]] = field(default_factory=list)

    @classmethod
    def blank(cls, states: int, materials: Sequence[Material], sensitivities: bool, keep: bool) -> Flat:
        """Without any answer; with ``keep`` it will have the states themselves."""
        dforce = None
        if sensitivities:
            moduli = max((len(m.mu) for m in materials), default=1)
            shapes = max((len(m.alpha) for m in materials), default=1)
            dforce = dict(zip(SLOPES, np.full((len(SLOPES), states), np.nan), strict=True))
            dforce |= {"mu": np.full((states, moduli), np.nan), "alpha": np.full((states, shapes), np.nan)}
        return cls(
            dict(zip(REAL, np.full((len(REAL), states), np.nan), strict=True)),
            dict(zip(WHOLE, np.zeros((len(WHOLE), states), dtype=np.intp), strict=True)),
            dict(zip(FLAG, np.zeros((len(FLAG), states), dtype=np.bool_), strict=True)),
            np.full(states, Status.INVALID, dtype=np.int8),
            dforce,
            keep,
        )

    def solutions(self, shape: tuple[int, ...], count: Evaluations) -> Solutions:
        dforce = None
        if self.dforce is not None:
            dforce = {name: values.reshape(shape + values.shape[1:]) for name, values in self.dforce.items()}
        columns: dict[str, Any] = {**self.real, **self.whole, **self.flag}
        return Solutions(
            **{name: values.reshape(shape) for name, values in columns.items()},
            status=self.status.reshape(shape),
            dforce=dforce,
            evaluations=count,
        )
