"""Zaber linear stages (X-LSQ and relatives) on the ASCII protocol: keys in a scene, how one is found and replayed."""

from __future__ import annotations

import re
from collections import Counter
from typing import Literal

from pydantic import Field

from drivers.instrument import Instrument
from drivers.instruments.zaber.codec import Codec, Reply, checksum, encode
from drivers.instruments.zaber.device import ZaberStage
from drivers.probe import Answered, Line, SerialProbe
from drivers.recorded import Dialect, Exchange
from drivers.roles import Identity
from drivers.settings import Positive, SerialSettings, StageSettings

NEAR_STEPS = 20
"""By which the place of a motion may differ when a log is served, about 10 um: it follows from readings."""

_REQUEST = re.compile(rb"/(\d+ \d+) (\d+) ?([^:\n]*)(?::[0-9A-F]{2})?\r?\n")
_REPLY = re.compile(rb"@(\d+ \d+) (\d+)([^:\r\n]*)(:[0-9A-F]{2})?\r\n")
_MOTION = re.compile(rb"(\d+ \d+ move abs) (-?\d+)")
_HALT = re.compile(rb"\d+ \d+ (?:stop|move abs -?\d+)")


class ZaberSettings(StageSettings, SerialSettings):
    """A Zaber stage on its ASCII protocol."""

    driver: Literal["zaber"] = Field(description="Zaber stage, ASCII protocol on a serial port.")
    device: int = Field(default=1, ge=1, le=99, description="Address of the device on the line.")
    axis: int = Field(default=1, ge=1, le=9, description="Axis of the device; 1 for stages with a built-in controller.")
    full_step_um: Positive | None = Field(
        default=None,
        description="Travel per full motor step (um): screw pitch over steps a turn; no device states it. 31.75 is a "
        "6.35 mm screw over 200 steps (LSQ..B). Absent: that of the X-LSQ150B; any other stage is refused.",
    )
    peripheral_id: int | None = Field(
        default=None,
        ge=0,
        description="Id of the stage that must be plugged into this axis of a controller. Absent: any. `serial` is "
        "that stage's own where it states one.",
    )


def _ask(line: Line) -> list[Answered]:
    codec = Codec()
    replies = [m for m in line.ask(encode(0, 0, 0, ""), codec.feed) if isinstance(m, Reply) and m.id == 0]
    devices = Counter(reply.device for reply in replies)
    return [
        _identified(line, codec, device) if count == 1 else _confused(line, codec, device)
        for device, count in sorted(devices.items())
    ]


def _confused(line: Line, codec: Codec, device: int) -> Answered:
    """Several devices with one address: each command is carried out by all of them."""
    replies = [m for m in line.ask(encode(device, 0, 1, "get system.serial"), codec.feed) if isinstance(m, Reply)]
    serials = [reply.data for reply in replies if (reply.device, reply.id) == (device, 1) and reply.accepted]
    return Answered(
        Identity("Zaber devices", " ".join(serials)),
        {},
        f"{max(len(serials), 2)} devices have address {device} and would move together. "
        f"dea-rig devices --renumber {line.port} gives each an address of its own.",
        usable=False,
    )


def _renumber(line: Line) -> bool:
    """Addresses by place on the line, the nearest to the computer first."""
    codec = Codec()
    if not any(isinstance(m, Reply) for m in line.ask(encode(0, 0, 0, ""), codec.feed)):
        return False
    for data in (encode(0, 0, 1, "renumber"), b"", b"", b""):  # it takes half a second and more
        for _ in line.ask(data, codec.feed):
            pass
    return True


def _identified(line: Line, codec: Codec, device: int) -> Answered:
    answers = []
    for number, words in enumerate(("get deviceid", "get system.serial", "get version"), start=1):
        expected = (device, 0, number)
        answer = ""
        for message in line.ask(encode(device, 0, number, words), codec.feed):
            if isinstance(message, Reply) and (message.device, message.axis, message.id) == expected:
                answer = message.data if message.accepted else ""
                break
        answers.append(answer)
    device_id, serial, version = answers
    return Answered(
        Identity(f"Zaber device {device_id}".rstrip(), serial, version), {"serial": serial, "device": device}
    )


class NumberedLines(Dialect):
    """Requests are numbered, and the answer bears the number; both may end in a checksum."""

    def key(self, request: bytes) -> bytes:
        match = _REQUEST.fullmatch(request)
        return request if match is None else match[1] + b" " + match[3]

    def alike(self, then: bytes, now: bytes) -> bool:
        one, other = _MOTION.fullmatch(then), _MOTION.fullmatch(now)
        if one is None or other is None:
            return then == now
        return one[1] == other[1] and abs(int(one[2]) - int(other[2])) <= NEAR_STEPS

    def replaces(self, earlier: bytes, later: bytes) -> bool:
        return _MOTION.fullmatch(earlier) is not None and _HALT.fullmatch(later) is not None

    def anew(self, exchange: Exchange, request: bytes) -> tuple[tuple[float, bytes], ...]:
        then, now = _REQUEST.fullmatch(exchange.request.data), _REQUEST.fullmatch(request)
        if then is None or now is None or not exchange.answers:
            return exchange.answers

        def renumber(match: re.Match[bytes]) -> bytes:
            number = now[2] if match[2] == then[2] else match[2]
            text = match[1] + b" " + number + match[3]
            return b"@" + text + (b":%02X" % checksum(text) if match[4] else b"") + b"\r\n"

        whole = b"".join(data for _, data in exchange.answers)
        return ((exchange.answers[-1][0], _REPLY.sub(renumber, whole)),)


INSTRUMENTS = (
    Instrument(
        driver="zaber",
        role="stage",
        settings=ZaberSettings,
        device=ZaberStage,
        dialect=NumberedLines(b"\n"),
        probe=SerialProbe(_ask, bauds=(115_200, 9_600), order=10, renumber=_renumber),
    ),
)
