"""A section of the report is added by one file: in the folder, by an entry point, or while running."""

from importlib.metadata import EntryPoint

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.report import report
from calibration.report.sections import registry
from calibration.report.sections.base import ReportData, Section, Table
from model.material.materials import Material
from model.membrane.solve import solve_many
from model.specimen import Specimen

# What the one file of another package would hold.
WEIGHT = Section(
    name="weight",
    place=45,
    context=lambda data: {"noted": Table(["curve", ">samples"], [[c.label, str(c.h.size)] for c in data.curves])},
    template="<h2>Weight of the data</h2>{{ table(noted) }}",
)


def test_the_sections_of_the_package_are_found_in_their_order() -> None:
    names = [section.name for section in registry.sections()]
    assert names[0] == "summary" and names[-1] == "provenance"
    assert len(names) == len(set(names)) >= 12


def test_an_entry_point_adds_a_section_between_others(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("weight", f"{__name__}:WEIGHT", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.GROUP else [])
    names = [section.name for section in registry.sections()]
    assert names.index("weight") == names.index("stiffness") + 1


def test_what_is_no_section_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("wrong", f"{__name__}:EntryPoint", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    with pytest.raises(TypeError, match=r"'wrong'.*is no Section"):
        registry.sections()


def test_an_added_section_is_on_the_page_and_its_text_is_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_added", {})
    registry.register(WEIGHT)
    registry.register(Section("nothing", 46, lambda data: None, "never shown"))
    film = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)
    specimen = Specimen(4e-3, 20e-3, 40e-6, 1.2, film)
    h = np.linspace(0.5e-3, 12e-3, 40)
    curve = Curve(
        label="<b>one</b>",
        run="r",
        specimen=specimen,
        h=h,
        force=solve_many(specimen, h).force,
        voltage=np.zeros(40),
        nominal_voltage=0.0,
        direction=np.ones(40, dtype=np.int8),
        force_noise=1e-3,
    )
    found = identify([curve], terms=1, starts=1)
    page = report.render(ReportData(found, [curve], report.select([curve], found.material)))
    assert "<h2>Weight of the data</h2>" in page
    assert "never shown" not in page
    assert '<td data-label="curve">&lt;b&gt;one&lt;/b&gt;</td><td class="n" data-label="samples">40</td>' in page
