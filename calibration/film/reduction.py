"""From samples to as few numbers as carry the same information about the model.

A curve of the model is smooth in the displacement, so its values ``f`` at a few Chebyshev nodes give it everywhere:
``F(h_i) = sum_j B_ij f_j`` with the barycentric matrix ``B``. With ``W = diag(1/sigma_i)`` and a factorisation
``W B = Q R`` of as many columns as its rank the misfit of any ``f`` to n samples is

    chi2(f) = |R f - Q^T W y|^2 + (|W y|^2 - |Q^T W y|^2)

so ``R`` and ``Q^T W y`` replace the samples in a fit, whose cost then does not depend on n. The second part is what no
smooth curve can explain: it measures the noise. The first part tests the model alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.material.materials import Material
from model.membrane.solve import Status, Wrinkling, solve_many

Array = NDArray[np.float64]

GRID = 33  # states at which the loss of tension is looked for along a curve
CONTACT_MARGIN = 3.0  # standard uncertainties of the displacement zero
RANK = 1e-9  # singular values of a reduced curve, relative to the largest, that carry anything but round-off
VOLTAGE_MARGIN = 0.1  # of the nominal voltage; farther off, the output was ramping or had tripped


def chebyshev_nodes(low: float, high: float, count: int) -> Array:
    """Chebyshev nodes of the first kind between ``low`` and ``high``, ascending; shape (count,)."""
    angle = (2 * np.arange(count) + 1) * np.pi / (2 * count)
    return 0.5 * (low + high) - 0.5 * (high - low) * np.cos(angle)


def interpolation_matrix(nodes: Array, points: Array) -> Array:
    """Barycentric interpolation from first-kind Chebyshev nodes to ``points``; shape (points, nodes)."""
    count = nodes.size
    weights = (-1.0) ** np.arange(count) * np.sin((2 * np.arange(count) + 1) * np.pi / (2 * count))
    difference = points[:, None] - nodes[None, :]
    hit = difference == 0.0
    terms = weights / np.where(hit, 1.0, difference)
    matrix: Array = terms / terms.sum(axis=1, keepdims=True)
    rows = hit.any(axis=1)
    matrix[rows] = hit[rows]
    return matrix


@dataclass(frozen=True, eq=False)
class Part:
    """Samples of a curve between two displacements (m) over which the model is one smooth function."""

    used: NDArray[np.bool_]
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Selection:
    """Which samples of a curve the membrane model can describe, in one or more smooth parts.

    ``excluded`` counts the others by reason, ``wrinkled`` the samples at which the film is wrinkled, used or not.
    """

    parts: tuple[Part, ...]
    excluded: dict[str, int]
    size: int
    wrinkled: int = 0

    @property
    def used(self) -> NDArray[np.bool_]:
        """Samples in any part."""
        used = np.zeros(self.size, dtype=np.bool_)
        for part in self.parts:
            used |= part.used
        return used

    @property
    def low(self) -> float:
        """Least displacement used (m); 0 when there is none."""
        return min((part.low for part in self.parts), default=0.0)

    @property
    def high(self) -> float:
        """Largest displacement used (m); 0 when there is none."""
        return max((part.high for part in self.parts), default=0.0)


def select(curves: Sequence[Curve], material: Material, wrinkling: Wrinkling = "plain") -> list[Selection]:
    """Leave out samples without a value, flagged ones, those before contact, and those the model does not describe.

    With "plain" only the taut film is described: of each curve the stretch of displacements with the most samples in
    which the film is taut throughout is kept. With "tension_field" wrinkled states are described too; a curve is cut
    where wrinkles begin or end, because the force has a kink of higher order there. Of a part without a state at one
    of its ends, at the voltage of its own samples, what lies between ends that have one is kept.
    """
    given = [_given(curve) for curve in curves]
    rows = [i for i, (used, _) in enumerate(given) if used.any()]
    grids = np.zeros((len(rows), GRID))
    voltage = np.zeros((len(rows), 1))
    for row, i in enumerate(rows):
        h = curves[i].place[given[i][0]]
        grids[row] = np.linspace(h.min(), max(h.max(), h.min() + 1e-9), GRID)
        voltage[row] = reference_voltage(curves[i], given[i][0])
    films = np.empty((len(rows), 1), dtype=np.object_)
    films[:, 0] = [curves[i].specimen.with_material(material) for i in rows]
    status = solve_many(films, grids, voltage, wrinkling=wrinkling).status
    found = []
    for i, curve in enumerate(curves):
        used, excluded = given[i]
        if i not in rows:
            found.append(Selection((), excluded, curve.h.size))
            continue
        row = rows.index(i)
        found.append(_divide(curve, used, excluded, grids[row], status[row], wrinkling))
    return _with_states(curves, found, material, wrinkling)


def _with_states(
    curves: Sequence[Curve], selections: list[Selection], material: Material, wrinkling: Wrinkling
) -> list[Selection]:
    """Leave out what has no state: the voltage of the few samples of a part may be above that of the curve."""
    parts = [(i, part) for i, selection in enumerate(selections) for part in selection.parts]
    if not parts:
        return selections
    films = np.empty((len(parts), 1), dtype=np.object_)
    films[:, 0] = [curves[i].specimen.with_material(material) for i, _ in parts]
    ends = np.array([(part.low, part.high) for _, part in parts])
    voltage = np.array([[reference_voltage(curves[i], part.used)] for i, part in parts])
    force = solve_many(films, ends, voltage, wrinkling=wrinkling).force
    for (i, part), at_ends in zip(parts, force, strict=True):
        if not np.isfinite(at_ends).all():
            rest = _with_state(curves[i], part, material, wrinkling)
            left = part.used if rest is None else part.used & ~rest.used
            one = selections[i]
            excluded = dict(one.excluded)
            _count(excluded, "no state at the voltage of these samples", left)
            kept = tuple(p if p is not part else rest for p in one.parts)
            selections[i] = replace(one, parts=tuple(p for p in kept if p is not None), excluded=excluded)
    return selections


def _with_state(curve: Curve, part: Part, material: Material, wrinkling: Wrinkling) -> Part | None:
    """What of a part is left between ends that have a state at the voltage of the samples between them."""
    film = curve.specimen.with_material(material)
    left: Part | None = part
    while left is not None:
        grid = np.linspace(left.low, left.high, GRID)
        voltage = reference_voltage(curve, left.used)
        there = np.isfinite(solve_many(film, grid, voltage, wrinkling=wrinkling).force)
        if there[0] and there[-1]:
            break
        first, last = _longest(there, curve.place[left.used], grid)
        left = _part(curve, left.used & (curve.place >= first) & (curve.place <= last))
    return left


def _part(curve: Curve, used: NDArray[np.bool_]) -> Part | None:
    """The samples ``used`` as a part; None where there are none."""
    if not used.any():
        return None
    least = float(curve.place[used].min())
    return Part(used, least, max(float(curve.place[used].max()), least + 1e-9))


def _given(curve: Curve) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Samples that hold a measurement of the film at the curve's voltage, and why the others do not."""
    excluded: dict[str, int] = {}
    used = np.ones(curve.h.size, dtype=np.bool_)
    off = np.abs(np.abs(curve.voltage) - abs(curve.nominal_voltage)) > VOLTAGE_MARGIN * abs(curve.nominal_voltage)
    flagged = np.zeros_like(used) if curve.flagged is None else curve.flagged
    for which, reason in (
        (flagged, "flagged by an instrument"),
        (~curve.usable, "without a value"),
        (off & (curve.nominal_voltage != 0.0), "away from the nominal voltage"),
        # Closer than this to the zero the tip may not touch the film yet, and a free tip pulls with no force.
        (curve.place < CONTACT_MARGIN * curve.displacement_zero, "before contact"),
    ):
        _count(excluded, reason, used & which)
        used &= ~which
    return used, excluded


def _divide(
    curve: Curve,
    given: NDArray[np.bool_],
    excluded: dict[str, int],
    grid: Array,
    status: NDArray[np.int8],
    wrinkling: Wrinkling,
) -> Selection:
    """Cut the samples ``given`` of a curve into parts, by the status of the film on a grid of displacements."""
    place = np.rint((curve.place[given] - grid[0]) / (grid[-1] - grid[0]) * (GRID - 1)).astype(np.intp)
    state = np.full(curve.h.size, -1)
    state[given] = status[place]
    wrinkled = int((state == Status.WRINKLED).sum())
    described = status == Status.TAUT
    if wrinkling == "tension_field":
        described |= status == Status.WRINKLED
    first, last = _longest(described, curve.place[given], grid)
    inside = given & (curve.place >= first) & (curve.place <= last)
    for value in np.unique(state[given & ~inside]):
        if value == Status.TAUT or (value == Status.WRINKLED and wrinkling == "tension_field"):
            reason = "next to a state that is not taut"
        else:
            reason = Status(value).name.lower().replace("_", " ")
        _count(excluded, reason, given & ~inside & (state == value))
    cuts = [first, last]
    if inside.any():
        changes = np.flatnonzero(np.diff(status)) if wrinkling == "tension_field" else np.empty(0, dtype=np.intp)
        middle = [0.5 * (grid[k] + grid[k + 1]) for k in changes if first <= grid[k] and grid[k + 1] <= last]
        cuts = [first, *middle, last]
    parts = []
    for low, high in itertools.pairwise(cuts):
        used = inside & (curve.place >= low) & ((curve.place < high) if high < last else (curve.place <= high))
        if (part := _part(curve, used)) is not None:
            parts.append(part)
    return Selection(tuple(parts), excluded, curve.h.size, wrinkled)


def _count(excluded: dict[str, int], reason: str, which: NDArray[np.bool_]) -> None:
    count = int(which.sum())
    if count:
        excluded[reason] = excluded.get(reason, 0) + count


def _longest(described: NDArray[np.bool_], h: Array, grid: Array) -> tuple[float, float]:
    """Ends of the run of grid points that are described with the most samples; an empty interval if there is none."""
    best, ends = 0, (np.inf, -np.inf)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], described.astype(np.int8), [0]))))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        low, high = float(grid[start]), float(grid[stop - 1])
        count = int(((h >= low) & (h <= high)).sum())
        if count > best:
            best, ends = count, (low, high)
    return ends


def reference_voltage(curve: Curve, used: NDArray[np.bool_]) -> float:
    """The voltage at which the model is evaluated: the root mean square, because the force is nearly linear in V^2.

    Exactly 0 where the protocol asked for 0 V: what a meter reads there is its own noise.
    """
    if curve.nominal_voltage == 0.0:
        return 0.0
    return float(np.sqrt(np.mean(curve.voltage[used] ** 2)))


@dataclass(frozen=True, eq=False)
class Block:
    """Samples of one part of a curve in one direction, reduced: ``chi2 = |root @ f - target|^2 + floor``.

    ``rows`` are their places in the curve and ``way`` their direction. ``base`` reduces them:
    ``target = base.T @ (force / sigma)``. ``noise`` are their residuals to the smooth curve nearest to them, in
    standard deviations.
    """

    rows: NDArray[np.intp]
    way: int
    sigma: Array  # (samples,)
    base: Array  # (samples, k)
    root: Array  # (k, nodes)
    target: Array  # (k,)
    floor: float
    noise: Array  # (samples,)

    @property
    def samples(self) -> int:
        """How many there are."""
        return int(self.rows.size)


@dataclass(frozen=True, eq=False)
class NodeModel:
    """The model at the nodes of a curve: force, and its derivatives by displacement (N/m) and voltage (N/V)."""

    force: Array
    by_h: Array
    by_voltage: Array


def reduce(curve: Curve, used: NDArray[np.bool_], nodes: Array, voltage: float, at: NodeModel) -> list[Block]:
    """Reduce the used samples of a part of a curve, loading and unloading apart.

    ``at`` is the latest knowledge of the model at ``nodes`` and ``voltage``. It carries each sample from its own
    voltage to ``voltage`` and turns the noise of the displacement into one of the force.
    """
    blocks = []
    for direction in (1, 0, -1):
        rows = np.flatnonzero(used & (curve.direction == direction))
        if rows.size == 0:
            continue
        matrix = interpolation_matrix(nodes, curve.place[rows])
        force = curve.force[rows]
        if voltage > 0.0:
            by_square = at.by_voltage / (2 * voltage)
            force = force - matrix @ by_square * (curve.voltage[rows] ** 2 - voltage**2)
        sigma = np.hypot(curve.force_noise, matrix @ at.by_h * curve.displacement_noise)
        matrix /= sigma[:, None]
        force = force / sigma
        base, root = np.linalg.qr(matrix)
        turn, size, root = np.linalg.svd(root)
        told = size > RANK * size[0]  # a film held at two places tells two forces, however many nodes there are
        base, root = base @ turn[:, : size.size][:, told], size[told, None] * root[: size.size][told]
        target = base.T @ force
        noise = force - base @ target
        blocks.append(
            Block(
                rows=rows,
                way=direction,
                sigma=sigma,
                base=base,
                root=root,
                target=target,
                floor=float(noise @ noise),
                noise=noise,
            )
        )
    return blocks


def noise_ratio(blocks: Sequence[Block]) -> tuple[float, int]:
    """Variance about the nearest smooth curves, in units of the stated one, and its degrees of freedom."""
    freedom = sum(block.samples - block.root.shape[0] for block in blocks)
    return (sum(block.floor for block in blocks) / freedom if freedom else 1.0), freedom


def correlation_time(blocks: Sequence[Block]) -> float:
    """How many samples carry the information of one independent sample: ``1 + 2 sum_k rho_k``, at least 1.

    The autocorrelation ``rho_k`` of the noise, pooled over all blocks, is summed until it can no longer be told from
    zero (two standard deviations, and three for the first).
    """
    total = sum(block.floor for block in blocks)
    count = sum(block.samples for block in blocks)
    if total <= 0.0:
        return 1.0
    time = 1.0
    for lag in range(1, max(block.samples for block in blocks) // 4):
        rho = sum(float(block.noise[lag:] @ block.noise[:-lag]) for block in blocks) / total
        if rho < (3.0 if lag == 1 else 2.0) / np.sqrt(count):
            break
        time += 2.0 * rho
    return time
