"""The guard as a process of its own: sole owner of the high-voltage link, and the last one to leave.

The engine starts it when a scene with high voltage runs on real ports. It is handed the link (or opens it, where a link
cannot be handed over), holds the limits and the film's model itself, and runs its own loop. It executes set-points only
while the engine's heartbeats arrive. The engine's death closes the socket between them: the output is then taken off at
once. A hung engine misses its deadline: the same. Off is believed when it has been *measured*; a supply that does not
obey is called NOT SAFE and told again until it obeys. A port that vanished is opened again as soon as it is back.
Nothing on this way needs a lock, a file or anybody's consent.

Ctrl-C, SIGTERM and SIGHUP do not concern this process: its life is bound to the socket. When *both* processes are
killed, or the computer loses its power, nothing in software is left to act, and the supply keeps its voltage: that case
belongs to the hardware, to interlock loop, emergency stop and bleed resistor.
"""

from __future__ import annotations

import gc
import json
import math
import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from drivers.dialogue import LOOK_AGAIN_S
from drivers.links.link import DeviceError, DeviceLost
from drivers.roles import GivesBack, HVSample, HVSupply, MonitorSample, SampleFlag
from drivers.settings import SupplySettings
from rig.base.clock import RealClock
from rig.base.errors import FaultError, RigError
from rig.base.host import HostTime
from rig.bench.devices import ROLE, Link, make_supply
from rig.log.errors import LogError
from rig.log.recorder import Severity
from rig.log.remote import RemoteLog
from rig.log.schema import MONITORED, SETTINGS, Way
from rig.safety.channel import Channel, ChannelDamaged, Message
from rig.safety.expected import Expected
from rig.safety.guard import ADVICE, GIVE_BACK, NOT_SAFE, Guard, GuardState
from rig.safety.last_words import LastWords
from rig.safety.limits import FilmLimits, Limits
from rig.safety.second import SecondReading
from rig.safety.stopped import Peer
from rig.safety.taken_over import TakenOver
from rig.scene.scene import Scene

SHORTEST_TURN_S, LONGEST_TURN_S = 0.001, 0.005  # the longest while an output is on its way to off
ANSWER_S, IDLE_S = 0.01, 0.05  # a supply that awaits an answer, or nothing, is polled after so long at the latest
STATE_S = 0.05  # how often the engine hears how it stands at least
ALIVE_S = 0.03  # ... and that this loop turns; with each heartbeat that is awaited, so that one turn does both
SOON_S = 0.01  # ... but no more often than this
AGAIN_S = 0.1  # a command that failed is given again at this interval
INSIST_S = 1.0  # an off that was sent but is not measured is sent again at this interval
BEGIN_S = 30.0  # how long the engine may take to say what is to be guarded
TRY_S = 3600.0  # how long a supply that does not obey is told again after the engine has gone, unless a signal ends it
ENDING = ("SIGINT", "SIGTERM")  # signals that the guard obeys once its engine has gone and it has said NOT SAFE
GIVE_BACK_S = 1.0  # how long the supply may take to confirm that it has its settings back
HUNG_S = 0.5  # an engine that has said nothing for so long reads no monitor either
SPEAK_S = 1.0  # how long the last word may wait for a terminal that takes nothing
IGNORED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
MAY_BE_CALLED = (
    "arm",
    "check_supply",
    "check_off",
    "request",
    "check_move",
    "take_down",
    "clear_faults",
    "ramp_off",
    "kill",
    "give_back",
)


def config(scene: Scene, clock: RealClock) -> bytes:
    """What the guard process needs to know, as JSON."""
    content = {"scene": scene.model_dump(mode="json", exclude_none=True), "zero": clock.zero, "ns": clock.started_ns}
    return json.dumps(content).encode()


def serve(end: socket.socket) -> None:
    """The life of the guard process, from the engine's first message to its end.

    Parameters
    ----------
    end : socket
        Our end of the pair; the engine holds the other one, and nobody else. The first message has the configuration
        (`config`), and with it come the descriptors of the link, if it can be handed over.
    """
    _detach()
    channel = Channel(end)
    begin = _first_message(channel)
    if begin is None:
        return
    known = json.loads(begin["config"])
    scene = Scene.model_validate(known["scene"])
    assert scene.hv is not None
    adopted, channel.handles = tuple(channel.handles), []
    try:
        link = scene.hv.open(ROLE, adopted)
    except Exception as error:
        channel.send({"is": "error", "error": pack_error(error)})
        return
    clock = RealClock(known["zero"], known["ns"])
    server = Server(scene, scene.hv, link, channel, clock, Peer(int(begin["engine"])), adopted[0] if adopted else None)
    try:
        server.run()
    finally:
        link.close()
        server.close()
        channel.close()


def _first_message(channel: Channel) -> Message | None:
    clock = RealClock()
    while clock.now() < BEGIN_S and not channel.closed:
        select.select([channel], [], [], 0.5)
        for message in channel.receive():
            return message
    return None


def _detach() -> None:
    """Out of reach of the terminal: what is typed there, and its end, are the engine's business."""
    for name in IGNORED:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if os.name == "posix":
        with suppress(OSError):  # it has a session of its own already
            os.setsid()
        signal.pthread_sigmask(signal.SIG_SETMASK, ())


class Server:
    """Runs the guard's loop until the engine closes the channel and the output has been taken care of."""

    def __init__(
        self,
        scene: Scene,
        table: SupplySettings,
        link: Link,
        channel: Channel,
        clock: RealClock,
        engine: Peer,
        descriptor: int | None = None,
    ) -> None:
        self._scene = scene
        self._table = table
        self._link = link
        self._channel = channel
        self._clock = clock
        self._engine = engine
        self._descriptor = descriptor  # of the link: by it the system says that something has come
        self._came = True  # whether it has said so
        self._host = HostTime(clock)
        self._supply: HVSupply | None = None
        self._expected: Expected | None = None  # its answers
        self._lent: GivesBack | None = None  # the supply, where it gives back what arming changes
        self._guard: Guard | None = None
        self._gain = 1.0
        self._monitor: TakenOver | None = None  # read from here only when the engine does not
        self._polled_at = self._heard_at = 0.0
        self._log: RemoteLog | None = None
        self._next_state = self._next_alive = 0.0
        self._again = 0.0
        self._off_at: float | None = None  # when the output was taken off that is not measured off yet
        self._off_limit = 0.0  # ... after which time it must be measured off
        self._off_ramps = False  # ... and whether that was an orderly ramp
        self._lost_at: float | None = None  # since when the link has been gone
        self._words = LastWords()
        self._told_not_safe = False
        self._dismissed = False

    def run(self) -> None:
        settings = dict(getattr(self._link, "settings", {}))
        self._channel.send({"is": "opened", "settings": settings})
        while not self._channel.closed and not self._dismissed:
            try:
                self._turn()
            except BaseException as error:  # whatever it is, the output goes off first
                self._fault(error)
            self._wait()
        guard = self._guard
        if guard is not None and guard.commanded and not (self._dismissed and _measured_off(guard)):
            self._leave(guard)

    def close(self) -> None:
        """Let go of the log."""
        self._engine.close()
        log, self._log = self._log, None
        if log is not None:
            log.close()

    # The loop ------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        # First everything that has arrived: a guard that was held up must not blame the engine for it.
        messages = self._receive()
        if messages:
            self._heard(self._clock.now())
        for message in messages:
            self._obey(message)
        guard, supply = self._guard, self._supply
        if guard is None or supply is None:
            return
        asked = any(message.get("do") != "heartbeat" for message in messages)
        if asked or self._came or self._clock.now() >= self._due(guard, supply):
            self._poll(guard, supply)
        now = self._clock.now()
        guard.turn(now)
        self._host.check()
        self._insist(guard, now)
        if now >= self._next_state:
            self._tell_state(guard, supply, now)
        elif now >= self._next_alive - (ALIVE_S - SOON_S) * bool(messages):
            self._channel.send({"is": "alive"})
            self._next_alive = now + ALIVE_S

    def _due(self, guard: Guard, supply: HVSupply) -> float:
        """When the supply is to be polled, if nothing comes before.

        While an output that was commanded off is not measured off, nothing is left to the link.
        """
        goes_off = guard.commanded and guard.state is GuardState.SAFE and not guard.output_is_safe
        if self._descriptor is None or goes_off:
            return min(self._polled_at + LONGEST_TURN_S, supply.next_poll)  # in this order NaN is no time
        if self._awaits(supply):
            return self._polled_at + ANSWER_S
        return min(self._polled_at + IDLE_S, supply.next_poll)

    def _awaits(self, supply: HVSupply) -> bool:
        """Whether an answer is all that is waited for, by what `Dialogue.next_poll` says then."""
        return supply.next_poll == self._polled_at + LOOK_AGAIN_S

    def _heard(self, now: float) -> None:
        """The engine turns: what it lent is its own again."""
        if self._monitor is not None and now - self._heard_at > HUNG_S:
            self._monitor.leave()
        self._heard_at = now

    def _receive(self) -> list[Message]:
        try:
            return self._channel.receive()
        except ChannelDamaged as error:
            raise FaultError(f"hv: the guard cannot understand the engine: {error}.") from None

    def _poll(self, guard: Guard, supply: HVSupply) -> None:
        self._polled_at = self._clock.now()  # all the time that the driver knows: what passes on its wire bears it
        try:
            samples = supply.poll(self._polled_at)
        except DeviceLost:
            self._find_again()
            raise
        except DeviceError:
            self._tell_wire(ROLE, "failed", b"", self._polled_at)
            raise
        for raw in samples:
            assert isinstance(raw, HVSample)
            self._tell_sample(raw)
            guard.on_sample(self._by_certificate(raw))
        if self._monitor is not None and self._reads_the_monitor(guard):
            for reading in self._monitor.poll(self._polled_at):
                self._tell_reading(reading)
                self._take_reading(reading)

    def _reads_the_monitor(self, guard: Guard) -> bool:
        """Whether nobody else does: the engine has ended, or is stopped or hung and the output not proven off yet."""
        if self._channel.closed:
            return True
        silent = self._polled_at - self._heard_at
        return silent > HUNG_S and guard.commanded and guard.state is GuardState.SAFE

    def _find_again(self) -> None:
        """Open a link that was lost as soon as it is back; the off is sent at once then."""
        now = self._clock.now()
        self._descriptor = None  # of what is gone
        if self._lost_at is None:
            self._lost_at = now
        if self._link.reopen():
            self._tell_event("warning", f"the supply's link was gone for {now - self._lost_at:.2f} s and is open again")
            self._lost_at, self._again = None, now

    def _by_certificate(self, sample: HVSample) -> HVSample:
        return replace(sample, voltage=sample.voltage * self._gain)

    def _wait(self) -> None:
        """Until something comes, or there is something to do."""
        now = self._clock.now()
        self._words.speak()
        self._tick_log(now)
        due = watches = now + LONGEST_TURN_S
        if self._guard is not None and self._supply is not None and self._expected is not None:
            # What is overdue already was tried in the turn before; it may go on failing, and is no cause for haste.
            instants = self._next_alive, self._guard.next_look
            due = min(self._due(self._guard, self._supply), *(at if at > now else due for at in instants))
            awaits = self._awaits(self._supply)
            soonest = self._expected.after(self._polled_at, awaits)
            # What comes unasked, on a full bus, is not read one by one.
            watches = soonest if awaits else self._polled_at + LONGEST_TURN_S
        due = max(due, now + SHORTEST_TURN_S)
        self._came = self._descriptor is None
        if self._channel.closed:
            self._came = True
            self._clock.sleep_until(min(due, now + LONGEST_TURN_S))
            return
        self._channel.flush()
        try:
            if watches > now and select.select([self._channel], [], [], min(watches, due) - now)[0]:
                return
            ends: list[Channel | int] = [self._channel]
            if self._descriptor is not None:
                ends.append(self._descriptor)
            readable, _, _ = select.select(ends, [], [], max(due - self._clock.now(), 0.0))
            self._came |= self._descriptor in readable
        except (OSError, ValueError):  # the link was closed, and says so when it is read
            self._descriptor, self._came = None, True
            self._clock.sleep_until(min(due, now + LONGEST_TURN_S))

    def _fault(self, error: BaseException) -> None:
        guard = self._guard
        if guard is not None and guard.state is not GuardState.SAFE:
            self._off(guard, str(error) or repr(error))
        elif guard is not None and guard.commanded and not guard.output_is_safe:
            if guard.ramps_down:  # the switch-off may be what failed, or the output does not come down
                self._off(guard, f"{guard.cause}; hastened, {error}")
            elif isinstance(error, DeviceError):
                self._again = min(self._again, self._clock.now() + AGAIN_S)
        self._channel.send({"is": "error", "error": pack_error(error)})
        if guard is not None:  # the turn that failed has not come so far
            self._insist(guard, self._clock.now())

    def _off(self, guard: Guard, cause: str) -> None:
        """Take the output off and send that in this very turn."""
        try:
            guard.kill(cause)
            if self._supply is not None:
                self._poll(guard, self._supply)
        except BaseException as error:
            self._channel.send({"is": "error", "error": pack_error(error)})

    def _insist(self, guard: Guard, now: float) -> None:
        """Off is what was measured: until then it is sent again, and after a while called by its name.

        An orderly ramp is given its time, whoever asked for it and whether that one still lives; then it is cut short.
        """
        if not guard.commanded or guard.state is not GuardState.SAFE or guard.output_is_safe:
            self._off_at, self._told_not_safe = None, False
            return
        if self._off_at is None or (self._off_ramps and not guard.ramps_down):
            self._off_at, self._off_ramps = now, guard.ramps_down
            self._off_limit = guard.ramp_limit if guard.ramps_down else guard.off_limit
            self._again = now + INSIST_S
        late = now - self._off_at > self._off_limit
        if self._off_ramps:
            if late:
                self._off(guard, f"{guard.cause}; hastened, the ramp has taken {now - self._off_at:.0f} s")
        elif late and not self._told_not_safe:
            self._told_not_safe = True
            message = f"{NOT_SAFE} {_sentence(guard.second_words)}{ADVICE}"
            self._tell_event("error", message)
            self._words.say(f"dea-rig guard: {message} It is told again until it obeys (process {os.getpid()}).")
        elif now >= self._again:
            self._again = now + INSIST_S
            self._off(guard, guard.cause)

    # What the engine asks --------------------------------------------------------------------------------------

    def _obey(self, message: Message) -> None:
        match message.get("do"):
            case "heartbeat":
                if self._guard is not None:
                    self._guard.heartbeat(bytes.fromhex(message["data"]), self._clock.now())
            case "reading":
                t, value, flags = message["values"]
                self._take_reading(MonitorSample(t, self._scene.second_reading, "voltage", value, SampleFlag(flags)))
            case "monitor":
                handles, self._channel.handles = tuple(self._channel.handles), []
                self._monitor = TakenOver(self._scene, handles)
            case "call":
                self._answer(message)
            case "appoint":
                self._appoint(message)
            case "log":
                self._log = RemoteLog(Path(message["path"]), socket.socket(fileno=self._channel.handles.pop(0)))
            case "close":
                self._dismissed = True
                self.close()  # the engine says in the log how it ended; what comes after is told at the terminal
            case other:
                raise FaultError(f"hv: the engine asks the guard for {other!r}, which it does not know.")

    def _take_reading(self, reading: MonitorSample) -> None:
        """What the monitor shows may take the output off; what else the engine asks is heard all the same."""
        try:
            if self._guard is not None:
                self._guard.on_monitor(reading)
        except RigError as error:
            self._fault(error)

    def _appoint(self, message: Message) -> None:
        """Put the driver on its link: from here on it is polled."""
        self._gain = float(message["gain"])
        self._supply = make_supply(self._table, self._link, self._tell_wire, lambda: self._polled_at)
        self._expected = Expected(self._supply)
        self._lent = self._supply if isinstance(self._supply, GivesBack) else None
        limits = Limits.of(self._scene)
        film = FilmLimits(self._scene.specimen.specimen(), limits)
        film.capacitance(0.0, 0.0)  # the model's first answer takes longest
        fresh = {str(role): float(age) for role, age in message["fresh"].items()}
        second = SecondReading.of(self._scene, limits.measured_voltage.high)
        ramp = self._table.ramp_V_per_s
        self._guard = Guard(self._supply, limits, film, ramp, self._tell_command, fresh, second, self._engine)
        if self._monitor is not None:
            self._monitor.gain = float(message["second_gain"])
        gc.freeze()  # a search for garbage through all that was made until now would hold the loop up

    def _answer(self, message: Message) -> None:
        guard, supply = self._guard, self._supply
        name, error, began = message["name"], None, self._clock.now()
        try:
            if guard is None or supply is None:
                raise FaultError("hv: the guard was asked before it was appointed.")
            if name not in MAY_BE_CALLED:
                raise FaultError(f"hv: the guard cannot be asked for {name!r}.")
            getattr(guard, name)(*message["args"])
        except Exception as caught:
            error = pack_error(caught)
        if guard is not None and supply is not None:
            guard.excuse(self._clock.now() - began)
            self._tell_state(guard, supply, self._clock.now())
        self._channel.send({"is": "answer", "n": message["n"], "error": error})

    # What the engine is told -----------------------------------------------------------------------------------

    def _tell_state(self, guard: Guard, supply: HVSupply, now: float) -> None:
        self._next_state, self._next_alive = now + STATE_S, now + ALIVE_S
        self._channel.send(
            {
                "is": "state",
                "state": guard.state.value,
                "cause": guard.cause,
                "commanded": guard.commanded,
                "setpoint": guard.setpoint,
                "output_is_safe": guard.output_is_safe,
                "ramp_duration": guard.ramp_duration,
                "second_words": guard.second_words,
                "given_back": guard.given_back,
                "found": {} if self._lent is None else dict(self._lent.found),
                "ready": supply.ready,
                "identity": [supply.identity.model, supply.identity.serial, supply.identity.firmware],
                "settings": supply.settings,
                "counters": supply.counters | {"heartbeat_gap_max_us": round(guard.longest_silence * 1e6)},
            }
        )

    def _tell_wire(self, role: str, way: Way, data: bytes, t: float) -> None:
        if not self._record(f"/raw/{role}/{way}", t, data=data):
            self._channel.send({"is": "wire", "way": way, "data": data.hex(), "t": t})

    def _tell_command(self, command: str, argument: str) -> None:
        t = self._clock.now()
        device = ROLE + SETTINGS * (command == GIVE_BACK)
        if not self._record("/command", t, device=device, command=command, argument=argument):
            self._channel.send({"is": "command", "command": command, "argument": argument, "t": t})

    def _tell_event(self, severity: Severity, message: str) -> None:
        if not self._record("/event", self._clock.now(), severity=severity, source="guard", message=message):
            self._channel.send({"is": "event", "severity": severity, "message": message})

    def _tell_sample(self, raw: HVSample) -> None:
        if not self._channel.closed:
            values = [raw.t, raw.voltage, raw.current, raw.setpoint, raw.flags.value]
            self._channel.send({"is": "sample", "values": values})
            self._next_state = 0.0
            return
        one = self._by_certificate(raw)
        fields = {"voltage_V": one.voltage, "current_A": one.current, "setpoint_V": one.setpoint}
        self._record("/hv/sample", one.t, **fields, flags=one.flags.value)

    def _tell_reading(self, one: MonitorSample) -> None:
        nothing = dict.fromkeys(MONITORED.values(), math.nan)
        fields = nothing | {MONITORED[one.quantity]: one.value}
        self._record(f"/{one.role}/sample", one.t, **fields, flags=one.flags.value)

    # The log ---------------------------------------------------------------------------------------------------

    def _record(self, topic: str, t: float, **fields: object) -> bool:
        """Write to our own end of the log; False when we have none, or none any more."""
        if self._log is None:
            return False
        epoch_ns = self._clock.epoch_ns
        try:
            self._log.write(topic, {"t_s": t, **fields}, epoch_ns(self._clock.now()), epoch_ns(t))
        except LogError:  # the engine meets the same error at its own end, and ends the run for it
            self._log = None
        return self._log is not None

    def _tick_log(self, now: float) -> None:
        if self._log is not None:
            try:
                self._log.tick(now)
            except LogError:
                self._log = None

    # The end ---------------------------------------------------------------------------------------------------

    def _leave(self, guard: Guard) -> None:
        """The engine ended without a shutdown message, or from a supply that it had commanded and not measured off."""
        cause = "the engine has ended without a shutdown message"
        if self._dismissed:
            cause = "the engine has ended before the output was measured off"
        began = self._clock.now()
        if guard.state is GuardState.SAFE:
            cause = f"{cause}, after {guard.cause}"
        if not _measured_off(guard):
            self._off(guard, cause)
        ended_by: list[int] = []
        while not guard.output_is_safe and self._clock.now() - began < TRY_S and not ended_by:
            if self._told_not_safe:
                _obey_signals(ended_by)
            try:
                assert self._supply is not None
                self._poll(guard, self._supply)
                self._insist(guard, self._clock.now())
            except BaseException as error:
                self._fault(error)
            self._wait()
        self._give_back(guard)
        measured = guard.last.voltage if guard.last is not None else float("nan")
        second = _sentence(guard.second_words)
        if guard.output_is_safe:
            message = f"{cause}. The high voltage is off, measured {measured:.0f} V. {second}".rstrip()
        else:
            message = f"{cause}. NOT SAFE: high voltage last measured {measured:.0f} V. {second}{ADVICE} "
            message += "The guard has ended."
        self._tell_event("error", message)
        self._words.say(f"dea-rig guard: {message}")
        end = time.monotonic() + SPEAK_S
        while not self._words.speak() and time.monotonic() < end:
            time.sleep(LONGEST_TURN_S)

    def _give_back(self, guard: Guard) -> None:
        """The last thing, and without it all is as safe: the supply gets back what arming changed."""
        assert self._supply is not None
        end = self._clock.now() + GIVE_BACK_S
        with suppress(Exception):
            if guard.output_is_safe and not guard.given_back:
                guard.give_back()
            while guard.output_is_safe and not guard.given_back and self._clock.now() < end:
                self._poll(guard, self._supply)
                self._wait()


def _obey_signals(ended_by: list[int]) -> None:
    """From now on the operator may end a guard that can do nothing more."""
    for name in ENDING:
        number = getattr(signal, name)
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda number, frame: ended_by.append(number))


def _sentence(words: str) -> str:
    """``words`` as a sentence with a blank after it; nothing of nothing."""
    return f"{words[:1].upper()}{words[1:]}. " if words else ""


def _measured_off(guard: Guard) -> bool:
    return guard.state is GuardState.SAFE and guard.output_is_safe


def pack_error(error: BaseException) -> Message:
    """An error as plain text and numbers."""
    if isinstance(error, DeviceError):
        said = {"device": error.device, "what": error.what, "advice": error.advice}
        return {"kind": type(error).__name__, **{key: str(text) for key, text in said.items()}}
    if not isinstance(error, RigError):
        error = FaultError(f"hv: internal error of the guard: {error!r}", device=ROLE)
    return error.fields()


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
