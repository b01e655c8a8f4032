"""The guard's process as the engine sees it: both the supply that it polls and the `Guard` that it asks.

Calls are answered within milliseconds and wait for the answer, so that what the guard refuses is refused here too.
When the guard's process is lost (dead, silent, or its messages are corrupt), the engine takes the output off itself and
goes on to measure it. For that it keeps its own descriptor of the link, and driver and rules made ready, from the
beginning: taking over needs no lock, no file, no new descriptor and nobody's consent, and off is sent again until it is
measured.
"""

from __future__ import annotations

import math
import os
import select
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.links.link import DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import GivesBack, HVFlag, HVSample, HVSupply, Identity, MonitorSample, Sample
from rig.base.clock import RealClock
from rig.base.errors import FaultError, from_fields
from rig.bench.devices import ROLE, Link, make_supply
from rig.bench.tap import Tap
from rig.log.recorder import Severity
from rig.safety import process, start
from rig.safety.channel import Channel, ChannelDamaged, Message
from rig.safety.commanded import ramp_limit
from rig.safety.guard import AT_ONCE_S, Guard, GuardState
from rig.safety.limits import FilmLimits, Limits
from rig.safety.second import SecondReading
from rig.safety.stopped import LOOK_S, Peer
from rig.scene.scene import Scene

START_S = 30.0  # until the process must have the link; a slow disk has many modules to read
# A guard that says nothing for SILENCE_S is lost: it says fifty times a second that it turns, so that a loaded computer
# may hold it up for 0.14 s. One that was asked, and works out what the film bears, gets ANSWER_S. Before any voltage a
# loaded computer may take longer.
SILENCE_S, ANSWER_S = 0.16, 0.25
UNARMED_S = 2.0
LATE_S = 0.015  # a turn that comes later than this is the host's fault: nobody listened
OPEN_AGAIN_S = 0.1
GO_ON_S = 0.5  # how long to wait for the end of one that goes on trying, or hangs
LEAVE_S = 5.0  # a guard that was told to go, and has nothing to take off, must have gone by then

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
        self.given_back = True
        second = SecondReading.of(scene, Limits.of(scene).measured_voltage.high)
        self.second_words = "" if second is None else second.words()
        self.off_limit = AT_ONCE_S + (0.0 if second is None else second.wait_s)
        self._found: dict[str, float] = {}  # what arming changes in the supply, as the guard found it
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
        self._heard_at = self._spoke_at = clock.now()  # the first goes on while nobody listens
        self._lost = ""  # why the process is lost
        self._next_listen = clock.now()
        self._successor: tuple[HVSupply, Guard] | None = None  # made ready; in charge once the guard is lost
        self._next_again = -math.inf
        self._lost_at: float | None = None  # since when our own link has been gone
        self._link: Link | None = self._table.open(ROLE) if self._table.two_may_hold else None
        try:
            self._start()
        except BaseException:
            if self._link is not None:
                self._link.close()
            raise

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        self._channel = Channel(ours)
        try:
            self._process = start.start_guard(theirs)
        except BaseException:
            self._channel.close()
            raise
        finally:
            theirs.close()
        self._peer = Peer(self._process.pid)
        begin = {"do": "begin", "config": process.config(self._scene, self._clock).decode(), "engine": os.getpid()}
        descriptors = tuple(getattr(self._link, "descriptors", ()))
        if descriptors:
            self._channel.hand_over(begin, *descriptors)
        else:
            self._channel.send(begin)

    @property
    def pid(self) -> int:
        """Number of the guard's process."""
        return self._process.pid

    def fileno(self) -> int:
        """Of the channel to the guard's process."""
        return self._channel.fileno()

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

    def lend_monitor(self, descriptors: Sequence[int]) -> None:
        """Give the process descriptors of the voltage's monitor, to read on should this process end. As `log_to`."""
        if descriptors:
            self._channel.hand_over({"do": "monitor"}, *descriptors)

    def appoint(
        self,
        gain: float,
        second_gain: float,
        fresh: Mapping[str, float],
        tell: Callable[[str, str, float], None],
        event: Callable[[Severity, str], None],
    ) -> None:
        """Put the driver to work.

        Parameters
        ----------
        gain : float
            Volts per volt that the supply states, from its certificate.
        second_gain : float
            The same of the monitor of the voltage.
        fresh
            As `Guard` takes it.
        tell : callable
            ``tell(command, argument, t)`` for each command, with the clock time at which it was given.
        event : callable
            ``event(severity, message)`` for what the guard has to say itself.
        """
        self._tell, self._event = tell, event
        if self._link is not None:
            self._make_ready(self._link)
        self._channel.send({"do": "appoint", "gain": gain, "second_gain": second_gain, "fresh": dict(fresh)})
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
        late = now - self._next_listen - LATE_S
        if late > 0:
            self._heard_at = min(self._heard_at + late, now)
        self._listen()
        # What it sends is seen at the channel. A silence is looked at as soon as it may mean something.
        self.next_poll = self._next_listen = max(self._spoke_at + LOOK_S, now + process.LONGEST_TURN_S)
        self._look_whether_stopped()
        if not self._lost and now - self._heard_at > (SILENCE_S if self.commanded else UNARMED_S):
            self._lose(f"it has said nothing for {now - self._heard_at:.2f} s")
        if self._lost:
            raise self._loss()
        if self._errors:
            raise self._errors.popleft()
        samples, self._samples = self._samples, []
        return samples

    def close(self) -> None:
        """Tell the process to end, and see that it does. Calling it twice does no harm.

        One that has commanded an output which is not measured off is left to go on trying.
        """
        may_go_on = self.commanded and not self.output_is_safe and not self._lost
        if not self._channel.closed:
            self._channel.send({"do": "close"})
            self._process.wait(GO_ON_S if may_go_on else LEAVE_S)
            self._channel.close()
        if not may_go_on and not self._process.wait(GO_ON_S if self._lost else LEAVE_S):  # nothing may wait for it
            self._process.kill()
            self._process.wait(GO_ON_S)
        if self._link is not None:
            self._link.close()
            self._link = None
        self._peer.close()

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

    def give_back(self) -> None:
        self._call("give_back")

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
        if self._lost and self._successor is not None:
            guard = self._successor[1]
            guard.on_sample(sample)
            self._mirror(guard)

    def on_monitor(self, sample: MonitorSample) -> None:
        """Pass a reading of the monitor on; what the guard thinks of it comes with the next `poll`."""
        if sample.quantity != "voltage":
            return
        if self._lost and self._successor is not None:
            guard = self._successor[1]
            guard.on_monitor(sample)
            self._mirror(guard)
        else:
            self._channel.send({"do": "reading", "values": [sample.t, sample.value, sample.flags.value]})

    @property
    def ramp_limit(self) -> float:
        """As `Guard.ramp_limit`."""
        return ramp_limit(self.ramp_duration) + self.off_limit - AT_ONCE_S

    # The process ---------------------------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> None:
        if self._lost and self._successor is not None:
            guard = self._successor[1]
            getattr(guard, name)(*arguments)
            self._mirror(guard)
            return
        if not self._lost:
            self._calls += 1
            number = self._calls
            self._channel.send({"do": "call", "n": number, "name": name, "args": list(arguments)})
            time_out = ANSWER_S if self.commanded and name != "arm" else UNARMED_S
            end = self._clock.now() + time_out
            while number not in self._answers and not self._lost:
                left = end - self._clock.now()
                if left <= 0:
                    self._lose(f"it did not answer within {time_out:g} s")
                    break
                if not self._channel.closed:
                    select.select([self._channel], [], [], min(left, LOOK_S))
                self._listen()
                self._look_whether_stopped()
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
            self._lose(f"its messages are corrupt: {error}")
            return
        if messages:
            self._heard_at = self._spoke_at = self._clock.now()
        for message in messages:
            self._take(message)
        if self._channel.closed:
            self._lose("its process has died")

    def _look_whether_stopped(self) -> None:
        """A guard that was stopped is lost at once: no loaded computer does that."""
        silent = self._clock.now() - self._spoke_at
        if silent > LOOK_S and not self._lost and self._peer.stopped:
            self._lose(f"its process was stopped, and has said nothing for {silent:.2f} s")

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
                error = unpack_error(message["error"])
                if not self._errors or str(self._errors[-1]) != str(error):  # a port that is gone is told every turn
                    self._errors.append(error)
            case "opened":
                self._is_open = True
                self.link_settings = message["settings"] | getattr(self._link, "settings", {})

    def _take_state(self, message: Message) -> None:
        self.state = GuardState(message["state"])
        self.cause = message["cause"]
        self.commanded = message["commanded"]
        self.setpoint = message["setpoint"]
        self.output_is_safe = message["output_is_safe"]
        self.ramp_duration = message["ramp_duration"]
        self.second_words = message["second_words"]
        self.given_back, self._found = message.get("given_back", True), message.get("found", {})
        self.ready = message["ready"]
        self.identity = Identity(*message["identity"])
        self.settings = message["settings"]
        self.counters = message["counters"]

    # When it is lost -----------------------------------------------------------------------------------------

    def _lose(self, why: str) -> None:
        """The process is lost: what is left of it must not wake up again. We take the output off ourselves."""
        if self._lost:
            return
        self._lost = why
        self.state, self.cause, self.output_is_safe = GuardState.SAFE, f"the guard is lost: {why}", False
        self._channel.close()
        self._process.kill()  # and nobody waits: one that hangs in the system may never end
        if self._is_open:
            self._take_over()

    def _loss(self) -> FaultError:
        done = "the output was never commanded"
        if self.commanded:
            done = "the output was commanded off" if self._lost_at is None else "the link is gone"
        return FaultError(f"hv: the guard is lost ({self._lost}); from here {done}.")

    def _make_ready(self, link: Link) -> None:
        """Driver and rules that take over; they send nothing before."""
        supply = make_supply(self._table, link, self._tap, self._clock.now)
        limits = Limits.of(self._scene)
        film = FilmLimits(self._scene.specimen.specimen(), limits)
        second = SecondReading.of(self._scene, limits.measured_voltage.high)
        self._successor = supply, Guard(supply, limits, film, self._table.ramp_V_per_s, self._tell_now, None, second)

    def _take_over(self) -> None:
        """Command the output off, if it was ever commanded on."""
        now = self._clock.now()
        try:
            if self._link is None:  # one that two programs cannot have open: free now
                self._link = self._table.open(ROLE)
                self._make_ready(self._link)
            self._lost_at = None
        except Exception as error:
            self._lost_at, self._next_again = now, now + OPEN_AGAIN_S
            self._errors.append(error)
            return
        assert self._successor is not None
        self._successor[1].commanded = self.commanded
        if isinstance(self._successor[0], GivesBack):
            self._successor[0].resume_found(self._found)
        with suppress(DeviceLost):
            getattr(self._link, "resume", lambda: None)()
        self._off(now)

    def _off(self, now: float) -> None:
        """Send the off, at once and whatever else may fail, and measure."""
        assert self._successor is not None
        supply, guard = self._successor
        self._next_again = now + process.INSIST_S
        try:
            guard.kill(self.cause)
            self._samples += supply.poll(now)
        except DeviceLost as error:
            self._find_again(now)
            self._errors.append(error)
        except Exception as error:
            self._errors.append(error)
        self._mirror(guard)

    def _find_again(self, now: float) -> None:
        """Open a link that was lost as soon as it is back; the off is sent at the next turn then."""
        if self._lost_at is None:
            self._lost_at = now
        if self._link is not None and self._link.reopen():
            gone = now - self._lost_at
            self._event("warning", f"the supply's link was gone for {gone:.2f} s and is open again")
            self._lost_at, self._next_again = None, now

    def _tell_now(self, command: str, argument: str) -> None:
        self._tell(command, argument, self._clock.now())

    def _poll_ourselves(self, now: float) -> Sequence[Sample]:
        """In the guard's place: measure, and send the off again while it is not measured."""
        if self._errors:
            raise self._errors.popleft()
        if self._link is None or self._successor is None:
            if self._is_open and now >= self._next_again:
                self._take_over()
            return []
        supply, guard = self._successor
        if guard.commanded and not guard.output_is_safe and now >= self._next_again:
            self._off(now)
        try:
            samples = [*self._samples, *supply.poll(now)]
        except DeviceLost:
            self._find_again(now)
            raise
        finally:
            self._samples = []
            self.ready, self.counters, self.next_poll = supply.ready, supply.counters, supply.next_poll
        return samples

    def _mirror(self, guard: Guard) -> None:
        self.state, self.cause, self.commanded = guard.state, guard.cause, guard.commanded
        self.setpoint, self.output_is_safe = guard.setpoint, guard.output_is_safe
        self.ramp_duration, self.given_back = guard.ramp_duration, guard.given_back
        self.second_words = guard.second_words


def unpack_error(message: Message) -> Exception:
    """The error that `rig.safety.process.pack_error` made into text."""
    kind = message["kind"]
    if "what" in message:
        return _DEVICE_ERRORS.get(kind, DeviceError)(message["device"], message["what"], message["advice"])
    return from_fields(message)
