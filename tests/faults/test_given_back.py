"""What arming changes in the supply is given back by whichever of program and guard is left, over real processes.

Asserted on the simulated module's own registers.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, cast

import pytest

from rig.base.errors import RigError
from rig.benchmark.stand import Run, Stand

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"), pytest.mark.slow]

TRIES = 3


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=20.0) as stand:
        yield stand


def registers(stand: Stand) -> dict[str, Any]:
    """Ramp, kill, set current, bounds, trip delay and action of the module."""

    def look(bench: Any) -> dict[str, Any]:
        module = cast(Any, bench.instruments["hv"])
        (channel,) = module._channels
        own = ("current_limit", "v_bounds", "i_bounds", "trip_delay_ms", "trip_action")
        kept = {name: getattr(channel, name) for name in own}
        return {**kept, "ramp": module._ramp_percent, "kill": module._kill}

    found: dict[str, Any] = stand.do(look)
    return found


def live(stand: Stand) -> tuple[Run, dict[str, Any]]:
    """A run with voltage on, and what the module had before it."""
    for left in reversed(range(TRIES)):
        stand.bench.power_cycle()
        before = registers(stand)
        run = stand.start(power_cycle=False)
        with suppress(RigError):
            stand.wait_until_live(run, 780.0)
            return run, before
        assert left
        stand.wait_until_alone(run)
    raise AssertionError


@pytest.mark.parametrize("killed", ["engine", "guard"])
def test_the_one_that_is_left_gives_the_supply_back_what_arming_changed(stand: Stand, killed: str) -> None:
    run, before = live(stand)
    armed = registers(stand)
    changed = {name for name, value in before.items() if armed[name] != value}
    assert {"current_limit", "trip_action", "ramp"} <= changed
    at = stand.kill(run.engine if killed == "engine" else run.guard)
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    stand.wait_until_alone(run)
    assert stand.bench.voltage() < 60.0
    assert registers(stand) == pytest.approx(before)
