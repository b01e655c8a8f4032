"""``dea-rig new-driver``: the files of a driver of your own, to be filled in."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FOLDER

ROLES = ("stage", "force", "displacement", "hv", "monitor")


@click.command("new-driver")
@click.argument("name")
@click.option("--role", type=click.Choice(ROLES), required=True, help="What the instrument does on the rig.")
@click.option("-o", "--out", type=FOLDER, help="New folder to write; default: NAME.")
def command(name: str, role: str, out: Path | None) -> None:
    """Write a driver, its simulated twin and its transcript test as a package that can be installed.

    The skeleton works from the start against its twin, with a protocol that is made up: replace that by yours, part by
    part. A new stage or supply can only be read: its commands are refused until you write them. The page on drivers
    (drivers/README.md) goes through it.
    """
    from rig.base.errors import ConfigError
    from rig.scene.skeleton import check_name, write_skeleton

    folder = out or Path(name)
    check_name(name, role)
    if folder.exists():
        raise ConfigError(f"{folder} exists already; nothing is overwritten. Name a new folder with --out.")
    files = write_skeleton(name, role, folder)
    click.echo(f"Written to {folder}: {', '.join(files)}.")
    click.echo(f"  test it:  cd {folder} && python -m pytest")
    click.echo(f"  install:  pip install -e {folder}, into the environment that dea-rig is in")
    click.echo(f'  name it:  [{role}] driver = "{name}" in a scene; dea-rig check, then run')
