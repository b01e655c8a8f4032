"""Progress of something long: a bar with the time left on a terminal, a line a step elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

from rig.base.clock import RealClock


@contextmanager
def progress(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Yield ``update(done, total, label)``. Time left is by the host's clock, from what has been done so far."""
    if sys.stderr.isatty():
        yield from _bar(title)
    else:
        yield from _lines(title)


def _bar(title: str) -> Iterator[Callable[[float, float, str], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )
    console = Console(stderr=True, markup=False, emoji=False)
    console.print(title)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, label: bar.update(task, completed=done, total=total, description=label)


def _lines(title: str) -> Iterator[Callable[[float, float, str], None]]:
    click.echo(title, err=True)
    clock = RealClock()
    last = ""

    def update(done: float, total: float, label: str) -> None:
        nonlocal last
        if label != last:
            last = label
            left = f"{clock.now() * (total - done) / done:4.0f} s left" if done > 0.01 * total else ""
            click.echo(f"  {100 * done / total:3.0f} %  {left:11}  {label}", err=True)

    yield update
