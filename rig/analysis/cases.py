"""Films given as plain data, solved: what stands behind ``dea-rig solve CASES.json``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring, Tabulated
from model.actuator.creep import creep
from model.actuator.equilibrium import Actuator
from model.material.laws import find_law
from model.material.materials import Branch, Material
from model.material.ogden import Ogden
from model.membrane.history import solve_history
from model.membrane.solve import Solutions, Status, Wrinkling, solve_many
from model.specimen import Specimen

NUMBERS = ("a", "b", "thickness", "prestretch", "h")
OPTIONAL = {"voltage": 0.0, "tolerance": 1e-8}
KEYS = ("id", *NUMBERS, *OPTIONAL, "wrinkling", "material")
ALONG = ("id", "a", "b", "thickness", "prestretch", "material", "history", "times")  # of a case along a history
DRIVES = ("h", "weight")  # of a history: displacement, or a weight that hangs on the disk; neither beside a bias
BIASES = {  # keys of each kind of bias, those that may be left out after the others
    "mass": (Mass, ("weight",), ()),
    "spring": (Spring, ("preload", "stiffness"), ()),
    "antagonist": (Antagonist, ("spacer",), ("voltage",)),
    "bistable": (Bistable, ("middle", "offset", "rate", "cubic"), ()),
    "tabulated": (Tabulated, ("displacement", "values"), ()),
}
WRINKLING = ("plain", "tension_field")


class CaseError(ValueError):
    """A case that does not describe a film; its text says which key, which value and what is allowed."""


@dataclass(frozen=True)
class HistoryCase:
    """A case along a history to be solved: of displacement ``h``, or of the ``share`` of a bias on a free disk."""

    specimen: Specimen
    t: list[float]
    h: list[float] | None
    voltage: list[float]
    times: list[float]
    tolerance: float
    sensitivities: bool
    wrinkling: Wrinkling
    bias: Bias | None = None
    share: list[float] | None = None


@dataclass(frozen=True)
class Case:
    """A case that can be solved."""

    specimen: Specimen
    h: float
    voltage: float
    tolerance: float
    wrinkling: Wrinkling


def solve_cases(cases: Any) -> list[dict[str, Any]]:
    """Solve a list of cases; the answers stand in the same order.

    A case is an object with, in SI units, ``id, a, b, thickness, prestretch, h, voltage, wrinkling`` ("plain" or
    "tension_field"), ``material {mu: [...], alpha: [...], eps_r}``, or of another law with the names of its parameters
    ``material {law: "gent", mu, Jm, eps_r}``, and optionally ``tolerance`` (relative, of the force); ``voltage`` 0,
    ``wrinkling`` "plain" and ``tolerance`` 1e-8 when left out. An answer has ``id, status, F, error_estimate,
    peak_field, min_hoop_stress, max_stretch, iterations``, the numbers None when there is no answer, and then a
    ``message``. A bad case gets the status "invalid" and does not touch its neighbours.

    A film that takes time has ``material {..., branches: [{ratio, time_s}, ...]}``, and in place of ``h`` and
    ``voltage`` the case has ``history {t: [...], h: [...], voltage: [...]}``, linear in between, and the ``times`` (s)
    at which answers are wanted. Then ``status, F, error_estimate, peak_field, min_hoop_stress`` are lists over
    ``times``; the error is over the largest force of the history, and ``tolerance`` is 1e-6 when left out. With
    ``sensitivities`` true there is also ``dF``: derivatives of F, as `model.membrane.history.History.dforce`, lists
    over ``times``, of several parameters with a list each time. Without a history the film is the relaxed one.

    Where the disk is free to move the history has a ``weight`` (N) in place of ``h``, that of a mass which hangs on it,
    or neither, and the case has ``bias {kind, ...}``: "mass" with ``weight``, "spring" with ``preload, stiffness``,
    "antagonist" with ``spacer, voltage`` (a second film like this one without its branches), "bistable" with ``middle,
    offset, rate, cubic``, "tabulated" with ``displacement, values``, as in `model.actuator.bias`. Then ``h`` is a list
    over ``times`` too, the error is that of ``h`` over the largest, and derivatives are those of h, ``dh``.

    Raises
    ------
    CaseError : ``cases`` is not a list
    """
    if not isinstance(cases, list):
        raise CaseError(f"the cases must be a JSON list of objects, not {_kind(cases)}")
    answers: list[dict[str, Any]] = []
    groups: dict[tuple[Wrinkling, float], list[tuple[int, Case]]] = {}
    for number, raw in enumerate(cases):
        name = raw.get("id") if isinstance(raw, dict) else None
        answers.append({"id": name})
        try:
            if isinstance(raw, dict) and "history" in raw:
                answers[number] |= _along(read_history_case(raw))
                continue
            case = read_case(raw)
        except (CaseError, ValueError) as error:
            answers[number] |= _numbers(None, 0) | {"status": "invalid", "message": str(error)}
        else:
            groups.setdefault((case.wrinkling, case.tolerance), []).append((number, case))
    for (wrinkling, tolerance), members in groups.items():
        films = [case.specimen for _, case in members]
        h, v = (np.array([getattr(case, key) for _, case in members]) for key in ("h", "voltage"))
        found = solve_many(films, h, v, tolerance=tolerance, wrinkling=wrinkling)
        for at, (number, _) in enumerate(members):
            status = Status(int(found.status[at]))
            answers[number] |= {"status": status.name.lower()} | _numbers(found, at)
            if not found.answered[at]:
                answers[number]["message"] = status.message
    return [{key: answer[key] for key in _ORDER if key in answer} for answer in answers]


_FIELDS = {
    "h": "h",
    "F": "force",
    "error_estimate": "error_estimate",
    "peak_field": "peak_field",
    "min_hoop_stress": "min_hoop_stress",
    "max_stretch": "max_stretch",
}
_ORDER = ("id", "status", *_FIELDS, "dF", "dh", "iterations", "message")


def _numbers(found: Solutions | None, at: int) -> dict[str, Any]:
    fields = {key: name for key, name in _FIELDS.items() if name in Solutions.__dataclass_fields__}
    if found is None:
        return dict.fromkeys(fields) | {"iterations": 0}
    values = {key: float(getattr(found, name)[at]) for key, name in fields.items()}
    return {key: value if math.isfinite(value) else None for key, value in values.items()} | {
        "iterations": int(found.iterations[at])
    }


def _along(case: HistoryCase) -> dict[str, Any]:
    """Answers of a case along a history."""
    how: Any = {"tolerance": case.tolerance, "sensitivities": case.sensitivities}
    if case.bias is None:
        course = case.t, case.h or [], case.voltage, case.times
        found = solve_history(case.specimen, *course, **how, wrinkling=case.wrinkling)
    else:
        actuator = Actuator(case.specimen, case.bias, case.wrinkling)
        found = creep(actuator, case.t, case.voltage, case.times, share=case.share or 1.0, **how)
    status = [Status(int(one)) for one in found.status]
    answer: dict[str, Any] = {"status": [one.name.lower() for one in status]}
    for key, name in _FIELDS.items():
        if hasattr(found, name) and (key != "h" or case.bias is not None):
            answer[key] = _or_none(getattr(found, name).tolist())
    for key, slopes in (("dF", found.dforce), ("dh", found.dh)):
        if slopes is not None:
            answer[key] = {name: _or_none(value.tolist()) for name, value in slopes.items()}
    lost = [one.message for one in status if one > Status.WRINKLED]
    return answer | {"iterations": found.steps} | ({"message": lost[0]} if lost else {})


def _or_none(value: Any) -> Any:
    """Numbers in lists, None for those that are not finite."""
    if isinstance(value, list):
        return [_or_none(one) for one in value]
    return value if math.isfinite(value) else None


def read_history_case(raw: Any) -> HistoryCase:
    """One case along a history, checked.

    Raises
    ------
    CaseError, ValueError : the case does not describe a film or a history
    """
    table = _table(raw, "the case", (*ALONG, "bias", "wrinkling", "tolerance", "sensitivities"), ALONG)
    history = _table(table["history"], "history", ("t", *DRIVES, "voltage"), ("t",))
    t, times = _list(history["t"], "history.t"), _list(table["times"], "times")
    voltage = _list(history.get("voltage", [0.0] * len(t)), "history.voltage")
    a, b, thickness, prestretch = (_number(table[key], key) for key in ("a", "b", "thickness", "prestretch"))
    film = Specimen(a, b, thickness, prestretch, _material(table["material"]))
    tolerance = _number(table.get("tolerance", 1e-6), "tolerance")
    slopes = table.get("sensitivities", False)
    if not isinstance(slopes, bool):
        raise CaseError(f"sensitivities must be true or false, not {_kind(slopes)}")
    given = [key for key in DRIVES if key in history] + ["bias"] * ("bias" in table)
    if not given:
        raise CaseError("history lacks the key 'h', or 'weight' where the disk is free, or the case a 'bias'")
    if len(given) > 1:
        raise CaseError(f"the case has {' and '.join(given)}; a disk is held (h), or free under a weight or a bias")
    case = HistoryCase(film, list(t), None, list(voltage), list(times), tolerance, slopes, _wrinkling(table))
    if given == ["bias"]:
        return replace(case, bias=_bias(table["bias"], film))
    drive = list(_list(history[given[0]], f"history.{given[0]}"))
    if given == ["h"]:
        return replace(case, h=drive)
    if min(drive, default=0.0) < 0.0:
        raise CaseError(f"history.weight = {min(drive):g}: a weight is 0 or more; it pushes to positive h")
    return replace(case, bias=Mass(1.0), share=drive)


def _bias(raw: Any, film: Specimen) -> Bias:
    """What pushes the disk."""
    kind = raw.get("kind") if isinstance(raw, dict) else None
    if isinstance(raw, dict) and not (isinstance(kind, str) and kind in BIASES):
        raise CaseError(f"bias.kind = {kind!r}: allowed are {', '.join(BIASES)}")
    law, needed, optional = BIASES[kind or "mass"]
    table = _table(raw, "bias", ("kind", *needed, *optional), needed)
    read = _list if law is Tabulated else _number
    values: dict[str, Any] = {key: read(table[key], f"bias.{key}") for key in (*needed, *optional) if key in table}
    if law is Antagonist:
        values["film"] = film.with_material(replace(film.material, branches=()))
    return cast(Bias, law(**values))


def _wrinkling(table: dict[str, Any]) -> Wrinkling:
    wrinkling = table.get("wrinkling", "plain")
    if wrinkling not in WRINKLING:
        raise CaseError(f'wrinkling = {wrinkling!r}: allowed are "plain" and "tension_field"')
    return cast(Wrinkling, wrinkling)


def read_case(raw: Any) -> Case:
    """One case, checked.

    Raises
    ------
    CaseError, ValueError : the case does not describe a film
    """
    table = _table(raw, "the case", KEYS, ("id", *NUMBERS, "material"))
    material = _material(table["material"])
    wrinkling = _wrinkling(table)
    values = {key: _number(table[key], key) for key in NUMBERS}
    values |= {key: _number(table.get(key, default), key) for key, default in OPTIONAL.items()}
    if not 1e-12 <= values["tolerance"] <= 1e-2:
        raise CaseError(f"tolerance = {values['tolerance']!r}: allowed are 1e-12 to 1e-2")
    film = Specimen(
        disk_radius=values["a"],
        ring_radius=values["b"],
        thickness=values["thickness"],
        prestretch=values["prestretch"],
        material=material,
    )
    return Case(film, values["h"], values["voltage"], values["tolerance"], wrinkling)


def _material(raw: Any) -> Material:
    """The film: a law, Ogden's when none is named, its parameters by their names, and the permittivity."""
    name = raw.get("law", Ogden.name) if isinstance(raw, dict) else Ogden.name
    if not isinstance(name, str):
        raise CaseError(f"material.law must be the name of a law, not {_kind(name)}")
    law = find_law(name)
    names = tuple(p.name for p in law.parameters(*law.counts(1)))
    table = _table(raw, "material", ("law", *names, "eps_r", "branches"), (*names, "eps_r"))
    values = {
        key: _list(table[key], f"material.{key}") if law.series else _number(table[key], f"material.{key}")
        for key in names
    }
    material = Material.with_law("case", law, values, _number(table["eps_r"], "material.eps_r"))
    branches = table.get("branches", [])
    if not isinstance(branches, list):
        raise CaseError(f"material.branches must be a list of objects, not {_kind(branches)}")
    return replace(material, branches=tuple(_branch(one, number) for number, one in enumerate(branches, start=1)))


def _branch(raw: Any, number: int) -> Branch:
    where = f"material.branches {number}"
    table = _table(raw, where, ("ratio", "time_s"), ("ratio", "time_s"))
    return Branch(*(_number(table[key], f"{where}.{key}") for key in ("ratio", "time_s")))


def _kind(value: Any) -> str:
    return {dict: "an object", list: "a list", str: "a text", type(None): "null"}.get(type(value), repr(value))


def _table(raw: Any, name: str, allowed: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise CaseError(f"{name} must be an object, not {_kind(raw)}")
    if unknown := [key for key in raw if key not in allowed]:
        raise CaseError(f"{name} has an unknown key {unknown[0]!r}; allowed are {', '.join(allowed)}")
    if missing := [key for key in needed if key not in raw]:
        raise CaseError(f"{name} lacks the key {missing[0]!r}")
    return raw


def _number(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaseError(f"{key} must be a number, not {_kind(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise CaseError(f"{key} = {value}: it must be finite")
    return number


def _list(values: Any, key: str) -> tuple[float, ...]:
    if not isinstance(values, list):
        raise CaseError(f"{key} must be a list of numbers, not {_kind(values)}")
    return tuple(_number(value, f"{key}[{i}]") for i, value in enumerate(values))
