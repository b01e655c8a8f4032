import math
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from time import process_time

import numpy as np
import pytest

from model.material.materials import NAMED
from model.specimen import Specimen
from rig.log.dataset import Phase, interpolate, load_run
from rig.log.errors import LogError
from rig.log.writer import LogWriter

SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"], name="film")
GAIN = 2.0  # N per mV/V


def truth_h(t):
    """Stands still until 1 s, then 0.5 mm/s up for 2 s and down again."""
    return 0.5e-3 * np.clip(2.0 - np.abs(np.asarray(t) - 3.0), 0.0, None)


def truth_force(t):
    return 30.0 * truth_h(t)


def write_run(
    path: Path, *, laser: bool = True, hv: bool = True, lost=(), flagged=(), zero_at: float = 0.5, certificate=b""
) -> None:
    """A ramp up and down at 1000 V: force at 100 Hz, laser and stage at 50 Hz, supply at 10 Hz.

    ``lost`` and ``flagged`` are intervals without, and with flagged, displacement samples.
    """
    with LogWriter(path) as log:

        def write(topic: str, t: float, **fields: object) -> None:
            ns = round((100.0 + t) * 1e9)
            log.write(topic, {"t_s": t, **fields}, ns, ns)

        log.attach("scene.toml", "application/toml", b"[specimen]\n")
        if certificate:
            log.attach("certificate.displacement.toml", "application/toml", certificate)
        phases = {
            0: (0, "zero", 0, False),
            100: (1, "sweep", 1, True),
            300: (1, "sweep", -1, True),
            500: (2, "return", 0, False),
        }
        for k in range(601):
            t = k / 100
            zero = 0.25 if t >= zero_at else math.nan
            if k in phases:
                step, kind, direction, record = phases[k]
                write("/phase", t, step=step, kind=kind, label=kind, cycle=0, direction=direction,
                      voltage_V=1000.0 if record else 0.0, record=record)  # fmt: skip
            if t == zero_at:
                write("/reference", t, name="force_zero", value=0.25, standard_uncertainty=1e-4, unit="mV/V")
                write("/reference", t, name="displacement_zero", value=2e-3, standard_uncertainty=1e-6, unit="m")
                write("/reference", t, name="contact_position", value=7e-3, standard_uncertainty=3e-6, unit="m")
            reading = 0.25 + float(truth_force(t)) / GAIN
            write("/force/sample", t, reading=reading, force_N=GAIN * (reading - zero), flags=4 * (k == 250))
            if k % 2 == 0:
                h = float(truth_h(t))
                write("/stage/sample", t, position_m=7e-3 + h, moving=False, referenced=True, raw_steps=k, warnings="")
                if laser and not any(a <= t <= b for a, b in lost):
                    bad = any(a <= t <= b for a, b in flagged)
                    value = math.nan if math.isnan(zero) else h
                    write("/displacement/sample", t, reading_m=2e-3 + h, displacement_m=value, flags=1 if bad else 0)
            if hv and k % 10 == 0:
                write("/hv/sample", t, voltage_V=1000.0 + t, current_A=0.0, setpoint_V=1000.0, flags=1)
        log.finish({"reason": "complete"})


@pytest.mark.parametrize("laser", [True, False], ids=["laser", "stage"])
def test_alignment_against_the_truth(tmp_path, laser):
    """Piecewise linear truth: linear interpolation must be exact away from the corners."""
    write_run(tmp_path / "a.mcap", laser=laser)
    run = load_run(tmp_path / "a.mcap")
    assert run.has_laser is laser
    assert run.t.tolist() == [k / 100 for k in range(601)]
    known = run.t >= 0.51
    assert np.isnan(run.force[~known][:-1]).all() and np.isnan(run.h[~known][:-1]).all()
    np.testing.assert_allclose(run.force[known], truth_force(run.t[known]), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(run.h[known], truth_h(run.t[known]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(run.voltage, 1000.0 + run.t, rtol=1e-12)
    assert run.force_per_reading == pytest.approx(GAIN, rel=1e-12)


def test_phases(tmp_path):
    write_run(tmp_path / "a.mcap")
    run = load_run(tmp_path / "a.mcap")
    assert [phase.kind for phase in run.phases] == ["zero", "sweep", "sweep", "return"]
    assert [run.phase[k] for k in (0, 99, 100, 299, 300, 499, 500, 600)] == [0, 0, 1, 1, 2, 2, 3, 3]


def test_gaps_stay_gaps(tmp_path):
    """One lost sample is bridged, half a second is not; a flagged sample is never bridged."""
    write_run(tmp_path / "a.mcap", lost=[(1.5, 1.5), (2.0, 2.5)], flagged=[(3.5, 3.5)])
    run = load_run(tmp_path / "a.mcap")
    missing = np.flatnonzero((run.t > 0.6) & np.isnan(run.h))  # rows are 10 ms apart, displacement samples 20 ms
    assert missing.tolist() == [*range(199, 252), 349, 350, 351]


def test_latency_is_taken_off(tmp_path):
    write_run(tmp_path / "a.mcap", laser=False)
    run = load_run(tmp_path / "a.mcap", latency={"stage": 0.1})
    rows = (run.t > 1.0) & (run.t < 2.8)
    np.testing.assert_allclose(run.h[rows], truth_h(run.t[rows] + 0.1), atol=1e-15)
    with pytest.raises(ValueError, match="lasser"):
        load_run(tmp_path / "a.mcap", latency={"lasser": 0.1})


def test_lags_of_the_certificates_in_the_log_are_taken_off(tmp_path):
    text = (Path(str(files("sim_fixtures"))) / "calibrations" / "displacement.toml").read_text()
    certificate = text.replace('role = "displacement"', 'role = "displacement"\nlag_s = 0.1')
    assert certificate != text
    write_run(tmp_path / "a.mcap", certificate=certificate.encode())
    for latency, seconds in ((None, 0.1), ({}, 0.0), ({"displacement": 0.2}, 0.2)):
        run = load_run(tmp_path / "a.mcap", latency)
        rows = (run.t > 1.0) & (run.t < 2.7)
        np.testing.assert_allclose(run.h[rows], truth_h(run.t[rows] + seconds), atol=1e-15)
    assert run.certificates["displacement"].lag == 0.1
    write_run(tmp_path / "b.mcap", certificate=b"lag_s = 'soon'")
    with pytest.raises(LogError, match=r"a certificate that cannot be used: certificate\.displacement\.toml inside"):
        load_run(tmp_path / "b.mcap")


def test_curves(tmp_path):
    write_run(tmp_path / "a.mcap")
    run = load_run(tmp_path / "a.mcap")
    (curve,) = run.curves(SPECIMEN, force_noise=1e-3, force_gain=2e-3)
    assert curve.run == "a.mcap"
    assert curve.specimen is SPECIMEN
    assert curve.nominal_voltage == 1000.0
    assert curve.h.size == 400
    assert curve.direction.tolist() == [1] * 200 + [-1] * 200
    assert curve.flagged.sum() == 1
    assert (curve.force_noise, curve.force_gain) == (1e-3, 2e-3)
    assert curve.force_zero == pytest.approx(GAIN * 1e-4)  # of the reference, in newtons
    assert curve.displacement_zero == 1e-6
    (given,) = run.curves(SPECIMEN, force_noise=1e-3, force_zero=5e-3)
    assert given.force_zero == 5e-3


def test_without_laser_the_contact_position_carries_the_uncertainty(tmp_path):
    write_run(tmp_path / "a.mcap", laser=False)
    (curve,) = load_run(tmp_path / "a.mcap").curves(SPECIMEN, force_noise=1e-3)
    assert curve.displacement_zero == 3e-6


def test_without_hv_the_voltage_is_zero(tmp_path):
    write_run(tmp_path / "a.mcap", hv=False)
    run = load_run(tmp_path / "a.mcap")
    assert not run.has_hv
    assert (run.voltage == 0.0).all()


def test_texts(tmp_path):
    write_run(tmp_path / "a.mcap")
    run = load_run(tmp_path / "a.mcap")
    assert run.scene == "[specimen]\n"
    with pytest.raises(LogError, match=r"no protocol\.toml inside"):
        _ = run.protocol


def test_a_log_without_force(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/event", {"t_s": 0.0, "severity": "info", "source": "x", "message": "y"}, 0, 0)
        log.finish({})
    with pytest.raises(LogError, match="no force samples"):
        load_run(tmp_path / "a.mcap")


def test_interpolate_edges():
    nan = math.nan
    t = np.array([0.0, 1.0, 2.0, 3.0])
    assert np.isnan(interpolate(np.array([-0.1, 3.1, nan]), t, t)).all()
    assert interpolate(np.array([0.0, 3.0, 1.5]), t, t).tolist() == [0.0, 3.0, 1.5]
    assert np.isnan(interpolate(np.array([1.5]), np.array([1.0]), np.array([1.0]))).all()
    assert np.isnan(interpolate(np.array([1.5]), np.array([]), np.array([]))).all()
    # out of order and twice the same time
    assert interpolate(np.array([0.5]), np.array([2.0, 0.0, 1.0, 1.0]), np.array([2.0, 0.0, 1.0, 1.0])).tolist() == [
        0.5
    ]


@pytest.mark.slow
def test_many_short_curves_take_time_in_proportion(tmp_path):
    """Twice the samples in twice the curves take twice as long, give or take, not four times."""
    write_run(tmp_path / "a.mcap")
    run = load_run(tmp_path / "a.mcap")

    def seconds(many):
        n = 20 * many
        t = np.arange(n) * 1e-2
        phases = [Phase(t[20 * k], k + 1, "sweep", "", 1, 1, 0.0, True) for k in range(many)]
        column = np.zeros(n)
        big = replace(
            run,
            t=t,
            force=column,
            h=column,
            voltage=column,
            flagged=column > 0,
            phase=np.arange(n) // 20,
            phases=phases,
        )
        began = process_time()
        curves = big.curves(SPECIMEN, force_noise=1e-3)
        took = process_time() - began
        assert len(curves) == many and all(curve.h.size == 20 for curve in curves)
        return took

    seconds(100)
    short, long = (min(seconds(many) for _ in range(3)) for many in (500, 2000))
    assert long < 8 * short  # measured 4; 16 where every curve looks at every sample
