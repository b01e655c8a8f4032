"""Which data, settings and software the result comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section


def context(data: ReportData) -> Mapping[str, Any]:
    """Names and values, and the scenes as they are."""
    own = {key: value for key, value in data.identification.provenance.items() if key != "data"}
    return {"facts": [*flat(data.provenance), *flat(own)], "scenes": dict(data.scene_texts)}


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested mappings as rows of name and text."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += flat(value, f"{prefix}{key} › ")
        elif isinstance(value, (list, tuple)):
            rows.append((f"{prefix}{key}", ", ".join(str(item) for item in value)))
        else:
            rows.append((f"{prefix}{key}", str(value)))
    return rows


TEMPLATE = """
<h2>Where it comes from</h2>
<div class="table"><table class="facts">
{% for key, value in facts %}
<tr><td>{{ key }}</td><td class="hash">{{ value }}</td></tr>
{% endfor %}
</table></div>
{% for title, text in scenes.items() %}
<h3>{{ title }}</h3>
<pre>{{ text }}</pre>
{% endfor %}
"""

SECTION = Section("provenance", 110, context, TEMPLATE)
