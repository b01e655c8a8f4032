"""Other ways to solve the plain equations, for comparison only: nothing else in the project uses them.

Each is a function ``(specimen, h, voltage, tolerance) -> Result``. None gives an error estimate of its force.
"""

from __future__ import annotations

from functools import partial

from model.verification.baselines.boundary_value import boundary_value
from model.verification.baselines.collocation import collocation
from model.verification.baselines.common import Baseline, Result
from model.verification.baselines.octave import available as octave_available
from model.verification.baselines.octave import octave_shooting
from model.verification.baselines.shooting import explicit_shooting, paper_shooting

BASELINES: dict[str, Baseline] = {
    "Octave ode15s shooting": octave_shooting,
    "BDF shooting": partial(paper_shooting, integrator="BDF"),
    "Radau shooting": partial(paper_shooting, integrator="Radau"),
    "LSODA shooting": partial(explicit_shooting, integrator="LSODA"),
    "RK45 shooting": partial(explicit_shooting, integrator="RK45"),
    "DOP853 shooting": partial(explicit_shooting, integrator="DOP853"),
    "solve_bvp in R": partial(boundary_value, coordinate="R"),
    "solve_bvp in ln R": partial(boundary_value, coordinate="ln R"),
    "Chebyshev in R": partial(collocation, coordinate="R"),
    "Chebyshev in ln R": partial(collocation, coordinate="ln R"),
}

__all__ = [
    "BASELINES",
    "Baseline",
    "Result",
    "boundary_value",
    "collocation",
    "explicit_shooting",
    "octave_available",
    "octave_shooting",
    "paper_shooting",
]
