"""The recorded logs, made anew by the documented command's own function."""

from __future__ import annotations

import numpy as np
import pytest

from rig.benchmark.fixtures import LOGS, arithmetic, made_on, names, record
from rig.log.reader import read_log
from rig.log.schema import ROLES

pytestmark = pytest.mark.slow

# Where the arithmetic is another than that of the machine that made them: a last digit may tip a conversion over.
NEAR = {"reading": 1e-5, "reading_m": 3e-7, "position_m": 2e-6, "voltage_V": 0.1, "setpoint_V": 1e-3}


@pytest.mark.parametrize("name", names())
def test_made_anew(name, tmp_path):
    kept, made = LOGS / name / "log.mcap", tmp_path / "log.mcap"
    record(name, made)
    if arithmetic(name) == made_on()[name]:
        assert made.read_bytes() == kept.read_bytes(), (
            f"{name}: the same arithmetic gives another log. If the change is meant, make them anew: .ci/fixtures"
        )
        return
    then, now = read_log(kept), read_log(made)
    assert now.topics == then.topics
    assert (now.outcome or {}).get("status") == (then.outcome or {}).get("status")
    for topic in (f"/{role}/sample" for role in ROLES if f"/{role}/sample" in then.topics):
        before, after = then.columns(topic), now.columns(topic)
        for column in NEAR.keys() & before.keys():
            np.testing.assert_allclose(after[column], before[column], rtol=0, atol=NEAR[column], err_msg=name)
