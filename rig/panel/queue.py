"""The campaign that a run belongs to, for the page: what is done, what waits, where it is now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rig.base.errors import RigError
from rig.campaign.campaign import load_campaign
from rig.campaign.progress import progress_of

RUNNING = "running"


def queue_of(log: Path, told: Mapping[str, str]) -> dict[str, Any]:
    """The queue as the page has it; ``told`` is the log's metadata ``campaign``, which names the file from the log.

    Empty where the campaign is not there any more, or cannot be read.
    """
    try:
        campaign = load_campaign(log.parent / told.get("file", ""))
        found = progress_of(campaign)
    except (RigError, OSError):
        return {}
    now = told.get("specimen", "")
    rows = [
        {
            "specimen": one.specimen.name,
            "batch": one.specimen.batch,
            "is": RUNNING if one.specimen.name == now and not log.exists() else one.standing.value,
            "note": one.specimen.note,
        }
        for one in found
    ]
    counts = Counter(row["is"] for row in rows)
    return {
        "title": campaign.table.title or campaign.path.stem,
        "words": ", ".join(f"{count} {name}" for name, count in counts.items()),
        "done": counts.get("done", 0),
        "of": len(rows),
        "rows": rows,
    }
