"""The panel's server: one page, its data, and the operator's words, on 127.0.0.1 only.

Whoever asks must come by the address that was printed (its token becomes a cookie), name this server as Host, and, when
he wants something done, come from this very page (Origin). Only the standard library is needed; nothing is fetched from
anywhere, and the page says so to the browser (Content-Security-Policy).
"""

from __future__ import annotations

import hmac
import json
import secrets
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from rig.base.errors import RigError
from rig.log.follow import growing
from rig.operator.live import live_runs
from rig.panel.run_view import RunView

LARGEST_REQUEST = 16 * 1024  # bytes
LOOK_S = 1.0  # between two looks for live runs
FILES = {"/panel.js": "text/javascript", "/panel.css": "text/css"}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Panel(ThreadingHTTPServer):
    """Serves the runs of this user, or one log.

    Parameters
    ----------
    log : Path or None
        The log to show; None: whatever runs are going on.
    port : int
        0: any free one.
    """

    daemon_threads = True

    def __init__(self, log: Path | None, port: int = 0) -> None:
        if log is not None:
            growing(log)  # before a port is taken
        super().__init__(("127.0.0.1", port), _Handler)
        self.token = secrets.token_urlsafe(24)
        self._log = None if log is None else log.resolve()
        self._views: dict[Path, RunView] = {}
        self._live: list[Path] = []
        self._next_look = 0.0
        self._lock = threading.Lock()
        if self._log is not None:
            self.view(self._log)

    @property
    def address(self) -> str:
        """What the operator opens in a browser."""
        return f"http://127.0.0.1:{self.server_port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Cookies are shared by all ports of a host, so the name tells whose it is."""
        return f"dea-rig-{self.server_port}"

    def logs(self) -> list[Path]:
        """The logs that may be shown: the one that was named, this user's live runs, and those shown already."""
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + LOOK_S
            self._live = [Path(run.log) for run in live_runs()]
        return list(dict.fromkeys([*([] if self._log is None else [self._log]), *self._live, *self._views]))

    def view(self, log: Path) -> RunView:
        """The view of one log, opened when it is first asked for."""
        with self._lock:
            if log not in self._views:
                self._views[log] = RunView(log)
            return self._views[log]

    def server_close(self) -> None:
        super().server_close()
        for view in self._views.values():
            view.close()


class _Handler(BaseHTTPRequestHandler):
    server: Panel
    protocol_version = "HTTP/1.1"
    timeout = 30

    def do_GET(self) -> None:
        """The page, its two files, the list of runs."""
        self._answer({"/": self._page, "/runs": self._runs} | dict.fromkeys(FILES, self._file))

    def do_POST(self) -> None:
        """The data of a run, and the operator's words."""
        origin = self.headers.get("Origin")
        if origin is None or urlsplit(origin).netloc not in self._hosts():
            self._refuse(HTTPStatus.FORBIDDEN, "This does not come from the panel's own page.")
            return
        self._answer({"/data": self._data, "/say": self._say})

    def _answer(self, paths: dict[str, Callable[[], None]]) -> None:
        path = urlsplit(self.path).path
        if self.headers.get("Host") not in self._hosts():
            self._refuse(HTTPStatus.FORBIDDEN, "The panel is reached as 127.0.0.1 only.")
        elif path not in paths:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such page.")
        elif path == "/" and self._given() is not None:
            self._let_in()
        elif not self._allowed():
            self._refuse(HTTPStatus.FORBIDDEN, "Open the panel with the address that dea-rig watch printed.")
        else:
            try:
                paths[path]()
            except RigError as error:
                self._send_json({"error": str(error)}, HTTPStatus.CONFLICT)

    # Who asks ------------------------------------------------------------------------------------------------

    def _hosts(self) -> tuple[str, str]:
        port = self.server.server_port
        return f"127.0.0.1:{port}", f"localhost:{port}"

    def _given(self) -> str | None:
        token = parse_qs(urlsplit(self.path).query).get("token")
        return token[0] if token else None

    def _let_in(self) -> None:
        """The token of the address becomes a cookie, so that it does not stay in the browser's address."""
        if not hmac.compare_digest((self._given() or "").encode(), self.server.token.encode()):
            self._refuse(HTTPStatus.FORBIDDEN, "Open the panel with the address that dea-rig watch printed.")
            return
        cookie = f"{self.server.cookie}={self.server.token}; HttpOnly; SameSite=Strict; Path=/"
        self._send(b"", "text/plain", HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": cookie})

    def _allowed(self) -> bool:
        try:
            cookie = SimpleCookie(self.headers.get("Cookie", "")).get(self.server.cookie)
        except CookieError:
            return False
        return cookie is not None and hmac.compare_digest(cookie.value.encode(), self.server.token.encode())

    # What is asked for ---------------------------------------------------------------------------------------

    def _page(self) -> None:
        self._send(_resource("panel.html"), "text/html")

    def _file(self) -> None:
        path = urlsplit(self.path).path
        self._send(_resource(path[1:]), FILES[path])

    def _runs(self) -> None:
        self._send_json([{"log": str(log), "name": log.name} for log in self.server.logs()])

    def _data(self) -> None:
        asked = self._body()
        if asked is not None and (log := self._log(asked)) is not None:
            seen = asked.get("seen")
            self._send_json(self.server.view(log).page(seen if isinstance(seen, dict) else {}))

    def _say(self) -> None:
        asked = self._body()
        if asked is None or (log := self._log(asked)) is None:
            return
        text = asked.get("text")
        if not isinstance(text, str) or len(text) > 500:
            self._refuse(HTTPStatus.BAD_REQUEST, "A text is needed.")
            return
        self._send_json({"said": self.server.view(log).send(text)})

    def _log(self, asked: dict[str, Any]) -> Path | None:
        for log in self.server.logs():
            if str(log) == asked.get("log"):
                return log
        self._refuse(HTTPStatus.NOT_FOUND, "This run has ended, or there is no such log.")
        return None

    def _body(self) -> dict[str, Any] | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > LARGEST_REQUEST:
            self.close_connection = True
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The request is too long.")
            return None
        try:
            asked = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            asked = None
        if isinstance(asked, dict):
            return asked
        self._refuse(HTTPStatus.BAD_REQUEST, "The request is not understood.")
        return None

    # Answers -------------------------------------------------------------------------------------------------

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # what else was sent is not read
        self._send(why.encode(), "text/plain", status)

    def _send_json(self, content: object, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(content).encode(), "application/json", status)

    def _send(
        self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK, headers: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        fixed = {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        for name, value in (fixed | (headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not told on the terminal."""


def _resource(name: str) -> bytes:
    return (files("rig.panel") / "page" / name).read_bytes()
