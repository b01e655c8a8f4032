"""What counts as unknown where nobody said how well it is known.

No input is exact by silence. A scene, a table or a `Curve` that says nothing of a dimension gets these standard
uncertainties, marked "assumed, not stated"; an input that is exact is written as 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from model.specimen import Specimen

THICKNESS = 0.05  # relative; a film's thickness varies by some per cent over a sheet
PRESTRETCH = 0.01  # relative
RADIUS_M = 0.05e-3  # of the disk and of the ring
VOLTAGE_AT_FILM = 0.01  # relative; of the supply's reading where it has no certificate, and of leads and electrodes
DISPLACEMENT_AXIS = 0.005  # relative; of the gain where it has no certificate, and cosine of sensor and stage

# Correlation of the errors of two specimens of which nobody said whether they are of one sheet, one punch, one hand:
# as well 0 as 1.
UNKNOWN_CORRELATION = 0.5


def assumed_uncertainties(specimen: Specimen) -> dict[str, float]:
    """Relative standard uncertainties by the name of the field of `calibration.film.curve.Curve`."""
    return {
        "thickness_uncertainty": THICKNESS,
        "prestretch_uncertainty": PRESTRETCH,
        "disk_radius_uncertainty": RADIUS_M / specimen.disk_radius,
        "ring_radius_uncertainty": RADIUS_M / specimen.ring_radius,
        "voltage_at_film": VOLTAGE_AT_FILM,
        "displacement_axis": DISPLACEMENT_AXIS,
    }
