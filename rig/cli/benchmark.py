"""``dea-rig benchmark``: error against run time, and other measurements of this software."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rig.cli.files import FOLDER


@click.group("benchmark")
def command() -> None:
    """Measure: error against run time, stability. Quick by default."""


def _options(measured: Callable[..., None]) -> Callable[..., None]:
    full = click.option("--full", is_flag=True, help="The whole grid; takes many minutes.")
    out = click.option("--out", type=FOLDER, default="benchmarks", show_default=True, help="For JSON, CSV, PNG.")
    return out(full(measured))


@command.command("solver")
@_options
def _solver(full: bool, out: Path) -> None:
    """Error of the membrane solver and of other methods against their run time."""
    from rig.benchmark import solver

    _benchmark(solver.run, solver.render, "solver", full, out)


@command.command("extremes")
@_options
def _extremes(full: bool, out: Path) -> None:
    """The solver in extreme states: statuses, and true error against the error it states."""
    from rig.benchmark import extremes

    _benchmark(extremes.run, extremes.render, "extremes", full, out)


@command.command("fit")
@_options
def _fit(full: bool, out: Path) -> None:
    """Error of the identified film against compute time and against the time of the rig."""
    from rig.benchmark import fit

    _benchmark(fit.run, fit.render, "fit", full, out)


@command.command("rates")
@_options
def _rates(full: bool, out: Path) -> None:
    """Samples lost and processor used with all serial drivers on pseudo-terminals, force at 1 kHz."""
    from rig.benchmark import rates

    _benchmark(rates.run, rates.render, "rates", full, out)


@command.command("log")
@_options
def _log(full: bool, out: Path) -> None:
    """Messages written a second, time to load ten minutes at 1 kHz, how long the disk takes, cost of damaged logs."""
    from rig.benchmark import log

    _benchmark(log.run, log.render, "log", full, out)


@command.command("safety")
@click.option("--number", type=click.IntRange(1, 10_000), help="Runs of every kind, in place of the usual numbers.")
@_options
def _safety(full: bool, out: Path, number: int | None) -> None:
    """How soon the voltage is off when the engine or the guard is killed or hangs, over real processes.

    Broken off and started again with the same numbers, it goes on from where it was.
    """
    from functools import partial

    from rig.benchmark import safety

    _benchmark(partial(safety.run, number=number), safety.render, "safety", full, out)


def _benchmark(run: Callable[..., Any], render: Callable[..., Any], name: str, full: bool, out: Path) -> None:
    from model.kernel.library import says
    from rig.base.progress import progress
    from rig.cli.show import show

    with progress(f"benchmark {name}") as update:
        report = run(full, out, lambda share, what: update(share, 1.0, what))
    show(render(report))
    click.echo(f"membrane solver: {says()}")
    click.echo(f"written to {out}/")
