"""Values that are possible but hardly meant: a length in the wrong unit, a limit that limits nothing.

A key that has a usual range declares it beside its description: ``json_schema_extra={"usual": [5, 2000]}``. A value
outside that range is refused with the probable slip, unless the file says that it is meant:
``accept = ["specimen.thickness_um"]`` at its top.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rig.base.errors import ConfigError

EPSILON_0 = 8.8541878188e-12  # F/m
PREFIXES = {"p": -12, "n": -9, "u": -6, "m": -3, "": 0, "k": 3, "M": 6}
UNITS = {"m": "num ", "N": "um ", "Pa": " kM", "V": "m k", "A": "pnum ", "s": "um ", "Hz": " k", "J": "um ", "g": "m k"}
_UNIT = re.compile(r"_(?P<prefix>[numkM]?)(?P<unit>Pa|Hz|[mNVAsJg])(?:_per_(?P<below>[a-zA-Z0-9]+))?$")


def usual_of(field: FieldInfo | None) -> tuple[float, float] | None:
    """The usual range that a key declares; None when it declares none."""
    extra = field.json_schema_extra if field is not None else None
    usual = extra.get("usual") if isinstance(extra, dict) else None
    return (float(usual[0]), float(usual[1])) if isinstance(usual, list) else None  # type: ignore[arg-type]


def check_usual(table: BaseModel, kind: str, source: str) -> None:
    """Refuse what is hardly meant and not accepted by name.

    Raises
    ------
    ConfigError
        Naming file, key, value, usual range, the probable slip, and how to say that it is meant.
    """
    accepted = set(getattr(table, "accept", ()))
    found = [(name, line) for name, line in _unusual(table, "", "") if name not in accepted]
    if not found:
        return
    names = ", ".join(f'"{name}"' for name in dict.fromkeys([*sorted(accepted), *(name for name, _ in found)]))
    lines = "\n".join(f"  {line}" for _, line in found[:10])
    raise ConfigError(
        f"{source}: this {kind} file holds values that are hardly meant.\n{lines}\n"
        f"  If they are meant, put this line above the first table of the file: accept = [{names}]"
    )


def _unusual(table: BaseModel, name: str, place: str) -> Iterator[tuple[str, str]]:
    """Dotted name, and what is to be told of it, of each unusual value."""
    own = getattr(table, "unusual", None)
    if own is not None:
        for key, text in own():
            yield f"{name}{key}", f"{place}{text}"
    for key, field in type(table).model_fields.items():
        value = getattr(table, key)
        usual = usual_of(field)
        items = value if isinstance(value, list) else [value]
        for number, item in enumerate(items):
            where = f"{place}{key}" + (f" {number + 1}" if isinstance(value, list) else "")
            if isinstance(item, BaseModel):
                yield from _unusual(item, f"{name}{key}.", f"{where}, ")
            elif usual is not None and isinstance(item, int | float) and not _within(item, usual):
                hint = slip(key, item, usual)
                yield f"{name}{key}", f"{where} = {item:.10g}: usual are {usual[0]:g} to {usual[1]:g}. {hint}".rstrip()


def _within(value: float, usual: tuple[float, float]) -> bool:
    return usual[0] <= value <= usual[1] or value == 0.0  # zero is a choice, not a slip of the unit


def slip(key: str, value: float, usual: tuple[float, float]) -> str:
    """What was probably meant: the value in another unit, a percentage in place of a ratio, or a decimal point."""
    if "stretch" in key:
        readings = [(f"{value:g} %", 1 + value / 100), (f"a strain of {value:g}", 1 + value)]
        for meant, ratio in reversed(readings) if value < 1 else readings:
            if value > 0 and usual[0] <= ratio <= usual[1]:
                return f"If {meant} is meant, write {ratio:g}."
    if key == "eps_r" and usual[0] <= value / EPSILON_0 <= usual[1]:
        return f"If {value:g} F/m is meant, write {value / EPSILON_0:.3g}: it is relative to that of empty space."
    for unit, factor in _other_units(key):
        if usual[0] <= value * factor <= usual[1]:
            return f"If {value:.10g} {unit} is meant, write {value * factor:.10g}."
    without_point = [f"{value / part:.10g}" for part in (10, 100) if value > usual[1] >= value / part >= usual[0]]
    return f"If the decimal point is missing, write {' or '.join(without_point)}." if without_point else ""


def _other_units(key: str) -> list[tuple[str, float]]:
    """Units in which the value may have been thought, nearest first, and the factor from each to the key's own."""
    found = _UNIT.search(key)
    if found is None:
        return []
    prefix, unit, below = found["prefix"], found["unit"], found["below"] or ""
    per = f"/{below}" if below else ""
    own = PREFIXES[prefix]
    lengths = {"um": -6, "mm": -3, "m": 0} if below in ("um", "mm") else {}  # V/um thought in V/m
    others = [(f"{prefix}{unit}/{b}", lengths[below] - e) for b, e in lengths.items() if b != below]
    others += [(f"{p.strip()}{unit}{per}", PREFIXES[p.strip()] - own) for p in UNITS[unit] if p.strip() != prefix]
    return [(name, 10.0**power) for name, power in sorted(others, key=lambda one: abs(one[1]))]


def slip_of(table: type[BaseModel], key: str, value: float) -> str:
    """What was probably meant by a value of a table's key; empty when it is usual or that cannot be told."""
    usual = usual_of(table.model_fields[key])
    return "" if usual is None or _within(value, usual) else slip(key, value, usual)
