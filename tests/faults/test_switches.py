"""Each thing that can go wrong with a wire or an instrument, met by driver and engine as required.

*Tolerated* means: the run completes, nothing recorded is wrong, and the driver has counted what it met. *Safe* means:
the run ends as a fault or limit and the supply's own output is off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from model.membrane import solve_many
from rig.log.reader import read_log
from rig.sim.settings import Fault

Tell = Callable[..., Any]  # of conftest.Story

TOLERATED = [
    # A little of everything that happens on a long wire.
    ("stage", "delay", {"value": 0.02}),
    ("stage", "drop", {"probability": 0.02}),
    ("stage", "split", {}),
    ("stage", "merge", {"probability": 0.02}),
    ("stage", "duplicate", {}),
    ("stage", "corrupt", {"probability": 0.02}),
    ("stage", "alert", {"duration_s": 3.0}),
    ("force", "delay", {"value": 0.02}),
    ("force", "drop", {"probability": 0.05}),
    ("force", "split", {}),
    ("force", "merge", {}),
    ("displacement", "delay", {"value": 0.02}),
    ("displacement", "drop", {"probability": 0.02}),
    ("displacement", "split", {}),
    ("displacement", "merge", {"probability": 0.02}),
    ("displacement", "duplicate", {}),
    ("displacement", "alert", {"duration_s": 3.0}),
    ("hv", "delay", {"value": 0.02}),
    ("hv", "drop", {"probability": 0.02}),
    ("hv", "duplicate", {}),
]
SAFE = [
    ("stage", "drop", {}),
    ("stage", "corrupt", {}),
    ("stage", "silent", {}),
    ("stage", "vanish", {}),
    ("stage", "reset", {}),
    ("stage", "freeze", {}),
    ("stage", "wrong_status", {}),
    ("force", "drop", {}),
    ("force", "duplicate", {}),  # so are doubled ones
    ("force", "silent", {}),
    ("force", "vanish", {}),
    ("force", "reset", {}),
    ("force", "saturate", {}),
    ("force", "freeze", {}),
    ("force", "wrong_status", {}),
    ("displacement", "drop", {}),
    ("displacement", "silent", {}),
    ("displacement", "vanish", {}),
    ("displacement", "reset", {}),
    ("displacement", "saturate", {}),
    ("displacement", "no_value", {}),
    ("displacement", "freeze", {}),
    ("hv", "reset", {}),
    ("hv", "breakdown", {}),
    ("hv", "over_current", {}),
    ("hv", "sag", {}),
    ("hv", "interlock", {}),
    ("hv", "inhibit", {}),
]


def names(entry: object) -> str | None:
    return entry if isinstance(entry, str) else None


def begin(role: str, kind: str, more: dict[str, Any]) -> Callable[..., None]:
    return lambda bench, stop: bench.inject(Fault(role=role, kind=kind, **more))


@pytest.mark.slow
@pytest.mark.parametrize(("role", "kind", "more"), TOLERATED, ids=names)
def test_tolerated(tell: Tell, role: str, kind: str, more: dict[str, Any]) -> None:
    story = tell(begin(role, kind, more))
    assert story.outcome.status == "complete", story.outcome.reason
    assert story.outcome.safe and abs(story.final_output) < 1.0
    log = read_log(story.log)
    stage, force, laser = (log.columns(f"/{name}/sample") for name in ("stage", "force", "displacement"))
    # Nothing wrong: each in its own physical bounds, the laser where the stage is, times rising.
    assert np.nanmax(np.abs(force["force_N"])) < 0.2
    held = np.isfinite(laser["displacement_m"]) & (laser["displacement_m"] > 1e-3)
    contact = next(m.fields["value"] for m in log.messages("/reference") if m.fields["name"] == "contact_position")
    expected = np.interp(laser["t_s"], stage["t_s"], stage["position_m"]) - contact
    assert np.max(np.abs((laser["displacement_m"] - expected)[held])) < 0.15e-3
    assert (np.diff(force["t_s"]) > 0).all()
    # Lost samples are gaps, not squeezed: on the way up, force by force is where the film has it at that time.
    up = (expected > 1e-3) & (np.gradient(expected) > 0)
    rise = slice(np.flatnonzero(up)[0], np.flatnonzero(up)[-1])
    t0, t1 = laser["t_s"][rise][[0, -1]]
    inside = (force["t_s"] > t0) & (force["t_s"] < t1)
    h = np.interp(force["t_s"][inside], laser["t_s"], laser["displacement_m"])
    model = solve_many(story.bench.world.specimen, h, 1000.0).force
    assert abs(np.mean(force["force_N"][inside] - model)) < 1.5e-3


@pytest.mark.slow
@pytest.mark.parametrize(("role", "kind", "more"), SAFE, ids=names)
def test_ends_safe(tell: Tell, role: str, kind: str, more: dict[str, Any]) -> None:
    story = tell(begin(role, kind, more))
    assert story.outcome.status in ("fault", "limit"), story.outcome
    assert abs(story.final_output) < 60 and story.outcome.safe
    assert story.off_after < 2.5
    assert read_log(story.log).outcome["status"] == story.outcome.status  # type: ignore[index]
