"""What a reader of a fit to tests over time must know, most serious first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.sheet.judgement import LARGEST_G, LEAST_G
from calibration.sheet.timed.problem import COARSE
from calibration.sheet.timed.record import SheetRecord
from calibration.sheet.timed.result import SheetTrace, TimedFit

LACK = 1.5  # of the misfit, from which on it is told
BADLY_PREDICTED = 0.05  # of the largest stress: a test that is missed by more is not predicted


def warnings_of(fit: TimedFit, records: Sequence[SheetRecord], predicted: Sequence[SheetTrace]) -> list[str]:
    """Sentences for people; the facts behind them are fields of the result."""
    words = []
    modulus = fit.quantities["G"].value
    if not LEAST_G <= modulus <= LARGEST_G:
        words.append(
            f"G = {modulus / 1e6:.4g} MPa is unusual: elastomers lie between {LEAST_G / 1e3:g} kPa and "
            f"{LARGEST_G / 1e6:g} MPa. Is the unit of the stress right (MPa, kPa)?"
        )
    for one in fit.tests:
        noise = float(np.sqrt(np.mean(one.deviation**2)))
        if fit.misfit > LACK and one.rms > LACK * noise:
            words.append(
                f"lack of fit in {one.name}: the residuals are {one.rms / 1e3:.3g} kPa ({one.rms / one.largest:.2%} of "
                f"the largest stress) and the noise of the means {noise / 1e3:.3g} kPa; uncertainties are larger for it"
            )
    for record in records:
        if record.pulled:
            words.append(
                f"{record.name}: the rows begin at stretch {record.stretch[0, 0]:.3g}; the sheet is taken as pulled "
                f"there from rest within {record.period:.2g} s. Record the move too where you can"
            )
    if fit.numerical > COARSE:
        words.append(f"the steps of time leave an error of {fit.numerical:.1e} of the largest stress")
    lost = [name for name, one in fit.quantities.items() if one.verdict.startswith("not")]
    if lost:
        words.append(f"not determined by these tests: {', '.join(lost)}")
    words += [
        f"{one.name} ({one.kind}) is not predicted: it is missed by {one.rms / one.largest:.1%} of its largest stress"
        for one in predicted
        if one.rms > BADLY_PREDICTED * one.largest
    ]
    if len({one.kind for one in fit.tests}) == 1 and fit.tests[0].kind != "biaxial":
        words.append(f"only {fit.tests[0].kind} data were fitted: the film in a cone is stretched in two directions")
    return words
