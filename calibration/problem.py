"""The least-squares problem of one pass: residuals of the reduced curves, and their analytic Jacobian."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.curve import Curve
from calibration.reduction import (
    Block,
    NodeModel,
    Selection,
    chebyshev_nodes,
    correlation_time,
    interpolation_matrix,
    noise_ratio,
    reduce,
    reference_voltage,
)
from model.materials import Material
from model.membrane import solve_many

Array = NDArray[np.float64]

NODES = 12
TOLERANCE = 1e-8  # of the membrane solution, relative; far below any noise, so that nodes lie on one smooth curve
INVALID_RESIDUAL = 1e8  # where the membrane has no state; larger than any real residual


class IdentificationError(ValueError):
    """Curves from which nothing can be identified; the message says why."""


class Problem:
    """Residuals and Jacobian of one pass, with the choice of samples and their weights fixed.

    The parameter vector ``x`` is ``[g_1..g_N, alpha_1..alpha_N, (eps_r), zeros...]``; zeros are in units of their
    priors.
    """

    def __init__(
        self,
        curves: Sequence[Curve],
        selections: Sequence[Selection],
        terms: int,
        at: Material,
        *,
        trust_noise: bool = False,
    ) -> None:
        self.curves = curves
        self.selections = selections
        self.terms = terms
        self.material = at
        self.scale = at.shear_modulus
        self.active = [i for i, selection in enumerate(selections) if selection.used.any()]
        if not self.active:
            raise IdentificationError(
                "no sample is left to fit: "
                + "; ".join(_why_empty(c, s) for c, s in zip(curves, selections, strict=True))
            )
        self.electric = any(curves[i].nominal_voltage != 0.0 for i in self.active)
        self.nodes = np.array([chebyshev_nodes(selections[i].low, selections[i].high, NODES) for i in self.active])
        self.voltage = np.array([reference_voltage(curves[i], selections[i].used) for i in self.active])
        # Zeros: (kind, run, prior, rows of the curves they shift)
        self.zeros: list[tuple[str, str, float, list[int]]] = []
        for run in dict.fromkeys(curves[i].run for i in self.active):
            rows = [row for row, i in enumerate(self.active) if curves[i].run == run]
            for kind in ("force_zero", "displacement_zero"):
                prior = max(getattr(curves[self.active[row]], kind) for row in rows)
                if prior > 0.0:
                    self.zeros.append((kind, run, prior, rows))
        self.names = [f"g{n + 1}" for n in range(terms)] + [f"alpha{n + 1}" for n in range(terms)]
        self.names += ["eps_r"] if self.electric else []
        self.film_parameters = len(self.names)
        self.names += [f"{kind}_{k}" for k, (kind, *_) in enumerate(self.zeros)]

        states = self._solve(at, np.zeros(len(self.active)))
        if not np.isfinite(states.force).all():
            raise IdentificationError("the membrane has no state at the starting guess, where its status says it has")
        self.blocks: list[Block] = []
        self.block_rows: list[int] = []
        for row, i in enumerate(self.active):
            model = NodeModel(states.force[row], states.by["h"][row], states.by["voltage"][row])
            new = reduce(i, curves[i], selections[i], self.nodes[row], float(self.voltage[row]), model)
            self.blocks += new
            self.block_rows += [row] * len(new)
        ratio, freedom = noise_ratio(self.blocks)
        self.noise_variance = ratio
        # Only a significant excess counts: with few samples the ratio is itself a matter of chance.
        significant = freedom > 0 and ratio > 1.0 + 3.0 * math.sqrt(2.0 / freedom)
        self.excess = ratio if significant and not trust_noise else 1.0
        self.correlation_time = 1.0 if trust_noise else correlation_time(self.blocks)
        self.inflation = self.excess * self.correlation_time
        self._roots = [block.root / math.sqrt(self.inflation) for block in self.blocks]
        self._targets = [block.target / math.sqrt(self.inflation) for block in self.blocks]
        self._last: tuple[bytes, Array, Array] | None = None

    @property
    def data_rows(self) -> int:
        """Residuals that come from data; one for each zero follows."""
        return sum(root.shape[0] for root in self._roots)

    def film(self, x: Array) -> Material:
        """The material of a parameter vector."""
        n = self.terms
        mu = 2.0 * self.scale * x[:n] / x[n : 2 * n]
        eps_r = float(x[2 * n]) if self.electric else self.material.eps_r
        return Material(name="identified", mu=tuple(mu), alpha=tuple(x[n : 2 * n]), eps_r=eps_r)

    def vector(self, material: Material) -> Array:
        """The parameter vector of a material, zeros at zero."""
        mu, alpha = np.array(material.mu), np.array(material.alpha)
        eps = [material.eps_r] if self.electric else []
        return np.concatenate((mu * alpha / (2.0 * self.scale), alpha, eps, np.zeros(len(self.zeros))))

    def by_parameters(self, x: Array, by_mu: Array, by_alpha: Array, by_eps: Array) -> Array:
        """Derivatives by x from derivatives by mu, alpha (both (..., N)) and eps_r (...); zeros get 0."""
        n = self.terms
        alpha = x[n : 2 * n]
        mu = 2.0 * self.scale * x[:n] / alpha
        parts = [by_mu * 2.0 * self.scale / alpha, by_alpha - by_mu * mu / alpha]
        if self.electric:
            parts.append(by_eps[..., None])
        parts.append(np.zeros((*by_mu.shape[:-1], len(self.zeros))))
        return np.concatenate(parts, axis=-1)

    def residual(self, x: Array) -> Array:
        """Weighted residuals, model minus measurement: reduced data, then zeros in units of their priors."""
        return self._evaluate(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivatives of `residual` by x, shape (residuals, parameters)."""
        return self._evaluate(x)[1]

    def answers(self, x: Array) -> bool:
        """Whether the membrane has a state at every node for these parameters."""
        return bool((np.abs(self.residual(x)) < INVALID_RESIDUAL).all())

    def states(self, x: Array) -> States:
        """The model at the nodes, displacement zeros included and force zeros not."""
        shift = np.zeros(len(self.active))
        for value, (kind, _, prior, rows) in zip(x[self.film_parameters :], self.zeros, strict=True):
            if kind == "displacement_zero":
                shift[rows] += value * prior
        return self._solve(self.film(x), shift)

    def project(self, at_nodes: Array) -> Array:
        """Weighted residual rows of changes of the force at the nodes, shape (curves, nodes, ...); zeros get 0."""
        rows = [root @ at_nodes[row] for root, row in zip(self._roots, self.block_rows, strict=True)]
        return np.concatenate([*rows, np.zeros((len(self.zeros), *at_nodes.shape[2:]))])

    def samples(self, row: int, x: Array, states: States) -> tuple[Array, Array, Array]:
        """Of an active curve's used samples: residual (measured minus model, N), its deviation, displacement."""
        i = self.active[row]
        curve, used = self.curves[i], self.selections[i].used
        matrix = interpolation_matrix(self.nodes[row], curve.h[used])
        model = matrix @ states.force[row]
        for value, (kind, _, prior, rows) in zip(x[self.film_parameters :], self.zeros, strict=True):
            if kind == "force_zero" and row in rows:
                model += value * prior
        reference = float(self.voltage[row])
        if reference > 0.0:
            by_square = states.by["voltage"][row] / (2 * reference)
            model += matrix @ by_square * (curve.voltage[used] ** 2 - reference**2)
        sigma = np.hypot(curve.force_noise, matrix @ states.by["h"][row] * curve.displacement_noise)
        return curve.force[used] - model, sigma, curve.h[used]

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1], self._last[2]
        states = self.states(x)
        if np.isfinite(states.force).all():
            slopes = self.by_parameters(x, states.by["mu"], states.by["alpha"], states.by["eps_r"])
            force = states.force.copy()
            for k, (kind, _, prior, rows) in enumerate(self.zeros, start=self.film_parameters):
                if kind == "force_zero":
                    force[rows] += x[k] * prior
                    slopes[rows, :, k] = prior
                else:
                    slopes[rows, :, k] = prior * states.by["h"][rows]
            residual = self.project(force)
            residual[: self.data_rows] -= np.concatenate(self._targets)
            residual[self.data_rows :] = x[self.film_parameters :]
            jacobian = self.project(slopes)
            jacobian[self.data_rows :, self.film_parameters :] = np.eye(len(self.zeros))
        else:
            residual = np.full(self.data_rows + len(self.zeros), INVALID_RESIDUAL)
            jacobian = np.zeros((residual.size, x.size))
        self._last = (key, residual, jacobian)
        return residual, jacobian

    def _solve(self, material: Material, shift: Array) -> States:
        solved = solve_many(
            films(self.curves, self.active, material),
            self.nodes + shift[:, None],
            self.voltage[:, None],
            tolerance=TOLERANCE,
            sensitivities=True,
        )
        if solved.dforce is None:
            raise RuntimeError("the membrane model returned no sensitivities")
        return States(solved.force, solved.dforce, solved.max_stretch)


def films(curves: Sequence[Curve], active: Sequence[int], material: Material) -> NDArray[np.object_]:
    """The specimens of the active curves, made of ``material``; shape (curves, 1)."""
    column = np.empty((len(active), 1), dtype=np.object_)
    column[:, 0] = [curves[i].specimen.with_material(material) for i in active]
    return column


@dataclass(frozen=True, eq=False)
class States:
    """The model at the nodes of all active curves: arrays of shape (curves, nodes), by mu and alpha (curves, nodes, N).

    ``by`` holds the derivatives of the force, with the keys of `model.membrane.Solutions.dforce`.
    """

    force: Array
    by: dict[str, Array]
    max_stretch: Array


def _why_empty(curve: Curve, selection: Selection) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in selection.excluded.items())
    return f"{curve.label}: {reasons or 'no samples'}"
