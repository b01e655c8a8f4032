"""The map's films without pre-stretch as the paper may have computed them: a hypothesis, not physics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.actuator.design import Point, Row, SameFilm
from model.specimen import Specimen
from model.verification.other_reading import Ends, Films, antagonist
from rig.design.claims import HYPOTHESIS


def hypothesis_rows(wanted: Sequence[Point]) -> list[Row]:
    """Rows of every film without pre-stretch and every bias that the map has; see `model.verification.other_reading`.

    The field at the disk's edge ends a stroke; there is no other limit. ``blocked_force`` is at the voltage of the end.
    """
    field = wanted[0].criteria.field
    flat = list(dict.fromkeys(point.film for point in wanted if point.film.prestretch == 1.0))
    if field is None or not flat:
        return []
    films = Films(flat)
    rows: list[Row] = []
    for case, recipe in dict.fromkeys((point.case, point.recipe) for point in wanted):
        bias = antagonist(films, recipe.spacer) if isinstance(recipe, SameFilm) else recipe.force
        found = films.ends(bias, field)
        rows += [_row(case, film, found, i, field) for i, film in enumerate(flat)]
    return rows


def _row(case: str, film: Specimen, found: Ends, i: int, field: float) -> Row:
    return Row(
        case=case,
        treatment=HYPOTHESIS,
        radius_ratio=film.disk_radius / film.ring_radius,
        disk_radius=film.disk_radius,
        ring_radius=film.ring_radius,
        thickness=film.thickness,
        prestretch=film.prestretch,
        rest=float(found.rest[i]),
        stroke=float(found.stroke[i]),
        stroke_error=float("nan"),
        work=float(found.work[i]),
        work_error=float("nan"),
        work_by_energy=float("nan"),
        blocked_force=float(found.blocked_force[i]),
        voltage=float(found.voltage[i]),
        peak_field=field,
        min_hoop_stress=float(found.min_hoop_stress[i]),
        max_stretch=float(found.max_stretch[i]),
        snaps=0,
        limit="BREAKDOWN" if np.isfinite(found.stroke[i]) else "NO_REST",
        status="WRINKLED" if found.min_hoop_stress[i] < 0.0 else "TAUT",
        status_at_work="WRINKLED" if found.min_hoop_stress[i] < 0.0 else "TAUT",
    )
