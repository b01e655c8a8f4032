"""The queue of a campaign beside one of its runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.campaign.campaign import load_campaign
from rig.log.writer import LogWriter
from rig.panel.queue import queue_of
from tests.rig.panel.conftest import served

NS = 1_700_000_000 * 10**9
EVENT = {"t_s": 0.0, "severity": "info", "source": "x", "message": "y"}


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Three specimens: the first done, the second failed, the third waits."""
    logs = tmp_path / "logs"
    logs.mkdir()
    names = "".join(f'[[specimen]]\nname = "{name}"\nbatch = "A"\nnote = "<b>"\n' for name in ("one", "two", "three"))
    file = tmp_path / "campaign.toml"
    file.write_text(f'title = "Films"\nscene = "scene.toml"\nprotocol = "protocol.toml"\n{names}')
    for name, status in (("one", "complete"), ("two", "fault")):
        with LogWriter(logs / f"{name}.mcap") as log:
            log.write("/event", EVENT, NS, NS)
            log.finish({"status": status, "safe": "yes"})
    return file


def test_the_page_of_a_run_has_the_queue_of_its_campaign(campaign: Path) -> None:
    loaded = load_campaign(campaign)
    path = loaded.logs / "three.mcap"
    with LogWriter(path) as log:
        log.metadata("campaign", loaded.told(loaded.specimens[2]))
        log.write("/event", EVENT, NS, NS)
        log.tick(0.0)
        log.tick(1.0)
        with served(path) as caller:
            page = caller.wait(path, lambda page: bool(page["queue"]))
        log.finish({"status": "complete", "safe": "yes"})
    queue = page["queue"]
    assert (queue["title"], queue["done"], queue["of"]) == ("Films", 1, 3)
    assert [row["is"] for row in queue["rows"]] == ["done", "failed", "running"]
    assert queue["words"] == "1 done, 1 failed, 1 running"
    assert [row["is"] for row in queue_of(path, loaded.told(loaded.specimens[2]))["rows"]] == ["done", "failed", "done"]


@pytest.mark.parametrize("told", [{}, {"file": "../gone.toml"}, {"file": "../logs/one.mcap"}, {"file": "/dev/null"}])
def test_a_campaign_that_is_not_there_shows_nothing(campaign: Path, told: dict[str, str]) -> None:
    assert queue_of(campaign.parent / "logs" / "one.mcap", told) == {}
