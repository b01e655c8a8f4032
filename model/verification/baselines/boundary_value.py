"""SciPy's boundary-value solver on the explicit form: fourth-order collocation on a mesh adapted to the residual."""

from __future__ import annotations

from typing import Literal

import numpy as np

from model.specimen import Specimen
from model.verification.baselines.common import PROFILE, Array, Film, Result, failed


def boundary_value(
    specimen: Specimen, h: float, voltage: float, tolerance: float, *, coordinate: Literal["R", "ln R"] = "ln R"
) -> Result:
    """``solve_bvp`` for (l1, l2, theta, z), from a cone on 9 nodes, with the residual held to ``tolerance``."""
    from scipy.integrate import solve_bvp

    film = Film(specimen, h, voltage)
    logarithmic = coordinate == "ln R"
    count = 0

    def slope(x: Array, y: Array) -> Array:
        nonlocal count
        count += x.size
        radius = np.exp(x) if logarithmic else x
        l1, l2, theta, _ = y
        s1, s2 = film.stresses(l1, l2)
        s11, s12, _ = film.stiffness(l1, l2)
        n1, n2 = s1 / l1, s2 / l2
        cos, sin = np.cos(theta), np.sin(theta)
        widening = l1 * cos - l2
        by_log = np.stack(
            [
                (n2 * cos - n1 - s12 / (l1 * l2) * widening) * l1**2 / (s11 - s1),
                widening,
                -n2 / n1 * sin,
                radius * l1 / film.lp * sin,
            ]
        )
        return by_log if logarithmic else by_log / radius

    def ends(first: Array, last: Array) -> Array:
        return np.array([first[1] - film.lp, first[3], last[1] - film.lp, last[3] - film.height])

    radius = np.geomspace(film.disk, 1.0, 9) if logarithmic else np.linspace(film.disk, 1.0, 9)
    x = np.log(radius) if logarithmic else radius
    l1, theta = film.cone()
    cone = [l1 + 0 * x, film.lp + 0 * x, theta + 0 * x, film.height * (radius - film.disk) / (1.0 - film.disk)]
    with np.errstate(all="ignore"):
        try:
            found = solve_bvp(slope, ends, x, np.stack(cone), tol=tolerance, max_nodes=20_000)
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as problem:
            return failed(f"solve_bvp: {problem}", count)
        if not found.success:
            return failed(f"solve_bvp: {found.message}", count)
        even = np.linspace(np.log(film.disk), 0.0, PROFILE)
        y = found.sol(even if logarithmic else np.clip(np.exp(even), film.disk, 1.0))
        s1, _ = film.stresses(y[0, :1], y[1, :1])
        pull = film.disk * float(s1[0] / y[0, 0] * np.sin(y[2, 0]))
        return film.answer(pull, y[0], y[1], count)
