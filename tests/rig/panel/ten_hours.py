"""A log of ten hours that grows as fast as it can be written."""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

from rig.log.writer import LogWriter

FORCE_HZ, EVENT_EVERY_S = 10, 20
SCENE = Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml"


def ten_hours(log: Path) -> Iterator[float]:
    """Write it; stops after a half, 1, 4, 7 and 10 hours with the run's time, everything before it on disk."""
    with LogWriter(log) as writer:
        writer.attach("scene.toml", "application/toml", SCENE.read_bytes())
        for tenth in range(36_000 * FORCE_HZ):
            t = tenth / FORCE_HZ
            ns = round(t * 1e9)
            fields = {"t_s": t, "reading": 0.1, "force_N": 0.2 + 0.1 * math.sin(t / 50), "flags": 0}
            writer.write("/force/sample", fields, ns, ns)
            if tenth % FORCE_HZ == 0:
                hv = {"t_s": t, "voltage_V": 800.0, "current_A": 1e-7, "setpoint_V": 800.0, "flags": 1}
                writer.write("/hv/sample", hv, ns, ns)
            if tenth % (EVENT_EVERY_S * FORCE_HZ) == 0:
                event = {"t_s": t, "severity": "info", "source": "run", "message": f"Hold {tenth}: 20 s at 800 V."}
                writer.write("/event", event, ns, ns)
            if tenth % 1000 == 0:
                writer.tick(t)
            if t in (1800.0, 3600.0, 14_400.0, 25_200.0, 35_990.0):
                writer.tick(t + 10.0)
                yield t
        writer.finish({"status": "complete", "safe": "yes", "reason": "written"})
