"""What happens to the host's own time during a run: its calendar is set; it is suspended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rig.base.clock import VirtualClock
from rig.base.errors import FaultError
from rig.log.reader import read_log

Tell = Callable[..., Any]  # of conftest.Story


@pytest.mark.slow
@pytest.mark.parametrize("hours", [1.0, -1.0])
def test_a_calendar_that_is_set_changes_no_duration_and_is_told(
    tell: Tell, monkeypatch: pytest.MonkeyPatch, hours: float
) -> None:
    step_ns = round(hours * 3600e9)
    monkeypatch.setattr(
        VirtualClock, "calendar_ns", lambda self: self.epoch_ns(self.now()) + step_ns * (self.now() > 6.0)
    )
    story = tell()
    assert story.error is None and story.outcome.safe and abs(story.final_output) < 1.0
    log = read_log(story.log)
    told = [m.fields["message"] for m in log.messages("/event") if m.fields["source"] == "host"]
    assert len(told) == 1 and f"{hours * 3600:+.3f} s" in told[0]
    # Times in the log go on as before; the force still comes at its 100 Hz.
    assert np.ptp(np.diff(log.columns("/force/sample")["t_s"])) < 5e-3


@pytest.mark.slow
def test_a_computer_that_was_suspended_with_voltage_on_takes_it_off(
    tell: Tell, monkeypatch: pytest.MonkeyPatch
) -> None:
    story = tell(lambda bench, control: monkeypatch.setattr(VirtualClock, "asleep", lambda self: 60.0))
    assert isinstance(story.error, FaultError) and "suspended for 60.0 s" in story.outcome.reason
    assert abs(story.final_output) < 60 and story.outcome.safe and story.off_after < 1.5
    assert story.control_words[-1] == "emergency_off"
