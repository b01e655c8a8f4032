"""Tables out of a log, for other programs: CSV or Parquet, with the unit in every column's name."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from rig.log.dataset import Run, load_run
from rig.log.errors import UnusableFile
from rig.log.part_file import PartFile
from rig.log.reader import Columns, Log, read_log

FORMATS = (".csv", ".parquet")
_ROWS = 20_000  # written at once


def export(path: Path, out: Path, topic: str | None = None) -> int:
    """Write the log at ``path`` as one table to ``out``, whose ending says in which format; how many rows it has.

    Without ``topic`` the table is the run on the time base of the force samples, as `rig.log.dataset.Run` aligns it:
    t_s, displacement_m, force_N, voltage_V, flagged, step, kind, label, cycle, direction, nominal_voltage_V, record.
    With a topic it is that topic as recorded, and the times in nanoseconds since 1970; the force sensor's ``reading``
    gets its unit into its name.

    A value that is missing is an empty field in CSV and NaN in Parquet. Text in a CSV file that a spreadsheet would
    run as a formula gets an apostrophe in front. Bytes are written in hexadecimal.

    Raises
    ------
    LogError
        The log cannot be read, ``out`` exists, has another ending, or cannot be written.
    """
    check_format(out)
    return write_table(_run_table(load_run(path)) if topic is None else _topic_table(read_log(path), topic), out)


def check_format(out: Path) -> None:
    """Raise `UnusableFile` when the ending of ``out`` says no format."""
    if out.suffix not in FORMATS:
        raise UnusableFile(out, "has an ending that says no known format", f"Allowed: {' and '.join(FORMATS)}.")


def write_table(table: Columns, out: Path) -> int:
    """Write columns of one length to ``out``, as `export` does; how many rows they have."""
    check_format(out)
    rows = len(next(iter(table.values())))
    file = PartFile(out)
    try:
        if out.suffix == ".csv":
            _write_csv(file, table, rows)
        else:
            _write_parquet(file, table)
        file.finish()
    except BaseException:
        if file.is_open:
            file.discard()
        raise
    return rows


def _topic_table(log: Log, topic: str) -> Columns:
    unit = log.metadata.get("units", {}).get(f"{topic} reading", "").replace("/", "_per_")
    return {f"{name}_{unit}" if unit and name == "reading" else name: c for name, c in log.columns(topic).items()}


def _run_table(run: Run) -> Columns:
    nothing = ("", "", False)
    texts = [(phase.kind, phase.label, phase.record) for phase in run.phases]
    numbers = [(phase.step, phase.cycle, phase.direction) for phase in run.phases]
    rows = run.phase  # -1, before the first phase, finds the last entry: the one added here
    kind, label, record = (np.array(column) for column in zip(*texts, nothing, strict=True))
    step, cycle, direction = (np.array(column) for column in zip(*numbers, (-1, 0, 0), strict=True))
    nominal = np.array([*(phase.voltage for phase in run.phases), 0.0])
    return {
        "t_s": run.t,
        "displacement_m": run.h,
        "force_N": run.force,
        "voltage_V": run.voltage,
        "flagged": run.flagged,
        "step": step[rows],
        "kind": kind[rows].astype(object),
        "label": label[rows].astype(object),
        "cycle": cycle[rows],
        "direction": direction[rows],
        "nominal_voltage_V": nominal[rows],
        "record": record[rows],
    }


def _write_csv(file: PartFile, table: Columns, rows: int) -> None:
    for start in range(0, max(rows, 1), _ROWS):
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if start == 0:
            writer.writerow(table)
        block = [[_cell(value) for value in column[start : start + _ROWS].tolist()] for column in table.values()]
        writer.writerows(zip(*block, strict=True))
        file.put(text.getvalue().encode())


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if value != value else repr(value)
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, str):
        return f"'{value}" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
    return str(int(value)) if isinstance(value, bool) else str(value)


def _write_parquet(file: PartFile, table: Columns) -> None:
    import pyarrow  # type: ignore[import-untyped]
    import pyarrow.parquet  # type: ignore[import-untyped]

    texts = {name for name, column in table.items() if column.dtype == object}
    arrays = {
        name: pyarrow.array([value.hex() if isinstance(value, bytes) else value for value in column], pyarrow.string())
        if name in texts
        else pyarrow.array(column)
        for name, column in table.items()
    }
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(arrays), buffer)
    file.put(buffer.getvalue())
