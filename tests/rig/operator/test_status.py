"""The status line: numbers with their units, cut between words, whatever the width."""

from __future__ import annotations

import math

import pytest

from rig.operator.status import Status, minutes

STATUS = Status(
    step=5,
    steps=6,
    done=0.434,
    left=83.2,
    label="step 5 sweep: 0 to 6 mm at 1000 V",
    force=0.12345,
    displacement=4.125e-3,
    voltage=1000.4,
    current=0.21e-6,
    field=35.12e6,
    nearest="field",
    nearest_part=0.439,
)


def test_everything_is_there_with_its_unit() -> None:
    assert STATUS.line(200, "SIMULATED") == (
        "SIMULATED | step 5 of 6 | 43 %, 1 min 23 s left | 0.123 N, 4.12 mm, 1000 V, 0.2 uA, 35.1 V/um, "
        "field at 44 % of its limit | step 5 sweep: 0 to 6 mm at 1000 V"
    )


@pytest.mark.parametrize("width", range(12, 180))
def test_it_fits_and_no_word_is_cut(width: int) -> None:
    line = STATUS.line(width, "REAL PORTS")
    assert len(line) <= width
    assert set(line.split()) <= set(STATUS.line(500, "REAL PORTS").split())
    assert line.startswith("REAL PORTS")


def test_what_is_not_known_is_left_out() -> None:
    bare = Status(1, 6, 0.0, 160.0, "step 1 home: find the reference position")
    assert bare.line(120) == "step 1 of 6 | 0 %, 2 min 40 s left | step 1 home: find the reference position"


def test_noise_below_zero_is_shown_as_zero() -> None:
    assert Status(1, 6, 0.0, 1.0, "", voltage=-0.3, current=-1e-9).numbers == "0 V, 0.0 uA"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599, "59 min 59 s"), (3600, "1 h 00 min"), (-1, "0 s")],
)
def test_times_are_read_at_a_glance(seconds: float, text: str) -> None:
    assert minutes(seconds) == text
    assert minutes(math.nan) == "unknown time"
