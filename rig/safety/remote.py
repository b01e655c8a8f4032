"""The guard's process as the engine sees it: both the supply that it polls and the `Guard` that it asks.

Calls are answered within milliseconds and wait for the answer, so that what the guard refuses is refused here too.
When the guard's process is lost (dead, silent or talking nonsense), nobody holds the link any more: the engine then
opens it itself, takes the output off, and goes on to measure it.
"""

from __future__ import annotations

import math
import select
import signal
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import get_context
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from drivers.links.link import DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import HVFlag, HVSample, HVSupply, Identity, Sample
from drivers.settings import CanSettings
from rig.base.clock import RealClock
from rig.base.errors import FaultError, LimitError, RigError, StaleData
from rig.bench.devices import ROLE, Link, make_supply
from rig.bench.tap import Tap
from rig.log.recorder import Severity
from rig.safety import process
from rig.safety.channel import Channel, ChannelDamaged, Message
from rig.safety.guard import Guard, GuardState
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import Scene

START_S = 30.0  # until the process must have opened the link; a slow disk has many modules to read
ANSWER_S = 1.0  # a guard that takes longer to answer is lost
SILENCE_S = 1.0  # ... and one that says nothing for this long: it sends its state twenty times a second
OPEN_AGAIN_S = 0.1
LEAVE_S = 5.0  # a guard that was told to go, and has nothing to take off, must have gone by then

_ERRORS = {kind.__name__: kind for kind in (LimitError, FaultError, StaleData)}
_DEVICE_ERRORS = {kind.__name__: kind for kind in (DeviceLost, DeviceSilent, DeviceRefused)}


class RemoteGuard:
    """Starts the guard's process; ``opened`` waits until it has the link.

    A device of the bench (`drivers.roles.Device`) and a guard (`rig.safety.guard.Guard`): each name means what it means
    there.
    """

    def __init__(self, scene: Scene, clock: RealClock) -> None:
        assert scene.hv is not None
        self.name = ROLE
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {}
        self.link_settings: dict[str, str] = {}
        self.ready = False
        self.next_poll = -math.inf
        self.state = GuardState.SAFE
        self.cause = "not armed"
        self.commanded = False
        self.setpoint = 0.0
        self.output_is_safe = False
        self.ramp_duration = 0.0
        self.last: HVSample | None = None
        self._scene = scene
        self._table = scene.hv
        self._clock = clock
        self._tap: Tap = lambda role, way, data, t: None
        self._tell: Callable[[str, str, float], None] = lambda command, argument, t: None
        self._event: Callable[[Severity, str], None] = lambda severity, message: None
        self._samples: list[Sample] = []
        self._errors: deque[Exception] = deque()
        self._answers: dict[int, Message | None] = {}
        self._calls = 0
        self._is_open = False
        self._heard_at = clock.now()
        self._lost = ""  # why the process is lost
        self._successor: tuple[HVSupply, Guard] | None = None
        self._next_open = -math.inf
        self._link: Link | None = None
        if isinstance(self._table, CanSettings):
            import can  # noqa: F401  # so that it need not be read from disk when the guard has been lost
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        self._channel = Channel(ours)
        # Before multiprocessing waits for its children at exit: a guard ends when its engine has gone.
        self._at_exit = Finalize(self, self._channel.close, exitpriority=100)
        self._process = get_context("spawn").Process(
            target=process.serve, args=(theirs, process.config(self._scene, self._clock)), name="dea-rig guard"
        )
        blocked = None
        if hasattr(signal, "pthread_sigmask"):  # until it ignores them, signals from the terminal must not reach it
            numbers = [getattr(signal, name) for name in process.IGNORED]
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        try:
            self._process.start()
        finally:
            if blocked is not None:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            theirs.close()

    @property
    def pid(self) -> int:
        """Number of the guard's process."""
        assert self._process.pid is not None
        return self._process.pid

    def opened(self) -> None:
        """Wait until the process has opened the link; nothing has been sent to the supply by then.

        Raises
        ------
        DeviceError, FaultError
            The link cannot be opened, or the process does not come up.
        """
        end = self._clock.now() + START_S
        while not self._is_open:
            self._listen()
            if self._errors:
                raise self._errors.popleft()
            if self._lost or self._clock.now() > end:
                raise FaultError(f"hv: the guard's process did not start ({self._lost or 'it says nothing'}).")
            select.select([self._channel], [], [], 0.1)

    def attach(self, tap: Tap) -> None:
        """From now on bytes and frames are told to ``tap``."""
        self._tap = tap

    def log_to(self, path: Path, end: socket.socket) -> None:
        """Give the process its own end of the log at ``path``: what it does is recorded even if this process dies.

        POSIX only; before `appoint`. The end may be closed here afterwards.
        """
        self._channel.hand_over({"do": "log", "path": str(path)}, end.fileno())

    def appoint(
        self,
        gain: float,
        fresh: Mapping[str, float],
        tell: Callable[[str, str, float], None],
        event: Callable[[Severity, str], None],
    ) -> None:
        """Put the driver to work.

        Parameters
        ----------
        gain : float
            Volts per volt that the supply states, from its certificate.
        fresh
            As `Guard` takes it.
        tell : callable
            ``tell(command, argument, t)`` for each command, with the clock time at which it was given.
        event : callable
            ``event(severity, message)`` for what the guard has to say itself.
        """
        self._tell, self._event = tell, event
        self._channel.send({"do": "appoint", "gain": gain, "fresh": dict(fresh)})
        self._heard_at = self._clock.now()  # it has had nothing to say until now

    # As a device ---------------------------------------------------------------------------------------------

    def poll(self, now: float) -> Sequence[Sample]:
        """New samples, as the supply states them.

        Raises
        ------
        DeviceError, RigError
            What the guard met or decided since the last call; or that it is lost.
        """
        if self._lost:
            return self._poll_ourselves(now)
        self.next_poll = now + process.LONGEST_TURN_S
        self._listen()
        if not self._lost and now - self._heard_at > SILENCE_S:
            self._lose(f"it has said nothing for {now - self._heard_at:.1f} s")
        if self._lost:
            raise self._loss()
        if self._errors:
            raise self._errors.popleft()
        samples, self._samples = self._samples, []
        return samples

    def close(self) -> None:
        """Let the process end, and see that it does. Calling it twice does no harm."""
        if not self._channel.closed:
            self._channel.send({"do": "close"})
            # One that has commanded the output first sees that it is measured off, for as long as it may try.
            self._process.join(LEAVE_S + (process.TRY_S if self.commanded else 0.0))
            self._channel.close()
        self._process.join(LEAVE_S)
        if self._process.is_alive():  # it hangs; nothing may wait for it
            self._process.kill()
            self._process.join(LEAVE_S)
        if self._link is not None:
            self._link.close()
            self._link = None

    # As a guard ----------------------------------------------------------------------------------------------

    def arm(self) -> None:
        self.commanded = True  # should the answer never come
        self._call("arm")

    def check_supply(self, highest: float) -> None:
        self._call("check_supply", highest)

    def check_off(self) -> None:
        self._call("check_off")

    def take_down(self, cause: str) -> None:
        self.commanded = True
        self._call("take_down", cause)

    def clear_faults(self, cause: str) -> None:
        self._call("clear_faults", cause)

    def request(self, volts: float, h: float) -> None:
        self._call("request", volts, h)

    def check_move(self, h0: float, h1: float) -> None:
        self._call("check_move", h0, h1)

    def ramp_off(self, cause: str) -> None:
        self._call("ramp_off", cause)

    def kill(self, cause: str) -> None:
        self._call("kill", cause)

    def heartbeat(self, data: bytes, now: float) -> None:
        """Pass a sign of life on; what the guard thinks of it comes with the next `poll`."""
        self._channel.send({"do": "heartbeat", "data": data.hex()})

    def turn(self, now: float) -> None:
        """The guard turns by itself."""

    def on_sample(self, sample: HVSample) -> None:
        """The guard has judged it already."""
        self.last = sample
        if self._successor is not None:
            guard = self._successor[1]
            guard.on_sample(sample)
            self._mirror(guard)

    # The process ---------------------------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> None:
        if self._successor is not None:
            guard = self._successor[1]
            getattr(guard, name)(*arguments)
            self._mirror(guard)
            return
        if not self._lost:
            self._calls += 1
            number = self._calls
            self._channel.send({"do": "call", "n": number, "name": name, "args": list(arguments)})
            end = self._clock.now() + ANSWER_S
            while number not in self._answers and not self._lost:
                left = end - self._clock.now()
                if left <= 0:
                    self._lose(f"it did not answer within {ANSWER_S:g} s")
                    break
                if not self._channel.closed:
                    select.select([self._channel], [], [], left)
                self._listen()
            if number in self._answers:
                error = self._answers.pop(number)
                if error is not None:
                    raise unpack_error(error)
                return
        raise self._loss()

    def _listen(self) -> None:
        """Take in what the guard has sent."""
        try:
            messages = self._channel.receive()
        except ChannelDamaged as error:
            self._lose(f"it talks nonsense: {error}")
            return
        if messages:
            self._heard_at = self._clock.now()
        for message in messages:
            self._take(message)
        if self._channel.closed:
            self._lose("its process has died")

    def _take(self, message: Message) -> None:
        match message.get("is"):
            case "sample":
                t, voltage, current, setpoint, flags = message["values"]
                self._samples.append(HVSample(t, voltage, current, setpoint, HVFlag(flags)))
            case "state":
                self._take_state(message)
            case "wire":
                self._tap(ROLE, message["way"], bytes.fromhex(message["data"]), message["t"])
            case "command":
                self._tell(message["command"], message["argument"], message["t"])
            case "event":
                self._event(message["severity"], message["message"])
            case "answer":
                self._answers[message["n"]] = message["error"]
            case "error":
                self._errors.append(unpack_error(message["error"]))
            case "opened":
                self._is_open = True
                self.link_settings = message["settings"]

    def _take_state(self, message: Message) -> None:
        self.state = GuardState(message["state"])
        self.cause = message["cause"]
        self.commanded = message["commanded"]
        self.setpoint = message["setpoint"]
        self.output_is_safe = message["output_is_safe"]
        self.ramp_duration = message["ramp_duration"]
        self.ready = message["ready"]
        self.identity = Identity(*message["identity"])
        self.settings = message["settings"]
        self.counters = message["counters"]

    # When it is lost -----------------------------------------------------------------------------------------

    def _lose(self, why: str) -> None:
        """The process is lost. What is left of it must not hold the link, nor wake up again."""
        if self._lost:
            return
        self._lost = why
        self.state, self.cause, self.output_is_safe = GuardState.SAFE, f"the guard is lost: {why}", False
        self._channel.close()
        self._process.kill()
        self._process.join(LEAVE_S)
        self._take_over()

    def _loss(self) -> FaultError:
        done = "the output was never commanded"
        if self.commanded:
            done = "the output was commanded off" if self._successor else "the link cannot be opened"
        return FaultError(f"hv: the guard is lost ({self._lost}); from here {done}.")

    def _take_over(self) -> None:
        """Open the link ourselves and command the output off, if it was ever commanded on."""
        if not self._is_open:
            return
        self._next_open = self._clock.now() + OPEN_AGAIN_S
        try:
            self._link = self._table.open(ROLE)
            supply = make_supply(self._table, self._link, self._tap, self._clock.now)
            limits = Limits.of(self._scene)
            film = FilmLimits(self._scene.specimen.specimen(), limits)
            guard = Guard(supply, limits, film, self._table.ramp_V_per_s, self._tell_now)
            guard.commanded = self.commanded
            self._successor = supply, guard
            guard.kill(self.cause)
            self._samples += supply.poll(self._clock.now())  # so that the command is sent at once
        except Exception as error:
            self._errors.append(error)
        self._mirror_successor()

    def _tell_now(self, command: str, argument: str) -> None:
        self._tell(command, argument, self._clock.now())

    def _poll_ourselves(self, now: float) -> Sequence[Sample]:
        if self._errors:
            raise self._errors.popleft()
        if self._successor is None:
            if now < self._next_open:
                return []
            self._take_over()
            if self._errors:
                raise self._errors.popleft()
            return []
        supply = self._successor[0]
        samples = [*self._samples, *supply.poll(now)]
        self._samples = []
        self.ready, self.counters, self.next_poll = supply.ready, supply.counters, supply.next_poll
        return samples

    def _mirror_successor(self) -> None:
        if self._successor is not None:
            self._mirror(self._successor[1])

    def _mirror(self, guard: Guard) -> None:
        self.state, self.cause, self.commanded = guard.state, guard.cause, guard.commanded
        self.setpoint, self.output_is_safe = guard.setpoint, guard.output_is_safe
        self.ramp_duration = guard.ramp_duration


def unpack_error(message: Message) -> Exception:
    """The error that `rig.safety.process.pack_error` made into text."""
    kind = message["kind"]
    if kind in _DEVICE_ERRORS or "device" in message:
        return _DEVICE_ERRORS.get(kind, DeviceError)(message["device"], message["what"], message["advice"])
    return _ERRORS.get(kind, RigError)(message["text"])
