"""The paper's method in GNU Octave: index-1 DAE with ``ode15s``, shooting with ``fsolve``; stands in for MATLAB.

Octave is a program of its own: it gets a script and numbers in a temporary folder and prints its answer. The time in
the result is processor time measured inside it, so that starting Octave does not count.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from pathlib import Path

from model.specimen import Specimen
from model.verification.baselines.common import Film, Result, failed

PROGRAM = "octave-cli"
TIME_LIMIT = 60.0  # s

_SCRIPT = """\
1;
function [n1, n2] = nominal(l1, l2, p)
  through = (l1 * l2) .^ -p.alpha;
  maxwell = p.electric * (l1 * l2) ^ 2;
  n1 = (sum(p.mu .* (l1 .^ p.alpha - through)) - maxwell) / l1;
  n2 = (sum(p.mu .* (l2 .^ p.alpha - through)) - maxwell) / l2;
end
function out = slope(R, y, p, pull)
  global evaluations
  evaluations += 1;
  l1 = y(4); l2 = p.lp * y(1) / R;
  [n1, n2] = nominal(l1, l2, p);
  out = [l1 / p.lp * cos(y(3)); l1 / p.lp * sin(y(3)); -n2 / (R * n1) * sin(y(3)); R * n1 * sin(y(3)) - pull];
end
function [R, y, pull] = integrate(u, p)
  [n1, ~] = nominal(u(1), p.lp, p);
  pull = p.disk * n1 * sin(u(2));
  options = odeset("Mass", diag([1 1 1 0]), "MStateDependence", "none", "RelTol", p.tol, "AbsTol", 0.1 * p.tol);
  start = [p.disk; 0; u(2); u(1)];
  [R, y] = ode15s(@(R, y) slope(R, y, p, pull), [p.disk 1], start, options);
end
function out = miss(u, p)
  [R, y, ~] = integrate(u, p);
  out = [p.lp * (y(end, 1) - 1); y(end, 2) - p.height];
end
global evaluations
evaluations = 0;
warning("off", "all");
p = struct(%s);
begun = cputime;
[u, rest, flag] = fsolve(@(u) miss(u, p), p.guess, optimset("TolX", p.tol, "TolFun", p.tol));
[R, y, pull] = integrate(u, p);
spent = cputime - begun;
at = linspace(log(p.disk), 0, 41)';
l1 = interp1(log(R), y(:, 4), at, "spline");
l2 = interp1(log(R), p.lp * y(:, 1) ./ R, at, "spline");
printf("%%d %%d %%.17g %%.17g %%.17g\\n", flag, evaluations, spent, pull, max(abs(rest)));
printf("%%.17g %%.17g\\n", [l1'; l2']);
"""


def available() -> str | None:
    """The path of Octave, or None."""
    return shutil.which(PROGRAM)


def octave_shooting(specimen: Specimen, h: float, voltage: float, tolerance: float) -> Result:
    """``ode15s`` with a singular mass matrix, tolerances ``tolerance`` and a tenth of it, from a cone."""
    import numpy as np

    program = available()
    if program is None:
        return failed(f"{PROGRAM} is not on PATH: skipped", 0)
    film = Film(specimen, h, voltage)
    stretch, slope = film.cone()
    numbers = {
        "mu": film.mu.tolist(),
        "alpha": film.alpha.tolist(),
        "electric": film.electric,
        "lp": film.lp,
        "disk": film.disk,
        "height": film.height,
        "tol": tolerance,
        "guess": [stretch, slope],
    }
    fields = ", ".join(f'"{key}", {_literal(value)}' for key, value in numbers.items())
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "shoot.m"
        script.write_text(_SCRIPT % fields, encoding="utf-8")
        try:
            done = subprocess.run(
                [program, "--norc", "--quiet", str(script)],
                capture_output=True,
                text=True,
                timeout=TIME_LIMIT,
                cwd=folder,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return failed(f"{PROGRAM} took more than {TIME_LIMIT:g} s", 0)
    rows = [line.split() for line in done.stdout.splitlines() if line.strip()]
    if done.returncode != 0 or len(rows) < 2:
        reason = done.stderr.strip().splitlines()
        return failed(f"{PROGRAM}: {reason[0] if reason else 'no answer'}", 0)
    flag, evaluations, spent, pull, rest = rows[0]
    l1, l2 = np.array(rows[1:], dtype=float).T
    count = int(evaluations)
    if not float(rest) <= 100 * tolerance * max(1.0, film.height):
        return failed(f"{PROGRAM}: fsolve ended with flag {flag} and a miss of {float(rest):.1e}", count)
    return film.answer(float(pull), l1, l2, count, seconds=float(spent) if math.isfinite(float(spent)) else None)


def _literal(value: float | list[float]) -> str:
    return f"[{' '.join(repr(v) for v in value)}]" if isinstance(value, list) else repr(value)
