"""Laws that are functions of the first invariant alone, ``W = f(J)`` with ``J = l1^2 + l2^2 + (l1 l2)^-2 - 3``."""

from __future__ import annotations

import numpy as np

from model.arrays import Array
from model.material.law import Derivatives


def invariant(log: Array) -> tuple[Array, Array]:
    """``J``, and ``l_i^2 - 1`` (3, ..., S), at stacked log stretches (3, ..., S)."""
    squares: Array = np.expm1(2.0 * log)
    total: Array = squares.sum(axis=0)
    return total, squares


def derivatives(squares: Array, first: Array, second: Array | float) -> Derivatives:
    """Derivatives of ``W`` by the log stretches from ``df/dJ``, ``d2f/dJ2`` and ``l_i^2 - 1`` (3, ..., S)."""
    by1, by2 = 2.0 * (squares[0] - squares[2]), 2.0 * (squares[1] - squares[2])  # dJ/dL_i
    through = 4.0 * (squares[2] + 1.0)  # d2J/dL1 dL2
    h11 = first * (4.0 * (squares[0] + 1.0) + through) + second * by1 * by1
    h22 = first * (4.0 * (squares[1] + 1.0) + through) + second * by2 * by2
    return first * by1, first * by2, h11, first * through + second * by1 * by2, h22
