"""A whole run whose instruments are all behind device servers: raw sockets, RFC 2217 by pyserial's own server, and the
supply's CAN adapter at one too. Verified bit for bit from its log. Ports on a network count as real, whoever serves
them: no voltage without somebody who is there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest
import serial
from serial.rfc2217 import PortManager

from tests.protocols import TO_THE_FILM

FIXTURES = Path(str(files("sim_fixtures")))
pytestmark = [pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"), pytest.mark.slow]

# Short ways, and patience with a busy machine.
CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 5.0\ntimeout_s = 2.0",
    'driver = "gsv8"': 'driver = "gsv8"\ntimeout_s = 2.0',
    'driver = "keyence-lkg"': 'driver = "keyence-lkg"\ntimeout_s = 1.0',
    'driver = "iseg-edcp"': 'driver = "iseg-edcp"\ntimeout_s = 2.0',
    "rig_compliance_um_per_N = 2.0\n": "",
    "contact_position_mm = 40.0": "contact_position_mm = 7.0\n[simulation.stage]\nstart_position_mm = 2.0",
    "ramp_V_per_s = 300.0": "ramp_V_per_s = 1000.0",
    "../calibrations": str(FIXTURES / "calibrations"),
}

PASSIVE = (
    TO_THE_FILM
    + """[[step]]
do = "sweep"
displacement_mm = 3.0
speed_mm_per_s = 4.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""
)


class Pty(serial.Serial):
    """A pseudo-terminal, which has no modem lines for the server to look at."""

    cts = dsr = ri = cd = False


class DeviceServer:
    """Carries a serial port to a socket on loopback, for one host after another."""

    def __init__(self, port: str, *, telnet: bool) -> None:
        self._line = Pty(port, 9600, timeout=0, exclusive=True)
        self._telnet = telnet
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.settimeout(0.05)
        self.address = f"{'rfc2217' if telnet else 'socket'}://127.0.0.1:{self._listening.getsockname()[1]}"
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                host, _ = self._listening.accept()
            except TimeoutError:
                continue
            with host, contextlib.suppress(ConnectionError):  # the host leaves with data unread
                self._carry(host)

    def _carry(self, host: socket.socket) -> None:
        host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        host.settimeout(5)
        lock = threading.Lock()

        class Out:
            def write(self, data: bytes) -> None:
                with lock:
                    host.sendall(data)

        out = Out()
        manager = PortManager(self._line, out, logger=logging.getLogger("quiet")) if self._telnet else None
        while not self._stop.is_set():
            if select.select([host, self._line], [], [], 0.02)[0] and select.select([host], [], [], 0)[0]:
                if not (data := host.recv(4096)):
                    return
                self._line.write(data if manager is None else b"".join(manager.filter(data)))
            if data := self._line.read(4096):
                out.write(data if manager is None else b"".join(manager.escape(data)))

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)
        self._listening.close()
        self._line.close()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
    for old, new in CHANGES.items():
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


@pytest.fixture
def ports(scene: Path, tmp_path: Path) -> Iterator[Path]:
    """The ports of the simulated bench, each behind a device server."""
    command = [sys.executable, "-m", "rig", "sim", str(scene)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as bench, contextlib.ExitStack() as stack:
        assert bench.stdout is not None
        served = json.loads(bench.stdout.readline())
        stack.callback(bench.terminate)
        named = {}
        for role in ("stage", "force", "displacement", "hv"):
            key = "can_channel" if role == "hv" else "port"
            server = DeviceServer(served[role][key], telnet=role == "force")
            stack.callback(server.close)
            named[role] = served[role] | {key: server.address}
        path = tmp_path / "ports.json"
        path.write_text(json.dumps(named))
        yield path


def dea_rig(*arguments: str | Path) -> str:
    command = [sys.executable, "-m", "rig", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_a_run_over_device_servers_is_replayed_bit_for_bit(scene: Path, ports: Path, tmp_path: Path) -> None:
    log, protocol = tmp_path / "run.mcap", tmp_path / "passive.toml"
    protocol.write_text(PASSIVE)
    out = dea_rig("run", scene, protocol, "-o", log, "--ports", ports, "--yes")
    assert "REAL PORTS" in out and "high voltage off" in out
    verified = dea_rig("replay", "--verify", log)
    assert "every sample comes out as recorded, bit for bit" in verified and " hv " in verified
