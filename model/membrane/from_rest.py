"""Answers for states that a cold start may miss, or find on another branch: the state is followed from rest.

First many states together, with every point taut or wrinkled by itself; then each is solved to its tolerance with a cut
at every edge of a wrinkled zone. Where the second fails, or the first ended close by, the state is approached alone, in
steps that are solved with their cuts each. A state whose law is not convex along the whole profile is not an answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.membrane import continuation, convexity, refinement, ritz, tension_field
from model.membrane.refinement import Answer, Start, refine
from model.membrane.ritz import Problem, State, guess

TRACE_MODES = (10, 16, 24)  # of a path; more where it ends without telling why, or at a state that does not settle
PIECES = 4  # elements in place of one where one does not settle
CLOSE = 2e-3  # of V^2: a path that ended so close below the wanted voltage is followed again
BACK = (0.03, 0.3)  # of V^2: where that begins
STEP = 1e-5  # of V^2: its smallest step
SOFT = 0.1  # stiffness below which a path that ends has met the loss of convexity
CHECK_MODES = 6  # of a way that is only looked at
WAY = (2, 5)  # steps of V^2 to an answer that is there already: so many, and then so many
WAY_GOAL, WAY_STEPS = 3e-2, 8  # of Newton on that way
ROUGH = 1e-6  # tolerance on the way
EDGE, JUDGE = 0.05, 1e-9  # margin of convexity below which the state at this tolerance judges
TIGHT, LEAST = 1e-8, 1e-12  # those of a wrinkled state which does not settle to a looser one


class Ended:
    """Why states have no answer."""

    def __init__(self, states: int) -> None:
        self.unstable = np.zeros(states, dtype=np.bool_)
        self.steps = np.zeros(states, dtype=np.intp)


def solve(
    problem: Problem, tolerance: float, slack: NDArray[np.bool_], *, relaxed: bool, sensitivities: bool
) -> tuple[list[Answer], Ended]:
    """Answers to the states that are on the branch from rest; for the others whether the branch ends before.

    Those that hang ``slack`` are not sought for long.
    """
    states = len(problem.span)
    ended = Ended(states)
    answers: list[Answer] = []
    progress = np.zeros(states)
    rest, reached = np.arange(states), np.arange(0)
    end = 1.0 if problem.film.field is None else 2.0
    for modes in TRACE_MODES:
        path = continuation.follow(problem.take(rest), modes, relaxed=relaxed)
        # Few modes lead smoothly past the end of a film that narrows.
        coarse = continuation.leans(path.grid, path.state) & (modes < TRACE_MODES[-1]) & ~slack[rest]
        ended.steps[rest] += path.steps
        ended.unstable[rest] |= path.limit & ~coarse
        progress[rest] = path.progress
        good = np.flatnonzero(path.reached & ~coarse)
        begin = Start(path.grid.take(good), path.state.take(good))
        reached = rest[good]
        found, lost = settled(problem, reached, tolerance, begin, relaxed, sensitivities, ended)
        answers += found
        left = np.zeros(states, dtype=np.bool_)
        near = (path.progress > end - 1.0) & (path.progress > end - CLOSE) & (not relaxed)
        left[rest[coarse | ~path.reached & (near | ~path.limit)]] = left[reached[lost]] = True
        left &= ~slack
        lost = lost[left[reached[lost]]]
        reached, begin, rest = reached[lost], begin.take(lost), np.flatnonzero(left)
        if len(rest) == 0:
            break
    if len(reached):
        # With folds a tighter tolerance begins with more modes; plain layers ask for short elements.
        begin = begin if relaxed else _in_pieces(problem.take(reached), begin)
        least = max(min(0.01 * tolerance, TIGHT), LEAST) if relaxed else tolerance
        found, _ = settled(problem, reached, least, begin, relaxed, sensitivities, ended)
        answers += found
    done = np.zeros(states, dtype=np.bool_) if relaxed else np.ones(states, dtype=np.bool_)
    for answer in answers:
        done[answer.index] = True
    for state in np.flatnonzero(~done & (progress > end - 1.0) & (progress > end - CLOSE)).tolist():
        one = np.array([state])
        last = Approach(problem.take(one), end, relaxed).run()
        ended.steps[one] += last.steps
        ended.unstable[one] |= last.limit
        if last.reached:
            answers += settled(problem, one, tolerance, last.begin, relaxed, sensitivities, ended)[0]
    return answers, ended


def settled(
    problem: Problem,
    these: NDArray[np.intp],
    tolerance: float,
    begin: Start,
    relaxed: bool,
    sensitivities: bool,
    ended: Ended,
) -> tuple[list[Answer], NDArray[np.intp]]:
    """The states ``these`` to their tolerance from ``begin``, and which of them do not settle, by their place there.

    One whose law is not convex along the film is beyond the end of the branch.
    """
    if len(these) == 0:
        return [], these
    answers, lost, spent = _settled(problem.take(these), tolerance, begin, relaxed, sensitivities)
    ended.steps[these] += spent
    answers = [answer for answer in answers if len(answer.index)]
    for answer in answers:
        answer.index = these[answer.index]
    if problem.film.field is not None:
        good = [_convex(problem, these, answer, begin, relaxed) for answer in answers]
        for answer, convex in zip(answers, good, strict=True):
            ended.unstable[answer.index[~convex]] = True
        answers = [answer.take(convex) for answer, convex in zip(answers, good, strict=True)]
    return answers, lost


def _settled(
    problem: Problem, tolerance: float, begin: Start, relaxed: bool, sensitivities: bool = False
) -> tuple[list[Answer], NDArray[np.intp], NDArray[np.intp]]:
    if relaxed:
        return tension_field.solve(problem, tolerance, sensitivities=sensitivities, begin=begin, careful=True)
    return refine(problem, tolerance, begin, sensitivities=sensitivities)


def _in_pieces(problem: Problem, begin: Start) -> Start:
    """Plain states with short elements: those that would wrinkle have layers, for which more modes help little."""
    pieces = PIECES * begin.grid.elements
    at = ritz.evaluate(problem, begin.grid, begin.state)
    taut = np.zeros(pieces, dtype=np.bool_)
    cut = tension_field.remap(begin.grid, begin.state, at.log[1], problem.cut(pieces), begin.grid.table.modes, taut)
    return Start(cut.grid, State(cut.state.c, cut.state.w))


def connected(problem: Problem, end: Start, lam: Array) -> NDArray[np.bool_]:
    """Whether taut states are on the branch from rest: by their energy, or since a few steps of the voltage lead there.

    The steps are as short as `continuation` asks for, so that following the state would lead to it as well.
    """
    everyone = np.arange(len(lam))
    good = convexity.between(problem, end.grid, end.state)
    rest = np.flatnonzero(~good)
    if len(rest):
        bare = continuation.at(problem, rest, np.ones(len(rest)))
        laid = end.grid.take(rest)
        found = refinement.newton(bare, laid, guess(bare, laid), WAY_GOAL, WAY_STEPS)
        begins = found.ok & ~continuation.leans(laid, found.state)
        rest, begun = rest[begins], found.state.take(begins)
        for steps in WAY:
            if len(rest) == 0:
                break
            led = _led(problem.take(rest), end.take(rest), begun, steps)
            good[rest[led]] = True
            rest, begun = rest[~led], begun.take(~led)
    some = everyone[good]
    if len(some):
        part = end.take(some)
        stations = convexity.stations(problem.take(some), part.grid, part.state, lam[some])
        good[some] = convexity.margin(problem.take(some), stations) > 0.0
    return good


def _led(problem: Problem, end: Start, begun: State, steps: int) -> NDArray[np.bool_]:
    """Whether so many steps of V^2 lead from ``begun`` without voltage to ``end``, none of them a jump."""
    everyone = np.arange(len(problem.span))
    good = np.ones(len(everyone), dtype=np.bool_)
    before = last = begun
    for k in range(1, steps):
        share = 1.0 / (steps - k + 1)
        w = last.w + share * (end.state.w - last.w)
        first = State(last.c + share * (end.state.c - last.c), w)
        part = continuation.at(problem, everyone, np.full(len(everyone), 1.0 + k / steps))
        found = refinement.newton(part, end.grid, first, WAY_GOAL, WAY_STEPS)
        good &= found.ok & (np.abs(found.state.w / w - 1.0).max(axis=(0, 1)) < continuation.CORRECTION)
        before, last = last, found.state
    ahead = 2.0 * last.w - before.w
    return np.asarray(good & (np.abs(ahead / end.state.w - 1.0).max(axis=(0, 1)) < continuation.CORRECTION))


def _convex(
    problem: Problem, these: NDArray[np.intp], answer: Answer, begin: Start, relaxed: bool
) -> NDArray[np.bool_]:
    """Whether the law is convex along the films of an answer to ``these``.

    Where that hangs on digits that a resolution leaves open one resolution judges for every tolerance.
    """
    margin = _margin(problem.take(answer.index), answer)
    for k in np.flatnonzero((np.abs(margin) < EDGE) & relaxed).tolist():
        one = answer.index[[k]]
        fine, _, _ = _settled(problem.take(one), JUDGE, begin.take(these == one), relaxed)
        for judge in fine:
            if len(judge.index):
                margin[k] = _margin(problem.take(one), judge)[0]
    return np.asarray(margin > 0.0)


def _margin(problem: Problem, answer: Answer) -> Array:
    return convexity.margin(problem, convexity.stations(problem, answer.grid, answer.state, answer.lam))


class Approach:
    """One state followed alone over the last part of its way, every step solved with its cuts."""

    def __init__(self, problem: Problem, end: float, relaxed: bool) -> None:
        self.problem, self.end, self.relaxed = problem, end, relaxed
        self.progress, self.steps = end, 0
        self.reached = self.limit = False
        self.margin = 1.0

    def run(self) -> Approach:
        """From where the state is easy to its own voltage, in steps that shorten where they fail."""
        one = np.zeros(1, dtype=np.intp)
        for back in BACK:
            self.progress = self.end - back
            part = continuation.at(self.problem, one, np.array([self.progress]))
            path = continuation.follow(part, TRACE_MODES[0], relaxed=self.relaxed)
            self.steps += int(path.steps[0])
            if path.reached[0] and self._step(part, Start(path.grid, path.state)):
                break
        else:
            return self
        size = self.end - self.progress
        while self.progress < self.end:
            aim = min(self.progress + size, self.end)
            if self._step(continuation.at(self.problem, one, np.array([aim])), self.begin):
                self.progress = aim
                size *= 2.0
            else:
                size *= 0.3
                if size < STEP:
                    # A path that ends where the law all but loses convexity has ended there.
                    self.limit = self.margin < SOFT
                    return self
        self.reached = True
        return self

    def _step(self, part: Problem, begin: Start) -> bool:
        answers, _, steps = _settled(part, ROUGH, begin, self.relaxed)
        self.steps += int(steps[0])
        for answer in answers:
            if len(answer.index) and (margin := float(_margin(part, answer)[0])) > 0.0:
                self.begin, self.margin = Start(answer.grid, answer.state), margin
                return True
        return False
