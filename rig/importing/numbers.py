"""Cells of one column -> numbers; what is no number is reported with its place, never skipped in silence."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.importing.dialect import Dialect

Array = NDArray[np.float64]

DAY = 86400.0
HALF_DAY = 0.5 * DAY


def column_values(cells: Sequence[str], dialect: Dialect) -> tuple[Array, list[int]]:
    """Numbers of a column, nan where a cell is empty or marks a missing value; and the rows with any other cell."""
    text = "\n".join(cells)
    # The fast road; float() also takes "1_0" and "nan", which are looked for apart, and a point may part thousands.
    if "_" not in text and not (dialect.decimal == "," and "." in text):
        try:
            values = np.array(text.replace(",", ".").split("\n") if dialect.decimal == "," else cells, dtype=np.float64)
        except ValueError:
            values = np.full(len(cells), np.nan)
        if len(values) == len(cells) and np.isfinite(values).all():
            return values, []
    values = np.full(len(cells), np.nan)
    bad = []
    for row, cell in enumerate(cells):
        kind = dialect.kind(cell)
        if kind == "N":
            values[row] = dialect.value(cell)
            if not np.isfinite(values[row]):
                bad.append(row)
        elif kind not in "EM" or "inf" in cell.casefold():  # an infinite value is a wrong one, not a missing one
            bad.append(row)
    return values, bad


def clock_values(cells: Sequence[str]) -> Array | None:
    """Seconds from times of day, with or without a date; None where a cell is no time.

    ``mm:ss.f`` has one colon and decimals, ``hh:mm`` one colon and none. The date serves only to tell days apart: time
    counts on over midnight.
    """
    pattern = re.compile(
        r"^(.*?)(\d{1,3}):(\d{2})(?::(\d{2}))?(?:[.,](\d+)|:(\d{3}))?\s*([AaPp][Mm])?\s*(?:Z|[+-]\d{2}:?\d{2})?$"
    )
    seconds = np.empty(len(cells))
    dates: list[str] = []
    for row, cell in enumerate(cells):
        found = pattern.match(cell)
        if found is None:
            return None
        date, one, two, three, decimals, thousandths, half = found.groups()
        fraction = decimals or thousandths  # data loggers part them by a colon
        if three is not None:
            value = 3600.0 * int(one) + 60.0 * int(two) + int(three)
        else:  # mm:ss.f, and hh:mm where there are no decimals
            value = 60.0 * int(one) + int(two) if fraction else 3600.0 * int(one) + 60.0 * int(two)
        if half:
            value = value % HALF_DAY + (HALF_DAY if half.casefold() == "pm" else 0.0)
        seconds[row] = value + (float(f"0.{fraction}") if fraction else 0.0)
        dates.append(date)
    new_day = np.array([0.0] + [float(a != b) for a, b in zip(dates[1:], dates, strict=False)])
    if not new_day.any():  # without dates, a step back by more than half a day is midnight
        new_day[1:] = np.diff(seconds) < -HALF_DAY
    return seconds + DAY * np.cumsum(new_day)
