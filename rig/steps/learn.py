"""``do = "learn"``: measure where it tells most, fit, and go on until a quantity is known well enough.

A closed loop. It begins with one sweep up at 0 V. Then it holds the film at one place (displacement and
voltage) after the other; after each hold an `rig.steps.advisor.Advisor` fits all that was recorded and names the next.
While it fits, the film is held and recorded where it is. Every place, and every way between two of them, has been held
against the limits before anything moved (`Learning.ways`); a place that is none of these is refused.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from rig.base.errors import FaultError, LimitError
from rig.scene.scene import Scene
from rig.steps.advisor import Advice, Ask, Kind, Standing, unit_of
from rig.steps.base import Action, NotNegative, Positive, State, Step, Turns, write_phase
from rig.steps.moves import move_to, ramp_duration, voltage_to
from rig.steps.places import connected
from rig.steps.rig import CyclesDone, Rig
from rig.steps.turns import ARRIVAL_M
from rig.steps.wanted import EXAMPLE, Wanted, parse_wanted

LEAST_TIME_S = 60.0
ANSWER_S = 60.0  # a fit that takes longer is given up
FAILURES = 3  # fits in a row that fail: then the step ends, in order
ENDS = {  # of one wish, for people
    Kind.MET: "met",
    Kind.UNREACHABLE: "unreachable",
    Kind.TIME: "needs more time",
    Kind.FAILED: "the fits failed",
}
HOLD_ANYWAY_S = 10.0  # where the film is, after a fit that failed
LEAST_HOLD_S = 1.0  # at a place that is gone to


class Learn(Step):
    """Measure, fit and choose the next place, until what is wanted is known well enough or the time is out."""

    needs_contact: ClassVar[bool] = True
    records: ClassVar[bool] = True
    joins: ClassVar[bool] = True

    do: Literal["learn"] = Field(description="The kind of step.")
    until: str = Field(
        description="What is to be known, and how well: quantity and relative standard uncertainty, several with "
        f"commas; {EXAMPLE}. Quantities: stiffness, eps_r. All parts of the uncertainty count, as `dea-rig fit` states "
        "it; with `given dimensions` behind the % those of the specimen's dimensions do not, with `noise and zeros` "
        "only what more time makes smaller."
    )
    at_most_min: Annotated[float, Field(ge=1.0, le=1440.0)] = Field(
        default=60.0, description="Longest time of this step (min), the way back included. Typical: 5 to 60."
    )
    speed_mm_per_s: Positive = Field(
        default=5.0,
        description="Speed of the disk between places (mm/s), at most limits.speed_mm_per_s. Typical: 1 to 5.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    settle_s: NotNegative = Field(default=1.0, description="Wait after each measured voltage has arrived (s).")
    terms: Annotated[int, Field(ge=1, le=3)] = Field(default=2, description="Ogden terms of the fits. Typical: 1 or 2.")

    @field_validator("until")
    @classmethod
    def _understood(cls, text: str) -> str:
        parse_wanted(text)
        return text

    @property
    def wanted(self) -> tuple[Wanted, ...]:
        """What is to be known."""
        return parse_wanted(self.until)

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        where = self.where(state.number)
        if state.voltage > 0:
            raise LimitError(f"{where} begins at 0 V: put a voltage step to 0 V before it.")
        if scene.hv is None and any(one.name == "eps_r" for one in self.wanted):
            raise LimitError(f"{where} wants eps_r, but the scene has no [hv] instrument.")
        places = connected(scene, scene.specimen.specimen())
        speed = min(self.speed_mm_per_s, scene.limits.speed_mm_per_s) * 1e-3
        yield Learning(
            by=self,
            step=state.number,
            label=f"until {', '.join(str(one) for one in self.wanted)}",
            h=(state.h, state.h),
            duration=self.at_most_min * 60.0,
            record=True,
            places=places,
            speed_between=speed,
            ways=tuple(self._ways(state, scene, places, speed)),
            done=state.done or CyclesDone(0, 0.0),
        )

    def _ways(
        self, state: State, scene: Scene, places: Mapping[float, tuple[float, ...]], speed: float
    ) -> Iterator[Action]:
        """Between them everywhere it may be, for the model and the limits."""
        for level, h in places.items():
            first = min(state.h, h[0]) if level == 0.0 else h[0]
            at = State(number=state.number, h=first, voltage=level)
            yield move_to(self, at, h[-1], speed)
            at = State(number=state.number, h=h[-1])
            yield voltage_to(self, at, scene, level, self.settle_s)


@dataclass(frozen=True, kw_only=True)
class Learning(Action):
    """The whole loop; it begins and ends at the same displacement and 0 V.

    Attributes
    ----------
    places : mapping of float to tuple of float
        Displacements (m) that may be held at each voltage (V): `rig.steps.places.connected`.
    speed_between : float
        m/s, of the disk.
    ways : tuple of Action
        Moves and ramps that between them go everywhere it may go.
    done : CyclesDone
        Questions asked so far, and seconds spent, by the run that this one goes on with.
    """

    begins_anywhere: ClassVar[bool] = True

    by: Learn
    places: Mapping[float, tuple[float, ...]]
    speed_between: float
    ways: tuple[Action, ...]
    done: CyclesDone

    @property
    def may(self) -> tuple[Action, ...]:
        return self.ways

    def carry_out(self, rig: Rig) -> Turns:
        if rig.advisor is None:
            raise FaultError(f"Step {self.step} ({self.kind}): nobody is there to fit what is recorded.")
        before = rig.counts.setdefault(self.step, self.done)
        loop = _Loop(rig, self, before)
        try:
            yield from loop.run()
        finally:
            rig.counts[self.step] = CyclesDone(loop.number, loop.spent)


class _Loop:
    """One stretch of the loop, between two pauses."""

    def __init__(self, rig: Rig, action: Learning, before: CyclesDone) -> None:
        self._rig = rig
        self._action = action
        self._began = rig.clock.now()
        self._before = before.reference
        self.number = before.count
        self._failures = 0  # in a row, the newest fit the last of them
        self._known: tuple[Standing, ...] = ()  # by the newest fit
        # Where the disk is: after a pause, somewhere at 0 V.
        measured = rig.recorder.displacement
        begin = action.h[0]
        self._at = State(
            number=action.step, h=begin if abs(measured - begin) <= ARRIVAL_M else max(measured, 0.0), contact=True
        )

    @property
    def spent(self) -> float:
        """Seconds of the rig in this step."""
        return self._before + self._rig.clock.now() - self._began

    @property
    def left(self) -> float:
        """What is left of them, the way back taken off."""
        return self._left_at(self._at.h, self._at.voltage)

    def _left_at(self, h: float, voltage: float) -> float:
        """What is left of them but for the way back from this place."""
        back = ramp_duration(self._rig.scene, voltage, 0.0) + self._action.by.settle_s
        back += abs(h - self._action.h[0]) / self._action.speed_between
        return self._action.duration - self.spent - back

    def _in_time(self, advice: Advice) -> bool:
        """Whether there is time to do so, and for the way back afterwards."""
        at = self._at
        if advice.kind is not Kind.GO or (advice.h, advice.voltage) == (at.h, at.voltage):
            return self.left > 0.0
        way = abs(advice.h - at.h) / self._action.speed_between
        if advice.voltage != at.voltage:
            way += ramp_duration(self._rig.scene, at.voltage, advice.voltage) + self._action.by.settle_s
        return self._left_at(advice.h, advice.voltage) - way >= LEAST_HOLD_S

    def run(self) -> Turns:
        if self.number == 0:
            yield from self._move(self._action.places[0.0][-1])
        while True:
            advice = yield from self._advised()
            self._failures = self._failures + 1 if advice.kind is Kind.FAILED else 0
            if advice.kind in (Kind.GO, Kind.FAILED) and not self._in_time(advice):
                advice = _out_of_time(advice)
            self._tell(advice)
            if advice.kind is Kind.GO:
                yield from self._go(advice)
                yield from self._hold(min(advice.hold_s, self.left))
            elif advice.kind is Kind.FAILED and self._failures < FAILURES:
                yield from self._hold(min(HOLD_ANYWAY_S, self.left))
            else:
                break
        self._result(advice)
        yield from self._voltage(0.0)
        yield from self._move(self._action.h[0])

    def _advised(self) -> Generator[None, None, Advice]:
        """The next advice; the film is held where it is, and recorded, until it has come."""
        rig = self._rig
        advisor = rig.advisor
        assert advisor is not None
        self.number += 1
        write_phase(rig, self._action, self._action.kind, "fit", voltage=self._at.voltage, record=True)
        began = rig.clock.now()
        advisor.ask(Ask(self._action.step, self.number, self._at.h, self._at.voltage, self.spent, self.left), began)
        while (advice := advisor.answer(rig.clock.now(), lambda: rig.control.count > 0)) is None:
            if rig.clock.now() - began > ANSWER_S:
                return Advice(Kind.FAILED, f"the fit took longer than {ANSWER_S:.0f} s")
            yield
        if advice.kind is Kind.GO and not self._allowed(advice):
            return Advice(Kind.FAILED, f"{1e3 * advice.h:g} mm at {advice.voltage:g} V is no place that was checked")
        return advice

    def _allowed(self, advice: Advice) -> bool:
        h = self._action.places.get(advice.voltage)
        return h is not None and advice.h in h and math.isfinite(advice.hold_s)

    def _tell(self, advice: Advice) -> None:
        rig = self._rig
        told = {"step": self._action.step, "number": self.number, "spent_s": self.spent}
        for one in advice.known:  # before the decision, so that no row of it comes without them
            rig.recorder.standing({"step": self._action.step, "number": self.number, **one.as_fields()})
        rig.recorder.decision({**told, **advice.as_fields()})
        self._known = advice.known or self._known
        words = ". ".join(one for one in (advice.standing, advice.reason) if one)
        if advice.kind is Kind.GO:
            rig.doing = advice.standing
        else:
            rig.control.say(f"{self._action.kind}: {words}.")
        if advice.kind is Kind.FAILED:
            rig.recorder.event("warning", "fit", advice.reason)

    def _result(self, ending: Advice) -> None:
        """All that was wanted, by the newest fit, in the order of the wish; NaN for what no fit has known yet.

        What no fit has settled needs more time, unless the loop ended because fits failed.
        """
        action, recorder = self._action, self._rig.recorder
        known = {one.quantity: one for one in self._known}
        for wish in action.by.wanted:
            one = known.get(wish.name)
            outcome, value, error = Kind.FAILED if self._failures else Kind.TIME, math.nan, math.nan
            said = f"not known: {ENDS[Kind.FAILED]}" if self._failures else "not known yet"
            if one is not None:
                failed = ending.kind is Kind.FAILED and one.outcome is Kind.TIME
                outcome, value, error = Kind.FAILED if failed else one.outcome, one.value, one.standard_uncertainty
                why = ending.reason if failed else one.reason
                said = f"{ENDS[outcome]} ({100 * one.relative:.3g} %; {why})"
            recorder.result(action.step, action.kind, str(outcome), wish.name, value, error, unit_of(wish.name))
            if len(action.by.wanted) > 1:
                self._rig.control.say(f"  {wish}: {said}.")

    def _go(self, advice: Advice) -> Turns:
        """At the lower of the two voltages: that the film bears."""
        if advice.voltage < self._at.voltage:
            yield from self._voltage(advice.voltage)
        yield from self._move(advice.h)
        yield from self._voltage(advice.voltage)

    def _move(self, h: float) -> Turns:
        if h != self._at.h:
            yield from self._do(move_to(self._action.by, self._at, h, self._action.speed_between, record=True))

    def _voltage(self, volts: float) -> Turns:
        if volts != self._at.voltage:
            settle = self._action.by.settle_s
            yield from self._do(voltage_to(self._action.by, self._at, self._rig.scene, volts, settle))

    def _do(self, part: Action) -> Turns:
        rig = self._rig
        write_phase(rig, part, part.kind, part.label, direction=part.direction, record=part.record)
        yield from part.carry_out(rig)

    def _hold(self, seconds: float) -> Turns:
        rig, at = self._rig, self._at
        label = f"hold {at.h * 1e3:g} mm, {at.voltage:g} V, {max(seconds, 0.0):.0f} s"
        words = f"{label}; {rig.doing}" if rig.doing else label
        write_phase(rig, self._action, self._action.kind, words, voltage=at.voltage, record=True)
        end = rig.clock.now() + seconds
        while rig.clock.now() < end:
            yield


def _out_of_time(last: Advice) -> Advice:
    return Advice(
        Kind.TIME,
        f"the time is out; {last.reason}" if last.kind is Kind.FAILED else "the time is out",
        quantity=last.quantity,
        value=last.value,
        standard_uncertainty=last.standard_uncertainty,
        relative=last.relative,
        wanted=last.wanted,
        known=last.known,
    )
