"""The compiled kernel (`model/kernel/membrane.c`): states of one element, by the steps of `model.membrane.ritz`.

What it leaves to others (soft wrinkled states, films of a huge span, laws that exist in Python only) is solved by the
methods for arrays, as everything is where there is no kernel.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from functools import lru_cache
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.kernel.film import MOST_PARAMETERS
from model.kernel.library import load
from model.material.law import Evaluations
from model.material.materials import Material
from model.membrane import output, ritz
from model.membrane.flat import REAL, SLOPES, WHOLE, Flat
from model.membrane.from_rest import CHECK_MODES, TRACE_MODES
from model.membrane.refinement import SPANS, first_modes, next_modes
from model.membrane.solution import Status
from model.specimen import Specimen

MOST_MODES, MOST_ELEMENTS = 64, 5
MOST_POINTS = MOST_MODES + ritz.MORE_POINTS
NEEDS_TABLE = -2  # in place of a status, of which the negative ones are left to others
FEW_LEVELS = 3  # resolutions whose tables are made at once; most states need two
# Tables for so many modes: the first levels only, those that nearly all states can do with, all. The last are large.
TIERS = (0, 36, MOST_MODES)


class _Table(Structure):
    """`Table` in ritz.h."""

    _fields_ = [(name, c_int64) for name in ("modes", "points", "next")] + [
        (name, POINTER(c_double))
        for name in (
            *(
                "xi",
                "weight",
                "values",
                "project",
                "pairs",
                "ends",
                "end_slopes",
                "integrate",
                "to_modes",
                "edge_tests",
            ),
            *("fine", "fine_xi", "legendre", "carry", "check"),
        )
    ]


class _Task(Structure):
    """`Task` in membrane.c."""

    _fields_ = [
        ("tables", POINTER(_Table) * (MOST_MODES + 1)),
        ("first_modes", c_int64 * len(SPANS)),
        ("relaxed", c_int64),
        ("sensitivities", c_int64),
        ("lanes", c_int64),
        ("tolerance", c_double),
    ]


class _Slopes(Structure):
    """`Slopes` in membrane.c."""

    _fields_ = [
        *((name, c_double) for name in SLOPES),
        ("mu", c_double * MOST_PARAMETERS),
        ("alpha", c_double * MOST_PARAMETERS),
    ]


class _Answer(Structure):
    """`Answer` in membrane.c."""

    _fields_ = [
        *((name, c_double) for name in REAL),
        ("lam", c_double),
        *((name, c_int64) for name in ("status", "iterations", "modes", "mechanical", "electric", "relaxed")),
        ("dforce", _Slopes),
    ]


class _State(Structure):
    """`State` in ritz.h."""

    _fields_ = [("c", c_double * (MOST_MODES + 2)), ("w", c_double * MOST_POINTS)]


class _Kept(Structure):
    """`Kept` in membrane.c."""

    _fields_ = [
        ("elements", c_int64),
        ("folded", c_int64 * MOST_ELEMENTS),
        ("breaks", c_double * (MOST_ELEMENTS + 1)),
        ("state", _State * MOST_ELEMENTS),
        ("natural", c_double * MOST_POINTS * MOST_ELEMENTS),
    ]


_FRONT = Struct("8d6q")  # an answer up to its derivatives
_BY_NUMBERS = Struct(f"{len(SLOPES)}d")  # and these up to those by moduli
_STATUSES = tuple(Status)


@lru_cache(maxsize=MOST_MODES)
def _table(modes: int) -> tuple[_Table, list[Array]]:
    """Tables of `model.membrane.ritz` as the kernel reads them, and the arrays that must outlive them."""
    t, after = ritz.table(modes), next_modes(modes) if modes < MOST_MODES else MOST_MODES + 1
    functions = t.values.reshape(2, t.points, modes + 2)
    arrays = {
        "xi": t.xi,
        "weight": t.weight,
        "values": functions.transpose(0, 2, 1),
        "project": functions.transpose(1, 0, 2),
        "pairs": t.pairs.reshape(-1, 3, t.points).transpose(2, 1, 0),
        "ends": t.ends,
        "end_slopes": t.end_slopes,
        "integrate": t.integrate,
        "to_modes": t.to_modes,
        "edge_tests": np.array(output.edge_tests(modes)),
        "fine": output.fine_table(modes).T,
        "fine_xi": -np.cos(np.linspace(0.0, np.pi, output.FINE)),
        "legendre": t.to_legendre.T,
        "carry": ritz.transfer(modes, min(after, MOST_MODES)),
        "check": ritz.transfer(modes, CHECK_MODES),
    }
    kept = {name: np.ascontiguousarray(values, dtype=np.float64) for name, values in arrays.items()}
    pointers = {name: values.ctypes.data_as(POINTER(c_double)) for name, values in kept.items()}
    return _Table(modes=modes, points=t.points, next=after, **pointers), list(kept.values())


@lru_cache(maxsize=64)
def _task(tolerance: float, relaxed: bool, sensitivities: bool, most: int) -> _Task:
    """What the states of a call share; tables of every resolution up to ``most`` modes, of the first ones when 0."""
    firsts = [first_modes(span, tolerance) for span in SPANS]
    task = _Task((), tuple(firsts), relaxed, sensitivities, 0, tolerance)
    begins = {*firsts, *(max(3, modes) for modes in firsts), CHECK_MODES}
    for modes in begins | set(TRACE_MODES) if most else begins:
        level = 0
        while modes <= (most or MOST_MODES) and (most or level < FEW_LEVELS):
            task.tables[modes] = ctypes.pointer(_table(modes)[0])
            modes, level = _table(modes)[0].next, level + 1
    return task


# Of the kernel's function: task, films and how many, film of every state, states, h, voltage; answers, unknowns.
ARGUMENTS: list[Any] = [c_void_p, c_void_p, c_int64, c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_void_p]


@lru_cache(maxsize=1)
def _kernel() -> Any:
    """The kernel with its functions; None where there is none."""
    kernel = load()
    if kernel is not None:
        kernel.dea_kernel_solve.restype = kernel.dea_kernel_solve_one.restype = c_int64
        kernel.dea_kernel_solve.argtypes = ARGUMENTS
        kernel.dea_kernel_hangs_slack.restype = c_int64
        kernel.dea_kernel_hangs_slack.argtypes = [c_void_p, c_double, c_double]
    return kernel


class One(Structure):
    """One state and what the kernel finds of it: `Single` in membrane.c."""

    _fields_ = [
        ("h", c_double),
        ("voltage", c_double),
        ("answer", _Answer),
        ("kept", _Kept),
    ]

    @property
    def lam(self) -> float:
        return float(self.answer.lam)

    @property
    def answered(self) -> bool:
        """Whether there is a force."""
        return int(self.answer.status) <= 1

    def arrays(self) -> tuple[ritz.Grid, ritz.State]:
        """The state as the rest of the model has it."""
        kept, n, m = self.kept, self.answer.modes, self.kept.elements
        grid = ritz.Grid.lay(n, np.array(kept.breaks[: m + 1])[:, None])
        parts = [kept.state[k] for k in range(m)]
        c = np.concatenate([part.c[:n] for part in parts] + [[part.c[n + 1] for part in parts[:-1]]])[:, None]
        w = np.array([part.w[: n + ritz.MORE_POINTS] for part in parts]).T[:, :, None]
        if not any(kept.folded):
            return grid, ritz.State(c, w)
        natural = np.array([kept.natural[k][: n + ritz.MORE_POINTS] for k in range(m)]).T[:, :, None]
        relaxed = np.broadcast_to(np.array(kept.folded[:m], dtype=np.bool_)[:, None], w.shape)
        return grid, ritz.State(c, w, natural, relaxed)

    def attributes(self, specimen: Specimen, h: float, voltage: float, sensitivities: bool) -> dict[str, Any]:
        """Attributes of `model.membrane.solve.Solution`."""
        # All at once, and none by its name: that way it takes a fifth of what the kernel does.
        front = _FRONT.unpack_from(self, _ANSWER)
        force, field, radius, hoop, meridional, stretch, error, _, status, iterations, modes, *points = front
        material = specimen.material
        return {
            "specimen": specimen,
            "h": h,
            "voltage": voltage,
            "force": force,
            "peak_field": field,
            "peak_field_radius": radius,
            "min_hoop_stress": hoop,
            "min_meridional_stress": meridional,
            "max_stretch": stretch,
            "status": _STATUSES[status],
            "error_estimate": error,
            "iterations": iterations,
            "modes": modes,
            "stable": status <= 1,
            "field_exceeded": field > (material.breakdown_field or math.inf),
            "stretch_exceeded": stretch > (material.max_stretch or math.inf),
            "dforce": self.dforce(material) if sensitivities else None,
            "evaluations": Evaluations(*points),
            "kept": None,
            "quick": self,
        }

    def dforce(self, material: Material) -> dict[str, Any]:
        """The derivatives of the force, as `model.membrane.solution.Solutions` has them."""
        found: dict[str, Any] = dict(zip(SLOPES, _BY_NUMBERS.unpack_from(self, _ANSWER + _FRONT.size), strict=True))
        memory: Any = self
        for name, given in (("mu", len(material.mu)), ("alpha", len(material.alpha))):
            found[name] = np.frombuffer(memory, np.float64, given, _ANSWER + 8 * _SLOPES[name])
        return found


_ANSWER = One.answer.offset


def solve_one(
    specimen: Specimen, h: float, voltage: float, *, tolerance: float, relaxed: bool, sensitivities: bool
) -> One | None:
    """One state, or None where it is left to others."""
    kernel = _kernel()
    if kernel is None:
        return None
    for most in TIERS:
        task = _task(tolerance, relaxed, sensitivities, most)
        one = One(h, voltage)
        status = kernel.dea_kernel_solve_one(byref(task), specimen.record, byref(one))
        if status != NEEDS_TABLE:
            break
    return one if status >= 0 else None


def hangs_slack(specimen: Specimen, h: float, voltage: float) -> bool | None:
    """Whether no tension can hold the film; None where that is left to others."""
    kernel = _kernel()
    if kernel is None:
        return None
    found = kernel.dea_kernel_hangs_slack(specimen.record, h, voltage)
    return None if found < 0 else bool(found)


def warm() -> None:
    """Make what any state needs at `solve`'s own tolerance: it takes some 0.2 s, which a loop has no time for."""
    if _kernel() is not None:
        for most in TIERS:
            _task(1e-8, False, False, most)


_NONE = np.empty(0, dtype=np.intp)
_RECORD: np.dtype[Any] = np.dtype(_Answer)
_WORDS = {name: _RECORD.fields[name][1] // 8 for name in _RECORD.names or ()} if _RECORD.fields else {}
_SLOPES = {name: _WORDS["dforce"] + getattr(_Slopes, name).offset // 8 for name in (*SLOPES, "mu", "alpha")}


def solve_states(
    specimens: Sequence[Specimen],
    which: NDArray[np.intp],
    h: Array,
    voltage: Array,
    *,
    tolerance: float,
    relaxed: bool,
    sensitivities: bool,
) -> tuple[Flat, Evaluations, NDArray[np.bool_]] | None:
    """The states (S,) of ``specimens[which]``, what they cost, and which are left to others; None without a kernel."""
    kernel = _kernel()
    if kernel is None or not specimens:
        return None
    films, found = b"".join([specimen.record for specimen in specimens]), np.zeros(len(h), dtype=_RECORD)
    some: slice | NDArray[np.intp] = slice(None)
    for most in TIERS:
        task, part = _task(tolerance, relaxed, sensitivities, most), found[some]
        given = np.ascontiguousarray(which[some], dtype=np.int64), h[some], voltage[some], part
        of, *data = [array.ctypes.data for array in given]
        left = kernel.dea_kernel_solve(byref(task), films, len(specimens), of, len(part), *data, None)
        if most:
            found[some] = part
        some = np.flatnonzero(found["status"] == NEEDS_TABLE) if left else _NONE
        if len(some) == 0:
            break
    return _placed(specimens, which, found, sensitivities)


def _placed(
    specimens: Sequence[Specimen], which: NDArray[np.intp], found: NDArray[np.void], sensitivities: bool
) -> tuple[Flat, Evaluations, NDArray[np.bool_]]:
    """What is ``found`` in columns; where there is no answer yet the status is INVALID."""
    words = np.ascontiguousarray(found.view(np.float64).reshape(len(found), _RECORD.itemsize // 8).T)
    whole = words.view(np.int64)
    status = whole[_WORDS["status"]].astype(np.int8)
    left = status < 0
    status[left] = Status.INVALID
    materials = [specimen.material for specimen in specimens]
    strength = np.array([m.breakdown_field or math.inf for m in materials])[which]
    elongation = np.array([m.max_stretch or math.inf for m in materials])[which]
    result = Flat(
        real={name: words[_WORDS[name]] for name in REAL},
        whole={name: whole[_WORDS[name]].astype(np.intp, copy=False) for name in WHOLE},
        flag={
            "stable": status <= 1,
            "field_exceeded": words[_WORDS["peak_field"]] > strength,
            "stretch_exceeded": words[_WORDS["max_stretch"]] > elongation,
        },
        status=status,
    )
    if sensitivities:
        result.dforce = {name: words[_SLOPES[name]] for name in SLOPES}
        for name, given in (("mu", [len(m.mu) for m in materials]), ("alpha", [len(m.alpha) for m in materials])):
            slopes = words[_SLOPES[name] : _SLOPES[name] + max(given)].T
            if min(given) < max(given):
                slopes[np.arange(max(given)) >= np.array(given)[which][:, None]] = np.nan
            result.dforce[name] = slopes
    points = whole[_WORDS["mechanical"] : _WORDS["relaxed"] + 1].sum(axis=1)
    return result, Evaluations(*points.tolist()), left
