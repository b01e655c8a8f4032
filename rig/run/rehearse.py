"""What a run would refuse when it meets its instruments, asked of the simulated ones before."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rig.engine.engine import Engine
from rig.log.nowhere import NoLog
from rig.operator.control import Control
from rig.protocol.experiment import Experiment, gains_of
from rig.run.backend import open_bench

if TYPE_CHECKING:
    from rig.log.writer import LogWriter


def check_instruments(experiment: Experiment) -> None:
    """Set the simulated bench in memory up as a run does, and hold the plan against what its instruments can do.

    Their own limits of voltage, ramp and current, the stage's travel, serial numbers and units. Nothing is moved and no
    output changed. A bench on real ports, or a log in its place, is left alone: it is asked when the run begins.

    Raises
    ------
    RigError, drivers.links.link.DeviceError
        What the run would end with before its first step.
    """
    if experiment.scene.on_real_ports or experiment.scene.bench is not None:
        return
    bench = open_bench(experiment.scene)
    try:
        Engine(
            bench,
            experiment.actions,
            cast("LogWriter", NoLog()),
            gains_of(experiment.certificates),
            Control(unattended="a check"),
            lambda done, total, label: None,
            experiment.certificates,
        ).set_up()
    finally:
        bench.close()
