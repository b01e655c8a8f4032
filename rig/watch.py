"""What is measured, held against the limits and against what a sensor can honestly say.

Every sample is judged as it comes in; once a turn the ages of all, and what two sensors say of one thing, are compared.
"""

from __future__ import annotations

import math

from drivers.roles import DisplacementSample, ForceSample, HVFlag, HVSample, Sample, StageSample
from rig.bench import Bench
from rig.errors import FaultError
from rig.recorder import Recorder
from rig.safety.guard import SAFE_VOLTAGE, AnyGuard, GuardState, flag_names
from rig.safety.limits import Limits

SILENCE_PERIODS = 10.0  # a sensor silent for this many periods, and longer than two of its time-outs, is a fault
BAD_SAMPLES = 3  # this many samples in a row that the sensor itself calls bad are a fault
FROZEN_SAMPLES = 25  # this many equal force readings in a row: an amplifier's last digits are never so quiet
DISAGREEMENT_M = 0.5e-3  # between laser and stage, besides what the stage moves in DISAGREEMENT_LAG_S ...
DISAGREEMENT_LAG_S = 0.05
DISAGREEMENT_S = 0.25  # ... and for longer than this: one of the two is frozen, or the pusher has slipped
# An unloaded sensor may be off by this part of the force limit: beyond it something is wrong with it, and a zero
# taken there would carry the limit away. Before the zero is taken the limit holds for the reading with that allowance.
ZERO_PART = 0.25


class Watch:
    """Judges samples, from the end of set-up until the run ends.

    Every method raises `LimitError` or `FaultError`, naming the quantity or device, its value and what is allowed.
    """

    def __init__(self, bench: Bench, recorder: Recorder, limits: Limits, guard: AnyGuard | None) -> None:
        self._recorder = recorder
        self._limits = limits
        self._guard = guard
        self._silence = allowed_silence(bench)
        self._newest = dict.fromkeys(bench.devices, bench.clock.now())
        self.newest_good = dict(self._newest)  # clock time at which each device's newest sample was found good
        self._bad = dict.fromkeys(bench.devices, 0)
        self._last_force = math.nan
        self._equal_forces = 0
        self._agreed = -math.inf
        self._seen_off = False

    def sample(self, role: str, sample: Sample, now: float) -> None:
        """Judge one sample, as the recorder gave it back."""
        self._newest[role] = now
        match sample:
            case ForceSample():
                if self._good(role, sample):
                    self._judge_frozen(sample)
                    self._judge_force(sample)
            case DisplacementSample():
                if self._good(role, sample) and math.isfinite(self._recorder.displacement_zero):
                    self._limits.displacement.check(self._recorder.quantity_of(sample), "Displacement measured")
            case HVSample():
                self._judge_output(sample)
        if isinstance(sample, StageSample) or not sample.flags:
            self.newest_good[role] = now

    def turn(self, now: float) -> None:
        """Judge what only shows over time: silence and disagreement."""
        recorder = self._recorder
        for role, allowed in self._silence.items():
            age = now - self._newest[role]
            if not age <= allowed:
                raise FaultError(f"{role}: no sample for {age:.2f} s.")
        if not math.isfinite(recorder.contact):
            return
        if not recorder.has_laser:
            self._limits.displacement.check(recorder.displacement, "Displacement measured")
        self._compare_stage_and_laser(now)

    def _good(self, role: str, sample: ForceSample | DisplacementSample) -> bool:
        """A sensor may call single samples bad, but not several in a row: then nobody knows where the film is."""
        self._bad[role] = self._bad[role] + 1 if sample.flags else 0
        if self._bad[role] >= BAD_SAMPLES:
            raise FaultError(f"{role}: {BAD_SAMPLES} samples in a row are bad ({flag_names(sample.flags)}).")
        return not sample.flags

    def _judge_frozen(self, sample: ForceSample) -> None:
        self._equal_forces = self._equal_forces + 1 if sample.reading == self._last_force else 0
        self._last_force = sample.reading
        if self._equal_forces >= FROZEN_SAMPLES:
            raise FaultError(f"force: {FROZEN_SAMPLES} equal readings in a row; the sensor is frozen.")

    def _judge_force(self, sample: ForceSample) -> None:
        recorder, limit = self._recorder, self._limits.force
        if math.isfinite(recorder.force_zero):
            limit.check(recorder.quantity_of(sample), "Force measured")
        else:
            limit.widened(1 + ZERO_PART).check(recorder.unzeroed(sample), "Force measured, before its zero")

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
        elif self._seen_off and (sample.voltage >= SAFE_VOLTAGE or on):
            raise FaultError(
                f"hv: the output is live ({sample.voltage:.0f} V) though nobody switched it on from here. "
                "Find out who did; take it down by hand; start again."
            )

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
                "One of them is frozen, or the pusher has slipped."
            )


def check_zero(limits: Limits, force_at_zero: float) -> None:
    """Refuse a zero of the force sensor (N, by its gain alone) so far off that it would carry the limit away.

    Raises
    ------
    LimitError
        Naming what was found and what is allowed.
    """
    limits.force.widened(ZERO_PART).check(force_at_zero, "Zero of the force sensor, unloaded")


def allowed_silence(bench: Bench) -> dict[str, float]:
    """Seconds without a sample after which a device counts as silent."""
    scene = bench.scene
    rates = {"stage": scene.stage.poll_rate_Hz, "force": bench.force.rate}
    if bench.displacement is not None:
        rates["displacement"] = bench.displacement.rate
    if scene.hv is not None:
        rates["hv"] = scene.hv.poll_rate_Hz
    return {role: max(2 * scene.instruments[role].timeout_s, SILENCE_PERIODS / rate) for role, rate in rates.items()}
