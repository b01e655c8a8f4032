"""What steps share about the high-voltage output: the second key, ramps, and the way to measured off."""

from __future__ import annotations

import math
from collections.abc import Generator

from drivers.roles import HVFlag
from rig.base.errors import FaultError
from rig.operator.control import Question
from rig.safety.guard import SAFE_VOLTAGE, TRIP, AnyGuard, GuardState, flag_names
from rig.steps.base import ALLOWED_S, Turns, allowed
from rig.steps.rig import Rig
from rig.steps.turns import wait

CLEARED = "--clear on the command line"  # as the log has it
MAY_CLEAR = "may be cleared"  # the operator's act


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

    What he said when he started the run holds once, and of what the supply showed then: what latches later has another
    cause.
    """
    guard = rig.guard
    said, rig.clear = rig.clear, ""
    if guard is None or guard.last is None or not guard.last.flags & TRIP:
        return
    flags = guard.last.flags & TRIP
    if flags & ~rig.latched_at_start:
        said = ""
    while not said:
        if rig.control.unattended:
            raise _latched(rig, flags)
        said, seen = yield from _ask_to_clear(rig, guard, flags)
        if seen & ~flags:  # it has a cause of its own
            said, flags = "", seen
    guard.clear_faults(said)
    rig.latched_at_start = HVFlag(0)
    rig.event("hv", f"cleared by {said}: {flag_names(flags)}")
    last = guard.last

    def gone() -> bool:  # the next sample may have been on its way when it was cleared
        return guard.last is not last and guard.last is not None and not guard.last.flags & TRIP

    yield from wait(rig, gone, ALLOWED_S, f"hv: the end of {flag_names(flags)} after it was cleared")


def _ask_to_clear(rig: Rig, guard: AnyGuard, flags: HVFlag) -> Generator[None, None, tuple[str, HVFlag]]:
    """His answer, and everything that showed until he gave it, gone again or not."""
    asking = rig.ask(Question(f"hv: the supply has latched: {flag_names(flags)}. Cause found and removed?", "clear"))
    while True:
        try:
            next(asking)
        except StopIteration as answered:
            return str(answered.value), flags
        if guard.last is not None:
            flags |= guard.last.flags & TRIP
        yield


def refuse_latched(rig: Rig) -> None:
    """Where nobody can say that the cause is removed, a run with voltage ends before anything moves.

    Where the operator said it when he started the run, it is noted of what he said it; of nothing, it holds no longer.
    """
    guard = rig.guard
    if guard is None or guard.last is None or rig.highest_voltage == 0.0:
        return
    rig.latched_at_start = guard.last.flags & TRIP
    if not rig.latched_at_start:
        rig.clear = ""
    elif rig.clear:
        rig.recorder.operator(MAY_CLEAR, flag_names(rig.latched_at_start), rig.clear)
    elif rig.control.unattended:
        raise _latched(rig, rig.latched_at_start)


def _latched(rig: Rig, flags: HVFlag) -> FaultError:
    later = flags & ~rig.latched_at_start
    when = f"during this run: {flag_names(later)}" if later else f"from before this run: {flag_names(flags)}"
    killed = ""
    if not later and HVFlag.EMERGENCY_OFF in flags:
        killed = "A run that was killed under voltage leaves an emergency off: its guard did that. "
    return FaultError(
        f"hv: the supply has latched {when}. {killed}Nobody is there to say that the cause is found and removed, so "
        "nothing was cleared, and no voltage was given since; the output is off. When it is removed, give the same "
        "command with --clear; on ports you can also leave out --yes, and answer the question."
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
