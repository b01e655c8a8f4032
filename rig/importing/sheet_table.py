"""Tables of homogeneous tests -> stretches and nominal stresses of every specimen, checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.sheet.sheet_tests import HomogeneousTest, TestHistory
from rig.importing.branches import hysteresis_of, jumps_of, legs_of, repeated_rows, tear_of
from rig.importing.columns import Chooser, Chosen, Part, read_columns
from rig.importing.findings import Finding, Findings, refuse
from rig.importing.headings import fold
from rig.importing.kinds import KINDS, kind_in, kind_of_standard
from rig.importing.options import ImportOptions
from rig.importing.source import Piece, Source, open_source
from rig.importing.understood import Understood

Array = NDArray[np.float64]

LARGEST_STRETCH = 15.0  # no elastomer goes there; a column of percent does
LEAST_G, LARGEST_G = 1e3, 20e6  # Pa: elastomers lie between
STRESS_AT_REST = 0.02  # of the largest stress, at stretch 1
NO_REST = 0.3  # away from stretch 1 the sheet bears stress
TOE = 0.02  # of the largest stress: until then a specimen hangs slack
BROKEN = 0.5  # of the largest stress: less than that, with the stretch still rising, is a break
AGREE = 0.03  # by which stress and force over area, or strain and extension over length, may differ
# A neo-Hookean sheet's nominal stress is G (l - l^p): the exponent p of each test.
POWER = {"uniaxial": -2.0, "equibiaxial": -5.0, "pure shear": -3.0}


@dataclass(frozen=True)
class SheetTests:
    """Tests of all files with the file of each, and what was understood of each file."""

    tests: list[HomogeneousTest]
    sources: list[str]
    understood: list[Understood]


def read_sheet_tests(paths: Sequence[Path], options: ImportOptions | None = None) -> SheetTests:
    """Read homogeneous tests from tables of any layout.

    Raises
    ------
    ImportRefused
        With every obstacle of every file, and the option that removes it.
    """
    tests: list[HomogeneousTest] = []
    sources: list[str] = []
    understood: list[Understood] = []
    findings: list[Finding] = []
    for path in paths:
        source = open_source(path, options or ImportOptions())
        found = _tests_of(source)
        tests += found
        sources += [str(path)] * len(found)
        understood.append(source.understood)
        findings += source.findings.all
    findings += _same_data(tests)
    refuse(findings, [line for one in understood for line in one.lines()])
    return SheetTests(_with_distinct_names(tests), sources, understood)


def _with_distinct_names(tests: Sequence[HomogeneousTest]) -> list[HomogeneousTest]:
    """Results are listed by name: two files of one name in different folders keep both."""
    names = [test.name for test in tests]
    renamed = []
    for k, test in enumerate(tests):
        same = [j for j, name in enumerate(names) if name == test.name]
        renamed.append(test if len(same) == 1 else replace(test, name=f"{test.name} ({same.index(k) + 1})"))
    return renamed


def _same_data(tests: Sequence[HomogeneousTest]) -> list[Finding]:
    found = []
    for one, other in combinations(tests, 2):
        mine = set(zip(one.stretch1.tolist(), one.stress1.tolist(), strict=True))
        theirs = set(zip(other.stretch1.tolist(), other.stress1.tolist(), strict=True))
        if len(mine & theirs) > 0.5 * min(len(mine), len(theirs)):
            what = f"{other.name} holds the same data; given twice they would count as if they had been measured twice"
            found.append(Finding("obstacle", "twice", one.name, what, "leave one of them out"))
    return found


def _tests_of(source: Source) -> list[HomogeneousTest]:
    findings = source.findings
    kind = _kind(source)
    if source.table is None:
        return []
    tests = []
    for number, piece in enumerate(source.pieces):
        part, how = _read(source, piece, kind, first=number == 0)
        if part is None or any(one.severity == "obstacle" for one in findings.all):
            continue
        name = source.path.stem
        if len(source.pieces) > 1:
            name = f"{name}, {piece.label or f'specimen {number + 1}'}"
        test = _test(name, kind or "uniaxial", part, source)
        if test is not None:
            tests.append(test)
            source.understood.rows_kept.append(int(test.stretch1.size))
            source.understood.parts.append(_described(test, how))
    return tests


def _described(test: HomogeneousTest, how: str) -> str:
    stress, time = test.measured, test.history.time if test.history else np.zeros(0)
    how += f"; with --branches {time.size} rows over {np.ptp(time):.4g} s" if time.size else ""
    return (
        f"{test.name}: {test.stretch1.size} rows, stretch {test.stretch1.min():.4g} to {test.stretch1.max():.4g}, "
        f"nominal stress {stress.min() / 1e3:.4g} to {stress.max() / 1e3:.4g} kPa{how}"
    )


# --- which test


def _kind(source: Source) -> str | None:
    """The kind of test: from the option, a remark in the file, the file's name, or a standard that the file names."""
    findings, table, understood = source.findings, source.table, source.understood
    named: list[tuple[str, str]] = []
    if source.options.kind:
        named.append((source.options.kind, "option"))
    else:
        for row in table.preamble if table else ():
            text = " ".join(row.given)
            key = fold(text.partition(":")[0] if ":" in text else (row.given or [""])[0])
            if key in (
                "kind",
                "test kind",
                "kind of test",
                "type of test",
                "test type",
                "prufart",
                "versuchsart",
                "type d essai",
                "test method",
            ):
                found = kind_in(text.partition(":")[2] if ":" in text else " ".join(row.given[1:]))
                if found:
                    named.append((found, f"line {row.line}: {text}"))
        found = kind_in(source.path.stem)
        if found:
            named.append((found, "the file's name"))
        if not named and table:
            texts = [(kind_in(" ".join(row.given)), row) for row in table.preamble if len(row.given) <= 3]
            named += [(kind, f"line {row.line}: {' '.join(row.given)}") for kind, row in texts if kind][:1]
        standard = kind_of_standard(" ".join(row.given) for row in table.preamble) if table and not named else None
        if standard:
            named.append((standard[0], f"by the standard named in {standard[1]!r}"))
    kinds = {kind for kind, _ in named}
    choice = " or ".join(f"--kind {kind!r}" if " " in kind else f"--kind {kind}" for kind in KINDS)
    if len(kinds) > 1:
        both = " and ".join(f"{kind} ({where})" for kind, where in named)
        findings.obstacle("kind", f"two kinds of test are named: {both}", choice)
        return None
    if not kinds and table is not None and any(heading.direction == 2 for heading in table.headings):
        stresses = {heading.direction for heading in table.headings if heading.quantity == "stress"}
        if stresses >= {1, 2}:
            named, kinds = [("biaxial", "two stretches and two stresses")], {"biaxial"}
    if not kinds:
        findings.obstacle("kind", "the kind of test is not known: neither the file nor its name tells it", choice)
        return None
    kind, where = named[0]
    if kind not in KINDS:
        findings.obstacle(
            "kind", f"{kind} tests are not supported ({where}); a sheet in pure shear is 'pure shear'", choice
        )
        return None
    understood.kind, understood.kind_source = kind, where
    return kind


# --- columns


def _read(source: Source, piece: Piece, kind: str | None, *, first: bool) -> tuple[Part | None, str]:
    """The piece's stretch and nominal stress as SI columns, and in words how they were made of what the file has."""
    table, findings = source.table, source.findings if first else Findings(str(source.path))
    assert table is not None
    chooser = Chooser(table, piece.group, source.options, findings)
    two = _directions(chooser)
    if kind == "biaxial" and not two:
        findings.obstacle(
            "kind",
            f"a biaxial test has two stretches and two stresses, and the columns are {chooser.listing()}",
            "--kind equibiaxial where both directions are alike, or --column stretch1=... --column stretch2=... "
            "--column stress1=... --column stress2=...",
            line=table.heading_line,
        )
        return None, ""
    if kind not in (None, "biaxial") and two:
        findings.obstacle(
            "kind",
            f"a {kind} test has one stretch and one stress, and the columns are {chooser.listing()}",
            f"--kind biaxial, or --column stretch=... --column stress=... for one direction of a {kind} test",
            line=table.heading_line,
        )
        return None, ""
    if two:
        names = ["stretch1", "stretch2", "stress1", "stress2"]
        chosen = [one for one in map(chooser.choose, names) if one is not None]
        how = ""
    else:
        chosen, how = _one_direction(chooser, piece, source, findings)
    if first or len(source.pieces) > 1:
        source.understood.take(chosen)
    if len(chosen) < (4 if two else 2):
        return None, ""
    time = Chooser(table, piece.group, source.options, Findings("")).choose("time")
    timed = [time] if time is not None and time.unit.name else []
    source.understood.take(timed, "; for --branches only")
    part, left_out = read_columns(table, piece.section, chosen + timed, piece.label, source.options, source.findings)
    source.understood.leave_out(left_out)
    values = _to_stretch_and_stress(part.values, piece, source.options)
    return replace(part, values=values), how


def _directions(chooser: Chooser) -> bool:
    """Whether there are columns of two directions."""
    named = set(chooser.options.column)
    if named & {"stretch2", "stress2"}:
        return True
    if named & {"stretch", "strain", "stress"}:
        return False
    return all(chooser.candidates(name) for name in ("stretch1", "stretch2", "stress1", "stress2"))


def _one_direction(chooser: Chooser, piece: Piece, source: Source, findings: Findings) -> tuple[list[Chosen], str]:
    """One column that gives the stretch and one that gives the nominal stress."""
    options, size = source.options, piece.size
    length, area = options.length or size.length, options.area or size.area
    roads = {
        "x": [
            ("stretch", True),
            ("strain", True),
            ("true strain", True),
            ("displacement", length is not None),
            ("length", length is not None),
        ],
        "y": [("stress", True), ("true stress", True), ("force", area is not None)],
    }
    chosen: list[Chosen] = []
    for axis, ways in roads.items():
        asked = [way for way in ways if way[0] in options.column] or ways
        present = [(name, usable) for name, usable in asked if chooser.candidates(name)]
        usable = [name for name, can in present if can]
        if usable:
            one = chooser.choose(usable[0])
            if one is not None:
                chosen.append(one)
            others = [name for name in usable[1:] if name in ("true strain", "true stress")]
            if others:
                findings.note(
                    "columns",
                    f"{usable[0]} is taken, and not {' and '.join(others)}",
                    f"--column {others[0].replace(' ', '-')}=...",
                )
        else:
            _ask(axis, [name for name, _ in present], chooser, findings, source.understood)
    how = []
    for one in chosen:
        source_of = {
            "displacement": (options.length and "option") or size.length_source,
            "force": (options.area and "option") or size.area_source,
        }
        if one.quantity in ("displacement", "length"):
            how.append(
                f"stretch = {'1 + extension' if one.quantity == 'displacement' else 'length'} over "
                f"{1e3 * (length or 0):g} mm ({source_of['displacement']})"
            )
        elif one.quantity == "force":
            how.append(f"nominal stress = force over {1e6 * (area or 0):.6g} mm2 ({source_of['force']})")
        elif one.quantity == "true strain":
            how.append("stretch = exp(true strain)")
        elif one.quantity == "true stress":
            how.append("nominal stress = true stress over stretch")
        elif one.quantity == "stress":
            plain = not any(
                word in fold(one.heading.text)
                for word in ("nominal", "engineering", "technisch", "nominale", "pk1", "piola")
            )
            how.append("the stress is taken as nominal (engineering) stress" if plain else "nominal stress as given")
    if source.pieces and piece is source.pieces[0]:
        for words in how:
            if not words.endswith("as given"):
                option = "--column true-stress=..." if words.startswith("the stress") else ""
                findings.note("quantity", words, option)
    return chosen, ""


def _ask(axis: str, present: Sequence[str], chooser: Chooser, findings: Findings, understood: Understood) -> None:
    """Say what is missing for the stretch ("x") or the stress ("y")."""
    table = chooser.table
    if present:
        one = chooser.choose(present[0])  # what else is wrong with the column is asked at once
        understood.take([one] if one is not None else [])
    if axis == "x" and present:
        findings.obstacle(
            "length",
            f"there is a column of {present[0]}, and the length of the specimen is not known",
            "--length-mm LENGTH",
            line=table.heading_line,
        )
    elif present:
        findings.obstacle(
            "area",
            "there is a column of force, and the cross-section of the specimen is not known (area, or "
            "width and thickness)",
            "--area-mm2 AREA",
            line=table.heading_line,
        )
    else:
        what = "stretch or strain" if axis == "x" else "nominal stress or force"
        option = (
            "--column stretch=NUMBER (or strain=NUMBER, or displacement=NUMBER with --length-mm LENGTH)"
            if axis == "x"
            else "--column stress=NUMBER --unit stress=UNIT (or force=NUMBER, with --area-mm2 AREA)"
        )
        heading = "there is no heading" if table.heading_line is None else f"the columns are {chooser.listing()}"
        findings.obstacle("columns", f"no column of {what} was found; {heading}", option, line=table.heading_line)


def _to_stretch_and_stress(values: dict[str, Array], piece: Piece, options: ImportOptions) -> dict[str, Array]:
    """SI columns as stretch and nominal stress."""
    made: dict[str, Array] = {
        name: values[name] for name in ("stretch1", "stretch2", "stress1", "stress2", "time") if name in values
    }
    length, area = options.length or piece.size.length or 1.0, options.area or piece.size.area or 1.0
    if "stretch" in values:
        made["stretch1"] = values["stretch"]
    elif "strain" in values:
        made["stretch1"] = 1.0 + values["strain"]
    elif "true strain" in values:
        made["stretch1"] = np.exp(np.clip(values["true strain"], -50.0, 50.0))
    elif "displacement" in values:
        made["stretch1"] = 1.0 + values["displacement"] / length
    elif "length" in values:
        made["stretch1"] = values["length"] / length
    if "stress" in values:
        made["stress1"] = values["stress"]
    elif "true stress" in values and "stretch1" in made:
        made["stress1"] = values["true stress"] / made["stretch1"]
    elif "force" in values:
        made["stress1"] = values["force"] / area
    return made


# --- rows and checks


def _test(name: str, kind: str, part: Part, source: Source) -> HomogeneousTest | None:
    """One specimen's test after the rows are chosen and the numbers held against what a sheet can do."""
    findings, understood = source.findings, source.understood
    values = part.values
    if not {"stretch1", "stress1"} <= values.keys():
        return None
    stretch, stress = values["stretch1"], values["stress1"]
    if stretch.size < 3:
        findings.obstacle(
            "rows",
            f"{name}: {stretch.size} rows with stretch and stress are left; at least 3 are needed",
            "--rows FIRST-LAST",
        )
        return None
    if not _plausible(name, part, findings):
        return None
    keep = np.ones(stretch.size, dtype=np.bool_)
    same = repeated_rows(stretch, stress, *([values["time"]] if "time" in values else []))
    if same.any():
        keep &= ~same
        understood.left_out["repeats the row before"] = part.lines[same].tolist()
        findings.warning(
            "repeated",
            f"{name}: {int(same.sum())} rows repeat the row before them; they are left out, for they tell nothing new",
        )
    over_time = keep.copy() if "time" in values else None
    if kind != "biaxial":
        rows = np.flatnonzero(keep)
        keep[rows[~_branch(name, stretch[rows], stress[rows], part.lines[rows], source)]] = False
        stress = _look_at_curve(name, kind, stretch, stress, keep, part, source)
    if kind == "biaxial":
        stretch2, stress2 = values["stretch2"], values["stress2"]
    else:
        stretch2 = {"uniaxial": stretch**-0.5, "equibiaxial": stretch, "pure shear": np.ones_like(stretch)}[kind]
        stress2 = np.full_like(stress, np.nan)
    columns = stretch, stretch2, stress, stress2
    history = None
    if over_time is not None:
        over_time &= ~np.isin(part.lines, understood.left_out.get("after the break", [])) & np.isfinite(values["time"])
        history = TestHistory(values["time"][over_time], *(one[over_time] for one in columns))
    first, second, along, across = (one[keep] for one in columns)
    return HomogeneousTest(name, kind, first, second, along, across, history)


def _plausible(name: str, part: Part, findings: Findings) -> bool:
    """Refuse what cannot be the stretches and stresses of a sheet."""
    count = len(findings.of("obstacle"))
    for quantity in ("stretch1", "stretch2"):
        if quantity not in part.values:
            continue
        stretch = part.values[quantity]
        k = int(stretch.argmax())
        if stretch[k] > LARGEST_STRETCH:
            findings.obstacle(
                "percent",
                f"{name}: stretch reaches {stretch[k]:.4g}, which no elastomer does; it looks like strain in percent",
                "--column strain=NUMBER --unit strain=%  (or --unit stretch=% where 100 is the unstretched sheet)",
                line=int(part.lines[k]),
            )
        elif stretch.min() <= 0.05:
            k = int(stretch.argmin())
            findings.obstacle(
                "stretch",
                f"{name}: stretch is {stretch[k]:.4g}, and must be positive: 1 is the unstretched sheet; it "
                f"looks like strain",
                "--column strain=NUMBER, with --unit strain=% where it is in percent",
                line=int(part.lines[k]),
            )
        elif quantity == "stretch1" and not np.ptp(stretch) > 0.0:
            findings.obstacle(
                "constant",
                f"{name}: the stretch is {stretch[0]:.6g} throughout; nothing varies",
                "--column stretch=NUMBER",
            )
    for quantity in ("stress1", "stress2"):
        if quantity in part.values and not np.ptp(part.values[quantity]) > 0.0:
            value = part.values[quantity][0]
            findings.obstacle(
                "constant",
                f"{name}: all stresses are {value:g} Pa; nothing can be fitted to that",
                "--column stress=NUMBER",
            )
    stretch, stress = part.values["stretch1"], part.values["stress1"]
    k = int(np.abs(stretch - 1.0).argmin())
    if abs(stretch[k] - 1.0) > NO_REST and abs(stress[k]) < STRESS_AT_REST * float(np.abs(stress).max()):
        findings.obstacle(
            "zero",
            f"{name}: the stretch begins at {stretch[k]:.4g}, and there is no stress there: is it counted from zero",
            "--zero displacement=first (or strain=first)",
            line=int(part.lines[k]),
        )
    jumps = jumps_of(stretch, stress)
    if jumps:
        line = int(part.lines[jumps[0]])
        findings.obstacle(
            "jump",
            f"{name}: the stretch jumps from {stretch[jumps[0] - 1]:.4g} to {stretch[jumps[0]]:.4g} while the "
            f"stress goes on: "
            "was the extensometer set to zero, or did it slip",
            f"--rows {int(part.lines[0])}-{line - 1} keeps the rows before",
            line=line,
        )
    return len(findings.of("obstacle")) == count


def _branch(name: str, stretch: Array, stress: Array, lines: NDArray[np.intp], source: Source) -> NDArray[np.bool_]:
    """Rows of the branches that were asked for; by default the first loading."""
    findings = source.findings
    legs = legs_of(stretch)
    everything = np.ones(stretch.size, dtype=np.bool_)
    up = 1 if stretch[np.abs(stretch - 1.0).argmax()] >= 1.0 else -1
    loading = [leg for leg in legs if leg.direction == up]
    asked = source.options.branch or "first-loading"
    if len(legs) <= 1 or asked == "all":
        if len(legs) > 1:
            findings.warning(
                "cycles",
                f"{name}: all {len(legs)} branches of the load cycles are used; they differ by hysteresis and "
                f"softening",
            )
        return everything
    if asked == "unloading":
        wanted = [leg for leg in legs if leg.direction != up]
    else:
        wanted = loading if asked == "loading" else loading[:1]
    chosen = np.zeros(stretch.size, dtype=np.bool_)
    for leg in wanted:
        chosen[leg.start : leg.stop] = True
    gap = hysteresis_of(stretch, stress, legs)
    findings.warning(
        "cycles",
        f"{name}: {len(loading)} loading and {len(legs) - len(loading)} unloading branches (load cycles"
        + (f", hysteresis {gap:.0%} of the largest stress" if gap is not None else "")
        + f"); used: {asked.replace('-', ' ')}",
        "--branch loading, --branch unloading or --branch all",
    )
    source.understood.left_out.setdefault("other branches of the load cycles", []).extend(lines[~chosen].tolist())
    return chosen


def _look_at_curve(
    name: str, kind: str, stretch: Array, stress: Array, keep: NDArray[np.bool_], part: Part, source: Source
) -> Array:
    """Sign, break, stress at rest, toe and stiffness of the rows that are kept; returns the stress, sign corrected."""
    findings = source.findings
    largest = float(np.abs(stress[keep]).max())
    far = keep & (np.abs(stretch - 1.0) > 0.2 * np.abs(stretch[keep] - 1.0).max())
    with np.errstate(all="ignore"):
        wrong = far & (stress * (stretch - 1.0) < -0.05 * largest * np.abs(stretch - 1.0))
    if far.any() and wrong.sum() > 0.9 * far.sum():
        if stretch[far].max() > 1.0:
            stress = -stress
            findings.warning(
                "sign",
                f"{name}: the stress is negative where the sheet is stretched; its sign is reversed, "
                f"for a sheet that is pulled pulls back",
                "--sign stress=+ with --factor",
            )
        else:
            k = int(np.flatnonzero(wrong)[0])
            findings.obstacle(
                "sign",
                f"{name}: stretch is below 1 ({stretch[k]:.4g}) and the stress is tension ({stress[k]:.4g} Pa): "
                f"is it compression, counted positive",
                "--sign stress=- for compression, or --sign strain=- for tension",
                line=int(part.lines[k]),
            )
            return stress
    rows = np.flatnonzero(keep)
    top = int(rows[np.abs(stress[rows]).argmax()])
    after = rows[rows > top]
    fallen = after[np.abs(stress[after]) < BROKEN * largest]
    if "time" in part.values:  # a sheet that is held relaxes
        fallen = fallen[fallen >= tear_of(np.abs(stress))]
    if fallen.size and abs(stretch[fallen[0]] - 1.0) >= 0.97 * abs(stretch[top] - 1.0):
        keep[after[after >= fallen[0]]] = False
        source.understood.left_out.setdefault("after the break", []).extend(
            part.lines[after[after >= fallen[0]]].tolist()
        )
        findings.warning(
            "break",
            f"{name}: the specimen broke at stretch {stretch[top]:.4g}; the rows after it are left out",
            line=int(part.lines[fallen[0]]),
        )
        rows = np.flatnonzero(keep)
    offset = _stress_at_rest(kind, stretch[rows], stress[rows])
    if offset is not None and abs(offset) > STRESS_AT_REST * largest:
        findings.warning(
            "offset",
            f"{name}: the stress is {offset / 1e6:.3g} MPa at stretch 1, unstretched, where it must be zero: "
            "the load cell was not tared, or the specimen was preloaded",
            "--zero stress=first takes the first value off (--zero force=first for a column of force)",
        )
    elif rows.size >= 8:
        order = rows[np.argsort(np.abs(stretch[rows] - 1.0))]
        reached = np.abs(stress[order]) > TOE * largest
        k = int(reached.argmax())
        share = abs(stretch[order[k]] - 1.0) / np.abs(stretch[rows] - 1.0).max()
        if k >= 3 and share > 0.08:
            findings.warning(
                "toe",
                f"{name}: the stress stays below {TOE:.0%} of its largest until stretch "
                f"{stretch[order[k]]:.4g}: the specimen hung slack, "
                "and its stretch is counted from too short a length",
                "--zero strain=VALUE counts from where it is taut, or --rows leaves the toe out",
            )
    rows = np.flatnonzero(keep)
    modulus = _modulus(kind, stretch[rows], stress[rows])
    if modulus is not None and not LEAST_G <= modulus <= LARGEST_G:
        findings.warning(
            "modulus",
            f"{name}: a shear modulus of {modulus / 1e6:.4g} MPa is unusual; elastomers lie between "
            f"{LEAST_G / 1e3:g} kPa and {LARGEST_G / 1e6:g} MPa: "
            "is the unit of the stress right (MPa, kPa), and the strain in percent or not",
            "--unit stress=kPa",
        )
    return stress


def _stress_at_rest(kind: str, stretch: Array, stress: Array) -> float | None:
    """Stress (Pa) at stretch 1: measured there, or where a neo-Hookean sheet through the first rows has its offset.

    None where the rows do not tell it.
    """
    away = np.abs(stretch - 1.0)
    if away.min() < 2e-3:
        return float(np.median(stress[away < 2e-3]))
    near = away < 0.15 * away.max()
    if near.sum() < 6 or kind not in POWER:
        return None
    columns = np.stack((stretch[near] - stretch[near] ** POWER[kind], np.ones(int(near.sum()))), axis=1)
    solution, *_ = np.linalg.lstsq(columns, stress[near], rcond=None)
    residual = stress[near] - columns @ solution
    scatter = float(np.sqrt(residual @ residual / (near.sum() - 2)))
    error = scatter * float(np.sqrt(np.linalg.inv(columns.T @ columns)[1, 1]))
    return float(solution[1]) if abs(solution[1]) > 5.0 * error else None


def _modulus(kind: str, stretch: Array, stress: Array) -> float | None:
    """Shear modulus (Pa) of the neo-Hookean sheet that fits best: ``P = G (l - l2^-2 l^-3)`` by mode."""
    if kind not in POWER:
        return None
    unit = stretch - stretch ** POWER[kind]
    return float(unit @ stress / (unit @ unit)) if unit @ unit > 0.0 else None
