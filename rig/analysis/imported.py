"""Other people's tables -> the same identification as logs: curves of a cone with a scene, tests of sheets without."""

from __future__ import annotations

import hashlib
import importlib.metadata
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibration.film.cards import without_card
from calibration.film.curve import CurveError
from calibration.sheet.fit import Compared, TestsFit, compare_laws, fit_tests
from calibration.sheet.problem import Weighting
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError, UnknownParameter
from calibration.sheet.timed.record import stress_fallen
from model.material.laws import known_laws
from model.material.materials import Material
from rig.analysis.film import UNKNOWN_LAG, Found, dimension_errors, identify_curves, law_called, write_cards
from rig.base.errors import ConfigError, DataError
from rig.base.table import Table
from rig.base.text_file import read_text
from rig.base.toml_file import validate
from rig.importing.cone_table import ConeTable, read_cone_tables
from rig.importing.options import ImportOptions
from rig.importing.sheet_table import read_sheet_tests
from rig.importing.understood import Understood
from rig.scene.specimen import SpecimenTable


class SpecimenScene(Table):
    """What of a scene a table needs: the specimen."""

    specimen: SpecimenTable


def load_specimen(path: Path) -> tuple[SpecimenTable, str]:
    """The ``[specimen]`` of a scene file, whatever else is in it, and the file's text.

    Raises
    ------
    ConfigError
        When the file cannot be read or has no specimen that can be used.
    """
    text = read_text(path, "scene")
    try:
        raw = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}.") from None
    found = validate({key: value for key, value in raw.items() if key == "specimen"}, SpecimenScene, "scene", str(path))
    return found.specimen, text


def read_cones(paths: Sequence[Path], scene: Path, options: ImportOptions) -> ConeTable:
    """The curves in tables of a rig, with the uncertainties of the scene's dimensions.

    Raises
    ------
    ConfigError
        When a table or the scene cannot be used.
    """
    specimen, _ = load_specimen(scene)
    found = read_cone_tables(paths, specimen.specimen(), options)
    errors = dimension_errors(specimen)
    try:
        return replace(found, curves=[replace(curve, lag_uncertainty=UNKNOWN_LAG, **errors) for curve in found.curves])
    except CurveError as error:
        raise DataError(f"{error}.") from None


def hashes(paths: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of every file, by its path."""
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def identify_cones(
    table: ConeTable, paths: Sequence[Path], scene: Path, *, law: str | None = None, **options: Any
) -> Found:
    """`identify_curves` on the curves of tables; ``options`` as there. ``law`` is named, the scene's when not given.

    Raises
    ------
    DataError
        When the curves cannot be fitted.
    """
    _, text = load_specimen(scene)
    provenance: dict[str, object] = {
        "tables": hashes(paths),
        "scene": hashes([scene]),
        "import": [one.to_dict() for one in table.understood],
    }
    law_of = None if law is None else law_called(law)
    found = identify_curves(table.curves, provenance, law=law_of, **options)
    notes = [str(one) for each in table.understood for one in each.findings if one.severity == "warning"]
    notes.append(
        "noise is estimated from the scatter of the readings; gain of the force (0.5 %), its zero (1 % of the "
        "largest) and where the disk touches (20 um) are assumed; dimensions, displacement and voltage: see the budget"
    )
    return replace(found, notes=[*found.notes, *notes], scene_texts={str(scene): text})


@dataclass(frozen=True)
class SheetsRead:
    """Tests to be fitted, tests to be predicted, and what was understood of all tables."""

    tests: list[HomogeneousTest]
    predict: list[HomogeneousTest]
    understood: list[Understood]


def read_sheets(paths: Sequence[Path], predict: Sequence[Path], options: ImportOptions) -> SheetsRead:
    """Tests in tables of any layout.

    Raises
    ------
    ImportRefused
        With every obstacle of every file.
    """
    found = read_sheet_tests([*paths, *predict], options)
    held = {str(path) for path in predict} - {str(path) for path in paths}
    tests: list[HomogeneousTest] = []
    predicted: list[HomogeneousTest] = []
    for test, source in zip(found.tests, found.sources, strict=True):
        (predicted if source in held else tests).append(test)
    return SheetsRead(tests, predicted, found.understood)


def identify_sheets(read: SheetsRead, *, law: str = "ogden", **options: Any) -> TestsFit:
    """`fit_tests` on tests that were read; ``options`` as there.

    Raises
    ------
    DataError
        When there is no such law, or the tests cannot be fitted.
    """
    try:
        found = fit_tests(read.tests, predict=read.predict, law=law_called(law), **options)
    except UnknownParameter as error:
        raise ConfigError(f"--fix: {error}.") from None
    except TestsError as error:
        raise DataError(f"{error}.") from None
    for test in read.tests:
        fallen = stress_fallen(test)
        if fallen > 0.0:
            found.warnings.append(
                f"{test.name}: the stress falls by {fallen:.0%} of its largest where the sheet is held: it takes time, "
                "and an elastic law is fitted to it all the same. --branches auto fits branches along"
            )
    return found


def sheets_record(paths: Sequence[Path], predict: Sequence[Path], settings: Mapping[str, Any]) -> dict[str, Any]:
    """What a fit to tests was made from: hashes of the tables, settings, versions."""
    software = {name: importlib.metadata.version(name) for name in ("dea-rig", "lmfit", "numpy", "scipy")}
    return {
        "tables": hashes(paths),
        "predicted": hashes(predict),
        "settings": dict(settings),
        "software": software,
    }


def compare_sheets(read: SheetsRead, weighting: Weighting) -> list[Compared]:
    """Every known law on the tests that were read."""
    return compare_laws(read.tests, list(known_laws().values()), weighting=weighting)


def sheet_cards(found: TestsFit, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the material cards of a sheet into ``folder``, without a permittivity, which its tests do not tell.

    Returns the files, and the programs that have no card for its law and why.

    Raises
    ------
    ConfigError
        When a file cannot be written, or is there already.
    DataError
        When no program has the law.
    """
    sheet = Material("sheet", found.mu, found.alpha, 1.0, law=found.law)  # its eps_r is in no card
    return write_cards(sheet, folder, electric=False), without_card(sheet)
