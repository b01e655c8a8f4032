"""A bench multimeter on the network that answers SCPI queries, line by line, on a raw TCP socket.

It knows ``*IDN?``, ``*CLS``, ``*RST``, ``*OPC?``, ``SYST:ERR?``, and ``READ?``, ``FETC?`` and all ``MEAS:...?``, each
of which gives the one value that it is connected to. Long and short forms and either case are one, as SCPI-99 has it; a
question that it does not know is not answered but noted as error -113, which is what meters do. It takes the time of
one conversion to answer, and does one thing after the other.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.probe import Probe
from rig.sim.truth import Fault, MonitorTruth, NetworkTruth, NotNegative, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

LONGEST = 1000
ERRORS_KEPT = 20
SHORT = {"MEASURE": "MEAS", "FETCH": "FETC", "SYSTEM": "SYST", "ERROR": "ERR", "NEXT": "NEXT"}


class MeterTruth(MonitorTruth, NetworkTruth):
    """A SCPI meter."""

    means_nothing: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("drop", "duplicate", "corrupt"), "TCP repeats what is lost and checks what comes"),
        "alert": "it speaks only when it is asked",
    }

    driver: Literal["scpi"] = Field(default="scpi", description="Meter that answers SCPI queries.")
    model: str = Field(default="ACME,DMM6500,04387,1.7.3", description="What it answers to *IDN?; empty: it has none.")
    conversion_ms: NotNegative = Field(default=20.0, description="How long a measurement takes (ms).")
    reboot_s: Positive = Field(default=2.0, description="How long it is silent after power comes back (s).")


class Meter:
    """One meter."""

    def __init__(self, truth: MeterTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._truth, self._wire = truth, wire
        self._probe = Probe(truth, world, rng)
        self._line = bytearray()
        self._errors: deque[str] = deque(maxlen=ERRORS_KEPT)
        self._frozen: float | None = None
        self._word = ""
        self._asleep_until = self._busy_until = -math.inf

    @property
    def next_time(self) -> float:
        return math.inf

    def advance(self, t: float) -> None:
        """It does nothing by itself."""

    def reset(self, t: float) -> None:
        self._line.clear()
        self._errors.clear()
        self._asleep_until = t + self._truth.reboot_s

    def freeze(self, t: float, frozen: bool) -> None:
        self._frozen = self._probe.number(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate``, it is over range; ``wrong_status``, it gives no number."""
        if fault.kind == "saturate":
            self._word = ("+9.90000000E+37" if fault.sign > 0 else "-9.90000000E+37") if begins else ""
        else:
            self._word = "+9.91000000E+37" if begins else ""

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self._asleep_until:
            return
        for byte in data:
            if byte == 0x0A:
                line = self._line.decode("ascii", "replace").strip()
                self._line.clear()
                if line:
                    self._obey(line, t)
            elif len(self._line) < LONGEST:
                self._line.append(byte)

    def _obey(self, line: str, t: float) -> None:
        begins = max(t, self._busy_until)
        answers = [answer for one in line.split(";") if (answer := self._one(one.strip(), begins)) is not None]
        if answers:
            self._busy_until = begins + self._truth.conversion_ms * 1e-3
            self._wire.send(";".join(answers).encode("ascii", "replace") + b"\n", self._busy_until)

    def _one(self, command: str, t: float) -> str | None:
        head = command.split(" ", 1)[0].upper()
        words = [SHORT.get(word, word) for word in head.removesuffix("?").lstrip(":").split(":")]
        match head.endswith("?"), words:
            case True, ["*IDN"] if self._truth.model:
                return self._truth.model
            case True, ["*OPC"]:
                return "1"
            case True, ["SYST", "ERR"] | ["SYST", "ERR", "NEXT"]:
                return self._errors.popleft() if self._errors else '+0,"No error"'
            case True, ["READ"] | ["FETC"] | ["MEAS", *_]:
                return self._word or f"{self._probe.number(t) if self._frozen is None else self._frozen:+.8E}"
            case False, ["*CLS"]:
                self._errors.clear()
            case False, ["*RST"]:
                pass
            case _:
                self._errors.append('-113,"Undefined header"')
        return None


TWINS = (Twin("scpi", "monitor", MeterTruth, Meter),)
