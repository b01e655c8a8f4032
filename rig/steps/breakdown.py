"""``do = "breakdown"``: the voltage rises until the film breaks down, or has borne the highest one that is asked for.

Breakdown is then a result and no fault: the output goes off at once, the result is written to the log, and the run ends
complete. What is at breakdown, voltage and fields, is what was measured and computed at the last sample before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from drivers.roles import HVSample, Sample
from model.membrane.solve import profiles, solve
from model.specimen import Specimen
from rig.base.errors import LimitError, RigError
from rig.safety.limits import FLAT_M
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, Result, State, Step, Turns
from rig.steps.moves import voltage_to
from rig.steps.output import ramp_to
from rig.steps.rig import Rig
from rig.steps.turns import listening, pause

STAIR_S = 0.5  # a rate below that of the supply is made of steps, one in this time
BROKE, BORNE, LIMITED = "breakdown", "ceiling", "limit"


class Breakdown(Step):
    """Raise the voltage until the film breaks down, up to a ceiling; nothing after it is carried out if it does.

    The scene's ``limits`` must allow the ceiling: voltage, field and tension are watched as ever, and where one of them
    is met first the result says so and counts, like the ceiling, as survived. With a supply that measures no current,
    a breakdown is an output that sags, and its voltage an upper bound.
    """

    needs_contact: ClassVar[bool] = True

    do: Literal["breakdown"] = Field(description="The kind of step.")
    ceiling_V: Positive = Field(
        description="Highest voltage (V). A film that bears it has survived: its value is censored there.",
        json_schema_extra={"usual": [200, 30000]},
    )
    rate_V_per_s: Positive | None = Field(
        default=None,
        description="How fast the voltage rises (V/s), in steps of half a second where it is below the scene's "
        "hv.ramp_V_per_s. Absent: that rate. Typical: 10 to 500; what a film bears depends on it.",
    )
    hold_s: NotNegative = Field(
        default=0.0,
        description="How long to wait at the ceiling for a breakdown (s). Typical: 0, or 60 to 3600 for a test of how "
        "long a film bears a voltage.",
        json_schema_extra={"usual": [1, 100000]},
    )

    @property
    def highest_voltage(self) -> float:
        return self.ceiling_V

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        most = scene.hv.ramp_V_per_s if scene.hv is not None else math.inf
        rate = min(most, self.rate_V_per_s or most)
        if self.rate_V_per_s is not None and self.rate_V_per_s > most:
            raise LimitError(
                f"{self.where(state.number)}: rate_V_per_s = {self.rate_V_per_s:g} is above the scene's "
                f"hv.ramp_V_per_s = {most:g}. Lower the one or raise the other."
            )
        if not self.ceiling_V > state.voltage:
            raise LimitError(
                f"{self.where(state.number)}: ceiling_V = {self.ceiling_V:g} is not above the {state.voltage:g} V that "
                "are on by then."
            )
        before, state.voltage = state.voltage, self.ceiling_V
        yield Rise(
            by=self,
            step=state.number,
            label=f"voltage to {self.ceiling_V:g} V at {rate:g} V/s, until it breaks down",
            h=(state.h, state.h),
            voltage=(before, self.ceiling_V),
            duration=(self.ceiling_V - before) / rate + self.hold_s,
            rate=rate,
            most=most,
            hold=self.hold_s,
        )
        yield voltage_to(self, state, scene, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Rise(Action):
    """The voltage rises at ``rate`` (V/s), ``most`` being the supply's; then ``hold`` seconds at the ceiling."""

    hears_errors: ClassVar[bool] = True

    rate: float
    most: float
    hold: float

    def carry_out(self, rig: Rig) -> Turns:
        last = Last(rig)
        began = rig.clock.now()
        try:
            with listening(rig, last):
                yield from self._raise(rig)
                yield from pause(rig, self.hold)
        except RigError as error:
            if not error.breakdown and not isinstance(error, LimitError):
                raise
            told = last.write(self, BROKE if error.breakdown else LIMITED, rig.clock.now() - began)
            if error.breakdown:
                raise Result(told) from error
            raise
        last.write(self, BORNE, rig.clock.now() - began)

    def rise_in(self, seconds: float) -> float:
        """By how much (V) the output rises at most in so many ``seconds``: a stair is climbed at the supply's ramp."""
        if math.isnan(seconds):
            return math.nan
        whole = math.floor(seconds / STAIR_S)
        stair = self.rate * STAIR_S
        return whole * stair + min(stair, self.most * (seconds - whole * STAIR_S))

    def _raise(self, rig: Rig) -> Turns:
        start, end = self.voltage
        if self.rate < self.most:
            stairs = math.ceil((end - start) / self.rate / STAIR_S)
            yield from ramp_to(rig, start + (end - start) / stairs, self.allowed_s)
            for k in range(2, stairs):
                rig.request_voltage(start + (end - start) * k / stairs)
                yield from pause(rig, STAIR_S)
        yield from ramp_to(rig, end, self.allowed_s)


def film_at(specimen: Specimen, h: float, volts: float) -> tuple[float, float, float]:
    """Largest field in the film, field at the disk's edge (V/m) and charge (C) by the model; NaN without a state.

    With the relaxed energy where the film has lost tension.
    """
    h = max(h, FLAT_M)
    state = solve(specimen, h, volts, wrinkling="tension_field")
    if not state.answered:
        return math.nan, math.nan, math.nan
    there = profiles(specimen, [h], [volts], 3, wrinkling="tension_field")
    return state.peak_field, volts / specimen.thickness * float(there.thinning[0, 0]), state.capacitance() * volts


class Last:
    """The last sample of the voltage before whatever ends the rise, the one before that, and the one after it."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._newest: HVSample | None = None
        self._before: HVSample | None = None
        self._after: HVSample | None = None
        self._h = math.nan

    def __call__(self, sample: Sample) -> None:
        if isinstance(sample, HVSample):
            # The one on which a breakdown is seen is no longer the film's: the voltage falls by then.
            if self._newest is None or sample.voltage >= self._newest.voltage:
                self._before, self._newest, self._after = self._newest, sample, None
            elif self._after is None:
                self._after = sample
            self._h = self._rig.recorder.displacement

    def write(self, action: Rise, outcome: str, seconds: float) -> str:
        """Write the result to the log; returns it in words.

        Without a current a film that broke down is seen only where the output sags: one of high resistance may have
        broken down far below. What is written is an upper bound then, what the voltage may have risen to before the
        next sample, at most to the ceiling; no uncertainty is stated.
        """
        volts = self._newest.voltage if self._newest is not None else math.nan
        gap = _between(self._before, self._newest)
        apart = action.rise_in(gap) / math.sqrt(12.0)  # it broke anywhere between this sample and the next
        hv = self._rig.scene.hv
        at_most = outcome == BROKE and hv is not None and not hv.measures_current
        if at_most:
            rise = action.rise_in(gap if self._after is None else _between(self._newest, self._after))
            volts, apart = max(volts, min(action.voltage[1], volts + rise)), math.nan
        peak, edge, charge = film_at(self._rig.scene.specimen.specimen(), self._h, volts)
        share = apart / volts if volts else math.nan
        for name, value, uncertainty, unit in (
            ("voltage", volts, apart, "V"),
            ("field", peak, peak * share, "V/m"),
            ("field_at_disk", edge, edge * share, "V/m"),
            ("displacement", self._h, math.nan, "m"),
            ("duration", seconds, math.nan, "s"),
            ("charge", charge, charge * share, "C"),
        ):
            self._rig.recorder.result(action.step, action.kind, outcome, name, value, uncertainty, unit)
        words = {BROKE: "breakdown at", BORNE: "no breakdown up to", LIMITED: "no breakdown, a limit was met at"}
        bound = " or below (no current is measured)" if at_most else ""
        text = f"{words[outcome]} {volts:.0f} V{bound}, {peak * 1e-6:.1f} V/um in the film at {self._h * 1e3:.2f} mm"
        self._rig.event("film", text)
        return text


def _between(first: HVSample | None, second: HVSample | None) -> float:
    """Seconds from the one to the other; NaN where one is missing."""
    return second.t - first.t if first is not None and second is not None else math.nan
