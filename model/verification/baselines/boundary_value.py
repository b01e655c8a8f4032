"""SciPy's boundary-value solver on the explicit form: fourth-order collocation on a mesh adapted to the residual."""

from __future__ import annotations

from typing import Literal

import numpy as np

from model.specimen import Specimen
from model.verification.baselines.common import PROFILE, Array, Film, Result, failed
from model.verification.baselines.explicit import Explicit

NODES = 17  # of the first mesh: the fastest of 5 to 25 for an error of 1e-6
# Derivatives of the conditions at the ends by (L1, L2, theta, z) at the disk and at the ring.
AT_DISK = np.array([[0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
AT_RING = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=float)


def boundary_value(
    specimen: Specimen, h: float, voltage: float, tolerance: float, *, coordinate: Literal["R", "ln R"] = "ln R"
) -> Result:
    """``solve_bvp`` for (ln l1, ln l2, theta, z) with analytic Jacobians, from a power law on few nodes.

    The residual is held to ``tolerance``.
    """
    from scipy.integrate import solve_bvp

    film = Film(specimen, h, voltage)
    equations = Explicit(film)
    logarithmic = coordinate == "ln R"
    prestretch = np.log(film.lp)

    def slopes(radius: Array, y: Array) -> Array:
        return equations.slopes(np.log(radius), y) / radius

    def jacobian(radius: Array, y: Array) -> Array:
        return equations.jacobian(np.log(radius), y) / radius

    def ends(first: Array, last: Array) -> Array:
        return np.array([first[1] - prestretch, first[3], last[1] - prestretch, last[3] - film.height])

    def ends_jacobian(first: Array, last: Array) -> tuple[Array, Array]:
        return AT_DISK, AT_RING

    radius = np.geomspace(film.disk, 1.0, NODES) if logarithmic else np.linspace(film.disk, 1.0, NODES)
    with np.errstate(all="ignore"):
        try:
            found = solve_bvp(
                equations.slopes if logarithmic else slopes,
                ends,
                np.log(radius) if logarithmic else radius,
                film.power_law(radius),
                fun_jac=equations.jacobian if logarithmic else jacobian,
                bc_jac=ends_jacobian,
                tol=tolerance,
                max_nodes=20_000,
            )
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as problem:
            return failed(f"solve_bvp: {problem}", equations.points)
        if not found.success:
            return failed(f"solve_bvp: {found.message}", equations.points)
        even = np.linspace(np.log(film.disk), 0.0, PROFILE)
        y = found.sol(even if logarithmic else np.clip(np.exp(even), film.disk, 1.0))
        l1, l2 = np.exp(y[:2])
        s1, _ = film.stresses(l1[:1], l2[:1])
        pull = film.disk * float(s1[0] / l1[0] * np.sin(y[2, 0]))
        return film.answer(pull, l1, l2, equations.points)
