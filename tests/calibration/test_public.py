"""The public names of the package, and the example of its page."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import calibration
from calibration import CurveError, Material, Specimen, curves_from_frame, frame_of, identify
from model.membrane.solve import solve_many

FILM = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)
CONE = Specimen(4e-3, 20e-3, 40e-6, 1.2, FILM, name="cone")
PAGE = Path(calibration.__file__).with_name("README.md")


def test_every_public_name_is_there_and_no_other() -> None:
    for name in calibration.__all__:
        assert getattr(calibration, name) is not None
    assert set(calibration.__all__) <= set(dir(calibration))
    with pytest.raises(AttributeError, match="no attribute 'idenfity'"):
        calibration.idenfity  # noqa: B018


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = "import sys, calibration; print(any(m in sys.modules for m in ('numpy', 'scipy', 'lmfit', 'matplotlib')))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "False"


def test_the_example_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    exec(compile(code, str(PAGE), "exec"), {"__name__": "example"})
    assert "stiffness" in capsys.readouterr().out


def test_a_table_becomes_one_curve_a_voltage_and_the_film_comes_back() -> None:
    way = np.concatenate((np.linspace(0.5, 11.0, 30), np.linspace(11.0, 0.5, 30)))
    volts = np.repeat((0.0, 1.5), way.size)
    h = np.tile(way, 2)
    force = solve_many(CONE, 1e-3 * h, 1e3 * volts).force
    noise = 1e-4 * np.random.default_rng(1).standard_normal(h.size)
    table = {"h_mm": h, "force_mN": 1e3 * (force + noise), "voltage_kV": volts, "time_s": np.arange(h.size) * 0.5}
    curves = curves_from_frame(table, CONE, force_noise=1e-4, thickness_uncertainty=0.0)
    assert [(curve.nominal_voltage, curve.h.size) for curve in curves] == [(0.0, 60), (1500.0, 60)]
    assert curves[1].direction.sum() == 0 and curves[0].thickness_uncertainty == 0.0
    assert "prestretch_uncertainty" in curves[0].assumed
    found = identify(curves, terms=1, starts=1)
    columns = frame_of(found)
    assert set(map(len, columns.values())) == {len(found.quantities)}
    eps = columns["value"][columns["quantity"].index("eps_r")]
    assert eps == pytest.approx(1.7, rel=0.01)


def test_what_a_table_lacks_is_named() -> None:
    with pytest.raises(CurveError, match="h_mm or h_um or h_m"):
        curves_from_frame({"force_N": [1.0]}, CONE, force_noise=1e-3)
    with pytest.raises(CurveError, match="column h_mm: it holds something that is no number"):
        curves_from_frame({"h_mm": ["one"], "force_N": [1.0]}, CONE, force_noise=1e-3)
