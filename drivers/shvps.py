"""Single-channel HV supply of the Peta-pico-Voltron project (shvps), as used in DEA laboratories: text on 115200 8N1.

A command ends with CR, and every command is answered with one line: a query with the value, a setting with the value
that now holds, anything else with ``Err``. Volts are whole numbers. Used here::

    QVer -> slave 8      kind ("slave" is the single-channel supply) and firmware    QName -> its name
    QVmax                rating                   QVset, SVset n    set-point        QVnow      measured voltage
    QSwMode, SSwMode n   0 off, 1 DC, 2 switching between 0 and set-point, 3 waveform
    QSwSrc, SSwSrc n     what switches: 0 the board, 1 an input, 2 the push button
    QVMode, SVMode n     0 regulated, 1 by a control voltage, 2 open loop
    QPowJack, QJack      whether power is to come from the jack, and whether it is plugged in

Sources: petapicovoltron.com, "Direct communication with the HVPS"; hvps.py 2.8 of the same project.

What this supply lacks
    It measures no current and has no current limit but what its converter can give; it has no ramp, no trip, no latched
    emergency off and no watchdog: when the host dies, the voltage stays. The driver makes ramp and latch itself, out of
    steps at its poll rate, and reports the current as NaN. There is no checksum: a digit lost or changed on the line is
    a wrong number, noticed only where it answers a setting or exceeds the rating. Answers do not name their command,
    so after one that had to be repeated the line must stay quiet for one timeout before the next.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from drivers.dialogue import Answer, Ask, Dialogue
from drivers.link import ByteLink, DeviceError, DeviceRefused
from drivers.roles import HVFlag, HVSample, Identity

T = TypeVar("T")

OFF, DC = 0, 1
ONBOARD = 0
REGULATED = 0

MAX_LINE = 80
_NUMBER = re.compile(rb"[0-9]{1,5}")
_PRINTABLE = re.compile(rb"[ -~]*")
_ATTEMPTS = 3


class Decoder:
    """Bytes to lines. Never raises; holds back less than `MAX_LINE` bytes.

    Lines end with CR, LF or both. Counters: ``dropped_bytes``, of lines that are too long or not printable ASCII.
    """

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("dropped_bytes", 0)
        self._buffer = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """Lines completed by ``data``, without their ends; empty ones are left out."""
        *lines, rest = (self._buffer + data).replace(b"\n", b"\r").split(b"\r")
        good = []
        for line in lines:
            if self._overlong or len(line) > MAX_LINE or not _PRINTABLE.fullmatch(line):
                self.counters["dropped_bytes"] += len(line)
                self._overlong = False
            elif line:
                good.append(line)
        if self._overlong or len(rest) > MAX_LINE:
            self.counters["dropped_bytes"] += len(rest)
            self._overlong, rest = True, b""
        self._buffer = rest
        return good


def encode(command: str, value: int | None = None) -> bytes:
    """One command with its end."""
    return (command if value is None else f"{command} {value}").encode("ascii") + b"\r"


@dataclass(frozen=True, slots=True)
class _Request:
    data: bytes
    number: bool = True  # what a good answer looks like

    def __str__(self) -> str:
        return self.data.decode("ascii").strip().replace("\r", ", ")


Script = Generator[Ask[_Request], Answer[bytes], T]


class SHVPS:
    """The supply as an `drivers.roles.HVSupply`.

    Set-up only asks. ``set_voltage`` names where the set-point is to go; it goes there in steps at ``poll_rate_Hz``
    once the channel is on. ``switch_off`` takes it down the same way and then switches off. ``emergency_off`` switches
    off at once and is remembered until `clear`. A channel that is found off though it was switched on (a reset, a
    button) shows as ``TRIPPED`` until `clear` and is not switched on again by itself.

    Parameters
    ----------
    poll_rate_Hz : float
        Samples per second, and steps of the ramp.
    timeout_s : float
        How long to wait for each answer.
    ramp_V_per_s : float
        Ramp until `set_ramp` says otherwise.
    max_current_A : float, optional
        What the converter can give at most, from its data sheet. The supply neither limits nor measures current; a
        limit is accepted only if the supply could not exceed it anyway.
    """

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        poll_rate_Hz: float = 10.0,
        timeout_s: float = 0.25,
        ramp_V_per_s: float = 200.0,
        max_current_A: float | None = None,
    ) -> None:
        if not 0 < poll_rate_Hz <= 100:
            raise DeviceRefused(name, f"poll rate {poll_rate_Hz} Hz is not possible", "Allowed: above 0, at most 100.")
        if max_current_A is not None and not 0 < max_current_A <= 1:
            raise DeviceRefused(name, f"a converter of {max_current_A} A is not possible", "Allowed: above 0 to 1 A.")
        self.name = name
        self.identity = Identity(model="shvps")
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"unexpected_answers": 0, "refused_answers": 0, "bad_values": 0}
        self._link = link
        self._period = 1.0 / poll_rate_Hz
        self._timeout = timeout_s
        self._nominal = (math.nan, math.nan if max_current_A is None else max_current_A)
        self._decoder = Decoder(self.counters)
        self._dialogue: Dialogue[_Request, bytes] = Dialogue(name, self._transmit, self.counters, timeout_s=timeout_s)
        self._settle_s = 0.0
        self._ready = False
        self._on = False  # whether we switched it on
        self._leaving = False  # on the way down to be switched off
        self._target = 0.0
        self._latched = HVFlag(0)
        self._commands = 0
        self._bad_in_a_row = 0
        self._stepped = -math.inf
        self._samples: list[HVSample] = []
        self._next_cycle = -math.inf
        self._next_poll = -math.inf
        self.set_ramp(ramp_V_per_s)

    # -- role -------------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def nominal(self) -> tuple[float, float]:
        """(rated volts, amperes as stated by the user); NaN where not known."""
        return self._nominal

    @property
    def busy(self) -> bool:
        return self._commands > 0

    def set_ramp(self, volts_per_second: float) -> None:
        if not 0 < volts_per_second <= 1e5:
            raise DeviceRefused(
                self.name, f"a ramp of {volts_per_second:g} V/s is not possible", "Allowed: above 0, at most 1e5 V/s."
            )
        self._ramp = volts_per_second
        self.settings["ramp_V_per_s"] = f"{volts_per_second:.9g}"

    def set_current_limit(self, amperes: float) -> None:
        limit = self._nominal[1]
        if not (amperes >= limit):
            stated = "is not stated" if math.isnan(limit) else f"is {limit:g} A"
            raise DeviceRefused(
                self.name,
                f"cannot limit its current to {amperes:g} A; what its converter can give {stated}",
                "State max_current_A, or put a limiting resistor in and state what it lets through.",
            )

    def set_voltage(self, volts: float) -> None:
        self._require_ready("set the voltage")
        if not 0.0 <= volts <= self._nominal[0]:
            raise DeviceRefused(
                self.name,
                f"a set-point of {volts:g} V is outside the supply's range",
                f"Allowed: 0 to {self._nominal[0]:g} V.",
            )
        if volts != round(volts):
            raise DeviceRefused(self.name, f"a set-point of {volts:g} V is no whole number", "It knows whole volts.")
        self._target = volts
        self._command(self._cycle())

    def switch_on(self) -> None:
        self._require_ready("switch on")
        if self._latched:
            raise DeviceRefused(
                self.name, f"is not switched on while {_names(self._latched)} is latched", "Find the cause, then clear."
            )
        self._command(self._switch_on())

    def switch_off(self) -> None:
        self._leaving = True
        self._command(self._cycle())

    def emergency_off(self) -> None:
        self._dialogue.clear()
        self._commands = 0
        self._on = self._leaving = False
        self._latched |= HVFlag.EMERGENCY_OFF
        self._settle_s = 0.0  # it waits for nothing
        self._command(self._emergency_off())

    def clear(self) -> None:
        self._command(self._clear())

    def close(self) -> None:
        self._link.close()

    # -- polling ----------------------------------------------------------------------------------------------------

    def poll(self, now: float) -> Sequence[HVSample]:
        for line in self._decoder.feed(self._link.read()):
            if not self._dialogue.offer(line, now):
                self.counters["unexpected_answers"] += 1
        if self._dialogue.idle:
            if not self._ready:
                self._dialogue.begin(self._set_up())
            elif now >= self._next_cycle:
                beat = self._next_cycle + self._period
                self._next_cycle = beat if beat > now else now + self._period
                self._dialogue.begin(self._cycle())
        try:
            self._dialogue.run(now)
        finally:
            self._next_poll = self._next_cycle if self._dialogue.idle else self._dialogue.next_poll(now)
        samples, self._samples = self._samples, []
        return samples

    def _command(self, script: Script[None]) -> None:
        self._commands += 1
        self._dialogue.begin(self._tracked(script))
        self._next_poll = -math.inf

    def _tracked(self, script: Script[None]) -> Script[None]:
        try:
            yield from script
        except DeviceError:
            self._dialogue.clear()
            self._commands = 0
            raise
        finally:
            self._commands = max(0, self._commands - 1)

    def _require_ready(self, what: str) -> None:
        if not self._ready:
            raise DeviceRefused(self.name, f"cannot {what} before the set-up dialogue has ended", "Poll it first.")

    def _transmit(self, request: _Request) -> Callable[[bytes], bool]:
        self._link.write(request.data)
        if not request.number:
            return lambda line: True
        return lambda line: line == b"Err" or _NUMBER.fullmatch(line) is not None

    # -- dialogue ---------------------------------------------------------------------------------------------------

    def _ask(self, request: _Request, *, delay_s: float = 0.0) -> Script[tuple[bytes, float]]:
        """(line, time)."""
        delay_s, self._settle_s = max(delay_s, self._settle_s), self._timeout  # in case this one goes wrong
        retries = self.counters["retries"]
        answer = yield Ask(request, delay_s=delay_s)
        if self.counters["retries"] == retries:
            self._settle_s = 0.0
        if answer.message == b"Err":
            self.counters["refused_answers"] += 1
            raise DeviceRefused(self.name, f"does not understand {str(request)!r}", "Its firmware may be too old.")
        return answer.message, answer.t

    def _number(self, command: str, value: int | None = None, *, delay_s: float = 0.0) -> Script[int]:
        line, _ = yield from self._ask(_Request(encode(command, value)), delay_s=delay_s)
        return int(line)

    def _write(self, command: str, value: int) -> Script[None]:
        """Set; the answer says what holds now."""
        for _ in range(_ATTEMPTS):
            if (read_back := (yield from self._number(command, value))) == value:
                return
        raise DeviceRefused(
            self.name,
            f"answers {read_back} to '{command} {value}'",
            "It does not accept the value: check its settings.",
        )

    def _set_up(self) -> Script[None]:
        version, _ = yield from self._ask(_Request(encode("QVer"), number=False))
        kind, _, firmware = version.decode("ascii").partition(" ")
        if kind != "slave":
            raise DeviceRefused(
                self.name, f"is no single-channel supply: it calls itself {kind!r}", "Check the port in the scene."
            )
        label, _ = yield from self._ask(_Request(encode("QName"), number=False))
        self.identity = Identity(model="shvps", serial=label.decode("ascii"), firmware=firmware)
        rating = yield from self._number("QVmax")
        if not 0 < rating <= 20_000:
            raise DeviceRefused(self.name, f"states a rating of {rating} V", "Check the instrument.")
        setpoint = yield from self._number("QVset")
        mode = yield from self._number("QSwMode")
        source = yield from self._number("QSwSrc")
        control = yield from self._number("QVMode")
        self._jack = bool((yield from self._number("QPowJack")))
        self._nominal = (float(rating), self._nominal[1])
        self.settings |= {
            "nominal_voltage_V": str(rating),
            "setpoint_at_setup_V": str(setpoint),
            "channel_at_setup": "off" if mode == OFF else "on",
            "switching_source": str(source),
            "voltage_control": str(control),
        }
        self._ready = True

    def _cycle(self) -> Script[None]:
        line, t = yield from self._ask(_Request(encode("QVnow")))
        setpoint = yield from self._number("QVset")
        mode = yield from self._number("QSwMode")
        plugged = not self._jack or bool((yield from self._number("QJack")))
        if self._on and mode == OFF:
            self._on = self._leaving = False
            self._latched |= HVFlag.TRIPPED
        if not (int(line) <= 1.2 * self._nominal[0] and setpoint <= self._nominal[0]):
            self.counters["bad_values"] += 1
            self._bad_in_a_row += 1
            if self._bad_in_a_row < _ATTEMPTS:
                return
            raise DeviceRefused(
                self.name,
                f"reports {int(line)} V with a set-point of {setpoint} V, beyond its rating of {self._nominal[0]:g} V",
                "Switch off by hand and check the supply.",
            )
        self._bad_in_a_row = 0
        flags = self._latched
        if mode != OFF:
            flags |= HVFlag.ON
        if not plugged:
            flags |= HVFlag.FAULT
        goal = 0.0 if self._leaving else self._target
        if (self._on or self._leaving) and mode != OFF and setpoint != goal:
            flags |= HVFlag.RAMPING
        self._samples.append(HVSample(t, float(int(line)), math.nan, float(setpoint), flags))
        if self._leaving:
            yield from self._go_down(mode, setpoint, t)
        elif self._on and setpoint != goal:
            yield from self._step(setpoint, goal, t)

    def _step(self, setpoint: int, goal: float, t: float) -> Script[None]:
        """One step of the ramp: as far as the time since the last one allows, but no leap after a long pause."""
        elapsed = min(t - self._stepped, max(2 * self._period, 1.0 / self._ramp))
        reach = self._ramp * elapsed
        if reach < 1.0:
            return
        self._stepped = t
        step = min(reach, goal - setpoint) if goal > setpoint else -min(reach, setpoint - goal)
        yield from self._write("SVset", setpoint + int(step))

    def _go_down(self, mode: int, setpoint: int, t: float) -> Script[None]:
        if mode != OFF and setpoint > 0:
            yield from self._step(setpoint, 0.0, t)
            return
        self._on = self._leaving = False
        self._target = 0.0
        if mode != OFF:
            yield from self._write("SSwMode", OFF)

    def _switch_on(self) -> Script[None]:
        mode = yield from self._number("QSwMode")
        if mode == OFF:
            # From nothing, by its own regulator, at once: a stored set-point must not jump to the output.
            yield from self._write("SVset", 0)
            yield from self._write("SSwSrc", ONBOARD)
            yield from self._write("SVMode", REGULATED)
            yield from self._write("SSwMode", DC)
        elif mode != DC:
            raise DeviceRefused(self.name, "is already on, but not with a constant voltage", "Switch it off first.")
        self._on, self._leaving = True, False

    def _emergency_off(self) -> Script[None]:
        off = _Request(encode("SSwMode", OFF) + encode("SVset", 0), number=False)
        error: DeviceError | None = None
        for _ in range(_ATTEMPTS):
            try:
                # The next line may still answer what was asked before; only a fresh question shows the state.
                yield Ask(off)
                if (yield from self._number("QSwMode", delay_s=self._timeout)) == OFF:
                    self._target = 0.0
                    return
            except DeviceError as failed:
                error = failed
        what = error.what if error is not None else "it still says that it is on"
        raise DeviceRefused(
            self.name,
            f"EMERGENCY OFF IS NOT CONFIRMED ({what})",
            "Take the high voltage away by hand: pull the supply's plug, then ground the electrodes.",
        )

    def _clear(self) -> Script[None]:
        yield from self._write("SSwMode", OFF)
        yield from self._write("SVset", 0)
        self._on = self._leaving = False
        self._target = 0.0
        self._latched = HVFlag(0)


def _names(flags: HVFlag) -> str:
    return " ".join(str(flag.name) for flag in flags)
