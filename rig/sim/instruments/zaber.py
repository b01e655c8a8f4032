"""A Zaber X-LSQ150B-E01 linear stage that speaks the Zaber ASCII protocol (firmware 7), byte for byte.

Commands ``/[device [axis [id]]] words[:CC]``, replies ``@DD A [id] OK|RJ BUSY|IDLE WW data``, info lines ``#..``,
alerts ``!..``. ``CC`` is the two's complement of the sum of the bytes after the first, as two hex digits; a command
whose checksum is wrong is ignored, and one that carried a checksum is answered with one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

from pydantic import Field

from rig.sim.path import trapezoid
from rig.sim.truth import Fault, LineTruth, Positive, StageTruth
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

DATA_PER_STEP = 1.6384  # speed settings: 1.6384 per microstep/s; acceleration: per 10 000 microsteps/s^2
FULL_STEP_UM = 6350 / 200  # 6.35 mm screw, 200 steps a turn
ENCODER_COUNT_M = 0.5e-6  # of its encoder
PACKET_SIZE = 80  # characters of a reply line, longer ones continue
ANSWER_S = 0.5e-3

# Warning flags, highest priority first: faults, warnings, notes.
FLAGS = (
    *("FF", "FN", "FZ", "FH", "FV", "FO", "FC", "FM", "FD", "FQ", "FI", "FA", "FR", "FS", "FB", "FP", "FE", "FT"),
    *("WL", "WV", "WT", "WS", "WM", "WP", "WR", "WH"),
    *("NC", "NI", "ND", "NR", "NT", "NU", "NJ"),
)

COMMAND = re.compile(rb"^/(?P<body>[^:]*)(?::(?P<check>[0-9A-F]{2}))?$")


def checksum(body: bytes) -> bytes:
    """LRC of the packet's bytes between its first character and the colon."""
    return b"%02X" % (-sum(body) & 0xFF)


class ZaberTruth(StageTruth, LineTruth):
    """Zaber X-LSQ150B-E01 on ASCII."""

    means_nothing: ClassVar[Mapping[str, str]] = {"saturate": "a position ends at the travel's limits"}

    driver: Literal["zaber"] = Field(default="zaber", description="Zaber stage.")
    serial_number: int = Field(default=50_443, description="Serial number that it states.")
    device_address: int = Field(default=1, ge=1, le=99, description="Its address on the line.")
    microstep_um: Positive = Field(default=0.49609375, description="Travel per microstep (um).")
    travel_mm: Positive = Field(default=151.498, description="Its travel (mm).")
    referenced_at_start: bool = Field(default=False, description="Whether it is homed at power-up.")
    default_speed_mm_per_s: Positive = Field(default=20.0, description="Its speed setting at power-up (mm/s).")
    max_speed_mm_per_s: Positive = Field(default=100.0, description="Largest speed that it can be set to (mm/s).")
    acceleration_mm_per_s2: Positive = Field(default=200.0, description="Its acceleration setting (mm/s^2).")
    homing_speed_mm_per_s: Positive = Field(default=10.0, description="Speed at which it homes (mm/s).")
    reboot_s: Positive = Field(default=0.5, description="How long it is silent after power comes back (s).")
    unhomed_reject: str = Field(default="BADDATA", description="Reject word for a move before homing.")
    axes: int = Field(default=1, ge=1, le=9, description="How many axes it has; the disk is on the first.")
    checksums_when_set: bool = Field(
        default=False, description="Whether only its setting comm.checksum makes it answer with checksums."
    )


class ZaberStage:
    """One device with one axis.

    Attributes
    ----------
    wrong_status : str or None
        A fault: this flag is shown as the highest warning, whatever is true.
    before_reply : callable or None
        A fault: called with the time before each reply is sent.
    """

    def __init__(self, settings: ZaberTruth, world: World, wire: ByteWire) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._line = bytearray()
        self._settled = math.inf  # when the motion under way ends
        self._after: Literal["home", "move", "stop"] = "move"
        self._asleep_until = -math.inf
        self._frozen_at: int | None = None
        self._parked = False  # these two in non-volatile memory
        self._stored: dict[int, dict[str, str]] = {}
        self.wrong_status: str | None = None
        self.before_reply: Callable[[float], None] | None = None
        s = settings
        step = s.microstep_um * 1e-3  # mm
        self._limits = {
            "maxspeed": (1, self._speed_data(s.max_speed_mm_per_s)),
            "accel": (1, 32_767),
            "limit.approach.maxspeed": (1, self._speed_data(s.max_speed_mm_per_s)),
            "limit.min": (-1_000_000_000, 1_000_000_000),
            "limit.max": (-1_000_000_000, 1_000_000_000),
            "comm.alert": (0, 1),
            "comm.checksum": (0, 1),
            "knob.enable": (0, 1),
            "comm.address": (1, 99),
        }
        self._values = {  # kept in non-volatile memory
            "maxspeed": self._speed_data(s.default_speed_mm_per_s),
            "accel": max(1, round(s.acceleration_mm_per_s2 / step * DATA_PER_STEP / 1e4)),
            "limit.approach.maxspeed": self._speed_data(s.homing_speed_mm_per_s),
            "limit.min": 0,
            "limit.max": math.floor(s.travel_mm / step),
            "comm.alert": 0,
            "comm.checksum": 0,
            "knob.enable": 1,
            "comm.address": s.device_address,
        }
        # Of the axes that drive nothing: what can be set of each by itself.
        own = {name: value for name, value in self._values.items() if not name.startswith("comm.")}
        self.others = [dict(own) for _ in range(s.axes - 1)]
        self._power_up(0.0)
        if settings.referenced_at_start:
            self._origin = 0.0
            self._flags.clear()

    def _power_up(self, t: float) -> None:
        self._driver_on = True
        self._origin = self._world.stage.at(t)[0]  # what it takes for zero until it is homed
        self._flags = {"WR", "WH"}
        self._line.clear()

    def _speed_data(self, mm_per_s: float) -> int:
        return max(1, round(mm_per_s / (self._settings.microstep_um * 1e-3) * DATA_PER_STEP))

    # Where it is

    @property
    def _step(self) -> float:
        return self._settings.microstep_um * 1e-6

    def position(self, t: float) -> int:
        """The position it reports (microsteps)."""
        if self._frozen_at is not None:
            return self._frozen_at
        return round((self._world.stage.at(t)[0] - self._origin) / self._step)

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: from now on always report the position of time ``t``."""
        self._frozen_at = None
        if frozen:
            self._frozen_at = self.position(t)

    def busy(self, t: float) -> bool:
        return t < self._settled < math.inf

    # Time

    @property
    def next_time(self) -> float:
        return self._settled

    def advance(self, t: float) -> None:
        if self._settled <= t:
            ended, self._settled = self._settled, math.inf
            if self._after == "home":
                self._origin = 0.0
                self._flags -= {"WR", "WH"}
            if self._values["comm.alert"] and ended >= self._asleep_until:
                self.alert(ended)

    def alert(self, t: float) -> None:
        """Send an unsolicited alert with the present state."""
        self._send("!", f"{self._status(t)}", t, axis=1, word="", with_check=bool(self._values["comm.checksum"]))

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other fault is ``wrong_status``: the flag for a stall."""
        self.wrong_status = "FS" if begins else None

    def reset(self, t: float) -> None:
        """Lose power and come back: motion stops dead, the reference is gone, deaf for a while; settings stay."""
        self._world.stage.rest(t, self._world.stage.at(t)[0])
        self._settled = math.inf
        self._power_up(t)
        self._asleep_until = t + self._settings.reboot_s

    # Bytes in

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self._asleep_until:
            return
        for byte in data:
            if byte in b"\r\n":
                line = bytes(self._line)
                self._line.clear()
                if line:
                    self._command(line, t)
            elif byte == 0x08:
                del self._line[-1:]
            elif byte == 0x7F or not 32 <= byte < 127:
                self._line.clear()
            elif self._line or byte == ord("/"):
                self._line.append(byte)
                if len(self._line) > 4 * PACKET_SIZE:
                    self._line.clear()

    def _command(self, line: bytes, t: float) -> None:
        match = COMMAND.match(line)
        if match is None:
            return
        body, check = match["body"], match["check"]
        if check is not None and checksum(body) != check:
            return
        words = body.decode("ascii").split()
        numbers: list[str] = []
        while words and len(numbers) < 3 and (words[0].isdigit() or (len(numbers) == 2 and words[0] == "--")):
            numbers.append(words.pop(0))
        device = int(numbers[0]) if numbers else 0
        axis = int(numbers[1]) if len(numbers) > 1 else 0
        identifier = numbers[2] if len(numbers) > 2 else ""
        if device not in (0, self._values["comm.address"]):
            return
        with_check = (check is not None and not self._settings.checksums_when_set) or bool(
            self._values["comm.checksum"]
        )
        if axis > self._settings.axes:
            verdict, data = "RJ", "BADAXIS"
        elif identifier not in ("", "--") and int(identifier) > 99:
            verdict, data, identifier = "RJ", "BADMESSAGEID", ""
        else:
            verdict, data = self._execute(words, axis, t)
        if identifier == "--":  # no reply wanted
            return
        text = f"{verdict} {self._status(t)} {data}"
        if self.before_reply is not None:
            self.before_reply(t)
        self._send("@", text, t + ANSWER_S, axis=axis, word=identifier, with_check=with_check)

    def _send(self, kind: str, text: str, t: float, *, axis: int, word: str, with_check: bool) -> None:
        """Send one packet; what is longer than a packet goes on in info packets marked ``cont``."""
        head = f"{self._values['comm.address']:02d} {axis}" + (f" {word}" if word else "")
        words = text.split(" ")
        start = head
        while True:
            line = start
            while words and len(line) + 1 + len(words[0]) <= PACKET_SIZE - 6:
                line += " " + words.pop(0)
            if words and line == start:
                line += " " + words.pop(0)
            if words:
                line += "\\"
            body = line.encode("ascii")
            check = b":" + checksum(body) if with_check else b""
            self._wire.send(kind.encode() + body + check + b"\r\n", t)
            if not words:
                return
            kind, start = "#", head + " cont"

    def _status(self, t: float) -> str:
        flags = self._ordered_flags()
        return f"{'BUSY' if self.busy(t) else 'IDLE'} {flags[0] if flags else '--'}"

    def _ordered_flags(self) -> list[str]:
        flags = set(self._flags)
        if self.wrong_status:
            flags.add(self.wrong_status)
        return [flag for flag in FLAGS if flag in flags]

    # Commands

    def _execute(self, words: list[str], axis: int, t: float) -> tuple[str, str]:
        if axis > 1:
            return self._execute_elsewhere(words, self.others[axis - 2])
        if axis == 0 and words[:1] == ["set"]:
            for other in self.others:
                self._execute_elsewhere(words, other)
        match words:
            case []:
                return "OK", "0"
            case ["home"]:
                return self._home(t)
            case ["move", *rest]:
                return self._move(rest, t)
            case ["stop"]:
                if self.busy(t):
                    self._brake(t)
                return "OK", "0"
            case ["estop"]:
                self._world.stage.rest(t, self._world.stage.at(t)[0])
                if self.busy(t):
                    self._settled, self._after = t, "stop"
                return "OK", "0"
            case ["get", name]:
                return self._get(name, axis, t)
            case ["set", name, value]:
                return self._set(name, value, t)
            case ["warnings"] | ["warnings", "clear"]:
                flags = self._ordered_flags()
                if len(words) == 2:
                    self._flags -= {"NI", "FS", "WS", "FE", "WL", "FH"}
                return "OK", " ".join([f"{len(flags):02d}", *flags])
            case ["system", "reset"]:
                if axis:
                    return "RJ", "DEVICEONLY"
                self.reset(t)
                return "OK", "0"
            case ["renumber", *first] if len(first) < 2:  # alone on its line it is the first
                number = int(first[0]) if first and re.fullmatch(r"[0-9]{1,2}", first[0]) else 0 if first else 1
                if axis or not number:
                    return "RJ", "DEVICEONLY" if axis else "BADDATA"
                self._values["comm.address"] = number
                return "OK", "0"
            case ["driver", "enable" | "disable" as word]:
                return self._switch_driver(word == "enable", t)
            case ["tools", "parking", "park" | "unpark" as word]:
                if self.busy(t):
                    return "RJ", "STATUSBUSY"
                self._parked = word == "park"
                return "OK", "0"
            case ["storage", *rest]:
                return self._storage(rest, axis)
        return "RJ", "BADCOMMAND"

    def _execute_elsewhere(self, words: list[str], values: dict[str, int]) -> tuple[str, str]:
        """On an axis that drives nothing, which has settings all the same."""
        match words:
            case ["get", name] if name in values:
                return "OK", str(values[name])
            case ["set", name, text] if name in values and re.fullmatch(r"[+-]?\d+", text):
                low, high = self._limits[name]
                if low <= int(text) <= high:
                    values[name] = int(text)
                    return "OK", "0"
            case [] | ["stop"] | ["warnings"]:
                return "OK", "00" if words == ["warnings"] else "0"
        return "RJ", "BADDATA" if words[:1] == ["set"] else "BADCOMMAND"

    def _switch_driver(self, on: bool, t: float) -> tuple[str, str]:
        """Without its driver the carriage stops dead and may be moved by hand."""
        self._driver_on = on
        if on:
            self._flags.discard("FO")
        else:
            self._world.stage.rest(t, self._world.stage.at(t)[0])
            self._settled = t if self.busy(t) else self._settled
            self._flags.add("FO")
        return "OK", "0"

    def _storage(self, rest: list[str], axis: int) -> tuple[str, str]:
        """Words that somebody keeps in the device, by key; those of an axis apart."""
        kept = self._stored.setdefault(axis, {})
        match rest:
            case ["set", key, *words] if words:
                kept[key] = " ".join(words)
                return "OK", "0"
            case ["append", key, *words] if words and key in kept:
                kept[key] += " ".join(words)
                return "OK", "0"
            case ["get", key] if key in kept:
                return "OK", kept[key]
            case ["erase", key] if key in kept:
                del kept[key]
                return "OK", "0"
            case ["get" | "erase" | "append", *_]:
                return "RJ", "BADDATA"
        return "RJ", "BADCOMMAND"

    def _cannot_move(self) -> str:
        return "PARKED" if self._parked else "" if self._driver_on else "DRIVERDISABLED"

    def _home(self, t: float) -> tuple[str, str]:
        if why := self._cannot_move():
            return "RJ", why
        self._start(0.0, self._speed("limit.approach.maxspeed"), t, "home")
        return "OK", "0"

    def _move(self, rest: list[str], t: float) -> tuple[str, str]:
        low, high = self._values["limit.min"], self._values["limit.max"]
        homed = "WR" not in self._flags
        speed = self._speed("maxspeed")
        if why := self._cannot_move():
            return "RJ", why
        acceleration = self._acceleration
        fixed = 1 if rest[:1] in (["min"], ["max"]) else 2
        rest, own = rest[:fixed], rest[fixed:]
        if len(own) > 2 or not all(re.fullmatch(r"[0-9]+", word) for word in own):
            return "RJ", "BADCOMMAND" if len(own) > 2 else "BADDATA"
        if own and rest[:1] != ["vel"]:
            if not 1 <= int(own[0]) <= self._limits["maxspeed"][1]:
                return "RJ", "BADDATA"
            speed = int(own[0]) / DATA_PER_STEP * self._step
        if own and (given := own[-1:] if rest[:1] == ["vel"] else own[1:]):
            if not 1 <= int(given[0]) <= self._limits["accel"][1]:
                return "RJ", "BADDATA"
            acceleration = int(given[0]) * 1e4 / DATA_PER_STEP * self._step
        match rest:
            case ["min"]:
                target = low
            case ["max"]:
                target = high
            case [("abs" | "rel" | "vel") as how, number] if re.fullmatch(r"[+-]?\d+", number):
                value = int(number)
                if how == "vel":
                    if abs(value) > self._limits["maxspeed"][1]:
                        return "RJ", "BADDATA"
                    if value == 0:
                        if self.busy(t):
                            self._brake(t)
                        return "OK", "0"
                    target = high if value > 0 else low
                    speed = abs(value) / DATA_PER_STEP * self._step
                else:
                    if not homed:
                        return "RJ", self._settings.unhomed_reject
                    target = value if how == "abs" else self.position(t) + value
                    if not low <= target <= high:
                        return "RJ", "BADDATA"
            case ["abs" | "rel" | "vel", _]:
                return "RJ", "BADDATA"
            case _:
                return "RJ", "BADCOMMAND"
        goal = self._origin + target * self._step
        if not homed:  # its limits mean nothing; the ends of the screw do
            goal = self._settings.travel_mm * 1e-3 if target == high else 0.0
        self._start(goal, speed, t, "move", acceleration)
        return "OK", "0"

    def _speed(self, name: str) -> float:
        """A speed setting in m/s."""
        return self._values[name] / DATA_PER_STEP * self._step

    @property
    def _acceleration(self) -> float:
        return self._values["accel"] * 1e4 / DATA_PER_STEP * self._step

    def _start(
        self, goal: float, speed: float, t: float, after: Literal["home", "move"], acceleration: float = 0.0
    ) -> None:
        if self.busy(t):
            self._flags.add("NI")
        x, v = self._world.stage.at(t)
        self._world.stage.follow(t, trapezoid(x, v, goal, speed, acceleration or self._acceleration))
        self._settled, self._after = self._world.stage.end, after

    def _brake(self, t: float) -> None:
        _, v = self._world.stage.at(t)
        self._world.stage.follow(t, [(abs(v) / self._acceleration, math.copysign(self._acceleration, -v))])
        self._settled, self._after = self._world.stage.end, "stop"

    # Settings

    def _get(self, name: str, axis: int, t: float) -> tuple[str, str]:
        device_only = {
            "deviceid": "50081",
            "system.serial": str(self._settings.serial_number),
            "version": "7.14",
            "version.build": "9999",
            "system.axiscount": "1",
            "system.voltage": "48.0",
            "system.temperature": "33.4",
            "device.hw.modified": "0",
            "comm.packet.size.max": str(PACKET_SIZE),
            "comm.command.packets.max": "1",
            "comm.word.size.max": "50",
            "get.settings.max": "1",
            "comm.address": str(self._values["comm.address"]),
            "comm.alert": str(self._values["comm.alert"]),
            "comm.checksum": str(self._values["comm.checksum"]),
        }
        if name in device_only:
            return ("RJ", "DEVICEONLY") if axis else ("OK", device_only[name])
        if name == "pos":
            return "OK", str(self.position(t))
        if name == "encoder.pos":
            return "OK", str(round((self._world.carriage_at(t) - self._origin) / self._step))
        if name == "resolution":
            return "OK", str(round(FULL_STEP_UM / self._settings.microstep_um))
        if name in ("peripheralid", "peripheral.id", "peripheral.serial"):
            return "OK", "0"
        if name == "encoder.count":
            return "OK", str(round((self._world.carriage_at(t) - self._origin) / ENCODER_COUNT_M))
        if name == "parking.state":
            return "OK", str(int(self._parked))
        if name == "driver.enabled":
            return "OK", str(int(self._driver_on))
        if name == "motion.busy":
            return "OK", str(int(self.busy(t)))
        if name == "driver.temperature":
            return "OK", "31.5"
        if name in self._values:
            return "OK", str(self._values[name])
        return "RJ", "BADCOMMAND"

    def _set(self, name: str, text: str, t: float) -> tuple[str, str]:
        if name != "pos" and name not in self._limits:
            known = self._get(name, 0, t)[0] == "OK"
            return "RJ", "NOACCESS" if known else "BADCOMMAND"
        if not re.fullmatch(r"[+-]?\d+", text):
            return "RJ", "BADDATA"
        value = int(text)
        if name == "pos":
            self._origin = self._world.stage.at(t)[0] - value * self._step
            self._flags.discard("WR")
            return "OK", "0"
        low, high = self._limits[name]
        if not low <= value <= high:
            return "RJ", "BADDATA"
        if (name == "limit.min" and value > self._values["limit.max"]) or (
            name == "limit.max" and value < self._values["limit.min"]
        ):
            return "RJ", "BADDATA"
        self._values[name] = value
        return "OK", "0"


TWINS = (
    Twin(
        driver="zaber",
        role="stage",
        truth=ZaberTruth,
        make=lambda truth, world, wire, rng: ZaberStage(truth, world, wire),  # nothing random about it
    ),
)
