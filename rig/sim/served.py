"""The simulated bench on pseudo-terminals, served by a thread of this process, with its truth to look at.

For tests and benchmarks that kill the processes of a run and look at what the supply's own output then did. POSIX only.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Self, TypeVar

from rig.base.clock import RealClock
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.iseg import IsegEDCP
from rig.sim.server import Server

T = TypeVar("T")
ANSWER_S = 20.0


@dataclass(frozen=True)
class Driven:
    """The supply's output was sent elsewhere at clock time ``t``: from where it was to ``target``, in volts."""

    t: float
    voltage: float
    target: float


class ServedBench:
    """Serves ``bench`` from entering the context until leaving it.

    Attributes
    ----------
    clock : RealClock
        The time in which ``driven`` is told.
    driven : list of Driven
        Whatever the output did, in order; noticed within a few milliseconds.
    """

    def __init__(self, bench: SimulatedBench) -> None:
        self.clock = RealClock()
        self.driven: list[Driven] = []
        self._bench = bench
        self._server = Server(bench, self.clock)
        self._changes = 0
        self._wanted: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="simulated bench", daemon=True)

    @property
    def ports(self) -> Mapping[str, dict[str, str | int]]:
        """As ``dea-rig sim`` prints them."""
        return self._server.ports

    def do(self, act: Callable[[SimulatedBench], T]) -> T:
        """Let the serving thread do something with the bench between two turns, and give back what came of it."""
        answers: SimpleQueue[T | BaseException] = SimpleQueue()

        def work() -> None:
            try:
                answers.put(act(self._bench))
            except BaseException as error:
                answers.put(error)

        self._wanted.put(work)
        answer = answers.get(timeout=ANSWER_S)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def stall(self, role: str, stalled: bool) -> None:
        """Let the adapter of an instrument hang, or work again."""
        self.do(lambda bench: self._server.stall(role, stalled))

    def voltage(self) -> float:
        """The supply's true output now (V)."""
        return self.do(lambda bench: bench.world.output.at(bench.now)[0])

    def power_cycle(self) -> None:
        """Switch the supply off and on: its output is at zero, nothing is latched."""

        def act(bench: SimulatedBench) -> None:
            supply = bench.instruments["hv"]
            assert isinstance(supply, IsegEDCP)
            bench.world.output.rest(bench.now, 0.0)
            supply.reset(bench.now, 0.0)

        self.do(act)
        self.driven.clear()

    def _serve(self) -> None:
        self._server.run(self._stop.is_set, self._look)

    def _look(self) -> None:
        output = self._bench.world.output
        if output.changes != self._changes:
            self._changes = output.changes
            now = self._bench.now
            self.driven.append(Driven(self.clock.now(), output.at(now)[0], output.at(output.end)[0]))
        while True:
            try:
                work = self._wanted.get_nowait()
            except Empty:
                return
            work()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(ANSWER_S)
        self._server.close()
