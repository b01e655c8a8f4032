"""The benchmark of rates: structure, files, and that nothing is lost. Shares of a core are measured, never tested."""

from __future__ import annotations

import io
import json
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rig.benchmark import rates
from rig.scene.scene import load_scene

posix = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
NOISE = 0.01


@pytest.fixture(scope="module")
def report() -> rates.Report:
    shares: list[float] = []
    found = rates.measure(2.0, network=False, whole_run=False, progress=lambda share, what: shares.append(share))
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 1.05
    return found


@pytest.mark.slow
@posix
def test_nothing_is_lost_and_every_instrument_answers(report: rates.Report) -> None:
    (row,) = report.rows
    assert row.what == rates.DRIVERS
    assert row.lost == 0
    # A stall of the machine may hold back what comes at the end; half of it would be another rate.
    assert 0.5 * row.expected < row.received < 1.5 * row.expected
    assert row.seconds >= 2.0
    assert {polled.role for polled in row.polled} == {"stage", "displacement"}
    for polled in row.polled:
        assert 0 < polled.reached_Hz <= 1.5 * polled.wanted_Hz
        assert 0 < polled.round_trip_mean_ms <= polled.round_trip_max_ms
        assert polled.retries >= 0
        assert polled.missed >= 0
    assert 0 < row.host_share <= 1.5
    assert row.used_of_allowed == row.host_share / 0.25


@pytest.mark.slow
@posix
def test_files_and_tables_hold_the_same_numbers(report: rates.Report, tmp_path: Path) -> None:
    rates.save(report, tmp_path)
    (saved,) = json.loads((tmp_path / "rates.json").read_text(encoding="utf-8"))["rows"]
    (row,) = report.rows
    assert saved["received"] == row.received
    assert saved["host_share"] == row.host_share
    assert (tmp_path / "rates.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(rates.render(report))
    text = console.export_text()
    for wanted in (rates.DRIVERS, str(row.received), "used/allowed", "load before"):
        assert wanted in text


@posix
@pytest.mark.slow
def test_no_frame_of_some_thousands_is_lost_beside_stage_and_laser() -> None:
    (row,) = rates.measure(4.0, network=False, whole_run=False).rows
    assert row.lost == 0 and row.seconds >= 4.0
    wanted = {polled.role: polled.wanted_Hz for polled in row.polled}
    assert (rates.FORCE_HZ, wanted) == (1000.0, {"stage": 50.0, "displacement": 100.0})
    assert all(polled.reached_Hz > 0 for polled in row.polled)


@posix
@pytest.mark.slow
def test_a_labjack_and_a_meter_over_tcp_answer_all_that_is_asked() -> None:
    _, row = rates.measure(3.0, whole_run=False).rows
    assert row.what == rates.NETWORK and math.isfinite(row.host_share)
    assert {polled.role: polled.wanted_Hz for polled in row.polled} == rates.NETWORK_HZ
    for polled in row.polled:
        assert polled.retries == 0 or polled.round_trip_max_ms > 1000.0, polled
        assert 0 < polled.round_trip_mean_ms <= polled.round_trip_max_ms
        assert 0 < polled.reached_Hz <= 1.5 * polled.wanted_Hz


@posix
@pytest.mark.slow
def test_a_whole_run_loses_nothing() -> None:
    _, row = rates.measure(1.0, network=False).rows
    assert row.what == rates.WHOLE_RUN
    assert row.lost == 0
    assert set(row.shares) == ({"loop", "guard", "log"} if sys.platform == "linux" else {"loop"})
    assert all(share > 0 for share in row.shares.values()) and row.host_share == sum(row.shares.values())
    assert row.received > 5000


def test_the_scene_has_the_rates_that_are_promised(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(rates.scene_text(), encoding="utf-8")
    scene, _ = load_scene(path)
    assert scene.force.rate_Hz == 1000
    assert scene.stage.poll_rate_Hz == 50
    assert scene.displacement is not None
    assert scene.displacement.poll_rate_Hz == 100
    assert len(rates.sent_readings(scene, 1.0)) == pytest.approx(1000, abs=3)


def readings(count: int = 5000) -> tuple[np.ndarray, np.ndarray]:
    """What was sent at no force, and the same with a slow force on it."""
    sent = NOISE * np.random.default_rng(3).standard_normal(count)
    return sent, sent + 0.5 * np.sin(np.arange(count) / 1500)


def test_samples_are_counted_by_their_noise_whatever_the_force() -> None:
    sent, received = readings()
    assert rates.count_lost(received[700:4000], sent, NOISE) == 0
    assert rates.count_lost(np.delete(received, 2000), sent, NOISE) == 1
    assert rates.count_lost(np.delete(received, [900, 901, 902, 2500]), sent, NOISE) == 4
    assert rates.count_lost(np.delete(received, [900, 907, 915, 916, 2500]), sent, NOISE) == 5
    assert rates.count_lost(np.delete(received, np.arange(1000, 3500)), sent, NOISE) == 2500


def test_a_jump_of_the_force_is_no_loss() -> None:
    sent, received = readings()
    received[2000:] += 1.0
    assert rates.count_lost(received, sent, NOISE) == 0


def test_readings_that_were_never_sent_are_refused() -> None:
    sent, received = readings()
    with pytest.raises(ValueError, match="did not send"):
        rates.count_lost(np.concatenate([received[:2000], received[1900:]]), sent, NOISE)
    with pytest.raises(ValueError, match="did not send"):
        rates.count_lost(received[::-1], sent, NOISE)
    with pytest.raises(ValueError, match="too few"):
        rates.count_lost(received[:10], sent, NOISE)
