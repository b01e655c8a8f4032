"""Slips of human hands: each is told on one screen with file, key, value and what is probably meant."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.base.reference import keys_of, tables_in
from rig.base.unusual import slip, usual_of
from rig.cli.app import main
from rig.cli.topics import FILES

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace("../calibrations", "cal")
PROTOCOL = (FIXTURES / "protocols" / "short.toml").read_text()
PLACES = (folder / "shared" / "cases" / "mistakes.md" for folder in Path(__file__).resolve().parents)
CASES = next((place for place in PLACES if place.is_file()), None)
INTERNALS = ("function-after", "Unable to extract", "Field required", "nput should", "Traceback", "pydantic", "errno")
SCREEN = 24


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "cal").symlink_to(FIXTURES / "calibrations")
    (tmp_path / "s.toml").write_text(SCENE)
    (tmp_path / "p.toml").write_text(PROTOCOL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def say(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments), prog_name="dea-rig")


def told(done: Result, code: int, *words: str) -> None:
    """It ended so, on one screen, without anything of the program's inside, and with these words."""
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == code, done.output
    assert len(done.output.splitlines()) <= SCREEN, done.output
    for inside in INTERNALS:
        assert inside not in done.output, done.output
    flat = " ".join(done.output.split())
    for word in words:
        assert word in flat, done.output


def replaced(text: str, old: str, new: str) -> str:
    assert old in text, old
    return text.replace(old, new, 1)


SCENES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "radius in um": ("ring_radius_mm = 20.0", "ring_radius_mm = 20000.0", ("20000", "If 20000 um is meant, write 20.")),
    "radius in m": (
        "disk_radius_mm = 4.0",
        "disk_radius_mm = 0.004",
        ("disk_radius_mm = 0.004", "0.2 to 100", "If 0.004 m is meant, write 4."),
    ),
    "thickness in mm": (
        "thickness_um = 40.0",
        "thickness_um = 0.04",
        ("thickness_um = 0.04", "1 to 5000", "0.04 mm is meant, write 40", 'accept = ["specimen.thickness_um"]'),
    ),
    "moduli in kPa": ("[33e3, 32e3]", "[33, 32]", ("mu_Pa", "shear modulus", "113 Pa", "in kPa", "33e3 for 33 kPa")),
    "moduli in MPa": ("[33e3, 32e3]", "[0.033, 0.032]", ("mu_Pa", "0.113 Pa", "in MPa")),
    "one negative modulus": ("[33e3, 32e3]", "[33e3, -2e3]", ("mu_Pa 2 = -2000", "same sign")),
    "permittivity, no point": (
        "eps_r = 1.9",
        "eps_r = 190",
        ("eps_r = 190", "usual are 1 to 50", "decimal point is missing, write 19 or 1.9."),
    ),
    "permittivity in F/m": ("eps_r = 1.9", "eps_r = 2.5e-11", ("eps_r = 2.5e-11", "write 2.82")),
    "a pre-stretch beyond the film": (
        "max_stretch = 2.4",
        "max_stretch = 1.1",
        ("prestretch = 1.2", "max_stretch", "1.1"),
    ),
    "an exponent of zero": ("[2.0, 5.0]", "[0, 5.0]", ("specimen, material: alpha = (0.0, 5.0)", "exponent of zero")),
    "disk and ring swapped": (
        "disk_radius_mm = 4.0\nring_radius_mm = 20.0",
        "disk_radius_mm = 20.0\nring_radius_mm = 4.0",
        ("disk_radius_mm = 20 and ring_radius_mm = 4", "Were the two swapped?"),
    ),
    "no limits": (SCENE[SCENE.index("[limits]") : SCENE.index("[stage]")], "", ("limits: this table is missing",)),
    "a table twice": ("gain_error = 5e-4", 'gain_error = 5e-4\n[hv]\ndriver = "x"', ("[hv]", "given twice")),
    "pre-stretch in percent": ("prestretch = 1.2", "prestretch = 20", ("at most 6", "20 % is meant, write 1.2")),
    "pre-stretch as strain": (
        "prestretch = 1.2",
        "prestretch = 0.25",
        ("at least 1", "strain of 0.25", "write 1.25"),
    ),
    "force in mN": ("force_N = 0.9", "force_N = 900", ("limits, force_N = 900", "If 900 mN is meant, write 0.9.")),
    "travel in um": ("displacement_mm = 14.0", "displacement_mm = 14000", ("14000 um is meant, write 14",)),
    "voltage in kV": ("voltage_V = 1800.0", "voltage_V = 1.8", ("voltage_V = 1.8", "1.8 kV is meant, write 1800")),
    "field in V/m": ("field_V_per_um = 80.0", "field_V_per_um = 80e6", ("80000000 V/m is meant, write 80",)),
    "field in V/mm": ("field_V_per_um = 80.0", "field_V_per_um = 80e3", ("80000 V/mm is meant, write 80",)),
    "current in pA": ("current_uA = 50.0", "current_uA = 50000000", ("50000000 pA is meant, write 50",)),
    "ramp in mV": ("ramp_V_per_s = 300.0", "ramp_V_per_s = 300000", ("300000 mV/s is meant, write 300",)),
    "approach without point": ("approach_from_mm = 36.0", "approach_from_mm = 360", ("is missing, write 36 or 3.6",)),
    "current in A": ("current_uA = 50.0", "current_uA = 5e-5", ("current_uA", "A is meant, write 50")),
    "approach in um": ("approach_from_mm = 36.0", "approach_from_mm = 36000", ("36000 um is meant, write 36",)),
    "a key of another unit": (
        "thickness_um",
        "thickness_mm",
        ("thickness_mm: unknown key", "mean thickness_um"),
    ),
    "a key of elsewhere": ("[stage]", "[stage]\nrate_Hz = 10", ("stage, rate_Hz: unknown key", "poll_rate_Hz")),
    "a number in quotes": ("prestretch = 1.2", 'prestretch = "1,2"', ('"1,2"', "without quotes", "1.2")),
    "a unit in the value": ("force_N = 0.9", "force_N = 0.9 N", ("line", "force_N = 0.9 N", "the key has it")),
    "a comma": ("force_N = 0.9", "force_N = 0,9", ("force_N = 0,9", "a point, not a comma")),
    "typographic quotes": ('name = "cone-4mm"', "name = “cone-4mm”", ("straight quotes",)),
    "no quotes": ('driver = "zaber"', "driver = zaber", ("driver = zaber", "needs quotes")),
    "a backslash": ('driver = "zaber"', 'driver = "zaber"\nport = "C:\\COM3"', ("C:\\COM3", "two backslashes")),
    "a long dash": ("gain_error = -3e-4", "gain_error = −3e-4", ("minus of the keyboard",)),
    "Python's true": ("gain_error = -3e-4", "gain_error = True", ("true or false",)),
    "a colon": ("prestretch = 1.2", "prestretch: 1.2", ("key = value",)),
    "no digit before the point": ("prestretch = 1.2", "prestretch = .5", ("both sides of the point",)),
    "a key twice": ("prestretch = 1.2", "prestretch = 1.2\nprestretch = 1.3", ("prestretch = 1.3", "given twice")),
    "an open bracket": ("mu_Pa = [33e3, 32e3]", "mu_Pa = [33e3, 32e3", ("mu_Pa = [33e3, 32e3", "list", "not closed")),
    "an open table": ("[limits]", "[limits", ("[limits", "bracket")),
    "unequal lists": ("alpha = [2.0, 5.0]", "alpha = [2.0]", ("mu_Pa has 2", "alpha has 1")),
    "no list": ("alpha = [2.0, 5.0]", "alpha = 2.0", ("alpha = 2.0", "square brackets", "[2.0]")),
    "an unknown instrument": (
        '"keyence-lkg"',
        '"keyence"',
        ("displacement", "driver = ", '"keyence"', '"keyence-lkg"'),
    ),
    "a list for a name": ('driver = "gsv8"', 'driver = ["gsv8"]', ("force", "driver")),
    "an unknown material": (
        SCENE[SCENE.index("[specimen.material]") : SCENE.index("[limits]")],
        'material = "parker"\n',
        ("material", "parker-cao2018"),
    ),
    "no certificate there": ("cal/hv.toml", "cal/hv9.toml", ("hv.certificate", "cal/hv9.toml", "no such certificate")),
    "certificate of another role": ("cal/hv.toml", "cal/force.toml", ("hv", "for the role 'force'")),
    "a scene as certificate": ("cal/hv.toml", "s.toml", ("hv.certificate", "this is a scene file")),
    "colours in a title": ("title = ", 'title = "\\u001b[31mred" # ', ("title", "control character U+001B")),
    "a title for the rich": ("title = ", 'title = "[/red] x" # ', ()),
}


@pytest.mark.parametrize("slip_of_hand", SCENES)
def test_a_slip_in_a_scene(bench: Path, slip_of_hand: str) -> None:
    old, new, words = SCENES[slip_of_hand]
    (bench / "mine.toml").write_text(replaced(SCENE, old, new))
    before = sorted(bench.iterdir())
    done = say("run", "mine.toml", "p.toml", "-o", "mine.mcap") if words else say("check", "mine.toml", "p.toml")
    told(done, 2, *words) if words else told_plan(done)
    assert sorted(bench.iterdir()) == before


def told_plan(done: Result) -> None:
    assert done.exit_code == 0 and "0 and 800 V on cone-4mm" in done.output


PROTOCOLS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "one bracket": ('[[step]]\ndo = "home"', '[step]\ndo = "home"', ("[step]", "two brackets: [[step]]")),
    "kV": ("[0, 800]", "[0, 0.8]", ("step 4, voltages_V 2 = 0.8", "0.8 kV is meant, write 800")),
    "N": ("threshold_mN = 8.0", "threshold_mN = 0.008", ("threshold_mN = 0.008", "0.008 N is meant, write 8")),
    "m": ("displacement_mm = 6.0", "displacement_mm = 0.006", ("0.006 m is meant, write 6",)),
    "ms": ("duration_s = 0.5", "duration_s = 500000", ("duration_s = 500000", "500000 ms is meant, write 500")),
    "sweeps": ('"sweep"', '"sweeps"', ("step 4", '"sweeps"', 'did you mean "sweep"?')),
    "cycles": ("settle_s = 0.2", "cycle = 3", ("cycle: unknown key; did you mean cycles?", "settle_s")),
    "minus": ("[0, 800]", "[-800]", ("voltages_V 1 = -800", "at least 0")),
    "no do": ('do = "sweep"\n', "", ("step 4, do", "missing", "sweep")),
    "scalar": ("[0, 800]", "800", ("voltages_V = 800", "square brackets", "[800]")),
}


@pytest.mark.parametrize("slip_of_hand", PROTOCOLS)
def test_a_slip_in_a_protocol(bench: Path, slip_of_hand: str) -> None:
    old, new, words = PROTOCOLS[slip_of_hand]
    (bench / "mine.toml").write_text(replaced(PROTOCOL, old, new))
    done = say("check", "s.toml", "mine.toml")
    told(done, 2, "mine.toml", *words)


UNCARRIED: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "no home": ('[[step]]\ndo = "home"\n', "", ("mine.toml on s.toml: Step 2 (approach) needs a home",)),
    "no approach": (
        PROTOCOL[PROTOCOL.index('[[step]]\ndo = "approach"') : PROTOCOL.index('[[step]]\ndo = "sweep"')],
        "",
        ("mine.toml on s.toml: Step 3 (sweep) needs the contact position: put an approach step before it.",),
    ),
    "too far": ("displacement_mm = 6.0", "displacement_mm = 60.0", ("displacement 60 mm", "at most 14 mm")),
    "too high": ("[0, 800]", "[0, 8000]", ("mine.toml on s.toml: Step 4", "8000 V", "0 to 1800 V")),
}


@pytest.mark.parametrize("slip_of_hand", UNCARRIED)
def test_a_plan_that_cannot_be_carried_out(bench: Path, slip_of_hand: str) -> None:
    old, new, words = UNCARRIED[slip_of_hand]
    (bench / "mine.toml").write_text(replaced(PROTOCOL, old, new))
    before = sorted(bench.iterdir())
    told(say("run", "s.toml", "mine.toml", "-o", "x.mcap"), 3, *words)
    assert sorted(bench.iterdir()) == before


LOG = next(FIXTURES.glob("logs/*/log.mcap"))
COMMANDS: dict[str, tuple[int, str]] = {
    "runs . --since 2026-03 --until 2025-01": (2, "2026-03 comes after --until 2025-01"),
    "chekc s.toml p.toml": (2, "no command 'chekc'. Did you mean 'check'?"),
    "check s.toml": (2, "Missing argument 'PROTOCOL'"),
    "check cal p.toml": (2, "File 'cal' is a directory"),
    "check p.toml s.toml": (2, "wrong order"),
    "run s.toml p.toml": (2, "Missing option '-o'"),
    "run s.toml p.toml -o cal": (2, "File 'cal' is a directory"),
    "run s.toml p.toml -o none/x.mcap": (2, "none/x.mcap: its folder none does not exist"),
    "run s.toml p.toml -o s.toml": (2, "s.toml: exists already; nothing is overwritten"),
    "run s.toml p.toml --output x.mcap": (2, "Did you mean '--out'?"),
    "run s.toml p.toml -o x.mcap --ports s.toml": (2, "not a JSON file of ports"),
    "fit p.toml": (2, "p.toml: not a log of this program"),
    "fit none.mcap": (2, "none.mcap: there is no such file"),
    "plan s.toml --time 10": (2, "with its unit: 10min, 300s or 1.5h"),
    "plan s.toml --time 1,5h": (2, "with its unit: 10min, 300s or 1.5h"),
    "verify force s.toml --standard 20g -o y.mcap": (
        2,
        "'20g': a number is needed here. The option's name says the unit: 20",
    ),
    "verify force s.toml --standard 1,5 -o y.mcap": (2, "Decimals take a point, not a comma: 1.5."),
    "verify force s.toml --standard nan -o y.mcap": (2, "a finite number is needed here"),
    "verify force s.toml --standard 0 -o y.mcap": (2, "not in the range x>0"),
    "verify force s.toml --standard 2000 -o y.mcap": (3, "2000 g pull with 19.6 N, and limits.force_N is less"),
    "calibrate force s.toml": (2, "Missing option '-o'"),
    "watch none.mcap": (2, "none.mcap: there is no such file"),
    "watch --terminal none.mcap": (2, "none.mcap: there is no such file"),
    "note none.mcap scratch": (2, "none.mcap: there is no such file"),
    "note s.toml scratch": (2, "s.toml: is not a log"),
    "runs none": (2, "none: there is no such folder"),
    "info none.mcap": (2, "none.mcap: there is no such file"),
    "view none.mcap": (2, "none.mcap: there is no such file"),
    "replay s.toml": (2, "s.toml: is not a log"),
    "resume none.mcap -o r.mcap": (2, "none.mcap: there is no such file"),
    "recover s.toml -o r.mcap": (2, "s.toml: is not a log"),
    f"recover {LOG} -o s.toml": (2, "s.toml: exists already"),
    f"export {LOG} -o x.xlsx": (2, "Allowed: .csv and .parquet"),
    f"stroke {LOG}": (1, "holds no follow step"),
    "fit-tests none.csv": (2, "none.csv: there is no such file"),
    "solve s.toml": (2, "not a JSON file of cases"),
    "keys sweeep": (2, "Did you mean sweep?"),
    "sim p.toml": (2, "this is a protocol file, not a scene file"),
    "design none.toml": (2, "none.toml: there is no such study file"),
    "stop": (2, "No run of yours is going on. Nothing was done."),
    "pause none.mcap": (2, "No run of yours is going on that writes none.mcap"),
    "init s.toml": (2, "Directory 's.toml' is a file"),
}


@pytest.mark.parametrize("line", COMMANDS)
def test_a_slip_in_a_command(
    bench: Path, line: str, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    code, words = COMMANDS[line]
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("live")))
    before = sorted(bench.rglob("*"))
    told(say(*line.split()), code, words)
    assert sorted(bench.rglob("*")) == before


def test_a_step_lists_its_own_keys_only(bench: Path) -> None:
    (bench / "mine.toml").write_text('[[step]]\ndo = "weigh"\nweights_g = [0, 50]\ncycle = 3\n')
    done = say("check", "s.toml", "mine.toml")
    told(done, 2, "did you mean cycles?", "weights_g")
    for other in ("voltages_V", "threshold_mN", "displacement_mm", "rate_Hz"):
        assert other not in done.output


ALLOWED = [
    ("force_N = 0.9", "force_N = 900", "limits.force_N"),
    ("thickness_um = 40.0", "thickness_um = 6000.0", "specimen.thickness_um"),
    ("[33e3, 32e3]", "[33e3, -2e3]", "specimen.material.mu_Pa"),
]


@pytest.mark.parametrize(("old", "new", "name"), ALLOWED)
def test_what_is_meant_can_be_accepted_by_name(bench: Path, old: str, new: str, name: str) -> None:
    scene = replaced(SCENE, old, new)
    (bench / "mine.toml").write_text(scene)
    assert f'accept = ["{name}"]' in say("check", "mine.toml", "p.toml").output
    (bench / "mine.toml").write_text(replaced(scene, "title = ", f'accept = ["{name}"]\ntitle = '))
    assert "hardly meant" not in say("check", "mine.toml", "p.toml").output
    (bench / "mine.toml").write_text(replaced(scene, "title = ", 'accept = ["limits.voltage_V"]\ntitle = '))
    told(say("check", "mine.toml", "p.toml"), 2, f'accept = ["limits.voltage_V", "{name}"]')


def test_files_in_the_wrong_place(bench: Path) -> None:
    told(say("check", "p.toml", "s.toml"), 2, "p.toml: this is a protocol file, not a scene file", "wrong order")
    told(say("check", "s.toml", "s.toml"), 2, "s.toml: this is a scene file, not a protocol file")
    told(say("check", "cal/force.toml", "p.toml"), 2, "this is a certificate file, not a scene file")
    told(say("design", "s.toml"), 2, "s.toml: this is a scene file, not a study file")
    told(say("check", str(next(FIXTURES.glob("logs/*/log.mcap"))), "p.toml"), 2, "a log (MCAP), not a scene file")
    told(say("fit", "s.toml"), 2, "s.toml", "not a log")
    told(say("check", "none.toml", "p.toml"), 2, "none.toml: there is no such scene file")


CONTENTS: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "empty"),
    "remarks only": (b"# nothing\n", "empty"),
    "zip": (b"PK\x03\x04" + bytes(100), "a ZIP archive or a spreadsheet"),
    "utf-16": ("[specimen]\n".encode("utf-16"), "UTF-16"),
    "latin-1": ("# Größe\n[specimen]\n".encode("latin-1"), "Latin-1"),
    "zero byte": (b"a = 1\n\0", "zero byte"),
    "json": (b'{"specimen": 1}', "not valid TOML in line 1"),
    "large": (b"#" * 300_000, "larger than 256 kB"),
    "deep key": (b"a" + b".a" * 10_000 + b" = 1", "more than 12 parts"),
    "deep list": (b"a = " + b"[" * 10_000, "more than 24 deep"),
    "long number": (b"a = " + b"9" * 5000, "5000 digits"),
}


@pytest.mark.parametrize("content", CONTENTS)
def test_contents_that_are_no_scene(bench: Path, content: str) -> None:
    data, words = CONTENTS[content]
    (bench / "mine.toml").write_bytes(data)
    told(say("check", "mine.toml", "p.toml"), 2, "mine.toml", words)


def test_ways_to_write_a_file_that_are_good(bench: Path) -> None:
    for data in (SCENE.replace("\n", "\r\n").encode(), b"\xef\xbb\xbf" + SCENE.encode()):
        (bench / "mine.toml").write_bytes(data)
        told_plan(say("check", "mine.toml", "p.toml"))


@pytest.mark.parametrize(
    ("key", "value", "usual", "words"),
    [
        ("thickness_um", 0.5, (1, 5000), "0.5 mm is meant, write 500"),
        ("voltages_V", 3, (5, 30000), "3 kV is meant, write 3000"),
        ("field_V_per_um", 5e7, (0.1, 1000), "50000000 V/m is meant, write 50"),
        ("threshold_mN", 0.01, (0.1, 1000), "0.01 N is meant, write 10"),
        ("duration_s", 3e6, (0.01, 1e5), "3000000 ms is meant, write 3000"),
        ("prestretch", 300, (1, 6), "300 % is meant, write 4"),
        ("cycles", 1e9, (1, 10), ""),
        ("force_N", -1e9, (0.1, 10), ""),
    ],
)
def test_the_slip_that_is_named(key: str, value: float, usual: tuple[float, float], words: str) -> None:
    found = slip(key, value, usual)
    assert words in found and bool(found) == bool(words)


def test_defaults_are_usual() -> None:
    """No key's own default is refused, and no range is upside down."""
    for _, table in ((name, one) for file in FILES.values() for _, top in file.tables for name, one in tables_in(top)):
        for key in keys_of(table):
            usual = usual_of(table.model_fields[key.name])
            if usual is None:
                continue
            assert usual[0] < usual[1], key
            value = table.model_fields[key.name].default
            if isinstance(value, int | float):
                assert value == 0 or usual[0] <= value <= usual[1], (table, key)


@pytest.mark.skipif(CASES is None, reason="the list of slips tried elsewhere is not on this machine")
def test_every_slip_of_the_list_that_is_a_replacement(bench: Path) -> None:
    """Rows with R('old','new'): one screen, code 2 or 3, nothing of the program's inside."""
    found = re.findall(
        r"^\| \d+ \| [^|]* \| `dea-rig check (\S+) (\S+)` \| `R\('(.*)','(.*)'` \|", CASES.read_text(), re.M
    )
    assert len(found) > 25
    for scene, protocol, old, new in found:
        target, text = (scene, SCENE) if scene != "s.toml" else (protocol, PROTOCOL)
        old, new = (one.encode().decode("unicode_escape") if "\\" in one else one for one in (old, new))
        Path(target).write_text(replaced(text, old, new))
        told(say("check", scene, protocol), 2, target)


STUDY = (FIXTURES / "studies" / "best-spring.toml").read_text()


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("[0.5, 0.1]", "radius_ratio = [0.5, 0.1]: the lowest value stands first and the highest second: [0.1, 0.5]"),
        ("[0.1, 5]", "radius_ratio reaches 5: the disk is smaller than the ring, below 1"),
    ],
)
def test_a_slip_in_the_bounds_of_a_study_makes_no_folder(bench: Path, new: str, words: str) -> None:
    (bench / "st.toml").write_text(replaced(STUDY, "[0.1, 0.5]", new))
    told(say("design", "st.toml", "--out", "d"), 2, "st.toml", words)
    assert not (bench / "d").exists()
