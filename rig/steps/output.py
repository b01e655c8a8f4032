"""What steps share about the high-voltage output: the second key, ramps, and the way to measured off."""

from __future__ import annotations

import math

from drivers.roles import HVFlag
from rig.base.errors import FaultError
from rig.operator.control import Question
from rig.safety.guard import SAFE_VOLTAGE, TRIP, GuardState, flag_names
from rig.steps.base import ALLOWED_S, Turns, allowed
from rig.steps.rig import Rig
from rig.steps.turns import wait

CLEARED = "--clear on the command line"  # as the log has it


def ramp_to(rig: Rig, target: float, limit: float) -> Turns:
    """Ramp, and wait until the measured voltage is there. A guard that is SAFE needs the operator's confirmation."""
    guard = rig.guard
    if guard is not None and guard.state is GuardState.SAFE:
        if target == 0.0:
            return  # off and measured so: nothing to arm for
        yield from confirm_voltage(rig)
    tolerance = max(10.0, 0.01 * target)
    rig.request_voltage(target)

    def arrived() -> bool:
        sample = rig.recorder.hv
        return (
            sample is not None
            and HVFlag.RAMPING not in sample.flags
            and math.isclose(sample.setpoint, target, rel_tol=1e-5, abs_tol=1e-3)  # it is single precision there
            and abs(sample.voltage - target) <= tolerance
        )

    yield from wait(rig, arrived, limit, f"The measured voltage's arrival at {target:g} V")


def confirm_voltage(rig: Rig) -> Turns:
    """The second key: the operator types the highest voltage. Nothing is asked while his last word still holds."""
    highest = rig.highest_voltage
    if rig.arming.allows(highest):
        return
    rig.arming.withdraw()
    yield from _clear_faults(rig)
    words = f"High voltage up to {highest:g} V. Lid closed, interlock closed, nobody touching the specimen?"
    said = yield from rig.ask(Question(words, expected=f"{highest:g}"))
    rig.arming.confirm(highest, f"{said}")


def _clear_faults(rig: Rig) -> Turns:
    """What the supply has latched (an earlier emergency off, a trip) is cleared only when the operator says so.

    What he said when he started the run holds once: what latches later has another cause.
    """
    guard = rig.guard
    said, rig.clear = rig.clear, ""
    if guard is None or guard.last is None or not guard.last.flags & TRIP:
        return
    if not said:
        if rig.control.unattended:
            raise _latched(guard.last.flags & TRIP)
        words = f"hv: the supply has latched: {flag_names(guard.last.flags & TRIP)}. Cause found and removed?"
        said = str((yield from rig.ask(Question(words, expected="clear"))))
    guard.clear_faults(said)
    last = guard.last
    yield from wait(rig, lambda: guard.last is not last and guard.last is not None, ALLOWED_S, "A new measurement")


def refuse_latched(rig: Rig) -> None:
    """Where nobody can say that the cause is removed, a run with voltage ends before anything moves."""
    guard = rig.guard
    if guard is None or guard.last is None or rig.highest_voltage == 0.0 or rig.clear or not rig.control.unattended:
        return
    if guard.last.flags & TRIP:
        raise _latched(guard.last.flags & TRIP)


def _latched(flags: HVFlag) -> FaultError:
    return FaultError(
        f"hv: the supply has latched from before this run: {flag_names(flags)}. A run that was killed under voltage "
        "leaves an emergency off: its guard did that. Nobody is there to say that the cause is found and removed, so "
        "nothing was cleared and no voltage given; the output is off. When it is removed, give the same command with "
        "--clear; or without --yes, and answer the question."
    )


def choose_about_live_output(rig: Rig) -> Turns:
    """A supply found live is reported and left alone; the operator may choose to have it taken down."""
    guard = rig.guard
    assert guard is not None
    if guard.last is None or (abs(guard.last.voltage) < SAFE_VOLTAGE and HVFlag.ON not in guard.last.flags):
        return
    found = f"hv: the output is live, measured {guard.last.voltage:.0f} V, though nobody switched it on from here."
    rig.recorder.event("warning", "hv", found)
    said = rig.take_down
    if not said:
        if rig.control.unattended:
            return  # nobody can choose: the run ends with the output as it was found
        answer = yield from rig.ask(Question(f"{found} Nothing was changed. Ramp it down to zero?", "take down"))
        said = str(answer)
    limit = allowed(guard.ramp_duration)
    guard.take_down(f"found live; {said}")
    yield from _until_off(rig, limit)


def take_down(rig: Rig, cause: str) -> Turns:
    """Ramp the voltage down, latch, and yield until it has been measured off.

    The operator's word is used up in any case: from here on somebody may touch the rig.
    """
    rig.arming.withdraw()
    guard = rig.guard
    if guard is None or guard.state is GuardState.SAFE:
        return
    limit = allowed(guard.ramp_duration)
    guard.ramp_off(cause)
    yield from _until_off(rig, limit)


def _until_off(rig: Rig, limit: float) -> Turns:
    guard = rig.guard
    assert guard is not None

    def off() -> bool:
        return guard.output_is_safe and guard.last is not None and HVFlag.ON not in guard.last.flags

    yield from wait(rig, off, limit, "The supply's way to zero")
    assert guard.last is not None
    rig.event("hv", f"off, measured {guard.last.voltage:.1f} V")
