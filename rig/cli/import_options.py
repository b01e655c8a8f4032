"""The options by which a person tells what is in a table; shared by the commands that read other people's tables."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import click

from rig.cli.files import FILE, POSITIVE

if TYPE_CHECKING:
    from rig.importing.options import ImportOptions
    from rig.importing.understood import Understood

F = TypeVar("F", bound=Callable[..., Any])

PAIRS = (
    ("column", 'Column of a quantity, by heading or number: force="Load (kgf)", stress=3.'),
    ("unit", "Unit of a column, before that in the file: force=kgf, strain=%."),
    ("sign", "force=- where a column counts the other way."),
    ("zero", "What a column shows at rest, in its unit: force=0.012, or stress=first for its first value."),
    ("factor", "Factor on the values of a column: displacement=2."),
)
SHEET_ONLY = (
    click.option("--kind", metavar="KIND", help="Kind of test: uniaxial, equibiaxial, 'pure shear' or biaxial."),
    click.option("--area-mm2", type=POSITIVE, help="Cross-section, unstretched."),
    click.option("--length-mm", type=POSITIVE, help="Length, unstretched."),
)
CONE_ONLY = (click.option("--voltage", metavar="V,V,...", help="Voltage of each sweep in turn, or one for all."),)
COMMON = (
    click.option("--rows", metavar="LINES", help="Lines of the file to use: 14-313,400-."),
    click.option(
        "--branch",
        type=click.Choice(["first-loading", "loading", "unloading", "all"]),
        help="Branches of load cycles to use.",
    ),
    click.option("--specimen", multiple=True, metavar="NAME", help="Specimen to use, by label or number; default all."),
    click.option("--separator", metavar="SIGN", help="tab, ';', ',', '|' or blanks; default: judged."),
    click.option("--decimal", type=click.Choice([".", ","]), help="Decimal sign; default: judged."),
    click.option("--encoding", metavar="NAME", help="Encoding of the text; default: judged."),
    click.option("--import", "import_file", type=FILE, help="These options as TOML; default: DATA.import.toml."),
    click.option("--dry-run", is_flag=True, help="Print what is understood of the tables and stop."),
    click.option("--tidy", type=FILE, metavar="FILE", help="Write the rows that are used as CSV in SI units."),
)
NAMES = (
    *(name for name, _ in PAIRS),
    "kind", "area_mm2", "length_mm", "voltage", "rows", "branch", "specimen", "separator", "decimal", "encoding",
)  # fmt: skip


def import_options(*, sheet: bool = False, cone: bool = False) -> Callable[[F], F]:
    """Add the options to a command; `taken` reads them."""

    def add(command: F) -> F:
        pairs = [
            click.option(f"--{name}", name, multiple=True, metavar="WHAT=VALUE", help=text) for name, text in PAIRS
        ]
        for option in reversed((*pairs, *(SHEET_ONLY if sheet else ()), *(CONE_ONLY if cone else ()), *COMMON)):
            command = option(command)
        return command

    return add


def taken(words: dict[str, Any]) -> ImportOptions:
    """Take the options out of a command's arguments; ``import_file`` is used where the command line says nothing."""
    from rig.importing.options import ImportOptions, from_file, from_words

    stated = from_words(**{name: words.pop(name) for name in NAMES if name in words})
    file: Path | None = words.pop("import_file", None)
    return stated.over(from_file(file) if file is not None else ImportOptions())


def given(options: ImportOptions) -> bool:
    """Whether anything is said about tables at all."""
    from rig.importing.options import ImportOptions

    return options != ImportOptions()


class Read(Protocol):
    """What was read of tables."""

    @property
    def understood(self) -> list[Understood]: ...


R = TypeVar("R", bound=Read)


def understood_or_refused(read: Callable[[], R]) -> R:
    """Read tables and print what was understood, one fact a line; of tables that are refused, too."""
    from rig.importing.findings import ImportRefused

    try:
        found = read()
    except ImportRefused as refused:
        _tell(refused.understood)
        raise
    for one in found.understood:
        _tell(one.lines())
    return found


def _tell(lines: Sequence[str]) -> None:
    """One fact a line; on a terminal wrapped between words, with what follows indented."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    for line in lines:
        margin = " " * (len(line) - len(line.lstrip()) + 4)
        wrapped = textwrap.wrap(line, width, subsequent_indent=margin, break_on_hyphens=False) if width > 20 else [line]
        click.echo("\n".join(wrapped))


def with_import(result: dict[str, Any], understood: Sequence[Understood]) -> str:
    """A result, with what was understood of its tables, as JSON text."""
    result = result | {"import": [one.to_dict() for one in understood]}
    return json.dumps(result, indent=2, allow_nan=False) + "\n"
