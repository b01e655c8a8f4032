"""How soon the high voltage is off when a process of ours dies or hangs: measured on the supply's own output.

Engine and guard are real processes; the bench is served on pseudo-terminals by this one. What is measured therefore
includes the system's scheduling, the adapter's lines and the simulated bus. POSIX only.
"""

from __future__ import annotations

import json
import math
import os
import platform
import random
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from rig.base.errors import LimitError, RigError
from rig.benchmark.stand import Run, Stand
from rig.safety.heartbeat import DEADLINE_S, INTERVAL_S
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.wire import FrameWire

if TYPE_CHECKING:
    from rich.console import RenderableType

Progress = Callable[[float, str], None]  # share done, what is being done

KILLED, STOPPED, SPINNING, GUARD = "engine killed", "engine stopped", "engine in a busy loop", "guard killed"
GUARD_STOPPED, BACK = "guard stopped", "adapter pulled, from its return on"
BEATS, MODEL = "interval between heartbeats", "answer of the film's model"
TRIALS = BEATS, MODEL
ALLOWED_MS = {KILLED: 50.0, STOPPED: 200.0, SPINNING: 200.0, GUARD: 200.0, GUARD_STOPPED: 300.0, BACK: 1000.0}
ALLOWED_MS |= {BEATS: DEADLINE_S * 1e3, MODEL: 2.0}
FLOODED = ", bus flooded"  # by somebody else's frames
FLOOD_HZ = 1000
KINDS = (KILLED, GUARD, STOPPED, GUARD_STOPPED, BACK)  # that are tried on a flooded bus too
ALLOWED_MS |= {kind + FLOODED: ALLOWED_MS[kind] for kind in KINDS}
QUICK = {KILLED: 20, STOPPED: 6, SPINNING: 6, GUARD: 10, GUARD_STOPPED: 6, BACK: 6, KILLED + FLOODED: 4}
TRIES = 5
FULL = {KILLED: 200, STOPPED: 100, SPINNING: 40, GUARD: 200, GUARD_STOPPED: 100, BACK: 60}
FULL |= {kind + FLOODED: FULL[kind] // 4 for kind in KINDS}
PARTS = "safety_parts.json"  # what a benchmark that was broken off had measured
PULLED_S = 0.3  # how long the adapter is out
LATEST_S = 10.0  # an output that is not commanded off by then never will be


@dataclass
class Row:
    """One kind of trouble: milliseconds from it to the supply's being sent to zero, one a run that had voltage.

    ``without`` counts runs that had none at that instant, ``never`` those whose output stayed on.
    """

    what: str
    ms: list[float] = field(default_factory=list)
    without: int = 0
    never: int = 0
    loads: list[float] = field(default_factory=list)  # of the machine (one minute), beside each time
    runs: int = 0  # done, with whatever end

    def quantile(self, share: float) -> float:
        """Linear between the values; NaN when there are none."""
        return float(np.quantile(self.ms, share)) if self.ms else math.nan


@dataclass(frozen=True)
class Report:
    """What the benchmark of safety found."""

    full: bool
    rows: list[Row]
    environment: dict[str, str]


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None, number: int | None = None) -> Report:
    """Measure, and write ``safety.json`` and ``safety.png``; ``number`` of runs of every kind, where it is given.

    After each run what has been measured is kept in ``safety_parts.json``: broken off and started again with the same
    numbers, the benchmark goes on from there.
    """
    numbers = dict.fromkeys(FULL, number) if number is not None else FULL if full else QUICK
    rows = _kept(out_dir / PARTS, numbers)
    total = sum(numbers.values())
    out_dir.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="dea-rig-safety-") as name, Stand(Path(name)) as stand:
        beats = Row(BEATS)
        _undisturbed(stand, beats)
        rng = random.Random()
        for row in rows:
            with flood(stand, FLOOD_HZ if row.what.endswith(FLOODED) else 0):
                while row.runs < numbers[row.what]:
                    done = sum(one.runs for one in rows)
                    progress(done / total, f"{row.what}: {row.runs} of {numbers[row.what]}, median {_ms(row)}")
                    with suppress(RigError):  # a machine too busy for a run to come to its voltage: another one
                        measure(stand, row, None, rng)
                    row.runs += 1
                    _keep(out_dir / PARTS, numbers, rows)
        rows += [beats, model_answers(stand)]
    report = Report(full, rows, _environment())
    save(report, out_dir)
    (out_dir / PARTS).unlink(missing_ok=True)
    return report


def _ms(row: Row) -> str:
    return f"{row.quantile(0.5):.0f} ms, longest {max(row.ms):.0f} ms" if row.ms else "not known yet"


def _keep(path: Path, numbers: dict[str, int], rows: list[Row]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps({"numbers": numbers, "rows": [asdict(row) for row in rows]}), encoding="utf-8")
    part.replace(path)


def _kept(path: Path, numbers: dict[str, int]) -> list[Row]:
    """The rows of a benchmark of the same numbers that was broken off; empty ones where there is none."""
    with suppress(OSError, ValueError, TypeError, KeyError):
        kept = json.loads(path.read_text(encoding="utf-8"))
        rows = [Row(**row) for row in kept["rows"]]
        if kept["numbers"] == numbers and [row.what for row in rows] == list(numbers):
            return rows
    return [Row(what) for what in numbers]


@contextmanager
def flood(stand: Stand, rate: int) -> Iterator[None]:
    """``rate`` frames a second of somebody else's on the supply's bus, as long as this lasts."""
    ending = threading.Event()
    bundle = 10

    def bundled(bench: SimulatedBench) -> None:
        wire = bench.wire("hv")
        assert isinstance(wire, FrameWire)
        for k in range(bundle):
            wire.send((0x100 + k, bytes(8)), bench.now)

    def send() -> None:
        while not ending.wait(bundle / rate):
            with suppress(Exception):  # the bus may be out at this moment
                stand.do(bundled)

    thread = threading.Thread(target=send)
    if rate:
        thread.start()
    try:
        yield
    finally:
        ending.set()
        if rate:
            thread.join()


def whole_run(stand: Stand, beats: Row | None = None) -> float:
    """Seconds that a run takes that nobody disturbs; the intervals between its heartbeats go into ``beats``."""
    run = stand.start()
    stand.wait_until_alone(run)
    if run.status != 0:
        raise RigError(f"A run that nobody disturbs failed: {run.said}")
    if beats is not None:
        beats.ms += [1e3 * float(step) for step in np.diff(run.beats)]
    return stand.bench.clock.now() - run.began


def model_answers(stand: Stand, number: int = 400) -> Row:
    """Processor time for one question of the guard: does the film bear this displacement and this voltage?"""
    scene, _ = load_scene(stand.scene)
    film = FilmLimits(scene.specimen.specimen(), Limits.of(scene))
    rng = random.Random(2)
    row = Row(MODEL)
    for k in range(number + 1):
        began = process_time()
        with suppress(LimitError):
            film.check(rng.uniform(0.0, 0.012), rng.uniform(0.0, 1500.0), "here")
        if k > 0:  # the guard puts the first question when it is appointed
            row.ms.append(1e3 * (process_time() - began))
    return row


def measure(stand: Stand, row: Row, instant: float | None, rng: random.Random) -> Run:
    """One run with one trouble: at ``instant`` seconds after its start, or at random while it is live."""
    run = stand.start()
    if instant is None:
        try:
            stand.wait_until_live(run)
        except RigError:  # the guard of a run killed in its first moments may still have the port
            row.without += 1
            stand.wait_until_alone(run)
            return run
        instant = stand.bench.clock.now() - run.began + rng.uniform(0.0, 1.0)
    due = run.began + instant
    stand.wait(lambda: stand.bench.clock.now() >= due or run.status is not None, "the instant")
    if run.status is not None:  # it was faster this time
        row.without += 1
        stand.wait_until_alone(run)
        return run
    what = row.what.removesuffix(FLOODED)
    pid = run.guard if what in (GUARD, GUARD_STOPPED) else run.engine
    stopping = {STOPPED: signal.SIGSTOP, GUARD_STOPPED: signal.SIGSTOP, SPINNING: signal.SIGUSR1}
    try:
        if what == BACK:
            pulled = stand.pull("hv")
            stand.wait(lambda: stand.bench.clock.now() > pulled + PULLED_S, "its return")
            at = stand.plug_in("hv")
        else:
            at = stand.kill(pid, stopping.get(what, signal.SIGKILL))
    except ProcessLookupError:  # it has ended this very moment
        row.without += 1
        stand.wait_until_alone(run)
        return run
    if not stand.was_on(at):
        row.without += 1
    else:
        try:
            stand.wait(lambda: stand.off_after(at) is not None, "the output's end", LATEST_S)
            off = stand.off_after(at)
            assert off is not None
            row.ms.append(1e3 * (off.t - at))
            row.loads.append(os.getloadavg()[0])
        except RigError:
            row.never += 1
    if what in (STOPPED, SPINNING):
        stand.kill(run.engine)
    stand.wait_until_alone(run)
    return run


def _undisturbed(stand: Stand, beats: Row | None = None) -> float:
    """`whole_run`; a busy machine may hold an engine up for longer than the guard bears, so a few are tried."""
    for _ in range(TRIES - 1):
        with suppress(RigError):
            return whole_run(stand, beats)
    return whole_run(stand, beats)


def kill_many(folder: Path, number: int, at_once: int, seed: int) -> Row:
    """``number`` engines killed at random instants, ``at_once`` of them side by side.

    Every other one at any instant of the whole run, the rest once voltage is on: however slow the machine, half of them
    have something to take off.
    """
    rows = [Row(KILLED) for _ in range(at_once)]
    errors: list[Exception] = []

    def work(k: int) -> None:
        rng = random.Random(seed * at_once + k)
        try:
            with Stand(folder / f"stand-{k}", hold_s=0.5) as stand:
                duration = min(_undisturbed(stand) for _ in range(2))  # the first has more to read
                for n in range(k, number, at_once):
                    anywhere = n // at_once % 2 == 0
                    measure(stand, rows[k], rng.uniform(0.0, duration) if anywhere else None, rng)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(at_once)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return Row(
        KILLED, [ms for row in rows for ms in row.ms], sum(row.without for row in rows), sum(row.never for row in rows)
    )


def _environment() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        "system": platform.system(),
        "processors": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.1f}",
        "heartbeat_ms": f"{INTERVAL_S * 1e3:.0f}",
        "deadline_ms": f"{DEADLINE_S * 1e3:.0f}",
    }


# ---- showing


def save(report: Report, out_dir: Path) -> None:
    """Write the report as JSON and a picture."""
    out_dir.mkdir(parents=True, exist_ok=True)
    content = {
        "full": report.full,
        "allowed_ms": ALLOWED_MS,
        "rows": [asdict(row) for row in report.rows],
        "environment": report.environment,
    }
    (out_dir / "safety.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    _draw(report, out_dir / "safety.png")


def render(report: Report) -> RenderableType:
    """A table for the terminal."""
    from rich.console import Group
    from rich.table import Table

    table = Table(
        title="From the trouble to the supply's output being sent to zero; what that rests on; in ms",
        caption="Measured on the simulated supply; what a real one then needs to discharge comes on top.",
    )
    for heading in ("", "times", "without HV", "median", "95 %", "longest", "allowed", "never off", "load"):
        table.add_column(heading, justify="right" if heading else "left")
    for row in report.rows:
        trial = row.what not in TRIALS
        times = (row.quantile(0.5), row.quantile(0.95), max(row.ms, default=math.nan), ALLOWED_MS[row.what])
        table.add_row(
            row.what,
            str(len(row.ms)),
            str(row.without) if trial else "",
            *(f"{time:.3g}" for time in times),
            str(row.never) if trial else "",
            f"{np.median(row.loads):.1f}" if row.loads else "",
        )
    setting = ", ".join(f"{name} {value}" for name, value in report.environment.items())
    return Group(table, f"Measured on: {setting}.")


def _draw(report: Report, path: Path) -> None:
    """Every measured time as a mark, a row a kind, with what is allowed."""
    from matplotlib.figure import Figure

    rows = report.rows[::-1]
    figure = Figure(figsize=(8.0, 1.4 + 0.6 * len(rows)), layout="constrained")
    axes = figure.subplots()
    rng = np.random.default_rng(1)
    for y, row in enumerate(rows):
        times = np.array(row.ms)
        axes.plot(times, y + rng.uniform(-0.18, 0.18, times.size), ".", color="#0072B2", alpha=0.5, markersize=5)
        axes.plot([row.quantile(0.5)] * 2, [y - 0.3, y + 0.3], color="black", linewidth=2)
        axes.plot([ALLOWED_MS[row.what]] * 2, [y - 0.4, y + 0.4], color="#D55E00", linewidth=2)
    axes.plot([], [], ".", color="#0072B2", label="one time")
    axes.plot([], [], color="black", linewidth=2, label="median")
    axes.plot([], [], color="#D55E00", linewidth=2, label="allowed")
    axes.set_xscale("log")
    ticks = [0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_yticks(range(len(rows)), [row.what for row in rows])
    axes.set_xlabel("time until the supply is sent to zero / ms; last rows: interval, processor time / ms")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
