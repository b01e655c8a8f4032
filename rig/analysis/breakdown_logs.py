"""What the ``breakdown`` step found, from logs, as rows of a breakdown table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rig.base.errors import DataError
from rig.log.contents import scene_in
from rig.log.reader import read_log

# What of a result is the value: the name in the log, the column of the table, the factor to its unit.
VALUES = {
    "field": ("field", "field_V_per_um", 1e-6),
    "field-at-disk": ("field_at_disk", "field_V_per_um", 1e-6),
    "voltage": ("voltage", "voltage_V", 1.0),
}
FAILED = "breakdown"


def log_rows(path: Path, value: str) -> list[dict[str, Any]]:
    """One row for each breakdown test in the log; a film that bore the ceiling, or met a limit, is censored there.

    Of a supply that measures no current the value of a breakdown is an upper bound.

    Raises
    ------
    rig.log.errors.LogError
        A file that is no log.
    DataError
        A log without a breakdown test, or of a run that did not end safe.
    """
    log = read_log(path)
    name, column, factor = VALUES[value]
    found: dict[int, Mapping[str, Any]] = {
        message.fields["step"]: message.fields
        for message in log.messages("/result")
        if message.fields["kind"] == "breakdown" and message.fields["name"] == name
    }
    if not found:
        raise DataError(f'{path}: has no result of a step do = "breakdown". Which log has one, `dea-rig info` tells.')
    scene = scene_in(log)
    specimen = scene.specimen.name or path.stem
    last = max(found)
    return [
        {
            column: one["value"] * factor,
            "censored": one["outcome"] != FAILED,
            "upper_bound": scene.breakdowns_are_bounds and one["outcome"] == FAILED,
            "specimen": specimen if step == last else f"{specimen}, step {step}",
            "note": f"{path.name}, step {step}: {one['outcome']}",
        }
        for step, one in sorted(found.items())
    ]
