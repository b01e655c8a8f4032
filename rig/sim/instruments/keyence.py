"""A Keyence LK-G laser displacement sensor on RS-232 ASCII, byte for byte.

Lines end with CR. In measure mode ``M1`` is answered by ``M1,ffffffff``: sign and seven characters with the decimal
point, ``+FFFFFFF`` over range, ``-FFFFFFF`` under range, ``XXXXXXXX`` no value yet. In communication mode (``Q0``, left
with ``R0``) settings are written with ``SW,..`` and read with ``SR,..`` and there is no measurement. Errors are
``ER,<command>,<nn>``. ``TG,a,ffffffff`` is sent unasked when the timing input is used.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.noise import ConversionNoise
from rig.sim.truth import Fault, LineTruth, NotNegative, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

SAMPLING_S = (20e-6, 50e-6, 100e-6, 200e-6, 500e-6, 1000e-6)  # SW,CA
DECIMALS = 4  # display setting, in mm
LONGEST = 32
NO_VALUE, OVER, UNDER = "XXXXXXXX", "+FFFFFFF", "-FFFFFFF"

COMMAND_ERROR, STATUS_ERROR, LENGTH_ERROR, COUNT_ERROR, PARAMETER_ERROR, OTHER_ERROR = 0, 1, 20, 21, 22, 99


def display(millimetres: float) -> str:
    """Eight characters: sign, then seven with the decimal point, filled with zeros."""
    text = f"{abs(millimetres):.{DECIMALS}f}".rjust(7, "0")
    if len(text) > 7:
        return OVER if millimetres > 0 else UNDER
    return ("-" if millimetres < 0 and float(text) else "+") + text


class _Refused(Exception):
    """The command is answered with this error number."""

    def __init__(self, number: int) -> None:
        self.number = number


class KeyenceTruth(LineTruth):
    """Keyence LK-G152 laser triangulation head."""

    more_faults: ClassVar[tuple[str, ...]] = ("no_value",)

    driver: Literal["keyence-lkg"] = Field(default="keyence-lkg", description="Keyence LK-G laser.")
    range_mm: Positive = Field(default=40.0, description="How far it sees to either side of its middle (mm).")
    offset_mm: float = Field(default=1.25, description="What it shows for the flat film (mm).")
    gain_error: float = Field(default=0.0, description="Hidden relative error of the scale. Typical: +-0.001.")
    noise_um: NotNegative = Field(
        default=0.5, description="Standard deviation of a reading as averaged at power-up (um)."
    )
    resolution_um: Positive = Field(default=0.1, description="Step of its readings (um).")
    averaging_code: int = Field(default=4, ge=0, le=9, description="Averages 4^code samples, as in SW,OC.")
    sampling_code: int = Field(
        default=1, ge=0, le=5, description="Sampling period: 20, 50, 100, 200, 500, 1000 us, as in SW,CA."
    )
    answer_ms: NotNegative = Field(default=1.0, description="How long it takes to answer (ms).")
    lag_ms: NotNegative = Field(
        default=0.0, description="By how much a reading is older than its averaging time tells (ms)."
    )


class KeyenceLKG:
    """One head on OUT1; OUT2 shows the same head without averaging.

    Attributes
    ----------
    saturated, no_value, wrong_status : faults
        Sign of the end of range it shows (0: none); it has no value; every measurement is answered with an error.
    before_reply : callable or None
        A fault: called with the time before each reply is sent.
    """

    def __init__(self, settings: KeyenceTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._rng = rng
        self._line = bytearray()
        self.saturated = 0
        self.no_value = False
        self.wrong_status = False
        self.before_reply: Callable[[float], None] | None = None
        self._frozen: float | None = None
        self._asleep_until = -math.inf
        # Kept in the controller
        self._sampling = settings.sampling_code
        self._averaging = {1: settings.averaging_code, 2: 0}
        self._offset = {1: 0.0, 2: 0.0}  # mm
        self._target = {1: 0, 2: 0}
        self._reflection = {1: 0, 2: 0}
        self._able = {1: 0, 2: 0}
        self._noise = ConversionNoise(rng, self._window(1))
        self._power_up(0.0)

    def _power_up(self, t: float) -> None:
        self._line.clear()
        self._communication = False
        self._zero = {1: 0.0, 2: 0.0}  # mm
        self._held: dict[int, str] = {}
        self._program = 0
        self._locked = False
        self._storing = False
        self._stored: list[str] = []
        self._valid_from = t + self._window(1)

    def _window(self, out: int) -> float:
        """Averaging time (s)."""
        return SAMPLING_S[self._sampling] * float(4 ** self._averaging[out])

    def reset(self, t: float) -> None:
        """Lose power and come back in measure mode; settings stay."""
        self._power_up(t + 1.0)
        self._asleep_until = t + 1.0

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: from now on always show the value of time ``t``."""
        self._frozen = None
        if frozen:
            self._frozen = self._millimetres(1, t)

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate``, ``no_value`` and ``wrong_status``, as its attributes say."""
        match fault.kind:
            case "saturate":
                self.saturated = fault.sign if begins else 0
            case "no_value":
                self.no_value = begins
            case _:
                self.wrong_status = begins

    # What it measures

    def _millimetres(self, out: int, t: float) -> float:
        """Reading before zero and offset: the mean over the averaging time is the value in its middle."""
        if self._frozen is not None:
            return self._frozen
        s = self._settings
        middle = max(t - 0.5 * self._window(out) - s.lag_ms * 1e-3, 0.0)
        true = self._world.displacement_at(middle) * 1e3
        fewer = self._averaging[1] if out == 1 else 0
        noise = s.noise_um * 1e-3 * math.sqrt(4.0 ** (s.averaging_code - fewer)) * self._noise.at(t)
        reading = true * (1.0 + s.gain_error) + s.offset_mm + noise
        return round(reading / (s.resolution_um * 1e-3)) * s.resolution_um * 1e-3

    def _value(self, out: int, t: float) -> str:
        if out in self._held:
            return self._held[out]
        if self.no_value or t < self._valid_from:
            return NO_VALUE
        millimetres = self._millimetres(out, t)
        reach = self._settings.range_mm
        if self.saturated > 0 or millimetres > reach:
            return OVER
        if self.saturated < 0 or millimetres < -reach:
            return UNDER
        return display(millimetres - self._zero[out] + self._offset[out])

    # Time

    @property
    def next_time(self) -> float:
        return math.inf

    def advance(self, t: float) -> None:
        """It does nothing by itself."""

    def alert(self, t: float) -> None:
        """The timing input is triggered: the value is pushed."""
        if not self._communication:
            self._wire.send(f"TG,1,{self._value(1, t)}\r".encode("ascii"), t)

    # Bytes in

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self._asleep_until:
            return
        for byte in data:
            if byte == 0x0D:
                line = bytes(self._line)
                self._line.clear()
                if line:
                    self._command(line, t)
            elif byte != 0x0A:  # some hosts send CR LF
                self._line.append(byte)
                if len(self._line) > 4 * LONGEST:
                    del self._line[LONGEST + 1 :]

    def _command(self, line: bytes, t: float) -> None:
        text = line.decode("ascii", "replace").upper()
        head = text.partition(",")[0]
        try:
            if len(text) > LONGEST:
                raise _Refused(LENGTH_ERROR)
            answer = self._answer(head, text.split(",")[1:], t)
        except _Refused as refused:
            name = re.sub("[^0-9A-Z]", "?", head)[:8]
            answer = f"ER,{name},{refused.number:02d}"
        if self.before_reply is not None:
            self.before_reply(t)
        self._wire.send(answer.encode("ascii") + b"\r", t + self._settings.answer_ms * 1e-3)

    def _answer(self, head: str, p: list[str], t: float) -> str:
        if head in ("Q0", "R0"):
            self._expect(p, 0)
            if (head == "Q0") == self._communication:
                raise _Refused(STATUS_ERROR)
            self._communication = head == "Q0"
            if not self._communication:
                self._valid_from = t + self._window(1)
                self._noise.restart(self._window(1), t)
            return head
        if head in ("SW", "SR"):
            if not self._communication:
                raise _Refused(STATUS_ERROR)
            return self._write(p) if head == "SW" else self._read(p)
        if head not in MEASURE_MODE:
            raise _Refused(COMMAND_ERROR)
        if self._communication:
            raise _Refused(STATUS_ERROR)
        self._expect(p, MEASURE_MODE[head])
        return self._measure(head, p, t)

    @staticmethod
    def _expect(p: list[str], count: int) -> None:
        if len(p) != count:
            raise _Refused(COUNT_ERROR)

    @staticmethod
    def _digit(text: str, low: int, high: int) -> int:
        if not re.fullmatch(r"\d{1,2}", text) or not low <= int(text) <= high:
            raise _Refused(PARAMETER_ERROR)
        return int(text)

    def _measure(self, head: str, p: list[str], t: float) -> str:
        if head in ("M0", "M1", "M2"):
            if self.wrong_status:
                raise _Refused(OTHER_ERROR)
            outs = (1, 2) if head == "M0" else (int(head[1]),)
            return ",".join([head, *(self._value(out, t) for out in outs)])
        outs = (1, 2) if head[-1] == "0" else (1,) if head[-1] == "1" else (2,)
        match head[0]:
            case "V" if head != "VR":
                for out in outs:
                    if t >= self._valid_from:
                        self._zero[out] = self._millimetres(out, t) + self._offset[out]
            case "W":
                for out in outs:
                    self._zero[out] = 0.0
            case "T":
                for out in outs:
                    self._held[out] = self._value(out, t)
            case "U":
                for out in outs:
                    self._held.pop(out, None)
            case _:
                return self._other(head, p, t)
        return head

    def _other(self, head: str, p: list[str], t: float) -> str:
        match head:
            case "VR":
                out = self._digit(p[0], 0, 2)
                for number in (1, 2) if out == 0 else (out,):
                    self._held.pop(number, None)
                self._valid_from = t + self._window(1)
            case "PW":
                self._program = self._digit(p[0], 0, 7)
                self._valid_from = t + self._window(1)
            case "PR":
                return f"PR,{self._program}"
            case "KL":
                self._locked = bool(self._digit(p[0], 0, 1))
            case "AQ":
                self._storing, self._stored = False, []
            case "AS":
                self._storing, self._stored = True, [self._value(1, t)]
            case "AP":
                self._storing = False
            case "AN":
                return f"AN,{int(self._storing)},{len(self._stored):06d},{0:06d}"
            case "AO":
                self._digit(p[0], 1, 2)
                if self._storing:
                    raise _Refused(STATUS_ERROR)
                return ",".join(["AO", *self._stored])
        return head

    # Settings

    def _write(self, p: list[str]) -> str:
        match p:
            case ["CA", code]:
                self._sampling = self._digit(code, 0, 5)
            case ["OC", out, "0", code]:
                self._averaging[self._digit(out, 1, 2)] = self._digit(code, 0, 9)
            case ["HB", head, mode]:
                self._target[self._digit(head, 1, 2)] = self._digit(mode, 0, 4)
            case ["HE", head, mode]:
                self._reflection[self._digit(head, 1, 2)] = self._digit(mode, 0, 1)
            case ["HA", "M", head, mode]:
                self._able[self._digit(head, 1, 2)] = self._digit(mode, 0, 1)
            case ["OF", out, number]:
                if not re.fullmatch(r"[+-]\d{6}", number):
                    raise _Refused(PARAMETER_ERROR)
                self._offset[self._digit(out, 1, 2)] = int(number) * 1e-4
            case [("CA" | "OC" | "HB" | "HE" | "HA" | "OF"), *_]:
                raise _Refused(COUNT_ERROR)
            case _:
                raise _Refused(PARAMETER_ERROR)
        return f"SW,{p[0]}"

    def _read(self, p: list[str]) -> str:
        match p:
            case ["CA"]:
                return f"SR,CA,{self._sampling}"
            case ["OC", out, "0"]:
                return f"SR,OC,{out},0,{self._averaging[self._digit(out, 1, 2)]}"
            case ["HB", head]:
                return f"SR,HB,{head},{self._target[self._digit(head, 1, 2)]}"
            case ["HE", head]:
                return f"SR,HE,{head},{self._reflection[self._digit(head, 1, 2)]}"
            case ["HA", "M", head]:
                return f"SR,HA,M,{head},{self._able[self._digit(head, 1, 2)]}"
            case ["OF", out]:
                offset = self._offset[self._digit(out, 1, 2)]
                return f"SR,OF,{out},{offset:+08.4f}"
            case [("CA" | "OC" | "HB" | "HE" | "HA" | "OF"), *_]:
                raise _Refused(COUNT_ERROR)
        raise _Refused(PARAMETER_ERROR)


# Commands of measure mode and their numbers of parameters
MEASURE_MODE = {
    **dict.fromkeys(["M0", "M1", "M2", "V0", "V1", "V2", "W0", "W1", "W2", "T0", "T1", "T2", "U0", "U1", "U2"], 0),
    **dict.fromkeys(["PR", "AQ", "AS", "AP", "AN"], 0),
    **dict.fromkeys(["VR", "PW", "KL", "AO"], 1),
}


TWINS = (Twin(driver="keyence-lkg", role="displacement", truth=KeyenceTruth, make=KeyenceLKG),)
