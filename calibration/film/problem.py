"""The least-squares problem of one pass: residuals of the reduced curves, and their analytic Jacobian."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.charge import NotResolved
from calibration.electrical.rows import Currents
from calibration.film.charged import KINDS, ChargeModel
from calibration.film.coordinates import Coordinates
from calibration.film.curve import Curve
from calibration.film.differences import DIMENSIONS, common, contrast_weights, contrasts, parts
from calibration.film.reduction import (
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
from calibration.film.suspects.base import Context, Kind
from model.material.materials import Material
from model.membrane.solve import Wrinkling, solve_many
from model.specimen import Specimen

Array = NDArray[np.float64]

NODES = 8  # of every part of a curve, to begin with
COMPLIANCE_ROUNDS = 3  # rounds after which force and giving way agree; each is off by a few per cent of the one before
TOLERANCE = 1e-7  # of the membrane solution, relative; far below any noise, so that nodes lie on one smooth curve
INVALID_RESIDUAL = 1e8  # where the membrane has no state; larger than any real residual


class IdentificationError(ValueError):
    """Curves from which nothing can be identified; the message says why."""


class UnknownParameter(IdentificationError):
    """A parameter that is to be fixed and that the film does not have."""


@dataclass(frozen=True)
class Nuisance:
    """An error that is fitted along: what kind, of which run, its prior standard uncertainty, which rows.

    One of a dimension is a contrast between specimens: by how much (relative, for one prior) it changes the dimension
    in each of its rows, is in ``weights``.
    """

    kind: str  # force_zero, displacement_zero, lag, compliance, one of DIMENSIONS or of KINDS (of the current)
    run: str
    prior: float
    rows: tuple[int, ...]
    weights: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Residuals and Jacobians of S parameter vectors: (S, residuals), (S, residuals, parameters).

    Where the membrane has no state, ``answered`` (S,) is False, residuals are `INVALID_RESIDUAL` and slopes 0.
    """

    residual: Array
    jacobian: Array
    answered: NDArray[np.bool_]
    states: States

    @property
    def cost(self) -> Array:
        """Sums of squares (S,)."""
        cost: Array = np.einsum("sr,sr->s", self.residual, self.residual)
        return cost


class Problem:
    """Residuals and Jacobian of one pass, with the choice of samples and their weights fixed.

    The parameter vector ``x`` is ``[shares, shape parameters, (eps_r), nuisances...]``. The shares are the moduli of
    the law of the material ``at``, made of order one (`model.material.law.Law.weights`): of Ogden terms
    ``g_n = mu_n alpha_n / (2 G_0) > 0``, which keeps the film stable at any stretch. ``terms`` counts for a series
    only. Nuisances are in units of their priors. Each part of a curve is a row of ``nodes``, and ``active`` names the
    curve of each row. The rig gives way by the force of the material ``at``, where its ``compliance`` (m/N, beyond
    that believed) holds the disk. ``currents`` are data beside the forces, whose residuals follow theirs; ``coarse``
    leaves out what the law does to the capacitance. ``solved`` counts the membrane states that were computed: rows
    times nodes for an evaluation, whatever the number of samples.
    """

    def __init__(
        self,
        curves: Sequence[Curve],
        selections: Sequence[Selection],
        terms: int,
        at: Material,
        *,
        trust_noise: bool = False,
        nodes: int = NODES,
        tolerance: float = TOLERANCE,
        wrinkling: Wrinkling = "plain",
        compliance: float = 0.0,
        along: Sequence[Kind] = (),
        currents: Currents | None = None,
        coarse: bool = False,
    ) -> None:
        self.curves = curves
        self.selections = selections
        self.tolerance = tolerance
        self.wrinkling: Wrinkling = wrinkling
        self.along = {kind.key: kind for kind in along}
        self.solved = 0
        self.pieces = [(i, part) for i, selection in enumerate(selections) for part in selection.parts]
        self.active = [i for i, _ in self.pieces]
        if not self.active:
            raise IdentificationError(
                "no sample is left to fit: "
                + "; ".join(_why_empty(c, s) for c, s in zip(curves, selections, strict=True))
            )
        self.electric = any(curves[i].nominal_voltage != 0.0 for i in self.active)
        self.coordinates = here = Coordinates.of(at, terms, self.electric)
        self.law, self.moduli, self.film_numbers = here.law, here.moduli, here.film_numbers
        self.parameters, self.material, self.scale = here.parameters, at, here.scale
        try:
            self.charge = None if currents is None or not self.electric else ChargeModel(currents, at, whole=not coarse)
        except NotResolved as error:
            raise IdentificationError(str(error)) from error
        self.nodes = np.array([chebyshev_nodes(part.low, part.high, nodes) for _, part in self.pieces])
        self.voltage = np.array([reference_voltage(curves[i], part.used) for i, part in self.pieces])
        self.nuisances = self._nuisances()
        self.names = list(here.names)
        self.film_parameters = len(self.names)
        self.names += [f"{nuisance.kind.replace('-', '_')}_{k}" for k, nuisance in enumerate(self.nuisances)]

        self._give = np.zeros_like(self.nodes)  # force (N) by which the rig gives way at the nodes
        x = np.zeros(len(self.names))
        for k, one in enumerate(self.nuisances, start=self.film_parameters):
            x[k] = compliance / one.prior if one.kind == "compliance" else 0.0
        for _ in range(COMPLIANCE_ROUNDS if x[self.film_parameters :].any() else 1):
            states = self._solve([at], x[None])[0]
            self._give = states.force
        if not np.isfinite(states.force).all():
            raise IdentificationError("the membrane has no state at the starting guess, where its status says it has")
        self.blocks: list[Block] = []
        self.block_rows: list[int] = []
        for row, (i, part) in enumerate(self.pieces):
            model = NodeModel(states.force[row], states.by["h"][row], states.by["voltage"][row])
            new = reduce(curves[i], part.used, self.nodes[row], float(self.voltage[row]), model)
            self.blocks += new
            self.block_rows += [row] * len(new)
        ratio, freedom = noise_ratio(self.blocks)
        self.noise_variance = ratio
        # Only a significant excess counts: with few samples the ratio is itself a matter of chance.
        significant = freedom > 0 and ratio > 1.0 + 3.0 * math.sqrt(2.0 / freedom)
        self.excess = ratio if significant and not trust_noise else 1.0
        self.correlation_time = 1.0 if trust_noise else correlation_time(self.blocks)
        self.inflation = self.excess * self.correlation_time
        self.roots = [block.root / math.sqrt(self.inflation) for block in self.blocks]
        self.ways = [block.way for block in self.blocks]
        self._target = np.concatenate([block.target for block in self.blocks]) / math.sqrt(self.inflation)
        self._stiffness = states.by["h"]  # N/m, at the nodes
        self._late = {k: self._by_lag(one) for k, one in enumerate(self.nuisances) if one.kind == "lag"}
        self._late |= self._by_suspects(states)
        self._last: tuple[bytes, Evaluation] | None = None

    def _nuisances(self) -> list[Nuisance]:
        found = []
        for run in dict.fromkeys(self.curves[i].run for i in self.active):
            rows = tuple(row for row, i in enumerate(self.active) if self.curves[i].run == run)
            for kind, prior_of in (
                ("force_zero", "force_zero"),
                ("displacement_zero", "displacement_zero"),
                ("lag", "lag_uncertainty"),
            ):
                prior = max(getattr(self.curves[self.active[row]], prior_of) for row in rows)
                if prior > 0.0:
                    found.append(Nuisance(kind, run, prior, rows))
        rows = tuple(row for row, i in enumerate(self.active) if self.curves[i].compliance_uncertainty > 0.0)
        if rows:
            prior = max(self.curves[self.active[row]].compliance_uncertainty for row in rows)
            found.append(Nuisance("compliance", "the rig", prior, rows))
        for dimension in DIMENSIONS:
            found += self._contrasts(dimension)
        runs = dict.fromkeys(self.curves[i].run for i in self.active)
        found += [Nuisance(key, run, kind.usual, ()) for key, kind in self.along.items() for run in runs]
        if self.charge is not None:
            found += [Nuisance(kind, "the supply", prior, ()) for kind, prior in self.charge.currents.priors.items()]
        return found

    @property
    def fitted_curves(self) -> list[Curve]:
        """The curve of every row."""
        return [self.curves[i] for i in self.active]

    def parts(self, dimension: str) -> list[str]:
        """Which parts (films, disks, rings) have errors of their own of a dimension; see `Curve.part`."""
        return parts(self.fitted_curves, dimension)

    def common(self, dimension: str) -> float:
        """Standard deviation of what the errors of a dimension have in common, in units of that of one part."""
        return common(self.fitted_curves, dimension)

    def contrasts(self, dimension: str) -> Array:
        """What the contrasts of a dimension do to each part, in units of its uncertainty; (K, K - 1)."""
        return contrasts(self.fitted_curves, dimension)

    def _contrasts(self, dimension: str) -> list[Nuisance]:
        rows = tuple(range(len(self.active)))
        weights = contrast_weights(self.fitted_curves, dimension)
        return [Nuisance(dimension, f"contrast {k + 1}", 1.0, rows, one) for k, one in enumerate(weights)]

    @property
    def force_rows(self) -> int:
        """Residuals that come from forces, the first ones; those of the charge follow."""
        return self._target.size

    @property
    def data_rows(self) -> int:
        """Residuals that come from data; one for each nuisance follows."""
        return self.force_rows + (0 if self.charge is None else self.charge.size)

    def film(self, x: Array) -> Material:
        """The material of a parameter vector."""
        return self.coordinates.film(x)

    def vector(self, material: Material) -> Array:
        """The parameter vector of a material, nuisances at zero."""
        return np.concatenate((self.coordinates.vector(material), np.zeros(len(self.nuisances))))

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Lower and upper bounds of a parameter vector; exponents keep the sign they have in ``x``."""
        free = np.full(len(self.nuisances), np.inf)
        low, high = self.coordinates.bounds(x)
        return np.concatenate((low, -free)), np.concatenate((high, free))

    def by_parameters(self, x: Array, by_mu: Array, by_alpha: Array, by_eps: Array) -> Array:
        """Derivatives by x (..., P) from those by mu (..., moduli), alpha (..., shapes) and eps_r (...).

        Nuisances get 0.
        """
        found = self.coordinates.by_parameters(x, by_mu, by_alpha, by_eps)
        return np.concatenate((found, np.zeros((*by_mu.shape[:-1], len(self.nuisances)))), axis=-1)

    def residual(self, x: Array) -> Array:
        """Weighted residuals, model minus measurement: reduced data, then nuisances in units of their priors."""
        residual: Array = self._one(x).residual[0]
        return residual

    def jacobian(self, x: Array) -> Array:
        """Derivatives of `residual` by x, shape (residuals, parameters)."""
        jacobian: Array = self._one(x).jacobian[0]
        return jacobian

    def answers(self, x: Array) -> bool:
        """Whether the membrane has a state at every node for these parameters."""
        return bool(self._one(x).answered[0])

    def states(self, x: Array) -> States:
        """The model at the nodes, errors of the displacement included and force zeros not."""
        return self._one(x).states[0]

    def project(self, at_nodes: Array) -> Array:
        """Weighted residual rows of changes of the force at the nodes, (..., rows, nodes, P); nuisances get 0."""
        rows = [root @ at_nodes[..., row, :, :] for root, row in zip(self.roots, self.block_rows, strict=True)]
        more = self.data_rows - self.force_rows + len(self.nuisances)
        nothing = np.zeros((*at_nodes.shape[:-3], more, at_nodes.shape[-1]))
        return np.concatenate([*rows, nothing], axis=-2)

    def evaluate(self, points: Array, *, slopes: bool = True) -> Evaluation:
        """Residuals and Jacobians of many parameter vectors (S, P), their membrane states all solved together."""
        count, data, forces = len(points), self.data_rows, self.force_rows
        solved = self._solve([self.film(x) for x in points], points, slopes=slopes)
        force = solved.force.copy()
        for k, nuisance in enumerate(self.nuisances, start=self.film_parameters):
            if nuisance.kind == "force_zero":
                force[:, nuisance.rows] += (points[:, k] * nuisance.prior)[:, None, None]
        residual = self.project(force[..., None])[..., 0]
        residual[:, :forces] -= self._target
        for k, late in self._late.items():
            residual[:, :forces] += points[:, self.film_parameters + k, None] * late
        residual[:, data:] = points[:, self.film_parameters :]
        jacobian = np.zeros((count, residual.shape[1], points.shape[1]))
        if slopes:
            by = self.by_parameters(points[:, None, None], *(solved.by[name] for name in ("mu", "alpha", "eps_r")))
            for k, nuisance in enumerate(self.nuisances, start=self.film_parameters):
                if nuisance.rows and k - self.film_parameters not in self._late:
                    by[..., k][:, list(nuisance.rows)] = self._by_nuisance(nuisance, solved)
            jacobian = self.project(by)
            for k, late in self._late.items():
                jacobian[:, :forces, self.film_parameters + k] = late
            jacobian[:, data:, self.film_parameters :] = np.eye(len(self.nuisances))
        if self.charge is not None:
            self._add_charge(self.charge, points, residual, jacobian if slopes else None)
        answered = np.asarray(np.isfinite(force).all(axis=(1, 2)))
        residual[~answered] = INVALID_RESIDUAL
        jacobian[~answered] = 0.0
        return Evaluation(residual, jacobian, answered, solved)

    def _add_charge(self, charge: ChargeModel, points: Array, residual: Array, jacobian: Array | None) -> None:
        """Put the rows of the charge into residuals and Jacobian."""
        mine = slice(self.force_rows, self.data_rows)
        values = {n.kind: points[:, k] * n.prior for k, n in enumerate(self.nuisances, self.film_parameters)}
        shift = np.zeros((len(points), len(charge.currents.places)))
        zeros = []
        for k, one in enumerate(self.nuisances, self.film_parameters):
            if one.kind == "displacement_zero":
                here = np.array([place.run == one.run for place in charge.currents.places])
                zeros.append((k, one.prior * here))
                shift += points[:, k, None] * one.prior * here
        errors = {kind: size for kind, size in values.items() if kind in KINDS}
        found = charge.evaluate([self.film(x) for x in points], errors, shift)
        residual[:, mine] = found.residual
        if jacobian is None:
            return
        rows = self.by_parameters(points[:, None], found.by_mu, found.by_alpha, found.by_eps_r)
        for k, one in enumerate(self.nuisances, self.film_parameters):
            if one.kind in KINDS:
                rows[..., k] = found.by_kind[one.kind] * one.prior
        for k, size in zeros:
            rows[..., k] = np.einsum("spm,p->sm", found.by_h, size)
        jacobian[:, mine] = rows

    def samples(self, row: int, x: Array, states: States) -> tuple[Array, Array, Array]:
        """Of the used samples of a row: residual (measured minus model, N), its deviation, displacement."""
        i, part = self.pieces[row]
        curve, used = self.curves[i], part.used
        matrix = interpolation_matrix(self.nodes[row], curve.place[used])
        model = matrix @ states.force[row]
        for value, nuisance in zip(x[self.film_parameters :], self.nuisances, strict=True):
            if nuisance.kind == "force_zero" and row in nuisance.rows:
                model += value * nuisance.prior
            elif nuisance.kind == "lag" and row in nuisance.rows:
                model -= value * nuisance.prior * curve.velocity[used] * (matrix @ self._stiffness[row])
        if self.along:
            model += self._along_at(row, x)[used]
        reference = float(self.voltage[row])
        if reference > 0.0:
            by_square = states.by["voltage"][row] / (2 * reference)
            model += matrix @ by_square * (curve.voltage[used] ** 2 - reference**2)
        sigma = np.hypot(curve.force_noise, matrix @ states.by["h"][row] * curve.displacement_noise)
        return curve.force[used] - model, sigma, curve.h[used]

    def context(self, x: Array) -> Context:
        """What the shapes of suspects are made from, at ``x``."""
        return self._context(self.film(x), self.states(x))

    def _context(self, film: Material, states: States) -> Context:
        return Context(
            curves=[self.curves[i] for i in self.active],
            nodes=self.nodes,
            voltage=self.voltage,
            force=states.force,
            by=states.by,
            film=film,
            blocks=self.blocks,
            block_rows=self.block_rows,
            project=self.project,
            residuals=self.data_rows + len(self.nuisances),
            scale=math.sqrt(self.inflation),
            wrinkling=self.wrinkling,
            fitted=frozenset(one.kind for one in self.nuisances),
        )

    def _by_suspects(self, states: States) -> dict[int, Array]:
        """What one prior of every error that is fitted along on request does to the weighted data rows, run by run."""
        if not self.along:
            return {}
        context, found = self._context(self.material, states), {}
        runs = [self.curves[self.active[row]].run for row in self.block_rows]
        owner = np.repeat(np.array(runs, dtype=np.object_), [root.shape[0] for root in self.roots])
        for key, kind in self.along.items():
            shapes = kind.shapes(replace(context, fitted=context.fitted - {key}))
            if not shapes:
                raise IdentificationError(f"{kind.name}: these data have nothing to do with it; do not fit it along")
            for k, one in enumerate(self.nuisances):
                if one.kind == key:
                    found[k] = one.prior * shapes[0].rows[: self.force_rows] * (owner == one.run)
        return found

    def _along_at(self, row: int, x: Array) -> Array:
        """What the errors that are fitted along on request add to the force of the samples of a row's curve (N)."""
        curve = self.curves[self.active[row]]
        change = np.zeros(curve.h.size)
        places = np.cumsum([0, *(root.shape[0] for root in self.roots)])
        for k, late in self._late.items():
            if self.nuisances[k].kind not in self.along:
                continue
            for block, begin, end, where in zip(self.blocks, places[:-1], places[1:], self.block_rows, strict=True):
                if where == row:
                    part = block.base @ late[begin:end] * math.sqrt(self.inflation) * block.sigma
                    change[block.rows] += x[self.film_parameters + k] * part
        return change

    def interpolation_error(self, states: States) -> Array:
        """Estimated error (N) of the interpolant of each row: what the last two of its Chebyshev terms amount to."""
        count = self.nodes.shape[1]
        angle = (2 * np.arange(count) + 1) * np.pi / (2 * count)
        last = np.array([np.cos(k * angle) for k in (count - 1, count - 2)]) * 2.0 / count
        found: Array = np.abs(states.force @ last.T).max(axis=1)
        return found

    def _by_nuisance(self, nuisance: Nuisance, solved: States) -> Array:
        rows = list(nuisance.rows)
        if nuisance.kind in DIMENSIONS:
            size = [
                weight * getattr(self.curves[self.active[row]].specimen, nuisance.kind)
                for row, weight in zip(rows, nuisance.weights, strict=True)
            ]
            sized: Array = solved.by[nuisance.kind][:, rows] * np.array(size)[:, None]
            return sized
        if nuisance.kind == "force_zero":
            return np.full((len(solved.force), len(rows), self.nodes.shape[1]), nuisance.prior)
        slope = nuisance.prior * solved.by["h"][:, rows]
        return slope if nuisance.kind == "displacement_zero" else -slope * self._give[rows]

    def _by_lag(self, lag: Nuisance) -> Array:
        """What force that is one prior too late does to the weighted residual rows: it is that of where the disk was.

        Every sample has its own velocity, and so this passes by the nodes.
        """
        late = []
        for block, row in zip(self.blocks, self.block_rows, strict=True):
            curve = self.curves[self.active[row]]
            slope = interpolation_matrix(self.nodes[row], curve.place[block.rows]) @ self._stiffness[row]
            change = -lag.prior * curve.velocity[block.rows] * slope * (row in lag.rows)
            late.append((change / block.sigma) @ block.base)
        return np.concatenate(late) / math.sqrt(self.inflation)

    def _shift(self, points: Array) -> Array:
        """What the errors of the displacement add to the nodes (m), shape (S, rows, nodes)."""
        shift = np.zeros((len(points), *self.nodes.shape))
        for values, nuisance in zip(points.T[self.film_parameters :], self.nuisances, strict=True):
            rows = list(nuisance.rows)
            size = (values * nuisance.prior)[:, None, None]
            if nuisance.kind == "displacement_zero":
                shift[:, rows] += size
            elif nuisance.kind == "compliance":
                shift[:, rows] -= size * self._give[rows]
        return shift

    def _one(self, x: Array) -> Evaluation:
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self.evaluate(x[None]))
        return self._last[1]

    def _dimensions(self, points: Array) -> dict[str, Array]:
        """Factors by which the contrasts change the specimens' dimensions, (S, rows), of those that have any."""
        factors: dict[str, Array] = {}
        for values, nuisance in zip(points.T[self.film_parameters :], self.nuisances, strict=True):
            if nuisance.kind in DIMENSIONS:
                factor = factors.setdefault(nuisance.kind, np.ones((len(points), len(self.active))))
                factor += values[:, None] * np.array(nuisance.weights)
        return factors

    def _solve(self, materials: Sequence[Material], points: Array, *, slopes: bool = True) -> States:
        specimens = np.empty((len(materials), len(self.active), 1), dtype=np.object_)
        known: dict[tuple[int, int], Specimen] = {}  # the curves of one specimen share it, so that its numbers are once
        factors = self._dimensions(points)
        for s, material in enumerate(materials):
            for row, i in enumerate(self.active):
                here = self.curves[i].specimen
                key = (s, id(here))
                if key not in known:
                    known[key] = scaled_specimen(
                        here.with_material(material), {name: float(one[s, row]) for name, one in factors.items()}
                    )
                specimens[s, row, 0] = known[key]
        solved = solve_many(
            specimens,
            self.nodes + self._shift(points),
            self.voltage[:, None],
            tolerance=self.tolerance,
            wrinkling=self.wrinkling,
            sensitivities=slopes,
        )
        self.solved += solved.force.size
        return States(solved.force, solved.dforce or {}, solved.max_stretch)


@dataclass(frozen=True, eq=False)
class States:
    """The model at the nodes: arrays (rows, nodes), by mu and alpha (rows, nodes, numbers), or with S before.

    ``by`` holds the derivatives of the force, with the keys of `model.membrane.solve.Solutions.dforce`.
    """

    force: Array
    by: dict[str, Array]
    max_stretch: Array

    def __getitem__(self, index: int) -> States:
        by = {name: values[index] for name, values in self.by.items()}
        return States(self.force[index], by, self.max_stretch[index])


def scaled_specimen(specimen: Specimen, factors: Mapping[str, float]) -> Specimen:
    """The specimen with its dimensions times ``factors``, which stay positive however far a search goes astray."""
    if not factors:
        return specimen
    changed = {name: getattr(specimen, name) * max(factor, 0.1) for name, factor in factors.items()}
    if changed.get("disk_radius", 0.0) >= changed.get("ring_radius", specimen.ring_radius):
        return specimen
    return replace(specimen, **changed)


def _why_empty(curve: Curve, selection: Selection) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in selection.excluded.items())
    return f"{curve.label}: {reasons or 'no samples'}"
