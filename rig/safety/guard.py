"""The guard: sole commander of the high voltage.

It starts latched SAFE. Arming needs the operator's word and a supply that is measurably off; the first set-point
makes it LIVE; any fault latches it SAFE again, and nothing but a new arming leads out of there. Connecting, reading
and latching never raise an output. Software is not the safety function: the interlock loop, the emergency stop, the
supply's own current limit and the bleed resistor are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, Flag

from drivers.roles import HVFlag, HVSample, HVSupply
from rig.errors import FaultError, LimitError
from rig.safety.limits import FilmLimits, Limits

SAFE_VOLTAGE = 60.0  # V; below this the discharge is harmless (EN 50191 names 60 V DC)
SAG_V, SAG_PART = 50.0, 0.05  # a settled output this far below its set-point, in SAG_SAMPLES in a row, has sagged
SAG_SAMPLES = 2  # ... and so many in which a channel that was on says it is off: not every supply flags a trip
SAFE_SAMPLES = 2  # consecutive measured voltages below SAFE_VOLTAGE before we call the output safe

TRIP = HVFlag.TRIPPED | HVFlag.INHIBITED | HVFlag.EMERGENCY_OFF | HVFlag.INTERLOCK_OPEN | HVFlag.ARC | HVFlag.FAULT


class GuardState(Enum):
    """Where the latch stands."""

    SAFE = "safe"
    ARMED = "armed"
    LIVE = "live"


class Guard:
    """Owns the supply's commands, checks every set-point and every sample.

    Parameters
    ----------
    supply : HVSupply
        Nobody else may command it. The current of one that does not measure it is not watched; a missing value from
        one that does is outside its limits.
    limits, film : Limits, FilmLimits
        What is allowed of voltage and current, and of the pair (displacement, voltage) on the deformed film.
    ramp : float
        Ramp rate in V/s for every change of the output.
    tell : callable
        ``tell(command, argument)`` is called with each command before it is given, for the log.
    """

    def __init__(
        self,
        supply: HVSupply,
        limits: Limits,
        film: FilmLimits,
        ramp: float,
        tell: Callable[[str, str], None],
    ) -> None:
        self.state = GuardState.SAFE
        self.cause = "start"
        self._supply = supply
        self._limits = limits
        self._film = film
        self._ramp = ramp
        self._tell = tell
        self._low_samples = 0
        self._sagging_samples = 0
        self._seen_on = False
        self.last: HVSample | None = None

    @property
    def output_is_safe(self) -> bool:
        """Whether the *measured* voltage has been below 60 V for the last two samples."""
        return self._low_samples >= SAFE_SAMPLES

    def arm(self) -> None:
        """Leave SAFE. The supply must be measurably off and free of faults.

        Raises
        ------
        FaultError
            When the supply is live, tripped or unmeasured; nothing is changed then.
        """
        if self.last is None or not self.output_is_safe:
            measured = "not measured yet" if self.last is None else f"{self.last.voltage:.0f} V"
            raise FaultError(
                f"hv: cannot be armed, its output is {measured}. Nothing was changed. "
                "Find out who switched it on; ramp it down by hand; start again."
            )
        if HVFlag.ON in self.last.flags:
            raise FaultError(
                "hv: cannot be armed, the channel is already on. Nothing was changed. Switch it off first."
            )
        faults = self.last.flags & TRIP
        if faults:
            raise FaultError(f"hv: cannot be armed, the supply reports {flag_names(faults)}. Clear the cause first.")
        limited = self._supply.measures_current
        limit = f"current limit {self._limits.current.high:g} A" if limited else "no current limit"
        self._tell("arm", f"ramp {self._ramp:g} V/s, {limit}")
        self._supply.set_ramp(self._ramp)
        if limited:
            self._supply.set_current_limit(self._limits.current.high)
        self.state = GuardState.ARMED
        self.cause = ""
        self._seen_on = False

    def request(self, volts: float, h: float) -> None:
        """Ramp the output to ``volts`` with the disk at displacement ``h`` metres.

        Raises
        ------
        LimitError
            When the voltage, the field or the tension on the deformed film would be outside its limits.
        FaultError
            When the guard is latched.
        """
        if self.state is GuardState.SAFE:
            raise FaultError(f"hv: {volts:g} V refused, the guard is latched safe ({self.cause}).")
        self._limits.voltage.check(volts, "HV set-point")
        self._film.check(h, volts, f"HV set-point {volts:g} V at {h * 1e3:.2f} mm")
        self._tell("set_voltage", f"{volts:g} V")
        self._supply.set_voltage(volts)
        if self.state is GuardState.ARMED:
            self._tell("switch_on", "")
            self._supply.switch_on()
            self.state = GuardState.LIVE
        self._low_samples = 0

    def on_sample(self, sample: HVSample) -> None:
        """Judge one measurement of the output.

        Raises
        ------
        LimitError, FaultError
            When voltage or current is outside its limit, or the supply reports a trip while live.
        """
        self.last = sample
        below = abs(sample.voltage) < SAFE_VOLTAGE  # False for NaN
        self._low_samples = self._low_samples + 1 if below else 0
        if self.state is not GuardState.LIVE:
            return
        self._limits.measured_voltage.check(sample.voltage, "HV monitor")
        if self._supply.measures_current:
            self._limits.current.check(sample.current, "HV monitor")
        faults = sample.flags & TRIP
        if faults:
            raise FaultError(f"hv: the supply reports {flag_names(faults)}.")
        on = HVFlag.ON in sample.flags
        self._seen_on = self._seen_on or on
        settled = on and HVFlag.RAMPING not in sample.flags
        sagging = settled and not sample.voltage >= sample.setpoint - max(SAG_V, SAG_PART * sample.setpoint)
        went_off = self._seen_on and not on
        self._sagging_samples = self._sagging_samples + 1 if sagging or went_off else 0
        if self._sagging_samples >= SAG_SAMPLES:
            if went_off:
                raise FaultError("hv: the supply says that it is off, and nobody switched it off from here.")
            raise FaultError(
                f"hv: the output has sagged to {sample.voltage:.0f} V with {sample.setpoint:.0f} V set: "
                "the film draws more current than the supply gives."
            )

    def ramp_off(self, cause: str) -> None:
        """Ramp the output down, switch it off and latch SAFE. For orderly ends; does nothing if never armed."""
        if self.state is GuardState.SAFE:
            return
        self._latch(cause)
        self._tell("switch_off", cause)
        self._supply.switch_off()

    def kill(self, cause: str) -> None:
        """Take the output off at once and latch SAFE. A supply that was never armed is left alone."""
        if self.state is GuardState.SAFE and self.cause == "start":
            return
        self._latch(cause)
        self._tell("emergency_off", cause)
        self._supply.emergency_off()

    def _latch(self, cause: str) -> None:
        self.state = GuardState.SAFE
        self.cause = cause
        self._low_samples = 0


def flag_names(flags: Flag) -> str:
    """The flags in plain words."""
    return ", ".join((flag.name or "").lower().replace("_", " ") for flag in flags)


def check_path(film: FilmLimits, h0: float, h1: float, voltage: float, points: int = 5) -> None:
    """Check the film along a move from ``h0`` to ``h1`` metres at ``voltage`` volts, ends included.

    Raises
    ------
    LimitError
        At the first displacement where field or tension does not hold.
    """
    if not (math.isfinite(h0) and math.isfinite(h1)):
        raise LimitError("A move was asked for from or to a displacement that is not a number.")
    for k in range(points):
        h = h0 + (h1 - h0) * k / (points - 1)
        film.check(h, voltage, f"Move to {h1 * 1e3:.2f} mm with {voltage:g} V on, at {h * 1e3:.2f} mm")
