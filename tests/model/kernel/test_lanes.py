"""The larger and the smaller of two numbers in the kernel: what is not a number is never lost."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from pathlib import Path

import pytest

from model.kernel import build
from model.kernel.library import HERE

SOURCE = """
#include "lanes.h"
void larger_and_smaller(const double *x, const double *y, double *out) {
    Real one, two, most, least;
    memcpy(&one, x, sizeof one);
    memcpy(&two, y, sizeof two);
    most = larger(one, two);
    least = smaller(one, two);
    memcpy(out, &most, sizeof most);
    memcpy(out + LANES, &least, sizeof least);
}
"""


@pytest.mark.parametrize("lanes", [1, 2])
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler (cc)")
def test_a_missing_number_wins_in_either_place(tmp_path: Path, lanes: int) -> None:
    source, made = tmp_path / "lanes.c", tmp_path / "lanes.so"
    source.write_text(SOURCE)
    command = ["cc", *build.flags("cc"), f"-DLANES={lanes}", f"-I{HERE}", str(source), "-o", str(made), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    numbers = ctypes.c_double * 4
    for x, y in ((math.nan, 1.0), (1.0, math.nan), (math.nan, math.inf), (math.nan, math.nan), (1.0, 2.0), (2.0, 1.0)):
        one, two, out = numbers(x, 5.0), numbers(y, 6.0), numbers()
        ctypes.CDLL(str(made)).larger_and_smaller(one, two, out)
        most, least = out[0], out[lanes]
        if math.isnan(x + y):
            assert math.isnan(most)
            assert math.isnan(least)
        else:
            assert (most, least) == (2.0, 1.0)
        if lanes > 1:  # its neighbour is left alone
            assert (out[1], out[lanes + 1]) == (6.0, 5.0)
