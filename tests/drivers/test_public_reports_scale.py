"""A wrong scale, and somebody else's stage on the axis: no wire says how long a step is, so nobody may guess it.

An X-LSM moved 0.96 mm for 10, a belt stage 45 mm, by the step of another one. Two peripherals that were swapped at an
X-MCC keep the controller's serial number. A laser whose display is in um, or in inches, shows quite another way than
the stage. Whoever turns readings into metres by a key has it: stages and displacement sensors; of forces the
certificate says it, of voltages the supply's own step proves it.
"""

from __future__ import annotations

import pytest

from drivers.instruments.zaber.device import ZaberStage
from drivers.links.link import DeviceRefused
from rig.base.errors import FaultError
from rig.engine.laser_scale import LaserScale

X_LSQ150B = 50_081


class Controller:
    """A Zaber device, answering byte for byte; a `drivers.links.link.ByteLink`."""

    name = "fake"

    def __init__(self, device_id: int, flags: str = "WR", **more: str) -> None:
        self.flags = flags
        self.values = {
            "deviceid": str(device_id),
            "system.serial": "70001",
            "version": "7.35",
            "resolution": "64",
            "limit.min": "0",
            "limit.max": "305381",
            "maxspeed": "153600",
            "accel": "205",
            **{key.replace("_", "."): value for key, value in more.items()},
        }
        self.asked: list[str] = []
        self.out = b""

    def write(self, data: bytes) -> None:
        for line in data.decode().splitlines():
            words = line.partition(":")[0].removeprefix("/").split(" ")
            device, axis, number, *command = words
            self.asked.append(" ".join(command))
            verdict, said = "OK", "0"
            if command[:1] == ["get"]:
                said = self.values.get(command[1], "")
                if command[1] == "pos":
                    said = "0"
                elif not said:
                    verdict, said = "RJ", "BADCOMMAND"
            elif command[:1] == ["warnings"]:
                flags = self.flags.split()
                said = " ".join([f"{len(flags):02d}", *flags])
            text = f"{int(device):02d} {axis} {number} {verdict} IDLE {self.flags.split()[0]} {said}"
            self.out += f"@{text}:{-sum(text.encode()) & 0xFF:02X}\r\n".encode()

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def reopen(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing to release."""

    @property
    def moved(self) -> bool:
        return any(words.startswith(("move", "home", "set")) for words in self.asked)


def set_up(controller: Controller, **keys: float) -> ZaberStage:
    stage = ZaberStage("stage", controller, **keys)  # type: ignore[arg-type]
    for k in range(100):
        stage.poll(0.01 * k)
    return stage


def test_a_stage_that_is_known_by_its_id_needs_no_key_and_is_asked_nothing_more() -> None:
    controller = Controller(X_LSQ150B)
    stage = set_up(controller)
    assert stage.ready and stage.travel[1] == pytest.approx(151.498e-3, rel=1e-4)
    assert not any("peripheral" in words for words in controller.asked)


@pytest.mark.parametrize("peripheral", ["", "43022"])
def test_any_other_stage_is_refused_until_the_scene_says_its_step(peripheral: str) -> None:
    """An X-LSM150A (3.048 um) by the step of an X-LSQ150B would go ten times too far."""
    more = {"peripheral_id": peripheral} if peripheral else {}
    controller = Controller(50_133, **more)
    with pytest.raises(DeviceRefused, match=r"how far device 50133.*does not say so itself.*full_step_um.*151\.5 mm"):
        set_up(controller)
    assert not controller.moved
    stage = set_up(Controller(50_133, **more), full_step_um=3.048)
    assert stage.ready and stage.travel[1] == pytest.approx(305381 * 3.048e-6 / 64)


def test_a_peripheral_on_a_known_controller_is_not_that_controllers_stage() -> None:
    controller = Controller(30_222, peripheral_id="43022", peripheral_serial="88123")
    stage = set_up(controller, full_step_um=3.048)
    assert stage.identity.serial == "88123" and stage.identity.model == "Zaber device 30222 peripheral 43022"
    assert (stage.settings["peripheral_id"], stage.settings["serial"]) == ("43022", "70001")


@pytest.mark.parametrize("key", ["peripheral_id", "peripheralid"])
def test_swapped_peripherals_are_refused(key: str) -> None:
    """Firmware 6 knows the id only, under its old name."""
    controller = Controller(30_222, **{key: "43022"})
    assert set_up(controller, full_step_um=3.048, peripheral_id=43_022).ready
    controller = Controller(30_222, **{key: "44053"})
    with pytest.raises(DeviceRefused, match=r"axis 1 has peripheral 44053, and peripheral_id = 43022 is w.*swapped"):
        set_up(controller, full_step_um=3.048, peripheral_id=43_022)
    assert not controller.moved


def test_an_axis_whose_stage_was_changed_says_what_to_do() -> None:
    controller = Controller(30_222, flags="FZ WR", peripheral_id="43022")
    with pytest.raises(DeviceRefused, match=r"FZ: peripheral inactive.*was activated last.*`activate`.*full_step_um"):
        set_up(controller, full_step_um=3.048)
    assert not controller.moved


# The laser, proven against the stage ----------------------------------------------------------------------------------


def seen(ratio: float, *, contact: float = 1.0, way: float = 10e-3, speed: float = 4e-3) -> None:
    """What a sensor shows that sees the pusher from position ``contact`` (m) on, 50 ms late and up to 20 ms old."""
    scale = LaserScale()
    for k in range(round(way / speed * 50)):
        t = 0.02 * k
        old = 0.07 if k % 7 else 0.03
        scale.sample(t, speed * t, ratio * max(speed * (t - old) - contact, 0.0) + 1e-3)


@pytest.mark.parametrize("speed", [0.5e-3, 4e-3, 50e-3])
@pytest.mark.parametrize("ratio", [1.0, -1.0, 0.97, 1.1])
def test_a_laser_that_goes_with_the_stage_is_right(ratio: float, speed: float) -> None:
    seen(ratio, contact=0.0, speed=speed, way=50 * speed if speed > 1e-2 else 10e-3)


@pytest.mark.parametrize("contact", [2e-3, 4.7e-3, 5.3e-3, 8e-3])
def test_a_laser_that_sees_the_disk_proves_nothing_before_contact_and_after(contact: float) -> None:
    """Wherever the film is met within the two millimetres that are compared."""
    seen(1.0, contact=contact)


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (1000.0, "display is in um"),
        (1 / 25.4, "display is in inches"),
        (0.1, "decimal point"),
        (10.0, "decimal point"),
        (127 / 31.75, "times as much. The unit or scale of one of the two is wrong. Correct"),
    ],
)
def test_a_laser_in_another_unit_is_refused_before_the_film_is_met(ratio: float, words: str) -> None:
    if ratio < 0.05:
        ratio = -ratio  # counting the other way is a matter of its own
    with pytest.raises(FaultError, match=words):
        seen(ratio, contact=0.0, way=6e-3)
