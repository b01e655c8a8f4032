"""``dea-rig analyse breakdown``: tables in, numbers out; what is unclear is asked for with exit code 2."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.cli.app import main

VALUES = (4.12, 4.55, 3.71, 4.91, 4.02, 3.12, 3.55, 2.91, 3.61, 3.42)
GOOD = "voltage_kV,censored\n" + "".join(f"{value},no\n" for value in VALUES) + "5.0,yes\n"


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["analyse", "breakdown", "--simulated", "200", *map(str, arguments)])


def numbers(folder: Path, name: str, text: str) -> dict[str, object]:
    table, out = folder / name, folder / f"{name}.json"
    table.write_text(text, encoding="utf-8")
    done = call(table, "-o", out)
    assert done.exit_code == 0, done.output
    found: dict[str, object] = json.loads(out.read_text(encoding="utf-8"))
    specimens = found["specimens"]
    assert isinstance(specimens, list)
    for number, one in enumerate(specimens, 1):  # without a name of its own it has the file's
        assert one.pop("specimen") == f"{table}, specimen {number}"
    return found


def test_units_separators_and_formats_give_the_same_numbers(tmp_path: Path) -> None:
    expected = numbers(tmp_path, "a.csv", GOOD)
    assert expected["unit"] == "V"
    comma = GOOD.replace(",", ";").replace(".", ",")
    toml = "".join(f"[[specimen]]\nvoltage_kV = {value}\ncensored = false\n" for value in VALUES)
    toml += "[[specimen]]\nvoltage_kV = 5.0\ncensored = true\n"
    for name, text in (("b.csv", comma), ("c.csv", GOOD.replace(",", "\t")), ("d.toml", toml)):
        assert numbers(tmp_path, name, text) == expected


def test_failures_whose_values_are_upper_bounds_are_told_and_counted(tmp_path: Path) -> None:
    rows = [f"{value},no,{'yes' if k < 3 else 'no'}" for k, value in enumerate(VALUES)]
    table, out = tmp_path / "a.csv", tmp_path / "a.json"
    table.write_text("voltage_kV,censored,upper_bound\n" + "\n".join([*rows, "5.0,yes,"]), encoding="utf-8")
    done = call(table, "-o", out)
    assert done.exit_code == 0, done.output
    assert "3 of 10 failures come from supplies that measure no current" in " ".join(done.output.split())
    found = json.loads(out.read_text(encoding="utf-8"))
    assert found["upper_bounds_taken_as_exact"] == 3
    assert [one["upper_bound"] for one in found["specimens"]] == [True] * 3 + [False] * 8


def test_plot_and_groups(tmp_path: Path) -> None:
    rows = [f"{value},no,{'new' if k < 5 else 'old'}" for k, value in enumerate(VALUES)]
    table = tmp_path / "a.csv"
    table.write_text("field_V_per_um,censored,group\n" + "\n".join(rows), encoding="utf-8")
    done = call(table, "--plot", tmp_path / "a.svg", "-o", tmp_path / "a.json")
    assert done.exit_code == 0, done.output
    assert "<svg" in (tmp_path / "a.svg").read_text(encoding="utf-8")
    found = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert found["unit"] == "V/m" and found["groups"]["names"] == ["new", "old"]
    assert found["groups"]["p_scale"] < 0.05 and "groups differ in scale" in done.output


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("voltage_kV,censored\n", "no specimen below"),
        (GOOD.replace("voltage_kV", "voltage"), "Which unit is it in? voltage_V or voltage_kV"),
        (GOOD.replace("censored", "cenosred"), "Is it censored?"),
        ("voltage_kV\n4\n5\n", "no column censored"),
        (GOOD.replace("3.71,no", "3.71,maybe"), "line 4: censored"),
        (GOOD.replace("3.71,no", "3.71,"), "line 4: censored is empty"),
        (GOOD.replace("3.71", "nan"), "line 4: voltage_kV"),
        (GOOD.replace("3.71", "-3.71"), "above 0"),
        (GOOD.replace("3.71", "3,71"), "3 cells, but 2 columns"),
        (GOOD.replace("3.71", ""), "has no voltage_kV"),
        (GOOD.replace("voltage_kV", "voltage_V"), "another unit"),
        (GOOD.replace("voltage_kV", "area_mm2"), "no column with a value"),
        (GOOD.replace(",no", ",yes"), "0 of 11 specimens failed"),
        ("voltage_kV,censored\n4.0,no\n4.0,no\n5.0,yes\n", "two failures at different values"),
        ("specimen,voltage_kV,censored\na,4.0,no\na,4.5,no\n", 'specimen "a" stands also'),
        ("voltage_kV,voltage_V,censored\n4.0,4000,no\n5,5000,no\n", "Keep one column"),
        ("\0\0", "zero byte"),
    ],
)
def test_what_cannot_be_used_is_told_and_nothing_is_written(tmp_path: Path, text: str, said: str) -> None:
    table, out = tmp_path / "a.csv", tmp_path / "out.json"
    table.write_text(text, encoding="utf-8")
    done = call(table, "-o", out)
    assert done.exit_code == 2, done.output
    assert said in done.output
    assert not out.exists()


def test_the_same_file_twice_and_a_missing_one_are_refused(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text(GOOD, encoding="utf-8")
    assert call(table, table).exit_code == 2
    assert call(tmp_path / "none.csv").exit_code == 2
