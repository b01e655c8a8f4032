"""What a run would refuse when it meets its instruments, and how long its log will be: asked of the simulated ones."""

from __future__ import annotations

import math
import random
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

from rig.bench.bench import Bench
from rig.engine.engine import Engine
from rig.log import schema
from rig.log.container import ContainerWriter
from rig.log.nowhere import NoLog
from rig.log.writer import SPARSE_CHUNK_SECONDS, LogWriter
from rig.operator.control import Control
from rig.protocol.experiment import Experiment, gains_of
from rig.run.backend import open_bench
from rig.steps.base import Action

REHEARSED_S, REHEARSED_M_PER_S = 4.0, 1e-3
REHEARSED_CHUNKS = 30
SCATTER = 1e-3  # relative, of what is summed up from cycle to cycle: what of a number no compression shortens


def check_instruments(experiment: Experiment) -> None:
    """Set the simulated bench in memory up as a run does, and hold the plan against what its instruments can do.

    Their own limits of voltage, ramp and current, the stage's travel, serial numbers and units. Nothing is moved and no
    output changed. A bench on real ports, or a log in its place, is left alone: it is asked when the run begins.

    Raises
    ------
    RigError, drivers.links.link.DeviceError
        What the run would end with before its first step.
    """
    if not _can_be_rehearsed(experiment):
        return
    with closing(open_bench(experiment.scene)) as bench:
        _engine(experiment, bench, NoLog()).set_up()


def log_size(experiment: Experiment) -> int | None:
    """Bytes that the log of the experiment will have, within some per cent; None where it cannot be rehearsed.

    Of the seconds in which everything is kept, by a few seconds of the simulated bench, its stage moving; of the
    summaries of cycles, by writing some. Attachments and what happens once count for nothing beside them.
    """
    if not _can_be_rehearsed(experiment):
        return None
    size = experiment.kept_s * _bytes_per_second(experiment)
    for action in experiment.actions:
        if action.summaries:
            size += action.summaries * _bytes_per_summary(experiment, action)
    return round(size)


def _bytes_per_second(experiment: Experiment) -> float:
    with TemporaryDirectory() as folder, closing(open_bench(experiment.scene)) as bench:
        log = LogWriter(Path(folder) / "rehearsal.mcap")
        with log:
            engine = _engine(experiment, bench, log)
            engine.set_up()
            before, begun = log.size, bench.clock.now()
            if bench.simulated is not None:
                stage, contact = bench.simulated.world.stage, bench.simulated.settings.contact_position_mm * 1e-3
                stage.rest(begun, contact)
                stage.ramp(begun + 1e-3, contact + REHEARSED_S * REHEARSED_M_PER_S, REHEARSED_M_PER_S)
            engine.idle(REHEARSED_S)
            return (log.size - before) / (bench.clock.now() - begun)


def _bytes_per_summary(experiment: Experiment, action: Action) -> float:
    """By as many as are written, a chunk at a time, with numbers that scatter and those left out that are not there."""
    sizes: list[int] = []
    container = ContainerWriter(lambda data: sizes.append(len(data)))
    channel = container.add_channel("/cycle", schema.schema_name("/cycle"), schema.schema_data("/cycle"))
    rng, period = random.Random(1), action.duration / action.summaries
    doubles = [f.name for f in schema.CHANNELS["/cycle"].fields if f.type == "double"]
    a_chunk = max(math.ceil(SPARSE_CHUNK_SECONDS / period), 1)
    before, count = sum(sizes), 0
    for _ in range(REHEARSED_CHUNKS):
        for _ in range(a_chunk):
            count += 1
            t = count * period
            row: dict[str, float | int | bool] = {name: 0.1 * (1.0 + SCATTER * rng.gauss()) for name in doubles}
            row |= dict.fromkeys(_not_measured(experiment, action), math.nan)
            row |= {"t_s": t, "begin_s": t - period, "cycle": count, "step": action.step, "samples": 100}
            row |= {"whole": True, "kept": False}
            container.add_message(channel, schema.encode("/cycle", row), round(t * 1e9), round(t * 1e9))
        container.end_chunk()
    return (container.size - before) / count


def _not_measured(experiment: Experiment, action: Action) -> list[str]:
    """Fields of a summary that have no value on this bench."""
    hv = experiment.scene.hv
    names = ["actuation_N_per_V2"] if action.moves else ["stiffness_N_per_m"]
    if hv is None:
        names += ["voltage_valley_V", "voltage_peak_V"]
    if hv is None or not hv.measures_current:
        names += ["current_valley_A", "current_peak_A", "electric_J", "leakage_A"]
    return names


def _can_be_rehearsed(experiment: Experiment) -> bool:
    return not experiment.scene.on_real_ports and experiment.scene.bench is None


def _engine(experiment: Experiment, bench: Bench, log: LogWriter | NoLog) -> Engine:
    return Engine(
        bench,
        experiment.actions,
        cast("LogWriter", log),
        gains_of(experiment.certificates),
        Control(unattended="a check"),
        lambda done, total, label: None,
        experiment.certificates,
    )
