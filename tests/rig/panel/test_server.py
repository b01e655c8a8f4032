"""The panel's server: what it says of finished logs, and whom it lets in."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.log.reader import read_log
from rig.log.writer import LogWriter

LOGS = Path(str(files("sim_fixtures"))) / "logs"
PAPER = LOGS / "paper" / "log.mcap"
Serve = Callable[[Path | None], Any]


@pytest.fixture(scope="module")
def caller(serve: Serve) -> Iterator[Any]:
    """One who asks a panel that has read the paper's log whole; nothing that is asked changes it."""
    with serve(PAPER) as caller:
        caller.wait(PAPER, lambda page: page["ended"])
        yield caller


def test_a_finished_log_is_shown_whole(caller: Any) -> None:
    page = caller.wait(PAPER, lambda page: page["ended"] and page["outlook"])
    log = read_log(PAPER)
    assert page["state"] == "SAFE" and page["simulated"] and page["outcome"]["status"] == "complete"
    force = log.columns("/force/sample")
    peak = max(value for value in page["traces"]["force_mN"]["largest"] if value is not None)
    assert peak == pytest.approx(np.nanmax(force["force_N"]) * 1e3, rel=1e-4)
    levels = {point[2] for point in page["loop"]["points"]}
    assert levels == {0.0, 1000.0, 1500.0}
    film = page["outlook"]["film"]
    assert film["voltages_V"] == [0.0, 1000.0, 1500.0] and film["force_mN"][0][-1] > film["force_mN"][2][-1] > 0
    assert page["phases"] == len(page["outlook"]["steps"])


def test_the_loop_lies_where_force_and_displacement_were_at_the_same_time(caller: Any) -> None:
    """Against the aligned data set, which is made another way."""
    from rig.log.dataset import load_run

    run = load_run(PAPER)
    points = caller.wait(PAPER, lambda page: page["ended"])["loop"]["points"]
    assert len(points) > 100
    for h, force, _ in points[::7]:
        near = abs(run.h * 1e3 - h) < 0.05
        assert (abs(run.force[near] * 1e3 - force) < 0.02 * abs(force) + 1.5).any()


@pytest.mark.parametrize(
    ("name", "state"), [("no-hv", "NO HIGH VOLTAGE"), ("breakdown", "SAFE"), ("wrinkled", "SAFE"), ("no-laser", "SAFE")]
)
def test_the_state_of_finished_logs(serve: Serve, name: str, state: str) -> None:
    log = LOGS / name / "log.mcap"
    with serve(log) as caller:
        page = caller.wait(log, lambda page: page["ended"])
    assert page["state"] == state
    assert page["latest"]["displacement_mm"] is not None


def test_an_output_that_was_not_proved_off_is_never_called_safe(serve: Serve, tmp_path: Path) -> None:
    path = tmp_path / "stuck.mcap"
    log = LogWriter(path)
    sample = {"t_s": 1.0, "voltage_V": 3.0, "current_A": 0.0, "setpoint_V": 0.0, "flags": 0}
    log.write("/hv/sample", sample, 10**9, 10**9)
    log.finish({"status": "stopped", "reason": "Ctrl-C", "safe": "NO"})
    with serve(path) as caller:
        assert caller.wait(path, lambda page: page["ended"])["state"] == "NOT SAFE"


def test_a_log_without_a_run_behind_it_is_old_and_its_voltage_unknown(serve: Serve) -> None:
    """A log that nobody goes on with and that has no end: what it measured last is not what is."""
    log = LOGS / "killed" / "log.mcap"
    with serve(log) as caller:
        page = caller.wait(log, lambda page: page["age_s"] > 1.0)
    assert not page["ended"] and page["state"] == "UNKNOWN"


@pytest.mark.parametrize(
    ("method", "path", "headers"),
    [
        ("GET", "/", {"Cookie": None}),
        ("GET", "/", {"Cookie": "dea-rig-1=x"}),
        ("GET", "/?token=wrong", {"Cookie": None}),
        ("GET", "/panel.js", {"Cookie": None}),
        ("GET", "/runs", {"Cookie": None}),
        ("GET", "/", {"Host": "evil.example"}),
        ("GET", "/", {"Host": None}),
        ("GET", "/", {"Host": "127.0.0.1"}),
        ("POST", "/data", {"Cookie": None}),
        ("POST", "/say", {"Cookie": None}),
        ("POST", "/say", {"Origin": None}),
        ("POST", "/say", {"Origin": "http://evil.example"}),
        ("POST", "/say", {"Origin": "http://127.0.0.1:1"}),
        ("POST", "/say", {"Origin": "null"}),
        ("POST", "/say", {"Host": "evil.example"}),
    ],
)
def test_who_is_not_the_page_is_refused(caller: Any, method: str, path: str, headers: dict[str, str | None]) -> None:
    body = {"log": str(PAPER), "text": "stop"} if method == "POST" else None
    status, _, content = caller.ask(method, path, body, **headers)
    assert status == 403 and b"{" not in content


def test_the_token_becomes_a_cookie_and_leaves_the_address(caller: Any) -> None:
    status, headers, _ = caller.ask("GET", f"/?token={caller.panel.token}", Cookie=None)
    assert status == 303 and headers["Location"] == "/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
    status, headers, page = caller.ask("GET", "/")
    assert status == 200 and b"STOP" in page and "default-src 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ([], 400),
        ({"log": "/etc/passwd", "text": "stop"}, 404),
        ({"log": str(PAPER.resolve()), "text": 5}, 400),
        ({"log": str(PAPER.resolve()), "text": "x" * 501}, 400),
        ({"log": str(PAPER.resolve()), "text": "x" * 20000}, 413),
        ({"log": str(PAPER.resolve()), "text": "stop"}, 409),  # the run of this log has ended
    ],
)
def test_a_bad_request_is_refused_and_the_server_goes_on(caller: Any, body: object, status: int) -> None:
    assert caller.ask("POST", "/say", body)[0] == status
    assert caller.data(PAPER)["log"] == "log.mcap"


@pytest.mark.parametrize(
    "seen", [{"loop": "x"}, {"force_mN": [1]}, {"force_mN": [0, -5]}, {"loop": [0, 10**9]}, {"x": None}]
)
def test_nonsense_about_what_was_seen_gets_everything(caller: Any, seen: dict[str, Any]) -> None:
    page = caller.data(PAPER, **seen)
    assert page["loop"]["first"] == 0 and page["traces"]["force_mN"]["first"] == 0


def test_the_page_names_nothing_outside_itself() -> None:
    for name in ("panel.html", "panel.js", "panel.css"):
        text = (files("rig.panel") / "page" / name).read_text(encoding="utf-8")
        assert not re.search(r"https?:|//[a-z]|@import|url\(", text.replace("// ", "")), name
        assert json.dumps(text)
