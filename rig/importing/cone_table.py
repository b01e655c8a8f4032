"""Tables of a rig -> force-displacement curves of a cone: sweeps, voltages, noise; checked against the cone itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from model.membrane.solve import solve
from model.specimen import Specimen
from rig.importing.branches import Leg, jumps_of, legs_of, noise_of, repeated_rows, steps_of
from rig.importing.columns import Chooser, Chosen, Part, read_columns
from rig.importing.findings import Finding, Findings, refuse
from rig.importing.options import ImportOptions
from rig.importing.source import Piece, Source, open_source
from rig.importing.table import LeftOut
from rig.importing.understood import Understood

Array = NDArray[np.float64]

WANTED = ("displacement", "force", "voltage")
IMPLAUSIBLE = 20.0  # factor between the measured force and that of the cone as believed
LEAST_VOLTAGE = 50.0  # V; less bends no film
NO_REST = 0.1  # of the largest displacement or force: what begins at more does not begin at zero
MOST_FIELD = 1e9  # V/m, of the undeformed film; elastomers break down at a tenth of it
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
    curves: list[Curve] = []
    understood: list[Understood] = []
    tidy: list[dict[str, Array]] = []
    findings: list[Finding] = []
    for path in paths:
        source = open_source(path, options or ImportOptions())
        found, columns = _curves_of(source, specimen)
        curves += found
        tidy += columns
        understood.append(source.understood)
        findings += source.findings.all
    findings += _same_data(curves)
    refuse(findings, [line for one in understood for line in one.lines()])
    return ConeTable(curves, understood, tidy)


def _same_data(curves: Sequence[Curve]) -> list[Finding]:
    found = []
    for one, other in combinations(curves, 2):
        if one.h.size == other.h.size and np.array_equal(one.h, other.h) and np.array_equal(one.force, other.force):
            what = f"{other.label} holds the same data; given twice they would count as if they had been measured twice"
            found.append(Finding("obstacle", "twice", one.label, what, "leave one of them out"))
    return found


def _curves_of(source: Source, specimen: Specimen) -> tuple[list[Curve], list[dict[str, Array]]]:
    curves: list[Curve] = []
    tidy: list[dict[str, Array]] = []
    for number, piece in enumerate(source.pieces):
        part = _read(source, piece, first=number == 0)
        if part is None:
            continue
        name = (
            source.path.name
            if len(source.pieces) == 1
            else f"{source.path.name}, {piece.label or f'part {number + 1}'}"
        )
        part = _turned(part, source, first=number == 0)
        if not _usable(name, part, source, specimen):
            continue
        sweeps = _sweeps(name, part, source)
        noise = _noises(part)
        found = [_curve(name, k, sweep, part, specimen, noise) for k, sweep in enumerate(sweeps)]
        found = _with_known_voltage(name, found, part, sweeps, source)
        used = (
            np.sort(np.concatenate([sweep.rows for sweep, curve in zip(sweeps, found, strict=False)]))
            if found
            else np.zeros(0, np.intp)
        )
        tidy.append({quantity: column[used] for quantity, column in part.values.items()})
        curves += found
        source.understood.rows_kept.append(int(used.size))
        spare = np.setdiff1d(np.arange(part.lines.size), used)
        source.understood.leave_out(
            [LeftOut(int(part.lines[k]), "at rest, or while the voltage changes", "") for k in spare]
        )
        source.understood.parts += [_described(curve) for curve in found]
    return curves, tidy


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
        elif quantity == "voltage" and source.options.voltage and not chooser.candidates(quantity):
            continue
        elif not chooser.candidates(quantity):
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
    if "voltage" not in values:
        values["voltage"] = np.zeros(part.lines.size)
    if first:
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
    if "voltage" not in options.sign and values["voltage"].min() < -LEVEL_V:
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


# --- checks


def _usable(name: str, part: Part, source: Source, specimen: Specimen) -> bool:
    """Refuse what cannot be the displacement and force of this cone."""
    findings, values = source.findings, part.values
    h, force, voltage = values["displacement"], values["force"], values["voltage"]
    before = len(findings.of("obstacle"))
    if h.size < 5:
        findings.obstacle(
            "rows",
            f"{name}: {h.size} rows with displacement and force are left; at least 5 are needed",
            "--rows FIRST-LAST",
        )
        return False
    for quantity, column in (("displacement", h), ("force", force)):
        if not np.ptp(column) > 0.0:
            findings.obstacle(
                "constant",
                f"{name}: the {quantity} is {column[0]:g} throughout; nothing varies",
                f"--column {quantity}=NUMBER",
            )
    if len(findings.of("obstacle")) > before:
        return False
    for k in jumps_of(h, force)[:3]:
        findings.obstacle(
            "jump",
            f"{name}: the displacement jumps from {1e3 * h[k - 1]:.4g} mm to {1e3 * h[k]:.4g} mm while the "
            f"force goes on "
            f"({force[k - 1]:.4g} N, {force[k]:.4g} N): was the sensor set to zero",
            f"--rows {part.lines[0]}-{part.lines[k - 1]} keeps the rows before",
            line=int(part.lines[k]),
        )
    for k in steps_of(force, h)[:3]:
        if abs(voltage[k] - voltage[k - 1]) < 0.1 * max(1.0, float(np.abs(voltage).max())):
            findings.obstacle(
                "jump",
                f"{name}: the force jumps from {force[k - 1]:.4g} N to {force[k]:.4g} N while the displacement "
                f"goes on: was the load cell tared, or did the film break",
                f"--rows {part.lines[0]}-{part.lines[k - 1]} keeps the rows before",
                line=int(part.lines[k]),
            )
    _against_the_cone(name, h, force, specimen, source)
    largest = float(np.abs(voltage).max())
    if 0.0 < largest < LEAST_VOLTAGE:
        findings.warning(
            "voltage",
            f"{name}: the highest voltage is {largest:.4g} V, which bends no film: is the unit kV",
            "--unit voltage=kV",
        )
    _at_rest(name, h, force, findings)
    field = largest / specimen.thickness
    if field > MOST_FIELD:
        findings.obstacle(
            "implausible",
            f"{name}: the highest voltage is {largest:.4g} V, {1e-6 * field:.3g} V/um across this film before it is "
            "stretched, which no film stands: check the unit",
            "--unit voltage=V",
            line=source.understood.unit_line or source.understood.heading_line,
        )
    return len(findings.of("obstacle")) == before


def _at_rest(name: str, h: Array, force: Array, findings: Findings) -> None:
    """Tell of displacement and force that do not begin at zero."""
    far, low = float(h.max()), float(h.min())
    if low > NO_REST * far:
        findings.warning(
            "zero",
            f"{name}: the displacement begins at {1e3 * low:.4g} mm; it has to be counted from where the disk touches "
            "the film",
            "--zero displacement=first",
        )
        return
    rest = float(np.median(force[h < low + 0.02 * (far - low)]))
    if abs(rest) > NO_REST * float(np.abs(force).max()):
        findings.warning(
            "zero",
            f"{name}: the force is {rest:.3g} N where the displacement begins: was it set to zero",
            "--zero force=first",
        )


def _against_the_cone(name: str, h: Array, force: Array, specimen: Specimen, source: Source) -> None:
    """Hold the largest force against that of the cone as believed; a factor above 20 is no matter of the material."""
    k = int(h.argmax())
    measured = float(np.median(force[np.argsort(h)[-max(3, h.size // 100) :]]))
    gap = specimen.ring_radius - specimen.disk_radius
    expected = _model_force(specimen, float(h[k]))
    ratio = measured / expected if expected and expected > 0.0 else float("nan")
    swapped = _model_force(specimen, float(force.max()) * 1e-3)  # as if its numbers were mm, and those of h N
    if 1.0 / IMPLAUSIBLE < ratio < IMPLAUSIBLE and h[k] < 5.0 * gap:
        return
    told = f"{expected:.3g} N" if expected else "no force that can be computed"
    looks_swapped = swapped is not None and 1.0 / IMPLAUSIBLE < float(h.max()) * 1e3 / max(swapped, 1e-30) < IMPLAUSIBLE
    source.findings.obstacle(
        "implausible",
        f"{name}: displacement {1e3 * h[k]:.4g} mm with force {measured:.4g} N is implausible for this cone, "
        f"for which {told} "
        f"is expected"
        + (f" (a film {ratio:.3g} times as stiff as believed)" if np.isfinite(ratio) else "")
        + (
            ": displacement and force look exchanged"
            if looks_swapped
            else ": check the units and whether columns are exchanged"
        ),
        "--column displacement=NUMBER --column force=NUMBER, or --unit displacement=UNIT --unit force=UNIT",
        line=source.understood.heading_line,
    )


def _model_force(specimen: Specimen, h: float) -> float | None:
    """Force (N) of the cone as believed at 0 V; None where there is none."""
    if not 0.0 < h < 20.0 * specimen.ring_radius:
        return None
    found = float(solve(specimen, h, 0.0).force)
    return found if np.isfinite(found) else None


# --- sweeps


def _sweeps(name: str, part: Part, source: Source) -> list[Sweep]:
    """Ways out and back, each at one voltage."""
    values, options, findings = part.values, source.options, source.findings
    h, voltage = values["displacement"], values["voltage"]
    noise = noise_of(h)
    legs = legs_of(h)
    if len(legs) > 2 * MOST_SWEEPS:
        findings.obstacle(
            "sweeps",
            f"{name}: {len(legs)} changes of direction were counted; at most {2 * MOST_SWEEPS} are read",
            "--rows FIRST-LAST",
        )
        return []
    same = repeated_rows(h, values["force"], voltage, *([values["time"]] if "time" in values else []))
    if same.sum() > 0.2 * same.size:
        findings.warning("repeated", f"{name}: {int(same.sum())} rows repeat the row before them; they are left out")
    branch = options.branch or "all"
    pairs = _out_and_back(legs)
    if branch == "first-loading":
        pairs = [pair[:1] for pair in pairs[:1]] if not np.ptp(voltage) > LEVEL_V else [pair[:1] for pair in pairs]
    levels = [_level(voltage, pair, h) for pair in pairs]
    if options.voltage:
        levels = _stated_levels(name, len(pairs), source)
    else:
        pairs = _parted_by_voltage(pairs, levels, voltage)
    sweeps = []
    rest = REST * noise + 1e-3 * float(np.ptp(h))
    for pair, level in zip(pairs, levels, strict=False):
        rows = np.concatenate([_moving(h, leg, rest) for leg in pair])
        direction = np.concatenate([_direction(h, _moving(h, leg, rest), leg, noise) for leg in pair])
        keep = ~same[rows] if same.sum() > 0.2 * same.size else np.ones(rows.size, dtype=np.bool_)
        if branch in ("loading", "unloading"):
            keep &= direction == (1 if branch == "loading" else -1)
        if not options.voltage:
            off = np.abs(voltage[rows] - level) > max(ALLOWED_V, ALLOWED_PART * abs(level))
            if off.sum() > 0.3 * off.size:
                findings.obstacle(
                    "voltage",
                    f"{name}: the voltage changes during the sweep that begins here ({voltage[rows].min():.4g} "
                    f"to {voltage[rows].max():.4g} V)",
                    "--rows FIRST-LAST keeps sweeps at one voltage",
                    line=int(part.lines[rows[0]]),
                )
            keep &= ~off
        if keep.sum() >= 3:
            sweeps.append(Sweep(rows[keep], direction[keep], level))
    if options.voltage:
        for sweep in sweeps:
            voltage[sweep.rows] = sweep.voltage
    elif sweeps:
        sweeps = _common_levels(sweeps)
    return sweeps


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
    largest = max(abs(sweep.voltage) for sweep in sweeps)
    for group in groups:
        level = float(np.median([sweeps[k].voltage for k in group]))
        level = 0.0 if abs(level) < min(LEVEL_V, 0.02 * largest) else round(level, 1)
        for k in group:
            levelled[k] = replace(sweeps[k], voltage=level)
    return levelled


def _stated_levels(name: str, count: int, source: Source) -> list[float]:
    stated = source.options.voltage
    if len(stated) == 1:
        return list(stated) * count
    if len(stated) != count:
        source.findings.obstacle(
            "voltage",
            f"{name}: {len(stated)} voltages are stated, and there are {count} sweeps",
            "--voltage with one value a sweep, or one for all",
        )
        return []
    return list(stated)


def _with_known_voltage(
    name: str, curves: list[Curve], part: Part, sweeps: Sequence[Sweep], source: Source
) -> list[Curve]:
    """Where the voltage reads zero throughout and sweeps differ, only the first can be said to be at 0 V."""
    findings = source.findings
    if not curves or source.options.voltage or float(np.abs(part.values["voltage"]).max()) > LEVEL_V:
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
