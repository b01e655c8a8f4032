"""The log in figures: how fast it is written and read, how long the disk takes to confirm, what damage costs.

Times of writing and reading are processor time, so that a busy machine tells the same; the disk's are waiting time.
"""

from __future__ import annotations

import json
import math
import os
import platform
import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time  # what work costs; when things happen is the clock's business
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.base.clock import RealClock
from rig.base.errors import ConfigError
from rig.log.dataset import load_run
from rig.log.errors import LogError
from rig.log.part_file import PartFile
from rig.log.process import LogProcess
from rig.log.reader import read_log
from rig.log.writer import LogWriter

if TYPE_CHECKING:
    from rich.console import RenderableType

Progress = Callable[[float, str], None]  # share done, what is being done

RATE_HZ = 1000.0  # force and displacement, each with its bytes
CHUNK_BYTES = 8192  # about what such a run writes in 80 ms
WANTED_PER_S, WANTED_LOAD_S, WANTED_S_PER_MIB = 20_000.0, 5.0, 2.0


@dataclass(frozen=True)
class Report:
    """What the benchmark of the log found; times in seconds, of one core where nothing else is said."""

    recorded_s: float  # seconds of the run that was written and read
    messages: int
    octets: int
    write_s: float  # by one process
    hand_over_s: float  # what recording costs the engine when a process of its own writes
    load_s: float
    sync_ms: dict[str, float]  # median, 99 %, most: waiting for the disk of the output folder
    damaged_s_per_MiB: dict[str, float]
    environment: dict[str, str]

    @property
    def messages_per_s(self) -> float:
        """Messages written in a second of processor time."""
        return self.messages / self.write_s

    @property
    def ten_minutes_s(self) -> float:
        """Time to load ten minutes."""
        return self.load_s * 600.0 / self.recorded_s


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None) -> Report:
    """Write and read a minute (full: ten) at 1 kHz in a folder of ``out_dir``; write ``log.json``."""
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out_dir}: cannot be made ({error.strerror}).") from None
    report = measure(out_dir, 600.0 if full else 60.0, 1000 if full else 100, progress)
    content = asdict(report) | {"messages_per_s": report.messages_per_s, "ten_minutes_s": report.ten_minutes_s}
    (out_dir / "log.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return report


def measure(out_dir: Path, seconds: float, syncs: int, progress: Progress = lambda share, what: None) -> Report:
    """Measure with a log of ``seconds`` and that many waits for the disk, in a folder of ``out_dir``."""
    with TemporaryDirectory(prefix="log-", dir=out_dir) as name:
        folder = Path(name)
        path = folder / "a.mcap"
        progress(0.0, "writing")
        write_s = _write(LogWriter(path), seconds)
        progress(0.4, "reading")
        began = process_time()
        load_run(path)
        load_s = process_time() - began
        messages, octets = sum(read_log(path).topics.values()), path.stat().st_size
        progress(0.5, "handing over to another process")
        hand_over_s = math.nan
        if os.name == "posix":
            part = min(seconds, 60.0)
            hand_over_s = seconds / part * _write(LogProcess(folder / "b.mcap"), part)
        progress(0.7, "waiting for the disk")
        sync_ms = _syncs(folder / "c", syncs)
        progress(0.8, "reading damaged logs")
        damaged = _damaged(folder, path.read_bytes()[: min(octets // 2, 16 * 2**20)])
    environment = {
        "python": platform.python_version(),
        "system": platform.system(),
        "processors": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown",
    }
    return Report(seconds, messages, octets, write_s, hand_over_s, load_s, sync_ms, damaged, environment)


def rows(seconds: float) -> Iterator[tuple[float, str, dict[str, Any]]]:
    """Time, topic and fields of a run at 1 kHz with two instruments."""
    for k in range(round(seconds * RATE_HZ)):
        t = k / RATE_HZ
        x = math.sin(t)
        yield t, "/raw/force/rx", {"t_s": t, "data": b"\xaa\x11\x22\x33\x44\x85"}
        yield t, "/force/sample", {"t_s": t, "reading": x, "force_N": 2 * x, "flags": 0}
        yield t, "/raw/displacement/rx", {"t_s": t, "data": b"M1,+01.2345\r"}
        yield t, "/displacement/sample", {"t_s": t, "reading_m": x, "displacement_m": 3 * x, "flags": 0}


def _write(log: LogWriter | LogProcess, seconds: float) -> float:
    clock = RealClock()
    began = process_time()
    with log:
        for n, (t, topic, fields) in enumerate(rows(seconds)):
            ns = round(t * 1e9)
            log.write(topic, fields, ns, ns)
            if n % 16 == 0:
                log.tick(t if isinstance(log, LogWriter) else 0.0)
            if n % 20_000 == 0 and isinstance(log, LogProcess):
                clock.sleep_until(clock.now() + 0.2)  # faster than real time: let the other process keep up
        log.finish({"status": "complete"})
    return process_time() - began


def _syncs(path: Path, count: int) -> dict[str, float]:
    file, clock = PartFile(path), RealClock()
    waits = []
    for _ in range(count):
        file.put(random.randbytes(CHUNK_BYTES))
        began = clock.now()
        file.sync()
        waits.append(1e3 * (clock.now() - began))
    file.discard()
    return {"median": float(np.median(waits)), "99 %": float(np.quantile(waits, 0.99)), "most": max(waits)}


def _damaged(folder: Path, good: bytes) -> dict[str, float]:
    rng = random.Random(1)
    flipped = bytearray(good)
    for at in range(1000, len(flipped), 5000):
        flipped[at] ^= 1 << rng.randrange(8)
    kinds = {
        "cut": good,
        "a flip every 5 kB": bytes(flipped),
        "zero tail": good[:100_000] + bytes(len(good)),
        "noise": good[:8] + rng.randbytes(len(good)),
    }
    costs = {}
    for what, content in kinds.items():
        path = folder / "damaged.mcap"
        path.write_bytes(content)
        began = process_time()
        with suppress(LogError):
            load_run(path)
        costs[what] = (process_time() - began) / (len(content) / 2**20)
    return costs


def render(report: Report) -> RenderableType:
    """A table for the terminal."""
    from rich.console import Group
    from rich.table import Table

    table = Table(
        title=f"The log of {report.recorded_s:.0f} s with two instruments at {RATE_HZ:.0f} Hz: "
        f"{report.messages} messages, {report.octets / 1e6:.1f} MB",
        caption="Processor time of one core, but for the disk.",
    )
    for heading in ("", "measured", "wanted"):
        table.add_column(heading, justify="right" if heading else "left")
    table.add_row("messages written a second", f"{report.messages_per_s:,.0f}", f"> {WANTED_PER_S:,.0f}")
    hand_over = 1e6 * report.hand_over_s / report.messages
    table.add_row("handing one over to the process that writes", f"{hand_over:.1f} µs", "")
    table.add_row("loading ten minutes", f"{report.ten_minutes_s:.2f} s", f"< {WANTED_LOAD_S:.0f} s")
    for what, wait in report.sync_ms.items():
        table.add_row(f"the disk confirms {CHUNK_BYTES} bytes: {what}", f"{wait:.1f} ms", "")
    for what, cost in report.damaged_s_per_MiB.items():
        table.add_row(f"reading a damaged log: {what}", f"{cost:.2f} s/MiB", f"< {WANTED_S_PER_MIB:.0f} s/MiB")
    setting = ", ".join(f"{name} {value}" for name, value in report.environment.items())
    return Group(table, f"Measured on: {setting}.")
