"""The imperfections that the residuals were held against, and what could be there unseen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from calibration.film.result import SHOWN, Identification, Suspect
from calibration.report.sections.base import ReportData, Section, Table, symbol
from calibration.rounding import rounded, two_digits


def context(data: ReportData) -> Mapping[str, Any] | None:
    """One row a suspect; a shift above the stated uncertainty is bold."""
    from markupsafe import Markup

    fit = data.identification
    if not fit.suspects:
        return None
    shifted = list(fit.unseen[fit.suspects[0].name])
    headings = ["imperfection", ">found", ">shows from"]
    headings += [Markup(">shifts {} by up to, unseen").format(symbol(name)) for name in shifted]
    rows = [_row(fit, suspect) for suspect in fit.suspects]
    caption = "What the residuals were held against, and what could be there unseen"
    return {"suspects": Table([*headings, "to rule it out"], rows, caption)}


def _row(fit: Identification, suspect: Suspect) -> list[Any]:
    from markupsafe import Markup

    factor, unit = SHOWN[suspect.unit]
    row: list[Any] = [suspect.name]
    if math.isfinite(suspect.shows_from):
        amplitude, uncertainty = rounded(suspect.amplitude * factor, suspect.uncertainty * factor)
        row += [f"{amplitude} ± {uncertainty} {unit}", f"{two_digits(suspect.shows_from * factor)} {unit}"]
    else:
        row += ["cannot be seen", f"never; at {two_digits(suspect.unseen_size * factor)} {unit}:"]
    for name, shift in fit.unseen[suspect.name].items():
        quantity = fit.quantities[name]
        text = f"{100.0 * shift / quantity.value:+.2g} %"
        row.append(Markup("<b>{}</b>").format(text) if abs(shift) > quantity.uncertainty else text)
    counted = f" (in the budget: {suspect.part})" if suspect.part else ""
    return [*row, suspect.remedy.replace("`", "") + counted]


TEMPLATE = """
{{ table(suspects) }}
<p class="soft">95 of 100 experiments like this one would report an imperfection from the size "shows from" on. A
smaller one
looks to the fit like another film: no test on these data finds it, and the uncertainties above do not contain it.
Shifts
larger than a stated uncertainty are bold: rule these imperfections out by other means.</p>
"""

SECTION = Section("suspects", 70, context, TEMPLATE)
