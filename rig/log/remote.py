"""A producer's end of the process that writes the log; what is sent through it outlives the producer.

The engine has one through `rig.log.process.LogProcess`. A second process (the guard) gets its own::

    with LogProcess(path) as log:
        guard = subprocess.Popen([..., str(log.second.fileno())], pass_fds=[log.second.fileno()])
        log.second.close()  # after the start; otherwise the writer would wait for this process to give it up too

    # in the other process
    log = RemoteLog(path, socket.socket(fileno=...))
    log.write("/command", {...}, log_ns, publish_ns)  # never blocks; LogError when the log is lost
    log.tick(now)  # once a turn
    log.close()

The writer ends when all producers have closed their ends or died. Start such a process with `subprocess` or with
multiprocessing's "spawn": one that is forked holds the engine's own end open, and the writer would not see it die.
"""

from __future__ import annotations

import json
import math
import select
import socket
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rig.base.clock import RealClock
from rig.log import frames, schema
from rig.log.checks import Checks
from rig.log.errors import LogError

MOST_WAITING = 8 * 1024 * 1024  # bytes not yet taken by the writer: half a minute of a run with all sensors at 1 kHz
SILENCE_S = 0.8  # the writer says ten times a second that it lives, by a thread of its own ...
MOST_IN_FRAME = 32 * 1024  # bytes of messages: so much a torn frame may take along
SEND_S = 0.01  # rows wait so long for others, from the first turn after the last were sent
LISTEN_S = 0.02  # how often we listen
LATE_S = 0.05  # a turn of ours that took longer is not the writer's silence
BUSY_S = 5.0  # ... and for how long it has waited for its disk, which may keep it that long
BLOCKING_S = 10.0  # for what may block: an attachment before the run, closing

_TOPICS = {topic: number for number, topic in enumerate(schema.CHANNELS)}
_AHEAD = {"/command", *(topic for topic in schema.CHANNELS if topic.endswith("/tx"))}  # sent before they take effect


class RemoteLog:
    """Records messages like `rig.log.writer.LogWriter`, in the process that writes the log at ``path``.

    `write` and `tick` never block: what the writer does not take at once waits here, up to `MOST_WAITING`.

    Parameters
    ----------
    path : Path
        The log, for messages.
    end : socket
        This producer's end; closed with this object.

    Raises
    ------
    LogError
        From every method: what is to be written is not valid (the log stays as it was), or the writer died, hangs,
        or failed to write; then every later call raises too.
    """

    def __init__(self, path: Path, end: socket.socket) -> None:
        self.path = path
        self._free: int | None = None
        self._end = end
        self._end.setblocking(False)
        self._checks = Checks(path)
        self._waiting = bytearray()  # frames
        self._messages = bytearray()  # of the frame that is being made
        self._unpack = frames.Unpacker()
        self._failure: LogError | None = None
        self._last_heard: float | None = None
        self._last_tick: float | None = None
        self._next_listen = self._next_send = -math.inf
        self._sent = False  # since the last tick
        self._busy = 0.0  # for how long the writer has waited for its disk (s)
        self._heard: set[int] = set()  # kinds of frames since last looked

    def write(self, topic: str, fields: Mapping[str, Any], log_ns: int, publish_ns: int) -> None:
        """Record one message, as `rig.log.writer.LogWriter.write` does.

        Commands and bytes for a wire are sent at once, so that they are in the log before they can take effect;
        everything else with the next of them, or a `tick`: at most `SEND_S` after the next turn.
        """
        if self._failure is not None:
            self._check()
        data = self._checks.message(topic, fields, log_ns, publish_ns)
        self._messages += frames.MESSAGE_HEAD.pack(_TOPICS[topic], log_ns, publish_ns, len(data)) + data
        if topic in _AHEAD:
            self._send()
        elif len(self._messages) > MOST_IN_FRAME:
            self._end_frame()
        if len(self._waiting) > MOST_WAITING:
            raise self._fail("the process that writes the log does not keep up", "Use a faster disk.")

    def tick(self, now: float) -> int | None:
        """Send what waits and listen to the writer. To be called in every turn, with the clock's time in seconds.

        Returns the bytes free on the log's disk, as the writer last said; None when they are not known.
        """
        self._check()
        if self._sent:
            self._sent, self._next_send = False, now + SEND_S
        elif now >= self._next_send:
            self._send()
        if now >= self._next_listen:
            self._next_listen = now + LISTEN_S
            self._listen()
        late = now - self._last_tick - LATE_S if self._last_tick is not None else 0.0
        self._last_tick = now
        if self._heard or self._last_heard is None:
            self._last_heard = now
            self._heard.clear()
        elif late > 0:  # nobody has listened meanwhile
            self._last_heard = min(self._last_heard + late, now)
        if not now - self._last_heard < SILENCE_S:
            raise self._fail(f"the process that writes the log has not answered for {SILENCE_S:g} s", "It hangs.")
        if not self._busy < BUSY_S:
            raise self._fail(
                f"the process that writes the log has waited for its disk for {self._busy:.0f} s",
                "The disk hangs or is very slow.",
            )
        return self._free

    def close(self) -> None:
        """Send what waits, then close this end."""
        with suppress(LogError):
            if self._failure is None:
                self._drain()
        self._end.close()

    def _check(self) -> None:
        if self._failure is not None:
            raise LogError(self._failure.path, self._failure.what, self._failure.advice)

    def _fail(self, what: str, advice: str) -> LogError:
        self._failure = LogError(self.path, what, advice)
        return self._failure

    def _end_frame(self) -> None:
        if self._messages:
            self._waiting += frames.pack(frames.MESSAGES, bytes(self._messages))
            self._messages.clear()

    def _send(self) -> None:
        self._end_frame()
        try:
            while self._waiting:
                del self._waiting[: self._end.send(self._waiting)]
            self._sent = True
        except BlockingIOError:
            pass
        except OSError:  # the writer has closed its end; it may have said why
            self._listen()
            raise self._fail(*self._gone()) from None

    def _listen(self) -> None:
        with suppress(BlockingIOError):
            while True:
                try:
                    data = self._end.recv(65536)
                except ConnectionError:
                    data = b""
                if not data:
                    if frames.DONE in self._heard:
                        return
                    raise self._fail(*self._gone())
                try:
                    found = self._unpack.feed(data)
                except ValueError as error:
                    raise self._fail(f"the process that writes the log sends {error}", "") from None
                for kind, body in found:
                    self._heard.add(kind)
                    if kind == frames.ALIVE:
                        free, self._busy = frames.STATE.unpack(body)
                        self._free = free if free >= 0 else None
                    elif kind == frames.FAILED:
                        path, what, advice = json.loads(body)
                        self._failure = LogError(Path(path), what, advice)
                        raise self._failure

    def _gone(self) -> tuple[str, str]:
        part = self.path.with_name(self.path.name + ".part")
        return "the process that writes the log has ended", f"What it wrote: dea-rig recover {part} -o OUT.mcap"

    def _drain(self) -> None:
        """Wait until the writer has taken everything."""
        clock = RealClock()
        self._end_frame()
        while self._waiting:
            self._send()
            self._listen()
            if clock.now() > BLOCKING_S:
                raise self._fail("the process that writes the log takes nothing more", "Its disk may hang.")
            if self._waiting:
                select.select([], [self._end], [], 0.1)
