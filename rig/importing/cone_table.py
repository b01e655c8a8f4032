"""Tables of a rig -> force-displacement curves of a cone: sweeps, voltages, noise; checked against the cone itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.specimen import Specimen
from rig.importing.branches import Leg, legs_of, noise_of, repeated_rows
from rig.importing.columns import Chooser, Chosen, Part, read_columns
from rig.importing.cone_checks import LEAST_VOLTAGE, usable
from rig.importing.findings import Finding, refuse
from rig.importing.options import ImportOptions
from rig.importing.source import Piece, Source, open_source
from rig.importing.stated_voltage import ask_for_other, said_of, shared_out
from rig.importing.table import LeftOut
from rig.importing.understood import Understood

Array = NDArray[np.float64]

WANTED = ("displacement", "force", "voltage")
LEVEL_V, LEVEL_PART = 20.0, 0.02  # by which voltages of one level may differ
ALLOWED_V, ALLOWED_PART = 50.0, 0.05  # by which a sample of a sweep may be off its level
SWEEPS_DIFFER = 0.05  # of the largest force: sweeps at one voltage that differ by more are not of one state
REST = 5.0  # times its noise: the disk is at rest
MOST_SWEEPS = 200
# What is not stated (standard uncertainties). Cells and amplifiers of class 0.5; lasers, and monitors of supplies.
FORCE_GAIN = 0.005  # gains of displacement and voltage are assumed by the curve
FORCE_ZERO, DISPLACEMENT_ZERO = 0.01, 2e-5  # of the largest force; m: where the disk touches the film


@dataclass(frozen=True)
class ConeTable:
    """Curves of all files, what was understood of each, and the SI columns of the rows that are used, by file."""

    curves: list[Curve]
    understood: list[Understood]
    tidy: list[dict[str, Array]]


@dataclass(frozen=True)
class Sweep:
    """Rows of one way out and back at one voltage level (V)."""

    rows: NDArray[np.intp]
    direction: NDArray[np.int8]
    voltage: float


@dataclass
class Run:
    """A piece of a table that is displacement and force of this cone, with its ways out and back.

    ``stated`` are the voltages (V) of the sweeps where they are said and not measured; ``part`` may then have no column
    of them.
    """

    source: Source
    piece: Piece
    name: str
    part: Part
    pairs: list[list[Leg]]
    stated: list[float] | None = None


def read_cone_tables(paths: Sequence[Path], specimen: Specimen, options: ImportOptions | None = None) -> ConeTable:
    """Read force-displacement curves of a cone from tables of any layout.

    Parameters
    ----------
    specimen : model.specimen.Specimen
        The film and its cone as believed; its material only says what forces are plausible.

    Raises
    ------
    ImportRefused
        With every obstacle of every file, and the option that removes it.
    """
    sources = [open_source(path, options or ImportOptions()) for path in paths]
    runs = [run for source in sources for run in _runs_of(source, specimen)]
    _share_out(runs)
    curves: list[Curve] = []
    tidy: list[dict[str, Array]] = []
    for source in sources:
        found = [_curves_of(run, specimen) for run in runs if run.source is source]
        curves += [curve for ours, _ in found for curve in ours]
        tidy += _together([columns for _, columns in found])
    findings = [one for source in sources for one in source.findings.all]
    findings += _same_data(curves)
    understood = [source.understood for source in sources]
    refuse(findings, [line for one in understood for line in one.lines()])
    return ConeTable(curves, understood, tidy)


def _same_data(curves: Sequence[Curve]) -> list[Finding]:
    found = []
    for one, other in combinations(curves, 2):
        if one.h.size == other.h.size and np.array_equal(one.h, other.h) and np.array_equal(one.force, other.force):
            what = f"{other.label} holds the same data; given twice they would count as if they had been measured twice"
            found.append(Finding("obstacle", "twice", one.label, what, "leave one of them out"))
    return found


def _runs_of(source: Source, specimen: Specimen) -> list[Run]:
    """The pieces of one file, as far as they can be displacement and force of this cone."""
    runs = []
    for number, piece in enumerate(source.pieces):
        part = _read(source, piece, first=number == 0)
        if part is None:
            continue
        name = source.path.name
        if len(source.pieces) > 1:
            name += f", {piece.label or f'part {number + 1}'}"
        part = _turned(part, source, first=number == 0)
        if usable(name, part, source, specimen):
            run = Run(source, piece, name, part, _pairs(name, part, source))
            said = None if source.options.voltage or "voltage" in part.values else said_of(source, piece)
            if said is not None:
                run.stated = [said[0]] * len(run.pairs)
                source.findings.note("voltage", f"{name}: {said[0]:g} V ({said[1]})", "--voltage 0,1000,1500")
            runs.append(run)
    return runs


def _share_out(runs: Sequence[Run]) -> None:
    """Give the voltages of the option to the sweeps: of each file where that comes out even, else of all of them."""
    asked = [run for run in runs if run.source.options.voltage]
    by_file = [
        [run for run in asked if run.source is source] for source in {id(r.source): r.source for r in asked}.values()
    ]
    even = all(shared_out(own[0].source.options.voltage, [len(run.pairs) for run in own]) for own in by_file)
    for own in by_file if even else [asked] if asked else []:
        stated, counts = own[0].source.options.voltage, [len(run.pairs) for run in own]
        shares = shared_out(stated, counts)
        if shares is None:
            ask_for_other(stated, counts, own[0].source.findings)
        if 0.0 < max(map(abs, stated)) < LEAST_VOLTAGE:
            own[0].source.findings.warning(
                "voltage",
                f"the highest voltage stated is {max(map(abs, stated)):g} V, which bends no film",
                "--voltage in V, not kV",
            )
        for run, share in zip(own, shares or [[] for _ in own], strict=True):
            run.stated = share


def _together(tables: Sequence[dict[str, Array]]) -> list[dict[str, Array]]:
    """The columns of the runs of one file, one below the other; time that begins again is left out."""
    if len(tables) <= 1:
        return list(tables)
    names = [name for name in tables[0] if name != "time" and all(name in table for table in tables)]
    return [{name: np.concatenate([table[name] for table in tables]) for name in names}]


def _curves_of(run: Run, specimen: Specimen) -> tuple[list[Curve], dict[str, Array]]:
    source, part = run.source, run.part
    sweeps = _sweeps(run)
    noise = _noises(part)
    found = [_curve(run.name, k, sweep, part, specimen, noise) for k, sweep in enumerate(sweeps)]
    found = _with_known_voltage(run, found)
    rows = [sweep.rows for sweep, _ in zip(sweeps, found, strict=False)]
    used = np.sort(np.concatenate(rows)) if rows else np.zeros(0, np.intp)
    source.understood.rows_kept.append(int(used.size))
    spare = np.setdiff1d(np.arange(part.lines.size), used)
    source.understood.leave_out(
        [LeftOut(int(part.lines[k]), "at rest, or while the voltage changes", "") for k in spare]
    )
    source.understood.parts += [_described(curve) for curve in found]
    return found, {quantity: column[used] for quantity, column in part.values.items()}


def _described(curve: Curve) -> str:
    ways = [word for word, sign in (("out", 1), ("back", -1), ("held", 0)) if (curve.direction == sign).any()]
    return (
        f"{curve.label}: {curve.h.size} rows ({' and '.join(ways)}), displacement to {1e3 * curve.h.max():.4g} mm, "
        f"force to {curve.force.max():.4g} N, noise {curve.force_noise:.2g} N and "
        f"{1e6 * curve.displacement_noise:.2g} um"
    )


# --- columns


def _read(source: Source, piece: Piece, *, first: bool) -> Part | None:
    table, findings = source.table, source.findings
    assert table is not None
    chooser = Chooser(table, piece.group, source.options, findings)
    chosen: list[Chosen] = []
    before = len(findings.of("obstacle"))
    for quantity in WANTED:
        one = chooser.choose(quantity)
        if one is not None:
            chosen.append(one)
        elif not chooser.candidates(quantity) and not (
            quantity == "voltage" and (source.options.voltage or said_of(source, piece))
        ):
            _ask(quantity, chooser)
    time = chooser.choose("time") if chooser.candidates("time") else None
    if time is not None:
        clock = ":" in piece.section.rows[0][time.index]
        if not time.unit.name and not clock:
            findings.warning("time", f"{time.name} has no unit; time is not used", "--unit time=s")
            time = None
        else:
            chosen.append(replace(time, unit=replace(time.unit, name="time of day")) if clock else time)
    if len(findings.of("obstacle")) > before or not {"displacement", "force"} <= {one.quantity for one in chosen}:
        return None
    part, left_out = read_columns(table, piece.section, chosen, piece.label, source.options, findings)
    source.understood.leave_out(left_out)
    if len(findings.of("obstacle")) > before:
        return None
    values = dict(part.values)
    if time is not None and "time" in values and values["time"].size:
        values["time"] = (
            _rising(values["time"], part, source) if np.isfinite(values["time"]).all() else values.pop("time")
        )
    source.understood.take(chosen)
    return replace(part, values=values)


def _ask(quantity: str, chooser: Chooser) -> None:
    table = chooser.table
    heading = "there is no heading" if table.heading_line is None else f"the columns are {chooser.listing()}"
    option = f"--column {quantity}=NUMBER"
    if quantity == "voltage":
        option += ", or --voltage 0 where there was none, or --voltage 0,1000,1500 for one voltage a sweep"
    elif table.heading_line is None:
        option += f" --unit {quantity}={'mm' if quantity == 'displacement' else 'N'}"
    chooser.findings.obstacle(
        "columns", f"no column of {quantity} was found; {heading}", option, line=table.heading_line
    )


def _rising(time: Array, part: Part, source: Source) -> Array:
    """Time that begins again is taken as following on: the sweeps were written one below the other."""
    back = np.flatnonzero(np.diff(time) < 0.0)
    if back.size:
        source.findings.warning(
            "time",
            f"time begins again {back.size} times; what follows is taken as later",
            "--column time=NUMBER",
            line=int(part.lines[back[0] + 1]),
        )
        usual = float(np.median(np.diff(time)[np.diff(time) > 0.0])) if (np.diff(time) > 0.0).any() else 1.0
        shift = np.zeros(time.size)
        for k in back:
            shift[k + 1 :] += time[k] - time[k + 1] + usual
        time = time + shift
    return time


def _turned(part: Part, source: Source, *, first: bool) -> Part:
    """Displacement counted outwards and force as pull, whatever the sensors count; what is reversed is said."""
    values, options = dict(part.values), source.options
    h, force = values["displacement"], values["force"]
    if h.size < 3:
        return part
    turned = []
    if "displacement" not in options.sign and abs(h.min()) > 2.0 * abs(h.max()) and np.median(h) < 0.0:
        values["displacement"] = h = -h
        turned.append("displacement")
    far = h > 0.5 * h.max()
    if (
        "force" not in options.sign
        and far.any()
        and np.median(force[far]) < 0.0
        and abs(force.min()) > 2.0 * abs(force.max())
    ):
        values["force"] = -force
        turned.append("force")
    if "voltage" in values and "voltage" not in options.sign and values["voltage"].min() < -LEVEL_V:
        values["voltage"] = np.abs(values["voltage"])
        if first:
            source.findings.note("sign", "the voltage is negative; its size is used, for the force goes by its square")
    for quantity in turned:
        if first:
            source.findings.note(
                "sign",
                f"sign of the {quantity} is reversed: a film pulls back wherever it is pushed to",
                f"--sign {quantity}=+ ",
            )
            for index, words in source.understood.use.items():
                if words.startswith(f"{quantity} "):
                    source.understood.use[index] = f"{words}, sign reversed"
    return replace(part, values=values)


# --- sweeps


def _pairs(name: str, part: Part, source: Source) -> list[list[Leg]]:
    """Ways out, each with the way back that follows, as far as they are asked for."""
    h = part.values["displacement"]
    legs = legs_of(h)
    if len(legs) > 2 * MOST_SWEEPS:
        source.findings.obstacle(
            "sweeps",
            f"{name}: {len(legs)} changes of direction were counted; at most {2 * MOST_SWEEPS} are read",
            "--rows FIRST-LAST",
        )
        return []
    pairs = _out_and_back(legs)
    if source.options.branch == "first-loading":
        one_voltage = not np.ptp(part.values.get("voltage", h[:1])) > LEVEL_V
        return [pair[:1] for pair in (pairs[:1] if one_voltage else pairs)]
    return pairs


def _sweeps(run: Run) -> list[Sweep]:
    """Ways out and back, each at one voltage."""
    part, pairs, findings = run.part, run.pairs, run.source.findings
    values = part.values
    h = values["displacement"]
    noise = noise_of(h)
    same = repeated_rows(h, values["force"], *(values[name] for name in ("voltage", "time") if name in values))
    if same.sum() > 0.2 * same.size:
        findings.warning(
            "repeated", f"{run.name}: {int(same.sum())} rows repeat the row before them; they are left out"
        )
    if run.stated is not None:
        levels, voltage = run.stated, values.setdefault("voltage", np.zeros(h.size))
    else:
        voltage = values["voltage"]
        levels = [_level(voltage, pair, h) for pair in pairs]
        pairs = _parted_by_voltage(pairs, levels, voltage)
    branch = run.source.options.branch
    sweeps = []
    rest = REST * noise + 1e-3 * float(np.ptp(h))
    for pair, level in zip(pairs, levels, strict=False):
        rows = np.concatenate([_moving(h, leg, rest) for leg in pair])
        direction = np.concatenate([_direction(h, _moving(h, leg, rest), leg, noise) for leg in pair])
        keep = ~same[rows] if same.sum() > 0.2 * same.size else np.ones(rows.size, dtype=np.bool_)
        if branch in ("loading", "unloading"):
            keep &= direction == (1 if branch == "loading" else -1)
        if run.stated is None:
            keep &= _at_level(run, rows, voltage, level)
        if keep.sum() >= 3:
            sweeps.append(Sweep(rows[keep], direction[keep], level))
    if run.stated is None:
        return _common_levels(sweeps)
    for sweep in sweeps:
        voltage[sweep.rows] = sweep.voltage
    return sweeps


def _at_level(run: Run, rows: NDArray[np.intp], voltage: Array, level: float) -> NDArray[np.bool_]:
    """Rows at the voltage of their sweep; a sweep on which it changes throughout is refused."""
    off = np.abs(voltage[rows] - level) > max(ALLOWED_V, ALLOWED_PART * abs(level))
    if off.sum() > 0.3 * off.size:
        run.source.findings.obstacle(
            "voltage",
            f"{run.name}: the voltage changes during the sweep that begins here ({voltage[rows].min():.4g} "
            f"to {voltage[rows].max():.4g} V)",
            "--rows FIRST-LAST keeps sweeps at one voltage",
            line=int(run.part.lines[rows[0]]),
        )
    return np.asarray(~off)


def _out_and_back(legs: Sequence[Leg]) -> list[list[Leg]]:
    """Each way out with the way back that follows it."""
    pairs: list[list[Leg]] = []
    for leg in legs:
        if leg.direction > 0 or not pairs or len(pairs[-1]) == 2:
            pairs.append([leg])
        else:
            pairs[-1].append(leg)
    return pairs


def _parted_by_voltage(pairs: list[list[Leg]], levels: Sequence[float], voltage: Array) -> list[list[Leg]]:
    """The sweeps with rows at the end of one that have the voltage of the next given to the next.

    At rest the lowest reading is a matter of noise, and the voltage tells which sweep a row belongs to.
    """
    for before, after, old, new in zip(pairs[:-1], pairs[1:], levels[:-1], levels[1:], strict=True):
        edge = before[-1].stop
        while edge - 3 > before[-1].start and abs(voltage[edge - 1] - new) < abs(voltage[edge - 1] - old):
            edge -= 1
        before[-1] = replace(before[-1], stop=edge)
        after[0] = replace(after[0], start=edge)
    return pairs


def _moving(h: Array, leg: Leg, rest: float) -> NDArray[np.intp]:
    """Rows of a leg without those at its lower end at which the disk waits; the last of them before a way out, and the
    first after a way back, are its ends and stay. Waiting at the upper end is data: the film relaxes there.
    """
    rows = np.arange(leg.start, leg.stop)
    low = h[rows] <= float(h[rows].min()) + rest
    if leg.direction > 0:
        waiting = int(np.argmin(low)) if not low.all() else rows.size
        return rows[waiting - 1 :] if waiting > 2 else rows
    waiting = int(np.argmin(low[::-1])) if not low.all() else rows.size
    return rows[: rows.size - waiting + 1] if waiting > 2 else rows


def _direction(h: Array, rows: NDArray[np.intp], leg: Leg, noise: float) -> NDArray[np.int8]:
    """+1 out, -1 back, 0 where the disk is held: it moves by less than a fifth of the mean of the leg."""
    direction = np.full(rows.size, leg.direction, dtype=np.int8)
    if rows.size < 20:
        return direction
    mean = float(np.ptp(h[rows])) / rows.size
    w = int(np.clip(np.ceil(12.0 * noise / max(mean, 1e-30)), 3, rows.size // 4))
    moved = np.abs(h[rows][2 * w :] - h[rows][: -2 * w])
    held = np.zeros(rows.size, dtype=np.bool_)
    held[w:-w] = moved < 0.2 * 2 * w * mean
    direction[held] = 0
    return direction


def _level(voltage: Array, pair: Sequence[Leg], h: Array) -> float:
    """The voltage of a sweep: its median while the disk is away from rest."""
    rows = np.concatenate([np.arange(leg.start, leg.stop) for leg in pair])
    away = h[rows] > h[rows].min() + 0.2 * np.ptp(h[rows])
    return float(np.median(voltage[rows][away])) if away.any() else float(np.median(voltage[rows]))


def _common_levels(sweeps: Sequence[Sweep]) -> list[Sweep]:
    """One nominal voltage for the sweeps of one level; a supply that is off shows a few volts."""
    order = np.argsort([sweep.voltage for sweep in sweeps])
    groups: list[list[int]] = []
    for k in order.tolist():
        value = sweeps[k].voltage
        if groups and abs(value - sweeps[groups[-1][-1]].voltage) <= max(LEVEL_V, LEVEL_PART * abs(value)):
            groups[-1].append(k)
        else:
            groups.append([k])
    levelled = list(sweeps)
    largest = max((abs(sweep.voltage) for sweep in sweeps), default=0.0)
    for group in groups:
        level = float(np.median([sweeps[k].voltage for k in group]))
        level = 0.0 if abs(level) < min(LEVEL_V, 0.02 * largest) else round(level, 1)
        for k in group:
            levelled[k] = replace(sweeps[k], voltage=level)
    return levelled


def _with_known_voltage(run: Run, curves: list[Curve]) -> list[Curve]:
    """Where the voltage reads zero throughout and sweeps differ, only the first can be said to be at 0 V."""
    name, part, findings = run.name, run.part, run.source.findings
    if not curves or run.stated is not None or float(np.abs(part.values["voltage"]).max()) > LEVEL_V:
        return curves
    largest = max(float(curve.force.max()) for curve in curves)
    highest = float(np.abs(part.values["voltage"]).max())
    read = "zero" if highest == 0.0 else f"at most {highest:.3g} V"
    differ = max((_difference(curves[0], curve) for curve in curves[1:]), default=0.0)
    if differ > SWEEPS_DIFFER * largest:
        findings.warning(
            "voltage",
            f"{name}: the voltage is {read} throughout, and the sweeps differ by {differ / largest:.0%} of the "
            f"largest force: was the "
            "monitor not connected, or does the film soften? Only the first sweep is used; no permittivity",
            "--voltage 0,1000,1500 states the voltage of each sweep in turn",
        )
        return curves[:1]
    findings.warning(
        "voltage",
        f"{name}: the voltage is {read} throughout; no permittivity can be found",
        "--voltage 0,1000,1500 states the voltage of each sweep in turn",
    )
    return curves


def _difference(one: Curve, other: Curve) -> float:
    """Largest difference of force between two curves on the way out, at the same displacements."""
    a, b = (curve.direction == 1 for curve in (one, other))
    if a.sum() < 3 or b.sum() < 3:
        return 0.0
    order = np.argsort(other.h[b])
    x, y = other.h[b][order], other.force[b][order]
    grid = np.linspace(max(x[0], one.h[a].min()), min(x[-1], one.h[a].max()), 20)
    mine = np.argsort(one.h[a])
    return float(np.abs(np.interp(grid, one.h[a][mine], one.force[a][mine]) - np.interp(grid, x, y)).max())


def _noises(part: Part) -> tuple[float, float]:
    """Standard deviation of one sample of force (N) and displacement (m): scatter, or what the digits leave open."""
    h, force = part.values["displacement"], part.values["force"]
    least = 1e-9 * float(np.abs(force).max())
    return max(noise_of(force), 0.3 * _resolution(force), least), max(noise_of(h), 0.3 * _resolution(h))


def _curve(name: str, number: int, sweep: Sweep, part: Part, specimen: Specimen, noise: tuple[float, float]) -> Curve:
    values, rows = part.values, sweep.rows
    h, force = values["displacement"], values["force"]
    label = f"{name}, sweep {number + 1}, {sweep.voltage:g} V"
    return Curve(
        label=label,
        run=name,
        specimen=specimen,
        h=h[rows],
        force=force[rows],
        voltage=values["voltage"][rows],
        nominal_voltage=sweep.voltage,
        direction=sweep.direction,
        force_noise=noise[0],
        displacement_noise=noise[1],
        force_gain=FORCE_GAIN,
        force_zero=FORCE_ZERO * float(np.abs(force).max()),
        displacement_zero=DISPLACEMENT_ZERO,
        time=values["time"][rows] if "time" in values else None,
    )


def _resolution(values: Array) -> float:
    """Smallest step between different values; 0 where all are alike."""
    steps = np.diff(np.unique(values))
    return float(np.median(steps[steps <= np.quantile(steps, 0.1)])) if steps.size > 3 else 0.0
