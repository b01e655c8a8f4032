"""What is measured, held against the limits and against what a sensor can honestly say.

Every sample is judged as it comes in; once a turn the ages of all, and what two sensors say of one thing, are compared.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from itertools import pairwise

from drivers.roles import OK, DisplacementSample, ForceSample, HVFlag, HVSample, MonitorSample, Sample, StageSample
from rig.base.errors import FaultError, StaleData
from rig.bench.bench import Bench
from rig.engine.follows import ForceFollows
from rig.engine.laser_scale import LaserScale
from rig.log.recorder import Recorder
from rig.safety.guard import SAFE_VOLTAGE, AnyGuard, GuardState, flag_names
from rig.safety.limits import ZERO_PART, Limits, StretchLimit

# Fresh data or stop. A device may miss two of its periods and take its time-out more (`timeout_s` in the scene: what
# its wire and the host may delay one answer; one lost answer is asked again after it). A turn of the loop that took
# longer than LATE_S is the host's fault, not the sensor's: nobody looked.
SILENT_PERIODS = 2.0
LATE_S = 0.02
BAD_SAMPLES = 3  # this many samples in a row that the sensor itself calls bad, so more than two periods, are a fault
# Frozen: more equal readings in a row than the sensor's own noise will give in FROZEN_ODDS samples. How often two
# readings are equal is measured while the sensor is unloaded (the zero step); until then FROZEN_SAMPLES are allowed.
FROZEN_SAMPLES, FROZEN_FEWEST, FROZEN_ODDS = 25, 3, 1e9
STUCK_M = 20e-6  # a stage that should have moved this far while it said that it moves, but shows no step, is frozen
DISAGREEMENT_M = 0.5e-3  # between laser and stage, besides what the stage moves in DISAGREEMENT_LAG_S ...
DISAGREEMENT_LAG_S = 0.05
DISAGREEMENT_S = 0.25  # ... and for longer than this: one of the two is frozen, or the pusher has slipped


class Watch:
    """Judges samples, from the end of set-up until the run ends.

    Every method raises `LimitError` or `FaultError`, naming the quantity or device, its value and what is allowed.
    """

    def __init__(self, bench: Bench, recorder: Recorder, limits: Limits, guard: AnyGuard | None) -> None:
        self._recorder = recorder
        self._limits = limits
        self._from_stored_zero = limits.force.widened(1.0 if recorder.has_stored_zero else 1 + ZERO_PART)
        self._guard = guard
        self._silence = allowed_silence(bench)
        self._newest = dict.fromkeys(bench.devices, bench.clock.now())
        self.newest_good = dict(self._newest)  # clock time at which each device's newest sample was found good
        self._bad = dict.fromkeys(bench.devices, 0)
        self._last_reading = {"force": math.nan, "displacement": math.nan}
        self._equal = dict.fromkeys(self._last_reading, 0)
        self._frozen = {"force": float(FROZEN_SAMPLES), "displacement": math.inf}  # a laser may well be so quiet
        self._stuck_since: tuple[float, int] | None = None  # time and step of the stage where it last advanced
        self._last_turn = bench.clock.now()
        self._agreed = -math.inf
        self._seen_off = False
        self._follows = ForceFollows(bench.scene, limits)
        self._scale = LaserScale()
        self._stretch = StretchLimit(bench.scene.specimen.specimen(), limits)

    def sample(self, role: str, sample: Sample, now: float) -> None:
        """Judge one sample, as the recorder gave it back."""
        self._newest[role] = now
        match sample:  # the most frequent first
            case ForceSample():
                if self._good(role, sample):
                    self._judge_frozen(role, sample.reading)
                    self._judge_force(sample)
                    self._judge_following(sample)
            case StageSample():
                self._judge_stuck(sample)
            case DisplacementSample():
                if self._good(role, sample):
                    self._judge_frozen(role, sample.displacement)
                    if math.isfinite(self._recorder.displacement_zero):
                        self._limits.displacement.check(self._recorder.quantity_of(sample), "Displacement measured")
            case HVSample():
                self._judge_output(sample)
            case MonitorSample() if role in self._silence:
                self._good(role, sample)
        if isinstance(sample, StageSample) or sample.flags == OK or not sample.flags:
            self.newest_good[role] = now

    def turn(self, now: float) -> None:
        """Judge what only shows over time: silence and disagreement."""
        recorder = self._recorder
        late = now - self._last_turn - LATE_S
        self._last_turn = now
        for role, allowed in self._silence.items():
            if late > 0:
                self._newest[role] = min(self._newest[role] + late, now)
            age = now - self._newest[role]
            if not age <= allowed:
                kind = FaultError if role == "hv" else StaleData  # an output that is not seen is not ramped, but cut
                raise kind(f"{role}: no sample for {age:.2f} s.")
        if not math.isfinite(recorder.contact):
            self._prove_scale()
            return
        if not recorder.has_laser:
            self._limits.displacement.check(recorder.displacement, "Displacement measured")
        self._stretch.check(recorder.displacement, "Film, at the displacement measured")
        self._compare_stage_and_laser(now)

    def _good(self, role: str, sample: ForceSample | DisplacementSample | MonitorSample) -> bool:
        """A sensor may call single samples bad, but not several in a row: then nobody knows where the film is."""
        if sample.flags == OK:  # nearly always
            self._bad[role] = 0
            return True
        self._bad[role] += 1
        if self._bad[role] >= BAD_SAMPLES:
            raise StaleData(f"{role}: {BAD_SAMPLES} samples in a row are bad ({flag_names(sample.flags)}).")
        return False

    def learn(self, role: str, readings: Sequence[float]) -> None:
        """Learn from readings of the unloaded sensor how many equal ones in a row its noise can give."""
        equal = sum(a == b for a, b in pairwise(readings))
        chance = (equal + 1) / (len(readings) + 1)  # that the next one is equal, never quite 0 or 1
        longest = math.log(FROZEN_ODDS) / -math.log(chance)
        self._frozen[role] = max(math.ceil(longest), FROZEN_FEWEST)
        if role == "force":
            self._follows.learn(statistics.pstdev(map(self._recorder.from_stored_zero, readings)))

    def _judge_frozen(self, role: str, reading: float) -> None:
        self._equal[role] = self._equal[role] + 1 if reading == self._last_reading[role] else 0
        self._last_reading[role] = reading
        if self._equal[role] >= self._frozen[role]:
            raise StaleData(f"{role}: {self._equal[role] + 1} equal readings in a row; the sensor is frozen.")

    def _judge_stuck(self, sample: StageSample) -> None:
        """A stage that says it moves must show steps, as many as its speed asks for."""
        if not sample.moving or self._stuck_since is None or sample.raw != self._stuck_since[1]:
            self._stuck_since = (sample.t, sample.raw)
            return
        still = sample.t - self._stuck_since[0]
        if still > self._silence["stage"] and still * self._recorder.speed > STUCK_M:
            raise StaleData(f"stage: it says that it moves, but its position has not changed for {still:.2f} s.")

    def _judge_force(self, sample: ForceSample) -> None:
        recorder = self._recorder
        if math.isfinite(recorder.force_zero):
            self._limits.force.check(recorder.quantity_of(sample), "Force measured")
        reading = recorder.from_stored_zero(sample.reading)
        self._from_stored_zero.check(reading, "Force measured, against the stored zero")

    def _judge_following(self, sample: ForceSample) -> None:
        """In contact with the film only; the samples of a zero step are not."""
        recorder = self._recorder
        if not (math.isfinite(recorder.contact) and math.isfinite(recorder.force_zero)):
            self._follows.restart()
            return
        volts = 0.0 if recorder.hv is None else abs(recorder.hv.voltage)
        self._follows.sample(recorder.quantity_of(sample), recorder.displacement, volts)

    def _judge_output(self, sample: HVSample) -> None:
        """A supply whose guard is SAFE must stay off, once it has been measured off."""
        guard = self._guard
        if guard is None:
            return
        on = HVFlag.ON in sample.flags
        if guard.state is not GuardState.SAFE:
            self._seen_off = False
        elif guard.output_is_safe and not on:
            self._seen_off = True
        elif self._seen_off and (not abs(sample.voltage) < SAFE_VOLTAGE or on):
            raise FaultError(
                f"hv: the output is live ({sample.voltage:.0f} V) though nobody switched it on from here. "
                "Find out who did; take it down by hand; start again."
            )

    def _prove_scale(self) -> None:
        stage, laser = self._recorder.stage, self._recorder.displacement_sample
        if self._recorder.has_laser and stage is not None and laser is not None and stage.moving and not laser.flags:
            self._scale.sample(stage.t, stage.position, self._recorder.without_zero(laser))

    def _compare_stage_and_laser(self, now: float) -> None:
        """Beyond contact the disk goes with the stage; if they part, one of the two sensors does not tell the truth."""
        recorder = self._recorder
        if not recorder.has_laser or recorder.stage is None:
            return
        by_stage = recorder.stage.position - recorder.contact
        allowed = DISAGREEMENT_M + DISAGREEMENT_LAG_S * self._limits.speed.high
        if by_stage < 0 or abs(by_stage - recorder.displacement) <= allowed:
            self._agreed = now
        elif now - self._agreed > DISAGREEMENT_S:
            raise FaultError(
                f"stage and laser disagree: {by_stage * 1e3:.2f} against {recorder.displacement * 1e3:.2f} mm. "
                "One of them is frozen, the pusher has slipped, or the unit or scale of one is wrong."
            )


def allowed_silence(bench: Bench) -> dict[str, float]:
    """Seconds without a sample after which a device counts as silent: two of its periods and its time-out."""
    scene = bench.scene
    rates = {"stage": scene.stage.poll_rate_Hz, "force": bench.force.rate}
    if bench.displacement is not None:
        rates["displacement"] = bench.displacement.rate
    if scene.hv is not None:
        rates["hv"] = scene.hv.sample_rate
    if second := scene.second_reading:  # what the air is ends no run
        rates[second] = scene.monitors[second].sample_rate
    return {role: SILENT_PERIODS / rate + scene.instruments[role].timeout_s for role, rate in rates.items()}
