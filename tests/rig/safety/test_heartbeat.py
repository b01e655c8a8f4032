"""The guard lives by the engine's heartbeats: deadline, counter, checksum, age of the data, film as measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.roles import HVFlag, HVSample
from rig.base.errors import FaultError, LimitError, StaleData
from rig.safety.guard import Guard, GuardState
from rig.safety.heartbeat import DEADLINE_S, INTERVAL_S, Heartbeat
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import load_scene

SCENE, _ = load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")
FRESH = {"stage": 0.5, "force": 0.2}


class Supply:
    """Writes down what it is told."""

    measures_current = True
    busy = False

    def __init__(self) -> None:
        self.words: list[str] = []

    def renew(self) -> None:
        """Keeps a hardware watchdog from running out; changes no output."""

    def __getattr__(self, word: str) -> Callable[..., None]:
        if word == "renew":  # it has no watchdog of its own
            raise AttributeError(word)
        return lambda *arguments: self.words.append(word)


class Rig:
    """A live guard at 1000 V, its supply, and an engine that beats."""

    def __init__(self) -> None:
        self.supply = Supply()
        limits = Limits.of(SCENE)
        film = FilmLimits(SCENE.specimen.specimen(), limits)
        self.guard = Guard(self.supply, limits, film, 300.0, lambda word, argument: None, FRESH)  # type: ignore[arg-type]
        self.now, self.beats = 100.0, 0
        for _ in range(2):
            self.guard.on_sample(HVSample(self.now, 0.0, 0.0, 0.0, HVFlag(0)))
        self.beat()
        self.guard.arm()
        self.guard.request(1000.0, 0.0)
        self.guard.on_sample(HVSample(self.now, 1000.0, 0.0, 1000.0, HVFlag.ON))
        assert self.guard.state is GuardState.LIVE

    def make(self, h: float = 0.0, **samples: float) -> bytes:
        times = {"stage": self.now, "force": self.now} | samples
        return Heartbeat(self.beats + 1, self.now, h, times).encode()

    def beat(self, h: float = 0.0, **samples: float) -> None:
        self.guard.heartbeat(self.make(h, **samples), self.now)
        self.beats += 1

    def go_on(self, seconds: float, *, beating: bool, h: float = 0.0) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now += INTERVAL_S / 2
            if beating:
                self.beat(h)
            self.guard.turn(self.now)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_beating_engine_is_left_alone(rig: Rig) -> None:
    before = list(rig.supply.words)
    rig.go_on(2.0, beating=True)
    assert rig.guard.state is GuardState.LIVE and rig.supply.words == before
    assert rig.guard.longest_silence == pytest.approx(INTERVAL_S / 2)


def test_a_silent_engine_is_left_no_voltage_after_the_deadline_and_not_before(rig: Rig) -> None:
    rig.go_on(1.0, beating=True)
    last = rig.now
    rig.go_on(DEADLINE_S - INTERVAL_S, beating=False)
    assert "emergency_off" not in rig.supply.words
    with pytest.raises(FaultError, match="silent"):
        rig.go_on(1.0, beating=False)
    assert rig.supply.words[-1] == "emergency_off"
    assert rig.guard.state is GuardState.SAFE
    assert rig.now - last < 0.2 - 0.03  # leaves time for the way to the supply
    rig.beat()  # it is back
    with pytest.raises(FaultError, match="latched safe"):
        rig.guard.request(500.0, 0.0)
    assert rig.supply.words[-1] == "emergency_off"


def test_an_engine_that_never_beats_again_after_arming_is_noticed() -> None:
    rig = Rig()
    with pytest.raises(FaultError, match="silent"):
        rig.go_on(1.0, beating=False)
    assert rig.supply.words[-1] == "emergency_off"


def test_a_guard_that_was_held_up_itself_does_not_blame_the_engine(rig: Rig) -> None:
    """Its process reads all that has arrived before it judges; the beats that waited count."""
    rig.now += 1.0
    rig.beat()
    rig.guard.turn(rig.now)
    assert rig.guard.state is GuardState.LIVE


def test_an_engine_that_waits_for_the_guards_answer_is_excused_for_so_long_and_no_longer(rig: Rig) -> None:
    rig.go_on(0.1, beating=True)
    rig.now += 0.19
    rig.guard.excuse(0.1)
    rig.guard.turn(rig.now)
    assert rig.guard.state is GuardState.LIVE
    with pytest.raises(FaultError):
        rig.go_on(DEADLINE_S, beating=False)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda rig: bytes([rig.make()[0] ^ 1]) + rig.make()[1:],
        lambda rig: rig.make()[:-1] + bytes([rig.make()[-1] ^ 0x80]),
        lambda rig: rig.make()[:-1],
        lambda rig: b"",
        lambda rig: Heartbeat(rig.beats, rig.now).encode(),  # a repeater
        lambda rig: Heartbeat(rig.beats + 2, rig.now).encode(),  # one is missing
        lambda rig: Heartbeat(0, rig.now).encode(),
    ],
)
def test_a_heartbeat_that_cannot_be_believed_takes_the_output_off_at_once(
    rig: Rig, spoil: Callable[[Rig], bytes]
) -> None:
    with pytest.raises(FaultError, match="cannot be believed"):
        rig.guard.heartbeat(spoil(rig), rig.now)
    assert rig.supply.words[-1] == "emergency_off" and rig.guard.state is GuardState.SAFE


def test_every_single_bit_of_a_heartbeat_counts() -> None:
    good = Heartbeat(7, 1.5, 0.003, {"stage": 1.4, "force": 1.45}).encode()
    assert Heartbeat.decode(good).counter == 7
    for i in range(8 * len(good)):
        bad = bytearray(good)
        bad[i // 8] ^= 1 << i % 8
        with pytest.raises(ValueError):
            Heartbeat.decode(bytes(bad))


@pytest.mark.parametrize("role", ["stage", "force"])
@pytest.mark.parametrize("newest", [0.0, math.nan])
def test_a_loop_that_beats_on_old_data_is_ramped_down(rig: Rig, role: str, newest: float) -> None:
    rig.beat(**{role: newest})
    with pytest.raises(StaleData, match=f"newest good sample of {role}"):
        rig.guard.turn(rig.now)
    assert rig.supply.words[-1] == "switch_off" and rig.guard.state is GuardState.SAFE


def test_a_disk_that_moves_where_the_field_is_too_high_takes_the_output_off(rig: Rig) -> None:
    """The pair (displacement, voltage) as measured, whatever the engine believes to have asked for."""
    rig.guard.request(1500.0, 0.0)
    rig.guard.on_sample(HVSample(rig.now, 1000.0, 0.0, 1500.0, HVFlag.ON | HVFlag.RAMPING))
    rig.go_on(0.2, beating=True, h=0.011)
    with pytest.raises(LimitError, match="field"):
        rig.go_on(0.2, beating=True, h=0.0125)  # judged by the set-point, before the voltage is there
    assert rig.supply.words[-1] == "emergency_off"


def test_a_move_is_asked_for_and_a_voltage_is_held_against_where_it_leads(rig: Rig) -> None:
    rig.guard.request(1500.0, 0.0)
    rig.guard.check_move(0.0, 0.011)
    with pytest.raises(LimitError, match="field"):
        rig.guard.check_move(0.0, 0.0125)
    with pytest.raises(LimitError, match="not a number"):
        rig.guard.check_move(math.nan, 0.0)
    before = list(rig.supply.words)
    with pytest.raises(LimitError, match="field"):
        rig.guard.request(1750.0, 0.0)  # the flat film bears it, but the disk is on its way to 11 mm
    assert rig.supply.words == before


def test_nothing_is_required_of_an_engine_whose_supply_was_never_commanded() -> None:
    supply = Supply()
    limits = Limits.of(SCENE)
    film = FilmLimits(SCENE.specimen.specimen(), limits)
    guard = Guard(supply, limits, film, 300.0, lambda word, argument: None, FRESH)  # type: ignore[arg-type]
    for now in (0.0, 10.0, 20.0):
        guard.turn(now)
    with pytest.raises(FaultError):
        guard.heartbeat(b"nonsense", 30.0)
    assert supply.words == []
