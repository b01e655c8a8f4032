"""Today's engine and drivers, run again on a bench that answers from the log: do they ask what was asked then?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from rig.bench import Bench
from rig.engine import Engine, Outcome
from rig.experiment import gains_of
from rig.replay.bench import Departure, ReplayBench
from rig.replay.recording import Recording
from rig.signals import StopRequest

if TYPE_CHECKING:
    from rig.log.writer import LogWriter

# Of the outcome of a run in real time; its measured values and times come out a little different each time.
SAME_IN_REAL_TIME = ("status", "safe", "stage_standing")


@dataclass(frozen=True)
class Rerun:
    """How the run went again.

    Attributes
    ----------
    recording : Recording
    requests : dict of str to int
        How many were the recorded ones, by role.
    departure : Departure or None
        The first that was not; None when all were, as far as the log goes.
    outcome : Outcome
        Of the run as it went today.
    disagreements : dict of str to (str, str)
        Entries of the outcome that were otherwise then: (then, today).
    """

    recording: Recording
    requests: dict[str, int]
    departure: Departure | None
    outcome: Outcome
    disagreements: dict[str, tuple[str, str]]

    @property
    def exit_code(self) -> int:
        """0 all the same; 3 the same as far as the log is whole; 1 different."""
        if self.departure is not None or self.disagreements:
            return 1
        return 3 if self.recording.problem else 0

    @property
    def report(self) -> str:
        path = self.recording.log.path
        counts = ", ".join(f"{role} {n}" for role, n in self.requests.items())
        if self.departure is not None:
            return f"{path}: DIFFERENT. The first {self.departure}.\nThe same before that: requests to {counts}."
        text = f"{path}: today's engine and drivers make the same requests, in the same order: {counts}"
        if self.recording.problem:
            return f"{text}.\nRun again as far as the log goes: {self.recording.problem}."
        if self.disagreements:
            lines = [f"  {key}: {then} then, {today} today" for key, (then, today) in self.disagreements.items()]
            return "\n".join([f"{text}; but the run ends DIFFERENTLY:", *lines])
        return f"{text}; and the run ends as it did: {self.outcome.status}, {self.outcome.reason}."


def rerun(recording: Recording) -> Rerun:
    """Run the recorded experiment again, answered from its log."""
    experiment = recording.experiment
    replay = ReplayBench(recording)
    bench = Bench(experiment.scene, replay)
    engine = Engine(
        bench,
        experiment.actions,
        cast("LogWriter", _NoLog()),
        gains_of(experiment.certificates),
        StopRequest(),
        lambda done, total, label: None,
        experiment.certificates,
    )
    try:
        outcome, _ = engine.run()
    finally:
        bench.close()
    return Rerun(
        recording,
        {role: script.requests for role, script in replay.scripts.items()},
        _departure(replay, bench.clock.now()),
        outcome,
        {} if recording.problem else _disagreements(recording, outcome),
    )


def _departure(replay: ReplayBench, end: float) -> Departure | None:
    """The first one, or the first request that should still have been made; the end of a cut log is none."""
    incomplete = bool(replay.recording.problem)
    if replay.departures:
        first = replay.departures[0]
        return None if incomplete and first.recorded is None else first
    left = {script.due.t: role for role, script in replay.scripts.items() if script.due is not None}
    return replay.departure(left[min(left)], end, None) if left else None


def _disagreements(recording: Recording, outcome: Outcome) -> dict[str, tuple[str, str]]:
    then, today = recording.log.outcome or {}, outcome.as_text()
    keys = today if recording.in_virtual_time else SAME_IN_REAL_TIME
    return {key: (then.get(key, "-"), today[key]) for key in keys if then.get(key) != today[key]}


class _NoLog:
    """Takes the place of a log that nobody needs."""

    def write(self, topic: str, fields: dict[str, Any], log_ns: int, publish_ns: int) -> None:
        """Nothing is kept."""

    def metadata(self, name: str, mapping: dict[str, str]) -> None:
        """Nothing is kept."""

    def tick(self, now: float) -> None:
        """Nothing is due."""
