"""The bench on pseudo-terminals in real time, and the slcan adapter."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import serial

from rig.base.clock import RealClock
from rig.sim.server import Server
from rig.sim.slcan import SlcanAdapter
from rig.sim.truth import Fault
from rig.sim.wire import FrameWire

# The adapter


def adapter(*lines: bytes, bitrate: int = 125_000) -> tuple[SlcanAdapter, FrameWire]:
    bus = FrameWire(bitrate=bitrate)
    one = SlcanAdapter(bus)
    for line in lines:
        assert one.host_write(line, 0.0) == b"\r"
    return one, bus


def test_opening_sequence_of_python_can():
    adapter(b"C\r", b"S4\r", b"\r", b"O\r", b"O\r")


def test_frames_both_ways():
    one, bus = adapter(b"S4\r", b"O\r")
    assert one.host_write(b"t20121208\rt20", 0.0) + one.host_write(b"050102030405\r", 0.0) == b"\r\r"
    assert [frame for _, frame in bus.deliveries(1.0)] == [(0x201, b"\x12\x08"), (0x200, bytes([1, 2, 3, 4, 5]))]
    bus.send((0x200, b"\x12\x08\x01"), 1.0)
    assert one.host_read(2.0) == b"t2003120801\r"


@pytest.mark.parametrize(
    "bad", [b"t2013 1208\r", b"t20131208\r", b"t8010\r", b"t2019\r", b"t201\r", b"r2010\r", b"hello\r", b"S9\r"]
)
def test_refusals(bad):
    one, bus = adapter(b"S4\r", b"O\r")
    assert one.host_write(bad, 0.0) == b"\x07"
    assert bus.deliveries(1.0) == []


def test_closed_listening_and_wrong_rate():
    one, bus = adapter(b"S4\r")
    assert one.host_write(b"t20121208\r", 0.0) == b"\x07"
    one.host_write(b"L\r", 0.0)
    assert one.host_write(b"t20121208\r", 0.0) == b"\x07"
    bus.send((0x200, b""), 0.0)
    assert one.host_read(1.0) == b"t2000\r"
    deaf, bus = adapter(b"S4\r", b"O\r", bitrate=250_000)
    assert deaf.host_write(b"t20121208\r", 0.0) == b"\r"
    bus.send((0x200, b""), 0.0)
    assert bus.deliveries(1.0) == [] and deaf.host_read(1.0) == b""


# The server


@pytest.fixture
def serve(make_host):
    running = []

    def start(*roles, **settings):
        server = Server(make_host(*roles, **settings).bench, RealClock())
        stop = threading.Event()
        thread = threading.Thread(target=server.run, args=(stop.is_set,), daemon=True)
        thread.start()
        running.append((server, stop, thread))
        return server

    yield start
    for server, stop, thread in running:
        stop.set()
        thread.join(5)
        assert not thread.is_alive()
        server.close()


def port(server, role, **keys):
    return serial.Serial(server.ports[role]["port"], timeout=2.0, **keys)


def test_ports_are_named_as_scenes_name_them(serve):
    ports = serve("stage", "force", "displacement", "hv").ports
    assert set(ports) == {"stage", "force", "displacement", "hv"}
    assert set(ports["stage"]) == {"port"}
    assert set(ports["hv"]) == {"interface", "can_channel"} and ports["hv"]["interface"] == "slcan"


def test_instruments_answer_beside_each_other(serve):
    server = serve("stage", "displacement", "hv")
    time.sleep(0.1)  # the laser's average fills
    with port(server, "stage") as stage, port(server, "displacement") as laser:
        for _ in range(20):
            stage.write(b"/1 1 07\n")
            laser.write(b"M1\r")
            assert stage.readline() == b"@01 1 07 OK IDLE WR 0\r\n"
            assert laser.read_until(b"\r").startswith(b"M1,+01.2")
    with serial.Serial(server.ports["hv"]["can_channel"], timeout=2.0) as can:
        can.write(b"S4\rO\rt2002D801\rt20121208\r")
        assert can.read_until(b"t2003120801\r").endswith(b"t2003120801\r")


def test_it_runs_in_real_time(serve):
    server = serve("stage", stage={"referenced_at_start": True})
    with port(server, "stage") as stage:
        for target in (60472, 0, 60472):  # a busy machine may be late once, and never early
            start = time.monotonic()
            stage.write(b"/1 1 move abs %d\n" % target)  # 18 mm at 20 mm/s and 200 mm/s^2
            while b"IDLE" not in stage.readline():
                stage.write(b"/1 1\n")
            took = time.monotonic() - start
            assert took > 18 / 20 - 0.05
            if took < 18 / 20 + 0.25:
                break
        assert took == pytest.approx(18 / 20 + 0.1, abs=0.15)


@pytest.mark.slow
def test_a_host_that_does_not_read_costs_frames_not_the_server(serve):
    server = serve("stage", "force", force={"stored_rate_Hz": 2000.0})
    time.sleep(2.0)  # 4000 frames of 36 bytes: far more than a pseudo-terminal holds
    assert server.lost_bytes["force"] > 20_000
    with port(server, "stage") as stage:
        stage.write(b"/1 1 07\n")
        assert stage.readline() == b"@01 1 07 OK IDLE WR 0\r\n"


def test_a_pulled_plug_is_seen_and_comes_back(serve):
    server = serve("stage", "displacement")
    bench = server._bench
    with port(server, "stage") as stage:
        bench.inject(Fault(role="stage", kind="vanish", duration_s=0.3))
        with pytest.raises(OSError):  # serial.SerialException is one
            for _ in range(100):
                stage.write(b"/1 1\n")
                stage.readline()
    time.sleep(0.5)
    with port(server, "stage") as stage:
        stage.write(b"/1 1 07\n")
        assert stage.readline() == b"@01 1 07 OK IDLE WR 0\r\n"


def test_close_takes_the_ports_away(make_host):
    server = Server(make_host("displacement", "hv").bench, RealClock())
    names = [server.ports["displacement"]["port"], server.ports["hv"]["can_channel"]]
    assert all(Path(name).exists() for name in names)
    server.close()
    server.close()
    assert not any(Path(name).exists() for name in names)


LOAD = """
import os, select, sys, time
from rig.base.clock import RealClock
from rig.sim.bench import SimulatedBench
from rig.sim.server import Server
from rig.sim.settings import SimulationSettings
from tests.rig.sim.conftest import closed_form, specimen

settings = SimulationSettings.model_validate({"seed": 1, "force": {"stored_rate_Hz": 1000.0}})
bench = SimulatedBench(settings, specimen(), {"stage", "force", "displacement"}, solve=closed_form)
server = Server(bench, RealClock())
print(*(server.ports[role]["port"] for role in ("stage", "force", "displacement")), flush=True)
start, used = time.monotonic(), os.times()
server.run(lambda: bool(select.select([sys.stdin], [], [], 0)[0]))
now = os.times()
share = (now.user + now.system - used.user - used.system) / (time.monotonic() - start)
print(share, server.lost_bytes["force"], flush=True)
"""


@pytest.mark.slow
def test_a_kilohertz_stream_beside_polling_costs_less_than_half_a_core():
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", LOAD], stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        names = process.stdout.readline().split()
        stage, force, laser = (serial.Serial(name, timeout=0) for name in names)
        force.write(bytes.fromhex("AA902385 AA902485"))
        received, k, start = 0, 0, time.monotonic()
        while time.monotonic() - start < 4.0:
            time.sleep(0.01)
            received += len(force.read(100_000))
            laser.write(b"M1\r")
            if k % 2:
                stage.write(b"/1 1 get pos\n")
            stage.read(1000), laser.read(1000)
            k += 1
        process.stdin.write("\n")
        process.stdin.flush()
        share, lost = process.stdout.readline().split()
        assert float(share) < 0.5 and int(lost) == 0
        assert received / 36 == pytest.approx(4000, abs=60)
