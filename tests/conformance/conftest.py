"""Other people's clients against the simulated bench on pseudo-terminals.

A client runs in a process of its own with a time limit: some spin threads, hang when a device is silent, or keep state
in their classes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import RealClock
from rig.sim.bench import SimulatedBench
from rig.sim.server import Server
from rig.sim.settings import SimulationSettings

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])


class Served:
    """A bench that is being served."""

    def __init__(self, settings: dict[str, Any], roles: tuple[str, ...]) -> None:
        self.bench = SimulatedBench(SimulationSettings.model_validate({"seed": 1, **settings}), FILM, roles)
        self.server = Server(self.bench, RealClock())
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.run, args=(self._stop.is_set,), daemon=True)
        self._thread.start()

    def client(self, script: str, *arguments: str, timeout: float = 60.0) -> Any:
        """Run ``script`` in its own process; it prints its result as JSON in its last line."""
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=timeout, check=False
        )
        assert done.returncode == 0, f"the client failed:\n{done.stdout}\n{done.stderr}"
        return json.loads(done.stdout.splitlines()[-1])

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.server.close()
        assert not self._thread.is_alive()


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    served: list[Served] = []

    def start(*roles: str, **settings: Any) -> Served:
        served.append(Served(settings, roles))
        return served[-1]

    yield start
    for one in served:
        one.close()
