r"""Where the output may be while it follows a commanded ramp, whatever the supply says of itself.

A change from :math:`v_0` to :math:`v_1` at rate :math:`r`, commanded at :math:`t_0`, has come at most as far as
:math:`v_0 \pm 1.1 r (t - t_0)`, and at least as far as :math:`v_0 \pm k r (t - t_0 - d)`. Both end at :math:`v_1`, and
:math:`d` is the time until the command was confirmed and `BEGINS_S`. To both comes a tolerance: `DEVIATION_V` or
`DEVIATION_PART` of the larger end, and while the ramp lasts what it goes in `LAG_S`. From the late end on only the
tolerance about the set-point is left. An output that was on its way somewhere else may go on there until then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

DEVIATION_V, DEVIATION_PART = 50.0, 0.05  # how far an output may be from where it should be
FASTEST = 1.1  # times the commanded rate
SLOWEST_UP, SLOWEST_DOWN = 0.8, 0.6  # downwards a film may discharge more slowly than it was charged
BEGINS_S = 0.5  # from the confirmed command to the first movement, and from a measurement to its sample
LAG_S = 0.1
LATEST_S = 10.0  # a command that is not confirmed by then counts as confirmed
RAMP_MARGIN, RAMP_GRACE_S = 1.5, 10.0  # a ramp down may take this much longer than it should before it is cut short


@dataclass
class CommandedRamp:
    """One commanded change of the output.

    Parameters
    ----------
    begun : float
        Time of the last measurement before the command (s).
    start, target : float
        Voltage measured then, and the one commanded (V).
    rate : float
        Commanded ramp (V/s).
    before : float
        Where it had been sent before (V).
    """

    begun: float
    start: float
    target: float
    rate: float
    before: float
    _confirmed: float = field(default=math.nan, init=False)

    def confirm(self, t: float, *, busy: bool) -> None:
        """Tell that at time ``t`` the supply was still ``busy`` with taking the command, or not any more."""
        if math.isnan(self._confirmed) and (not busy or t - self.begun > LATEST_S):
            self._confirmed = t

    def over(self, t: float) -> bool:
        """Whether the ramp must have ended by time ``t``: nothing excuses any other voltage from then on."""
        return self._latest(t) == self.target

    def band(self, t: float) -> tuple[float, float]:
        """(least, most) voltage that the output may have at time ``t``."""
        ends = [_towards(self.start, self.target, FASTEST * self.rate * (t - self.begun)), self._latest(t)]
        tolerance = max(DEVIATION_V, DEVIATION_PART * max(abs(self.start), abs(self.target)))
        if self.over(t):
            tolerance = max(DEVIATION_V, DEVIATION_PART * abs(self.target))
        else:
            tolerance += self.rate * LAG_S
        return min(ends) - tolerance, max(ends) + tolerance

    def _latest(self, t: float) -> float:
        """Where an output is that obeys as late, and goes as slowly, as it may."""
        begins = self._confirmed + BEGINS_S  # NaN while it is not confirmed
        until = min(t, begins) if math.isfinite(begins) else t
        late = _towards(self.start, self.before, FASTEST * self.rate * (until - self.begun))
        if abs(late - self.target) < abs(self.start - self.target):  # the same way as now
            late = self.start
        if not t > begins:
            return late
        slowest = SLOWEST_UP if self.target > late else SLOWEST_DOWN
        return _towards(late, self.target, slowest * self.rate * (t - begins))


def _towards(start: float, end: float, way: float) -> float:
    """From ``start`` so far towards ``end``, and no further."""
    whole = end - start
    return end if way >= abs(whole) else start + math.copysign(max(way, 0.0), whole)


def ramp_limit(duration: float) -> float:
    """How long a ramp down that should take ``duration`` may take in all (s)."""
    return duration * RAMP_MARGIN + RAMP_GRACE_S
