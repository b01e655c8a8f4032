"""More tables as laboratories have them: each is read to the numbers that were written, with what it says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from model.material.materials import Material
from model.specimen import Specimen
from rig.importing.cone_table import ConeTable, read_cone_tables
from rig.importing.findings import ImportRefused
from rig.importing.options import ImportOptions, from_words
from rig.importing.sheet_table import SheetTests, read_sheet_tests
from rig.importing.tidy import write_cone_table

Array = NDArray[np.float64]

STRAIN = np.round(np.linspace(0.0, 1.0, 31), 4)
MPA = np.round(0.25 * (1.0 + STRAIN - (1.0 + STRAIN) ** -2), 6)
TIME = np.round(0.5 * np.arange(31), 1)
AREA, LENGTH = 12.0, 25.0  # mm2, mm


def lines(form: str, *columns: Sequence[float] | Array) -> list[str]:
    """A line for each row of the columns."""
    return [form.format(*row) for row in zip(*columns, strict=True)]


ROWS = lines("{:.1f},{:.4f},{:.6f}", TIME, STRAIN, MPA)
HEAD = ["Time (s),Strain,Stress (MPa)"]
PULLED = lines('"{:.1f}","{:.4f}","{:.6f}"', TIME, LENGTH * STRAIN, AREA * MPA)
SHEETS: dict[str, list[str]] = {
    "groups of parameters": [
        'Dimensions : Thickness,"2.00",mm',
        'Dimensions : Width,"6.00",mm',
        'Dimensions : Length,"25.00",mm',
        "",
        "Time,Extension,Load",
        "(s),(mm),(N)",
        *PULLED,
    ],
    "French, with the travel named": [
        '"Section",12,"mm²"',
        '"L0 - course standard",25,"mm"',
        '"Temps","Course standard","Force standard"',
        '"s","mm","N"',
        *PULLED,
    ],
    "pages": ["Page 1", *HEAD, *ROWS[:12], "", "Page 2", *HEAD, *ROWS[12:22], "", "Page 3", *HEAD, *ROWS[22:]],
    "statistics below": [*HEAD, *ROWS, "Mean,0.5,0.21", "Std. Dev.,0.3,0.1", "Maximum,1.0,0.4375"],
    "exponents of Fortran": ["# strain stress_MPa", *lines("{:.4f}D+00 {:.6f}D0", STRAIN, MPA)],
    "marks of missing values": [
        *HEAD,
        *ROWS[:9],
        "4.2,---,---",
        *ROWS[9:20],
        "9.7,OVER,NaN",
        *ROWS[20:],
        "15.1,0.9,OL",
    ],
    "a heading of two lines": ['"Strain\n(%)","Stress\n(MPa)"', *lines("{:.2f},{:.6f}", 100 * STRAIN, MPA)],
    "percent in cells": ["Strain,Stress (MPa)", *lines("{:.2f}%,{:.6f}", 100 * STRAIN, MPA)],
    "units in cells": ["Strain;Stress", *lines("{:.2f} %;{:.6f} MPa", 100 * STRAIN, MPA)],
    "names in cells": lines("strain:{:.4f} stress_MPa:{:.6f}", STRAIN, MPA),
    "percent first in the unit row": ["Prüfart;Zugversuch", "", "Dehnung;Spannung", "%;MPa"]
    + [line.replace(".", ",") for line in lines("{:.2f};{:.6f}", 100 * STRAIN, MPA)],
    "a remark behind the units": ["Strain,Stress", "(mm/mm),(MPa),2 N preload", *lines("{:.4f},{:.6f}", STRAIN, MPA)],
    "zeros after a loss of power": [*HEAD, *ROWS, "\0" * 300],
}


def sheets(folder: Path, text: list[str], options: ImportOptions | None = None) -> SheetTests:
    """What is read of a table."""
    (folder / "Zug1.csv").write_text("\n".join([*text, ""]).replace("\0\n", "\0"), "utf-8")
    return read_sheet_tests([folder / "Zug1.csv"], options)


@pytest.mark.parametrize("text", SHEETS.values(), ids=SHEETS)
def test_a_sheet_is_read_to_the_numbers_that_were_written(tmp_path: Path, text: list[str]) -> None:
    (test,) = sheets(tmp_path, text).tests
    np.testing.assert_allclose(test.stretch1, 1.0 + STRAIN, rtol=1e-9)
    np.testing.assert_allclose(test.stress1, 1e6 * MPA, rtol=1e-6, atol=1.0)
    assert test.kind == "uniaxial"


def test_a_position_that_does_not_begin_at_zero_is_asked_for_its_zero(tmp_path: Path) -> None:
    text = ["Position (mm),Load (N)", *lines("{:.4f},{:.6f}", 52.3 + LENGTH * STRAIN, AREA * MPA)]
    size = {"area_mm2": AREA, "length_mm": LENGTH}
    with pytest.raises(ImportRefused, match="--zero displacement=first"):
        sheets(tmp_path, text, from_words(**size))  # type: ignore[arg-type] # numbers
    (test,) = sheets(tmp_path, text, from_words(zero=["displacement=first"], **size)).tests  # type: ignore[arg-type]
    np.testing.assert_allclose(test.stretch1, 1.0 + STRAIN, rtol=1e-9)


def test_a_heading_above_the_names_of_specimens_is_that_of_all(tmp_path: Path) -> None:
    own = lines("{:.4f},{:.6f}", STRAIN, MPA)
    text = ["Strain,Stress (MPa)", "Specimen: A", *own, "Specimen: B", *lines("{:.4f},{:.6f}", STRAIN, 1.1 * MPA)]
    read = sheets(tmp_path, text).tests
    assert [test.name for test in read] == ["Zug1, Specimen: A", "Zug1, Specimen: B"]


def test_two_specimens_under_one_heading_stay_two(tmp_path: Path) -> None:
    loop = [*ROWS, *lines("{:.1f},{:.4f},{:.6f}", 15.5 + TIME, STRAIN[::-1], 0.8 * MPA[::-1])]
    again = [*ROWS[:1], *lines("{:.1f},{:.4f},{:.6f}", TIME, STRAIN, 1.01 * MPA)]
    assert len(sheets(tmp_path, [*HEAD, *loop, *HEAD, *again]).tests) == 2


def test_a_column_taken_for_what_its_heading_does_not_say_is_told(tmp_path: Path) -> None:
    text = ["eyy - Hencky,Stress (MPa)", *lines("{:.6f},{:.6f}", np.log1p(STRAIN), MPA)]
    told = sheets(tmp_path, text, from_words(column=["strain=1"])).understood[0].lines()
    assert any("reads as true strain" in line and "--column true-strain=1" in line for line in told)


def test_one_option_leaves_all_wrong_cells_out(tmp_path: Path) -> None:
    text = [*HEAD, *ROWS]
    text[5], text[9] = "2.0,0.1x,0.05", "4.0,0.3,0.1y"
    with pytest.raises(ImportRefused) as refused:
        sheets(tmp_path, text)
    assert str(refused.value).count("--rows 2-5,7-9,11-") == 2
    (test,) = sheets(tmp_path, text, from_words(rows="2-5,7-9,11-")).tests
    assert test.stretch1.size == 29


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (["<html><table><tr><td>1</td></tr></table></html>"], "save the sheet as CSV"),
        (["Strain;Stress", "(%);(MPa)", *lines("{:.2f};{:.6f} kPa", 100 * STRAIN, MPA)], "its cells say kPa"),
        (["試験力,ストローク", "N,mm", *lines("{:.4f},{:.4f}", MPA, STRAIN)], "--area-mm2"),
    ],
)
def test_what_is_refused_says_what_to_do(tmp_path: Path, text: list[str], words: str) -> None:
    with pytest.raises(ImportRefused) as refused:
        sheets(tmp_path, text)
    assert words in str(refused.value)


# --- a rig: voltages that are said and not measured

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("x", (33e3, 32e3), (2.0, 5.0), 1.9), name="film-a")
H = np.round(np.concatenate((np.linspace(0.0, 8.0, 21), np.linspace(7.6, 0.0, 20))), 3)
F = {0: 0.0018 * H**2 + 0.002 * H, 1000: 0.0016 * H**2 + 0.002 * H, 1500: 0.0014 * H**2 + 0.002 * H}
VOLTS = np.repeat(list(F), H.size)
ALL = np.concatenate(list(F.values()))


def pairs(volts: int, form: str = "{:.3f},{:.6f}") -> list[str]:
    """Displacement (mm) and force (N) at one voltage."""
    return lines(form, H, F[volts])


SIX = lines(",".join(["{:.3f},{:.6f}"] * 3), H, F[0], H, F[1000], H, F[1500])
RIGS: dict[str, dict[str, list[str]]] = {
    "a label above each pair of columns": {"a.csv": ["0 V,,1 kV,,1.5 kV,", ",".join(["h (mm),F (N)"] * 3), *SIX]},
    "in the headings": {"a.csv": ["h (mm) 0V,F (N) 0V,h (mm) 1000V,F (N) 1000V,h (mm) 1500V,F (N) 1500V", *SIX]},
    "one displacement, three forces": {
        "a.csv": [
            "Displacement (mm),F at 0 V (N),F at 1 kV (N),F at 1.5 kV (N)",
            *lines("{:.3f},{:.6f},{:.6f},{:.6f}", H, F[0], F[1000], F[1500]),
        ]
    },
    "a line above each block": {
        "a.csv": [line for v in F for line in (f"# voltage = {v} V", "h_mm,F_N", *pairs(v), "")]
    },
    "a row in kV above each block": {
        "a.csv": [
            line
            for v in F
            for line in (
                f"Spannung;{v / 1e3:.1f};kV".replace(".", ","),
                "",
                "Weg;Kraft",
                "mm;N",
                *(row.replace(".", ",") for row in pairs(v, "{:.3f};{:.6f}")),
            )
        ]
    },
    "a file each, by its heading": {f"{v}.csv": [f"Voltage (V),{v}", "", "h_mm,F_N", *pairs(v)] for v in F},
    "a file each, by its name": {f"cone_{v}V.csv": ["h_mm,F_N", *pairs(v)] for v in F},
}


def cones(folder: Path, files: dict[str, list[str]], options: ImportOptions | None = None) -> ConeTable:
    """What is read of the files of a rig."""
    for name, text in files.items():
        (folder / name).write_text("\n".join(text) + "\n", "utf-8")
    return read_cone_tables([folder / name for name in files], FILM, options)


@pytest.mark.parametrize("files", RIGS.values(), ids=RIGS)
def test_a_voltage_that_is_said_is_that_of_its_sweeps(tmp_path: Path, files: dict[str, list[str]]) -> None:
    read = cones(tmp_path, files)
    assert [curve.nominal_voltage for curve in read.curves] == list(F)
    np.testing.assert_allclose(np.concatenate([curve.force for curve in read.curves]), ALL, atol=1e-6)
    np.testing.assert_allclose(np.concatenate([curve.voltage for curve in read.curves]), VOLTS)
    told = [line for one in read.understood for line in one.lines() if "note:" in line and " V (" in line]
    assert len(told) == 3
    stated = cones(tmp_path, files, from_words(voltage="10,1100,1600"))  # the option goes before what a file says
    assert [curve.nominal_voltage for curve in stated.curves] == [10.0, 1100.0, 1600.0]


def test_several_runs_of_a_file_are_one_tidy_table(tmp_path: Path) -> None:
    read = cones(tmp_path, RIGS["in the headings"])
    write_cone_table(tmp_path / "tidy.csv", read.tidy)
    again = read_cone_tables([tmp_path / "tidy.csv"], FILM)
    for one, other in zip(read.curves, again.curves, strict=True):
        assert np.array_equal(one.h, other.h) and np.array_equal(one.force, other.force)
        assert one.nominal_voltage == other.nominal_voltage


@pytest.mark.parametrize(("voltage", "words"), [("0,1000", "3 sweeps in 3 runs"), ("0,1,1.5", "")])
def test_stated_voltages_that_do_not_suit_are_told(tmp_path: Path, voltage: str, words: str) -> None:
    files = RIGS["a file each, by its name"]
    if words:
        with pytest.raises(ImportRefused, match=words):
            cones(tmp_path, files, from_words(voltage=voltage))
    else:
        told = cones(tmp_path, files, from_words(voltage=voltage)).understood[0].lines()
        assert any("1.5 V, which bends no film" in line for line in told)


def test_a_load_cell_that_was_tared_in_between_is_told_with_its_row(tmp_path: Path) -> None:
    force = F[0][:21].copy()
    assert cones(tmp_path, {"a.csv": ["h_mm,F_N", *lines("{:.3f},{:.6f}", H[:21], force)]}, from_words(voltage="0"))
    force[12:] += 0.4
    files = {"a.csv": ["h_mm,F_N", *lines("{:.3f},{:.6f}", H[:21], force)]}
    with pytest.raises(ImportRefused, match="the force jumps") as caught:
        cones(tmp_path, files, from_words(voltage="0"))
    assert "--rows 2-13" in str(caught.value)


def test_a_stage_that_counts_backwards_from_far_is_asked_for_its_zero(tmp_path: Path) -> None:
    files = {"a.csv": ["x_mm,F_N,U_V", *lines("{:.3f},{:.6f},{}", np.tile(123.4 - H, 3), ALL, VOLTS)]}
    with pytest.raises(ImportRefused, match="--zero displacement=first"):
        cones(tmp_path, files)
    read = cones(tmp_path, files, from_words(zero=["displacement=first"]))
    assert [round(1e3 * float(curve.h.max()), 3) for curve in read.curves] == [8.0, 8.0, 8.0]
