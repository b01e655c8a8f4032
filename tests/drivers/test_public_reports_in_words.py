"""What an instrument warns of reaches the operator in words, and so does a rate that a slow adapter cannot keep.

The reports: warnings WM, WS, WL of a stage and their like elsewhere; the 16 ms of FTDI adapters (jSerialComm#369).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.instruments.cia404.codec import emergency_in_words
from drivers.instruments.cia404.device import CiA404
from drivers.instruments.zaber.codec import checksum
from drivers.instruments.zaber.device import ZaberStage
from drivers.links.link import CanFrame
from drivers.registry import registered
from rig.base.clock import VirtualClock
from rig.bench.bench import Bench
from rig.bench.opening import Opened
from rig.scene.scene import Scene, load_scene

SCENES = Path(str(files("sim_fixtures"))) / "scenes"


class Stage:
    """A Zaber stage at its end of a line: answers every question; ``flags`` are its warnings."""

    name = "line"

    def __init__(self, flags: str = "") -> None:
        self.flags, self.out = flags, b""

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def write(self, data: bytes) -> None:
        device, axis, number, *words = data.decode()[1:].partition(":")[0].split()
        flags = self.flags.split()
        values = {
            "get deviceid": "50081",
            "get resolution": "64",
            "get limit.max": "305381",
            "get maxspeed": "1000",
            "get accel": "100",
        }
        value = f"{len(flags):02d} {self.flags}".strip() if words == ["warnings"] else values.get(" ".join(words), "0")
        text = f"{int(device):02d} {axis} {int(number):02d} OK IDLE {flags[0] if flags else '--'} {value}".encode()
        self.out += b"@" + text + b":%02X\r\n" % checksum(text)

    def reopen(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""


def polled(device: ZaberStage, begin: float, seconds: float) -> list[str]:
    told: list[str] = []
    for k in range(round(seconds * 1000)):
        device.poll(begin + k * 1e-3)
        told += device.remarks()
    return told


def test_a_stage_that_warns_is_told_of_in_words_and_once() -> None:
    line = Stage()
    stage = ZaberStage("stage", line)
    assert polled(stage, 0.0, 0.5) == []
    line.flags = "WM WL"
    (told,) = polled(stage, 0.5, 0.5)
    assert "WM: " in told and "WL: " in told and "unknown" not in told and len(told) > 50
    assert polled(stage, 1.0, 0.5) == []
    line.flags = ""
    polled(stage, 1.5, 0.5)
    line.flags = "WS"
    assert len(polled(stage, 2.0, 0.5)) == 1


@pytest.mark.parametrize("code", [0x1000, 0x2310, 0x3100, 0x4210, 0x8110, 0x8250, 0xFF07, 0xF001])
def test_an_emergency_of_a_node_is_told_of_in_words(code: int) -> None:
    class Bus:
        name = "bus"

        def __init__(self) -> None:
            self.out = [
                CanFrame(0x301, b""),
                CanFrame(0x085, code.to_bytes(2, "little") + bytes(6)),
                CanFrame(0x085, bytes(8)),
            ]

        def read(self) -> list[CanFrame]:
            return [self.out.pop(0)] if self.out else []

        def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
            """Nobody answers."""

    node = CiA404("force", Bus(), node=5, boot_s=10)  # type: ignore[arg-type]
    told = []
    for k in range(5):
        node.poll(k * 1e-3)
        told += node.remarks()
    assert told == [f"the device reports {emergency_in_words(code)}", "its emergency is over"]
    assert f"{code:04X}" in told[0] and len(told[0]) > 35


def bench_with_stage(line: Stage, rate_Hz: float) -> Bench:
    scene, _ = load_scene(SCENES / "no-hv.toml")
    raw = scene.model_dump(exclude_none=True)
    raw["stage"]["poll_rate_Hz"] = rate_Hz
    bench = Bench(Scene.model_validate(raw), Opened(VirtualClock(lambda t: None)))
    bench.devices["stage"] = ZaberStage("stage", line)
    return bench


@pytest.mark.parametrize(("late_ms", "rate_Hz", "told"), [(16, 100, True), (16, 50, False), (1, 200, False)])
def test_a_rate_that_cannot_be_kept_is_told_at_the_start(late_ms: int, rate_Hz: float, told: bool) -> None:
    """An adapter that holds every answer back for its latency timer."""
    line = Stage()
    bench = bench_with_stage(line, rate_Hz)
    give: Callable[[], bytes] = line.read
    held: list[tuple[int, bytes]] = []
    now = [0]

    def late() -> bytes:
        if data := give():
            held.append((now[0] + late_ms, data))
        return held.pop(0)[1] if held and held[0][0] <= now[0] else b""

    line.read = late  # type: ignore[method-assign]
    device = bench.devices["stage"]
    while not device.ready:
        device.poll(now[0] * 1e-3)
        now[0] += 1
    slow = bench.too_slow("stage")
    assert bool(slow) == told
    if told:
        assert "poll_rate_Hz = 100 Hz cannot be kept" in slow and "17.0 ms" in slow and "at most 58.8 Hz" in slow


def test_every_instrument_says_how_many_questions_a_sample_takes() -> None:
    asks = {one.driver: one.settings.asks_per_sample for one in registered().instruments.values()}
    streaming = {"gsv8", "cia404", "optoncdt-1420", "ascii-stream"}
    assert {driver for driver, count in asks.items() if count == 0} == streaming
