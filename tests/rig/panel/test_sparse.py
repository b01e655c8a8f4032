"""The panel beside a run whose log leaves most out: what it shows is what the run says that it measures now."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.operator.status import Status
from rig.panel import run_view
from rig.panel.run_view import OLD_S, RunView, State

NS = 1_700_000_000 * 10**9


def test_a_live_film_is_seen_though_its_log_has_no_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    control, t = Control(), 10.0
    live: list[dict[str, str]] = []

    def say() -> dict[str, str]:
        nonlocal t
        t += 0.25
        control.measured = Status(1, 1, 0.5, 9.0, "", 0.1, 2e-3, 600.0, 1e-7).measured(t)
        live.append(control.describe())
        return live[-1]

    monkeypatch.setattr(run_view, "live_run", lambda path: SimpleNamespace(send=lambda text: say()))
    with LogWriter(tmp_path / "a.mcap") as log:
        sample = {"t_s": 9.0, "voltage_V": 5.0, "current_A": 0.0, "setpoint_V": 0.0, "flags": 0}
        log.write("/hv/sample", sample, NS, NS)
        log.write("/kept", {"t_s": 9.1, "keeping": False, "before_s": 0.0, "cause": "cycle 11"}, NS, NS)
        log.write("/hv/sample", sample | {"t_s": 9.2}, NS, NS)
        log.tick(0.0)
        log.tick(3.0)
        view = RunView(log.part)
        try:
            end = time.monotonic() + 20.0
            while view.state is not State.LIVE:
                assert time.monotonic() < end, view.page({})
                time.sleep(0.02)
            page = view.page({})
            assert page["latest"]["voltage_V"] == 600.0 and page["latest"]["displacement_mm"] == 2.0
            assert page["age_s"] < OLD_S and page["t_s"] > 10.0
        finally:
            view.close()
            log.finish({})
    assert "t_s" not in Control().describe()  # a log that keeps everything speaks for itself
