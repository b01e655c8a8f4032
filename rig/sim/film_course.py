"""The film that takes time on its way: when its steps end, and its force at any instant between.

A step ends where stage or supply begin something new, and is short enough that film and branches go straight in it:
short after a bend, longer the longer nothing new has happened. It is solved when somebody asks for the force within it,
or when it is over, and depends on neither: the same moves give the same film.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from rig.sim.path import Path
from rig.sim.viscous_film import Moment, ViscousFilm

FIRST_S = 0.01  # step after a bend, and the shortest but for those that a bend ends
GROWTH = 0.05  # of the time since the last bend: a step later on
WAY, VOLTS = (
    1 / 320,
    1 / 200,
)  # largest change in a step: of the annulus's width, of the voltage that breaks the film down


class FilmCourse:
    """A film driven by stage and supply.

    way, volts : largest changes of displacement (m) and voltage (V) in a step
    indentation : displacement of the carriage beyond contact (m) at a time
    """

    def __init__(
        self,
        film: ViscousFilm,
        stage: Path,
        output: Path,
        indentation: Callable[[float], float],
        way: float,
        volts: float,
    ) -> None:
        self._film, self._stage, self._output, self._indentation = film, stage, output, indentation
        self._way, self._volts = way * WAY, volts * VOLTS
        self._now = self._bend = 0.0
        self._moment, self._touched = film.rested, False
        self._planned: tuple[int, int] | None = None
        self._end = 0.0
        self._next: Moment | None = None

    @property
    def end(self) -> float:
        """When the step that is going on is over."""
        state = (self._stage.changes, self._output.changes)
        if state != self._planned:
            self._planned, self._next = state, None
            dt = max(FIRST_S, GROWTH * (self._now - self._bend))
            speed, rate = (abs(path.at(self._now)[1]) for path in (self._stage, self._output))
            if speed > 0.0 or rate > 0.0:
                dt = min(dt, max(FIRST_S, min(_over(self._way, speed), _over(self._volts, rate))))
            self._end = min(self._now + dt, self._stage.next_bend(self._now), self._output.next_bend(self._now))
        return self._end

    def moment(self) -> Moment:
        """The film at the end of this step."""
        end = self.end
        if self._next is None:
            s, voltage = self._indentation(end), self._output.at(end)[0]
            if s == 0.0 and not self._touched:
                self._next = self._film.untouched(voltage)
            else:
                self._touched = True
                self._next = self._film.step(self._moment, end - self._now, s, voltage)
        return self._next

    def force(self, t: float) -> float:
        """Force (N) at a time ``t`` of this step."""
        after, before = self.moment().force, self._moment.force
        share = min(max((t - self._now) / (self.end - self._now), 0.0), 1.0)
        return before + share * (after - before)

    def advance(self, t: float) -> Iterator[Moment]:
        """Go on to ``t``; the film at the end of every step."""
        while (end := self.end) <= t:
            self._moment = self.moment()
            if self._stage.bends_at(end) or self._output.bends_at(end):
                self._bend = end
            self._now, self._planned = end, None
            yield self._moment


def _over(most: float, rate: float) -> float:
    return most / rate if rate > 0.0 else math.inf
