"""``dea-rig keys``: every key of every file: unit, meaning, default, range."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pydantic import BaseModel

    from rig.base.reference import Key

WIDTH = 80


@click.command("keys")
@click.argument("what", required=False)
@click.option("--json-schema", is_flag=True, help="A JSON Schema of the file, from which editors complete.")
def command(what: str | None, json_schema: bool) -> None:
    """Print the keys of WHAT: unit, meaning, default, range.

    WHAT is a file (scene, protocol, certificate, simulation, study, fixture), a protocol step (sweep), an instrument
    (gsv8) or a law of a material (ogden). Without it, the names of all.
    """
    import json

    from rig.base.errors import ConfigError
    from rig.cli.topics import FILES, names, tables_of

    if what is None:
        click.echo("dea-rig keys WHAT, where WHAT is one of:")
        for title, some in names().items():
            click.echo(textwrap.fill(", ".join(some), WIDTH, initial_indent=f"  {title}: ", subsequent_indent="    "))
        return
    if json_schema:
        if what not in FILES:
            raise ConfigError(f"There is a schema of {', '.join(FILES)}; {what!r} is a part of one of them.")
        click.echo(json.dumps(FILES[what].schema(), indent=2))
        return
    click.echo("\n\n".join("\n".join(_lines(title, table)) for title, table in tables_of(what)))


def _lines(title: str, table: type[BaseModel]) -> Iterator[str]:
    """One table as text, 80 columns wide."""
    from rig.base.reference import keys_of

    yield title
    about = " ".join((table.__doc__ or "").split("\n\n")[0].split()).replace("`", "")
    yield from textwrap.wrap(about, WIDTH, initial_indent="  ", subsequent_indent="  ")
    for key in keys_of(table):
        if f"{key.name} = {key.allowed}" in title:  # the key that says which table this is
            continue
        yield _heading(key)
        yield from textwrap.wrap(key.text, WIDTH, initial_indent="      ", subsequent_indent="      ")


def _heading(key: Key) -> str:
    """``  thickness_um = 40.0   number, greater than 0``: with its default, if it has one."""
    start = f"  {key.name}" + (f" = {key.default}" if key.default else "")
    state = "needed" if key.needed else ""
    rest = ", ".join(part for part in (state, key.kind, key.allowed) if part)
    return (
        textwrap.shorten(f"{start}   {rest}", WIDTH, placeholder=" ...")
        if len(start) + len(rest) + 3 > WIDTH
        else (f"{start}   {rest}")
    )
