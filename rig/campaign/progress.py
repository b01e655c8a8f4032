"""What has been done of a campaign: read from its logs, which are the only record.

A specimen is *done* when a run of it ended complete. A run that was cut short or stopped is *interrupted*: it is
taken up again at its step. One that ended otherwise (a limit, a fault, NOT SAFE) has *failed* and is not done again by
itself.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from rig.campaign.campaign import Campaign, SpecimenTable
from rig.log.catalogue import Entry, runs_in

COMPLETE, CUT_SHORT, STOPPED = "complete", "cut short", "stopped"


class Standing(Enum):
    """What has become of a specimen."""

    WAITING = "waiting"
    DONE = "done"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class Done:
    """One specimen and its runs, the oldest first."""

    specimen: SpecimenTable
    runs: list[Entry]

    @property
    def standing(self) -> Standing:
        """By its newest run; a complete one counts whatever came later."""
        if any(run.outcome == COMPLETE for run in self.runs):
            return Standing.DONE
        if not self.runs:
            return Standing.WAITING
        return Standing.INTERRUPTED if self.runs[-1].outcome in (CUT_SHORT, STOPPED) else Standing.FAILED

    @property
    def newest(self) -> Entry | None:
        """Its last run."""
        return self.runs[-1] if self.runs else None


def progress_of(campaign: Campaign) -> list[Done]:
    """Every specimen of the campaign with its runs, in the campaign's order."""
    entries = runs_in(campaign.logs) if campaign.logs.is_dir() else []
    return [Done(one, [run for run in entries if _is_of(run.log, one.name)]) for one in campaign.specimens]


def next_log(campaign: Campaign, done: Done) -> Path:
    """The log of the next run of a specimen: NAME.mcap, then NAME.2.mcap and so on; never one that is there."""
    stem = done.specimen.name
    taken = {Path(run.log).name for run in done.runs}
    number = len(done.runs) + 1
    while True:
        name = f"{stem}.mcap" if number == 1 else f"{stem}.{number}.mcap"
        if name not in taken and f"{name}.part" not in taken and not (campaign.logs / name).exists():
            return campaign.logs / name
        number += 1


def failed_in_a_row(all_done: list[Done]) -> int:
    """How many of the newest runs of the campaign, whichever specimens, did not end complete or stopped."""
    runs = sorted((run for one in all_done for run in one.runs), key=lambda run: (run.date, run.log))
    count = 0
    for run in reversed(runs):
        if run.outcome in (COMPLETE, STOPPED):
            break
        count += 1
    return count


def _is_of(log: str, name: str) -> bool:
    return re.fullmatch(rf"{re.escape(name)}(\.\d+)?\.mcap(\.part)?", Path(log).name) is not None
