"""The compiled kernel (`model/kernel/membrane.c`): states of one element, by the steps of `model.membrane.ritz`.

What it leaves to others (soft wrinkled states, films of a huge span, laws that exist in Python only) is solved by the
methods for arrays, as everything is where there is no kernel.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.kernel.library import load
from model.material.gent import Gent
from model.material.law import Evaluations, Law
from model.material.materials import Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh
from model.membrane import output, ritz
from model.membrane.flat import Flat
from model.membrane.from_rest import CHECK_MODES, TRACE_MODES
from model.membrane.refinement import SPANS, first_modes, next_modes
from model.specimen import Specimen

MOST_MODES, MOST_ELEMENTS, MOST_PARAMETERS = 64, 5, 8
MOST_POINTS = MOST_MODES + ritz.MORE_POINTS
LAWS: tuple[type[Law], ...] = (Ogden, NeoHooke, MooneyRivlin, Yeoh, Gent)  # in the order of their numbers in law.h
SLOPES = ("h", "voltage", "disk_radius", "ring_radius", "thickness", "prestretch", "eps_r")
NUMBERS = (
    *("force", "peak_field", "peak_field_radius", "min_hoop_stress", "min_meridional_stress", "max_stretch"),
    *("error_estimate", "iterations", "modes"),
)
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
        ("tolerance", c_double),
    ]


class _Law(Structure):
    """`Law` in law.h."""

    _fields_ = [
        *((name, c_int64) for name in ("kind", "moduli", "shapes")),
        ("mu", c_double * MOST_PARAMETERS),
        ("alpha", c_double * MOST_PARAMETERS),
    ]


class _Film(Structure):
    """`Film` in membrane.c."""

    _fields_ = [
        *((name, c_double) for name in ("disk_radius", "ring_radius", "thickness", "prestretch")),
        *((name, c_double) for name in ("shear_modulus", "eps_r", "permittivity")),
        ("law", _Law),
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
        *((name, c_double) for name in NUMBERS[:7]),
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
    task = _Task((), tuple(firsts), relaxed, sensitivities, tolerance)
    begins = {*firsts, *(max(3, modes) for modes in firsts), CHECK_MODES}
    for modes in begins | set(TRACE_MODES) if most else begins:
        level = 0
        while modes <= (most or MOST_MODES) and (most or level < FEW_LEVELS):
            task.tables[modes] = ctypes.pointer(_table(modes)[0])
            modes, level = _table(modes)[0].next, level + 1
    return task


def _film(specimen: Specimen) -> _Film:
    """A film as the kernel reads it; one that it does not know has a law without a number."""
    m = specimen.material
    if m.law not in LAWS or max(len(m.mu), len(m.alpha)) > MOST_PARAMETERS:
        return _Film(law=_Law(-1))
    return _Film(
        specimen.disk_radius,
        specimen.ring_radius,
        specimen.thickness,
        specimen.prestretch,
        m.shear_modulus,
        m.eps_r,
        m.permittivity,
        _Law(LAWS.index(m.law), len(m.mu), len(m.alpha), m.mu, m.alpha),
    )


# Of the kernel's function: task, films and how many, film of every state, states, h, voltage; answers, unknowns.
ARGUMENTS: list[Any] = [c_void_p, c_void_p, c_int64, c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_void_p]


@lru_cache(maxsize=1)
def _solver() -> Any:
    """The kernel's function; None where there is no kernel."""
    library = load()
    if library is None:
        return None
    function = library.dea_kernel_solve
    function.restype = c_int64
    function.argtypes = ARGUMENTS
    return function


@dataclass(slots=True)
class One:
    """One solved state."""

    answer: Any  # _Answer
    kept: Any  # _Kept

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

    def attributes(self, material: Material, sensitivities: bool) -> dict[str, Any]:
        """Attributes of `model.membrane.solve.Solution`."""
        found = self.answer
        values: dict[str, Any] = {name: getattr(found, name) for name in NUMBERS}
        values["stable"] = self.answered
        values["field_exceeded"] = found.peak_field > (material.breakdown_field or math.inf)
        values["stretch_exceeded"] = found.max_stretch > (material.max_stretch or math.inf)
        values["evaluations"] = Evaluations(found.mechanical, found.electric, found.relaxed)
        values["dforce"] = self.dforce(material) if sensitivities else None
        return values

    def dforce(self, material: Material) -> dict[str, Any]:
        """The derivatives of the force, as `model.membrane.solution.Solutions` has them."""
        slopes = self.answer.dforce
        found: dict[str, Any] = {name: getattr(slopes, name) for name in SLOPES}
        return found | {
            "mu": np.array(slopes.mu[: len(material.mu)]),
            "alpha": np.array(slopes.alpha[: len(material.alpha)]),
        }


def solve_one(
    specimen: Specimen, h: float, voltage: float, *, tolerance: float, relaxed: bool, sensitivities: bool
) -> One | None:
    """One state, or None where it is left to others."""
    solver = _solver()
    if solver is None:
        return None
    film, answer, kept = _one_film(specimen), _Answer(), _Kept()
    for most in TIERS:
        task = _task(tolerance, relaxed, sensitivities, most)
        where = byref(c_double(h)), byref(c_double(voltage))
        solver(byref(task), byref(film), 1, byref(_FIRST), 1, *where, byref(answer), byref(kept))
        if answer.status != NEEDS_TABLE:
            break
    return One(answer, kept) if answer.status >= 0 else None


def hangs_slack(specimen: Specimen, h: float, voltage: float) -> bool | None:
    """Whether no tension can hold the film; None where that is left to others."""
    solver = _solver()
    if solver is None:
        return None
    found = _slack()(byref(_one_film(specimen)), h, voltage)
    return None if found < 0 else bool(found)


def warm() -> None:
    """Make what any state needs at `solve`'s own tolerance: it takes some 0.2 s, which a loop has no time for."""
    if _solver() is not None:
        for most in TIERS:
            _task(1e-8, False, False, most)


@lru_cache(maxsize=1)
def _slack() -> Any:
    library = load()
    assert library is not None
    function = library.dea_kernel_hangs_slack
    function.restype = c_int64
    function.argtypes = [c_void_p, c_double, c_double]
    return function


_one_film = lru_cache(maxsize=16)(_film)
_FIRST = c_int64(0)  # the only film of a call for one state
_RECORD: np.dtype[Any] = np.dtype(_Answer)


def solve_states(
    result: Flat,
    count: Evaluations,
    specimens: Sequence[Specimen],
    which: NDArray[np.intp],
    h: Array,
    voltage: Array,
    *,
    tolerance: float,
    relaxed: bool,
) -> NDArray[np.bool_]:
    """Write the states (S,) of ``specimens[which]`` into ``result``; tells which are left to others."""
    solver = _solver()
    left = np.ones(len(h), dtype=np.bool_)
    if solver is None:
        return left
    films = (_Film * len(specimens))(*(_film(specimen) for specimen in specimens))
    for most in TIERS:
        some = np.flatnonzero(left)
        of, hh, vv = which[some].astype(np.int64), h[some].astype(np.float64), voltage[some].astype(np.float64)
        found = np.zeros(len(some), dtype=_RECORD)
        task = _task(tolerance, relaxed, result.dforce is not None, most)
        data = [array.ctypes.data for array in (of, hh, vv, found)]
        solver(byref(task), films, len(films), data[0], len(some), *data[1:], None)
        good = found["status"] >= 0
        _place(result, specimens, which, some[good], found[good])
        for name in ("mechanical", "electric", "relaxed"):
            setattr(count, name, getattr(count, name) + int(found[name][good].sum()))
        left[some[good]] = False
        if not (found["status"] == NEEDS_TABLE).any():
            break
    return left


def _place(
    result: Flat,
    specimens: Sequence[Specimen],
    which: NDArray[np.intp],
    to: NDArray[np.intp],
    found: NDArray[np.void],
) -> None:
    for values in (result.real, result.whole):
        for name, array in values.items():
            array[to] = found[name]
    result.status[to] = found["status"]
    result.flag["stable"][to] = found["status"] <= 1
    materials = [specimen.material for specimen in specimens]
    of = which[to]
    for name, quantity, limits in (
        ("field_exceeded", "peak_field", [m.breakdown_field or math.inf for m in materials]),
        ("stretch_exceeded", "max_stretch", [m.max_stretch or math.inf for m in materials]),
    ):
        result.flag[name][to] = found[quantity] > np.array(limits)[of]
    if result.dforce is None:
        return
    slopes = found["dforce"]
    for name in SLOPES:
        result.dforce[name][to] = slopes[name]
    for name, given in (("mu", [len(m.mu) for m in materials]), ("alpha", [len(m.alpha) for m in materials])):
        width = result.dforce[name].shape[1]
        absent = np.arange(width) >= np.array(given, dtype=np.intp)[of][:, None]
        result.dforce[name][to] = np.where(absent, np.nan, slopes[name][:, :width])
