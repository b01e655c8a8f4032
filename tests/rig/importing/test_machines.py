"""Tables of many makers' machines, of spreadsheets and of home-made rigs, from numbers that are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.material.materials import Material
from model.specimen import Specimen
from rig.importing.cone_table import read_cone_tables
from rig.importing.findings import ImportRefused
from rig.importing.options import from_words
from rig.importing.sheet_table import read_sheet_tests
from tests.rig.importing.test_layouts import (
    EXTENSION,
    FORCE,
    GRAVITY,
    INCH,
    POUND,
    STRAIN,
    STRESS,
    STRETCH,
    TIME,
    rows,
)

Array = NDArray[np.float64]


def german(value: float, decimals: int) -> str:
    """A number with points between thousands and a decimal comma."""
    return f"{value:,.{decimals}f}".translate(str.maketrans(",.", ".,"))


def quoted(*columns: Sequence[float]) -> str:
    return "".join(",".join(f'"{value:.9f}"' for value in row) + "\n" for row in zip(*columns, strict=True))


def clock(t: float) -> str:
    return f"{int(t) // 3600:02d}:{int(t) // 60 % 60:02d}:{t % 60:06.3f}"


MPA, KPA = STRESS / 1e6, STRESS / 1e3
SHEETS: dict[str, tuple[str, str]] = {  # file: text, encoding
    "Instron Bluehill 3 tensile.csv": (
        '"Results Table 1"\n"","Maximum Load","Tensile stress at Maximum Load"\n"","(N)","(MPa)"\n'
        '"1","3.50000","0.43750"\n"Mean","3.50000","0.43750"\n\n"Results Table 2"\n"","Width","Thickness","Length"\n'
        '"","(mm)","(mm)","(mm)"\n"1","4.00000","2.00000","25.00000"\n\n"Time","Extension","Load"\n"(sec)","(mm)","(N)"\n'
        + quoted(TIME, EXTENSION, FORCE),
        "utf-8-sig",
    ),
    "Bluehill Universal uniaxial.csv": (
        'Specimen label,"Film 1"\nWidth,4.000000,mm\nThickness,2.000000,mm\nGauge length,25.00000,mm\n'
        "Time,Displacement,Force,Tensile strain (Displacement),Tensile stress\n(s),(mm),(N),(%),(MPa)\n"
        + quoted(TIME, EXTENSION, FORCE, 100 * STRAIN, MPA),
        "utf-8",
    ),
    "testXpert II Zugversuch.txt": (
        "Prüfprotokoll\nPrüfnorm\t:\tDIN 53504\nEinspannlänge\t:\t25,00\tmm\n\nProbe 1\nProbendicke\t2,00\tmm\n"
        "Probenbreite\t4,00\tmm\n\nPrüfzeit\tStandardweg\tStandardkraft\tDehnung\ns\tmm\tN\t%\n"
        + rows(TIME, EXTENSION, FORCE, 100 * STRAIN, separator="\t", comma=True, decimals=9),
        "cp1252",
    ),
    "testXpert III Zug.csv": (
        '"Dehnung";"Spannung"\n"%";"Pa"\n'
        + "".join(f"{german(a, 4)};{german(b, 3)}\n" for a, b in zip(100 * STRAIN, STRESS, strict=True)),
        "cp1252",
    ),
    "MTS TestSuite uniaxial.txt": (
        "Test Run Name:\tRun 7\nDate:\t3/4/2024 10:11:12 AM\nWidth (mm):\t4.00\nThickness (mm):\t2.00\n"
        "Gage Length (mm):\t25.0\n\nCrosshead\tLoad\tTime\nmm\tN\tsec\n"
        + rows(EXTENSION, FORCE, TIME, separator="\t", decimals=9),
        "utf-8",
    ),
    "TA RSA-G2 tension.txt": (
        "Filename\tfilm.tri\nInstrument name\tRSA-G2\nGeometry name\tTension fixture (rectangle)\n"
        "Loading gap\t25.0 mm\nWidth\t4.0 mm\nThickness\t2.0 mm\n[step]\nAxial - 1\n"
        "Step time\tLength\tStrain\tStress\tAxial force\n"
        "s\tmm\t%\tMPa\tN\n" + rows(TIME, 25 * STRETCH, 100 * STRAIN, MPA, FORCE, separator="\t", decimals=9),
        "utf-8",
    ),
    "Mark-10 uniaxial.csv": (
        "MESURgauge Plus\nSample width,4.0,mm\nSample thickness,2.0,mm\nOriginal length,25.0,mm\n"
        "Reading,Load (lbF),Travel (in),Time (sec)\n"
        + "".join(
            f"{k + 1},{a:.9f},{b:.9f},{t:.1f}\n"
            for k, (a, b, t) in enumerate(zip(FORCE / POUND, EXTENSION * 1e-3 / INCH, TIME, strict=True))
        ),
        "utf-8",
    ),
    "LabVIEW uniaxial.lvm": (
        "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nTime\t10:11:12,123\n***End_of_Header***\t\n\t\n"
        "Channels\t2\t\t\nSamples\t41\t41\t\nY_Unit_Label\t%\tkPa\t\nX_Dimension\tTime\tTime\t\nX0\t0,0E+0\t0,0E+0\t\n"
        "***End_of_Header***\t\t\t\nX_Value\tDehnung\tSpannung\tComment\n"
        + rows(TIME, 100 * STRAIN, KPA, separator="\t", comma=True).replace("\n", "\t\n"),
        "utf-8",
    ),
    "Excel sep tensile.csv": (
        "sep=;\nStrain [%];Stress [kPa]\n" + rows(100 * STRAIN, KPA, separator=";", comma=True),
        "utf-8-sig",
    ),
    "Excel empty rows and columns uniaxial.csv": (
        ",,,,\nTensile test,,,,\n,,,,\n,Strain,Stress,,\n,(mm/mm),(MPa),,\n"
        + "".join(f",{a:.6f},{b:.8f},,\n" for a, b in zip(STRAIN, MPA, strict=True))
        + ",,,,\n,,,,\n",
        "utf-8",
    ),
    "Excel errors uniaxial.csv": (
        "Strain;Stress (MPa);Modulus\n"
        + "".join(
            f"{a:.6f};{b:.8f};{'#DIV/0!' if a == 0.0 else f'{b / a:.3f}'}\n".replace(".", ",")
            for a, b in zip(STRAIN, MPA, strict=True)
        ),
        "utf-8",
    ),
    "exponents uniaxial.txt": (
        "Dehnung\tSpannung / kPa\n"
        + "".join(f"{a:.7E}\t{b:.7E}\n".replace(".", ",") for a, b in zip(STRAIN, KPA, strict=True)),
        "utf-8",
    ),
    "Swiss thousands uniaxial.csv": (
        "Dehnung [%];Spannung [Pa]\n"
        + "".join(f"{a:.4f};{b:,.2f}\n".replace(",", "'") for a, b in zip(100 * STRAIN, STRESS, strict=True)),
        "utf-8",
    ),
    "traction, espaces fines.csv": (
        "Allongement (%);Contrainte nominale (Pa)\n"
        + "".join(
            f"{a:.4f};{b:,.2f}\n".replace(",", "\u202f").replace(".", ",")
            for a, b in zip(100 * STRAIN, STRESS, strict=True)
        ),
        "utf-8",
    ),
    "Zug hms.csv": (
        "Zeit;Dehnung;Spannung\nhh:mm:ss;%;kPa\n"
        + "".join(
            f"{clock(t)};{100 * a:.4f};{b:.5f}\n".replace(".", ",") for t, a, b in zip(TIME, STRAIN, KPA, strict=True)
        ),
        "cp1252",
    ),
    "ISO times tensile.csv": (
        "timestamp,stretch,stress_kPa\n"
        + "".join(f"2024-03-01T10:00:{t:06.3f}Z,{a:.6f},{b:.6f}\n" for t, a, b in zip(TIME, STRETCH, KPA, strict=True)),
        "utf-8",
    ),
    "big-endian uniaxial.txt": (
        "\ufeffStretch\tNominal stress [kPa]\n" + rows(STRETCH, KPA, separator="\t"),
        "utf-16-be",
    ),
    "old Mac uniaxial.csv": (("Stretch,Stress (kPa)\n" + rows(STRETCH, KPA)).replace("\n", "\r"), "utf-8"),
    "fixed width uniaxial.txt": (
        "   Strain     Stress\n    [%]        [kPa]\n"
        + "".join(f"{100 * a:10.4f} {b:12.5f}\n" for a, b in zip(STRAIN, KPA, strict=True)),
        "utf-8",
    ),
    "drawn lines uniaxial.txt": (
        "| Stretch | Stress (kPa) |\n|---|---|\n"
        + "".join(f"| {a:.6f} | {b:.6f} |\n" for a, b in zip(STRETCH, KPA, strict=True)),
        "utf-8",
    ),
    "comma and blank uniaxial.csv": (
        "stretch, stress [kPa]\n"
        + "".join(f"{a:.4f}/{b:.4f}\n".replace(".", ",").replace("/", ", ") for a, b in zip(STRETCH, KPA, strict=True)),
        "utf-8",
    ),
    "micrometres uniaxial.csv": (
        "Breite;4,0;mm\nDicke;2000;µm\nMesslänge;25;mm\nVerlängerung [µm];Kraft [cN]\n"
        + rows(EXTENSION * 1e3, FORCE * 100, separator=";", comma=True, decimals=7),
        "cp1252",
    ),
    "cross-section uniaxial.csv": (
        "Querschnitt;8,0;mm²\nLänge L0;25;mm\nWeg in mm;Kraft in N\n"
        + rows(EXTENSION, FORCE, separator=";", comma=True, decimals=9),
        "cp1252",
    ),
    "psi uniaxial.csv": (
        "Strain (in/in),Stress (psi)\n" + rows(STRAIN, STRESS / (POUND / INCH**2), decimals=9),
        "utf-8",
    ),
    "gnuplot uniaxial.dat": (
        "# uniaxial test\n# stretch  stress\n# -  kPa\n" + rows(STRETCH, KPA, separator=" "),
        "utf-8",
    ),
    "downwards uniaxial.csv": ("stretch,stress_kPa\n" + rows(STRETCH[::-1], KPA[::-1]), "utf-8"),
}


@pytest.mark.parametrize("name", SHEETS)
def test_a_sheet_is_read_to_the_numbers_that_were_written(tmp_path: Path, name: str) -> None:
    text, encoding = SHEETS[name]
    (tmp_path / name).write_bytes(text.encode(encoding))
    (test,) = read_sheet_tests([tmp_path / name]).tests
    order = np.argsort(test.stretch1)
    assert test.stretch1.size == STRETCH.size
    np.testing.assert_allclose(test.stretch1[order], STRETCH, rtol=2e-6)
    np.testing.assert_allclose(test.stress1[order], STRESS, rtol=2e-6, atol=0.06)


# --- rigs

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("x", (33e3, 32e3), (2.0, 5.0), 1.9), name="film-a")
VOLTAGES, EACH = (0.0, 1000.0, 1500.0), 120


def run() -> tuple[Array, Array, Array, Array]:
    """Time (s), displacement (m), force (N) and voltage (V) of three ways out and back."""
    random = np.random.default_rng(0)
    way = np.concatenate((np.linspace(0.0, 10.0, EACH // 2), np.linspace(10.0, 0.0, EACH // 2)))
    h = np.tile(way, 3)
    volts = np.repeat(VOLTAGES, EACH)
    force = (0.0116 * h + 1e-4 * h**3) * (1.0 - 0.25 * (volts / 1500.0) ** 2)
    time = np.concatenate([k * 29.0 + 0.2 * np.arange(EACH) for k in range(3)])
    return time, h * 1e-3 + 2e-6 * random.standard_normal(h.size), force + 5e-4 * random.standard_normal(h.size), volts


T, H, F, V = run()
MM = H * 1e3


def lines(pattern: str, *columns: Sequence[float], comma: bool = False) -> str:
    text = "".join(pattern.format(*row) + "\n" for row in zip(*columns, strict=True))
    return text.replace(".", ",") if comma else text


THIRDS = [slice(k * EACH, (k + 1) * EACH) for k in range(3)]
RIGS: dict[str, tuple[str, str, bool]] = {  # file: text, encoding, whether it tells time
    "Keysight DAQ.csv": (
        "Instrument,34970A,,\nStart Time,3/1/2024 10:11:12,,\nChannels,3,,\n"
        "Scan,Time,101 <LVDT> (mm),102 <LOAD> (N),103 <HV MON> (kV)\n"
        + "".join(
            f"{k + 1},3/1/2024 10:{11 + int(t) // 60}:{int(t) % 60:02d}:{round(1000 * (t % 1)):03d},"
            f"{h:+.8E},{f:+.8E},{v:+.8E}\n"
            for k, (t, h, f, v) in enumerate(zip(T, MM, F, V / 1e3, strict=True))
        ),
        "utf-8",
        True,
    ),
    "FUTEK SENSIT.csv": (
        "Sensor Name,LSB200,,\nSerial Number,123456,,\nUnit,gf,,\n\n"
        "Sample,Time (s),Tracking Value (gf),Laser (mm),HV (V)\n"
        + lines("{:.0f},{:.3f},{:.4f},{:.5f},{:.1f}", np.arange(T.size), T, F * 1e3 / GRAVITY, MM, V),
        "utf-8",
        True,
    ),
    "LabVIEW.lvm": (
        "LabVIEW Measurement\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\n\nChannels\t3\nSamples\t1\t1\t1\n"
        "Y_Unit_Label\tmm\tN\tV\nX_Dimension\tTime\tTime\tTime\n***End_of_Header***\n"
        "X_Value\tPosition\tForce\tHV monitor\tComment\n" + lines("{:.6f}\t{:.6f}\t{:.6f}\t{:.3f}", T, MM, F, V),
        "utf-8",
        True,
    ),
    "German spreadsheet.csv": (
        "Messprotokoll;;;\nPrüfer;Müller;;\n;;;\nZeit;Weg;Kraft;Hochspannung\n[s];[mm];[mN];[kV]\n"
        + lines("{:.2f};{:.5f};{:.5f};{:.5f}", T, MM, F * 1e3, V / 1e3, comma=True),
        "cp1252",
        True,
    ),
    "French.txt": (
        "Temps (s)\tDéplacement (µm)\tForce (mN)\tTension (V)\n"
        + lines("{:.2f}\t{:.3f}\t{:.4f}\t{:.1f}", T, H * 1e6, F * 1e3, V, comma=True),
        "cp1252",
        True,
    ),
    "times of day.csv": (
        "Time,Displacement (mm),Force (N),Voltage (V)\n" + lines("{},{:.6f},{:.6f},{:.1f}", map(clock, T), MM, F, V),  # type: ignore[arg-type]
        "utf-8",
        True,
    ),
    "balance.csv": (
        "millis,pos_um,load_g,hv_V\n" + lines("{:.0f},{:.2f},{:.4f},{:.0f}", T * 1e3, H * 1e6, F * 1e3 / GRAVITY, V),
        "utf-8",
        True,
    ),
    "UTF-16.csv": (
        "Time (s),Displacement (mm),Force (N),Voltage (kV)\n" + lines("{:.2f},{:.6f},{:.6f},{:.4f}", T, MM, F, V / 1e3),
        "utf-16",
        True,
    ),
    "counted downwards.csv": (
        "t [s];z [mm];F [N];U [V]\n" + lines("{:.2f};{:.6f};{:.6f};{:.1f}", T, -MM, -F, V, comma=True),
        "utf-8",
        True,
    ),
    "set and measured.csv": (
        "t_s,stage_mm,laser_mm,F_N,V_set,V_mon_kV\n"
        + lines("{:.2f},{:.6f},{:.6f},{:.6f},{:.1f},{:.4f}", T, MM * 1.02, MM, F, V * 1.01, V / 1e3),
        "utf-8",
        True,
    ),
    "stacked.csv": (
        "".join(
            f"# voltage {V[part][0]:.0f} V\ndisplacement_mm,force_N,voltage_V\n"
            + lines("{:.6f},{:.6f},{:.1f}", MM[part], F[part], V[part])
            for part in THIRDS
        ),
        "utf-8",
        False,
    ),
    "side by side.csv": (
        ",".join(["displacement_mm,force_N,voltage_V"] * 3)
        + "\n"
        + rows(*(column[part] for part in THIRDS for column in (MM, F, V))),
        "utf-8",
        False,
    ),
    "thousands.csv": (
        "Time (s);Voltage (V);Displacement (mm);Force (N)\n"
        + "".join(
            f"{german(t, 2)};{german(v, 1)};{german(h, 6)};{german(f, 6)}\n"
            for t, v, h, f in zip(T, V, MM, F, strict=True)
        ),
        "utf-8",
        True,
    ),
    "with leakage.csv": (
        "t_s,h_mm,F_N,V_mon_V,I_mon_uA,temp_C\n"
        + lines("{:.2f},{:.6f},{:.6f},{:.1f},{:.4f},{:.1f}", T, MM, F, V, V * 1e-5, 22 + 0 * V),
        "utf-8",
        True,
    ),
    "inches and pounds.csv": (
        "Time (sec),Crosshead (in),Load (lbf),HV (kV)\n"
        + lines("{:.2f},{:.8f},{:.8f},{:.4f}", T, H / INCH, F / POUND, V / 1e3),
        "utf-8",
        True,
    ),
}


def check(curves: Sequence[Curve], timed: bool) -> None:
    assert sorted(curve.nominal_voltage for curve in curves) == list(VOLTAGES)
    for curve, part in zip(curves, THIRDS, strict=True):
        assert curve.h.size >= 0.95 * EACH
        rows_of = [
            int(np.argmin(np.abs(H[part] - h) + 1e-3 * np.abs(F[part] - f)))
            for h, f in zip(curve.h, curve.force, strict=True)
        ]
        np.testing.assert_allclose(curve.h, H[part][rows_of], atol=2e-8)
        np.testing.assert_allclose(curve.force, F[part][rows_of], atol=2e-6)
        assert (curve.time is not None) == timed
        if curve.time is not None:
            assert np.ptp(curve.time) == pytest.approx(np.ptp(T[part]), abs=0.5)
        assert 3e-4 < curve.force_noise < 8e-4 and 1e-6 < curve.displacement_noise < 4e-6


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_is_read_to_the_sweeps_that_were_made(tmp_path: Path, name: str) -> None:
    text, encoding, timed = RIGS[name]
    (tmp_path / name).write_bytes(text.encode(encoding))
    check(read_cone_tables([tmp_path / name], FILM).curves, timed)


def test_a_serial_log_without_heading_is_read_with_its_columns_named(tmp_path: Path) -> None:
    """Chatter between the rows, and a last line that was cut off."""
    text = "boot v1.2\nREADY\n"
    for k, row in enumerate(zip(T, MM, F, V, strict=True)):
        text += "{:.2f},{:.5f},{:.6f},{:.0f}\n".format(*row) + ("# relay\n" if k % 97 == 5 else "")
    (tmp_path / "serial.log").write_text(text + "12.3,4.")
    options = from_words(
        column=["time=1", "displacement=2", "force=3", "voltage=4"],
        unit=["time=s", "displacement=mm", "force=N", "voltage=V"],
    )
    check(read_cone_tables([tmp_path / "serial.log"], FILM, options).curves, timed=True)
    with pytest.raises(ImportRefused) as refused:
        read_cone_tables([tmp_path / "serial.log"], FILM)
    assert all(f"--column {name}=" in str(refused.value) for name in ("displacement", "force", "voltage"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Strain,Stress (MPa)\n" + lines("{:.4f},{:.3f} kPa", STRAIN, KPA), "says MPa, and its cells say kPa"),
        ('{"stretch": [1, 1.1, 1.2], "stress": [0, 1, 2]}', "no rows of at least two numbers"),
        ("Time;Extension;Load\ns;mm;N\n" + rows(TIME, EXTENSION, FORCE, separator=";"), "--length-mm"),
        ("Strain,Load\n%,?\n" + rows(100 * STRAIN, FORCE), "--unit force=N"),
        ("Strain (%),Load (stone)\n" + rows(100 * STRAIN, FORCE), "--unit force=N"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_way_out(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "uniaxial.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ImportRefused) as refused:
        read_sheet_tests([tmp_path / "uniaxial.csv"])
    assert words in str(refused.value) and "Option: --" in str(refused.value)


@pytest.mark.parametrize("heading", ["λ;σ_true [kPa]", "stretch;stress (true) [kPa]", "Stretch;Spannung, wahr [kPa]"])
def test_true_stress_is_known_wherever_the_word_stands(tmp_path: Path, heading: str) -> None:
    (tmp_path / "uniaxial.csv").write_text(heading + "\n" + rows(STRETCH, KPA * STRETCH, separator=";"), "utf-8")
    (test,) = read_sheet_tests([tmp_path / "uniaxial.csv"]).tests
    np.testing.assert_allclose(test.stress1, STRESS, rtol=1e-5, atol=1.0)


def rig(folder: Path, *columns: Array, heading: str = "t_s,h_mm,F_N,U_V") -> Path:
    path = folder / "rig.csv"
    path.write_text(heading + "\n" + lines("{:.2f},{:.6f},{:.6f},{:.1f}", *columns))
    return path


def test_a_negative_supply_is_read_by_the_size_of_its_voltage(tmp_path: Path) -> None:
    check(read_cone_tables([rig(tmp_path, T, MM, F, -V)], FILM).curves, timed=True)


def test_what_does_not_begin_at_zero_is_told(tmp_path: Path) -> None:
    for h, force, word in ((MM + 5.0, F, "--zero displacement=first"), (MM, F + 0.05, "--zero force=first")):
        found = read_cone_tables([rig(tmp_path, T, h, force, V)], FILM)
        assert any(word in line for line in found.understood[0].lines())
    assert not any(
        "--zero" in line for line in read_cone_tables([rig(tmp_path, T, MM, F, V)], FILM).understood[0].lines()
    )


def test_a_voltage_that_no_film_stands_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportRefused, match="which no film stands"):
        read_cone_tables([rig(tmp_path, T, MM, F, V, heading="t_s,h_mm,F_N,U_kV")], FILM)
