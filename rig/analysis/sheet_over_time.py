"""Tables of sheets that take time -> law and branches; the cone predicted from the sheet, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from calibration.film.curve import CurveError
from calibration.sheet.sheet_tests import TestsError
from calibration.sheet.timed.fit import fit_timed
from calibration.sheet.timed.predict import ConePrediction, predict_cones, predict_sheets
from calibration.sheet.timed.result import SheetTrace, TimedFit
from model.material.materials import Material
from rig.analysis.film import law_called, read_records
from rig.analysis.fit_file import read_fit
from rig.analysis.imported import SheetsRead, hashes
from rig.base.errors import DataError

NOBODYS = Material("none", (1e5,), (2.0,), 1.0)  # what a film's own result replaces


@dataclass(frozen=True)
class SheetsOverTime:
    """A fit of sheets over time, and cones as it predicts them."""

    fit: TimedFit
    cones: list[ConePrediction]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        found = self.fit.to_dict()
        return found | ({"cones": [one.to_dict() for one in self.cones]} if self.cones else {})


def identify_over_time(
    read: SheetsRead, cones: Sequence[Path], *, branches: int | Literal["auto"], law: str, **settings: Any
) -> SheetsOverTime:
    """`fit_timed` on tests that were read, and the runs of cones in logs predicted from it.

    Raises
    ------
    DataError
        When a test has no time, the tests cannot be fitted, or a log holds nothing to predict.
    """
    number = None if branches == "auto" else branches
    records = read_records(cones) if cones else []
    try:
        found = fit_timed(read.tests, branches=number, predict=read.predict, law=law_called(law), **settings)
        return SheetsOverTime(found, predict_cones(found, records))
    except (TestsError, CurveError) as error:
        raise DataError(f"{error}.") from None


def sheets_from_film(read: SheetsRead, film: Path) -> tuple[Material, list[SheetTrace]]:
    """Tests that were read, as the film in a result of `dea-rig fit -o` predicts them.

    Raises
    ------
    ConfigError, DataError
        When the file is no such result, or a test has no time.
    """
    material = read_fit(film, NOBODYS).material
    try:
        return material, predict_sheets(material, [*read.tests, *read.predict])
    except TestsError as error:
        raise DataError(f"{error}.") from None


def record_of(settings: Mapping[str, Any], provenance: Mapping[str, Any], cones: Sequence[Path]) -> dict[str, Any]:
    """Where the result is from, with the logs of cones that were predicted."""
    found = {**provenance, "settings": dict(settings)}
    return found | ({"cones": hashes(cones)} if cones else {})
