"""A run with monitors, from the scene to the report's environment: recorded, shown, replayed and run again."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from rig.analysis.film import said_in
from rig.log.info import info
from rig.log.reader import read_log
from rig.operator.status import Status
from rig.panel.run_view import RunView, State
from rig.protocol.experiment import prepare
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify
from rig.run.run import run
from tests.protocols import TO_THE_FILM

pytestmark = pytest.mark.slow

FIXTURES = Path(str(files("sim_fixtures")))
MONITORS = """
[monitor]
driver = "labjack-monitor"
quantity = "voltage"
factor = 1000.0
certificate = "../calibrations/hv.toml"

[monitor_2]
driver = "scpi"
quantity = "temperature"
query = "MEAS:TEMP?"

[monitor_3]
driver = "ascii-stream"
quantity = "humidity"
rate_Hz = 2.0

[simulation.monitor_2]
units_per_number = 1.0

[simulation.monitor_3]
print_rate_Hz = 2.0

[simulation]
"""
VOLTAGE = (
    '\n[[step]]\ndo = "voltage"\nvoltage_V = 500\nsettle_s = 0.5\n\n[[step]]\ndo = "return"\nspeed_mm_per_s = 4.0\n'
)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[Status]]]:
    folder = tmp_path_factory.mktemp("monitors")
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace("../", f"{FIXTURES.as_posix()}/")
    monitors = MONITORS.replace("../", f"{FIXTURES.as_posix()}/")
    for old, new in (
        ("[simulation]\n", monitors),
        ("approach_from_mm = 36.0", "approach_from_mm = 13.0"),
        ("contact_position_mm = 40.0", "contact_position_mm = 17.0"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    scene, protocol = folder / "scene.toml", folder / "protocol.toml"
    scene.write_text(text)
    protocol.write_text(f'title = "Monitors"\n{TO_THE_FILM}{VOLTAGE}')
    seen: list[Status] = []
    outcome = run(prepare(scene, protocol), folder / "run.mcap", lambda *_: None, show=seen.append)
    assert outcome.safe and outcome.second.startswith("the second reading of the voltage (monitor) shows")
    yield folder / "run.mcap", seen


def test_it_is_replayed_bit_for_bit_and_run_again(told: tuple[Path, list[Status]]) -> None:
    recording = load_recording(told[0])
    verified = verify(recording)
    assert verified.exit_code == 0, verified.report
    assert {"monitor", "monitor_2", "monitor_3"} <= {role for role, n in verified.samples.items() if n > 5}
    again = rerun(recording)
    assert again.exit_code == 0, again.report


def test_it_is_shown_and_stands_in_the_environment_of_the_report(told: tuple[Path, list[Status]]) -> None:
    path, seen = told
    log = read_log(path)
    session: Any = said_in([log])["session"][str(path)]
    assert session["measured_temperature_C"].startswith("23.") or session["measured_temperature_C"].startswith("22.9")
    assert float(session["measured_humidity_percent"].split()[0]) == pytest.approx(45.0, abs=0.5)
    assert "measured_temperature_C" in info(path) and "(monitor) shows" in info(path)
    live = max(seen, key=lambda status: status.second if status.second == status.second else 0.0)
    assert live.second == pytest.approx(500.0, abs=5.0) and "second reading 50" in live.numbers.replace("49", "50")
    view = RunView(path)
    try:
        page = view.page({})
        assert view.state is State.SAFE and abs(page["latest"]["second_V"]) < 60.0
        assert page["latest"]["measured_humidity_percent"] == pytest.approx(45.0, abs=1.0)
        view._metadata.pop("outcome")  # as if it went on, with data that are fresh
        view._arrived = float("inf")
        view._latest["second_V"] = 300.0
        assert view.state is State.LIVE
    finally:
        view.close()
