"""The report: whole, self-contained, true to the numbers, and harmless whatever the files say."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.reduction import select
from calibration.film.result import Identification
from calibration.report import figures
from calibration.report.report import write_report
from calibration.rounding import percent, rounded, stated
from model.material.materials import NAMED, Material

Experiment = Callable[..., list[Curve]]
PARKER = NAMED["parker-cao2018"]
ONE_TERM = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)
ATTACK = "<script>alert(1)</script> & \"'"


class Page(HTMLParser):
    """Tags with their attributes, and the text outside of style."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(html)
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def curves(experiment: Experiment) -> list[Curve]:
    made = experiment(seed=12, samples=200, guess=replace(PARKER, name="start"))
    return [replace(curve, label=f"{curve.label} {ATTACK}" if k == 0 else curve.label) for k, curve in enumerate(made)]


@pytest.fixture(scope="module")
def found(curves: list[Curve]) -> Identification:
    return identify(curves, terms=2, starts=2)


@pytest.fixture(scope="module")
def small(experiment: Experiment) -> tuple[Identification, list[Curve]]:
    """One curve, one term, no voltage."""
    curves = experiment(seed=12, samples=200, voltages=(0.0,), disks=(4e-3,))
    return identify(curves, terms=1, starts=1), curves


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory, found: Identification, curves: list[Curve]) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(
        path,
        found,
        curves,
        scene_texts={f"scene {ATTACK}": f"# {ATTACK}\n[specimen]"},
        provenance={"logs": {f"a.mcap {ATTACK}": "ab" * 32}},
        truth=PARKER,
        comparison=[found],
    )
    assert [item.name for item in path.parent.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def test_the_numbers_are_in_it(html: str, found: Identification) -> None:
    text = Page(html).text
    eps, stiffness = found.quantities["eps_r"], found.quantities["stiffness"]
    assert " ± ".join(rounded(eps.value, eps.uncertainty)) in text
    assert " ± ".join(rounded(stiffness.value * 1e-3, stiffness.uncertainty * 1e-3)) + " kPa" in text
    shear = found.quantities["G"]
    assert shear.interval is None
    for k in (-1.96, 1.96):
        end = rounded((shear.value + k * shear.uncertainty) * 1e-3, shear.uncertainty * 1e-3)[0]
        assert end in text, k
    assert "not identifiable from this data" in text
    assert f"{found.reduced_chi_square:.3f}" in text
    assert f"{found.used} samples used" in text
    assert "ab" * 32 in text
    for curve in found.curves:
        assert f"{curve.used} of {curve.samples}" in text
    for warning in found.warnings:
        assert re.sub(r"\s+", " ", warning) in text


def test_it_needs_nothing_from_outside(html: str) -> None:
    page = Page(html)
    assert "http:" not in html
    assert "https:" not in html
    assert "@import" not in html
    assert not [tag for tag, _ in page.tags if tag in ("script", "link", "iframe", "object", "embed", "base")]
    sources = [attributes["src"] or "" for tag, attributes in page.tags if "src" in attributes]
    assert len(sources) == 3
    for source in sources:
        head, data = source.split(",", 1)
        assert head == "data:image/svg+xml;base64"
        svg = base64.b64decode(data, validate=True).decode()
        assert not re.findall(r'(?:href|src)="(?!#|data:)', svg)


def test_figures_have_units_and_every_voltage(html: str) -> None:
    page = Page(html)
    images = [attributes for tag, attributes in page.tags if tag == "img"]
    assert all(attributes["alt"] for attributes in images)
    figure = base64.b64decode((images[0]["src"] or "").split(",", 1)[1]).decode()
    for words in ("displacement h / mm", "force F / N", "0 V", "1000 V", "1500 V", "a = 4 mm", "a = 6 mm"):
        assert f"<!-- {words}" in figure or words in figure, words


def test_what_comes_from_files_is_escaped(html: str) -> None:
    assert "<script" not in html
    assert Page(html).text.count("<script>alert(1)</script> & \"'") >= 4  # label, scene's name, scene, log


def pictured(found: Identification, curves: list[Curve]) -> list[tuple[float, float]]:
    """Of every curve the root mean square of the residuals, in the picture and in the table."""
    selections = select(curves, found.material, found.wrinkling)
    pairs = []
    for curve, selection, row in zip(curves, selections, found.curves, strict=True):
        _, residual = figures.residual_force(found, curve, selection)
        pairs.append((float(np.sqrt(np.mean(residual**2))), row.rms_residual))
    return pairs


@pytest.mark.slow
def test_errors_of_the_rig_that_were_found_have_their_units_and_are_in_the_pictures(
    tmp_path: Path, experiment: Experiment
) -> None:
    """A rig that gives way by 1 mm/N, and force that is 20 ms late at 1 mm/s."""
    curves = []
    for curve in experiment(1, samples=400, noise=1e-3, truth=ONE_TERM, guess=ONE_TERM, voltages=(0.0, 1500.0)):
        assert curve.time is not None
        late = np.interp(curve.time - 20e-3, curve.time, curve.force)
        way = curve.h + 1e-3 * late
        curves.append(replace(curve, h=way, force=late, compliance_uncertainty=1e-3, lag_uncertainty=20e-3))
    found = identify(curves, terms=1, starts=1)
    gives, lag = found.nuisance["compliance of the rig"], found.nuisance["lag of run-4mm"]
    assert abs(gives.value - 1e-3) < 4.0 * gives.uncertainty < 4e-4
    assert abs(lag.value - 20e-3) < 4.0 * lag.uncertainty < 8e-3
    for shown, told in pictured(found, curves):
        assert shown == pytest.approx(told, rel=0.01)
    path = tmp_path / "report.html"
    write_report(path, found, curves, scene_texts={}, provenance={})
    text = Page(path.read_text(encoding="utf-8")).text
    assert f"{gives.value * 1e6:+.3f} µm/N" in text
    assert f"{lag.value * 1e3:+.3f} ms" in text


@pytest.mark.slow
def test_pictures_show_what_was_fitted_with_the_tension_field(experiment: Experiment) -> None:
    curves = experiment(seed=4, samples=600, truth=ONE_TERM, guess=ONE_TERM, prestretch=1.0, highest=14e-3)
    found = identify(curves, terms=1, starts=1, wrinkling="tension_field")
    assert sum(curve.wrinkled for curve in found.curves) > 50
    for shown, told in pictured(found, curves):
        assert shown == pytest.approx(told, rel=0.01)


@pytest.mark.slow
def test_it_is_the_same_each_time(tmp_path: Path, small: tuple[Identification, list[Curve]]) -> None:
    paths = [tmp_path / "one.html", tmp_path / "two.html"]
    for path in paths:
        write_report(path, *small, scene_texts={}, provenance={})
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_failure_leaves_the_old_report_and_nothing_else(
    tmp_path: Path, small: tuple[Identification, list[Curve]]
) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_report(path, *small, scene_texts={"scene": "\ud800"}, provenance={})
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(FileNotFoundError):
        write_report(tmp_path / "none" / "report.html", *small, scene_texts={}, provenance={})


@pytest.mark.slow
def test_without_voltage_the_report_has_no_permittivity(
    tmp_path: Path, small: tuple[Identification, list[Curve]]
) -> None:
    path = tmp_path / "report.html"
    write_report(path, *small, scene_texts={}, provenance={})
    assert "ermittivity" not in path.read_text()


@pytest.mark.parametrize(
    ("value", "uncertainty", "expected"),
    [
        (1.70391, 0.01093, ("1.704", "0.011")),
        (145.876, 0.2417, ("145.88", "0.24")),
        (33.587, 264.9, ("34", "265")),
        (5.0, 0.0996, ("5.00", "0.10")),
        (5.0, float("inf"), ("5", "not determined")),
    ],
)
def test_rounding(value: float, uncertainty: float, expected: tuple[str, str]) -> None:
    assert rounded(value, uncertainty) == expected


@pytest.mark.parametrize(
    ("value", "uncertainty", "expected"),
    [(2.1278, 23488226648.0, ("2.1", "> 21")), (33.587, 264.9, ("34", "265")), (-24.3, 19338.0, ("-24", "> 240"))],
)
def test_an_uncertainty_far_above_its_value_has_no_digits(
    value: float, uncertainty: float, expected: tuple[str, str]
) -> None:
    assert stated(value, uncertainty) == expected


@pytest.mark.parametrize(
    ("fraction", "expected"), [(0.00123, "0.12 %"), (0.000999, "0.10 %"), (7.88, "790 %"), (float("inf"), "> 1000 %")]
)
def test_percent(fraction: float, expected: str) -> None:
    assert percent(fraction) == expected
