"""The commands on tables: the page's example, what is told, exit codes, tidy tables to the bit."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import rig.importing
from model.material.materials import Material
from model.membrane.solve import solve
from model.specimen import Specimen
from rig.cli.app import main
from rig.importing.cone_table import read_cone_tables
from rig.importing.options import from_words
from rig.importing.sheet_table import read_sheet_tests

PAGE = (Path(rig.importing.__file__).parent / "README.md").read_text(encoding="utf-8")
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("x", (33e3, 32e3), (2.0, 5.0), 1.9), name="film-a")
SCENE = """[specimen]
name = "film-a"
disk_radius_mm = 4.0
ring_radius_mm = 20.0
thickness_um = 40.0
prestretch = 1.2
[specimen.material]
mu_Pa = [33e3, 32e3]
alpha = [2.0, 5.0]
eps_r = 1.9
"""


def test_the_example_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    table, told = re.findall(r"```text\n(.*?)```", PAGE, re.S)
    (tmp_path / "Zugversuch.csv").write_text(table, encoding="utf-8")
    result = CliRunner().invoke(main, ["fit-tests", "Zugversuch.csv", "--terms", "1", "--dry-run"])
    assert result.exit_code == 0 and result.output == told
    result = CliRunner().invoke(
        main, ["fit-tests", "Zugversuch.csv", "--terms", "1", "-o", "fit.json", "--report", "r.html"]
    )
    assert result.exit_code == 0, result.output
    fit = json.loads((tmp_path / "fit.json").read_text())
    assert fit["quantities"]["G"]["value"] == pytest.approx(128e3, rel=1e-3)
    assert fit["import"][0]["decimal"] == "," and fit["import"][0]["rows_kept"] == 11
    page = (tmp_path / "r.html").read_text()
    assert "Zugversuch" in page and "http" not in page.replace("http://www.w3.org", "")


def test_a_refused_file_ends_with_code_2_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a,b\n1,2\n3,4\n5,6\n")
    result = CliRunner().invoke(main, ["fit-tests", str(tmp_path / "x.csv"), "-o", str(tmp_path / "o.json")])
    assert result.exit_code == 2 and "--kind" in result.output and "--column" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["x.csv"]
    result = CliRunner().invoke(main, ["fit", str(tmp_path / "x.csv")])
    assert result.exit_code == 2 and "--scene" in result.output


def test_tidy_tests_read_back_to_the_same_bits(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    stretch = np.sort(random.uniform(1.0, 2.0, 30))
    force = 1e-3 * (stretch - stretch**-2) * random.uniform(0.99, 1.01, 30)
    path = tmp_path / "uniaxial.csv"
    path.write_text(
        "extension (in),load (lbf)\n"
        + "".join(f"{x!r},{y!r}\n" for x, y in zip((stretch - 1).tolist(), force.tolist(), strict=True))
    )
    arguments = [
        "fit-tests",
        str(path),
        "--area-mm2",
        "0.7",
        "--length-mm",
        "25.4",
        "--dry-run",
        "--tidy",
        str(tmp_path / "t.csv"),
    ]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    (one,) = read_sheet_tests([path], from_words(area_mm2=0.7, length_mm=25.4)).tests
    (other,) = read_sheet_tests([tmp_path / "t.csv"]).tests
    assert one.kind == other.kind
    assert np.array_equal(one.stretch1, other.stretch1) and np.array_equal(one.stress1, other.stress1)


def cone(voltages: tuple[float, ...]) -> str:
    """A table of a rig whose film is the scene's: sweeps out and back at each voltage, force counted negative."""
    lines, now = [], 0.0
    out = np.linspace(0.0, 8e-3, 30)
    for voltage in voltages:
        forces = [float(solve(FILM, float(h), voltage).force) if h else 0.0 for h in out]
        for h, force in [*zip(out, forces, strict=True), *zip(out[::-1], forces[::-1], strict=True)]:
            lines.append(
                f"{now:.1f}\t{1e3 * h:.5f}\t{-1e3 * force + 0.05 * np.sin(7.0 * now):.4f}\t{1e-3 * voltage:.4f}"
            )
            now += 0.1
    return "Zeit [s]\tWeg [mm]\tKraft [mN]\tSpannung [kV]\n" + "\n".join(lines) + "\n"


def test_a_rig_s_table_is_read_with_its_signs_and_tidied_to_the_bit(tmp_path: Path) -> None:
    path, scene, tidy = tmp_path / "rig.csv", tmp_path / "scene.toml", tmp_path / "t.csv"
    path.write_text(cone((0.0, 1000.0)))
    scene.write_text(SCENE)
    result = CliRunner().invoke(main, ["fit", str(path), "--scene", str(scene), "--dry-run", "--tidy", str(tidy)])
    assert result.exit_code == 0, result.output
    assert "force [mN], sign reversed" in result.output and "1000 V" in result.output
    one, other = (read_cone_tables([file], FILM) for file in (path, tidy))
    assert [curve.nominal_voltage for curve in one.curves] == [0.0, 1000.0]
    for quantity, column in one.tidy[0].items():
        assert np.array_equal(column, other.tidy[0][quantity]), quantity
    assert one.curves[0].force.max() == pytest.approx(float(solve(FILM, 8e-3, 0.0).force), rel=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("Weg [mm]", "Weg [um]", "implausible"),
        ("Kraft [mN]", "Kraft [N]", "implausible"),
        ("Weg [mm]\tKraft [mN]", "Kraft [N]\tWeg [mm]", "exchanged"),
        ("\tSpannung [kV]", "\tTemperatur", "--voltage"),
        ("Spannung [kV]", "Spannung [V]", "kV"),
    ],
)
def test_a_rig_s_table_that_cannot_be_is_refused_or_warned_of(tmp_path: Path, old: str, new: str, words: str) -> None:
    path, scene = tmp_path / "rig.csv", tmp_path / "scene.toml"
    path.write_text(cone((0.0, 1000.0)).replace(old, new))
    scene.write_text(SCENE)
    result = CliRunner().invoke(main, ["fit", str(path), "--scene", str(scene), "--dry-run"])
    assert words in result.output
    assert "warning" in result.output if words == "kV" else result.exit_code == 2


def test_a_folder_is_taken_for_its_logs(tmp_path: Path) -> None:
    """Not refused as a file that is none: what it holds is looked for."""
    (tmp_path / "logs").mkdir()
    result = CliRunner().invoke(main, ["fit", str(tmp_path / "logs")])
    assert result.exit_code == 2 and "there is no log (*.mcap) in this folder" in result.output


SHEET = "stretch,stress (Pa)\n" + "".join(
    f"{1 + k / 20:.2f},{3e4 * (1 + k / 20 - (1 + k / 20) ** -2):.3f}\n" for k in range(21)
)


def test_a_sheet_has_material_cards_without_a_permittivity(tmp_path: Path) -> None:
    (tmp_path / "uniaxial.csv").write_text(SHEET, encoding="utf-8")
    words = ["fit-tests", str(tmp_path / "uniaxial.csv"), "--law", "neo-hooke", "--cards", str(tmp_path / "cards")]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    cards = {path.name: path.read_text() for path in (tmp_path / "cards").iterdir()}
    assert set(cards) == {"film_abaqus.inp", "film_ansys.mac", "film_comsol.txt", "film_febio.xml"}
    c10 = float(re.search(r"NEO HOOKE\n([\d.e+]+),", cards["film_abaqus.inp"])[1])  # type: ignore[index] # or it fails
    assert c10 == pytest.approx(1.5e4, rel=1e-4)
    assert not any("DIELECTRIC" in text or "PERX" in text or "epsilonr" in text for text in cards.values())
    assert CliRunner().invoke(main, words).exit_code == 2  # nothing is overwritten


@pytest.mark.parametrize(
    ("words", "told"),
    [(["--law", "mooney"], "Did you mean mooney_rivlin?"), (["--fix", "mu=3"], "--fix: cannot fix mu; what can be")],
)
def test_an_option_that_names_what_is_not_there_cannot_be_used(tmp_path: Path, words: list[str], told: str) -> None:
    (tmp_path / "uniaxial.csv").write_text(SHEET, encoding="utf-8")
    result = CliRunner().invoke(main, ["fit-tests", str(tmp_path / "uniaxial.csv"), *words])
    assert result.exit_code == 2 and told in result.output
