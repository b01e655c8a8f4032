"""``dea-rig publish``: a result with its data as a folder that others can cite and fit again."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import click

from rig.cli.files import FOLDER, read_json


@click.command("publish")
@click.argument("result", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=FOLDER, help="Folder to write; default: RESULT-crate beside RESULT.")
@click.option(
    "--license",
    "terms",
    default="",
    help="Terms of use, by address or name, e.g. https://creativecommons.org/licenses/by/4.0/; default: none stated.",
)
@click.option("--author", "authors", multiple=True, metavar="NAME", help='Who did it: "Ada L. <0000-0002-1825-0097>".')
@click.option("--title", default="", help="Title of the data set; default: made from the result.")
@click.option("--data", "moved", type=FOLDER, help="Folder in which the data are now, if they were moved.")
@click.option("--check", is_flag=True, help="Fit the crate RESULT again and compare; exit code 1 where digits differ.")
def command(
    result: Path,
    out: Path | None,
    terms: str,
    authors: tuple[str, ...],
    title: str,
    moved: Path | None,
    check: bool,
) -> None:
    """Write RESULT of `fit` or `fit-tests` with its data as a research object (RO-Crate 1.1).

    The folder holds the data, the settings, the versions and the command that fits them again to the same digits. With
    --check RESULT is such a folder.
    """
    if check:
        _check(result)
        return
    from rig.analysis.publish import NO_TERMS, About, publish

    out = out or result.with_name(f"{result.stem}-crate")
    written = publish(result, out, About(terms or NO_TERMS, title, authors), moved)
    if not terms:
        click.echo("note: no terms of use are stated, so nobody may use the data: --license NAME states them")
    click.echo(f"written: {out} ({len(written)} files); `dea-rig publish --check {out}` fits it again")


def _check(crate: Path) -> None:
    from rig.analysis.publish import MOST_BYTES, SAME, differences, of_crate
    from rig.cli.app import main

    recipe = of_crate(crate)
    with TemporaryDirectory() as folder:
        again = Path(folder) / "again.json"
        words = recipe.words([one.path for one in recipe.inputs])
        main([*words, "-o", str(again)], standalone_mode=False)
        found = differences(recipe.result, read_json(again, "result", MOST_BYTES))
    worst = max(found, key=lambda name: found[name])
    if found[worst] > SAME:
        click.echo(f"NOT the same: {worst} differs by {found[worst]:.2g} of its size.", err=True)
        raise SystemExit(1)
    exact = "to the last bit" if found[worst] == 0.0 else f"within {found[worst]:.1g} of their size"
    click.echo(f"the same: {len(found)} quantities {exact}")
