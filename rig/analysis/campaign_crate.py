"""A campaign as a research object (RO-Crate 1.1): its files, its logs, the table and the page, in one folder.

Source: RO-Crate Metadata Specification 1.1 (w3id.org/ro/crate/1.1); terms are those of schema.org.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

from rig.analysis.publish import CONTEXT, METADATA, NO_TERMS, PROFILE, crate_file, crate_ids
from rig.base.clock import calendar_now
from rig.base.errors import ConfigError
from rig.base.outputs import write_text
from rig.campaign.campaign import SCENES, Campaign
from rig.campaign.report import Row
from rig.campaign.statistics import Statistics

TABLE, PAGE = "specimens.csv", "report.html"


def write_crate(
    campaign: Campaign, rows: list[Row], found: list[Statistics], texts: dict[str, str], crate: Path, license_: str
) -> None:
    """Write the folder ``crate``; it appears whole or not at all. ``texts`` are further files, by name.

    Raises
    ------
    ConfigError
        The folder is there already, or cannot be written.
    """
    part = crate.with_name(f".{crate.name}.part")
    if crate.exists():
        raise ConfigError(f"{crate}: there already; nothing was overwritten. Name another folder.")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        _copy(campaign, rows, part)
        for name, text in texts.items():
            write_text(part / name, text)
        write_text(part / METADATA, _metadata(campaign, found, part, license_))
        part.rename(crate)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise ConfigError(f"{crate}: cannot be written: {error.strerror}.") from None


def _copy(campaign: Campaign, rows: list[Row], part: Path) -> None:
    """Campaign, scenes, protocols and logs, where the campaign has them; what lies outside its folder, by its name."""
    folder = campaign.path.parent
    wanted = {campaign.path: campaign.path.name}
    for one in campaign.specimens:
        protocol = folder / (one.protocol or campaign.table.protocol or "")
        wanted[protocol] = protocol.name
        scene = folder / SCENES / f"{one.name}.toml"
        if scene.exists():
            wanted[scene] = f"{SCENES}/{scene.name}"
    for row in rows:
        for run in row.done.runs:
            wanted[campaign.logs / run.log] = f"logs/{run.log}"
    for source, name in wanted.items():
        (part / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, part / name)


def _metadata(campaign: Campaign, found: list[Statistics], part: Path, license_: str) -> str:
    files = sorted(path.relative_to(part).as_posix() for path in part.rglob("*") if path.is_file())
    quantities = [_quantity(k, one) for k, one in enumerate(found, 1) if math.isfinite(one.mean)]
    terms: Any = {"@id": license_} if "://" in license_ else license_ or NO_TERMS
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": campaign.table.title or campaign.path.stem,
        "description": f"{len(campaign.specimens)} specimens; the table is {TABLE}, the page {PAGE}.",
        "datePublished": calendar_now().isoformat(timespec="seconds"),
        "license": terms,
        "hasPart": crate_ids(files),
        "variableMeasured": crate_ids(one["@id"] for one in quantities),
    }
    itself = {"@id": METADATA, "@type": "CreativeWork", "conformsTo": {"@id": PROFILE}, "about": {"@id": "./"}}
    graph = [itself, root, *(crate_file(part, name) for name in files), *quantities]
    return json.dumps({"@context": CONTEXT, "@graph": graph}, indent=2, allow_nan=False) + "\n"


def _quantity(number: int, one: Statistics) -> dict[str, Any]:
    error = one.standard_uncertainty
    known = f"standard uncertainty {error:.6g}, " if math.isfinite(error) else ""
    between = f"standard deviation between specimens {one.between:.6g}, " if math.isfinite(one.between) else ""
    return {
        "@id": f"#quantity-{number}",
        "@type": "PropertyValue",
        "name": one.name,
        "value": one.mean,
        "unitText": one.unit,
        "description": f"mean of specimens, {known}{between}{one.specimens} specimens",
    }
