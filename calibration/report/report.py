"""The report: one HTML file that needs nothing else, to be read on a screen or on paper.

Its sections are files of `calibration.report.sections`; this file sets them on one page.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from calibration.electrical.charge import ByCharge
from calibration.film.curve import Curve
from calibration.film.reduction import select
from calibration.film.result import Identification
from calibration.report.sections.base import ReportData, Table, symbol
from calibration.report.sections.registry import sections
from model.material.materials import Material


def write_report(
    path: Path,
    identification: Identification,
    curves: Sequence[Curve],
    *,
    scene_texts: Mapping[str, str],
    provenance: Mapping[str, Any],
    truth: Material | None = None,
    comparison: Sequence[Identification] = (),
    charge: ByCharge | None = None,
) -> None:
    """Write the report of an identification as one self-contained HTML file.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all.
    curves : sequence of Curve
        Those that were identified, in the same order.
    scene_texts : mapping of str to str
        Name and text of every scene file, shown as they are.
    provenance : mapping
        What identifies the data; plain values, lists and mappings.
    truth : Material, optional
        The film of a simulation, to be held against what was found.
    comparison : sequence of Identification, optional
        The same data with other numbers of Ogden terms (`calibration.film.identify.compare`).
    charge : ByCharge, optional
        The permittivity by the charge alone, where it was asked for.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    selections = select(curves, identification.material, identification.wrinkling)
    data = ReportData(identification, curves, selections, scene_texts, provenance, truth, comparison, charge)
    page = render(data)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with open(handle, "w", encoding="utf-8") as file:  # noqa: PTH123 # a descriptor, not a path
            file.write(page)
        Path(name).chmod(0o644)
        os.replace(name, path)  # noqa: PTH105
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def render(data: ReportData) -> str:
    """The page as text."""
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )

    def template(name: str) -> jinja2.Template:
        return environment.from_string((files("calibration.report") / name).read_text(encoding="utf-8"))

    tables = template("table.html.j2")

    def table(of: Table) -> Markup:
        columns = [_column(heading) for heading in of.headings]
        return Markup(tables.render(table=of, columns=columns))  # escaped by the template

    environment.globals.update(symbol=symbol, table=table)
    parts = []
    for section in sections():
        context = section.context(data)
        if context is not None:
            parts.append(Markup(environment.from_string(section.template).render(context)))  # escaped
    return template("report.html.j2").render(specimens=data.specimens, sections=parts)


def _column(heading: Any) -> tuple[Any, str, bool]:
    """The heading as it is shown, as plain text, and whether its column is of numbers."""
    from markupsafe import Markup

    number = str(heading).startswith((">", "&gt;"))
    if not number:
        return heading, Markup(heading).striptags(), False
    shown = type(heading)(str(heading).removeprefix("&gt;").removeprefix(">"))
    return shown, Markup(shown).striptags(), True
