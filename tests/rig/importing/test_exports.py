"""Files as laboratories have them, with known truth: read with no option, or refused with the option named."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.importing.cone_table import read_cone_tables
from rig.importing.findings import ImportRefused
from rig.importing.options import ImportOptions, from_words
from rig.importing.sheet_table import read_sheet_tests
from rig.scene.specimen import SpecimenTable

UP = Path(__file__).resolve().parents
EXPORTS = next((up / "shared/data/exports" for up in UP if (up / "shared/data/exports").is_dir()), Path("none"))
if not (EXPORTS / "manifest.json").is_file():
    pytest.skip("the exports of other laboratories are not there", allow_module_level=True)
FILES = {entry["path"][0]: entry for entry in json.loads((EXPORTS / "manifest.json").read_text())["files"]}
# Where the import needs no option although the manifest allows for some: kind and area stand in the file.
REFUSED = {
    "rig_pandas_index.csv": {"unit": ["displacement=mm", "force=N", "voltage=V"]},
    "published/Treloar_1944/UT.txt": {"column": ["stretch=1", "stress=2"], "unit": ["stress=MPa"]},
    "uniaxial_percent_in_stretch.csv": {"column": ["strain=1"], "unit": ["strain=%"]},
    "rig_two_force_columns.csv": {"column": ["force=3"]},
    "rig_swapped_columns.csv": {"column": ["displacement=3", "force=2"], "unit": ["displacement=mm", "force=N"]},
    "rig_rezeroed.csv": {"rows": "2-262"},
}


def understood(name: str, options: ImportOptions | None = None) -> tuple[Any, list[str], list[str]]:
    """What is read, the lines that are told first, and the message where it is refused."""
    entry = FILES[name]
    try:
        if entry["kind"] == "test":
            tests = read_sheet_tests([EXPORTS / name], options)
            return tests.tests, [line for one in tests.understood for line in one.lines()], []
        scene = tomllib.loads((EXPORTS / entry["scene"]).read_text())
        specimen = SpecimenTable.model_validate(scene["specimen"]).specimen()
        cones = read_cone_tables([EXPORTS / name], specimen, options)
        return cones, [line for one in cones.understood for line in one.lines()], []
    except ImportRefused as refused:
        return None, list(refused.understood), str(refused).splitlines()


@pytest.mark.parametrize("name", FILES)
def test_it_is_read_or_refused_as_the_manifest_says(name: str) -> None:
    read, told, message = understood(name)
    assert (read is None) == (name in REFUSED)
    ideal = FILES[name]["ideal"]
    assert (ideal == "refused") <= (read is None)
    words = " ".join(told + message).lower()
    if ideal in ("refused", "warned") or read is None:
        for group in FILES[name]["message_topics"]:
            assert any(topic.lower() in words for topic in group), group
    if ideal == "warned":
        assert "warning: " in words
    if read is None:
        assert "Option: --" in " ".join(message)


@pytest.mark.parametrize("name", [name for name, entry in FILES.items() if "check" in entry["good_import"]])
def test_its_columns_are_the_truth(name: str) -> None:
    """Means, ends and extremes against the manifest, within the rounding of the file."""
    read, _, _ = understood(name, from_words(**REFUSED.get(name, {})))
    check = FILES[name]["good_import"]["check"]
    if FILES[name]["kind"] == "rig":
        columns = [{f"{quantity}_{unit}": read.tidy[0][quantity] for quantity, unit in
                    (("displacement", "m"), ("force", "N"), ("voltage", "V"))}]  # fmt: skip
        checks = [check]
    else:
        columns = [{"stretch": test.stretch1, "nominal_stress_Pa": test.stress1} for test in read]
        checks = [check[f"specimen {k + 1}"] for k in range(3)] if "specimen 1" in check else [check]
    assert len(columns) == len(checks)
    for found, wanted in zip(columns, checks, strict=True):
        for quantity, facts in wanted.items():
            if quantity == "time_s":
                continue
            values = found[quantity]
            assert values.size == facts["n"]
            size = float(np.abs(values).max())
            for fact, value in (("first", values[0]), ("last", values[-1]), ("max", values.max())):
                if fact in facts:
                    assert value == pytest.approx(facts[fact], abs=2e-3 * size)
            if "mean" in facts:
                assert values.mean() == pytest.approx(facts["mean"], rel=2e-4)


@pytest.mark.parametrize("name", [name for name, entry in FILES.items() if "curves" in entry["good_import"]])
def test_its_sweeps_are_at_their_voltages(name: str) -> None:
    read, _, _ = understood(name, from_words(**REFUSED.get(name, {})))
    assert [curve.nominal_voltage for curve in read.curves] == pytest.approx(
        FILES[name]["good_import"]["curves"], rel=1e-3
    )
    for curve in read.curves:
        assert {-1, 1} <= set(curve.direction.tolist())


@pytest.mark.parametrize("name", REFUSED)
def test_the_named_options_make_it_readable(name: str) -> None:
    read, _, _ = understood(name, from_words(**REFUSED[name]))
    assert read is not None


def test_stated_voltages_stand_for_a_monitor_that_was_not_connected() -> None:
    read, _, _ = understood("rig_hv_all_zero.csv", from_words(voltage="0,1000,1500"))
    assert [curve.nominal_voltage for curve in read.curves] == [0.0, 1000.0, 1500.0]
    alone, _, _ = understood("rig_hv_all_zero.csv")
    assert len(alone.curves) == 1, "sweeps of unknown voltage are no film at 0 V"
