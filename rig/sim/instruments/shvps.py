"""A peta-pico-Voltron single-channel high-voltage supply (shvps) on its serial protocol, line by line.

A command is a word and perhaps a number, ended by CR; each is answered by one line, the value alone, ended by CR LF.
``Q..`` asks, ``S.. n`` sets and is answered by the value that now holds. Voltages are whole volts. ``SwMode`` 0 is off
(0 V whatever the set-point), 1 steady; ``SwSrc`` 0 lets the board itself switch; ``VMode`` 0 regulates to the
set-point, 1 follows an analogue input, 2 is open loop by ``PWM``. There is no ramp, no current measurement, no status.

Known from the host library of EPFL's NERD set-up (library 2.8 for firmware 8). Assumed, since no source says it: a
value out of range is moved to the end of the range, a word it does not know is answered ``Err``. Not simulated:
switching and waveforms; modes 2 and 3 are not entered.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from rig.sim.noise import ConversionNoise
from rig.sim.supply import switch_output
from rig.sim.truth import IN_REACH, Fault, LineTruth, NotNegative, OutputTruth, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import TICK, World

OFF, STEADY = 0, 1  # SwMode
ONBOARD = 0  # SwSrc
REGULATED, EXTERNAL, OPEN_LOOP = 0, 1, 2  # VMode
LONGEST = 64  # the board's receive buffer
FIRMWARE: Final = 8
COMMAND = re.compile(r"(?P<way>[QS])(?P<name>[A-Za-z0-9]+)(?: (?P<number>-?\d+(?:\.\d+)?))?")
# What is remembered: value after power-up, and smallest and largest.
NUMBERS: dict[str, tuple[int, int, int]] = {
    "SwSrc": (ONBOARD, 0, 2),
    "VMode": (REGULATED, 0, 2),
    "PWM": (0, 0, 1023),
    "Cycle": (0, 0, 65_535),
    "LatchMode": (0, 0, 1),
    "I2C": (12, 8, 119),
}
LOWEST_HZ, HIGHEST_HZ = 1e-3, 5e3


class ShvpsTruth(OutputTruth, LineTruth):
    """shvps, the peta-pico-Voltron single-channel supply of dielectric-elastomer labs, on a serial port."""

    means_nothing: ClassVar[Mapping[str, str]] = IN_REACH | {"alert": "it never speaks unasked"}

    driver: Literal["shvps"] = Field(default="shvps", description="shvps supply.")
    board: str = Field(default="HVPS 7", pattern=r"^[ -~]{1,32}$", description="Name that was given to the board.")
    maximum_voltage_V: int = Field(default=5000, ge=1, le=10_000, description="Largest voltage of the board (V).")
    slew_V_per_s: Positive = Field(default=20_000.0, description="How fast the regulated output rises (V/s).")
    largest_current_uA: Positive = Field(default=200.0, description="What the converter can give at most (uA).")
    voltage_noise_V: NotNegative = Field(default=0.7, description="Standard deviation of a voltage reading (V).")
    reading_period_s: Positive = Field(default=0.01, description="Period of the board's voltage measurement (s).")
    answer_ms: NotNegative = Field(default=1.0, description="How long it takes to answer (ms).")
    reboot_s: Positive = Field(default=2.0, description="How long it is silent after power comes back (s).")
    power_jack: bool = Field(default=True, description="Whether the power jack is plugged in.")


class Shvps:
    """One board.

    Attributes
    ----------
    stuck_on, wrong_mode : faults
        The output neither falls nor is switched off; ``QSwMode`` answers this whatever is true (None: the truth).
    jack : bool
        Whether the power jack is plugged in; without it the converter gives nothing.
    """

    def __init__(self, settings: ShvpsTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._noise = ConversionNoise(rng, settings.reading_period_s)
        self._line = bytearray()
        self.stuck_on = self.lies = False
        self.wrong_mode: int | None = None
        self.jack = settings.power_jack
        self._left = 1.0
        self._frozen: int | None = None
        self._asleep_until = -math.inf
        self._tick = 0
        self._power_up()
        if settings.start_live_V:
            self._vset, self._mode = round(settings.start_live_V), STEADY

    def _power_up(self) -> None:
        self._line.clear()
        self._vset = 0
        self._mode = OFF
        self._frequency = 1.0
        self._numbers = {name: start for name, (start, _, _) in NUMBERS.items()}

    @property
    def largest_current(self) -> float:
        """What the converter can give at most (A)."""
        return self._settings.largest_current_uA * 1e-6

    def reset(self, t: float) -> None:
        """Lose power and come back: output off, set-point and mode as after power-up."""
        self._power_up()
        self._drive(t)
        self._asleep_until = t + self._settings.reboot_s

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: the measured voltage stays what it was at ``t``."""
        self._frozen = None
        if frozen:
            self._frozen = self._reading(t)

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: those of every output, and ``wrong_status``: another mode."""
        if fault.kind == "wrong_status":
            self.wrong_mode = int(fault.value or 0) if begins else None
        else:
            switch_output(self, self._world, fault, begins, t)

    def pull_jack(self, t: float) -> None:
        """The power jack falls out: the logic lives on by USB, and the output decays."""
        self.jack = False
        self._drive(t)

    def set_sag(self, t: float, left: float) -> None:
        """A fault: only this part of the set-point reaches the output from now on."""
        self._left = left
        self._drive(t)

    # Output

    def _wanted(self) -> float:
        """Where the output goes (V) if the converter can give the current."""
        if not self.jack or self._mode != STEADY or self._numbers["SwSrc"] != ONBOARD:
            return 0.0
        match self._numbers["VMode"]:
            case 0:
                volts = self._vset * (1.0 + self._settings.gain_error)
            case 2:
                volts = self._numbers["PWM"] / NUMBERS["PWM"][2] * self._settings.maximum_voltage_V
            case _:
                volts = 0.0  # nothing on the analogue input
        return volts * self._left

    def _reachable(self) -> float:
        """The highest voltage (V) that the converter can hold on the film as it is."""
        return max(self.largest_current - self._world.extra_leakage, 0.0) * self._world.film_resistance

    def _drive(self, t: float) -> None:
        """Let the output go where it now should."""
        now = self._world.output.at(t)[0]
        target = min(self._wanted(), self._reachable())
        if target < now:
            if not self.stuck_on:
                self._world.output.ramp(t, target, max(now, 1.0) / self._settings.fall_time_s)
        elif target > now:
            self._world.output.ramp(t, target, self._settings.slew_V_per_s)

    @property
    def next_time(self) -> float:
        """The next look at the output's load; inf while there is no voltage."""
        return (self._tick + 1) * TICK if self._is_live else math.inf

    @property
    def _is_live(self) -> bool:
        return self._mode != OFF or self._tick * TICK < self._world.output.end

    def advance(self, t: float) -> None:
        """See whether the converter still holds its voltage."""
        tick = math.floor(t / TICK + 1e-9)
        if tick <= self._tick:
            return
        self._tick = tick
        now, reachable = self._world.output.at(t)[0], self._reachable()
        if now > reachable and not self.stuck_on:
            self._world.output.ramp(t, reachable, max(now - reachable, 1.0) / TICK)
        elif self._is_live and t >= self._world.output.end and now != min(self._wanted(), reachable):
            self._drive(t)

    # What it reports

    def _reading(self, t: float) -> int:
        """Measured voltage in whole volts, never negative."""
        if self.lies:
            return 0
        if self._frozen is not None:
            return self._frozen
        true = self._world.output.at(t)[0] / (1.0 + self._settings.gain_error)
        return max(round(true + self._settings.voltage_noise_V * self._noise.at(t)), 0)

    # Bytes in

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self._asleep_until:
            return
        for byte in data:
            if byte == 0x0D:
                line = self._line.decode("ascii", "replace")
                self._line.clear()
                if line:
                    answer = self._command(line, t)
                    self._wire.send(answer.encode("ascii") + b"\r\n", t + self._settings.answer_ms * 1e-3)
            elif byte != 0x0A and len(self._line) < LONGEST:
                self._line.append(byte)

    def _command(self, line: str, t: float) -> str:
        if line == "Save":
            return "0"
        command = COMMAND.fullmatch(line)
        if command is None:
            return "Err"
        name, number = command["name"], command["number"]
        if command["way"] == "Q":
            answer = self._ask(name, t) if number is None else None
        elif number is not None and self._set(name, float(number), t):
            answer = str(self._numbers[name]) if name in NUMBERS else self._ask(name, t)
        else:
            answer = None
        return "Err" if answer is None else answer

    def _ask(self, name: str, t: float) -> str | None:
        """The answer to ``Q<name>``; None when there is no such question."""
        match name:
            case "Name":
                return self._settings.board
            case "Ver":
                return f"slave {FIRMWARE}"
            case "Vmax":
                return str(self._settings.maximum_voltage_V)
            case "Vset":
                return str(self._vset)
            case "Vnow":
                return str(self._reading(t))
            case "SwMode":
                shown = OFF if self.lies else self._mode
                return str(shown if self.wrong_mode is None else self.wrong_mode)
            case "F":
                return f"{self._frequency:.3f}"
            case "Cycle":
                return f"0/{self._numbers['Cycle']}"
            case "Jack":
                return str(int(self.jack))
            case "PowJack":
                return "1"
        return str(self._numbers[name]) if name in NUMBERS else None

    def _set(self, name: str, number: float, t: float) -> bool:
        """Take a new value; False when there is nothing of that name to set."""
        if name == "Vset":
            self._vset = min(max(int(number), 0), self._settings.maximum_voltage_V)
        elif name == "SwMode":
            if number in (OFF, STEADY):
                self._mode = int(number)
        elif name == "F":
            self._frequency = min(max(number, LOWEST_HZ), HIGHEST_HZ)
        elif name in NUMBERS:
            _, low, high = NUMBERS[name]
            self._numbers[name] = min(max(int(number), low), high)
        else:
            return False
        self._drive(t)
        return True


TWINS = (Twin(driver="shvps", role="hv", truth=ShvpsTruth, make=Shvps),)
