"""``dea-rig benchmark ...``: measurements of the project itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click


@click.group()
def benchmark() -> None:
    """Measure: error against run time, stability. Quick by default."""


def _benchmark_options(command: Callable[..., None]) -> Callable[..., None]:
    command = click.option("--full", is_flag=True, help="The whole grid; takes many minutes.")(command)
    folder = click.Path(path_type=Path, file_okay=False)
    return click.option("--out", type=folder, default="benchmarks", show_default=True, help="For JSON, CSV, PNG.")(
        command
    )


@benchmark.command("solver")
@_benchmark_options
def benchmark_solver(full: bool, out: Path) -> None:
    """Error of the membrane solver and of other methods against their run time."""
    from rig.benchmark import solver

    _benchmark(solver.run, solver.render, "solver", full, out)


@benchmark.command("extremes")
@_benchmark_options
def benchmark_extremes(full: bool, out: Path) -> None:
    """The solver in extreme states: statuses, and true error against the error it states."""
    from rig.benchmark import extremes

    _benchmark(extremes.run, extremes.render, "extremes", full, out)


@benchmark.command("fit")
@_benchmark_options
def benchmark_fit(full: bool, out: Path) -> None:
    """Error of the identified film against compute time and against the time of the rig."""
    from rig.benchmark import fit

    _benchmark(fit.run, fit.render, "fit", full, out)


@benchmark.command("rates")
@_benchmark_options
def benchmark_rates(full: bool, out: Path) -> None:
    """Samples lost and processor used with all serial drivers on pseudo-terminals, force at 1 kHz."""
    from rig.benchmark import rates

    _benchmark(rates.run, rates.render, "rates", full, out)


@benchmark.command("log")
@_benchmark_options
def benchmark_log(full: bool, out: Path) -> None:
    """Messages written a second, time to load ten minutes at 1 kHz, the disk's patience, cost of damaged logs."""
    from rig.benchmark import log

    _benchmark(log.run, log.render, "log", full, out)


@benchmark.command("safety")
@_benchmark_options
def benchmark_safety(full: bool, out: Path) -> None:
    """How soon the voltage is off when the engine or the guard is killed or hangs, over real processes."""
    from rig.benchmark import safety

    _benchmark(safety.run, safety.render, "safety", full, out)


def _benchmark(run: Callable[..., Any], render: Callable[..., Any], name: str, full: bool, out: Path) -> None:
    from rig.base.progress import progress
    from rig.cli.show import show

    with progress(f"benchmark {name}") as update:
        report = run(full, out, lambda share, what: update(share, 1.0, what))
    show(render(report))
    click.echo(f"written to {out}/")
