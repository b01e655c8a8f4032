"""Whatever is done to the guard in whatever order, the simulated supply's own output keeps to the rules.

The guard, the driver and the supply are the real ones, joined by CAN frames in virtual time; a small loop stands for
the engine: it polls, gives signs of life, and ends the run on the first error, as the engine does.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.link import DeviceError
from model.membrane.solve import Solution, solve
from rig.base.clock import VirtualClock
from rig.base.errors import FaultError, LimitError
from rig.bench.memory_link import MemoryFrameLink
from rig.safety import limits
from rig.safety.arming import Arming
from rig.safety.guard import SAFE_VOLTAGE, Guard, GuardState
from rig.safety.heartbeat import DEADLINE_S, Heartbeat
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.film import FilmTable
from rig.sim.truth import Fault
from rig.sim.wire import FrameWire

SCENE, _ = load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")
SPECIMEN = SCENE.specimen.specimen()
LIMITS = Limits.of(SCENE)
RAMP = 1200.0  # V/s, the fastest that the module takes
TICK_S = 0.05
FRESH_S = 0.3
FALL_S = 0.05  # of the simulated output, once it is cut
TOLD_S = 0.3  # emergency off on a bus that works, its confirmation included
HIGHEST = 1800.0
TABLES: list[FilmTable] = []


class Rig(RuleBasedStateMachine):
    """One supply with a film on it, a guard, and an engine that may hang, die and start again."""

    @initialize(begin=st.sampled_from(["off", "armed", "live", "live", "found live"]))
    def power_up(self, begin: str) -> None:
        simulation = SCENE.simulation
        assert simulation is not None
        truth = simulation.model_copy(
            update={
                "hv": simulation.hv.model_copy(update={"start_live_V": 500.0 if begin == "found live" else 0.0}),
                "fault": [],
            }
        )
        self.bench = SimulatedBench(truth, SPECIMEN, {"hv"})
        if TABLES:
            self.bench.world._table = TABLES[0]  # the same film each time: tabulated once
        else:
            TABLES.append(self.bench.world.film)
        self.clock = VirtualClock(self.bench.advance)
        self.h = 0.0
        self.bad_until = 0.0  # until when the wire or the supply may not do what it is told
        self.start()
        if begin in ("armed", "live"):
            self.confirm()
            self.arm()
            assert self.guard.state is GuardState.ARMED
        if begin == "live":
            self.voltage(1000.0)
            self.tick(20)
            assert self.output == pytest.approx(1000.0, rel=1e-3)

    def start(self) -> None:
        """The program starts: a new driver, a new guard; nothing but questions goes out."""
        wire = self.bench.wire("hv")
        assert isinstance(wire, FrameWire)
        self.supply = IsegEDCP("hv", MemoryFrameLink("hv", wire, self.clock))
        film = FilmLimits(SPECIMEN, LIMITS)
        self.told: list[str] = []
        self.armed_at = self.told_at = -math.inf
        self.guard = Guard(self.supply, LIMITS, film, RAMP, self.tell, {"force": FRESH_S})
        self.arming = Arming("a test")
        self.beats = 0
        self.beating = True
        self.fresh_at = self.clock.now()
        self.fresh = True
        self.last_beat = self.clock.now()
        self.ended = False  # by a fault: the engine only makes safe from then on
        self.safe_since: float | None = None
        self.untouched = (self.bench.world.output.changes, self.output)
        self.tick(12)

    def tell(self, command: str, argument: str) -> None:
        """Commands are told before they are given: the output has not been told yet."""
        if command == "arm":
            assert self.output < SAFE_VOLTAGE, "armed while the output was live"
            assert self.arming.allows(1.0), "armed without both keys"
        if command in ("set_voltage", "switch_on"):
            assert self.told and "arm" in self.told, "a voltage without arming"
            since = self.told[len(self.told) - self.told[::-1].index("arm") :]
            assert not {"switch_off", "emergency_off"} & set(since), "a voltage after the latch, without arming anew"
        self.told.append(command)
        self.told_at = self.clock.now()
        self.armed_at = self.told_at if command == "arm" else self.armed_at

    @property
    def output(self) -> float:
        return float(self.bench.world.output.at(self.clock.now())[0])

    def one_tick(self) -> None:
        end = self.clock.now() + TICK_S
        try:
            while (now := self.clock.now()) < end:
                self.clock.sleep_until(min(max(self.supply.next_poll, now + 0.003), end))
                for sample in self.supply.poll(self.clock.now()):
                    self.guard.on_sample(sample)
            if self.beating and not self.ended:
                self.beats += 1
                self.fresh_at = now if self.fresh else self.fresh_at
                beat = Heartbeat(self.beats, now, self.h, {"force": self.fresh_at})
                self.last_beat = now
                self.guard.heartbeat(beat.encode(), now)
            self.turn_of_the_guard(now)
        except (FaultError, LimitError, DeviceError) as error:
            self.clock.sleep_until(end)
            self.fault(error)
        if self.guard.state is not GuardState.SAFE:
            self.safe_since = None
        elif self.safe_since is None:
            self.safe_since = end

    def turn_of_the_guard(self, now: float) -> None:
        """What the guard does by itself; an engine that hangs does not hear of it and adds nothing."""
        try:
            self.guard.turn(now)
        except (FaultError, LimitError):
            self.arming.withdraw()
            self.ended = True
            if self.beating:
                raise

    def fault(self, error: Exception) -> None:
        """As the teardown does: off at once, and again while the supply does not answer."""
        self.ended = True
        self.arming.withdraw()
        with suppress(DeviceError):
            self.guard.kill(str(error))

    # What may be done -------------------------------------------------------------------------------------------------

    @rule(n=st.integers(1, 8))
    def tick(self, n: int) -> None:
        for _ in range(n):
            self.one_tick()

    @rule()
    def confirm(self) -> None:
        """The operator's second act."""
        if not self.ended:
            self.arming.confirm(HIGHEST, "a test")

    @rule()
    def arm(self) -> None:
        if self.ended or not (self.beating and self.fresh) or self.guard.state is not GuardState.SAFE:
            return  # an engine that hangs, or has no data, asks for nothing
        before = self.bench.world.output.changes
        try:
            self.arming.check(1.0)
            self.guard.arm()
        except (FaultError, DeviceError):
            assert self.guard.state is GuardState.SAFE and self.bench.world.output.changes == before
        else:
            self.safe_since = None

    @rule(volts=st.sampled_from([0.0, 300.0, 1000.0, 1500.0, 1800.0, 1801.0, -1.0, math.nan, math.inf]))
    def voltage(self, volts: float) -> None:
        if self.ended or not self.beating:
            return
        state, setpoint = self.guard.state, self.guard.setpoint
        try:
            self.guard.request(volts, self.h)
        except LimitError:
            assert self.guard.setpoint == setpoint and self.guard.state is state
        except FaultError:
            assert state is GuardState.SAFE
        else:
            assert state is not GuardState.SAFE and 0.0 <= volts <= HIGHEST

    @rule(h_mm=st.sampled_from([0.0, 4.0, 8.0, 11.0, 12.0, 12.5, 13.0, 14.0]))
    def move(self, h_mm: float) -> None:
        if self.ended or not self.beating:
            return
        try:
            self.guard.check_move(self.h, h_mm * 1e-3)
        except LimitError:
            return
        self.h = h_mm * 1e-3

    @rule(
        kind=st.sampled_from(["over_current", "breakdown", "sag", "interlock", "inhibit", "freeze", "reset"]),
        seconds=st.sampled_from([0.1, 0.5]),
    )
    def supply_fault(self, kind: str, seconds: float) -> None:
        duration = {} if kind == "reset" else {"duration_s": seconds}
        self.bench.inject(Fault.model_validate({"role": "hv", "kind": kind, "at_s": self.clock.now()} | duration))
        if kind == "freeze":
            self.bad_until = max(self.bad_until, self.clock.now() + seconds)
        if kind == "reset":
            self.bad_until = max(self.bad_until, self.clock.now() + 12.0)

    @rule(
        kind=st.sampled_from(["vanish", "silent", "drop", "corrupt", "delay", "duplicate"]),
        seconds=st.sampled_from([0.1, 0.5]),
        both=st.booleans(),
    )
    def wire_fault(self, kind: str, seconds: float, both: bool) -> None:
        more: dict[str, Any] = {"duration_s": seconds, "direction": "both" if both else "from_device"}
        if kind == "delay":
            more["value"] = 0.2
        if kind in ("drop", "corrupt"):
            more["probability"] = 0.5
        self.bench.inject(Fault.model_validate({"role": "hv", "kind": kind, "at_s": self.clock.now()} | more))
        # A driver asks again after its time-outs, and gives up after the third; then the loop tells it again.
        self.bad_until = max(self.bad_until, self.clock.now() + seconds + 1.5)

    @rule(n=st.sampled_from([0, 4, 14]))
    def hang(self, n: int) -> None:
        self.beating = not self.beating
        self.tick(n)

    @rule(n=st.sampled_from([0, 4, 14]))
    def lose_a_sensor(self, n: int) -> None:
        self.fresh = not self.fresh
        self.tick(n)

    @rule(how=st.sampled_from(["damaged", "repeated", "skipped"]))
    def bad_heartbeat(self, how: str) -> None:
        if self.ended or self.beats == 0:
            return
        self.beats += {"damaged": 1, "repeated": 0, "skipped": 2}[how]
        data = Heartbeat(self.beats, self.clock.now(), self.h, {"force": self.fresh_at}).encode()
        data = data[:-1] + bytes([data[-1] ^ 1]) if how == "damaged" else data
        with pytest.raises(FaultError, match="cannot be believed"):
            self.guard.heartbeat(data, self.clock.now())
        assert self.guard.state is GuardState.SAFE
        self.fault(FaultError("a heartbeat that cannot be believed"))

    @rule(at_once=st.booleans())
    def stop(self, at_once: bool) -> None:
        (self.guard.kill if at_once else self.guard.ramp_off)("a test")
        self.arming.withdraw()

    @precondition(lambda self: self.guard.state is GuardState.SAFE)
    @rule()
    def restart(self) -> None:
        """The program ends, having made safe, or never having touched the supply; and is started again."""
        self.start()

    @rule()
    def operator_chooses(self) -> None:
        """An output found live is taken down; what is latched is cleared."""
        if self.ended or self.guard.state is not GuardState.SAFE:
            return
        try:
            if self.output >= SAFE_VOLTAGE:
                self.guard.take_down("a test")
            else:
                self.guard.clear_faults("a test")
        except (FaultError, DeviceError):
            pass

    # What must hold ---------------------------------------------------------------------------------------------------

    @invariant()
    def the_film_is_within_its_limits(self) -> None:
        volts = self.output
        assert volts <= LIMITS.voltage.high * 1.001
        if volts > 1.0:
            state = film_at(
                self.h, float(math.floor(volts * 0.999))
            )  # the supply's own gain is off by half a part in a thousand
            assert LIMITS.field.holds(state.peak_field) and LIMITS.hoop_stress.holds(state.min_hoop_stress)

    @invariant()
    def a_supply_that_was_never_commanded_is_left_alone(self) -> None:
        if not self.told and self.clock.now() > self.bad_until:
            return  # a fault of its own may have changed it; what we did is in `told`
        if not self.told:
            assert not self.guard.commanded

    @invariant()
    def a_latched_output_goes_down_and_stays_down(self) -> None:
        now = self.clock.now()
        if self.safe_since is None or not self.guard.commanded or now <= self.bad_until:
            return
        latched = now - max(self.safe_since, self.told_at, self.bad_until)
        if latched > HIGHEST / RAMP + 1.0:
            assert self.output < SAFE_VOLTAGE, f"latched for {latched:.2f} s ({self.guard.cause})"
        if self.told[-1] == "emergency_off" and latched > TOLD_S + FALL_S:
            assert self.output < SAFE_VOLTAGE, f"cut {latched:.2f} s ago ({self.guard.cause})"

    @invariant()
    def without_signs_of_life_the_output_is_off(self) -> None:
        now = self.clock.now()
        silent = now - max(self.last_beat, self.bad_until, self.armed_at)
        if self.guard.commanded and not self.beating and silent > DEADLINE_S + 2 * TICK_S + TOLD_S + FALL_S:
            # Only what was being ramped down in good order before may take its time, and what was cut this moment.
            ramp = self.told[-1] == "switch_off" and self.told_at <= self.last_beat + DEADLINE_S
            cut = self.told[-1] == "emergency_off" and now - self.told_at <= TOLD_S + FALL_S
            assert self.guard.state is GuardState.SAFE
            assert self.output < SAFE_VOLTAGE or ramp or cut or self.told[-1] == "take_down"

    @invariant()
    def without_fresh_data_the_guard_is_safe(self) -> None:
        now = self.clock.now()
        if now - self.fresh_at > FRESH_S + 2 * TICK_S and now - self.armed_at > 2 * TICK_S + DEADLINE_S and self.beats:
            assert self.guard.state is GuardState.SAFE


@cache
def film_at(h: float, volts: float) -> Solution:
    return solve(SPECIMEN, h, volts)


@pytest.fixture
def quick_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """The film at whole volts, from above, remembered: the model has tests of its own."""
    known: dict[int, float] = {}
    worked_out = Solution.capacitance

    def capacitance_of(state: Solution) -> float:
        if id(state) not in known:  # `film_at` keeps the states alive
            known[id(state)] = worked_out(state)
        return known[id(state)]

    monkeypatch.setattr(limits, "solve", lambda specimen, h, volts: film_at(h, float(math.ceil(volts))))
    monkeypatch.setattr(Solution, "capacitance", capacitance_of)


@pytest.mark.usefixtures("quick_film")
@pytest.mark.parametrize("examples", [40, pytest.param(2000, marks=pytest.mark.long)])
def test_no_order_of_events_breaks_the_rules(examples: int) -> None:
    how = settings(
        max_examples=examples,
        stateful_step_count=10,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(Rig, settings=how)
