"""A process that has everything read and checked for one run, and forks a fresh engine from that when asked.

For many short runs over real ports without paying each time for reading modules: the engine and its guard are then real
processes all the same. Standard input gets one JSON object a run, ``{"ports": {...}, "log": path}``; standard output
gives lines ``engine PID``, ``guard PID`` and ``ended PID STATUS``. POSIX only.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import select
import signal
import sys
import traceback
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

from drivers.links.link import DeviceError
from rig.base.errors import RigError
from rig.protocol.experiment import Experiment, prepare
from rig.run.run import Consent, run
from rig.safety import process, remote, start

CONSENT = Consent("a benchmark", "a benchmark")


def main(scene: str, protocol: str) -> None:
    experiment = prepare(Path(scene), Path(protocol))
    # The product starts a guard's process afresh each time; here they are forked from one that has read the modules.
    multiprocessing.set_forkserver_preload(
        ["rig.safety.process", "serial", "drivers.links.can_link", "drivers.instruments.iseg_edcp"]
    )
    forkserver.ensure_running()
    fork = multiprocessing.get_context("forkserver").Process
    start.start_guard = lambda end: start.ByMultiprocessing(fork(target=process.serve, args=(end,)))
    say("ready")
    serve(experiment)


def serve(experiment: Experiment) -> None:
    children: set[int] = set()
    buffer = b""
    while True:
        ready, _, _ = select.select([0], [], [], 0.005 if children else 0.1)
        if ready:
            data = os.read(0, 65536)
            if not data:
                return
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                pid = os.fork()
                if pid == 0:
                    spawn(experiment, json.loads(line))
                children.add(pid)
                say(f"engine {pid}")
        for pid in list(children):
            found, status = os.waitpid(pid, os.WNOHANG)
            if found:
                children.discard(pid)
                say(f"ended {pid} {os.waitstatus_to_exitcode(status)}")


def spawn(experiment: Experiment, wanted: dict[str, Any]) -> None:
    """The life of one engine; never returns."""
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[method-assign]  # it is our parent's child
    code = 1
    log = Path(wanted["log"])
    os.setsid()
    try:
        with log.with_suffix(".err").open("w", buffering=1) as err:
            os.dup2(err.fileno(), 2)
            beats = _watch_guard()
            signal.signal(signal.SIGUSR1, _spin)
            try:
                run(
                    replace(experiment, scene=experiment.scene.with_ports(wanted["ports"]), served=True),
                    log,
                    lambda *_: None,
                    CONSENT,
                )
                code = 0
            except (RigError, DeviceError) as error:
                err.write(f"{error}\n")
                code = getattr(error, "exit_code", 4)
            except BaseException:
                traceback.print_exc(file=err)
            log.with_suffix(".beats").write_text("\n".join(map(repr, beats)))
    finally:
        os._exit(code)


def _watch_guard() -> list[float]:
    """Tell the number of the guard's process once it is there; the times of the heartbeats come into the list."""
    beats: list[float] = []
    opened, heartbeat = remote.RemoteGuard.opened, remote.RemoteGuard.heartbeat

    def tell(self: remote.RemoteGuard) -> None:
        opened(self)
        say(f"guard {os.getpid()} {self.pid}")

    def note(self: remote.RemoteGuard, data: bytes, now: float) -> None:
        beats.append(now)
        heartbeat(self, data, now)

    remote.RemoteGuard.opened = tell  # type: ignore[method-assign]
    remote.RemoteGuard.heartbeat = note  # type: ignore[method-assign]
    return beats


def _spin(number: int, frame: object) -> None:
    """A mistake of ours that never comes back and holds the interpreter."""
    while True:
        pass


def say(line: str) -> None:
    os.write(1, f"{line}\n".encode())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
