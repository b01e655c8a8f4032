"""Our Keyence driver against the `keylkg` emulator of the EPICS device emulators, run by lewis as it is, over TCP.

The emulator is no package: LEWIS_EMULATORS names a checkout of github.com/ISISComputingGroup/EPICS-DeviceEmulator. It
knows M0, M1, M2, Q0, R0 and some settings, and says nothing at all to the others.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.instruments.keyence_lkg import UNANSWERED, KeyenceLKG
from drivers.links.device_server import open_line
from drivers.roles import DisplacementSample

pytestmark = pytest.mark.conformance

LEWIS = shutil.which("lewis", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", ""))))
EMULATORS = os.environ.get("LEWIS_EMULATORS", "")


@pytest.fixture
def address() -> Iterator[str]:
    if not LEWIS or not (Path(EMULATORS) / "lewis_emulators" / "keylkg").is_dir():
        pytest.skip("needs lewis, and LEWIS_EMULATORS naming a checkout of the EPICS device emulators")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [LEWIS, "-a", EMULATORS, "-k", "lewis_emulators", "keylkg"]
    command += ["-p", f"stream: {{bind_address: 127.0.0.1, port: {port}}}"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as emulator:
        end = time.monotonic() + 30
        while True:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                assert emulator.poll() is None and time.monotonic() < end
                time.sleep(0.1)
        yield f"socket://127.0.0.1:{port}"
        emulator.terminate()


def test_it_measures_though_its_settings_are_not_answered(address: str) -> None:
    link = open_line("laser", address, 115_200)
    laser = KeyenceLKG("laser", link, timeout_s=0.25, poll_rate_Hz=20)
    samples: list[DisplacementSample] = []
    end = time.monotonic() + 30
    while len(samples) < 20:
        assert time.monotonic() < end, laser.counters
        samples += laser.poll(time.monotonic())
        time.sleep(0.002)
    laser.close()
    assert UNANSWERED in (laser.settings["sampling_code"], laser.settings["program"])
    assert {(sample.displacement, sample.flags.value) for sample in samples} == {(0.0, 0)}
