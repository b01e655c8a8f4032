"""``dea-rig design``: a design study, from its file to its pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE, FOLDER

if TYPE_CHECKING:
    from concurrent.futures import Executor


@click.command("design")
@click.argument("study", type=FILE)
@click.option("--out", type=FOLDER, default="designs", show_default=True)
@click.option("--workers", type=click.IntRange(1, 256), default=1, show_default=True, help="Processes for maps.")
@click.option("--dask", metavar="ADDRESS", help="Dask scheduler that carries maps, e.g. tcp://10.0.0.5:8786.")
@click.option(
    "--compare",
    is_flag=True,
    help="Time the paper's shooting method on a sample of a map too; of a map that is there already, only that.",
)
def command(study: Path, out: Path, workers: int, dask: str | None, compare: bool) -> None:
    """Carry out STUDY (TOML): pictures, CSV, and the paper's claims beside the same computed here."""
    from rig.base.clock import RealClock
    from rig.base.progress import progress
    from rig.cli.show import show
    from rig.design.run import run_study
    from rig.design.study import load_study

    wanted = load_study(study)
    clock = RealClock()
    with _executor(workers, dask) as pool, progress(wanted.title or study.stem) as update:
        outcome = run_study(wanted, study.stem, out, pool, update, compare=compare)
    show(*outcome.show)
    written = f"; written: {', '.join(str(file) for file in outcome.files)}" if outcome.files else ""
    click.echo(f"{clock.now():.1f} s{written}")


@contextmanager
def _executor(workers: int, dask: str | None) -> Iterator[Executor | None]:
    """What carries a sweep: nothing, processes of this machine, or a Dask cluster."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from rig.base.errors import ConfigError

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
