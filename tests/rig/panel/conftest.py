"""A panel served as `dea-rig watch` serves it, and one who asks it without a browser."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rig.panel.server import Panel


class Caller:
    """Asks a panel over HTTP, with whatever headers."""

    def __init__(self, panel: Panel) -> None:
        self.panel = panel
        self.own = {
            "Host": f"127.0.0.1:{panel.server_port}",
            "Origin": f"http://127.0.0.1:{panel.server_port}",
            "Cookie": f"{panel.cookie}={panel.token}",
        }

    def ask(
        self, method: str, path: str, body: object = None, **headers: str | None
    ) -> tuple[int, dict[str, str], bytes]:
        sent = {name: value for name, value in (self.own | headers).items() if value is not None}
        line = http.client.HTTPConnection("127.0.0.1", self.panel.server_port, timeout=20)
        try:
            line.putrequest(method, path, skip_host=True)
            content = b"" if body is None else json.dumps(body).encode()
            for name, value in sent.items():
                line.putheader(name, value)
            line.putheader("Content-Length", str(len(content)))
            line.endheaders(content)
            answer = line.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            line.close()

    def data(self, log: Path, **seen: Any) -> dict[str, Any]:
        status, _, body = self.ask("POST", "/data", {"log": str(log.resolve()), "seen": seen})
        assert status == 200, body
        found: dict[str, Any] = json.loads(body)
        return found

    def wait(self, log: Path, done: Callable[[dict[str, Any]], bool], limit_s: float = 60.0) -> dict[str, Any]:
        """The first page for which ``done``."""
        end = time.monotonic() + limit_s
        while not done(page := self.data(log)):
            assert time.monotonic() < end, page
            time.sleep(0.05)
        return page


@contextmanager
def served(log: Path | None) -> Iterator[Caller]:
    panel = Panel(log)
    thread = threading.Thread(target=panel.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield Caller(panel)
    finally:
        panel.shutdown()
        thread.join()
        panel.server_close()


@pytest.fixture(scope="session")
def serve() -> Callable[[Path | None], Any]:
    return served
