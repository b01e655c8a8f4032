"""Data frames in, data frames out: curves from columns with units in their names, results as one row a quantity.

A frame is anything with named columns: of pandas, polars or pyarrow, or a mapping of names to sequences.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from calibration.film.curve import Curve, CurveError
from calibration.film.result import Identification
from model.specimen import Specimen

# Column -> its factor to SI units.
DISPLACEMENT = {"h_mm": 1e-3, "h_um": 1e-6, "h_m": 1.0}
FORCE = {"force_N": 1.0, "force_mN": 1e-3}
VOLTAGE = {"voltage_V": 1.0, "voltage_kV": 1e3}
TIME = {"time_s": 1.0}
STEP_V = 50.0  # from one row to the next, from which on another curve begins


def curves_from_frame(
    frame: Any, specimen: Specimen, *, force_noise: float, run: str = "run", **stated: Any
) -> list[Curve]:
    """Curves of one specimen from a table, one for every uninterrupted stretch of rows at one voltage.

    Parameters
    ----------
    frame : table
        Columns ``h_mm`` (or ``h_um``, ``h_m``), ``force_N`` (or ``force_mN``), and if there are any ``voltage_V`` (or
        ``voltage_kV``) and ``time_s``, in the order of time. Zeros are taken off.
    specimen : Specimen
        Dimensions as measured; its material is where the fit starts.
    force_noise : float
        Standard deviation of one force sample (N).
    run : str
        What the table is called.
    **stated
        Uncertainties and other fields of `Curve`; what is left out of the dimensions is assumed.

    Raises
    ------
    CurveError
        When a column is missing or cannot be used.
    """
    h, force = _column(frame, DISPLACEMENT), _column(frame, FORCE)
    voltage = _column(frame, VOLTAGE)
    time = _column(frame, TIME)
    if h is None or force is None:
        raise CurveError(f"{run}: the table needs a column of {' or '.join(DISPLACEMENT)}, and of {' or '.join(FORCE)}")
    volts = np.zeros(h.size) if voltage is None else voltage
    ends = [0, *(np.flatnonzero(np.abs(np.diff(volts)) > STEP_V) + 1), h.size]
    curves = []
    for number, (begin, end) in enumerate(itertools.pairwise(ends)):
        rows = slice(int(begin), int(end))
        level = round(float(np.median(volts[rows])), -1)
        curves.append(
            Curve(
                label=f"{run}, {level:g} V, part {number + 1}",
                run=run,
                specimen=specimen,
                h=h[rows],
                force=force[rows],
                voltage=volts[rows],
                nominal_voltage=level,
                direction=_direction(h[rows]),
                force_noise=force_noise,
                time=None if time is None else time[rows],
                **stated,
            )
        )
    return curves


def frame_of(found: Identification) -> dict[str, list[Any]]:
    """The quantities as columns, one row each: ``pandas.DataFrame(frame_of(found))``."""
    rows = found.quantities
    return {
        "quantity": list(rows),
        "value": [one.value for one in rows.values()],
        "standard_uncertainty": [one.uncertainty for one in rows.values()],
        "standard_uncertainty_given_dimensions": [one.conditional for one in rows.values()],
        "unit": [one.unit for one in rows.values()],
        "verdict": [one.verdict for one in rows.values()],
    }


def _column(frame: Any, names: Mapping[str, float]) -> Any:
    for name, factor in names.items():
        try:
            values = frame[name]
        except (KeyError, ValueError, TypeError, IndexError):
            continue
        try:
            return factor * np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            raise CurveError(f"column {name}: it holds something that is no number") from None
    return None


def _direction(h: Any) -> Any:
    """+1 before the largest displacement, -1 after it, of a curve that goes up and back."""
    top = int(np.nanargmax(h))
    way = np.ones(h.size, dtype=np.int8)
    way[top + 1 :] = -1
    return way
