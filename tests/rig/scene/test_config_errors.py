"""Bad files give one message that names file, key, value and what is allowed, exit code 2 and no traceback."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.base.errors import ConfigError
from rig.base.text_file import MAX_BYTES
from rig.cli.app import main
from rig.protocol.protocol import load_protocol
from rig.scene.scene import Scene, load_scene

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = FIXTURES / "scenes" / "cone-4mm.toml"
PROTOCOL = FIXTURES / "protocols" / "paper.toml"


def edited(tmp_path: Path, source: Path, old: str, new: str) -> Path:
    text = source.read_text()
    assert old in text
    path = tmp_path / source.name
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("thickness_um = 40.0", "thickness_mm = 0.04", ["specimen, thickness_mm", "did you mean thickness_um"]),
        ("force_N = 0.9", "force_N = nan", ["limits, force_N = nan", "finite"]),
        ("force_N = 0.9", "force_N = inf", ["limits, force_N = inf", "finite"]),
        ("force_N = 0.9", "force_N = -1.0", ["limits, force_N = -1.0", "greater than 0"]),
        ("force_N = 0.9", 'force_N = "0.9"', ['limits, force_N = "0.9"', "number"]),
        ("force_N = 0.9", "force_N = true", ["limits, force_N = true", "number"]),
        ("force_N = 0.9\n", "", ["limits, force_N", "missing"]),
        ('driver = "zaber"', 'driver = "zabre"', ['stage, driver = "zabre"', 'did you mean "zaber"']),
        ('driver = "zaber"', 'driver = "zaber"\nspeed = 1.0', ["stage, speed: unknown key", "approach_from_mm"]),
        ("disk_radius_mm = 4.0", "disk_radius_mm = 24.0", ["disk_radius_mm must be smaller"]),
        ("voltage_V = 1800.0\n", "", ["must give limits.voltage_V"]),
        ("alpha = [2.0, 5.0]", "alpha = [2.0]", ["they must pair up"]),
        ('name = "cone-4mm"', 'name = "../../etc"', ["specimen, name", "not allowed", "letters, digits"]),
        ("[specimen]", "[specimen", ["not valid TOML", "line"]),
    ],
)
def test_a_bad_scene_names_file_key_value_and_what_is_allowed(
    tmp_path: Path, old: str, new: str, expected: list[str]
) -> None:
    path = edited(tmp_path, SCENE, old, new)
    with pytest.raises(ConfigError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert str(path) in message
    for words in expected:
        assert words in message, message
    assert len(message.splitlines()) < 20


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('driver = "iseg-edcp"', 'driver = "shvps"', ["limits.current_uA is given", "shvps", "leave the limit out"]),
        ("current_uA = 50.0\n", "", ["must give limits.voltage_V and limits.current_uA"]),
        ('driver = "gsv8"', 'driver = "hx711"', ["force", "hx711", "gsv8", "cia404"]),
        ('driver = "gsv8"', 'driver = "cia404"\nfactor = 9.81', ["force", "factor is given without unit"]),
        ('driver = "gsv8"', 'driver = "cia404"\nbaud = 9600', ["force, baud: unknown key", "bitrate", "node"]),
        ('driver = "gsv8"', 'driver = "cia404"\ninterface = "slcan"', ["interface and can_channel belong together"]),
        ("[simulation.force]", '[simulation.force]\ndriver = "cia404"', ["leave simulation.force.driver out"]),
        ('driver = "gsv8"', 'driver = "cia404"\ninput_range = 2', ["force, input_range: unknown key"]),
        (
            "[simulation.force]",
            "[simulation.force]\nnode = 5",
            ["simulation, force, node: unknown key", "sensitivity_mV_per_V"],
        ),
    ],
)
def test_a_bad_choice_of_instruments(tmp_path: Path, old: str, new: str, expected: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scene(edited(tmp_path, SCENE, old, new))
    for words in expected:
        assert words in str(caught.value), str(caught.value)


def test_two_instruments_on_one_bus_are_refused(tmp_path: Path) -> None:
    text = SCENE.read_text()
    for old, new in {
        'driver = "zaber"': 'driver = "zaber"\nport = "/dev/a"',
        'driver = "keyence-lkg"': 'driver = "keyence-lkg"\nport = "/dev/b"',
        'driver = "gsv8"': 'driver = "cia404"\ninterface = "slcan"\ncan_channel = "/dev/c"',
        'driver = "iseg-edcp"': 'driver = "iseg-edcp"\ninterface = "slcan"\ncan_channel = "/dev/c"',
    }.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="force and hv both name the CAN channel '/dev/c'"):
        load_scene(path)
    path.write_text(text.replace("/dev/c", "/dev/d", 1))
    assert load_scene(path)[0].on_real_ports


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('do = "home"', 'do = "hoem"', ["step 1", '"hoem"', 'did you mean "home"']),
        ("cycles = 2", "cycles = 0", ["step 4, cycles = 0", "at least 1"]),
        ("speed_mm_per_s = 1.0", "speed_m_per_s = 1.0", ["step 5, speed_m_per_s", "did you mean speed_mm_per_s"]),
        ("[0, 1000, 1500]", "[0, nan, 1500]", ["step 5, voltages_V 2 = nan", "finite"]),
        ("[0, 1000, 1500]", "[]", ["step 5, voltages_V = []", "at least 1"]),
    ],
)
def test_a_bad_protocol_counts_its_steps_from_one(tmp_path: Path, old: str, new: str, expected: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_protocol(edited(tmp_path, PROTOCOL, old, new))
    for words in expected:
        assert words in str(caught.value), str(caught.value)


def test_files_that_are_no_files(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    huge = tmp_path / "huge.toml"
    huge.write_bytes(b"#" * (MAX_BYTES + 1))
    nested = tmp_path / "nested.toml"
    nested.write_text("a = " + "[" * 100_000)
    long_number = tmp_path / "number.toml"
    long_number.write_text("a = " + "1" * 10_000)
    for path, words in [
        (tmp_path / "missing.toml", "no such scene file"),
        (tmp_path, "directory"),
        (binary, "not UTF-8"),
        (huge, "larger than"),
        (nested, "brackets more than 24 deep"),
        (long_number, "a number of 10000 digits"),
    ]:
        with pytest.raises(ConfigError, match=words):
            load_scene(path)


def test_ports_are_named_for_all_instruments_or_for_none(tmp_path: Path) -> None:
    path = edited(tmp_path, SCENE, 'driver = "zaber"', 'driver = "zaber"\nport = "/dev/ttyUSB0"')
    with pytest.raises(ConfigError, match="name all or none"):
        load_scene(path)


def test_the_ports_of_a_served_bench_turn_the_scene_to_real_ports() -> None:
    scene, _ = load_scene(SCENE)
    assert not scene.on_real_ports
    ports: dict[str, dict[str, object]] = {
        role: {"port": f"/dev/{role}"} for role in ("stage", "force", "displacement")
    }
    ports["hv"] = {"interface": "slcan", "can_channel": "/dev/hv"}
    moved = scene.with_ports(ports)
    assert isinstance(moved, Scene) and moved.on_real_ports
    assert moved.stage.port == "/dev/stage"
    del ports["hv"]
    with pytest.raises(ConfigError, match="no 'hv'"):
        scene.with_ports(ports)


@pytest.mark.parametrize("command", [["check"], ["run", "-o", "LOG"]])
def test_the_command_line_ends_with_2_and_leaves_nothing(tmp_path: Path, command: list[str]) -> None:
    scene = edited(tmp_path, SCENE, "thickness_um = 40.0", "thickness_um = nan")
    before = sorted(tmp_path.iterdir())
    arguments = [command[0], str(scene), str(PROTOCOL), *command[1:]]
    arguments = [str(tmp_path / "x.mcap") if a == "LOG" else a for a in arguments]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "thickness_um = nan" in result.output
    assert "Traceback" not in result.output
    assert sorted(tmp_path.iterdir()) == before


def test_a_protocol_beyond_a_limit_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    protocol = edited(
        tmp_path,
        PROTOCOL,
        "displacement_mm = 11.0\nspeed_mm_per_s = 1.0",
        "displacement_mm = 13.0\nspeed_mm_per_s = 1.0",
    )
    out = tmp_path / "x.mcap"
    result = CliRunner().invoke(main, ["run", str(SCENE), str(protocol), "-o", str(out)])
    assert result.exit_code == 3
    assert "Step 5 (sweep" in result.output and "V/um is outside" in result.output
    assert not out.exists() and not out.with_name("x.mcap.part").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mu_Pa = [33e3, 32e3]", "mu_Pa = [-33e3, -32e3]", "mu"),
        ("alpha = [2.0, 5.0]", "alpha = [0.0, 5.0]", "alpha"),
    ],
)
def test_a_material_that_the_model_refuses(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_scene(edited(tmp_path, SCENE, old, new))


@pytest.mark.parametrize("command", ["fit", "info", "view", "export", "recover"])
def test_a_log_that_is_no_log(tmp_path: Path, command: str) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("not a log\n" * 50)
    output = {"fit": ["-o"], "view": ["--save"], "export": ["-o"], "recover": ["-o"]}.get(command, [])
    arguments = [command, str(text), *output, *([str(tmp_path / "out.csv")] if output else [])]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2, result.output
    assert "notes.txt" in result.output and "not a log" in result.output and "Traceback" not in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_outputs_are_never_written_over_anything(tmp_path: Path) -> None:
    log = tmp_path / "precious.mcap"
    log.write_bytes(b"precious")
    for arguments in (
        ["fit", str(log), "-o", str(log)],
        ["fit", str(log), "--report", str(log)],
        ["view", str(log), "--save", str(log)],
        ["view", str(log), "--screenshot", str(log)],
        ["run", str(SCENE), str(PROTOCOL), "-o", str(log)],
        ["fit", str(log), "-o", str(tmp_path / "nowhere" / "fit.json")],
        ["fit", str(log), "-o", str(tmp_path / "a"), "--report", str(tmp_path / "a")],
        ["run", str(SCENE), str(PROTOCOL), "-o", ""],
    ):
        result = CliRunner().invoke(main, arguments)
        assert result.exit_code == 2, arguments
        assert "Traceback" not in result.output
    assert log.read_bytes() == b"precious" and len(list(tmp_path.iterdir())) == 1


def test_a_port_that_does_not_exist(tmp_path: Path) -> None:
    text = SCENE.read_text()
    for role in ("zaber", "gsv8", "keyence-lkg"):
        text = text.replace(f'driver = "{role}"', f'driver = "{role}"\nport = "{tmp_path}/no-{role}"')
    text = text.replace(
        'driver = "iseg-edcp"', f'driver = "iseg-edcp"\ninterface = "slcan"\ncan_channel = "{tmp_path}/no-can"'
    )
    text = text.replace("../calibrations", str(FIXTURES / "calibrations"))
    scene = tmp_path / "scene.toml"
    scene.write_text(text)
    out = tmp_path / "x.mcap"
    result = CliRunner().invoke(main, ["run", str(scene), str(PROTOCOL), "-o", str(out), "--arm"])
    assert result.exit_code == 4, result.output
    assert "no-can" in result.output and "hv" in result.output  # the supply's guard opens its link first
    assert "Traceback" not in result.output
    assert not out.exists() and not out.with_name("x.mcap.part").exists()
