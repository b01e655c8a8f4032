"""``dea-rig info``: what is in a log; with --system, what this installation runs on."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("info")
@click.argument("log", type=FILE, required=False)
@click.option("--system", is_flag=True, help="Versions, platform, and whether the membrane solver is compiled.")
def command(log: Path | None, system: bool) -> None:
    """What is in LOG: run, devices, channels and rates, gaps, outcome."""
    if log is None and not system:
        raise click.UsageError("Name a log, or ask for --system.")
    if system:
        click.echo(_system())
    if log is not None:
        from rig.log.info import info

        click.echo(info(log))


def _system() -> str:
    import platform
    from importlib.metadata import version

    from model.kernel.library import says

    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "lmfit", "mcap", "rerun-sdk"))
    return "\n".join(
        [
            f"dea-rig {version('dea-rig')}, Python {platform.python_version()}, {platform.platform()}",
            f"packages: {packages}",
            f"membrane solver: {says()}",
        ]
    )
