"""``dea-rig replay``: hold today's software against a log."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("replay")
@click.argument("log", type=FILE)
@click.option("--verify", is_flag=True, help="Recorded bytes through today's drivers: the same samples?")
@click.option("--rerun", is_flag=True, help="Today's engine and drivers, answered by LOG: the same requests?")
def command(log: Path, verify: bool, rerun: bool) -> None:
    """Hold today's software against LOG; without an option, in both ways.

    The first difference is reported: for --verify with the byte offset in what the instrument sent, its bytes, what was
    recorded and what is decoded today; for --rerun with both requests in hex and the step of the protocol.

    Exit code 0: all is as recorded; 3: all is, as far as the log is whole (it says how far); 1: something differs, or
    this version cannot read the log; 2: there is no such log.
    """
    from rig.replay.recording import load_recording
    from rig.replay.rerun import rerun as run_again
    from rig.replay.verify import verify as verify_samples

    recording = load_recording(log)
    both = not (verify or rerun)
    found = [do(recording) for do, asked in ((verify_samples, verify), (run_again, rerun)) if asked or both]
    for result in found:
        click.echo(result.report)
    codes = {result.exit_code for result in found}
    click.get_current_context().exit(1 if 1 in codes else max(codes))
