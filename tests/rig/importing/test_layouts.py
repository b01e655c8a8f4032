"""Tables as other programs and people write them, from numbers that are known: each is read to the same numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from rig.importing.findings import ImportRefused, spans
from rig.importing.headings import split_unit
from rig.importing.options import ImportOptions, from_words
from rig.importing.sheet_table import SheetTests, read_sheet_tests
from rig.importing.table import TextRow, _unit_row_above

G = 0.25e6  # Pa, a neo-Hookean sheet: P = G (l - l^-2)
STRETCH = np.round(np.linspace(1.0, 2.0, 41), 6)
STRESS = G * (STRETCH - STRETCH**-2)
POUND, INCH, GRAVITY = 0.45359237 * 9.80665, 0.0254, 9.80665


def rows(*columns: Sequence[float], separator: str = ",", decimals: int = 6, comma: bool = False) -> str:
    """Lines of numbers."""
    lines = [separator.join(f"{value:.{decimals}f}" for value in row) for row in zip(*columns, strict=True)]
    text = "\n".join(lines) + "\n"
    return text.replace(".", ",") if comma else text


TIME = np.arange(41) * 0.5
STRAIN = STRETCH - 1.0
FORCE = STRESS * 8e-6  # N, on 4 mm x 2 mm
EXTENSION = 25.0 * STRAIN  # mm, of 25 mm
LAYOUTS: dict[str, tuple[str, str, str]] = {
    # name of the file: text, encoding, what the report has to say
    "uniaxial_plain.csv": ("stretch,nominal_stress_MPa\n" + rows(STRETCH, STRESS / 1e6), "utf-8", ""),
    "Zug_probe.csv": (
        "Zeit;Dehnung;Spannung\ns;%;kPa\n" + rows(TIME, 100 * STRAIN, STRESS / 1e3, separator=";", comma=True),
        "cp1252",
        "decimal sign ','",
    ),
    "traction_film.csv": (
        "Temps (s);Déformation (%);Contrainte (MPa)\n"
        + rows(TIME, 100 * STRAIN, STRESS / 1e6, separator=";", comma=True),
        "cp1252",
        "cp1252",
    ),
    "uniaxial_utf16.txt": (
        "Strain [-]\tStress [kPa]\n" + rows(STRAIN, STRESS / 1e3, separator="\t"),
        "utf-16",
        "utf-16",
    ),
    "uniaxial_utf16_no_mark.txt": (
        "Strain [-]\tStress [kPa]\n" + rows(STRAIN, STRESS / 1e3, separator="\t"),
        "utf-16-le",
        "utf-16-le",
    ),
    "mts_tensile.txt": (
        "MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A\n\nSpecimen Width: 4.0 mm\nSpecimen Thickness: 2.0 mm\nGauge Length: "
        "25.0 mm\n\n"
        "Running Time\tAxial Displacement\tAxial Force\nsec\tmm\tN\n"
        + rows(TIME, EXTENSION, FORCE, separator="\t", decimals=9),
        "utf-8",
        "over 25 mm",
    ),
    "zwick_zugversuch.csv": (
        '"Probenbreite b0";4,00;"mm"\n"Probendicke a0";2,00;"mm"\n"Messlänge '
        'L0";25,0;"mm"\n\n"Verlängerung";"Kraft"\n"mm";"mN"\n'
        + rows(EXTENSION, FORCE * 1e3, separator=";", comma=True, decimals=9),
        "cp1252",
        "over 8 mm2",
    ),
    "uniaxial_imperial.csv": (
        "Width,0.157480314960,in\nThickness,0.0787401574803,in\nGauge length,0.984251968504,in\nExtension "
        "(in),Load (lbf)\n" + rows(EXTENSION * 1e-3 / INCH, FORCE / POUND, decimals=12),
        "utf-8",
        "lbf",
    ),
    "uniaxial_kgf.csv": (
        "Strain (%),Load (kgf)\n" + rows(100 * STRAIN, FORCE / GRAVITY, decimals=9),
        "utf-8",
        "--area",
    ),
    "uniaxial_balance.csv": (
        "Strain (%),Load (g)\n" + rows(100 * STRAIN, 1e3 * FORCE / GRAVITY, decimals=9),
        "utf-8",
        "--area",
    ),
    "uniaxial_hencky.csv": (
        "Hencky strain,Cauchy stress (kPa)\n" + rows(np.log(STRETCH), STRESS * STRETCH / 1e3),
        "utf-8",
        "exp(true strain)",
    ),
    "uniaxial_true.csv": (
        "True Strain;True Stress (MPa);Engineering Strain;Engineering Stress (MPa)\n"
        + rows(np.log(STRETCH), STRESS * STRETCH / 1e6, STRAIN, STRESS / 1e6, separator=";"),
        "utf-8",
        "not true strain",
    ),
    "tensile_hms.csv": (
        "Time,Strain,Stress (kPa)\n"
        + "".join(
            f"0:{int(t) // 60:02d}:{t % 60:06.3f},{a:.6f},{b:.6f}\n"
            for t, a, b in zip(TIME, STRAIN, STRESS / 1e3, strict=True)
        ),
        "utf-8",
        "",
    ),
    "uniaxial_index.csv": (
        ",strain,stress_kPa\n"
        + "".join(f"{k},{a:.6f},{b:.6f}\n" for k, (a, b) in enumerate(zip(STRAIN, STRESS / 1e3, strict=True))),
        "utf-8",
        "",
    ),
    "uniaxial_r.txt": (
        '"stretch" "stress_kPa"\n'
        + "".join(f'"{k + 1}" {a:.6f} {b:.6f}\n' for k, (a, b) in enumerate(zip(STRETCH, STRESS / 1e3, strict=True))),
        "utf-8",
        "",
    ),
    "uniaxial_savetxt.txt": ("# stretch stress_kPa\n" + rows(STRETCH, STRESS / 1e3, separator=" "), "utf-8", "blanks"),
    "uniaxial_thousands.csv": (
        '"Strain (%)","Stress (Pa)"\n'
        + "".join(f'"{a:.4f}","{b:,.3f}"\n' for a, b in zip(100 * STRAIN, STRESS, strict=True)),
        "utf-8",
        "",
    ),
    "Zug_tausender.csv": (
        "Dehnung [%];Spannung [Pa]\n"
        + "".join(
            f"{a:.4f};{b:,.3f}\n".replace(",", " ").replace(".", ",") for a, b in zip(100 * STRAIN, STRESS, strict=True)
        ),
        "utf-8",
        "decimal sign ','",
    ),
    "uniaxial_remarks.csv": (
        "Stretch,Stress (kPa)\n"
        + rows(STRETCH[:20], STRESS[:20] / 1e3)
        + "operator: door opened\n"
        + rows(STRETCH[20:], STRESS[20:] / 1e3),
        "utf-8",
        "no row of numbers",
    ),
    "uniaxial_minus.csv": (
        "strain,stress (kPa)\n" + rows(STRAIN, -STRESS / 1e3).replace("-", "−"),
        "utf-8",
        "its sign is reversed",
    ),
    "uniaxial_kilo.csv": ("Strain (%),Stress (KPA)\n" + rows(100 * STRAIN, STRESS / 1e3), "utf-8", "kPa"),
    "uniaxial_trailing.csv": ("stretch,stress_kPa\n" + rows(STRETCH, STRESS / 1e3).replace("\n", ",,\n"), "utf-8", ""),
}
WITH_AREA = from_words(area_mm2=8.0)


def read(
    folder: Path, name: str, text: str, encoding: str = "utf-8", options: ImportOptions | None = None
) -> SheetTests:
    """Write a file and read it."""
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return read_sheet_tests([path], options)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_same_numbers_come_out_of_every_layout(tmp_path: Path, name: str) -> None:
    text, encoding, words = LAYOUTS[name]
    found = read(tmp_path, name, text, encoding, WITH_AREA if words == "--area" else None)
    (test,) = found.tests
    assert test.kind == "uniaxial"
    np.testing.assert_allclose(test.stretch1, STRETCH, atol=2e-6)
    np.testing.assert_allclose(test.stress1, STRESS, atol=2.0)
    told = "\n".join(found.understood[0].lines())
    assert words in told or words == "--area"


def refused(folder: Path, name: str, text: str, options: ImportOptions | None = None) -> str:
    """The message with which a file is refused."""
    with pytest.raises(ImportRefused) as caught:
        read(folder, name, text, options=options)
    assert caught.value.exit_code == 2
    return str(caught.value)


PLAIN = "stretch,nominal_stress_kPa\n" + rows(STRETCH, STRESS / 1e3)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("sheet.csv", lambda text: text, ["kind", "--kind uniaxial"]),
        ("simple_shear.csv", lambda text: text, ["simple shear", "not supported"]),
        ("uniaxial.csv", lambda text: text.replace("_kPa", ""), ["unit of stress", "missing", "--unit stress=MPa"]),
        ("uniaxial.csv", lambda text: text.replace("stress_kPa", "stress (furlong)"), ["stress", "--unit stress="]),
        ("uniaxial.csv", lambda text: text.replace("_kPa", "_mm"), ["--"]),
        (
            "uniaxial.csv",
            lambda text: text.replace("stretch", "stress_kPa", 1),
            ["2 columns can be the stress", "--column stress=1"],
        ),
        ("uniaxial.csv", lambda text: text.replace("1.250000,", "1_0,"), ["line 12", "column 1", "'1_0'", "--rows"]),
        ("uniaxial.csv", lambda text: text.replace("1.250000,", "1.25x,"), ["line 12", "column 1", "'1.25x'"]),
        ("uniaxial.csv", lambda text: text.replace("1.250000,", "inf,"), ["line 12", "'inf'"]),
        ("uniaxial.csv", lambda text: text.replace("1.250000,", "1e999,"), ["line 12", "'1e999'"]),
        ("uniaxial.csv", lambda text: "stretch,nominal_stress_kPa\n1.1,20\n", ["no rows"]),
        ("biaxial.csv", lambda text: text, ["two stretches and two stresses", "--kind equibiaxial"]),
        ("uniaxial_planar.csv", lambda text: "# kind: uniaxial\n" + text, ["two kinds"]),
    ],
)
def test_it_is_refused_and_the_message_names_the_place_and_the_option(
    tmp_path: Path, name: str, change: Callable[[str], str], words: list[str]
) -> None:
    message = refused(tmp_path, name, change(PLAIN))
    for word in words:
        assert word in message, message


def test_all_obstacles_are_named_at_once(tmp_path: Path) -> None:
    message = refused(tmp_path, "x.csv", "a;Dehnung;Kraft\n" + rows(TIME, STRAIN, FORCE, separator=";", decimals=8))
    for option in ("--kind", "--area-mm2"):
        assert option in message


def test_a_unit_is_asked_for_and_never_guessed(tmp_path: Path) -> None:
    message = refused(
        tmp_path, "uniaxial.csv", "strain,force\n" + rows(STRAIN, FORCE, decimals=8), from_words(area_mm2=8.0)
    )
    assert "--unit force=N" in message
    found = read(
        tmp_path,
        "uniaxial.csv",
        "strain,force\n" + rows(STRAIN, FORCE, decimals=8),
        options=from_words(area_mm2=8.0, unit=["force=N"]),
    )
    np.testing.assert_allclose(found.tests[0].stress1, STRESS, atol=2.0)


def test_specimens_one_below_the_other_and_side_by_side(tmp_path: Path) -> None:
    table = "Strain (%),Stress (kPa)\n" + rows(100 * STRAIN, STRESS / 1e3)
    second = "Strain (%),Stress (kPa)\n" + rows(100 * STRAIN, 1.1 * STRESS / 1e3)
    found = read(tmp_path, "tensile.csv", f"Specimen 1\n{table}\nSpecimen 2\n{second}")
    assert [test.stress1[-1] for test in found.tests] == pytest.approx([STRESS[-1], 1.1 * STRESS[-1]], rel=1e-6)
    assert "Specimen 2" in found.tests[1].name
    beside = "Strain 1 (%),Stress 1 (kPa),Strain 2 (%),Stress 2 (kPa)\n" + rows(
        100 * STRAIN, STRESS / 1e3, 100 * STRAIN, 1.1 * STRESS / 1e3
    )
    found = read(tmp_path, "tensile_b.csv", beside)
    assert [test.stress1[-1] for test in found.tests] == pytest.approx([STRESS[-1], 1.1 * STRESS[-1]], rel=1e-6)
    only = read(tmp_path, "tensile_b.csv", beside, options=from_words(specimen=["2"]))
    assert [test.stress1[-1] for test in only.tests] == pytest.approx([1.1 * STRESS[-1]], rel=1e-6)
    column = "".join(
        f"A{k},{a:.6f},{b:.6f}\n"
        for k in (1, 2)
        for a, b in zip(STRETCH, (1 + 0.1 * (k - 1)) * STRESS / 1e3, strict=True)
    )
    found = read(tmp_path, "tensile_c.csv", "Specimen,Stretch,Stress (kPa)\n" + column)
    assert [test.stress1[-1] for test in found.tests] == pytest.approx([STRESS[-1], 1.1 * STRESS[-1]], rel=1e-6)


def test_two_directions_are_a_biaxial_test_whatever_the_name(tmp_path: Path) -> None:
    other = np.linspace(1.1, 1.6, 41)
    stress2 = G * (other - 1.0 / (other**3 * STRETCH**2))
    stress1 = G * (STRETCH - 1.0 / (STRETCH**3 * other**2))
    text = "stretch1,stretch2,nominal_stress1_MPa,nominal_stress2_MPa\n" + rows(
        STRETCH, other, stress1 / 1e6, stress2 / 1e6
    )
    (test,) = read(tmp_path, "film.csv", text).tests
    assert test.kind == "biaxial"
    np.testing.assert_allclose(test.stress2, stress2, atol=2.0)
    message = refused(tmp_path, "uniaxial_film.csv", text)
    assert "one stretch and one stress" in message and "--kind biaxial" in message


def test_a_file_given_twice_is_refused_and_two_of_one_name_both_appear(tmp_path: Path) -> None:
    one, other = tmp_path / "a" / "uniaxial.csv", tmp_path / "b" / "uniaxial.csv"
    for path, factor in ((one, 1.0), (other, 1.07)):
        path.parent.mkdir()
        path.write_text("stretch,stress_kPa\n" + rows(STRETCH, factor * STRESS / 1e3))
    names = [test.name for test in read_sheet_tests([one, other]).tests]
    assert names == ["uniaxial (1)", "uniaxial (2)"]
    with pytest.raises(ImportRefused, match="twice"):
        read_sheet_tests([one, one])


def test_rows_repeated_five_times_count_once(tmp_path: Path) -> None:
    found = read(
        tmp_path, "uniaxial.csv", "stretch,stress_kPa\n" + rows(np.repeat(STRETCH, 5), np.repeat(STRESS, 5) / 1e3)
    )
    assert found.tests[0].stretch1.tolist() == STRETCH.tolist()
    assert "repeat" in "\n".join(found.understood[0].lines())


def test_cycles_break_toe_offset_and_stiffness_are_told(tmp_path: Path) -> None:
    up, down = STRETCH, STRETCH[::-1][1:]
    cycles = "stretch,stress_kPa\n" + rows(
        np.concatenate((up, down)), np.concatenate((STRESS, 0.8 * STRESS[::-1][1:])) / 1e3
    )
    found = read(tmp_path, "uniaxial.csv", cycles)
    assert found.tests[0].stretch1.tolist() == STRETCH.tolist()
    assert "unloading" in "\n".join(found.understood[0].lines())
    found = read(tmp_path, "uniaxial.csv", cycles, options=from_words(branch="unloading"))
    np.testing.assert_allclose(found.tests[0].stress1.max(), 0.8 * STRESS[-2], rtol=1e-5)
    broken = "stretch,stress_kPa\n" + rows([*STRETCH, 2.02, 2.04], [*(STRESS / 1e3), 3.0, 1.0])
    found = read(tmp_path, "uniaxial.csv", broken)
    assert found.tests[0].stretch1.size == 41 and "broke" in "\n".join(found.understood[0].lines())
    assert found.understood[0].left_out["after the break"] == [43, 44]
    toe = "stretch,stress_kPa\n" + rows(
        np.linspace(1.0, 2.2, 49), np.interp(np.linspace(1.0, 2.2, 49), STRETCH + 0.2, STRESS, left=0.0) / 1e3
    )
    assert "slack" in "\n".join(read(tmp_path, "uniaxial.csv", toe).understood[0].lines())
    shifted = "stretch,stress_kPa\n" + rows(STRETCH, (STRESS + 3e4) / 1e3)
    found = read(tmp_path, "uniaxial.csv", shifted)
    assert "tared" in "\n".join(found.understood[0].lines())
    found = read(tmp_path, "uniaxial.csv", shifted, options=from_words(zero=["stress=first"]))
    np.testing.assert_allclose(found.tests[0].stress1, STRESS, atol=2.0)
    stiff = "stretch,stress_MPa\n" + rows(STRETCH, STRESS / 1e3)
    assert "unusual" in "\n".join(read(tmp_path, "uniaxial.csv", stiff).understood[0].lines())


def test_a_jump_and_compression_counted_positive_are_refused(tmp_path: Path) -> None:
    jumped = STRETCH.copy()
    jumped[25:] -= 0.5
    message = refused(tmp_path, "uniaxial.csv", "stretch,stress_kPa\n" + rows(jumped, STRESS / 1e3))
    assert "jumps" in message and "--rows 2-26" in message
    short = np.linspace(1.0, 0.6, 30)
    message = refused(tmp_path, "uniaxial.csv", "stretch,stress_kPa\n" + rows(short, -G * (short - short**-2) / 1e3))
    assert "tension" in message and "--sign stress=-" in message


@pytest.mark.parametrize(
    ("heading", "name", "unit", "known"),
    [
        ("Stress (eng)", "Stress (eng)", "", False),  # a word of the name
        ("Weg (Soll)", "Weg (Soll)", "", False),
        ("Kraft [mN]", "Kraft", "mN", True),
        ("Load (psf)", "Load", "psf", False),  # meant for a unit, which has to be asked for
        ("Force (smoothed)", "Force (smoothed)", "", False),
    ],
)
def test_what_stands_in_brackets_is_a_unit_or_belongs_to_the_name(
    heading: str, name: str, unit: str, known: bool
) -> None:
    found = split_unit(heading)
    assert found[:2] == (name, unit) and (found[2] is not None) == known


@pytest.mark.parametrize(
    ("lines", "said"),
    [([7], "7"), ([3, 4], "3-4"), ([19, 3, 17, 18, 18], "3, 17-19"), ([1, 3, 5, 7], "1, 3, 5, 7"),
     ([1, 3, 5, 7, 9], "1, 3, 5, 7 and more"), ([1, 3, 5, 7, 9, 11], "1, 3, 5, 7 and more")],
)  # fmt: skip
def test_lines_are_named_in_spans_and_not_more_than_four(lines: list[int], said: str) -> None:
    assert spans(lines) == said


def test_options_stand_beside_the_data(tmp_path: Path) -> None:
    (tmp_path / "a.import.toml").write_text(
        'kind = "uniaxial"\narea_mm2 = 8.0\n[column]\nforce = "F2"\nstrain = 1\n[unit]\nforce = "mN"\n'
    )
    text = "e;F1;F2\n" + rows(STRAIN, FORCE, FORCE * 1e3, separator=";", decimals=7)
    found = read(tmp_path, "a.csv", text)
    np.testing.assert_allclose(found.tests[0].stress1, STRESS, atol=2.0)
    assert "a.import.toml" in found.understood[0].lines()[1]


def test_too_large_and_binary_files_are_refused_before_they_are_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.importing.text.LARGEST_BYTES", 100)
    assert "MB" in refused(tmp_path, "uniaxial.csv", PLAIN)
    monkeypatch.undo()
    for head, words in (
        (b"PK\x03\x04\x00", "workbook"),
        (b"\x00\x01\x02" * 50, "not a text file"),
        (b"", "empty"),
        (b"TDSm\x0e", "TDMS"),
    ):
        (tmp_path / "x.csv").write_bytes(head)
        with pytest.raises(ImportRefused, match=words):
            read_sheet_tests([tmp_path / "x.csv"])
    with pytest.raises(ImportRefused, match="there is no such file"):
        read_sheet_tests([tmp_path / "none.csv"])


@pytest.mark.slow
def test_two_hundred_thousand_rows_take_seconds(tmp_path: Path) -> None:
    import time

    count = 200_000
    stretch = np.linspace(1.0, 2.0, count)
    text = "Time (s);Strain (%);Stress (kPa)\n" + rows(
        np.arange(count) * 0.01, 100 * (stretch - 1), G * (stretch - stretch**-2) / 1e3, separator=";", comma=True
    )
    path = tmp_path / "uniaxial.csv"
    path.write_text(text)
    begun = time.process_time()
    (test,) = read_sheet_tests([path]).tests
    assert time.process_time() - begun < 5.0
    assert test.stretch1.size == count and math.isclose(test.stretch1[-1], 2.0, rel_tol=1e-9)


@pytest.mark.parametrize(
    ("heading", "quantity", "unit"),
    [
        ("Stress N/mm2", "stress", "N/mm2"),
        ("F_raw_mV/V", "other", "mV/V"),
        ("Dehnung/%", "strain", "%"),
        ("Kraft in N", "force", "N"),
        ("Spannung [kV]", "voltage", "kV"),
        ("Spannung [MPa]", "stress", "MPa"),
        ("Elongation (mm)", "displacement", "mm"),
        ("Élongation (%)", "strain", "%"),
        ("Tension (V)", "voltage", "V"),
        ("load_cell", "force", None),
        ("λ", "stretch", None),
        ("Strain rate (1/s)", "other", "1/s"),
        ("hv_V", "voltage", "V"),
        ("nominal_stress_mpa", "stress", "MPa"),
    ],
)
def test_headings_are_understood(heading: str, quantity: str, unit: str | None) -> None:
    from rig.importing.headings import understand

    found = understand(heading)
    assert found.quantity == quantity
    assert (found.unit.name if found.unit else None) == unit


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
def test_a_row_of_units_that_says_so_is_found_beside_one_channel_and_many(channels: int) -> None:
    row = TextRow(7, ["Y_Unit_Label", *["N"] * channels])
    found = _unit_row_above([TextRow(3, ["Operator", "N"]), row], channels + 1)
    assert found == (7, ["s", *["N"] * channels])
    assert _unit_row_above([TextRow(7, ["Y_Unit_Label", *["Ann"] * channels])], channels + 1) is None
