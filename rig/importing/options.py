"""What a person says about a table: on the command line, or in a small TOML file beside the data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from rig.base.errors import ConfigError
from rig.base.table import Table
from rig.base.toml_file import load_table
from rig.importing.headings import DIMENSION, fold
from rig.importing.kinds import KINDS, kind_in

Branch = Literal["first-loading", "loading", "unloading", "all"]
BRANCHES = ("first-loading", "loading", "unloading", "all")
SUFFIX = ".import.toml"
# Other words for the quantities, as people type them in options.
ALIASES = {
    "nominal stress": "stress",
    "engineering stress": "stress",
    "engineering strain": "strain",
    "hencky": "true strain",
    "extension": "displacement",
    "position": "displacement",
    "hv": "voltage",
    "load": "force",
    "cauchy stress": "true stress",
}
QUANTITIES = (*DIMENSION, "stretch1", "stretch2", "stress1", "stress2", "specimen", "cycle")


class ImportTable(Table):
    """The file ``DATA.import.toml`` beside ``DATA.csv``: the same options as on the command line."""

    column: dict[str, str | int] = Field(
        default={}, description="Quantity = heading or number (from 1) of its column, e.g. force = 'Load (kgf)'."
    )
    unit: dict[str, str] = Field(
        default={},
        description="Quantity or heading = unit of its column, e.g. force = 'kgf'; goes before the file's own.",
    )
    sign: dict[str, Literal["+", "-"]] = Field(
        default={}, description="Quantity = '-' where the column counts the other way; default '+'."
    )
    zero: dict[str, float | Literal["first"]] = Field(
        default={},
        description="Quantity = what the column shows at rest, in the column's unit, or 'first' for its first "
        "value; it is taken off.",
    )
    factor: dict[str, float] = Field(
        default={}, description="Quantity = factor on the column's values, e.g. of a gear or an amplifier."
    )
    kind: str | None = Field(default=None, description="Kind of test: uniaxial, equibiaxial, 'pure shear' or biaxial.")
    area_mm2: float | None = Field(
        default=None,
        gt=0,
        description="Cross-section (mm2) of the undeformed specimen, typical 1 to 100: stress = force over area.",
    )
    length_mm: float | None = Field(
        default=None,
        gt=0,
        description="Length (mm) of the undeformed specimen between the points that the extension belongs to, "
        "typical 10 to 100.",
    )
    voltage_V: list[float] = Field(
        default=[], description="Voltage (V) of each sweep in turn, or one for all, where no column tells it."
    )
    rows: list[str] = Field(default=[], description="Lines of the file to use, e.g. ['14-313', '400-']; default all.")
    branch: Literal["first-loading", "loading", "unloading", "all"] | None = Field(
        default=None,
        description="Which branches of load cycles to use; default first-loading for tests of sheets, all for cones.",
    )
    specimen: list[str] = Field(
        default=[], description="Names or numbers (from 1) of the specimens to use; default all."
    )
    separator: str | None = Field(
        default=None, description="What parts the columns: tab, ';', ',', '|' or blanks; default: judged."
    )
    decimal: Literal[".", ","] | None = Field(default=None, description="Decimal sign; default: judged.")
    encoding: str | None = Field(default=None, description="Encoding of the text, e.g. cp1252; default: judged.")


@dataclass(frozen=True)
class ImportOptions:
    """Everything that a person has said about one table. Keys of the mappings are quantities, or folded headings."""

    column: Mapping[str, str] = field(default_factory=dict)
    unit: Mapping[str, str] = field(default_factory=dict)
    sign: Mapping[str, float] = field(default_factory=dict)
    zero: Mapping[str, float | None] = field(default_factory=dict)  # None: the first value
    factor: Mapping[str, float] = field(default_factory=dict)
    kind: str | None = None
    area: float | None = None  # m2
    length: float | None = None  # m
    voltage: tuple[float, ...] = ()
    rows: tuple[tuple[int, int], ...] = ()
    branch: Branch | None = None
    specimen: tuple[str, ...] = ()
    separator: str | None = None
    decimal: str | None = None
    encoding: str | None = None

    def has(self, line: int) -> bool:
        """Whether a line of the file is to be used."""
        return not self.rows or any(low <= line <= high for low, high in self.rows)

    def over(self, other: ImportOptions) -> ImportOptions:
        """These options, and those of ``other`` where these say nothing."""
        merged: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            mine, theirs = getattr(self, name), getattr(other, name)
            if isinstance(mine, Mapping):
                merged[name] = {**theirs, **mine}
            else:
                merged[name] = mine if mine not in (None, ()) else theirs
        return replace(self, **merged)

    def to_table(self) -> dict[str, Any]:
        """What is said here, with the keys and units of `ImportTable`; what is not said is left out."""
        table = {
            "column": dict(self.column),
            "unit": dict(self.unit),
            "sign": {key: "-" if value < 0.0 else "+" for key, value in self.sign.items()},
            "zero": {key: "first" if value is None else value for key, value in self.zero.items()},
            "factor": dict(self.factor),
            "kind": self.kind,
            "area_mm2": None if self.area is None else _before(self.area, 1e-6),
            "length_mm": None if self.length is None else _before(self.length, 1e-3),
            "voltage_V": list(self.voltage),
            "rows": [f"{low}-{high}" for low, high in self.rows],
            "branch": self.branch,
            "specimen": list(self.specimen),
            "separator": self.separator,
            "decimal": self.decimal,
            "encoding": self.encoding,
        }
        return {key: value for key, value in table.items() if value not in (None, {}, [])}


def from_words(
    *,
    column: Iterable[str] = (),
    unit: Iterable[str] = (),
    sign: Iterable[str] = (),
    zero: Iterable[str] = (),
    factor: Iterable[str] = (),
    kind: str | None = None,
    area_mm2: float | None = None,
    length_mm: float | None = None,
    voltage: str | None = None,
    rows: str | None = None,
    branch: Any = None,
    specimen: Iterable[str] = (),
    separator: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
) -> ImportOptions:
    """The options as typed on the command line: ``force="Load (kgf)"``, ``14-313``, ``0,1000,1500``.

    Raises
    ------
    ConfigError
        Naming the option and what is wrong with it.
    """
    return ImportOptions(
        column={_quantity(key, "--column"): value for key, value in _pairs(column, "--column")},
        unit={_key(key): value for key, value in _pairs(unit, "--unit")},
        sign={_quantity(key, "--sign"): _sign(value) for key, value in _pairs(sign, "--sign")},
        zero={
            _quantity(key, "--zero"): None if value in ("", "first") else _number(value, "--zero")
            for key, value in _pairs((one if "=" in one else f"{one}=first" for one in zero), "--zero")
        },
        factor={_quantity(key, "--factor"): _number(value, "--factor") for key, value in _pairs(factor, "--factor")},
        kind=None if kind is None else _kind(kind),
        area=None if area_mm2 is None else area_mm2 * 1e-6,
        length=None if length_mm is None else length_mm * 1e-3,
        voltage=() if voltage is None else tuple(_number(part, "--voltage") for part in voltage.split(",")),
        rows=() if rows is None else tuple(_span(part) for part in rows.split(",")),
        branch=branch,
        specimen=tuple(specimen),
        separator=_separator(separator),
        decimal=decimal,
        encoding=encoding,
    )


def beside(path: Path) -> tuple[ImportOptions, Path | None]:
    """The options in ``DATA.import.toml`` beside ``DATA.csv``, if there is such a file, and its path."""
    for file in (path.with_name(path.name + SUFFIX), path.with_name(path.stem + SUFFIX)):
        if file.is_file():
            return from_file(file), file
    return ImportOptions(), None


def from_file(path: Path) -> ImportOptions:
    """The options in a TOML file. Raises `ConfigError`."""
    table, _ = load_table(path, ImportTable, "import")
    try:
        return from_words(
            column=[f"{key}={value}" for key, value in table.column.items()],
            unit=[f"{key}={value}" for key, value in table.unit.items()],
            sign=[f"{key}={value}" for key, value in table.sign.items()],
            zero=[f"{key}={value}" for key, value in table.zero.items()],
            factor=[f"{key}={value}" for key, value in table.factor.items()],
            kind=table.kind,
            area_mm2=table.area_mm2,
            length_mm=table.length_mm,
            voltage=",".join(map(str, table.voltage_V)) or None,
            rows=",".join(table.rows) or None,
            branch=table.branch,
            specimen=table.specimen,
            separator=table.separator,
            decimal=table.decimal,
            encoding=table.encoding,
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _before(value: float, factor: float) -> float:
    """The number that makes ``value`` to the last bit when it is multiplied by ``factor``."""
    near = (round(value / factor, 12), value / factor)
    return next((one for one in near if one * factor == value), near[1])


def _pairs(words: Iterable[str], option: str) -> list[tuple[str, str]]:
    pairs = []
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key.strip() or not value.strip():
            raise ConfigError(f"{option} {word!r}: NAME=VALUE is needed, for instance {option} force=...")
        pairs.append((key.strip(), value.strip()))
    return pairs


def _quantity(text: str, option: str) -> str:
    found = _key(text)
    if found not in QUANTITIES:
        raise ConfigError(f"{option}: {text!r} is not known; known are {', '.join(QUANTITIES)}.")
    return found


def _key(text: str) -> str:
    folded = fold(text)
    folded = ALIASES.get(folded, folded)
    return re.sub(r"^(?:nominal |engineering )?(stretch|stress) ([12])$", r"\1\2", folded)


def _number(text: str, option: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not -1e300 < value < 1e300 or "_" in text:
        raise ConfigError(f"{option}: {text!r} is not a number.")
    return value


def _sign(text: str) -> float:
    if text not in ("+", "-"):
        raise ConfigError(f"--sign: {text!r} is not + or -, for instance --sign force=-.")
    return -1.0 if text == "-" else 1.0


def _kind(text: str) -> str:
    found = kind_in(text)
    if found not in KINDS:
        raise ConfigError(f"--kind: {text!r} is not known; known are {', '.join(KINDS)}.")
    return found


def _span(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"\s*(\d*)\s*-?\s*(\d*)\s*", text)
    if not found or not (found[1] or found[2]):
        raise ConfigError(f"--rows: {text!r} is not a range of lines such as 14-313, 400- or -500.")
    if "-" not in text:
        return int(found[1]), int(found[1])
    return int(found[1] or 1), int(found[2] or 10**12)


def _separator(text: str | None) -> str | None:
    if text is None or text in ("tab", "semicolon", "comma", "bar", "blanks", ";", ",", "|", " ", "\t"):
        return text
    if text == "\\t":
        return "tab"
    raise ConfigError(f"--separator: {text!r} is not known; known are tab, ';', ',', '|' and blanks.")
