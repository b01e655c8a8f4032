r"""``do = "cycle"``: displacement or voltage to and fro, from one to a thousand million times: endurance.

Of every cycle the log has a summary (``/cycle``): it is the record by which a run that is taken up again goes on
counting, and by which a pause or a kill neither loses nor repeats a cycle. Samples and bytes of all cycles would fill
the disk, so the log keeps the whole waveform by a rule: cycles 1 to 10, then 20, 30, ... 100, 200, ... of every decade,
each ``keep_every``-th, the last, the first two after the run began or went on, and the seconds around whatever ends or
interrupts the step. ``/kept`` messages say where it does (`rig.log.decimation`).

Every byte is still logged up to the first cycle that is left out, and that far `dea-rig replay --verify` and a run done
again compare bit for bit. What an instrument's driver has seen meanwhile is not in the log behind that place, so that
later waveforms are data and not replayed; the report of the replay says from where on.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from drivers.roles import DisplacementSample, ForceSample, HVFlag, HVSample, Sample, StageSample
from rig.base.errors import LimitError, RigError
from rig.log.decimation import BEFORE_S
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, Result, State, Step, Turns, allowed, write_phase
from rig.steps.moves import move_to, voltage_to
from rig.steps.output import confirm_voltage, ramp_to
from rig.steps.rig import CyclesDone, Rig
from rig.steps.turns import arrive, listening, wait

LEAST_SAMPLES = 10  # of the force in a cycle
REST_POLLS = 3.0  # periods of the stage's polls at each end, in which it is seen to stand where it was sent
MOVING = 0.9  # share of half a period that a triangle takes; the rest is for starting and braking
STAIR_S, FEWEST_STAIRS = 0.5, 8  # a voltage slower than the scene's ramp goes in stairs
NATURAL = 0.7  # a ramp that takes at least this share of the time is left to the supply
LATE = 0.1  # share of the period by which a cycle may end late before the later ones are put off
AVERAGED = 5  # cycles over which reference and drift are averaged
ALL_OF_THE_FIRST = 10
AFTER_A_START = 2  # cycles kept after the run began or went on
DRIFT, LEAKS, DONE, BROKE, LIMITED = "drift", "leakage", "all cycles done", "breakdown", "limit"
Percent = Annotated[float, Field(gt=0, lt=1000)]


class Cycle(Step):
    """Displacement or voltage to and fro between two values, until the count is full or the film has changed too much.

    From ``from_mm`` to ``to_mm`` or from ``from_V`` to ``to_V``; the other quantity stays as it is. Ends at the first
    value. The response is the slope of the force over displacement, or over voltage squared, within a cycle.
    """

    needs_contact: ClassVar[bool] = True

    do: Literal["cycle"] = Field(description="The kind of step.")
    waveform: Literal["triangle", "trapezoid", "square", "sine"] = Field(
        default="triangle",
        description="triangle: to and fro without a rest but the stage's polls; trapezoid: with a rest at each end; "
        "square: as fast as limits.speed_mm_per_s or hv.ramp_V_per_s allow; sine: of the voltage, in stairs.",
    )
    from_mm: NotNegative = Field(default=0.0, description="Displacement at which each cycle begins (mm).")
    to_mm: Positive | None = Field(
        default=None, description="Displacement at the other end (mm).", json_schema_extra={"usual": [0.02, 200]}
    )
    from_V: NotNegative = Field(default=0.0, description="Voltage at which each cycle begins (V).")
    to_V: Positive | None = Field(
        default=None, description="Voltage at the other end (V).", json_schema_extra={"usual": [5, 30000]}
    )
    period_s: Positive = Field(
        description="Duration of a cycle (s). Typical: 0.5 to 10; at least ten samples of the force.",
        json_schema_extra={"usual": [0.02, 10000]},
    )
    rest_share: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        default=0.25, description="Share of the period that a trapezoid rests at each end. Typical: 0.1 to 0.4."
    )
    cycles: Annotated[int, Field(ge=1, le=10**9)] | None = Field(
        default=None, description="How many. This or hours. Typical: 1000 to 1000000."
    )
    hours: Positive | None = Field(default=None, description="For how long (h), in whole cycles. This or cycles.")
    keep_every: Annotated[int, Field(ge=0, le=10**9)] = Field(
        default=0,
        description="Keep the whole waveform of each so-many-th cycle as well; 0: only the rule by decades (1 to 10, "
        "20, 30, ... 100, 200, ...), the last one, and what is around events.",
    )
    reference_cycle: Annotated[int, Field(ge=1, le=10**6)] = Field(
        default=10, description="From this cycle on five make the response that counts as 100 %. Typical: 10."
    )
    stop_below_percent: Percent | None = Field(
        default=None, description="End when the response has fallen to this part of the reference (%). Typical: 80."
    )
    stop_above_percent: Percent | None = Field(
        default=None, description="End when the response has risen to this part of the reference (%). Typical: 120."
    )
    stop_leakage_nA: Positive | None = Field(
        default=None,
        description="End when the current at rest at the top is above this (nA); with a rest only: square, trapezoid.",
    )

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if (self.to_mm is None) == (self.to_V is None):
            raise ValueError("give to_mm or to_V")
        if (self.to_mm is None and self.from_mm) or (self.to_V is None and self.from_V):
            raise ValueError("from_mm goes with to_mm, from_V with to_V")
        if not (self.from_mm < self.to_mm if self.to_mm is not None else self.from_V < (self.to_V or 0.0)):
            raise ValueError("from_mm or from_V must be smaller than the other end")
        if (self.cycles is None) == (self.hours is None):
            raise ValueError("give cycles or hours")
        if self.count < 1:
            raise ValueError("hours is less than one period_s")
        if self.stop_leakage_nA is not None and self.waveform in ("triangle", "sine"):
            raise ValueError("stop_leakage_nA needs a rest at the top: waveform square or trapezoid")
        if self.drifts and self.count < self.reference_cycle + AVERAGED:
            raise ValueError(f"reference_cycle: it and the {AVERAGED - 1} after it must come before the last cycle")
        if (self.stop_below_percent or 0.0) >= 100.0 or not (self.stop_above_percent or 200.0) > 100.0:
            raise ValueError("stop_below_percent is below 100, stop_above_percent above")
        if self.to_mm is not None and self.waveform == "sine":
            raise ValueError("a stage cannot follow a sine; waveform triangle, trapezoid or square")
        return self

    @property
    def count(self) -> int:
        """How many cycles, by number or by time."""
        return self.cycles if self.cycles is not None else int((self.hours or 0.0) * 3600.0 / self.period_s)

    @property
    def drifts(self) -> bool:
        """Whether a change of the response ends it."""
        return self.stop_below_percent is not None or self.stop_above_percent is not None

    @property
    def highest_voltage(self) -> float:
        return self.to_V or 0.0

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        where = self.where(state.number)
        rate = scene.rates["force"]
        if not self.period_s * rate >= LEAST_SAMPLES:
            raise LimitError(
                f"{where}: period_s = {self.period_s:g} has fewer than {LEAST_SAMPLES} samples of the force at "
                f"{rate:g} Hz."
            )
        if self.stop_leakage_nA is not None and (scene.hv is None or not scene.hv.measures_current):
            raise LimitError(f"{where}: stop_leakage_nA needs a supply that measures its current.")
        before = state.done if state.done is not None else CyclesDone(0, math.nan)
        way = self._displacement(where, state, scene) if self.to_mm is not None else self._voltage(where, state, scene)
        yield from way.before
        yield Cycling(
            by=self,
            step=state.number,
            label=f"{self.count} cycles of {self.period_s:g} s, {way.words}",
            h=way.h,
            voltage=way.voltage,
            duration=(self.count - before.count) * self.period_s,
            speed=way.speed,
            cycle=0,
            rise_s=way.rise_s,
            stairs=way.stairs,
            done=before,
        )

    def _displacement(self, where: str, state: State, scene: Scene) -> _Way:
        low, high = self.from_mm * 1e-3, (self.to_mm or 0.0) * 1e-3
        half, rest = 0.5 * self.period_s, REST_POLLS / scene.stage.poll_rate_Hz
        fastest = scene.limits.speed_mm_per_s * 1e-3
        rise = {
            "triangle": MOVING * half - rest,
            "trapezoid": half - max(self.rest_share * self.period_s, rest),
            "square": (high - low) / fastest,
        }[self.waveform]
        longest = min(0.5 * half, half - rest) if self.waveform == "square" else half
        if not (rise > 0 and (high - low) / rise <= fastest * (1 + 1e-9) and rise <= longest):
            raise LimitError(
                f"{where}: a {self.waveform} of {(high - low) * 1e3:g} mm in period_s = {self.period_s:g} is too fast: "
                f"limits.speed_mm_per_s = {fastest * 1e3:g}, and the stage is seen to rest for {rest:g} s at each end "
                "(stage.poll_rate_Hz). Ask for a longer period or a shorter way."
            )
        speed = (high - low) / rise
        first = [] if state.h == low else [move_to(self, state, low, speed)]
        words = f"{low * 1e3:g} to {high * 1e3:g} mm at {state.voltage:g} V"
        return _Way(first, (low, high), (state.voltage, state.voltage), speed, rise, 1, words)

    def _voltage(self, where: str, state: State, scene: Scene) -> _Way:
        low, high = self.from_V, self.to_V or 0.0
        if scene.hv is None:
            raise LimitError(f"{where} asks for {high:g} V, but the scene has no [hv] instrument.")
        half, natural = 0.5 * self.period_s, (high - low) / scene.hv.ramp_V_per_s
        rise = {
            "triangle": half,
            "sine": half,
            "trapezoid": half - self.rest_share * self.period_s,
            "square": natural,
        }[self.waveform]
        steepest = (0.5 * math.pi if self.waveform == "sine" else 1.0) * natural
        longest = 0.5 * half if self.waveform == "square" else half
        stairs = 1 if self.waveform != "sine" and natural >= NATURAL * rise else int(rise / STAIR_S)
        if not (steepest <= rise * (1 + 1e-9) and rise <= longest) or (stairs != 1 and stairs < FEWEST_STAIRS):
            raise LimitError(
                f"{where}: a {self.waveform} of {high - low:g} V in period_s = {self.period_s:g} cannot be followed: "
                f"hv.ramp_V_per_s = {scene.hv.ramp_V_per_s:g}, and a slower rise goes in stairs of {STAIR_S:g} s, at "
                f"least {FEWEST_STAIRS}. Ask for a longer period, or set hv.ramp_V_per_s to the slope."
            )
        first = [] if state.voltage == low else [voltage_to(self, state, scene, low, 0.0)]
        words = f"{low:g} to {high:g} V at {state.h * 1e3:g} mm"
        return _Way(first, (state.h, state.h), (low, high), 0.0, rise, stairs, words)


@dataclass(frozen=True)
class _Way:
    """What goes to and fro: ends, speed, time of a rise, stairs in it; and what comes before the first cycle."""

    before: Sequence[Action]
    h: tuple[float, float]
    voltage: tuple[float, float]
    speed: float
    rise_s: float
    stairs: int
    words: str


@dataclass(frozen=True, kw_only=True)
class Cycling(Action):
    """All cycles. ``h`` and ``voltage`` are the two ends; it begins and ends at the first of them.

    Attributes
    ----------
    rise_s : float
        Time from one end to the other (s).
    stairs : int
        In how many set-points the voltage goes.
    done : CyclesDone
        What the run that this one goes on with had counted.
    """

    hears_errors: ClassVar[bool] = True

    by: Cycle
    rise_s: float
    stairs: int
    done: CyclesDone

    @property
    def kept_s(self) -> float:
        return sum(self.keeps(n) for n in self._candidates()) * self.by.period_s

    @property
    def summaries(self) -> int:
        return self.by.count - self.done.count

    def _candidates(self) -> Iterator[int]:
        """Numbers among which are all that are kept, each once."""
        first, last, every = self.done.count + 1, self.by.count, self.by.keep_every
        found = set(range(first, min(first + AFTER_A_START, last + 1))) | {last}
        for power in range(10):
            found.update(n for n in range(10**power, 10 ** (power + 1), 10**power) if first <= n <= last)
        yield from found
        if every:
            yield from (n for n in range(every * -(-first // every), last + 1, every) if n not in found)

    def keeps(self, n: int, began: int | None = None) -> bool:
        """Whether the whole waveform of cycle ``n`` stays in the log of a run that went on after ``began``."""
        decade = 10 ** (len(str(n)) - 1)
        began = self.done.count if began is None else began
        every = self.by.keep_every
        return (
            n <= ALL_OF_THE_FIRST
            or n % decade == 0
            or n == self.by.count
            or n <= began + AFTER_A_START
            or (every > 0 and n % every == 0)
        )

    def carry_out(self, rig: Rig) -> Turns:
        counted = rig.counts.setdefault(self.step, self.done)
        loop, watch = Loop(rig, self), Drift(self.by, counted.reference)
        if math.isfinite(counted.reference):
            watch.write(rig)
        began = rig.clock.now()
        try:
            with listening(rig, loop):
                outcome = yield from self._cycles(rig, loop, watch, counted.count)
        except RigError as error:
            if error.breakdown or isinstance(error, LimitError):
                told = watch.tell(rig, self, BROKE if error.breakdown else LIMITED, rig.clock.now() - began)
                if error.breakdown:
                    raise Result(told) from error
            raise
        finally:
            if loop.running:  # a pause, or the end of the run: done to the film, but not counted
                rig.recorder.cycle(loop.end(whole=False))
            if not rig.recorder.keeping:
                rig.recorder.keep(True, "cycling has ended or was interrupted", BEFORE_S)
        watch.tell(rig, self, outcome, rig.clock.now() - began)

    def _cycles(self, rig: Rig, loop: Loop, watch: Drift, began: int) -> Generator[None, None, str]:
        start = rig.clock.now()
        for n in range(began + 1, self.by.count + 1):
            self._keep(rig, n, began)
            loop.begin(n)
            yield from self._one(rig, loop, start)
            row = loop.end(whole=True)
            rig.recorder.cycle(row)
            why = watch.judge(rig, row)
            rig.counts[self.step] = CyclesDone(n, watch.reference)
            if why:
                return why
            start += self.by.period_s
            if rig.clock.now() > start + LATE * self.by.period_s:  # a turn of the loop late is none: it does not add up
                start = rig.clock.now()
        return DONE

    def _keep(self, rig: Rig, n: int, began: int) -> None:
        keeps = self.keeps(n, began)
        if keeps is not rig.recorder.keeping:
            rig.recorder.keep(keeps, f"cycle {n}")
            if keeps:
                write_phase(rig, self, self.kind, f"cycle {n}", cycle=n)

    def _one(self, rig: Rig, loop: Loop, start: float) -> Turns:
        stage = rig.bench.stage
        for half, end in ((1, 1), (2, 0)):
            until = start + 0.5 * half * self.by.period_s
            loop.resting_since = math.inf
            if self.moves:
                rig.move_to(self.h[end], self.speed)
                yield from wait(rig, lambda: not stage.moving, allowed(self.rise_s), "The end of the stage's move")
                yield from arrive(rig, rig.recorder.contact + self.h[end])
            else:
                yield from self._change(rig, self.voltage[1 - end], self.voltage[end], until)
            now = rig.clock.now()
            if end == 1 and now < until:
                loop.resting_since = 0.5 * (now + until)
            while rig.clock.now() < until:
                yield

    def _change(self, rig: Rig, before: float, after: float, until: float) -> Turns:
        began = rig.clock.now()
        if rig.guard is not None:
            yield from confirm_voltage(rig)
        for k in range(1, self.stairs):
            share = k / self.stairs
            part = 0.5 - 0.5 * math.cos(math.pi * share) if self.by.waveform == "sine" else share
            level = before + (after - before) * part
            rig.request_voltage(float(round(level)) if rig.scene.hv and rig.scene.hv.whole_volts else level)
            while rig.clock.now() < min(began + self.rise_s * share, until):
                yield
        yield from ramp_to(rig, after, allowed(self.rise_s))


class Loop:
    """Sums up one cycle after the other from the samples as they arrive; forgets each at its end."""

    def __init__(self, rig: Rig, action: Cycling) -> None:
        self._rig = rig
        self._action = action
        self.running = False
        self.resting_since = math.inf  # from when on voltage and disk stand at the top
        self._h = _Line()  # they go on from cycle to cycle
        self._v = _Line()

    def begin(self, n: int) -> None:
        """Cycle ``n`` begins now."""
        self.running, self._n = True, n
        self._begin = self._rig.clock.now()
        self._kept = self._rig.recorder.keeping
        self._force, self._displacement, self._volts, self._amperes = Ends(), Ends(), Ends(), Ends()
        self._by_h, self._by_v = Slope(), Slope()
        self._work = self._electric = 0.0
        self._last: tuple[float, float] | None = None  # force and displacement
        self._power: tuple[float, float] | None = None  # time and watts
        self._leaks: list[float] = []
        self.resting_since = math.inf

    def __call__(self, sample: Sample) -> None:
        if not self.running:
            return
        match sample:
            case ForceSample() if not sample.flags:
                self._on_force(sample.t, self._rig.recorder.quantity_of(sample))
            case DisplacementSample() if not sample.flags:
                self._on_displacement(sample.t, self._rig.recorder.displacement)
            case StageSample() if not self._rig.recorder.has_laser:
                self._on_displacement(sample.t, self._rig.recorder.displacement)
            case HVSample():
                self._on_output(sample)

    def _on_displacement(self, t: float, h: float) -> None:
        self._h.add(t, h)
        self._displacement.add(h)

    def _on_force(self, t: float, force: float) -> None:
        self._force.add(force)
        h, volts = self._h.at(t), self._v.at(t)
        if self._action.moves:
            self._by_h.add(h, force)
        else:
            self._by_v.add(volts * volts, force)
        if not math.isfinite(h):  # nothing has been measured yet
            return
        if self._last is not None:
            self._work += 0.5 * (force + self._last[0]) * (h - self._last[1])
        self._last = force, h

    def _on_output(self, sample: HVSample) -> None:
        self._v.add(sample.t, sample.voltage)
        self._volts.add(sample.voltage)
        self._amperes.add(sample.current)
        power = sample.voltage * sample.current
        if self._power is not None:
            self._electric += 0.5 * (power + self._power[1]) * (sample.t - self._power[0])
        self._power = sample.t, power
        if sample.t >= self.resting_since and HVFlag.RAMPING not in sample.flags:
            self._leaks.append(sample.current)

    def end(self, *, whole: bool) -> dict[str, float | int | bool]:
        """The cycle ends; its summary, as ``/cycle`` has it."""
        self.running = False
        return {
            "step": self._action.step,
            "cycle": self._n,
            "whole": whole,
            "kept": self._kept,
            "begin_s": self._begin,
            "samples": self._force.count,
            "force_valley_N": self._force.low,
            "force_peak_N": self._force.high,
            "displacement_valley_m": self._displacement.low,
            "displacement_peak_m": self._displacement.high,
            "voltage_valley_V": self._volts.low,
            "voltage_peak_V": self._volts.high,
            "current_valley_A": self._amperes.low,
            "current_peak_A": self._amperes.high,
            "stiffness_N_per_m": self._by_h.slope,
            "actuation_N_per_V2": self._by_v.slope,
            "work_J": self._work if self._force.count > 1 else math.nan,
            "electric_J": self._electric if self._amperes.count > 1 else math.nan,
            "leakage_A": statistics.fmean(self._leaks) if self._leaks else math.nan,
        }


@dataclass
class Ends:
    """Smallest and largest of what was measured; NaN before."""

    low: float = math.nan
    high: float = math.nan
    count: int = 0

    def add(self, value: float) -> None:
        if not math.isfinite(value):
            return
        self.low = value if not value > self.low else self.low
        self.high = value if not value < self.high else self.high
        self.count += 1


@dataclass
class Slope:
    """Slope of y over x by least squares, in one pass."""

    _n: int = 0
    _x: float = 0.0
    _y: float = 0.0
    _xx: float = 0.0
    _xy: float = 0.0

    def add(self, x: float, y: float) -> None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return
        self._n += 1
        away = x - self._x
        self._x += away / self._n
        self._y += (y - self._y) / self._n
        self._xx += away * (x - self._x)
        self._xy += away * (y - self._y)

    @property
    def slope(self) -> float:
        return self._xy / self._xx if self._n > 2 and self._xx > 0 else math.nan


@dataclass
class _Line:
    """A quantity at another one's instants: by its last two samples, no further than one of its periods beyond."""

    _t: float = math.nan
    _x: float = math.nan
    _rate: float = 0.0
    _gap: float = 0.0

    def add(self, t: float, x: float) -> None:
        gap = t - self._t
        self._rate, self._gap = ((x - self._x) / gap, gap) if gap > 0 else (0.0, 0.0)
        self._t, self._x = t, x

    def at(self, t: float) -> float:
        return self._x + self._rate * min(max(t - self._t, -self._gap), self._gap)


@dataclass
class Drift:
    """Holds each cycle against the criteria; ``reference`` is the response that counts as 100 %, NaN before."""

    step: Cycle
    reference: float
    _response: deque[float] = field(default_factory=lambda: deque(maxlen=AVERAGED))
    _leaks: deque[float] = field(default_factory=lambda: deque(maxlen=AVERAGED))
    _count: int = 0

    @property
    def _unit(self) -> str:
        return "N/m" if self.step.to_mm is not None else "N/V2"

    def judge(self, rig: Rig, row: dict[str, float | int | bool]) -> str:
        """Why this whole cycle is the last one; empty: it is not."""
        self._count = int(row["cycle"])
        name = "stiffness_N_per_m" if self.step.to_mm is not None else "actuation_N_per_V2"
        if math.isfinite(row[name]):
            self._response.append(float(row[name]))
        if math.isfinite(row["leakage_A"]):
            self._leaks.append(float(row["leakage_A"]))
        if math.isnan(self.reference):
            if self._count >= self.step.reference_cycle + AVERAGED - 1 and len(self._response) == AVERAGED:
                self.reference = statistics.fmean(self._response)
                self.write(rig)
            return self._leaking()
        share = 100.0 * self.share
        below, above = self.step.stop_below_percent, self.step.stop_above_percent
        if len(self._response) == AVERAGED and (
            (below is not None and share <= below) or (above is not None and share >= above)
        ):
            return DRIFT
        return self._leaking()

    @property
    def share(self) -> float:
        """The response of the last cycles, over the reference."""
        known = self._response and math.isfinite(self.reference) and self.reference != 0.0
        return statistics.fmean(self._response) / self.reference if known else math.nan

    def _leaking(self) -> str:
        most = self.step.stop_leakage_nA
        full = len(self._leaks) == AVERAGED
        return LEAKS if most is not None and full and statistics.fmean(self._leaks) > most * 1e-9 else ""

    def write(self, rig: Rig) -> None:
        """Write the reference to the log: a run taken up again is held against the same one."""
        rig.recorder.reference("cycle_response", self.reference, math.nan, self._unit)

    def tell(self, rig: Rig, action: Cycling, outcome: str, seconds: float) -> str:
        """Write the result to the log; returns it in words."""
        cycles = rig.counts[action.step].count
        leak = statistics.fmean(self._leaks) if self._leaks else math.nan
        for name, value, unit in (
            ("cycles", float(cycles), "1"),
            ("response", self.share * self.reference, self._unit),
            ("reference_response", self.reference, self._unit),
            ("leakage", leak, "A"),
            ("duration", seconds, "s"),
        ):
            rig.recorder.result(action.step, action.kind, outcome, name, value, math.nan, unit)
        changed = f", response {100.0 * self.share:.1f} % of the reference" if math.isfinite(self.share) else ""
        text = f"{outcome} after {cycles} cycles{changed}"
        rig.event("film", text)
        return text
