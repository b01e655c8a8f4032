"""The process that writes a log for others: ``python -m rig.log.server PATH FD...``, started by `rig.log.process`.

Each FD is the end of a producer; the first is the engine's. It writes a chunk when its first message is 80 ms old and
has the disk confirm it. It ends when the engine has finished the log, or when no producer is left: then the file is
ended so that every reader can read it, says in its metadata ``cut`` that it was not finished, and stays ``.part``.
Signals that end programs are ignored: they are for the engine, which then finishes the log.
"""

from __future__ import annotations

import json
import select
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from rig.base.clock import RealClock
from rig.log import frames, schema
from rig.log.errors import LogError
from rig.log.writer import LogWriter

LONGEST_TURN_S, SHORTEST_TURN_S = 0.02, 0.02
ALIVE_S = 0.1
OTHERS_S = 5.0  # how long a finished engine waits for the others to end
MOST_AT_ONCE = 1024 * 1024

_TOPICS = list(schema.CHANNELS)


class Producer:
    """The writer's end of one producer."""

    def __init__(self, end: socket.socket) -> None:
        self.end = end
        self.end.setblocking(False)
        self.open = True
        self._unpack = frames.Unpacker()
        self._saying = threading.Lock()

    def read(self) -> list[tuple[int, bytes]]:
        """The frames that came. ``open`` turns False when there will be no more."""
        try:
            data = self.end.recv(MOST_AT_ONCE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        with suppress(ValueError):
            found = self._unpack.feed(data)
            self.open = bool(data) and not self._unpack.problem
            return found
        self.open = False
        return []

    def say(self, kind: int, body: bytes = b"") -> None:
        """Send a frame unless the producer is gone or does not listen; from either thread."""
        with self._saying, suppress(OSError):
            self.end.send(frames.pack(kind, body))


class Alive:
    """Tells the producers ten times a second that this process lives, and for how long its loop has been in one turn.

    A thread of its own: a disk that keeps the loop waiting is told from a process that was stopped.
    """

    def __init__(self, producers: Sequence[Producer]) -> None:
        self.free: int | None = None
        self._producers = producers
        self._clock = RealClock()
        self._turn = self._clock.now()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="alive", daemon=True)
        self._thread.start()

    def turn(self) -> None:
        """A new turn of the loop begins."""
        self._turn = self._clock.now()

    def _run(self) -> None:
        while not self._end.wait(ALIVE_S):
            free = -1 if self.free is None else self.free
            state = frames.STATE.pack(free, self._clock.now() - self._turn)
            for producer in self._producers:
                if producer.open:
                    producer.say(frames.ALIVE, state)

    def close(self) -> None:
        """End the thread."""
        self._end.set()
        self._thread.join()


def serve(path: Path, ends: Sequence[socket.socket]) -> None:
    """Write the log at ``path`` from what comes from ``ends``; the first is the engine's."""
    producers = [Producer(end) for end in ends]
    try:
        with LogWriter(path) as log:
            producers[0].say(frames.READY)
            with closing(Alive(producers)) as alive:
                recorded = _record(log, producers, alive)
            if not recorded:
                log.metadata("cut", {"reason": "what recorded this log ended without finishing it"})
                return
        producers[0].say(frames.DONE)
    except LogError as error:
        _fail(producers, error)
    except Exception as error:  # a mistake of ours must reach the operator too
        _fail(producers, LogError(path, f"internal error of the process that writes the log: {error!r}"))


def _fail(producers: Sequence[Producer], error: LogError) -> None:
    for producer in producers:
        producer.say(frames.FAILED, json.dumps([str(error.path), error.what, error.advice]).encode())


def _record(log: LogWriter, producers: Sequence[Producer], alive: Alive) -> bool:
    """Record until the log is finished (True) or everybody has gone."""
    clock = RealClock()
    outcome: dict[str, str] | None = None
    give_up = 0.0
    while True:
        began = clock.now()
        alive.turn()
        listening = [producer for producer in producers if producer.open]
        if outcome is not None and (not any(p.open for p in producers[1:]) or began > give_up):
            log.finish(outcome)
            return True
        if not listening:
            return False
        readable, _, _ = select.select([producer.end for producer in listening], [], [], LONGEST_TURN_S)
        for producer in listening:
            if producer.end not in readable:
                continue
            for kind, body in producer.read():
                if kind == frames.FINISH:
                    outcome, give_up = json.loads(body), clock.now() + OTHERS_S
                else:
                    _take(log, kind, body)
        alive.free = log.tick(clock.now())
        log.sync()
        clock.sleep_until(began + SHORTEST_TURN_S)  # many messages a turn cost less than a turn a message


def _take(log: LogWriter, kind: int, body: bytes) -> None:
    match kind:
        case frames.MESSAGES:
            at, before = 0, frames.MESSAGE_HEAD
            while at < len(body):
                topic, log_ns, publish_ns, length = before.unpack_from(body, at)
                at += before.size + length
                log.add(_TOPICS[topic], body[at - length : at], log_ns, publish_ns)
        case frames.METADATA:
            name, table = json.loads(body)
            log.metadata(name, table)
        case frames.ATTACHMENT:
            head, _, data = body.partition(b"\n")
            name, media_type = json.loads(head)
            log.attach(name, media_type, data)


def main(arguments: Sequence[str]) -> None:
    """Take over the ends and write until all is written."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGPIPE"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    path, *numbers = arguments
    serve(Path(path), [socket.socket(fileno=int(number)) for number in numbers])


if __name__ == "__main__":
    main(sys.argv[1:])
