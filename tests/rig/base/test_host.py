"""The host's calendar and its sleep, under clocks that can be told."""

from __future__ import annotations

import pytest

from rig.base.clock import RealClock, VirtualClock
from rig.base.errors import FaultError
from rig.base.host import HostTime


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 0.2])
def test_a_calendar_that_was_set_is_told_once(step_s: float) -> None:
    clock = VirtualClock()
    host = HostTime(clock)
    clock.sleep_until(10.0)
    assert host.check() == 0.0
    clock.calendar_step_ns = round(step_s * 1e9)
    clock.sleep_until(11.0)
    assert host.check() == pytest.approx(step_s)
    clock.sleep_until(12.0)
    assert host.check() == 0.0


def test_a_suspension_is_a_fault() -> None:
    clock = VirtualClock()
    host = HostTime(clock)
    clock.slept = 60.0
    clock.sleep_until(1.0)
    with pytest.raises(FaultError, match=r"suspended for 60\.0 s"):
        host.check()


def test_two_processes_share_one_clock() -> None:
    one = RealClock()
    other = RealClock(one.zero, one.started_ns)
    earlier, later = one.now(), other.now()
    assert earlier <= later < earlier + 10.0
    assert other.epoch_ns(5.0) == one.epoch_ns(5.0)
    assert one.asleep() >= -1.0
