"""``dea-rig design``: a study from its file to its pictures, on this machine or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import click

from rig.base.clock import RealClock
from rig.base.errors import ConfigError
from rig.base.progress import progress
from rig.cli.show import show
from rig.design.run import run_study
from rig.design.study import load_study


def carry_out(study_file: Path, out: Path, workers: int, dask: str | None, compare: bool) -> None:
    """Load, compute, write, and print the tables.

    Raises
    ------
    ConfigError
        When the study cannot be used, an output exists, or Dask is asked for and not there.
    """
    study = load_study(study_file)
    clock = RealClock()
    with executor(workers, dask) as pool, progress(study.title or study_file.stem) as update:
        outcome = run_study(study, study_file.stem, out, pool, update, compare=compare)
    show(*outcome.show)
    click.echo(f"{clock.now():.1f} s; written: {', '.join(str(file) for file in outcome.files)}")


@contextmanager
def executor(workers: int, dask: str | None) -> Iterator[Executor | None]:
    """What carries a sweep: nothing, processes of this machine, or a Dask cluster."""
    if dask is not None:
        try:
            from distributed import Client
        except ImportError:
            raise ConfigError("Dask is not installed: uv sync --extra dask.") from None
        with Client(dask) as client:  # type: ignore[no-untyped-call,unused-ignore]
            yield client.get_executor()
    elif workers > 1:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield pool
    else:
        yield None
