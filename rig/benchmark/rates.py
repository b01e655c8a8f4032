"""Rates over real ports: does every sample arrive, and what part of a processor core does that take?

The simulated bench runs in a process of its own behind pseudo-terminals, with the force amplifier at 1 kHz, the stage
polled at 50 Hz and the laser at 100 Hz. First only the three serial drivers are polled, in the engine's manner; then
load cell, laser and a probe on one LabJack and a meter, over TCP, beside the stage; then a whole run with high voltage,
a meter and the log: loop, guard and log writer are three processes, and all three count. POSIX only.

Lost samples are counted by their noise. What the simulated amplifier adds to its n-th frame follows from the scene's
seed, so that every reading tells which frame it is, and no clock is needed to see that one is missing.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time  # what work costs; when things happen is the clock's business
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.instruments.gsv8 import GSV8Settings
from drivers.instruments.gsv8.codec import Decoder, Measured
from drivers.roles import Device, ForceSample, Sample
from rig.base.clock import RealClock
from rig.base.errors import RigError
from rig.base.toml_file import validate
from rig.bench.bench import Bench
from rig.engine.attention import Attention
from rig.engine.engine import LONGEST_TURN_S, SETUP_LIMIT_S, SHORTEST_TURN_S
from rig.log.reader import read_log
from rig.log.schema import ROLES
from rig.protocol.experiment import prepare
from rig.run.backend import open_bench
from rig.run.run import Consent
from rig.run.run import run as run_experiment
from rig.scene.scene import Scene, load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.gsv8 import GSV8Truth
from rig.sim.wire import ByteWire

if TYPE_CHECKING:
    from rich.console import RenderableType

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]  # share done, what is being done

FORCE_HZ, STAGE_HZ, LASER_HZ = 1000.0, 50.0, 100.0
ALLOWED_SHARE = 0.25  # of a core, for the host
DRIVERS, WHOLE_RUN = "three serial drivers", "whole run with high voltage and log"
NETWORK = "a LabJack with three sensors, and a meter, over TCP"
RUN_SHARE, NETWORK_SHARE = 0.4, 0.25  # of the progress bar
NETWORK_HZ = {"stage": STAGE_HZ, "force": 100.0, "displacement": 100.0, "monitor": 10.0, "monitor_2": 5.0}
NETWORK_CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 36.0\ntimeout_s = 2.0",
    "rate_Hz = 100.0": "rate_Hz = 100.0\ntimeout_s = 2.0",
    "mm_per_V = 4.0": "rate_Hz = 100.0\ntimeout_s = 2.0\nmm_per_V = 4.0",
    "[simulation]\n": '[monitor]\ndriver = "labjack-monitor"\nquantity = "temperature"\nrate_Hz = 10.0\n'
    'timeout_s = 2.0\n\n[monitor_2]\ndriver = "scpi"\nquantity = "humidity"\nrate_Hz = 5.0\n\n[simulation]\n',
}

METER = {
    "[simulation]\n": '[monitor]\ndriver = "scpi"\nquantity = "temperature"\nrate_Hz = 10.0\ntimeout_s = 2.0\n\n'
    "[simulation]\n"
}
LAST_HOLD = 'do = "hold"\nduration_s = 0.5'  # of the short protocol, where the full measurement stays
LONG_HOLD = 'do = "voltage"\nvoltage_V = 800\n\n[[step]]\ndo = "hold"\nduration_s = {seconds:g}\n\n'
LONG_HOLD += '[[step]]\ndo = "voltage"\nvoltage_V = 0'
PROCESSES = {"rig.safety.process": "guard", "rig.log.server": "log"}

# From the scene of the examples to this one. Short ways; and time-outs with patience, they are not what is measured.
CHANGES = {
    'driver = "zaber"\napproach_from_mm = 36.0': f'driver = "zaber"\npoll_rate_Hz = {STAGE_HZ}\n'
    "approach_from_mm = 5.0\ntimeout_s = 2.0",
    "rate_Hz = 100.0": f"rate_Hz = {FORCE_HZ}\ntimeout_s = 2.0",
    'driver = "keyence-lkg"': f'driver = "keyence-lkg"\npoll_rate_Hz = {LASER_HZ}\ntimeout_s = 2.0',
    'driver = "iseg-edcp"': 'driver = "iseg-edcp"\ntimeout_s = 2.0',
    "contact_position_mm = 40.0": "contact_position_mm = 7.0",
    "[simulation.film]": "[simulation.stage]\nstart_position_mm = 2.0\n\n[simulation.film]",
    "[simulation.force]": f"[simulation.force]\nstored_rate_Hz = {FORCE_HZ}",
}

SAME = 0.2  # two readings differ by their noise alone if they do within this many of its standard deviations
TELLING = 20  # that many neighbours are never the same by chance
MOST_SKIPPED = 500  # readings, where one loss follows so close on another that none of them can be placed


@dataclass(frozen=True)
class Polled:
    """One instrument that answers questions."""

    role: str
    wanted_Hz: float
    reached_Hz: float
    round_trip_mean_ms: float
    round_trip_max_ms: float
    retries: int
    missed: int  # polls whose time had passed before they could be sent


@dataclass(frozen=True)
class Row:
    """One way of working.

    ``expected`` is rate times time; ``lost`` is counted by the noise between the first and the last reading;
    ``believed_lost`` is how many the driver (in a log: the time stamps) leaves room for. Shares are processor time
    over time; the simulator's is NaN where the system does not tell it.
    """

    what: str
    seconds: float
    expected: float
    received: int
    lost: int
    believed_lost: int
    host_share: float
    simulator_share: float
    polled: list[Polled]
    shares: dict[str, float] = field(default_factory=dict)  # of the host's, by process

    @property
    def used_of_allowed(self) -> float:
        """Ratio of the host's share of a core to what it may use."""
        return self.host_share / ALLOWED_SHARE


@dataclass(frozen=True)
class Report:
    """What the benchmark of rates found."""

    full: bool
    rows: list[Row]
    environment: dict[str, str]


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None) -> Report:
    """Poll for 10 s, then a whole run of half a minute (full: 60 s more, each); ``rates.json`` and ``rates.png``."""
    report = measure(60.0 if full else 10.0, full=full, progress=progress)
    save(report, out_dir)
    return report


def measure(
    seconds: float,
    *,
    full: bool = False,
    network: bool = True,
    whole_run: bool = True,
    progress: Progress = lambda share, what: None,
) -> Report:
    """Poll for ``seconds``; over TCP too with ``network``; with ``whole_run``, carry out the short protocol."""
    with TemporaryDirectory(prefix="dea-rig-rates-") as name:
        folder = Path(name)
        path = folder / "scene.toml"
        path.write_text(scene_text(), encoding="utf-8")
        load_before = _load()
        on_tcp = folder / "network.toml"
        on_tcp.write_text(scene_text("analogue-amplifier", NETWORK_CHANGES), encoding="utf-8")
        share = 1.0 - RUN_SHARE if whole_run else 1.0
        first = share * (1.0 - NETWORK_SHARE)
        rows = [_drivers(path, seconds, lambda done: progress(first * done, DRIVERS))]
        if network:
            rows.append(_network(on_tcp, seconds, lambda done: progress(first + (share - first) * done, NETWORK)))
        if whole_run:
            hold_s = seconds if full else 0.0
            rows.append(_whole_run(folder, hold_s, lambda done: progress(share + RUN_SHARE * done, WHOLE_RUN)))
    environment = {
        "python": platform.python_version(),
        "system": platform.system(),
        "processors": str(os.cpu_count()),
        "load before": load_before,
        "load after": _load(),
    }
    return Report(full, rows, environment)


def save(report: Report, out_dir: Path) -> None:
    """Write the report as JSON and a picture."""
    out_dir.mkdir(parents=True, exist_ok=True)
    rows = [asdict(row) | {"used_of_allowed": row.used_of_allowed} for row in report.rows]
    for table in [*rows, *(polled for row in rows for polled in row["polled"])]:
        for key, value in table.items():
            if isinstance(value, float) and not math.isfinite(value):
                table[key] = None
    content = {
        "full": report.full,
        "allowed_share": ALLOWED_SHARE,
        "rows": rows,
        "environment": report.environment,
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    (out_dir / "rates.json").write_text(text + "\n", encoding="utf-8")
    _draw(report, out_dir / "rates.png")


# ---- the ways of working


def scene_text(name: str = "cone-4mm", changes: Mapping[str, str] = CHANGES) -> str:
    """The scene: that of the examples with a disk of 4 mm, at these rates."""
    fixtures = Path(str(files("sim_fixtures")))
    text = (fixtures / "scenes" / f"{name}.toml").read_text(encoding="utf-8")
    for old, new in ({**changes} | {"../calibrations": (fixtures / "calibrations").as_posix()}).items():
        if old not in text:
            raise ValueError(f"the example scene has no {old!r} any more")
        text = text.replace(old, new)
    return text


@dataclass(frozen=True)
class _Polling:
    """What came of polling a bench: force readings, and of each role how often it gave a sample."""

    seconds: float
    host_s: float
    simulator_s: float
    readings: list[float]
    polled: dict[str, Polled]
    believed_lost: int


def _poll(path: Path, seconds: float, rates: Mapping[str, float], progress: Callable[[float], None]) -> _Polling:
    """Poll the drivers of a scene, without its supply, in the engine's manner."""
    scene, _ = load_scene(path)
    readings: list[float] = []
    counts: dict[str, int] = {}
    with _simulator(path) as (simulator, ports), closing(open_bench(_without_hv(scene).with_ports(ports))) as bench:
        clock, devices = bench.clock, bench.devices
        bench.attach(lambda role, way, data, t: None)
        attention = Attention(bench)
        give_up = clock.now() + SETUP_LIMIT_S
        while not all(device.ready for device in devices.values()):
            _turn(bench, attention)
            if clock.now() > give_up:
                raise RigError(f"The simulated bench was not set up within {SETUP_LIMIT_S:.0f} s.")
        before = {role: dict(device.counters) for role, device in devices.items()}
        for device in devices.values():
            device.counters["round_trip_max_us"] = 0  # without those of the set-up
        begun, used, used_there = clock.now(), process_time(), _processor_time(simulator)
        next_progress = begun
        while clock.now() < begun + seconds:
            for role, sample in _turn(bench, attention):
                counts[role] = counts.get(role, 0) + 1
                if isinstance(sample, ForceSample):
                    readings.append(sample.reading)
            if clock.now() >= next_progress:
                next_progress += 0.2
                progress((clock.now() - begun) / seconds)
        elapsed = clock.now() - begun
        host, there = process_time() - used, _processor_time(simulator) - used_there
        polled = {
            role: _polled(role, wanted, counts.get(role, 0) / elapsed, devices[role], before[role])
            for role, wanted in rates.items()
        }
        lost = "lost_samples" if "lost_samples" in before["force"] else "polls_missed"
        believed = devices["force"].counters[lost] - before["force"][lost]
    return _Polling(elapsed, host, there, readings, polled, believed)


def _drivers(path: Path, seconds: float, progress: Callable[[float], None]) -> Row:
    scene, _ = load_scene(path)
    found = _poll(path, seconds, {"stage": STAGE_HZ, "displacement": LASER_HZ}, progress)
    return Row(
        DRIVERS,
        found.seconds,
        FORCE_HZ * found.seconds,
        len(found.readings),
        count_lost(found.readings, sent_readings(scene, found.seconds + SETUP_LIMIT_S), _noise(scene)),
        found.believed_lost,
        found.host_s / found.seconds,
        found.simulator_s / found.seconds,
        list(found.polled.values()),
    )


def _network(path: Path, seconds: float, progress: Callable[[float], None]) -> Row:
    """Nothing is lost on TCP: a question that could not be asked in time is what is missing."""
    found = _poll(path, seconds, NETWORK_HZ, progress)
    return Row(
        NETWORK,
        found.seconds,
        NETWORK_HZ["force"] * found.seconds,
        len(found.readings),
        found.polled["force"].missed,
        found.believed_lost,
        found.host_s / found.seconds,
        found.simulator_s / found.seconds,
        list(found.polled.values()),
    )


def _turn(bench: Bench, attention: Attention) -> list[tuple[str, Sample]]:
    """One turn as `rig.engine.engine.Engine` makes it, without what it does with the samples."""
    began = bench.clock.now()
    samples: list[tuple[str, Sample]] = []
    for role in attention.wanted(began):
        now = bench.clock.now()
        attention.polled(role, now)
        samples += [(role, sample) for sample in bench.poll(role, now)]
    due, awaited = attention.next()
    latest = began + LONGEST_TURN_S + attention.puts_off
    attention.wait(began + SHORTEST_TURN_S, min(max(due, began + SHORTEST_TURN_S), latest), awaited)
    return samples


def _polled(role: str, wanted: float, reached: float, device: Device, before: dict[str, int]) -> Polled:
    now = device.counters
    new = {key: now[key] - before[key] for key in ("round_trips", "round_trip_sum_us", "retries", "polls_missed")}
    mean = new["round_trip_sum_us"] / new["round_trips"] if new["round_trips"] else math.nan
    longest = now["round_trip_max_us"]
    return Polled(role, wanted, reached, 1e-3 * mean, 1e-3 * longest, new["retries"], new["polls_missed"])


def _whole_run(folder: Path, hold_s: float, progress: Callable[[float], None]) -> Row:
    """The short protocol with all links and high voltage; of it the last ``hold_s`` or, if that is 0, the whole."""
    path, protocol, log_path = folder / "whole.toml", folder / "protocol.toml", folder / "run.mcap"
    path.write_text(scene_text(changes=CHANGES | METER), encoding="utf-8")
    scene, _ = load_scene(path)
    short = (Path(str(files("sim_fixtures"))) / "protocols" / "short.toml").read_text(encoding="utf-8")
    protocol.write_text(short.replace(LAST_HOLD, LONG_HOLD.format(seconds=hold_s)) if hold_s else short, "utf-8")
    clock = RealClock()
    with _simulator(path) as (simulator, ports):
        marks: list[tuple[float, dict[str, float], float]] = []  # time, processor time here and there

        def note(done: float, total: float, label: str) -> None:
            if " hold: " in label or not hold_s:
                marks.append((clock.now(), _processor_times(), _processor_time(simulator)))
            progress(done / total)

        consent = Consent(arm="a benchmark", answers="a benchmark")
        run_experiment(prepare(path, protocol, ports), log_path, note, consent)
    (begun, before, there_before), (ended, after, there_after) = marks[0], marks[-1]
    elapsed = ended - begun
    shares = {who: (after[who] - before[who]) / elapsed for who in after if who in before}
    log = read_log(log_path)
    tables = log.tables(["/force/sample", "/stage/sample", "/displacement/sample", "/counter", "/phase"])
    of_hold = tables["/phase"]["t_s"][int(np.flatnonzero(tables["/phase"]["kind"] == "hold")[-1]) :]
    between = (float(of_hold[0]), float(of_hold[1])) if hold_s else (0.0, math.inf)
    t = tables["/force/sample"]["t_s"]
    gaps = np.round(np.diff(t) * FORCE_HZ) - 1
    readings = tables["/force/sample"]["reading"]
    lasted = float(t[-1] - t[0])
    return Row(
        WHOLE_RUN,
        elapsed,
        FORCE_HZ * lasted + 1,
        len(readings),
        count_lost(readings, sent_readings(scene, lasted + SETUP_LIMIT_S), _noise(scene)),
        int(gaps[gaps > 0].sum()) + sum(log.missing.get(f"/{role}/sample", 0) for role in ROLES),
        sum(shares.values()),
        (there_after - there_before) / elapsed,
        [
            _polled_in_log(tables, role, wanted, between)
            for role, wanted in (("stage", STAGE_HZ), ("displacement", LASER_HZ))
        ],
        shares,
    )


def _polled_in_log(
    tables: Mapping[str, Mapping[str, Any]], role: str, wanted: float, between: tuple[float, float]
) -> Polled:
    """Samples between two times; round trips and retries, as the driver has counted them, of the whole run."""
    counted = zip(*(tables["/counter"][key] for key in ("device", "name", "count")), strict=True)
    of_it = {name: int(count) for device, name, count in counted if device == role}
    t = tables[f"/{role}/sample"]["t_s"]
    t = t[(t >= between[0]) & (t <= between[1])]
    lasted, samples = float(t[-1] - t[0]), len(t) - 1
    mean_us = of_it["round_trip_sum_us"] / of_it["round_trips"]
    missed = max(round(lasted * wanted) - samples, 0)
    longest_us = of_it["round_trip_max_us"]
    return Polled(role, wanted, samples / lasted, 1e-3 * mean_us, 1e-3 * longest_us, of_it["retries"], missed)


def _processor_times() -> dict[str, float]:
    """Seconds of processor time of each process of a run; of the loop's own only where there is no ``/proc``."""
    times = {"loop": process_time()}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (folder / "cmdline").read_bytes().decode(errors="replace")
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            who = next((who for name, who in PROCESSES.items() if name in words), "")
            if who and int(parent) == os.getpid():
                times[who] = _processor_time(int(folder.name))
    return times


@contextmanager
def _simulator(scene: Path) -> Iterator[tuple[int, dict[str, dict[str, object]]]]:
    """``dea-rig sim`` as a process of its own: its number and its ports."""
    process = subprocess.Popen([sys.executable, "-m", "rig", "sim", str(scene)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise RigError("The simulated bench did not start; its own message stands above.")
        yield process.pid, json.loads(line)
    finally:
        process.terminate()
        process.communicate(timeout=10)


def _without_hv(scene: Scene) -> Scene:
    raw = scene.model_dump(exclude_none=True)
    del raw["hv"]
    for key in ("voltage_V", "current_uA", "field_V_per_um"):
        raw["limits"].pop(key, None)
    return validate(raw, Scene, "scene", "scene without high voltage")


def _processor_time(process: int) -> float:
    """Seconds of processor time of another process; NaN where the system has no ``/proc``."""
    stat = Path(f"/proc/{process}/stat")
    if not stat.exists():
        return math.nan
    fields = stat.read_text().rpartition(")")[2].split()  # the name before may hold blanks
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


# ---- counting by noise


def sent_readings(scene: Scene, seconds: float) -> Array:
    """What the simulated amplifier sends in its first ``seconds``, in mV/V, with nothing touching the film."""
    assert scene.simulation is not None
    bench = SimulatedBench(scene.simulation, scene.specimen.specimen(), {"force"})
    wire = bench.wire("force")
    assert isinstance(wire, ByteWire)
    assert isinstance(scene.force, GSV8Settings)
    decoder = Decoder()
    found: list[float] = []
    for i in range(1, math.ceil(seconds / 0.1) + 1):
        bench.advance(0.1 * i)
        for frame in decoder.feed(wire.host_read(0.1 * i)):
            assert isinstance(frame, Measured)
            found.append(frame.values[scene.force.channel - 1])
    return np.array(found)


def _noise(scene: Scene) -> float:
    """Standard deviation of the noise, mV/V."""
    assert scene.simulation is not None
    truth = scene.simulation.force
    assert isinstance(truth, GSV8Truth)
    return truth.noise_fraction * truth.sensitivity_mV_per_V


def count_lost(received: Sequence[float] | Array, sent: Array, noise: float) -> int:
    """Samples of ``sent`` that are missing in ``received`` between its first and its last.

    ``received`` may have any slowly changing force added to it. With ``r`` and ``s`` the steps between neighbours, the
    place of ``received[i]`` in ``sent`` is the ``j`` for which ``r[i..] - s[j..]`` is small, `TELLING` steps long.

    Raises
    ------
    ValueError
        The readings are not those that were sent.
    """
    r, s = np.diff(received), np.diff(sent)
    if len(r) < TELLING:
        raise ValueError(f"{len(r) + 1} readings are too few to be recognised")
    i, place = _next_match(r, s, noise)
    first = place - i
    while True:
        n = min(len(r) - i, len(s) - place)
        wrong = np.flatnonzero(np.abs(r[i : i + n] - s[place : place + n]) > SAME * noise)
        if wrong.size == 0:
            break
        # The step into a reading is not the one that was sent: something is missing before it. Go on from there.
        i, place = i + int(wrong[0]) + 1, place + int(wrong[0]) + 1
        if len(r) - i < TELLING:
            break
        skipped, ahead = _next_match(r[i:], s[place:], noise)
        if ahead < skipped:
            raise ValueError("readings were received that the amplifier did not send in this order")
        i, place = i + skipped, place + ahead
    if len(r) - i > len(s) - place:
        raise ValueError("more readings were received than sent")
    return place - i - first


def _next_match(r: Array, s: Array, noise: float) -> tuple[int, int]:
    """The first place in ``r`` from which `TELLING` steps stand somewhere in ``s``, and where."""
    if len(s) >= TELLING:
        windows = np.lib.stride_tricks.sliding_window_view(s, TELLING)
        for i in range(min(len(r) - TELLING + 1, MOST_SKIPPED)):
            fits = np.flatnonzero(np.all(np.abs(windows - r[i : i + TELLING]) <= SAME * noise, axis=1))
            if fits.size:
                return i, int(fits[0])
    raise ValueError("readings were received that the amplifier did not send in this order")


# ---- showing


def render(report: Report) -> RenderableType:
    """Tables for the terminal."""
    from rich.console import Group
    from rich.table import Table

    force = Table(
        title=f"Force at {FORCE_HZ:.0f} Hz over a pseudo-terminal, stage and laser polled beside it; and over TCP",
        caption="Lost: counted by the simulator's own noise; over TCP, questions that could not be asked in time. "
        "Believed lost: room that the time stamps leave. "
        f"Used/allowed: of {ALLOWED_SHARE:.0%} of a core.",
    )
    for heading in ("", "s", "expected", "received", "lost", "believed lost", "host", "simulator", "used/allowed"):
        force.add_column(heading, justify="right" if heading else "left")
    for row in report.rows:
        force.add_row(
            row.what,
            f"{row.seconds:.1f}",
            f"{row.expected:.0f}",
            str(row.received),
            str(row.lost),
            str(row.believed_lost),
            f"{row.host_share:.1%}",
            f"{row.simulator_share:.1%}" if math.isfinite(row.simulator_share) else "unknown",
            f"{row.used_of_allowed:.2f}",
        )
    polled = Table(title="Polled instruments")
    for heading in ("", "", "wanted / Hz", "reached / Hz", "round trip / ms", "longest / ms", "retries", "missed"):
        polled.add_column(heading, justify="right" if heading else "left")
    for row in report.rows:
        for p in row.polled:
            times = p.round_trip_mean_ms, p.round_trip_max_ms
            measured = math.isfinite(p.round_trip_mean_ms)
            polled.add_row(
                row.what if p is row.polled[0] else "",
                p.role,
                f"{p.wanted_Hz:g}",
                f"{p.reached_Hz:.2f}",
                *(f"{time:.1f}" if measured else "" for time in times),
                *(str(number) if measured else "" for number in (p.retries, p.missed)),
            )
    setting = ", ".join(f"{name} {value}" for name, value in report.environment.items())
    processes = [
        f"{row.what}: {', '.join(f'{who} {share:.1%}' for who, share in row.shares.items())} of a core."
        for row in report.rows
        if row.shares
    ]
    return Group(force, polled, *processes, f"Measured on: {setting}.")


def _draw(report: Report, path: Path) -> None:
    """Shares of a core, one pair of bars a row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 1.6 + 0.7 * len(report.rows)), layout="constrained")
    axes = figure.subplots()
    rows = report.rows[::-1]
    for offset, colour, who, shares in (
        (0.19, "#0072B2", "host", [row.host_share for row in rows]),
        (-0.19, "#999999", "simulated bench", [row.simulator_share for row in rows]),
    ):
        at = np.arange(len(rows)) + offset
        percent = 100 * np.nan_to_num(np.array(shares))
        axes.barh(at, percent, height=0.36, color=colour, label=who)
        for y, x in zip(at, percent, strict=True):
            axes.text(x + 0.3, y, f"{x:.1f} %", va="center", fontsize=9)
    axes.axvline(100 * ALLOWED_SHARE, color="#D55E00", linestyle="--", label="allowed for the host")
    labels = [f"{row.what}\n{row.lost} of {row.received + row.lost} samples lost" for row in rows]
    axes.set_yticks(range(len(rows)), labels)
    axes.set_xlabel("processor time / % of a core")
    axes.set_title(
        f"Force at {FORCE_HZ:.0f} Hz, stage at {STAGE_HZ:.0f} Hz, laser at {LASER_HZ:.0f} Hz over serial ports"
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
