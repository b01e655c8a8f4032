"""What measurements say of a film, and how well: sensors, films on the rig, homogeneous tests.

The public names, imported when they are asked for::

    from calibration import Curve, identify

See `calibration/README.md`, which has an example that runs.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibration.film.cards import material_cards
    from calibration.film.curve import Curve, CurveError
    from calibration.film.identify import compare, identify
    from calibration.film.problem import IdentificationError
    from calibration.film.result import Identification, Quantity
    from calibration.film.tables import curves_from_frame, frame_of
    from calibration.report.report import write_report
    from model.material.materials import Material
    from model.specimen import Specimen

__all__ = [
    "Curve",
    "CurveError",
    "Identification",
    "IdentificationError",
    "Material",
    "Quantity",
    "Specimen",
    "compare",
    "curves_from_frame",
    "frame_of",
    "identify",
    "material_cards",
    "write_report",
]

_WHERE = {
    "Curve": "calibration.film.curve",
    "CurveError": "calibration.film.curve",
    "Identification": "calibration.film.result",
    "IdentificationError": "calibration.film.problem",
    "Material": "model.material.materials",
    "Quantity": "calibration.film.result",
    "Specimen": "model.specimen",
    "compare": "calibration.film.identify",
    "curves_from_frame": "calibration.film.tables",
    "frame_of": "calibration.film.tables",
    "identify": "calibration.film.identify",
    "material_cards": "calibration.film.cards",
    "write_report": "calibration.report.report",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
