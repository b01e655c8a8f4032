"""Wrinkled elements that are straight cones, told by what stands at their two ends.

Where the relaxed law is almost flat the stretch changes so steeply that no polynomial through points in R knows it. The
pull and the stretches at both ends do, at every resolution alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from numpy.typing import NDArray

from model.arrays import Array


@dataclass(slots=True)
class Straight:
    """Wrinkled elements, (K, S); what has a value at either end, (2, K, S), has that of the inner end first."""

    u: Array  # (2, K, S): ln(l1/lp)
    natural: Array  # (2, K, S): ln(l2) that makes no hoop stress
    inner: Array  # (Q, K, S): the same at the points of `soft_cone`
    cos: Array
    sin: Array
    pull: Array  # R S1, in units of G/lp

    def arrays(self) -> Iterator[Array]:
        """Every array."""
        yield from (self.u, self.natural, self.inner, self.cos, self.sin, self.pull)

    def take(self, index: NDArray) -> Straight:  # type: ignore[type-arg]
        """Those of the states at ``index``."""
        return Straight(*(values[..., index] for values in self.arrays()))
