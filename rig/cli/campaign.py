"""``dea-rig campaign``: many specimens, one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import FILE, FILE_OR_STDIN, FOLDER, read_ports, tell_written

if TYPE_CHECKING:
    from rig.campaign.campaign import Campaign
    from rig.campaign.progress import Done
    from rig.protocol.experiment import Experiment


@click.group("campaign")
def command() -> None:
    """Many specimens, one after the other: run, status, resume, report."""


def _running(function: Any) -> Any:
    for option in reversed(
        (
            click.option("--ports", type=FILE_OR_STDIN, help="Ports by role, as for `dea-rig run`."),
            click.option("--arm", is_flag=True, help="As for `dea-rig run`."),
            click.option("--yes", is_flag=True, help="Answer every question as expected: for simulated benches."),
            click.option("--take-down", is_flag=True, help="As for `dea-rig run`."),
            click.option("--clear", is_flag=True, help="As for `dea-rig run`; holds for the first run."),
            click.option("--skip", multiple=True, metavar="NAME", help="Leave this specimen out this time."),
            click.option("--again", multiple=True, metavar="NAME", help="Do this one, which failed, once more."),
            click.option("--most", type=click.IntRange(min=1), help="End after so many specimens."),
        )
    ):
        function = option(function)
    return click.argument("campaign", type=FILE)(function)


@command.command("run")
@_running
def run(campaign: Path, **options: Any) -> None:
    """Do the specimens of CAMPAIGN that wait, in its order; what is done is read from its logs."""
    _go(campaign, resume=False, **options)


@command.command("resume")
@_running
def resume(campaign: Path, **options: Any) -> None:
    """Go on with CAMPAIGN: the specimen whose run was cut short or stopped at its step, then those that wait."""
    _go(campaign, resume=True, **options)


@command.command("status")
@click.argument("campaign", type=FILE)
def status(campaign: Path) -> None:
    """Which specimens of CAMPAIGN are done, which wait, and what comes next."""
    from rich.table import Table

    from rig.base.text import printable
    from rig.campaign.campaign import load_campaign
    from rig.campaign.progress import Standing, progress_of
    from rig.cli.show import show

    found = progress_of(load_campaign(campaign))
    table = Table()
    for heading in ("", "specimen", "batch", "is", "newest log", "ended"):
        table.add_column(heading, overflow="fold")
    for number, one in enumerate(found, 1):
        newest = one.newest
        row = (one.specimen.name, one.specimen.batch, one.standing.value)
        log = ("", "") if newest is None else (newest.log, newest.outcome)
        table.add_row(str(number), *(printable(text) for text in (*row, *log)))
    show(table)
    counts = {kind: sum(one.standing is kind for one in found) for kind in Standing}
    click.echo(", ".join(f"{count} {kind.value}" for kind, count in counts.items() if count))


@command.command("report")
@click.argument("campaign", type=FILE)
@click.option("-o", "--out", type=FILE, help="The table as CSV, SI units in the headings.")
@click.option("--page", type=FILE, help="One self-contained HTML page: table, statistics, pictures, certificates.")
@click.option("--crate", type=FOLDER, help="Folder for all of it with logs and scenes as a research object (RO-Crate).")
@click.option("--license", "license_", default="", metavar="URL", help="Terms of use, for the research object.")
def report(campaign: Path, out: Path | None, page: Path | None, crate: Path | None, license_: str) -> None:
    """One row for each specimen of CAMPAIGN, and over all of them: scatter, batches compared, drift over the days."""
    from rig.base.outputs import check_new, write_text
    from rig.campaign.campaign import load_campaign
    from rig.campaign.report import as_csv, as_table, certificate_problems, rows_of, statistics, statistics_table
    from rig.cli.show import show

    check_new(out, page)
    loaded = load_campaign(campaign)
    rows = rows_of(loaded)
    found = statistics(rows, loaded)
    show(as_table(loaded, rows), *([statistics_table(found)] if found else []))
    for name, problems in certificate_problems(rows, loaded).items():
        click.echo(f"certificates of {name}: {'; '.join(problems)}")
    logs = loaded.table.logs
    click.echo(f"More: dea-rig fit {logs}, dea-rig analyse breakdown {logs}/*.mcap")
    if page is not None or crate is not None:
        from rig.campaign.page import page as made

        text = made(loaded, rows, found)
        if crate is not None:
            from rig.analysis.campaign_crate import PAGE, TABLE, write_crate

            write_crate(loaded, rows, found, {TABLE: as_csv(rows), PAGE: text}, crate, license_)
        if page is not None:
            write_text(page, text)
    if out is not None:
        write_text(out, as_csv(rows))
    tell_written(out, page, crate)


def _go(
    path: Path,
    *,
    resume: bool,
    ports: Path | None,
    arm: bool,
    yes: bool,
    take_down: bool,
    clear: bool,
    skip: tuple[str, ...],
    again: tuple[str, ...],
    most: int | None,
) -> None:
    from dataclasses import replace

    from drivers.links.link import DeviceError
    from rig.base.errors import FaultError, LimitError, NotSafe, RigError
    from rig.campaign.campaign import load_campaign
    from rig.campaign.progress import Standing, failed_in_a_row, next_log, progress_of
    from rig.cli.running import run_and_tell

    campaign = load_campaign(path)
    for name in (*skip, *again):
        campaign.number(name)
    given = read_ports(ports)
    for specimen in campaign.specimens:  # what cannot be used is said before the first is mounted
        campaign.prepare(specimen, given)
    campaign.logs.mkdir(parents=True, exist_ok=True)
    left_again, count = set(again), 0
    while most is None or count < most:
        found = progress_of(campaign)
        one = _next(found, set(skip), left_again, resume)
        if one is None:
            click.echo(f"{path}: nothing is left to do. `dea-rig campaign report {path}` shows the results.")
            return
        failed = failed_in_a_row(found)
        if failed >= campaign.table.most_failed_in_a_row and not (again or count == 0):
            raise RigError(
                f"{path}: {failed} runs in a row did not end complete, and most_failed_in_a_row = "
                f"{campaign.table.most_failed_in_a_row}. Find the cause; `dea-rig campaign run {path}` goes on."
            )
        count += 1
        left_again.discard(one.specimen.name)
        out = next_log(campaign, one)
        experiment, words = _experiment(campaign, one, given, resume and one.standing is Standing.INTERRUPTED)
        number = campaign.number(one.specimen.name)
        experiment = replace(experiment, campaign=campaign.told(one.specimen))
        click.echo(f"Specimen {number} of {len(found)}: {one.specimen.name}{words}, into {out}")
        if not yes and experiment.scene.on_real_ports:
            note = f" ({one.specimen.note})" if one.specimen.note else ""
            if not click.confirm(f"Specimen {one.specimen.name}{note} is mounted, nobody touches the rig?"):
                click.echo("Nothing was touched.")
                return
        try:
            run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down, clear=clear and count == 1)
        except NotSafe:
            raise
        except (FaultError, LimitError, DeviceError) as error:
            if not out.exists():  # nothing was done with it: a port that is not there will not be there for the next
                raise
            # This specimen has failed; the next one may not.
            click.echo(f"{one.specimen.name}: {error}", err=True)
            for text in getattr(error, "__notes__", ()):
                click.echo(text, err=True)


def _next(found: list[Done], skip: set[str], again: set[str], resume: bool) -> Done | None:
    """The first specimen that is to be done now.

    Raises
    ------
    ConfigError
        An interrupted one, which `run` does not begin anew.
    """
    from rig.base.errors import ConfigError
    from rig.campaign.progress import Standing

    for one in found:
        name = one.specimen.name
        if name in skip:
            continue
        if one.standing is Standing.INTERRUPTED and not resume and name not in again:
            assert one.newest is not None
            raise ConfigError(
                f"{one.newest.log}: the run of {name} was interrupted ({one.newest.outcome}). `campaign resume` goes "
                f"on at its step; `campaign run --again {name}` begins anew; `--skip {name}` leaves it out. Nothing "
                "was touched."
            )
        if one.standing in (Standing.WAITING, Standing.INTERRUPTED) or name in again:
            return one
    return None


def _experiment(campaign: Campaign, one: Done, ports: Any, resumed: bool) -> tuple[Experiment, str]:
    """What is done with it now, and that in words: the whole, or the rest of a run that had begun."""
    from rig.log.reader import read_log
    from rig.run.resume import prepare_resumed

    if resumed and one.newest is not None:
        log = campaign.logs / one.newest.log
        if "/identity" in read_log(log).topics:
            return prepare_resumed(log, ports), ", going on where it was interrupted"
    return campaign.prepare(one.specimen, ports), ""
