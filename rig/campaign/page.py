"""A campaign as one self-contained HTML page: its specimens, statistics over them, pictures, certificates."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from calibration.report.figures import RC, STYLES
from rig.campaign.campaign import Campaign
from rig.campaign.report import Row, bounds_words, certificate_problems, statistics_cells
from rig.campaign.statistics import DAY_S, Statistics

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
td, th { border-bottom: 1px solid #ddd; padding: .25rem .6rem; text-align: left; white-space: nowrap; }
svg { max-width: 100%; height: auto; } .bad { color: #a30000; }
"""
HEADS = ("result", "specimens", "mean (95 % interval)", "between specimens", "within", "groups differ: p")
MOST_SHOWN = 8  # results with a picture


def page(campaign: Campaign, rows: list[Row], found: list[Statistics]) -> str:
    """The page as HTML."""
    title = html.escape(campaign.table.title or campaign.path.name)
    done = sum(row.done.standing.value == "done" for row in rows)
    parts = [
        f"<h1>{title}</h1>",
        f"<p>{len(rows)} specimens, {done} done. Standard deviations between and within specimens by random effects. "
        f"{html.escape(bounds_words(found))}</p>",
        "<h2>Specimens</h2>",
        _specimens(rows),
        "<h2>Over all specimens</h2>",
        _table([*HEADS, "drift per day", "bounds"], statistics_cells(found)) if found else "<p>No results yet.</p>",
    ]
    groups = [
        [f"{one.name} / {one.unit}", name or "(no batch)", str(group.specimens),
         f"{group.mean:.4g} +- {group.standard_uncertainty:.2g}" if group.specimens > 1 else f"{group.mean:.4g}"]
        for one in found for name, group in one.groups.items() if len(one.groups) > 1
    ]  # fmt: skip
    if groups:
        parts += ["<h2>Batches</h2>", _table(["result", "batch", "specimens", "mean +- standard uncertainty"], groups)]
    shown = [one for one in found if one.specimens > 1 and one.between > 0][:MOST_SHOWN]
    if shown:
        parts += ["<h2>Pictures</h2>", *(_picture(one) for one in shown)]
    parts += ["<h2>Certificates</h2>", _certificates(certificate_problems(rows, campaign))]
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>\n"
    )


def _specimens(rows: list[Row]) -> str:
    cells = []
    for row in rows:
        newest, one = row.done.newest, row.done
        date = newest.date[:16].replace("T", " ") if newest else ""
        cells.append([one.specimen.name, one.specimen.batch, one.standing.value, str(len(one.runs)), date, row.found])
    return _table(["specimen", "batch", "is", "runs", "date (UTC)", "found"], cells)


def _certificates(problems: dict[str, list[str]]) -> str:
    if not problems:
        return "<p>Nothing speaks against the certificates of any run.</p>"
    lines = [f"<li>{html.escape(name)}: {html.escape(text)}</li>" for name, texts in problems.items() for text in texts]
    return f'<ul class="bad">{"".join(lines)}</ul>'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _picture(one: Statistics) -> str:
    """Left each specimen, by batch, with the mean and its interval; right the same over the days."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    batches = list(dict.fromkeys(value.batch for value in one.values))
    names = list(dict.fromkeys(value.specimen for value in sorted(one.values, key=lambda v: batches.index(v.batch))))
    begin = min((value.at_s for value in one.values), default=0.0)
    with mpl.rc_context({**RC, "svg.fonttype": "none"}):
        figure = Figure(figsize=(8.4, 2.9), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        for k, batch in enumerate(batches):
            colour, marker, _ = STYLES[k % len(STYLES)]
            mine = [value for value in one.values if value.batch == batch]
            for bound, face in ((False, colour), (True, "none")):
                some = [value for value in mine if value.bound is bound]
                if not some:
                    continue
                label = f"{batch or 'no batch'}{' (bound only)' if bound else ''}"
                style = {"color": colour, "marker": marker, "ls": "", "ms": 5, "mfc": face, "label": label}
                values = [value.value for value in some]
                left.plot([names.index(value.specimen) for value in some], values, **style)
                right.plot([(value.at_s - begin) / DAY_S for value in some], values, **style)
        if math.isfinite(one.interval[0]):
            left.axhspan(*one.interval, color="0.92", zorder=0)
            left.axhline(one.mean, color="0.5", lw=0.8)
        if math.isfinite(one.drift_per_day):
            days = np.array([value.at_s for value in one.values if not value.bound]) / DAY_S
            at = np.array([days.min(), days.max()])
            right.plot(at - begin / DAY_S, one.mean + one.drift_per_day * (at - days.mean()), color="0.5", lw=0.8)
        left.set_xticks(range(len(names)), names, rotation=60 if len(names) > 6 else 0, fontsize=7)
        left.set_ylabel(f"{one.name} / {one.unit}")
        day = datetime.fromtimestamp(begin, UTC).date().isoformat() if math.isfinite(begin) else ""
        right.set_xlabel(f"days since {day}")
        left.legend(fontsize=7)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return f"<figure>{svg[svg.index('<svg') :]}</figure>"
