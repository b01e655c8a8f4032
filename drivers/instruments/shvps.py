r"""The peta-pico-Voltron single-channel HV supply (shvps, up to 5 kV) of dielectric-elastomer labs, serial, 115200 8N1.

A command is a word and perhaps a number, ended by CR; one line ended by CR LF comes back, which is the value alone:
``QVnow\r`` -> ``1498\r\n``. ``Q..`` asks, ``S.. n`` sets and answers with the new value. Voltages are whole volts.
``SSwMode`` is the state of the output: 0 off (0 V whatever the set-point), 1 steady, 2 switching, 3 waveform;
``SVMode`` 0 means regulated to the set-point, ``SSwSrc`` 0 that the board itself switches.

**What the protocol lacks, and what stands in for it.**
No line says what it answers, and numbers look alike. After each number the driver asks for the version, whose answer
(``slave 8``) looks like no number: a doubled or late number meets that question and is dropped, and since answers
keep their order no old one can come after it.
There is no checksum: a digit may change unseen. Commands are read back; a voltage above 1.2 times the maximum is not
believed; a set-point or state other than expected is believed when it has been read twice, since the ramp goes on from
the set-point.
There is no ramp: the set-point is moved in steps at the polling rate. When the host dies, the voltage stays.
The power jack is looked at in the set-up, and whenever the output stands clearly below its set-point: without power it
decays, while the board still says that it is on.
The current is not measured (NaN) and not limited beyond what the converter can give: `set_current_limit` refuses.
There is no latch: an emergency off is remembered here, until `clear`.
Regulation (``VMode``) and source of the switching (``SwSrc``) are changed when it is switched on, and given back as
they were found once it is off. The set-point is not: it stays 0 V, since the source may be a switch that is on.

Source: EPFL NERDv3, libs/hvps.py (library 2.8, firmware 8). Not tried on hardware.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import suppress
from typing import ClassVar, Literal, TypeVar

from pydantic import Field, PrivateAttr

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, Schedule, Script, label
from drivers.heard import Heard
from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.probe import Answered, Line, SerialProbe
from drivers.recorded import Dialect
from drivers.roles import HVFlag, HVSample, Identity
from drivers.settings import SerialSettings, SupplySettings

T = TypeVar("T")

OFF, STEADY, SWITCHING, WAVEFORM = range(4)
MODES = "VMode", "SwSrc"
"""What switching on changes beside set-point and state."""

TRIES = 3
PLAUSIBLE = 1.2
LONGEST_STEP_S = 0.25
"""A ramp does not make up for time in which nobody polled."""

CLEARLY_BELOW_V = 10.0
"""The regulated output is this far below a set-point that has stood for a cycle, and not by noise."""

_MAX_LINE = 64
_LINE = re.compile(rb"[ -~]+\r")
_NUMBER = re.compile(r"-?[0-9]{1,6}")
_VERSION = re.compile(r"(slave|master) ([0-9]{1,4})")
_UNSAFE = "Take the high voltage away by hand: pull the power jack, then ground the electrodes."

_Part = Generator[Ask[str], Answer[str], T]


def encode(command: str) -> bytes:
    return command.encode("ascii") + b"\r"


def version_of(line: str) -> tuple[str, str]:
    """(kind of board, firmware) from the answer to ``QVer``; ("", "") when it is none."""
    match = _VERSION.fullmatch(line)
    return (match[1], match[2]) if match else ("", "")


def identity(name: str, version: str) -> Identity:
    """From the answers to ``QName`` and ``QVer``. The board has no serial number."""
    return Identity(model=f"shvps {name}".rstrip(), firmware=version)


class Codec:
    """Bytes to lines of printable ASCII. ``counters``: ``bad_grammar``, ``too_long``.

    What follows a line that ended without CR is dropped as well, until `asked`: it may be the rest of a number that was
    torn in two.
    """

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("bad_grammar", 0)
        self._lines = LineSplitter(b"\n", _MAX_LINE, self.counters)
        self._torn = False

    def feed(self, data: bytes) -> list[str]:
        """The lines that ``data`` completes, in order."""
        return [line[:-1].decode("ascii") for line in self._lines.feed(data) if self._is_good(line)]

    def asked(self) -> None:
        """A question is sent: what comes from now on is no rest of an earlier line."""
        self._torn = False

    def _is_good(self, line: bytes) -> bool:
        good = not self._torn and _LINE.fullmatch(line) is not None
        self._torn = not line.endswith(b"\r")
        self.counters["bad_grammar"] += not good
        return good


class ShvpsSettings(SupplySettings, SerialSettings):
    """The shvps supply of dielectric-elastomer labs on a serial port. Whole volts; it does not measure its current."""

    measures_current: ClassVar[bool] = False
    whole_volts: ClassVar[bool] = True
    asks_per_sample: ClassVar[int] = 6

    driver: Literal["shvps"] = Field(description="shvps (peta-pico-Voltron) high-voltage supply on a serial port.")
    poll_rate_Hz: float = Field(
        default=10.0,
        gt=0,
        le=20,
        description="How often voltage and state are read (Hz); the ramp is made in steps at this rate. Typical: 10.",
    )

    _looked_at_jack: bool = PrivateAttr(default=True)

    def as_recorded(self, sent: Sequence[bytes]) -> None:
        first = next((request for request in sent if b"VMode" in request), b"")
        self._looked_first = first.startswith(b"Q")
        self._looked_at_jack = sum(b"QJack" in request for request in sent) > 1  # once it is asked in the set-up

    @property
    def looks_at_jack(self) -> bool:
        """Recorded dialogues of earlier releases did not ask for it again."""
        return self._looked_at_jack


class Shvps:
    """A `drivers.roles.HVSupply`. Set-up asks and changes nothing.

    Parameters
    ----------
    name : str
        The device's name in the scene.
    link : ByteLink
        Its serial line.
    poll_rate_Hz : float
        How often voltage and state are asked for; also the rate of the ramp's steps.
    timeout_s : float
        How long to wait for each answer.
    ramp_V_per_s : float
        Ramp until `set_ramp` says otherwise.
    boot_s : float
        How long the first answer may take.
    looks_first : bool
        Whether it reads the modes that it changes when it is switched on. Recorded dialogues of earlier releases did
        not.
    looks_at_jack : bool
        Whether it asks for the power jack where the output stands below its set-point; as above.
    """

    measures_current = False

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        poll_rate_Hz: float = 20.0,
        timeout_s: float = 0.1,
        ramp_V_per_s: float = 100.0,
        boot_s: float = 0.0,
        looks_first: bool = False,
        looks_at_jack: bool = True,
    ) -> None:
        self.name = name
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"implausible": 0, "doubted": 0, "unexpected_replies": 0}
        self._label = label(name, link)
        self._link = link
        self._codec = Codec(self.counters)
        self._schedule = Schedule(1.0 / poll_rate_Hz, self.counters)
        self._boot_s = boot_s
        self._heard = Heard()
        self._dialogue: Dialogue[str, str] = Dialogue(
            self._label, self._send, self.counters, timeout_s=timeout_s, heard=self._heard
        )
        self._inbox: deque[str] = deque()
        self._samples: list[HVSample] = []
        self._now = self._next_poll = 0.0
        self._ready = False
        self._commands = 0
        self._max_volts = math.nan
        self._ramp = ramp_V_per_s
        self._target = self._setpoint = 0
        self._stepped_at: float | None = None  # None: with the next cycle a ramp begins
        self._on = self._emergency = False
        self._looks_first = looks_first
        self._looks_at_jack = looks_at_jack
        self.found: dict[str, float] = {}
        self._present: dict[str, float] = {}
        self._dialogue.begin(self._set_up())

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def nominal(self) -> tuple[float, float]:
        """(volts, NaN): what current the converter can give is not known to it."""
        return self._max_volts, math.nan

    @property
    def fastest_ramp(self) -> float:
        """Any: the ramp is made here, in steps."""
        return math.inf

    @property
    def busy(self) -> bool:
        return self._commands > 0

    def set_ramp(self, volts_per_second: float) -> None:
        self._require_ready()
        if not 0 < volts_per_second < math.inf:
            raise DeviceRefused(self._label, f"{volts_per_second:g} V/s is no ramp", "Give one above zero.")
        self._ramp = volts_per_second

    def set_current_limit(self, amperes: float) -> None:
        raise DeviceRefused(
            self._label,
            "this supply has no current limit that could be set",
            "Leave the current limit out of the scene, and limit the current with a resistor.",
        )

    def set_voltage(self, volts: float) -> None:
        self._require_ready()
        if not 0 <= volts <= self._max_volts:
            raise DeviceRefused(
                self._label,
                f"a set-point of {volts:g} V is outside its range",
                f"Allowed: 0 to {self._max_volts:g} V.",
            )
        if volts != round(volts):
            raise DeviceRefused(self._label, f"a set-point of {volts!r} V is no whole number", "Give whole volts.")
        if self._on and self._dialogue.idle:  # nothing is to be sent before the ramp's next step
            self._target, self._stepped_at = round(volts), None
        else:
            self._command(self._aim(round(volts)))

    def switch_on(self) -> None:
        """Switch on at 0 V; the output then ramps to the set-point."""
        self._require_ready()
        if self._emergency:
            raise DeviceRefused(
                self._label, "it is not switched on after an emergency off", "Find the cause, then clear."
            )
        self._command(self._switch_on())

    def switch_off(self) -> None:
        self._require_ready()
        self._dialogue.clear()  # nothing that was queued before may switch on after it
        self._commands = 0
        self._command(self._switch_off())

    def emergency_off(self) -> None:
        self._dialogue.clear()
        self._commands = 0
        self._emergency = True
        self._target = 0
        self._command(self._emergency_off())
        if not self._ready:
            self._dialogue.begin(self._set_up())

    def clear(self) -> None:
        self._emergency = False

    @property
    def given_back(self) -> bool:
        """Whether both modes are as they were found, read back."""
        return self._present == self.found

    def resume_found(self, found: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Another program found it so, and changed it."""
        self.found = {word: found[word] for word in MODES if word in found}
        self._present = {}
        return {word: (math.nan, value) for word, value in self.found.items()}

    def give_back(self) -> None:
        """Put both modes back; the output must be off, and is looked at once more afterwards."""
        if self._ready and not self.given_back:
            self._command(self._giving_back())

    def poll(self, now: float) -> Sequence[HVSample]:
        self._now = now
        try:
            self._inbox.extend(self._codec.feed(self._heard.bytes(self._link.read())))
            while self._inbox:
                if not self._dialogue.offer(self._inbox.popleft(), now):
                    self.counters["unexpected_replies"] += 1
            if self._ready and self._dialogue.idle and self._schedule.take(now):
                self._dialogue.begin(self._cycle())
            self._dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            if self._emergency:  # a line that gives nothing any more may still take something
                with suppress(DeviceError):
                    self._write_off()
            raise
        except DeviceError:
            self._next_poll = now
            raise
        due = self._schedule.due if self._dialogue.idle else math.inf
        self._next_poll = min(self._dialogue.next_poll(now), due)
        samples, self._samples = self._samples, []
        return samples

    def close(self) -> None:
        self._link.close()

    def _send(self, request: str) -> Callable[[str], bool]:
        self._link.write(encode(request))
        self._codec.asked()
        if request == "QVer":
            return lambda line: _VERSION.fullmatch(line) is not None
        if request == "QName":
            return lambda line: not (_VERSION.fullmatch(line) or _NUMBER.fullmatch(line))
        limit = PLAUSIBLE * self._max_volts if request == "QVnow" else math.inf
        return lambda line: self._is_number(line, limit)

    def _is_number(self, line: str, limit: float) -> bool:
        if not _NUMBER.fullmatch(line):
            return False
        if abs(int(line)) > limit:
            self.counters["implausible"] += 1
            return False
        return True

    def _ask(self, request: str) -> _Part[Answer[str]]:
        """The answer to a request that may be repeated, followed by the question whose answer is unlike any other."""
        for last in (False,) * (TRIES - 1) + (True,):
            try:
                answer = yield Ask(request, repeat=False)
            except DeviceSilent:
                if last:
                    raise
                self.counters["retries"] += 1
                yield Ask("QVer")
            else:
                yield Ask("QVer")
                return answer
        raise AssertionError("unreachable")

    def _number(self, request: str) -> _Part[int]:
        return int((yield from self._ask(request)).message)

    def _set(self, word: str, value: int) -> _Part[None]:
        """Set, and read back by another question."""
        yield from self._number(f"S{word} {value}")
        for _ in range(TRIES):
            read_back = yield from self._number(f"Q{word}")
            if read_back == value:
                return
        raise DeviceRefused(
            self._label,
            f"{word} reads back as {read_back} after {value} was set",
            "Check that no other program, button or external input controls it.",
        )

    def _confirmed(self, request: str, expected: int) -> _Part[int]:
        """The number as expected, or another one that was read twice."""
        seen = {expected}
        for _ in range(TRIES + 1):
            number = yield from self._number(request)
            if number in seen:
                return number
            self.counters["doubted"] += 1
            seen.add(number)
        raise DeviceRefused(
            self._label, f"{request} is answered differently each time", "Check cable, grounding and shielding."
        )

    def _set_up(self) -> Script[str, str]:
        kind, version = version_of((yield Ask("QVer", boot_s=self._boot_s)).message)
        if kind != "slave":
            raise DeviceRefused(
                self._label, f"it is a {kind}, not a single-channel supply", "Connect the supply itself."
            )
        name = (yield from self._ask("QName")).message
        max_volts = yield from self._number("QVmax")
        setpoint = yield from self._confirmed("QVset", 0)
        mode = yield from self._confirmed("QSwMode", OFF)
        needs_jack = yield from self._number("QPowJack")
        jack = yield from self._number("QJack")
        if not 0 < max_volts <= 20_000:
            raise DeviceRefused(self._label, f"it states a maximum of {max_volts} V", "Check its configuration.")
        self._jack_missing = bool(needs_jack) and not jack
        self._looks_at_jack = self._looks_at_jack and bool(needs_jack)
        self.identity = identity(name, version)
        self._max_volts = float(max_volts)
        self._setpoint = self._target = setpoint
        self._on = mode != OFF
        self.settings |= {
            "name": name,
            "firmware": version,
            "maximum_V": str(max_volts),
            "setpoint_at_setup_V": str(setpoint),
            "output_at_setup": "off" if mode == OFF else f"mode {mode}",
            "power_jack": "missing" if self._jack_missing else "in order",
        }
        self._schedule.start(self._now)
        self._ready = True

    def _cycle(self) -> Script[str, str]:
        stood = self._setpoint
        if self._on and self._setpoint != self._target:
            yield from self._step()
        answer = yield from self._ask("QVnow")
        self._setpoint = yield from self._confirmed("QVset", self._setpoint)
        mode = yield from self._confirmed("QSwMode", STEADY if self._on else OFF)
        self._on = mode != OFF
        low = float(answer.message) < min(stood, self._setpoint) - CLEARLY_BELOW_V
        asks = low and self._on and self._looks_at_jack
        if asks:
            with suppress(DeviceSilent):  # then nothing is known of it
                self._jack_missing = int((yield Ask("QJack", repeat=False)).message) == 0
        flags = HVFlag(0)
        if self._on:
            flags |= HVFlag.ON
        if self._on and self._setpoint != self._target:
            flags |= HVFlag.RAMPING
        if self._emergency:
            flags |= HVFlag.EMERGENCY_OFF
        if self._jack_missing:
            flags |= HVFlag.FAULT
        self._samples.append(HVSample(answer.t, float(answer.message), math.nan, float(self._setpoint), flags))
        if asks:
            yield Ask("QVer")  # as after each number; the sample does not wait for it

    def _step(self) -> _Part[None]:
        """Move the set-point towards the target by what the ramp allows since the last step; at least one volt."""
        if self._stepped_at is None:
            self._stepped_at = self._now
            return
        elapsed = min(self._now - self._stepped_at, LONGEST_STEP_S)
        room = max(1, int(self._ramp * elapsed))
        change = max(-room, min(room, self._target - self._setpoint))
        if room > self._ramp * elapsed:
            return  # not yet a volt's time
        self._stepped_at = self._now
        yield from self._set("Vset", self._setpoint + change)
        self._setpoint += change

    def _aim(self, volts: int) -> Script[str, str]:
        if not self._on:
            yield from self._set("Vset", 0)
            self._setpoint = 0
        self._target = volts
        self._stepped_at = None

    def _switch_on(self) -> Script[str, str]:
        if self._on:
            return
        if self._jack_missing:
            raise DeviceRefused(self._label, "its power jack is not plugged in", "Plug it in and start again.")
        yield from self._set("Vset", 0)
        for word in MODES:
            if self._looks_first and word not in self.found:
                self.found[word] = float((yield from self._confirmed(f"Q{word}", 0)))
            if word in self.found:
                self._present[word] = math.nan
            yield from self._set(word, 0)
            if word in self.found:
                self._present[word] = 0.0
        yield from self._set("SwMode", STEADY)
        self._setpoint, self._on = 0, True
        self._stepped_at = self._now

    def _giving_back(self) -> Script[str, str]:
        for word, value in self.found.items():
            yield from self._set(word, int(value))
            self._present[word] = value
        if (yield from self._number("QSwMode")) != OFF:
            for word in (*MODES, "SwMode"):
                yield from self._set(word, OFF)
            raise DeviceRefused(self._label, "it switched itself on when its modes were given back; off again", _UNSAFE)

    def _switch_off(self) -> Script[str, str]:
        self._target = 0
        self._stepped_at = self._now
        while self._on and self._setpoint > 0:
            yield from self._cycle()
        yield from self._set("SwMode", OFF)
        self._on = False

    def _emergency_off(self) -> Script[str, str]:
        try:
            self._write_off()
            # What was asked before may still be answered, by a version too; only the name comes after all that.
            yield Ask("QName")
            yield from self._set("SwMode", OFF)
            yield from self._set("Vset", 0)
        except DeviceError as error:
            raise type(error)(self._label, f"EMERGENCY OFF IS NOT CONFIRMED ({error.what})", _UNSAFE) from error
        self._on, self._setpoint = False, 0

    def _write_off(self) -> None:
        """Both are on their way before anything is waited for."""
        for request in ("SSwMode 0", "SVset 0"):
            self._link.write(encode(request))

    def _command(self, script: Script[str, str]) -> None:
        self._commands += 1
        self._dialogue.begin(self._tracked(script))
        self._next_poll = self._now

    def _tracked(self, script: Script[str, str]) -> Script[str, str]:
        try:
            yield from script
        finally:
            self._commands = max(0, self._commands - 1)

    def _require_ready(self) -> None:
        if not self._ready:
            raise DeviceRefused(self._label, "the supply is not set up yet", "Poll it until it is ready.")


def _ask(line: Line) -> list[Answered]:
    codec = Codec()

    def answer(question: str) -> str:
        return next(iter(line.ask(encode(question), codec.feed)), "")

    kind, version = version_of(answer("QVer"))
    if not version:
        return []
    found, maximum = identity(answer("QName"), version), answer("QVmax")
    if kind != "slave":
        return [Answered(found, {}, "A switchboard, no supply by itself.", usable=False)]
    remark = f"At most {maximum} V; measures no current." if maximum.isdecimal() else "Measures no current."
    return [Answered(found, {}, remark)]


class Board(Dialect):
    """Lines that end in CR."""

    def unknown(self, request: bytes) -> bytes:
        """Logs of earlier releases do not say what the modes were before they were set."""
        return b"0\r\n" if request in map(encode, (f"Q{word}" for word in MODES)) else b""


INSTRUMENTS = (
    Instrument(
        driver="shvps",
        role="hv",
        settings=ShvpsSettings,
        device=Shvps,
        dialect=Board(b"\r"),
        probe=SerialProbe(_ask, order=40),
    ),
)
