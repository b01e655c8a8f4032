"""Every fault switch of every simulated instrument during a whole run with high voltage: tolerated, or ended safe.

The switches come from the instruments themselves (`InstrumentTruth.faults`). *Tolerated*: the run completes, nothing
recorded is wrong, and the driver has counted what it met. *Off*: the run ends as a fault or limit and the supply's own
output has been measured off. *Not safe*: it ends so too, and says that nothing proves the output off. *Either*: the
protocol cannot show the damage, a wrong value may end the run or not, and the output has been measured off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from model.membrane.solve import solve_many
from rig.engine.outcome import NOT_SAFE_STATUS
from rig.log.reader import read_log
from rig.sim.truth import Fault
from rig.sim.twins import registered

pytestmark = pytest.mark.slow

Tell = Callable[..., Any]  # of conftest.Story
RAMP_DOWN_S = 1000 / 500 + 1.0  # from 1000 V at the 500 V/s of a quick story, and a second for polling
AT_ONCE_S = 1.5
MONITORS_FIRST = sorted(registered().twins.values(), key=lambda one: one.role != "monitor")
ROLE_OF = {one.driver: one.role for one in MONITORS_FIRST}  # of a driver with several roles the last
LABJACK = ("labjack-amplifier", "labjack-force", "labjack-displacement")
SCENE_OF = {  # the others are in cone-4mm
    "cia404": "other-instruments",
    "ascii-stream": "streams",
    "optoncdt-1420": "streams",
    "shvps": "other-instruments",
    **dict.fromkeys(LABJACK, "analogue-amplifier"),
}

# What is tolerated: a little of everything that happens on a long wire, one after the other in one run; and counters of
# which at least one of each group shows it.
LITTLE: dict[str, dict[str, dict[str, float]]] = {
    "zaber": {
        "delay": {"value": 0.02},
        "split": {},
        "duplicate": {},
        "drop": {"probability": 0.05},
        "merge": {"probability": 0.05},
        "alert": {"value": 0.02},
    },
    "gsv8": {"delay": {"value": 0.02}, "split": {}, "merge": {}, "drop": {"probability": 0.05}},
    "optoncdt-1420": {"delay": {"value": 0.02}, "split": {}, "merge": {}, "drop": {"probability": 0.05}},
    "ascii-stream": {
        "delay": {"value": 0.02},
        "split": {},
        "merge": {"probability": 0.05},
        "duplicate": {"probability": 0.05},
        "drop": {"probability": 0.05},
    },
    "cia404": {"delay": {"value": 0.02}, "drop": {"probability": 0.05}, "alert": {"value": 0.3}},
    "keyence-lkg": {
        "delay": {"value": 0.02},
        "split": {},
        "duplicate": {},
        "drop": {"probability": 0.02},
        "merge": {"probability": 0.02},
        "alert": {"value": 0.02},
    },
    "iseg-edcp": {
        "delay": {"value": 0.02},
        "duplicate": {},
        "drop": {"probability": 0.05},
        "alert": {"value": 0.0, "probability": 0.3},
    },
    "shvps": {
        "delay": {"value": 0.01},
        "split": {"value": 0.01},
        "duplicate": {},
        # Of 2 % two come in a row by chance, and that is silence: its three questions a sample have one time-out each.
        "drop": {"probability": 0.01},
        "merge": {"probability": 0.01},
    },
    **{
        driver: {
            "delay": {"value": 0.01},
            "split": {"value": 0.01},
            "merge": {"probability": 0.01},
            "alert": {"value": 0.0, "probability": 0.3},
        }
        for driver in LABJACK
    },
}
COUNTED = {
    "zaber": ("retries", "unexpected_replies", "alerts"),
    "gsv8": ("lost_samples", "gaps"),
    "optoncdt-1420": ("lost_samples", "gaps"),
    "ascii-stream": (),  # its lines have no number
    "cia404": ("lost_samples", "gaps", "emergencies"),
    "keyence-lkg": ("retries", "unexpected_replies", "pushed"),
    "iseg-edcp": ("retries", "unexpected_frames", "log_ons"),
    "shvps": ("retries", "unexpected_replies"),
    **dict.fromkeys(LABJACK, ("retries", "unexpected_replies")),
}

OFF, NOT_SAFE, EITHER = "off", "not safe", "either"
ENDS: dict[tuple[str, str], str] = {
    **dict.fromkeys(
        [("zaber", kind) for kind in ("drop", "corrupt", "silent", "vanish", "reset", "freeze", "wrong_status")], OFF
    ),
    **dict.fromkeys(
        [
            (cell, kind)
            for cell in ("gsv8", "cia404")
            for kind in ("drop", "duplicate", "silent", "vanish", "reset", "saturate", "freeze", "wrong_status")
        ],
        OFF,
    ),
    **dict.fromkeys(
        [("ascii-stream", kind) for kind in ("silent", "vanish", "reset", "saturate", "freeze", "wrong_status")],
        OFF,
    ),
    **dict.fromkeys(
        [
            ("optoncdt-1420", kind)
            for kind in ("duplicate", "silent", "vanish", "reset", "saturate", "freeze", "wrong_status", "no_value")
        ],
        OFF,
    ),
    **dict.fromkeys(
        [
            ("keyence-lkg", kind)
            for kind in ("drop", "silent", "vanish", "reset", "saturate", "freeze", "wrong_status", "no_value")
        ],
        OFF,
    ),
    **dict.fromkeys(
        [("iseg-edcp", kind) for kind in ("reset", "breakdown", "over_current", "sag", "interlock", "inhibit")],
        OFF,
    ),
    **dict.fromkeys([("shvps", kind) for kind in ("reset", "wrong_status", "breakdown", "over_current", "sag")], OFF),
    **dict.fromkeys(
        [
            (sensor, kind)
            for sensor in ("labjack-force", "labjack-displacement")
            for kind in ("silent", "vanish", "reset", "saturate", "freeze", "wrong_status")
        ],
        OFF,
    ),
    **dict.fromkeys([("labjack-amplifier", kind) for kind in ("reset", "breakdown", "over_current", "sag")], OFF),
    **dict.fromkeys(
        [
            ("labjack-amplifier", kind)
            for kind in ("silent", "vanish", "stuck_on", "freeze", "saturate", "wrong_status")
        ],
        NOT_SAFE,
    ),
    # Nothing proves the output off of a supply that cannot be heard, does not obey, or shows the same for ever ...
    ("iseg-edcp", "wrong_status"): NOT_SAFE,  # ... or says that its channel is on and ramps
    **dict.fromkeys(
        [(supply, kind) for supply in ("iseg-edcp", "shvps") for kind in ("silent", "vanish", "stuck_on", "freeze")],
        NOT_SAFE,
    ),
    # No checksum, or none that the switch leaves wrong: one message in twenty has a bit turned over.
    **dict.fromkeys(
        [
            (driver, "corrupt")
            for driver in ("gsv8", "cia404", "ascii-stream", "optoncdt-1420", "keyence-lkg", "iseg-edcp", "shvps")
        ],
        EITHER,
    ),
}
SEEN_DAMAGE = {
    "gsv8": ("bad_frames", "dropped_bytes", "bad_values"),
    "cia404": ("bad_values", "overloads", "ignored_frames", "bad_frames"),
    "keyence-lkg": ("bad_grammar", "retries"),
    "ascii-stream": ("bad_grammar", "bad_values"),
    "optoncdt-1420": ("dropped_bytes", "bad_values", "error_words"),
    "iseg-edcp": ("bad_frames", "bad_values", "unexpected_frames", "retries"),
    "shvps": ("bad_grammar", "retries", "doubted", "implausible"),
}


def counted(story: Any, role: str) -> dict[str, int]:
    """The driver's counters as the log has them at the end of the run."""
    rows = [m.fields for m in read_log(story.log).messages("/counter")]
    return {row["name"]: row["count"] for row in rows if row["device"] == role}


@pytest.mark.parametrize("driver", LITTLE)
def test_a_little_of_everything_is_tolerated(tell: Tell, driver: str) -> None:
    role = ROLE_OF[driver]

    def mischief(bench: Any, stop: Any) -> None:
        # From the ramp up to the return: some seconds in all.
        for number, (kind, more) in enumerate(LITTLE[driver].items()):
            keys = {"role": role, "kind": kind, "at_s": bench.now + 0.8 * number, "duration_s": 0.8, **more}
            bench.inject(Fault.model_validate(keys))

    story = tell(mischief, scene=SCENE_OF.get(driver, "cone-4mm"))
    assert story.outcome.status == "complete", story.outcome.reason
    assert story.outcome.safe and abs(story.final_output) < 1.0
    counters = counted(story, role)
    assert all(counters.get(key, 0) > 0 for key in COUNTED[driver]), counters
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
    inside = (force["t_s"] > t0) & (force["t_s"] < t1) & np.isfinite(force["force_N"])
    h = np.interp(force["t_s"][inside], laser["t_s"], laser["displacement_m"])
    model = solve_many(story.bench.world.specimen, h, 1000.0).force
    assert abs(np.mean(force["force_N"][inside] - model)) < 1.5e-3


@pytest.mark.parametrize(("driver", "kind"), ENDS)
def test_the_run_ends_as_required(tell: Tell, driver: str, kind: str) -> None:
    role, end = ROLE_OF[driver], ENDS[driver, kind]
    more = {"probability": 0.05} if end == EITHER else {}
    story = tell(
        lambda bench, stop: bench.inject(Fault.model_validate({"role": role, "kind": kind, **more})),
        scene=SCENE_OF.get(driver, "cone-4mm"),
    )
    if end == EITHER:
        assert story.outcome.status in ("complete", "fault", "limit"), story.outcome
        counters = counted(story, role)
        assert any(counters.get(key, 0) for key in SEEN_DAMAGE[driver]) or story.took < 1.0, counters
    else:
        assert story.outcome.status in ((NOT_SAFE_STATUS,) if end == NOT_SAFE else ("fault", "limit")), story.outcome
    assert story.outcome.safe is (end != NOT_SAFE), story.outcome
    assert read_log(story.log).outcome["status"] == story.outcome.status  # type: ignore[index]
    # What really became of the output: only one that does not obey, or hears nothing, is still there.
    unheard = (role, kind) == ("hv", "vanish") and driver != "labjack-amplifier"  # whose own watchdog has acted
    assert (abs(story.final_output) < 60) is (kind != "stuck_on" and not unheard)
    if end == NOT_SAFE:
        events = [message.fields["message"] for message in read_log(story.log).messages("/event")]
        assert any(text.startswith("NOT SAFE") for text in events)
    if end == OFF:  # a sensor that has no fresh data: nothing burns, the voltage ramps down
        assert story.off_after < (AT_ONCE_S if kind == "vanish" else 0.5 + RAMP_DOWN_S)
    if role == "force" and kind in ("vanish", "silent", "reset", "saturate", "freeze", "wrong_status"):
        # A device that refuses its reads, or whose connection ends, is lost: as one that has vanished.
        at_once = kind == "vanish" or (driver == "labjack-force" and kind in ("wrong_status", "reset"))
        assert story.control_words[-1] == ("emergency_off" if at_once else "switch_off")
    if kind in ("vanish", "silent"):
        assert role in story.outcome.reason
        assert story.outcome.standing is (role != "stage")


def test_every_switch_of_every_instrument_has_its_required_behaviour() -> None:
    """Those of monitors, and a supply that lies, which only a monitor finds out, are in `test_second_reading`."""
    twins = [one for one in registered().twins.values() if one.role != "monitor"]
    switches = {(one.driver, kind) for one in twins for kind in one.truth.faults() if kind != "lies"}
    tolerated = {(driver, kind) for driver, kinds in LITTLE.items() for kind in kinds}
    assert switches == tolerated | set(ENDS)
