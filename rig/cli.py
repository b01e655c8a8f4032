"""The command line: thin commands over the rooms of the house."""

from __future__ import annotations

import click


@click.group()
@click.version_option(package_name="dea-rig")
def main() -> None:
    """Characterise conical dielectric elastomer actuators on a bench, real or simulated."""
