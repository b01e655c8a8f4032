"""The panel in a browser, beside runs in real time over pseudo-terminals; judged by the supply's own output."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from rig.benchmark.stand import Stand
from rig.log.reader import read_log
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.sim.settings import Fault
from tests.rig.panel.ten_hours import ten_hours

playwright = pytest.importorskip("playwright.sync_api", reason="needs the dependency group browser")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"),
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
    pytest.mark.slow,
]
PROMPT = """
title = "A question first"
[[step]]
do = "home"
[[step]]
do = "prompt"
text = "Is the lid closed?"
[[step]]
do = "zero"
duration_s = 0.4
"""


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=60.0) as stand:
        yield stand


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    # It draws on the processor here, and must not take it from the bench, which has two of them for everything.
    patient = tmp_path_factory.mktemp("browser") / "chromium"
    patient.write_text(f'#!/bin/sh\nexec nice -n 19 "{CHROMIUM}" "$@"\n')
    patient.chmod(0o700)
    with playwright.sync_playwright() as started:
        found = started.chromium.launch(executable_path=patient, args=["--no-sandbox"])
        yield found
        found.close()


class Live:
    """A run over the stand's ports, its panel's process, and the page."""

    def __init__(self, stand: Stand, browser: Any, folder: Path, protocol: Path) -> None:
        self.stand, self.log = stand, folder / "run.mcap"
        stand.bench.power_cycle()
        ports = folder / "ports.json"
        ports.write_text(json.dumps({**stand.bench.ports, SERVED_BY: SERVER}))
        options = ["--arm", "--yes"] if protocol == stand.protocol else []
        self.run = process(folder / "run.txt", "run", stand.scene, protocol, "-o", self.log, "--ports", ports, *options)
        self.wait(lambda: self.log.with_name("run.mcap.part").exists(), "a log")
        self.panel, address = panel_of(self.log, folder / "panel.txt")
        self.page = browser.new_page()
        self.asked: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)

    def wait(self, done: Callable[[], bool], what: str, limit_s: float = 60.0) -> None:
        end = time.monotonic() + limit_s
        while not done():
            said = (self.log.parent / "run.txt").read_text()[-1500:]
            assert time.monotonic() < end, f"waited in vain for {what}: {said}"
            time.sleep(0.02)

    def state(self) -> str:
        return str(self.page.inner_text("#state-word"))

    def is_live(self) -> None:
        self.wait(lambda: self.stand.bench.voltage() > 700.0, "the supply's own output")
        self.wait(lambda: self.state() == "LIVE", "the word LIVE")

    def close(self) -> None:
        self.page.close()
        for started in (self.panel, self.run):
            started.terminate()
            started.wait(20)


def process(said: Path, *arguments: str | Path) -> subprocess.Popen[bytes]:
    """A command; what it says goes into the file ``said``."""
    command = [sys.executable, "-m", "rig", *map(str, arguments)]
    with said.open("wb") as file:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)


def panel_of(log: Path, said: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A panel's process and its address."""
    panel, end = process(said, "watch", log, "--no-browser"), time.monotonic() + 120.0
    while not (found := re.search(r"http://\S+", said.read_text())):
        assert time.monotonic() < end and panel.poll() is None, said.read_text()
        time.sleep(0.05)
    return panel, found[0]


@pytest.fixture
def watched(stand: Stand, browser: Any, tmp_path: Path) -> Iterator[Callable[[Path], Live]]:
    lives: list[Live] = []

    def start(protocol: Path) -> Live:
        lives.append(Live(stand, browser, tmp_path, protocol))
        return lives[-1]

    yield start
    for live in lives:
        live.close()


@pytest.mark.parametrize("by", ["click", pytest.param("key", marks=pytest.mark.long)])
def test_stop_takes_the_voltage_off_and_the_log_says_who(
    watched: Callable[[Path], Live], stand: Stand, by: str
) -> None:
    live = watched(stand.protocol)
    live.is_live()
    first = live.page.evaluate("curves.force_mN.least.length")
    live.page.wait_for_timeout(1500)
    assert live.page.evaluate("curves.force_mN.least.length") > first  # the curves move
    pressed = time.monotonic()
    live.page.click("#stop") if by == "click" else live.page.keyboard.press("Escape")
    live.wait(lambda: abs(stand.bench.voltage()) < 60.0, "the supply's output to go off")
    took = time.monotonic() - pressed
    assert live.run.wait(30) == 130
    live.wait(lambda: live.state() == "SAFE", "the word SAFE")
    log = read_log(live.log)
    assert log.outcome is not None and log.outcome["status"] == "stopped" and log.outcome["safe"] == "yes"
    assert "the panel" in log.outcome["reason"]
    assert took < 5.0
    assert all(url.startswith("http://127.0.0.1:") for url in live.asked) and len(live.asked) > 10


def test_an_output_that_stays_on_is_shown_in_red_within_a_second(watched: Callable[[Path], Live], stand: Stand) -> None:
    live = watched(stand.protocol)
    live.is_live()
    stand.bench.do(lambda bench: bench.inject(Fault(role="hv", kind="stuck_on")))
    try:
        live.page.keyboard.press("Escape")  # Stop by its key: a safe end by it is tried on demand, above
        live.wait(lambda: live.log.exists(), "the finished log")
        ended = time.monotonic()
        live.wait(lambda: live.state() == "NOT SAFE", "the words NOT SAFE", 5.0)
        assert time.monotonic() - ended < 1.0
        colour = live.page.evaluate("getComputedStyle(document.getElementById('state')).backgroundColor")
        red, green, blue = map(int, re.findall(r"\d+", colour)[:3])
        assert red > 100 and green < 40 and blue < 40
        assert stand.bench.voltage() > 60.0  # it is true
        outcome = read_log(live.log).outcome
        assert outcome is not None and "the panel" in outcome["reason"]
    finally:
        stand.bench.do(lambda bench: setattr(bench.instruments["hv"], "stuck_on", False))


def test_a_prompt_is_answered_on_the_page(watched: Callable[[Path], Live], stand: Stand, tmp_path: Path) -> None:
    protocol = tmp_path / "prompt.toml"
    protocol.write_text(PROMPT)
    live = watched(protocol)
    live.wait(lambda: live.page.is_visible("#question"), "the question")
    assert "Is the lid closed?" in live.page.inner_text("#question-text")
    live.page.fill("#answer-text", "closed by Ann")
    live.page.click("#answer button")
    assert live.run.wait(60) == 0
    messages = [message.fields["message"] for message in read_log(live.log).messages("/event")]
    assert any("closed by Ann" in message and "the panel" in message for message in messages)


def test_a_killed_run_is_unknown_and_its_data_are_said_to_be_old(watched: Callable[[Path], Live], stand: Stand) -> None:
    live = watched(stand.protocol)
    live.is_live()
    live.run.kill()
    live.wait(lambda: live.state() in ("UNKNOWN", "SAFE", "NOT SAFE"), "a word that is not LIVE", 5.0)
    live.page.wait_for_timeout(2500)
    assert live.state() == "UNKNOWN"
    assert live.page.is_visible("#old") and "old" in live.page.inner_text("#old")


def test_a_panel_that_is_gone_is_said_on_the_page(watched: Callable[[Path], Live], stand: Stand) -> None:
    live = watched(stand.protocol)
    live.is_live()
    live.panel.kill()
    live.wait(lambda: live.state() == "UNKNOWN", "the word UNKNOWN", 5.0)
    assert "has not answered" in live.page.inner_text("#old")


@pytest.mark.parametrize(("width", "height", "scheme"), [(1400, 1000, "light"), (390, 844, "dark")])
def test_it_fits_a_desk_and_a_phone(browser: Any, tmp_path: Path, width: int, height: int, scheme: str) -> None:
    log = Path(str(files("sim_fixtures"))) / "logs/paper/log.mcap"
    panel, address = panel_of(log, tmp_path / "panel.txt")
    page = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme).new_page()
    try:
        page.goto(address)
        end = time.monotonic() + 60.0
        while page.evaluate("outlook === null"):
            assert time.monotonic() < end
            page.wait_for_timeout(100)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        word, stop = page.locator("#state-word").bounding_box(), page.locator("#stop").bounding_box()
        assert word["height"] >= 35 and stop["y"] < 200 and stop["x"] + stop["width"] <= width
        page.wait_for_timeout(300)
        page.screenshot(path=tmp_path / "panel.png", full_page=True)
    finally:
        page.close()
        panel.terminate()
        panel.wait(10)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_ten_hours_do_not_grow_the_browsers_memory(browser: Any, tmp_path: Path) -> None:
    """Objects that are left when garbage is collected, and nodes of the page, from 1 to 10 hours of a log.

    The page is opened at half an hour: what it makes with the first new data is there at one.
    """
    log = tmp_path / "long.mcap"
    panel: subprocess.Popen[bytes] | None = None
    page = browser.new_page()
    held: list[tuple[float, float]] = []
    try:
        for t in ten_hours(log):
            if panel is None:
                panel, address = panel_of(log, tmp_path / "panel.txt")
                page.goto(address)
                asked = page.context.new_cdp_session(page)
                asked.send("Performance.enable")
            end = time.monotonic() + 120.0
            while float(page.evaluate("last ? last.t_s : 0")) < t - 2.0:
                assert time.monotonic() < end
                page.wait_for_timeout(200)
            page.wait_for_timeout(3000)
            asked.send("HeapProfiler.collectGarbage")
            found = {one["name"]: one["value"] for one in asked.send("Performance.getMetrics")["metrics"]}
            held.append((found["JSHeapUsedSize"] / 2**20, found["Nodes"]))
    finally:
        page.close()
        if panel is not None:
            panel.terminate()
            panel.wait(20)
    print("heap (MiB) and nodes after 0.5, 1, 4, 7 and 10 h:", held)
    assert held[-1][0] <= 1.1 * held[1][0]
    assert held[-1][1] <= 1.1 * held[1][1]
