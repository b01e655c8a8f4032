r"""Whether the displacement sensor's unit is the stage's, proven while nothing is in contact yet.

A sensor that sees the pusher, or anything else that goes with the stage, must show its way: over each of two stretches
of a millimetre and a quarter of a second at least the ratio :math:`r = \Delta x_{sensor} / \Delta x_{stage}` is taken.
Where both are alike and far from 1, the unit or scale is wrong (a display in um, a decimal point, inches, another
screw). Samples are up to two periods apart and a sensor may be late, so that no less than a factor of 2 is meant. One
that sees the disk only shows nothing before contact; then the first millimetre in contact tells, by `rig.engine.watch`.
"""

from __future__ import annotations

from rig.base.errors import FaultError

WAY_M, LASTS_S = 1e-3, 0.25  # of the stage, for one ratio
STILL = 0.015  # a ratio below this: it sees something that stands
ALIKE = 0.2  # relative difference of two ratios that are one
LOW, HIGH = 0.5, 2.0  # far more than any calibration corrects, or a late sample feigns
NEAR = 1.25  # times one of these
LIKELY = {
    1e3: "its display is in um",
    25.4: "its unit is taken for inches, and it shows mm",
    1 / 25.4: "its display is in inches",
    **{10.0**n: "a decimal point is elsewhere" for n in (-1, 1, 2)},
}


class LaserScale:
    """Takes stage position and sensor reading (m) of one time (s), in order, while nothing is in contact."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, float, float]] = []

    def sample(self, t: float, stage: float, reading: float) -> None:
        """Judge once there are two stretches of way.

        Raises
        ------
        FaultError
            The sensor's unit is not the stage's.
        """
        if self._marks:
            before, place, _ = self._marks[-1]
            if abs(stage - place) < WAY_M or t - before < LASTS_S:
                return
        self._marks.append((t, stage, reading))
        if len(self._marks) < 3:
            return
        (_, s0, x0), (_, s1, x1), (_, s2, x2) = self._marks
        first, second = abs((x1 - x0) / (s1 - s0)), abs((x2 - x1) / (s2 - s1))
        del self._marks[0]
        larger = max(first, second)
        if larger < STILL or abs(first - second) > ALIKE * larger or LOW <= second <= HIGH:
            return
        likely = next((words for ratio, words in LIKELY.items() if 1 / NEAR <= second / ratio <= NEAR), "")
        raise FaultError(
            f"displacement: it changed by {abs(x2 - x1) * 1e3:.4g} mm while the stage moved {abs(s2 - s1) * 1e3:.4g} "
            f"mm, {second:.3g} times as much. The unit or scale of one of the two is wrong"
            f"{f': {likely}' if likely else ''}. Correct unit and scale of the sensor in the scene (unit_mm, mm_per_V, "
            "factor), its certificate, or stage.full_step_um. The film was not met yet.",
            device="displacement",
        )
