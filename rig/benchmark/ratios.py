"""How many times one thing is dearer than another, measured side by side in one run, with its spread.

In every round each state is solved by both, one right after the other, so that what else runs on the machine falls on
both; a round's value is the median over the states. Quoted are the median and the quartiles of the rounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import process_time  # what work costs; when things happen is the clock's business

import numpy as np

Job = Callable[[], object]
ENOUGH = 1e-3  # s: far above what reading the clock costs


@dataclass(frozen=True)
class Ratio:
    """``median`` times, between the quartiles ``low`` and ``high`` of ``rounds`` rounds."""

    what: str
    median: float
    low: float
    high: float
    rounds: int

    def __str__(self) -> str:
        return f"{self.what:<58} {self.median:>6.3g} ({self.low:.3g} to {self.high:.3g})"


def measured(
    what: str, dear: Sequence[Job], cheap: Sequence[Job], rounds: int, *, states: int = 1, repeats: int = 2
) -> Ratio:
    """Time of each of ``dear`` over that of its fellow in ``cheap``; one of ``cheap`` does ``states`` states for all.

    A job's time in a round is the least of ``repeats``, in seconds of processor.
    """
    values = []
    for _ in range(rounds):
        if len(cheap) == len(dear):
            turn = [seconds(theirs, repeats) / seconds(ours, repeats) for theirs, ours in zip(dear, cheap, strict=True)]
            values.append(float(np.median(turn)))
        else:
            (together,) = cheap
            alone = float(np.median([seconds(theirs, repeats) for theirs in dear]))
            values.append(alone * states / seconds(together, repeats))
    low, median, high = (float(value) for value in np.quantile(values, (0.25, 0.5, 0.75)))
    return Ratio(what, median, low, high, rounds)


def seconds(job: Job, repeats: int) -> float:
    """Processor time of a job, the least of ``repeats``; a short job is done over and over for `ENOUGH`."""
    best = np.inf
    for _ in range(repeats):
        count, begun = 0, process_time()
        while count == 0 or process_time() - begun < ENOUGH:
            job()
            count += 1
        best = min(best, (process_time() - begun) / count)
    return float(best)


def lines(ratios: Sequence[Ratio], conditions: Sequence[str]) -> str:
    """The ratios and under what conditions they were measured, as printed and as quoted in the README."""
    rounds = sorted({ratio.rounds for ratio in ratios})
    heading = f"How many times: median (quartiles) of {' or '.join(str(count) for count in rounds)} rounds in one run"
    return "\n".join([heading, *(f"  {ratio}" for ratio in ratios), *conditions])
