"""`dea-rig devices` on served benches: what it proposes is a scene that runs, and a swapped pair is refused."""

from __future__ import annotations

import json
import os
import re
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.base.clock import RealClock
from rig.base.toml_file import validate
from rig.bench.devices import make_supply
from rig.cli.app import main
from rig.run.backend import open_bench, simulated_bench
from rig.scene.scene import Scene, load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.server import Server

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

FIXTURES = Path(str(files("sim_fixtures")))
SCENES = FIXTURES / "scenes"


class Served:
    """A scene's simulated bench behind pseudo-terminals, in a thread."""

    def __init__(self, scene: Scene) -> None:
        self.bench: SimulatedBench = simulated_bench(scene)
        self.server = Server(self.bench, RealClock())
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.run, args=(self._stop.is_set,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.server.close()


@pytest.fixture
def serve() -> Iterator[Callable[[Scene], Served]]:
    served: list[Served] = []

    def start(scene: Scene) -> Served:
        served.append(Served(scene))
        return served[-1]

    yield start
    for one in served:
        one.close()


def devices(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["devices", *arguments], env={"COLUMNS": "200"})
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def asked(served: Served) -> list[str]:
    """The arguments that name everything that is served."""
    out: list[str] = []
    for keys in served.server.ports.values():
        out += ["--port", keys["port"]] if "port" in keys else ["--bus", f"slcan:{keys['can_channel']}@125000"]
    return out


HIGH_VOLTAGE = ("voltage", "current", "field", "energy")  # with these begin the limits that need a supply
WHO = {
    "cone-4mm": {
        "stage": ("zaber", "50443", "7.14"),
        "force": ("gsv8", "14209876", "1.44"),
        "displacement": ("keyence-lkg", None, None),
        "hv": ("iseg-edcp", "484216", None),
    },
    "other-instruments": {
        "stage": ("zaber", "50443", "7.14"),
        "force": ("cia404", "77120", "1.4"),
        "displacement": ("keyence-lkg", None, None),
        "hv": ("shvps", None, "8"),
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WHO)
def test_the_lines_proposed_are_a_scene_on_which_every_instrument_answers(
    serve: Callable[[Scene], Served], name: str, tmp_path: Path
) -> None:
    scene, text = load_scene(SCENES / f"{name}.toml")
    served = serve(scene)
    code, output = devices(*asked(served))
    assert code == 0, output
    proposed = tomllib.loads(output.partition("For the scene:")[2])
    assert set(proposed) == set(WHO[name])
    for role, (driver, serial, firmware) in WHO[name].items():
        assert proposed[role]["driver"] == driver
        assert proposed[role].get("serial") == serial
        assert firmware is None or re.search(rf"\b{re.escape(firmware)}\b", output)
    # Those lines, and what only the user knows of his specimen: a scene without [simulation], on these ports.
    known = tomllib.loads(text)
    whole = validate({"specimen": known["specimen"], "limits": known["limits"], **proposed}, Scene, "scene", "proposed")
    assert whole.hv is not None
    # The supply by its driver alone: on real ports its guard would be a process of its own.
    limits = {key: value for key, value in known["limits"].items() if key.split("_")[0] not in HIGH_VOLTAGE}
    rest = {"specimen": known["specimen"], "limits": limits, **{r: t for r, t in proposed.items() if r != "hv"}}
    with (
        closing(open_bench(validate(rest, Scene, "scene", "proposed"))) as bench,
        closing(whole.hv.open("hv")) as link,
    ):
        bench.attach(lambda *told: None)
        found = dict(bench.devices) | {"hv": make_supply(whole.hv, link, lambda *told: None, bench.clock.now)}
        end = bench.clock.now() + 20.0
        while not all(device.ready for device in found.values()) and bench.clock.now() < end:
            for device in found.values():
                device.poll(bench.clock.now())
            bench.clock.sleep_until(bench.clock.now() + 2e-3)
        for role, device in found.items():
            assert device.ready, role
            assert device.identity.serial == (WHO[name][role][1] or "")
            # What was listed is what the driver reads, word for word.
            for word in (device.identity.model, device.identity.firmware):
                assert word in output


@pytest.mark.slow
def test_an_adapter_asked_as_a_serial_port_says_how_to_ask_on_its_bus(serve: Callable[[Scene], Served]) -> None:
    scene, _ = load_scene(SCENES / "other-instruments.toml")
    port = serve(scene).server.ports["force"]["can_channel"]
    code, output = devices("--port", port)
    assert code == 1
    assert f"--bus slcan:{port}@" in output.replace("\n", "").replace(" ", "").replace("--bus", "--bus ")


@pytest.mark.slow
def test_a_bus_at_another_bit_rate_is_silent_and_at_its_own_is_not(serve: Callable[[Scene], Served]) -> None:
    scene, _ = load_scene(SCENES / "other-instruments.toml")
    assert scene.simulation is not None
    force = scene.simulation.force.model_copy(update={"bitrate": 250_000})
    scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"force": force})})
    port = serve(scene).server.ports["force"]["can_channel"]
    code, output = devices("--bus", f"slcan:{port}@250000")
    assert code == 0 and "bitrate = 250000" in output


@pytest.mark.parametrize(
    ("bus", "words"),
    [
        ("slcan", "names no channel"),
        ("usb:0", "no CAN interface"),
        ("slcan:/dev/x@y", "no bit rate"),
    ],
)
def test_a_bus_that_cannot_be_is_told_without_a_traceback(bus: str, words: str) -> None:
    code, output = devices("--bus", bus)
    assert code == 2 and words in output


@pytest.mark.parametrize(
    "bus", ["socketcan:can-none", "slcan:/dev/none", "pcan:PCAN_USBBUS1", "vector:0", "udp_multicast:0"]
)
def test_a_bus_that_cannot_be_opened_is_told_without_a_traceback(bus: str) -> None:
    code, output = devices("--bus", bus)
    assert code == 1 and "cannot be" in output and "Traceback" not in output


# Two rigs beside each other on one computer: their stages look alike, and the ports may come up in either order.


def rig_with_stage(serial: int) -> Scene:
    scene, _ = load_scene(SCENES / "no-hv.toml")
    assert scene.simulation is not None
    stage = scene.simulation.stage.model_copy(update={"serial_number": serial})
    return scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"stage": stage})})


@pytest.mark.slow
def test_a_swapped_pair_of_stages_is_refused_before_either_moves(
    serve: Callable[[Scene], Served], tmp_path: Path
) -> None:
    left, right = serve(rig_with_stage(111)), serve(rig_with_stage(222))
    scene = tmp_path / "scene.toml"
    text = (SCENES / "no-hv.toml").read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
    scene.write_text(text.replace('driver = "zaber"', 'driver = "zaber"\ntimeout_s = 5.0\nserial = "111"'))

    protocol = tmp_path / "protocol.toml"
    protocol.write_text('[[step]]\ndo = "home"\n')

    def run(ports: dict[str, dict[str, str]], log: str) -> tuple[int, str]:
        listed = tmp_path / "ports.json"
        listed.write_text(json.dumps(ports))
        names = [str(scene), str(protocol), "-o", str(tmp_path / log), "--ports", str(listed)]
        done = CliRunner().invoke(main, ["run", *names])
        return done.exit_code, done.output

    begin = left.bench.world.stage.at(0.0), right.bench.world.stage.at(0.0)
    code, output = run(dict(left.server.ports) | {"stage": right.server.ports["stage"]}, "swapped.mcap")
    assert code == 2, output
    words = " ".join(output.split())
    assert "serial number 111" in words and "but 222 answered" in words and "swapped" in words
    now = [served.bench.world.stage.at(served.bench.now) for served in (left, right)]
    assert tuple(now) == begin
    code, output = run(dict(left.server.ports), "right.mcap")
    assert code == 0, output
    now = [served.bench.world.stage.at(served.bench.now) for served in (left, right)]
    assert now[0] == pytest.approx((0.0, 0.0), abs=1e-9) and now[1] == begin[1]
