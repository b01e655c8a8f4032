"""A pytest plugin for `.ci/mutants`: the tests are collected once, and each mutant is tried in a forked copy.

First all tests run in one copy with no mutant on, which tells what each place is executed by, how long each test takes
and which tests fail without any mutant (left out). Then each mutant has a copy of its own, in which only the tests that
execute its place run, the quick ones first, until one fails.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import pkgutil
import select
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mutant_switch
import pytest

PACKAGES = ("rig", "drivers", "calibration", "model")


def pytest_configure() -> None:
    """Import the whole product before any test: what modules do when they are imported belongs to no test."""
    for name in PACKAGES:
        package = importlib.import_module(name)
        for module in pkgutil.walk_packages(package.__path__, f"{name}."):
            if not module.name.endswith("__main__"):
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool:
    asked = json.loads(Path(os.environ["DEA_MUTANT_JOB"]).read_text(encoding="utf-8"))
    Trials(session, asked).run()
    return True


class Trials:
    """All mutants of one job, against the tests that were collected."""

    def __init__(self, session: pytest.Session, asked: dict[str, Any]) -> None:
        self._items = {item.nodeid: item for item in session.items}
        self._asked = asked
        self._folder = Path(asked["folder"])
        self._most: float = asked["seconds"]

    def run(self) -> None:
        hits = self._folder / "hits"
        if not hits.exists():
            hits.touch()
        at_import = {
            int(line.split(" ", 1)[0]) for line in hits.read_text(encoding="utf-8").splitlines() if line.endswith(" ")
        }
        failed = self._folder / "baseline.json"
        if not failed.exists():
            self._baseline(failed)
        seconds: dict[str, float] = json.loads(failed.read_text(encoding="utf-8"))
        by = self._executed_by(hits, seconds)
        mutant_switch.hits = ""
        for number in self._asked["numbers"]:
            if number in at_import:
                self._tell(number, "at import", 0.0, 0)
                continue
            tests = sorted(by[number], key=lambda name: seconds[name])
            begun = time.monotonic()
            test, tried = self._tried(number, tests, seconds)
            self._tell(
                number,
                test or ("survived" if tried == len(tests) else "survived nearby"),
                time.monotonic() - begun,
                tried,
            )

    def _tell(self, number: int, result: str, seconds: float, tests: int) -> None:
        with (self._folder / "results").open("a", encoding="utf-8") as file:
            file.write(
                json.dumps({"number": number, "result": result, "seconds": round(seconds, 1), "tests": tests}) + "\n"
            )

    def _baseline(self, path: Path) -> None:
        """Run all with no mutant on: for each test that passed how long it took."""
        names = [name for name in self._items if name not in set(self._asked["left_out"])]

        def body(say: Callable[[str], None]) -> None:
            for name, reports, seconds in run_each([self._items[name] for name in names]):
                if all(report.passed for report in reports):
                    say(f"{seconds:.3f} {name}")

        lines = in_a_copy(body, 6 * 3600.0)
        rows = (line.split(" ", 1) for line in lines)
        path.write_text(json.dumps({name: float(seconds) for seconds, name in rows}), encoding="utf-8")

    def _executed_by(self, hits: Path, seconds: dict[str, float]) -> dict[int, set[str]]:
        """The tests that execute each place; what a fixture of several tests executes belongs to all that use it."""
        users: dict[tuple[str, str], set[str]] = defaultdict(set)
        for name in seconds:
            for fixture in self._shared(name):
                users[fixture].add(name)
        by: dict[int, set[str]] = defaultdict(set)
        for line in hits.read_text(encoding="utf-8").splitlines():
            number, _, test = line.partition(" ")
            name, _, phase = test.rpartition(" ")
            if name not in self._items:
                continue
            found = {name}
            if phase == "(setup)":
                found.update(*(users[fixture] for fixture in self._shared(name)))
            by[int(number)] |= found & set(seconds)
        return by

    def _shared(self, name: str) -> list[tuple[str, str]]:
        info = self._items[name]._fixtureinfo.name2fixturedefs
        return [
            (key, found[-1].baseid)
            for key, found in info.items()
            if found[-1].scope != "function" and not key.startswith("tmp")
        ]

    def _tried(self, number: int, tests: list[str], seconds: dict[str, float]) -> tuple[str, int]:
        """The first test that fails, and how many were tried in the time allowed."""
        chosen, total = [], 0.0
        for name in tests:
            total += seconds[name]
            if chosen and total > self._most:
                break
            chosen.append(name)

        def body(say: Callable[[str], None]) -> None:
            mutant_switch.active = number
            os.environ["DEA_MUTANT"] = str(number)
            for name, reports, _ in run_each([self._items[name] for name in chosen]):
                if any(report.failed for report in reports):
                    say(name)
                    return

        try:
            lines = in_a_copy(body, 120.0 + 8.0 * self._most)
        except TimeoutError:
            return "does not end", len(chosen)
        return (lines[0] if lines else ""), len(chosen)


class _Reports:
    def __init__(self) -> None:
        self.reports: list[pytest.TestReport] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.reports.append(report)


def run_each(items: list[pytest.Item]) -> Iterator[tuple[str, list[pytest.TestReport], float]]:
    """Run one after the other; the reports and the duration of each."""
    for item, following in zip(items, [*items, None][1:], strict=True):
        kept = _Reports()
        item.config.pluginmanager.register(kept)
        begun = time.monotonic()
        try:
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
        finally:
            item.config.pluginmanager.unregister(kept)
        yield item.nodeid, kept.reports, time.monotonic() - begun


def in_a_copy(body: Callable[[Callable[[str], None]], None], seconds: float) -> list[str]:
    """The lines that ``body`` says in a forked copy of this process; its processes are ended with it."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.setsid()
        os.close(reading)
        nothing = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(nothing, descriptor)
        try:
            body(lambda line: os.write(writing, f"{line}\n".encode()) and None)
        except BaseException as problem:
            os.write(writing, f"{type(problem).__name__}: {problem}".encode())
        os._exit(0)
    os.close(writing)
    said, end = b"", time.monotonic() + seconds
    try:
        while select.select([reading], [], [], max(0.0, end - time.monotonic()))[0]:
            if not (part := os.read(reading, 65536)):
                return said.decode().splitlines()
            said += part
        raise TimeoutError
    finally:
        os.close(reading)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
