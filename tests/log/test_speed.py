"""A long run is written faster than it happens and loaded in seconds (of processor time: the machine may be busy)."""

import math
import time

import numpy as np
import pytest

from rig.log.dataset import load_run
from rig.log.writer import LogWriter


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_ten_minutes_at_a_kilohertz(tmp_path):
    path = tmp_path / "long.mcap"
    n = 600_000
    force = {"reading": 0.0, "force_N": 0.0, "flags": 0}
    laser = {"reading_m": 0.0, "displacement_m": 0.0, "flags": 0}
    began = time.process_time()
    with LogWriter(path) as log:
        for k in range(n):
            t, ns = k * 1e-3, k * 1_000_000
            x = math.sin(t)
            log.write("/raw/force/rx", {"t_s": t, "data": b"\xaa\x11\x22\x33\x44\x85"}, ns, ns)
            log.write("/force/sample", {**force, "t_s": t, "reading": x, "force_N": 2 * x}, ns, ns)
            log.write("/raw/displacement/rx", {"t_s": t, "data": b"M1,+01.2345\r"}, ns, ns)
            log.write("/displacement/sample", {**laser, "t_s": t, "reading_m": x, "displacement_m": 3 * x}, ns, ns)
            log.tick(t)
        log.finish({})
    assert 4 * n / (time.process_time() - began) > 20_000

    began = time.process_time()
    run = load_run(path)
    assert time.process_time() - began < 5.0
    assert len(run.t) == n
    np.testing.assert_array_equal(run.force, 2 * np.array([math.sin(k * 1e-3) for k in range(n)]))
    np.testing.assert_array_equal(run.h, 3 * np.array([math.sin(k * 1e-3) for k in range(n)]))
