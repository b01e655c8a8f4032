r"""A second, independent reading of the output: what makes a supply that lies in status and reading detectable.

Where the scene names a monitor of the voltage, the output counts as off only when both say so: the last two readings
of the monitor below `SAFE_VOLTAGE`, made after the off was commanded, the newest of them no older than it may be. No
value, an old one and one that is called bad are no evidence.

While there is voltage the monitor must agree with the supply. Its reading at time :math:`t` must lie among what the
supply said from :math:`t - d` on, with :math:`d` of ``lag_s`` and two of the supply's periods, widened by
``agrees_within_V`` or ``agrees_within_percent``, whichever is more, and by what the commanded ramp does since the
supply's last sample. Two readings that do not, more than two of the supply's periods apart, end the run.

It only ever adds to what must be measured. No off waits for it, and one that fails prevents none.
"""

from __future__ import annotations

import math
from collections import deque

from drivers.roles import HVSample, MonitorSample
from drivers.settings import MonitorSettings
from rig.base.errors import FaultError, LimitError, StaleData
from rig.safety.guard import SAFE_SAMPLES, SAFE_VOLTAGE
from rig.scene.scene import Scene

SILENT_PERIODS = 2.0  # a monitor may miss so many of its periods, and take its time-out more
MARGIN_S = 0.25  # and the host this much, until a reading has come here
SUPPLY_PERIODS = 2.0
FASTEST = 1.1  # times the commanded ramp


class SecondReading:
    """Judges the readings of one monitor beside those of the supply.

    Parameters
    ----------
    role : str
        The monitor's name in the scene.
    table : MonitorSettings
        What the scene says of it.
    supply_period : float
        Seconds between two samples of the supply.
    ramp : float
        Commanded ramp (V/s).
    highest : float
        Beyond this its reading is outside the limit of the voltage (V).
    """

    def __init__(self, role: str, table: MonitorSettings, supply_period: float, ramp: float, highest: float) -> None:
        self.role = role
        self.last: MonitorSample | None = None
        self.allowed_age = SILENT_PERIODS / table.sample_rate + table.timeout_s + MARGIN_S
        self.wait_s = (SAFE_SAMPLES + 1) / table.sample_rate + table.timeout_s + table.lag_s
        self._lasts = SUPPLY_PERIODS * supply_period
        self._lag = table.lag_s + self._lasts
        self._volts, self._part = table.agrees_within_V, table.agrees_within_percent * 1e-2
        self._ramp, self._highest = ramp, highest
        self._good_at: float | None = None
        self._low_samples = 0
        self._supply: deque[tuple[float, float]] = deque()
        self._apart_since = math.nan
        self._apart = 0

    @classmethod
    def of(cls, scene: Scene, highest: float) -> SecondReading | None:
        """That of a scene; None where it names none. ``highest``: the highest voltage that may be measured (V)."""
        role = scene.second_reading
        if not role or scene.hv is None:
            return None
        return cls(role, scene.monitors[role], 1.0 / scene.hv.sample_rate, scene.hv.ramp_V_per_s, highest)

    def words(self, now: float = math.nan) -> str:
        """What it shows at time ``now``, in words for the operator."""
        name = f"the second reading of the voltage ({self.role})"
        if self.last is None or self._good_at is None:
            return f"{name} has given no value"
        if now - self._good_at > self.allowed_age:
            return f"{name} has given no value for {now - self._good_at:.1f} s"
        if self.last.flags or math.isnan(self.last.value):
            return f"{name} has no value"
        return f"{name} shows {self.last.value:.0f} V"

    def shows_off(self, now: float) -> bool:
        """Whether it shows the output off at time ``now``, by readings made since `expect_off`."""
        fresh = self._good_at is not None and now - self._good_at <= self.allowed_age
        return fresh and self._low_samples >= SAFE_SAMPLES

    def expect_off(self) -> None:
        """An off was commanded: what was read before it proves nothing."""
        self._low_samples = 0

    def check_age(self, now: float) -> None:
        """Raise unless there is a good reading that is no older than it may be.

        Raises
        ------
        StaleData
        """
        age = math.nan if self._good_at is None else now - self._good_at
        if not age <= self.allowed_age:
            has = "has given no value yet" if self._good_at is None else f"has given no value for {age:.2f} s"
            raise StaleData(f"hv: the second reading of the voltage ({self.role}) {has}.", device=self.role)

    def on_supply(self, sample: HVSample) -> None:
        """Take what the supply says."""
        self._supply.append((sample.t, abs(sample.voltage)))
        while len(self._supply) > 2 and self._supply[1][0] < sample.t - self._lag - 1.0:
            self._supply.popleft()

    def take(self, sample: MonitorSample) -> None:
        """Take one reading."""
        self.last = sample
        good = not sample.flags and math.isfinite(sample.value)
        if good:
            self._good_at = sample.t
        self._low_samples = self._low_samples + 1 if good and abs(sample.value) < SAFE_VOLTAGE else 0

    def judge(self) -> None:
        """Hold the newest reading against the limit, and against the supply.

        Raises
        ------
        LimitError
            It shows more than the limit of the voltage.
        FaultError
            It has not agreed with the supply for too long.
        """
        sample = self.last
        if sample is None or sample.flags or not math.isfinite(sample.value):
            return  # its age tells
        shown = abs(sample.value)
        within = max(self._volts, self._part * shown)
        if not shown <= self._highest + within:
            raise LimitError(
                f"hv: {self.words()}; outside the limit of the voltage ({self._highest:.0f} V, as measured).",
                device=self.role,
            )
        low, high = self._band(sample.t)
        if low <= shown <= high:
            self._apart, self._apart_since = 0, math.nan
            return
        self._apart += 1
        if self._apart == 1:
            self._apart_since = sample.t
        if self._apart >= SAFE_SAMPLES and sample.t - self._apart_since > self._lasts:
            says = self._supply[-1][1] if self._supply else math.nan
            raise FaultError(
                f"hv: supply and {self.role} disagree: the supply says {says:.0f} V, the second reading {shown:.0f} V; "
                f"allowed are {self._volts:.0f} V or {self._part:.0%}. One of the two is wrong.",
                device=self.role,
            )

    def _band(self, t: float) -> tuple[float, float]:
        """(least, most) that agrees with the supply at time ``t``."""
        said = [volts for at, volts in self._supply if at >= t - self._lag]
        before = [volts for at, volts in self._supply if at < t - self._lag]
        said += before[-1:]
        if not said or not all(map(math.isfinite, said)):
            return -math.inf, math.inf  # the supply's own silence is told elsewhere
        since = FASTEST * self._ramp * max(t - self._supply[-1][0], 0.0)
        within = max(self._volts, self._part * max(said)) + since
        return min(said) - within, max(said) + within
