"""The two keys of the high voltage: two different acts of the operator, both needed, both in the log.

The first is given when the run is started (``--arm``). The second is the highest voltage, typed when the instruments
have answered and the supply has been measured off. It is used up by every way back to SAFE: after a pause, after a
prompt at which somebody may have touched the rig, it has to be given again.
"""

from __future__ import annotations

from rig.base.errors import FaultError


def undetectable(second: str) -> str:
    """What no software can see, said whenever high voltage is asked for on ports. ``second`` names the second reading
    of the voltage; empty: there is none."""
    if second:
        known = f"A second reading of the voltage ({second}) must agree with the supply; off is only what both show."
        hidden = ""
    else:
        known, hidden = (
            "There is no second reading of the voltage.",
            "a supply whose status and reading are wrong at once; ",
        )
    return (
        f"{known} What cannot be detected from here: {hidden}program and guard both stopped; power lost. Interlock, "
        "emergency stop and grounding stick are for that."
    )


class Arming:
    """Whether the operator allows high voltage, and how much.

    Parameters
    ----------
    requested : str
        The first act, in words for the log; empty when it was not done.
    """

    def __init__(self, requested: str) -> None:
        self.requested = requested
        self.confirmed = ""
        self._highest = 0.0

    def confirm(self, highest: float, by: str) -> None:
        """The second act: voltages up to ``highest`` are allowed until `withdraw`."""
        self._highest, self.confirmed = highest, by

    def withdraw(self) -> None:
        """The second act is used up."""
        self._highest, self.confirmed = 0.0, ""

    def allows(self, volts: float) -> bool:
        """Whether both acts were done, and name at least this voltage; False for NaN."""
        return bool(self.requested) and bool(self.confirmed) and volts <= self._highest

    def check(self, volts: float) -> None:
        """Raise unless both acts were done.

        Raises
        ------
        FaultError
            Naming the act that is missing.
        """
        if self.allows(volts):
            return
        missing = "asked for" if not self.requested else "confirmed" if not self.confirmed else "confirmed so high"
        raise FaultError(f"hv: {volts:g} V refused: high voltage was not {missing} by the operator.")
