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
from itertools import chain
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.kernel.library import load
from model.material.gent import Gent
from model.material.law import Evaluations, Law
from model.material.materials import EPSILON_0, Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh
from model.membrane import output, ritz
from model.membrane.flat import REAL, SLOPES, Flat
from model.membrane.from_rest import CHECK_MODES, TRACE_MODES
from model.membrane.refinement import SPANS, first_modes, next_modes
from model.specimen import Specimen

MOST_MODES, MOST_ELEMENTS, MOST_PARAMETERS = 64, 5, 8
MOST_POINTS = MOST_MODES + ritz.MORE_POINTS
LAWS: tuple[type[Law], ...] = (Ogden, NeoHooke, MooneyRivlin, Yeoh, Gent)  # in the order of their numbers in law.h
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


def _films(specimens: Sequence[Specimen]) -> NDArray[np.void]:
    """Films as the kernel reads them; one that it does not know has a law without a number."""
    films = np.zeros(len(specimens), dtype=_FILM)
    numbers = films.view(np.float64).reshape(len(films), _FILM.itemsize // 8)
    materials = [specimen.material for specimen in specimens]
    numbers[:, :4] = _rows([(s.disk_radius, s.ring_radius, s.thickness, s.prestretch) for s in specimens])
    numbers[:, 4] = [m.shear_modulus for m in materials]
    numbers[:, 5] = [m.eps_r for m in materials]
    numbers[:, 6] = EPSILON_0 * numbers[:, 5]
    laws, kinds = films["law"], [(m.law, len(m.mu), len(m.alpha)) for m in materials]
    for one in set(kinds):
        law, moduli, shapes = one
        these = slice(None) if kinds.count(one) == len(kinds) else [i for i, kind in enumerate(kinds) if kind == one]
        known = law in LAWS and max(moduli, shapes) <= MOST_PARAMETERS
        laws["kind"][these] = LAWS.index(law) if known else -1
        if known:
            some = materials if isinstance(these, slice) else [materials[i] for i in these]
            laws["moduli"][these], laws["shapes"][these] = moduli, shapes
            laws["mu"][these, :moduli] = _rows([m.mu for m in some])
            laws["alpha"][these, :shapes] = _rows([m.alpha for m in some])
    return films


def _rows(rows: Sequence[tuple[float, ...]]) -> Array:
    """Rows of as many numbers each: three times as fast as NumPy's own way from a list of tuples."""
    width = len(rows[0])
    return np.fromiter(chain.from_iterable(rows), dtype=np.float64, count=len(rows) * width).reshape(len(rows), width)


def _film(specimen: Specimen) -> _Film:
    """One film, without the detour over arrays."""
    m = specimen.material
    if m.law not in LAWS or max(len(m.mu), len(m.alpha)) > MOST_PARAMETERS:
        return _Film(law=_Law(-1))
    law = _Law(LAWS.index(m.law), len(m.mu), len(m.alpha), m.mu, m.alpha)
    radii = specimen.disk_radius, specimen.ring_radius
    return _Film(*radii, specimen.thickness, specimen.prestretch, m.shear_modulus, m.eps_r, m.permittivity, law)


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
        # All at once, and none by its name: that way it takes a tenth of what the kernel does.
        front = _FRONT.unpack_from(self.answer)
        force, field, radius, hoop, meridional, stretch, error, _, status, iterations, modes, *points = front
        values: dict[str, Any] = {
            "force": force,
            "peak_field": field,
            "peak_field_radius": radius,
            "min_hoop_stress": hoop,
            "min_meridional_stress": meridional,
            "max_stretch": stretch,
            "error_estimate": error,
            "iterations": iterations,
            "modes": modes,
            "stable": status <= 1,
            "field_exceeded": field > (material.breakdown_field or math.inf),
            "stretch_exceeded": stretch > (material.max_stretch or math.inf),
            "evaluations": Evaluations(*points),
        }
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
_FILM: np.dtype[Any] = np.dtype(_Film)
_WORDS = {name: _RECORD.fields[name][1] // 8 for name in _RECORD.names or ()} if _RECORD.fields else {}
_SLOPES = {name: _WORDS["dforce"] + getattr(_Slopes, name).offset // 8 for name in (*SLOPES, "mu", "alpha")}


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
    if solver is None or not specimens:
        return left
    films = _films(specimens) if len(specimens) > 1 else _one_film(specimens[0])
    where = byref(films) if isinstance(films, _Film) else films.ctypes.data
    for most in TIERS:
        some = np.flatnonzero(left)
        of, hh, vv = which[some].astype(np.int64), h[some].astype(np.float64), voltage[some].astype(np.float64)
        found = np.zeros(len(some), dtype=_RECORD)
        task = _task(tolerance, relaxed, result.dforce is not None, most)
        data = [array.ctypes.data for array in (of, hh, vv, found)]
        solver(byref(task), where, len(specimens), data[0], len(some), *data[1:], None)
        status = found["status"]
        good = status >= 0
        if good.all() and most == 0:
            _place(result, count, specimens, which, None, found)
        else:
            _place(result, count, specimens, which, some[good], found[good])
        left[some[good]] = False
        if not (status == NEEDS_TABLE).any():
            break
    return left


def _place(
    result: Flat,
    count: Evaluations,
    specimens: Sequence[Specimen],
    which: NDArray[np.intp],
    to: NDArray[np.intp] | None,
    found: NDArray[np.void],
) -> None:
    """Write what is ``found`` of the states ``to``, or of all of them, where copying can be spared."""
    words = np.ascontiguousarray(found.view(np.float64).reshape(len(found), _RECORD.itemsize // 8).T)

    def put(into: dict[str, Any], name: str, values: NDArray[Any]) -> None:
        if to is None:
            into[name] = values
        else:
            into[name][to] = values

    for name in result.real:
        put(result.real, name, words[_WORDS[name]])
    for name in result.whole:
        put(result.whole, name, words[_WORDS[name]].view(np.int64).astype(np.intp, copy=False))
    points = words[_WORDS["mechanical"] : _WORDS["relaxed"] + 1].view(np.int64).sum(axis=1)
    for name, number in zip(("mechanical", "electric", "relaxed"), points.tolist(), strict=True):
        setattr(count, name, getattr(count, name) + number)
    every = slice(None) if to is None else to
    status = words[_WORDS["status"]].view(np.int64)
    result.status[every] = status
    put(result.flag, "stable", status <= 1)
    of = which[every]
    materials = [specimen.material for specimen in specimens]
    for name, quantity, limits in (
        ("field_exceeded", "peak_field", [m.breakdown_field or math.inf for m in materials]),
        ("stretch_exceeded", "max_stretch", [m.max_stretch or math.inf for m in materials]),
    ):
        put(result.flag, name, words[_WORDS[quantity]] > np.array(limits)[of])
    if result.dforce is None:
        return
    for name in SLOPES:
        put(result.dforce, name, words[_SLOPES[name]])
    for name, given in (("mu", [len(m.mu) for m in materials]), ("alpha", [len(m.alpha) for m in materials])):
        width = result.dforce[name].shape[1]
        slopes = words[_SLOPES[name] : _SLOPES[name] + width].T
        if min(given) < width:
            slopes = np.where(np.arange(width) >= np.array(given, dtype=np.intp)[of][:, None], np.nan, slopes)
        put(result.dforce, name, slopes)
