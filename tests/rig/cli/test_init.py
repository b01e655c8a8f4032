"""`dea-rig init`: what it writes is accepted by check, run on the simulated bench and fitted, no key edited by hand."""

from __future__ import annotations

import json
import os
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.cli.app import main
from rig.run.backend import simulated_bench
from rig.scene.presets import PRESETS
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

FIXTURES = Path(str(files("sim_fixtures")))


def say(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def made(folder: Path, preset: str, *more: str) -> Path:
    done = say("init", str(folder), "--preset", preset, "--yes", *more)
    assert done.exit_code == 0, done.output
    return folder


@pytest.mark.parametrize("preset", list(PRESETS))
def test_check_accepts_what_it_wrote(tmp_path: Path, preset: str) -> None:
    folder = made(tmp_path / "mine", preset)
    protocols = sorted((folder / "protocols").iterdir())
    assert [path.stem for path in protocols] == ["breakdown", "relaxation", "sweep"]
    for protocol in protocols:
        done = say("check", str(folder / "scene.toml"), str(protocol))
        assert done.exit_code == 0 and "All hold." in " ".join(done.output.split()), done.output
    scene, text = load_scene(folder / "scene.toml")
    assert scene.specimen.prestretch == PRESETS[preset].prestretch and not scene.on_real_ports
    assert tomllib.loads(text)["specimen"]["material"]["source"] == PRESETS[preset].source
    # Every key that stands there is explained in the line above it.
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if " = " in line and not line.startswith("#"):
            assert lines[number - 1].startswith("# "), line
    assert tomllib.loads(text)["session"] == {} and "# operator = ..." in lines  # to be filled in
    assert (folder / "schema" / "scene.json").is_file() and lines[0] == "#:schema schema/scene.json"
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.slow
def test_dimensions_are_those_asked_for(tmp_path: Path) -> None:
    options = ("--disk-radius-mm", "5", "--ring-radius-mm", "25", "--prestretch", "3", "--thickness-um", "500")
    scene, _ = load_scene(made(tmp_path / "mine", "vhb-4905", *options, "--name", "left-1") / "scene.toml")
    film = scene.specimen
    assert (film.disk_radius_mm, film.ring_radius_mm, film.thickness_um, film.prestretch) == (5, 25, 500, 3)
    assert film.name == "left-1" and film.specimen().material.law.name == "gent"
    assert scene.limits.field_V_per_um is not None
    assert scene.limits.field_V_per_um < PRESETS["vhb-4905"].breakdown_V_per_um


def test_a_bench_without_supply_and_laser(tmp_path: Path) -> None:
    folder = made(tmp_path / "mine", "elastosil-2030", "--no-hv", "--no-laser")
    scene, _ = load_scene(folder / "scene.toml")
    assert set(scene.instruments) == {"stage", "force"} and scene.limits.voltage_V is None
    assert [path.name for path in (folder / "certificates").iterdir()] == ["force.toml"]
    assert say("check", str(folder / "scene.toml"), str(folder / "protocols" / "sweep.toml")).exit_code == 0


def test_without_options_it_asks(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["init", str(tmp_path / "mine")], input="sylgard-184\n4\n20\n\n1.2\n")
    assert done.exit_code == 0, done.output
    film = load_scene(tmp_path / "mine" / "scene.toml")[0].specimen
    assert (film.disk_radius_mm, film.ring_radius_mm, film.thickness_um, film.prestretch) == (4, 20, 100, 1.2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--preset", "vhb4905"), "Did you mean vhb-4905?"),
        (("--disk-radius-mm", "30"), "--disk-radius-mm 30 and --ring-radius-mm 25"),
        (("--disk-radius-mm", "5000"), "--disk-radius-mm 5000: usual are 0.2 to 100. If 5000 um is meant, write 5."),
        (("--disk-radius-mm", "5mm"), "The option's name says the unit: 5."),
        (("--prestretch", "300"), "--prestretch 300: usual are 1 to 6. If 300 % is meant, write 4."),
        (("--prestretch", "1,2"), "Decimals take a point, not a comma: 1.2."),
        (("--prestretch", "nan"), "a finite number"),
        (("--name", "a/b"), "not allowed"),
        (("--thickness-um", "0.04"), "--thickness-um 0.04: usual are 1 to 5000. If 0.04 mm is meant, write 40."),
    ],
)
def test_what_cannot_be_leaves_nothing(tmp_path: Path, options: tuple[str, ...], words: str) -> None:
    done = say("init", str(tmp_path / "mine"), "--yes", *options)
    assert done.exit_code == 2 and words in " ".join(done.output.split()), done.output
    assert "Traceback" not in done.output and list(tmp_path.iterdir()) == []
    (tmp_path / "mine").mkdir()
    assert say("init", str(tmp_path / "mine"), "--yes").exit_code == 2


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_from_devices_it_writes_ports_and_serial_numbers(tmp_path: Path) -> None:
    simulated = load_scene(FIXTURES / "scenes" / "cone-4mm.toml")[0]
    with ServedBench(simulated_bench(simulated)) as served:
        port = {role: str(keys.get("port", keys.get("can_channel"))) for role, keys in served.ports.items()}
        where = ["--bus", f"slcan:{port['hv']}@125000"]
        for role in ("stage", "force", "displacement"):
            where += ["--port", port[role]]
        folder = made(tmp_path / "mine", "parker", "--from-devices", *where)
        scene, text = load_scene(folder / "scene.toml")
        assert scene.on_real_ports and "[simulation" not in text
        found = {role: (table.driver, table.serial) for role, table in scene.instruments.items()}
        assert found == {
            "stage": ("zaber", "50443"),
            "force": ("gsv8", "14209876"),
            "displacement": ("keyence-lkg", None),
            "hv": ("iseg-edcp", "484216"),
        }
        assert scene.stage.approach_from_mm == 0.0  # nobody knows yet where the film is
        done = say("read", str(folder / "scene.toml"))
        assert done.exit_code == 0 and "channel off  (iseg E08C 484216)" in done.output, done.output
        done = say("init", str(tmp_path / "other"), "--yes", "--from-devices", "--port", port["displacement"])
        assert done.exit_code == 2 and "No instrument answers as stage and force" in done.output
        assert served.driven == [] and not (tmp_path / "other").exists()


@pytest.mark.long  # one of VHB, as the first page has it: `test_readme_commands.py`
@pytest.mark.timeout(300)  # the film's table, the run and the fit of one law each, on a busy machine
@pytest.mark.parametrize(
    ("preset", "options"),
    [
        ("parker", ("--disk-radius-mm", "4", "--ring-radius-mm", "20")),
        ("elastosil-2030", ("--thickness-um", "100")),
    ],
)
def test_init_check_run_fit_report(tmp_path: Path, preset: str, options: tuple[str, ...]) -> None:
    """As a new user types it; the permittivity of the simulated film is found again."""
    folder = made(tmp_path / "mine", preset, *options)
    scene, sweep, log = (str(folder / name) for name in ("scene.toml", "protocols/sweep.toml", "run.mcap"))
    assert say("check", scene, sweep).exit_code == 0
    done = say("run", scene, sweep, "-o", log)
    assert done.exit_code == 0, done.output
    fit, report = folder / "fit.json", folder / "report.html"
    done = say("fit", log, "-o", str(fit), "--report", str(report))
    assert done.exit_code == 0, done.output
    assert "<html" in report.read_text(encoding="utf-8")
    found = json.loads(fit.read_text(encoding="utf-8"))["quantities"]["eps_r"]
    assert (
        abs(found["value"] - PRESETS[preset].eps_r) < 4 * found["standard_uncertainty"] + 0.02 * PRESETS[preset].eps_r
    )
