"""Today's engine and drivers, run again on a bench that answers from the log: do they ask what was asked then?"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from drivers.roles import Identity
from rig.bench.bench import Bench
from rig.bench.opening import open_memory
from rig.engine.engine import LONGEST_TURN_S, Engine
from rig.engine.lent import from_argument
from rig.engine.outcome import Outcome
from rig.log.nowhere import NoLog
from rig.operator.control import Answer, Control, Question
from rig.protocol.experiment import gains_of
from rig.replay.bench import Departure, ReplayBench
from rig.replay.recording import OperatorAct, Recording
from rig.replay.steering import NANOSECONDS, SteeredBench
from rig.replay.verify import GUARDED
from rig.steps.advisor import Advice, Ask
from rig.steps.output import CLEARED, MAY_CLEAR

if TYPE_CHECKING:
    from rig.log.writer import LogWriter

# Of the outcome of a run in real time; its measured values and times come out a little different each time.
SAME_IN_REAL_TIME = ("status", "safe", "stage_standing")
AS_RECORDED = "as in the log"
AT_ONCE_S = 2e-3  # an answer that came so soon was given in the same turn of the loop


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


def rerun(recording: Recording, *, steered: bool | None = None) -> Rerun:
    """Run the recorded experiment again, answered from its log.

    ``steered``: whether the clock shows the recorded times turn by turn; by default where the run was in real time.
    """
    if steered is None:
        steered = not recording.in_virtual_time
    experiment = recording.experiment
    operator = _Operator(recording)
    replay = _Again(recording, operator)
    log = NoLog()
    bench: Bench
    if steered:
        bench = SteeredBench(experiment.scene, replay, recording)
        log.listener = bench.decided
    else:
        bench = Bench(experiment.scene, open_memory(experiment.scene, replay))
    engine = Engine(
        bench,
        experiment.actions,
        cast("LogWriter", log),
        gains_of(experiment.certificates),
        operator,
        lambda done, total, label: None,
        experiment.certificates,
        requested=AS_RECORDED,
        take_down=AS_RECORDED if operator.took_down else "",
        clear=AS_RECORDED if operator.cleared else "",
        advisor=_Advisor(recording),
        kept=_Kept(recording),
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
    if not replay.recording.in_virtual_time:  # a guard in a process of its own polls on until it is dismissed
        left = {t: role for t, role in left.items() if role != GUARDED}
    return replay.departure(left[min(left)], end, None) if left else None


def _disagreements(recording: Recording, outcome: Outcome) -> dict[str, tuple[str, str]]:
    then, today = recording.log.outcome or {}, outcome.as_text()
    keys = today if recording.in_virtual_time else SAME_IN_REAL_TIME
    return {key: (then.get(key, "-"), today[key]) for key in keys if then.get(key) != today[key]}


class _Operator(Control):
    """The operator of the recorded run: wants again what he wanted then, at the same instants."""

    def __init__(self, recording: Recording) -> None:
        given = [row.fields for row in recording.rows if row.topic == "/command"]
        acts = recording.operator_acts
        asked = [act.t for act in acts if act.what == "is asked"]
        answered = [act for act in acts if act.what == "answers"]
        # Answers that came at once were given by nobody, and nobody was there to choose anything either.
        nobody = len(asked) == len(answered) and all(
            late.t - t < AT_ONCE_S for t, late in zip(asked, answered, strict=True)
        )
        super().__init__(unattended=AS_RECORDED if nobody else "")
        self.took_down = any((c["device"], c["command"]) == ("hv", "take_down") for c in given)
        self.cleared = any(act.what == MAY_CLEAR for act in acts) or any(
            (c["device"], c["command"], c["argument"]) == ("hv", "clear", CLEARED) for c in given
        )
        self._questions, self._answers = deque(asked), deque(answered)
        self._coming: OperatorAct | None = None  # the answer to the question that is open
        self._wishes = deque(act for act in acts if act.what in ("pauses", "continues"))
        stopped = next((act for act in reversed(acts) if act.what == "stops"), None)
        self._stopped_by = "" if stopped is None else stopped.by
        self._stop_at = math.inf
        if stopped is not None:
            # Making safe begins with the stage, in the same turn.
            self._stop_at = max((c["t_s"] for c in given if c["command"] == "stop"), default=math.inf)

    def put(self, question: Question) -> None:
        super().put(question)
        asked = self._questions.popleft() if self._questions else 0.0
        self._coming = self._answers.popleft() if self._answers else None
        if self._coming is not None and self._coming.t - asked < AT_ONCE_S:
            self._reply(question, self._coming)

    def at(self, t: float) -> None:
        """What he has wanted by ``t``."""
        if self.question is not None and self.answer is None and self._coming is not None and t >= self._coming.t:
            self._reply(self.question, self._coming)
        while self._wishes and self._wishes[0].t <= t:
            if self._wishes.popleft().what == "pauses":
                self.ask_pause(AS_RECORDED)
            else:
                self.pausing = ""
        if t >= self._stop_at and not self.count:
            self.ask(self._stopped_by)

    def _reply(self, question: Question, recorded: OperatorAct) -> None:
        self.answer = Answer(question.expected or recorded.text, AS_RECORDED)


class _Advisor:
    """Advises what was decided then, at the same instants."""

    def __init__(self, recording: Recording) -> None:
        self._decisions = deque(row for row in recording.rows if row.topic == "/decision")
        self._standings = [row.fields for row in recording.rows if row.topic == "/standing"]
        # Led through its turns, the clock shows when the turn began in which the answer came.
        self._early = NANOSECONDS if recording.in_virtual_time else LONGEST_TURN_S

    def ask(self, question: Ask, now: float) -> None:
        """Nothing is worked out again."""

    def answer(self, now: float, stopping: Callable[[], bool]) -> Advice | None:
        if not self._decisions or now < self._decisions[0].t - self._early:
            return None
        fields = self._decisions.popleft().fields
        belongs = (fields["step"], fields["number"])
        known = [one for one in self._standings if (one["step"], one["number"]) == belongs]
        return Advice.from_fields(fields, known)

    def close(self) -> None:
        """Nothing is open."""


class _Kept:
    """What killed runs had left then. Nothing is kept: a replay leaves the files of real runs alone."""

    def __init__(self, recording: Recording) -> None:
        taken = [row.fields for row in recording.rows if row.topic == "/command"]
        self._left = {f["device"]: from_argument(f["argument"]) for f in taken if f["command"] == "resume_found"}

    def left(self, role: str, who: Identity) -> Mapping[str, float]:
        return self._left.get(role, {})

    def keep(self, role: str, who: Identity, found: Mapping[str, float]) -> None:
        """Nowhere."""

    def forget(self, role: str) -> None:
        """Nothing is kept."""


class _Again(ReplayBench):
    """A replayed bench with its operator."""

    def __init__(self, recording: Recording, operator: _Operator) -> None:
        super().__init__(recording)
        self._operator = operator

    def advance(self, t: float) -> None:
        super().advance(t)
        self._operator.at(t)
