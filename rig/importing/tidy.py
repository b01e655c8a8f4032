"""Tidy tables: the rows that are used, in SI units, which the import reads back to the same numbers, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.sheet.sheet_tests import HomogeneousTest
from rig.base.errors import ConfigError
from rig.base.outputs import write_text

Array = NDArray[np.float64]

CONE = {"time": "t_s", "displacement": "displacement_m", "force": "force_N", "voltage": "voltage_V"}


def write_sheet_tests(path: Path, tests: Sequence[HomogeneousTest]) -> None:
    """Write tests of one kind; several specimens stand one below the other, told apart by their first column.

    Raises
    ------
    ConfigError
        When the tests are of several kinds, or the file cannot be written.
    """
    kinds = sorted({test.kind for test in tests})
    if len(kinds) != 1:
        raise ConfigError(f"{path}: a tidy table holds tests of one kind, and these are {', '.join(kinds)}.")
    lines = [f"# kind: {kinds[0]}"]
    biaxial = kinds[0] == "biaxial"
    names = (
        ["stretch1", "stretch2", "nominal_stress1_Pa", "nominal_stress2_Pa"]
        if biaxial
        else ["stretch", "nominal_stress_Pa"]
    )
    lines.append(",".join([*(["specimen"] if len(tests) > 1 else []), *names]))
    for test in tests:
        columns = (
            [test.stretch1, test.stretch2, test.stress1, test.stress2] if biaxial else [test.stretch1, test.stress1]
        )
        label = [test.name.replace(",", ";").replace('"', "'")] if len(tests) > 1 else []
        lines += [",".join([*label, *map(repr, row)]) for row in zip(*(c.tolist() for c in columns), strict=True)]
    write_text(path, "\n".join(lines) + "\n")


def write_cone_table(path: Path, tables: Sequence[Mapping[str, Array]]) -> None:
    """Write the columns of a rig, in the order of time.

    Raises
    ------
    ConfigError
        When there are several tables, or the file cannot be written.
    """
    if len(tables) != 1:
        raise ConfigError(f"{path}: a tidy table holds one run, and {len(tables)} are given.")
    (table,) = tables
    names = [name for name in CONE if name in table]
    lines = [",".join(CONE[name] for name in names)]
    lines += [",".join(map(repr, row)) for row in zip(*(table[name].tolist() for name in names), strict=True)]
    write_text(path, "\n".join(lines) + "\n")
