"""Which sections the report has: those in this folder, those of other packages, and those added while running.

Another package adds a section by an entry point of the group ``dea_rig.report_sections`` that names a `Section`.
"""

from __future__ import annotations

import importlib
import pkgutil
from importlib.metadata import entry_points

from calibration.report.sections.base import Section

GROUP = "dea_rig.report_sections"
PACKAGE = "calibration.report.sections"

_added: dict[str, Section] = {}


def register(section: Section) -> None:
    """Add a section to every report of this process; one of the same name is replaced."""
    _added[section.name] = section


def sections() -> list[Section]:
    """All sections, in the order in which they are shown."""
    found: dict[str, Section] = {}
    for module in pkgutil.iter_modules(importlib.import_module(PACKAGE).__path__):
        section = getattr(importlib.import_module(f"{PACKAGE}.{module.name}"), "SECTION", None)
        if isinstance(section, Section):
            found[section.name] = section
    for point in entry_points(group=GROUP):
        section = point.load()
        if not isinstance(section, Section):
            raise TypeError(f"entry point {point.name!r} of the group {GROUP} is no Section: {point.value}")
        found[section.name] = section
    return sorted((found | _added).values(), key=lambda one: (one.place, one.name))
