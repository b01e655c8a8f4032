r"""The posterior of a fit by Markov chains, where least squares with a covariance may not be believed.

The walkers of emcee (Foreman-Mackey et al. 2013; stretch moves and, as often, differential evolution, which forgets
twice as fast in the long valleys of Ogden terms) sample

.. math:: \ln p(x) = -\tfrac{1}{2} \chi^2(x) + \text{const}

with the same residuals, the same Gaussian priors of the nuisances and the same bounds as the fit, flat inside them;
what was held in the fit is held here.
Gains and the specimen's dimensions are not sampled: what they add stands in the budget of the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.rows import Currents
from calibration.film.curve import Curve
from calibration.film.problem import IdentificationError, Problem
from calibration.film.propagation import secant_modulus, sorted_terms
from calibration.film.reduction import select
from calibration.film.result import Identification, Posterior, Sampled
from calibration.film.suspects.registry import fittable

Array = NDArray[np.float64]

WALKERS = 4  # a parameter
MOST_STEPS = 12_000
LOOK = 500  # steps after which it is looked whether the chain is long enough
ENOUGH = 50.0  # autocorrelation times that a chain must be long before its times can be believed (emcee's own advice)
KEPT = 2000  # samples at which derived quantities are worked out


def posterior(
    curves: Sequence[Curve],
    found: Identification,
    *,
    steps: int = MOST_STEPS,
    seed: int = 0,
    progress: Callable[[float, float, str], None] = lambda done, total, label: None,
    currents: Currents | None = None,
) -> Posterior:
    """Sample the posterior around an identification of ``curves``, until the chain is long enough.

    Parameters
    ----------
    curves, found
        What was fitted, and what came of it.
    steps : int
        At most so many; a chain that is too short by then says so.
    seed : int
    progress : callable
        Told steps done, steps expected, and a label.
    currents : Currents, optional
        As they were fitted along.

    Raises
    ------
    IdentificationError
        When the package emcee is missing, or nothing can be sampled.
    """
    try:
        import emcee
    except ImportError:
        raise IdentificationError("the posterior needs the package emcee: uv sync --extra posterior") from None

    selections = select(curves, found.material, found.wrinkling)
    rig = found.nuisance.get("compliance of the rig")
    compliance = 0.0 if rig is None else rig.value
    settings = found.provenance.get("settings", {})
    along = [fittable()[key] for key in settings.get("along", [])]
    problem = Problem(
        curves,
        selections,
        found.terms,
        found.material,
        wrinkling=found.wrinkling,
        compliance=compliance,
        along=along,
        currents=currents,
    )
    best = problem.vector(found.material)
    held = settings.get("fixed", {})
    free = np.array([name not in held for name in problem.names])
    low, high = (side[free] for side in problem.bounds(best))
    rng = np.random.default_rng(seed)
    size = int(free.sum())
    walkers = WALKERS * size

    def whole(points: Array) -> Array:
        full = np.tile(best, (len(points), 1))
        full[:, free] = points
        return full

    def log_probability(points: Array) -> Array:
        inside = ((points > low) & (points < high)).all(axis=1)
        values = np.full(len(points), -np.inf)
        if inside.any():
            there = problem.evaluate(whole(points[inside]), slopes=False)
            values[inside] = np.where(there.answered, -0.5 * there.cost, -np.inf)
        return values

    begin = _around(problem.jacobian(best)[:, free], best[free], low, high, walkers, rng)
    moves = [(emcee.moves.DEMove(), 0.5), (emcee.moves.StretchMove(), 0.5)]
    sampler = emcee.EnsembleSampler(walkers, size, log_probability, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    state, done, longest = begin, 0, math.inf
    while done < min(steps, ENOUGH * longest):
        state = sampler.run_mcmc(state, min(LOOK, steps - done))
        done = sampler.iteration
        times = np.asarray(sampler.get_autocorr_time(tol=0, quiet=True))[: free[: problem.film_parameters].sum()]
        longest = float(times.max()) if np.isfinite(times).all() else math.inf
        progress(done, max(done, min(steps, ENOUGH * longest)), f"{done} steps, autocorrelation {longest:.0f}")
    chain = sampler.get_chain(discard=done // 3, flat=True)
    kept = chain[rng.choice(len(chain), size=min(KEPT, len(chain)), replace=False)]
    return Posterior(
        quantities=_quantities(problem, whole(kept), found),
        steps=done,
        walkers=walkers,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        autocorrelation=longest,
        converged=done >= ENOUGH * longest,
    )


def _around(jacobian: Array, best: Array, low: Array, high: Array, walkers: int, rng: np.random.Generator) -> Array:
    """Where the walkers begin: about the best fit, by its curvature, well inside the bounds."""
    scale = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12)))
    room = np.where(np.isfinite(high - low), 0.02 * (high - low), np.inf)
    points = best + np.minimum(scale, room) * rng.standard_normal((walkers, best.size))
    margin = np.where(np.isfinite(room), 0.05 * room, 0.0)
    return np.clip(
        points, np.where(np.isfinite(low), low + margin, low), np.where(np.isfinite(high), high - margin, high)
    )


def _quantities(problem: Problem, points: Array, found: Identification) -> dict[str, Sampled]:
    films = [problem.film(x) for x in points]
    named = [sorted_terms(film).values for film in films]
    values = {name: [one[name] for one in named] for name in named[0]}
    values["G"] = [film.shear_modulus for film in films]
    values["stiffness"] = [secant_modulus(film, *found.stretch) for film in films]
    if "eps_r" in found.quantities:
        values["eps_r"] = [film.eps_r for film in films]
    ends = {name: np.quantile(one, (0.025, 0.975)) for name, one in values.items()}
    return {
        name: Sampled(
            mean=float(np.mean(one)),
            deviation=float(np.std(one, ddof=1)),
            low=float(ends[name][0]),
            high=float(ends[name][1]),
            unit=found.quantities[name].unit,
        )
        for name, one in values.items()
        if name in found.quantities
    }
