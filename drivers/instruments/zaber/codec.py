r"""Zaber linear stages (X-LSQ and relatives) over the Zaber ASCII protocol, 115200 baud 8N1.

A command is ``/1 1 07 move abs 2000:CC\n``: device, axis, message id, words, checksum. What comes back is sorted by
its first character: ``@`` a reply (``@01 1 07 OK BUSY -- 0:CC\r\n``), ``#`` info that follows a reply, ``!`` an alert
that may come at any time, also between a command and its reply. BUSY or IDLE is the state after the command was
accepted; the two letters that follow are the highest-priority warning flag, ``--`` for none. A packet that is too
long ends in ``\`` and goes on in ``#01 1 07 cont ...``.

The checksum is the negative sum, modulo 256, of the bytes between the first character and the colon. It shows every
change of a single byte; two changes that cancel each other pass it (one in 256 of random damage), so numbers are
also held to a strict grammar and replies to the message id that was asked.

Positions are whole microsteps. One microstep is the screw's travel per full motor step divided by the device's
``resolution``, which is read from the device; speeds are in units of 1/1.6384 microstep per second.

Source: Zaber ASCII Protocol Manual; flag and reject words as in zaber-motion and zproto.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from drivers.lines import LineSplitter

WARNINGS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "hardware emergency stop pressed",
    "FV": "supply over- or undervoltage, driver disabled",
    "FO": "driver disabled by command",
    "FC": "inrush current error, driver disabled",
    "FM": "motor too hot, driver disabled",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder lost synchronisation",
    "FR": "overdrive limit exceeded, driver disabled",
    "FS": "stalled and stopped",
    "FB": "stream left its bounds",
    "FP": "deviated from the path",
    "FE": "limit error",
    "FT": "excessive twist",
    "WL": "unexpected limit trigger",
    "WV": "supply voltage out of range",
    "WT": "controller hot",
    "WS": "stalled, recovered",
    "WM": "displaced while standing still",
    "WP": "calibration of the wrong type",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "manual control by the knob",
    "NI": "movement interrupted by another command",
    "ND": "stream ran dry",
    "NR": "value rounded",
    "NT": "value truncated",
    "NU": "setting takes effect later",
    "NJ": "joystick calibrating",
}
"""Warning flags; F is a fault (motion stopped or refused), W a warning, N a note."""

POWER_CYCLE = "Remove the cause; if the flag stays, power-cycle the stage."
FAULT_ADVICE = {
    "FZ": "Another stage is plugged into this axis than was activated last. If two are swapped, put them back. If this "
    "one is meant, activate it in the maker's software (`activate`), which may set speed, limits and resolution anew; "
    "give its full_step_um in the scene, and start again.",
    "FN": "The controller's firmware does not know the stage that is plugged in: update the firmware.",
}
"""What to do about a fault that power-cycling does not end."""

UNREFERENCED = frozenset({"WR", "WH"})

REJECTIONS = {
    "BADCOMMAND": ("it does not know the command", "Check the firmware version; the command may need a newer one."),
    "BADDATA": ("a value is out of range", "Keep the position within the travel and the speed below the maximum."),
    "BADAXIS": ("it has no such axis", "Check `axis` in the scene."),
    "BADMESSAGEID": ("the message id was not understood", "Check the line for noise."),
    "STATUSBUSY": ("it cannot do that while moving", "Wait until it stands still."),
    "DEVICEONLY": ("the command is for the device, not an axis", "This is a fault of the driver: report it."),
    "AXISONLY": ("the command is for an axis, not the device", "This is a fault of the driver: report it."),
    "NOACCESS": ("the command needs a higher access level", "Set system.access in the maker's software."),
    "INACTIVE": (
        "the axis is inactive",
        "Plug in what was activated, or activate this one in the maker's software.",
    ),
    "NOTSUPPORTED": ("the command is not supported on this stage", "Check the stage's model."),
    "DRIVERDISABLED": ("the motor driver is disabled", "Look for a fault flag, remove its cause, and power-cycle it."),
    "LONGWORD": ("a word of the command is too long", "This is a fault of the driver: report it."),
    "CYCLICONLY": ("the command is for rotary stages", "Check the stage's model."),
    "BADSPLIT": ("a continued command was broken", "Check the line for noise."),
    "PARKED": ("the stage is parked", "Unpark it in the maker's software, or home it."),
    "REMOTE": ("the stage is under remote control", "End the other program that controls it."),
    "FULL": ("its storage is full", "Free space in the maker's software."),
    "AGAIN": ("it is busy at the moment", "Try again."),
}
"""Why a command was rejected, and what to do."""

VELOCITY_UNIT = 1.6384  # velocity data per microstep/s; acceleration data per 10 000 microsteps/s^2

_MAX_LINE = 512  # devices send 80 characters a packet; settings raise that to some hundred
_MAX_PARTS = 16
_CHECKSUMMED = re.compile(r"(.*):([0-9A-F]{2})", re.DOTALL)
_REPLY = re.compile(r"([0-9]{2}) ([0-9])(?: ([0-9]{2}))? (OK|RJ) (BUSY|IDLE) (--|[A-Z]{2}) (.+)")
_ALERT = re.compile(r"([0-9]{2}) ([0-9]) (BUSY|IDLE) (--|[A-Z]{2})(?: (.*))?")
_INFO = re.compile(r"([0-9]{2}) ([0-9])(?: ([0-9]{2})(?= ))? (.*)")
WHOLE = re.compile(r"-?[0-9]{1,10}")
FLAGS = re.compile(r"([0-9]{2})((?: [A-Z]{2})*)")


@dataclass(frozen=True, slots=True)
class Reply:
    """``@``: the answer to one command. ``id`` is None when the command carried none."""

    device: int
    axis: int
    id: int | None
    accepted: bool
    busy: bool
    warning: str
    data: str


@dataclass(frozen=True, slots=True)
class Info:
    """``#``: text that follows a reply."""

    device: int
    axis: int
    id: int | None
    text: str


@dataclass(frozen=True, slots=True)
class Alert:
    """``!``: sent by the device on its own, when motion ends or a warning appears."""

    device: int
    axis: int
    busy: bool
    warning: str
    data: str


Message = Reply | Info | Alert


def checksum(text: bytes) -> int:
    """Longitudinal redundancy check of what stands between the first character and the colon."""
    return -sum(text) & 0xFF


def encode(device: int, axis: int, message_id: int, words: str) -> bytes:
    """A command with message id and checksum, e.g. ``/1 0 00 get pos:2D``; without words it asks for the state."""
    text = f"{device} {axis} {message_id:02d}" + (f" {words}" if words else "")
    return f"/{text}:{checksum(text.encode('ascii')):02X}\n".encode("ascii")


class Codec:
    """Bytes from the stage to messages.

    A line with a wrong checksum, or that fits no grammar, is dropped and counted. Lines without a checksum are taken
    only until the first one with a valid checksum has been seen: from then on the device is known to send them. Alerts
    count for themselves: a device may send checksums only in reply to a command that had one.

    ``counters``: ``bad_checksum``, ``without_checksum`` (dropped for it), ``bad_grammar``, ``too_long``,
    ``lost_continuation`` (packets whose rest never came, or the rest of a packet never seen).
    """

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        for key in ("bad_checksum", "without_checksum", "bad_grammar", "lost_continuation"):
            self.counters.setdefault(key, 0)
        self.checksums_seen = self._alert_checksums_seen = False
        self._lines = LineSplitter(b"\n", _MAX_LINE, self.counters)
        self._unfinished: dict[tuple[int, int, int | None], list[Reply | Info]] = {}

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes, in order."""
        messages = (self._line(line.removesuffix(b"\r")) for line in self._lines.feed(data))
        return [message for message in messages if message is not None]

    def _line(self, line: bytes) -> Message | None:
        if not line:
            return None
        text = line.decode("ascii", "replace")
        if not (text.isascii() and text.isprintable()):
            self.counters["bad_grammar"] += 1
            return None
        kind, body = text[0], text[1:]
        checked = _CHECKSUMMED.fullmatch(body)
        if checked:
            body = checked[1]
            if checksum(body.encode("ascii")) != int(checked[2], 16):
                self.counters["bad_checksum"] += 1
                return None
        elif self._alert_checksums_seen if kind == "!" else self.checksums_seen:
            self.counters["without_checksum"] += 1
            return None
        to_be_continued = body.endswith("\\")
        message = _parse(kind, body.removesuffix("\\"))
        if message is None or (to_be_continued and isinstance(message, Alert)):
            self.counters["bad_grammar"] += 1
            return None
        if isinstance(message, Alert):
            self._alert_checksums_seen |= checked is not None
            return message
        self.checksums_seen |= checked is not None
        if isinstance(message, Info) and message.text.startswith("cont "):
            return self._next_part(message, to_be_continued)
        return self._first_part(message, to_be_continued)

    def _first_part(self, message: Reply | Info, to_be_continued: bool) -> Message | None:
        key = (message.device, message.axis, message.id)
        if self._unfinished.pop(key, None) is not None:
            self.counters["lost_continuation"] += 1
        if not to_be_continued:
            return message
        if len(self._unfinished) >= _MAX_PARTS:
            del self._unfinished[next(iter(self._unfinished))]
            self.counters["lost_continuation"] += 1
        self._unfinished[key] = [message]
        return None

    def _next_part(self, part: Info, to_be_continued: bool) -> Message | None:
        key = (part.device, part.axis, part.id)
        parts = self._unfinished.get(key)
        if parts is None or len(parts) >= _MAX_PARTS:
            self._unfinished.pop(key, None)
            self.counters["lost_continuation"] += 1
            return None
        parts.append(part)
        if to_be_continued:
            return None
        del self._unfinished[key]
        text = " ".join([_text(parts[0]), *(_text(part).removeprefix("cont ") for part in parts[1:])])
        first = parts[0]
        return replace(first, data=text) if isinstance(first, Reply) else replace(first, text=text)


def _parse(kind: str, body: str) -> Message | None:
    if kind == "@" and (match := _REPLY.fullmatch(body)):
        device, axis, message_id, verdict, state, warning, data = match.groups()
        return Reply(
            int(device), int(axis), _whole_or_none(message_id), verdict == "OK", state == "BUSY", warning, data
        )
    if kind == "#" and (match := _INFO.fullmatch(body)):
        device, axis, message_id, text = match.groups()
        return Info(int(device), int(axis), _whole_or_none(message_id), text)
    if kind == "!" and (match := _ALERT.fullmatch(body)):
        device, axis, state, warning, data = match.groups()
        return Alert(int(device), int(axis), state == "BUSY", warning, data or "")
    return None


def _whole_or_none(digits: str | None) -> int | None:
    return None if digits is None else int(digits)


def _text(part: Reply | Info) -> str:
    return part.data if isinstance(part, Reply) else part.text
