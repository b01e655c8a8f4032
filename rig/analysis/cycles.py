"""The cycles of an endurance test, from its log and from those of the runs that went on with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.base.errors import DataError
from rig.log.reader import Columns, Log, read_log

if TYPE_CHECKING:
    from rich.table import Table

TOPIC = "/cycle"
MOST_NAMED = 5  # lost or repeated cycles, in a remark


@dataclass(frozen=True)
class Cycles:
    """All cycles of one step.

    Attributes
    ----------
    columns : dict of str to ndarray
        One row a cycle, in the order in which they were done: ``log`` (which one, from 1), ``date_s`` (since 1970) and
        the fields of ``/cycle``. Those that were cut short have ``whole`` false and are not counted.
    reference : float
        The response that counts as 100 %; NaN where it was not taken.
    """

    logs: list[Path]
    step: int
    columns: Columns
    reference: float

    @cached_property
    def whole(self) -> Columns:
        """The cycles that count."""
        return {name: column[self.columns["whole"]] for name, column in self.columns.items()}

    @property
    def response_name(self) -> str:
        """Which of the two slopes was driven."""
        stiffness = self.columns["stiffness_N_per_m"]
        return "stiffness_N_per_m" if np.isfinite(stiffness).any() else "actuation_N_per_V2"

    @property
    def remarks(self) -> list[str]:
        """What a reader must know: how many, whether any is missing or there twice, what was cut short."""
        numbers = self.whole["cycle"]
        count = f"Step {self.step}: {len(numbers)} whole cycles in {len(self.logs)} logs"
        lines = [f"{count}, {numbers.min()} to {numbers.max()}." if len(numbers) else f"{count}."]
        missing, twice = self.missing, self.twice
        lines.append("Each is there once." if not missing.size and not twice.size else "NOT each is there once.")
        for words, found in (("missing", missing), ("there twice", twice)):
            if found.size:
                some = ", ".join(map(str, found[:MOST_NAMED].tolist()))
                lines.append(f"{found.size} {words}: {some}{', ...' if found.size > MOST_NAMED else ''}.")
        if short := int(np.count_nonzero(~self.columns["whole"])):
            lines.append(f"{short} more were cut short by a pause or an end: the film has had them in part.")
        return lines

    @property
    def missing(self) -> NDArray[np.int64]:
        """Numbers up to the last one that no log has."""
        numbers = self.whole["cycle"].astype(np.int64)
        if not numbers.size:
            return numbers
        return np.setdiff1d(np.arange(1, numbers.max() + 1), numbers)

    @property
    def twice(self) -> NDArray[np.int64]:
        """Numbers that stand more than once."""
        numbers, counts = np.unique(self.whole["cycle"].astype(np.int64), return_counts=True)
        return numbers[counts > 1]


def read_cycles(paths: Sequence[Path], step: int | None = None) -> Cycles:
    """The cycles in the logs of one test, in any order of ``paths``.

    Raises
    ------
    rig.log.errors.LogError
        A file that is no log.
    DataError
        No log has cycles; there are several steps with cycles and none was chosen; not all logs are of one protocol.
    """
    logs = sorted((read_log(path) for path in paths), key=_when)
    if len({(_text(log, "protocol.toml"), log.metadata.get("run", {}).get("specimen", "")) for log in logs}) > 1:
        raise DataError("The logs are not of one test: they have different protocols or specimens.")
    tables = [log.columns(TOPIC) for log in logs]
    steps = sorted({int(one) for table in tables for one in table["step"].tolist()})
    if not steps:
        raise DataError(f'{paths[0]}: has no summary of a cycle. The step do = "cycle" writes them.')
    if step is None and len(steps) > 1:
        raise DataError(f"Steps {', '.join(map(str, steps))} have cycles: choose one with --step.")
    chosen = steps[0] if step is None else step
    if chosen not in steps:
        raise DataError(f"Step {chosen} has no cycles. There are: {', '.join(map(str, steps))}.")
    parts = [
        {
            "log": np.full(len(table["step"]), number),
            "date_s": table["publish_ns"] * 1e-9,
            **{name: column for name, column in table.items() if not name.endswith("_ns")},
        }
        for number, table in enumerate(tables, 1)
    ]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    mine = columns["step"] == chosen
    found = {name: column[mine] for name, column in columns.items()}
    return Cycles([log.path for log in logs], chosen, found, _reference(logs, chosen))


def _when(log: Log) -> tuple[int, int]:
    """When it began; on the virtual clock, whose runs all begin at once, after how many cycles."""
    return log.start_ns, int(log.metadata.get("resumed", {}).get("cycles_done", "0"))


def _reference(logs: Sequence[Log], step: int) -> float:
    """As the step wrote it; it is the same in all logs."""
    for log in logs:
        began = [(message.log_ns, message.fields["step"]) for message in log.messages("/phase")]
        for message in log.messages("/reference"):
            at = [number for ns, number in began if ns <= message.log_ns]
            if message.fields["name"] == "cycle_response" and at[-1:] == [step]:
                return float(message.fields["value"])
    return float("nan")


def _text(log: Log, name: str) -> bytes:
    attachment = log.attachments.get(name)
    return b"" if attachment is None else attachment.data


def as_table(found: Cycles) -> Table:
    """Some cycles of every decade, for the terminal."""
    from rich.table import Table

    whole, name = found.whole, found.response_name
    by_displacement = name == "stiffness_N_per_m"
    factor, unit = (1.0, "N/m") if by_displacement else (1e9, "nN/V2")
    table = Table()
    for heading in ("cycle", "force peak / N", f"response / {unit}", "of reference", "loop / uJ", "leakage / nA"):
        table.add_column(heading, justify="right")
    for row in _some(whole["cycle"]):
        response = float(whole[name][row])
        cells = (
            str(int(whole["cycle"][row])),
            f"{whole['force_peak_N'][row]:.4g}",
            f"{response * factor:.4g}",
            _known(100.0 * response / found.reference, "{:.1f} %"),
            _known(float(whole["work_J" if by_displacement else "electric_J"][row]) * 1e6, "{:.3g}"),
            _known(float(whole["leakage_A"][row]) * 1e9, "{:.3g}"),
        )
        table.add_row(*cells)
    return table


def _known(value: float, form: str) -> str:
    return form.format(value) if np.isfinite(value) else ""


def _some(numbers: NDArray[np.int64]) -> list[int]:
    """Rows of the first, second and fifth cycle of every decade, and of the last."""
    wanted = {lead * 10**power for power in range(10) for lead in (1, 2, 5)}
    rows = [row for row, number in enumerate(numbers.tolist()) if number in wanted]
    last = len(numbers) - 1
    return rows if last in rows or last < 0 else [*rows, last]
