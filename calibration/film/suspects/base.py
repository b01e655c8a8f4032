"""What a suspect is: an imperfection of film or rig, and the shape that it gives to the data.

The shape is the change of the measured forces by one unit of the imperfection, at the displacements and voltages that
were read. It is worked out to first order from the fitted model: by the model's own derivatives, by the way each sample
was taken, or by what an addition ``w`` to the energy density of the film does to the force (envelope theorem: the
state stands still to first order, so ``dF = d/dh of the integral of w``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.reduction import Block, interpolation_matrix
from model.material.materials import Material
from model.membrane.solve import Wrinkling, profiles

Array = NDArray[np.float64]

POINTS = 81  # along the radius, at which energies are summed
PROFILE_TOLERANCE = 1e-6
Density = Callable[[Array, Array, Array], Array]  # energy density (J/m3) from both stretches and the field V/T (V/m)


@dataclass(frozen=True, eq=False)
class Context:
    """The fitted model at its nodes, and how the samples were taken.

    ``curves`` are those of the rows. ``by`` holds the derivatives of the ``force`` at the ``nodes``, (rows, nodes).
    Samples come in ``blocks`` of one direction; ``block_rows`` names the row of each. ``project`` makes weighted
    residual rows from changes at the nodes, and ``scale`` divides them.
    """

    curves: Sequence[Curve]
    nodes: Array
    voltage: Array
    force: Array
    by: dict[str, Array]
    film: Material
    blocks: Sequence[Block]
    block_rows: Sequence[int]
    project: Callable[[Array], Array]
    residuals: int  # rows in all, those of the errors that are fitted along included
    scale: float
    wrinkling: Wrinkling
    fitted: frozenset[str]  # kinds of errors that are fitted along

    @property
    def timed(self) -> bool:
        """Whether every curve knows the time of its samples."""
        return all(curve.time is not None for curve in self.curves)

    @property
    def charged(self) -> bool:
        """Whether there is voltage in the data."""
        return bool((self.voltage > 0.0).any())

    @cached_property
    def way(self) -> Array:
        """Displacement at the nodes over the largest one of the data."""
        return np.asarray(self.nodes / self.nodes.max())

    @cached_property
    def runs(self) -> dict[str, tuple[float, float]]:
        """Begin and duration of every run (s), by the samples that are used."""
        found: dict[str, tuple[float, float]] = {}
        for run in dict.fromkeys(curve.run for curve in self.curves):
            times = [
                curve.time[block.rows]
                for block, row in zip(self.blocks, self.block_rows, strict=True)
                if (curve := self.curves[row]).run == run and curve.time is not None
            ]
            if times:
                begin = min(float(one.min()) for one in times)
                found[run] = begin, max(max(float(one.max()) for one in times) - begin, 1e-9)
        return found

    def elapsed(self, row: int, block: Block) -> Array:
        """Time of the samples of a block since the run began, over the duration of the run: 0 to 1."""
        curve = self.curves[row]
        assert curve.time is not None
        begin, duration = self.runs[curve.run]
        return np.asarray((curve.time[block.rows] - begin) / duration)

    def at_nodes(self, change: Array) -> Array:
        """Shape of a change of the force at the nodes (N), (rows, nodes) or what broadcasts to it."""
        rows: Array = self.project(np.broadcast_to(change, self.nodes.shape)[..., None])[:, 0]
        return rows

    def at_samples(self, change: Callable[[int, Block], Array]) -> Array:
        """Shape of a change of the force of every sample (N), as ``change(row, block)`` tells it."""
        parts = [
            (change(row, block) / block.sigma) @ block.base
            for block, row in zip(self.blocks, self.block_rows, strict=True)
        ]
        found = np.zeros(self.residuals)
        rows = np.concatenate(parts) / self.scale
        found[: rows.size] = rows
        return found

    def interpolated(self, at_nodes: Array, row: int, block: Block) -> Array:
        """Values at the nodes of a row, carried to the samples of a block."""
        place = self.curves[row].place[block.rows]
        return np.asarray(interpolation_matrix(self.nodes[row], place) @ at_nodes[row])

    def from_energy(self, density: Density) -> Array:
        """Change of the force at the nodes (N) by an addition to the energy density of the film."""
        l1, l2, fields, weights = self.states
        found: Array = np.einsum("rnp,rp->rn", density(l1, l2, fields), weights)
        return np.asarray(np.einsum("rij,rj->ri", self.differentiation, found))

    @cached_property
    def states(self) -> tuple[Array, Array, Array, Array]:
        """Stretches (rows, nodes, points), field V/T (rows, 1, 1), and weights (m3) of the points (rows, points)."""
        rows, nodes = self.nodes.shape
        specimens = np.empty((rows, 1), dtype=np.object_)
        specimens[:, 0] = [curve.specimen.with_material(self.film) for curve in self.curves]
        found = profiles(
            specimens,
            self.nodes,
            self.voltage[:, None],
            POINTS,
            tolerance=PROFILE_TOLERANCE,
            wrinkling=self.wrinkling,
        )
        l1, l2 = (one.reshape(rows, nodes, POINTS) for one in (found.stretch_1, found.stretch_2))
        thickness = np.array([curve.specimen.thickness for curve in self.curves])
        prestretch = np.array([curve.specimen.prestretch for curve in self.curves])
        radius = found.R.reshape(rows, nodes, POINTS)[:, 0]
        simpson = np.ones(POINTS)
        simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
        step = np.log(radius[:, -1] / radius[:, 0]) / (POINTS - 1)
        weights = 2.0 * math.pi * radius**2 * np.abs(step)[:, None] * simpson / 3.0
        return l1, l2, (self.voltage / thickness)[:, None, None], weights * (thickness / prestretch**2)[:, None]

    @cached_property
    def differentiation(self) -> Array:
        """Matrices that differentiate the interpolants by displacement at their nodes, (rows, nodes, nodes)."""
        count = self.nodes.shape[1]
        weight = (-1.0) ** np.arange(count) * np.sin((2 * np.arange(count) + 1) * np.pi / (2 * count))
        apart = self.nodes[:, :, None] - self.nodes[:, None, :] + np.eye(count)
        matrix = weight[None, None, :] / weight[None, :, None] / apart * (1.0 - np.eye(count))
        matrix -= np.eye(count) * matrix.sum(axis=2, keepdims=True)
        return np.asarray(matrix)


@dataclass(frozen=True)
class Shape:
    """A suspect in one data set: what it is called there, and the change of the data by one unit."""

    name: str
    rows: Array


@dataclass(frozen=True)
class Kind:
    """An imperfection that data are held against.

    Attributes
    ----------
    name : str
        Of the family: what it is called where several of its members cannot be told apart.
    unit : str
        "1" (shown in %), "N", "m", "s" or "m/N".
    sign : int
        +1 where a negative size is impossible, 0 where both signs are.
    usual : float
        A size that occurs; prior standard deviation where it is fitted along.
    remedy : str
        How to rule it out, or to find it.
    shapes : callable
        From a `Context` to its members in these data; empty where the data have nothing to do with it.
    part : str
        Entry of the uncertainty budget that counts it already; "" where none does.
    key : str
        By which it is asked for to be fitted along; "" where it cannot be.
    """

    name: str
    unit: str
    sign: int
    usual: float
    remedy: str
    shapes: Callable[[Context], Sequence[Shape]]
    part: str = ""
    key: str = ""
