"""A calibration as one picture: what the standstills leave over, within the stated uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.report.figures import RC, STYLES
from calibration.sensors.sensor import COVERAGE
from rig.analysis.sensors import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Scale and unit in which the operator reads the standard and the residual.
SHOWN = {
    "force": ((1.0, "N"), (1e3, "mN")),
    "displacement": ((1e3, "mm"), (1e6, "µm")),
    "hv": ((1.0, "V"), (1.0, "V")),
    "compliance": ((1.0, "N"), (1e3, "mN")),
}


def draw(found: Calibration, path: Path) -> None:
    """Write the picture; its format follows from the file's ending."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(RC):
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.add_subplot()
        if found.characteristic is None:
            _lags(axes, found)
        else:
            _residuals(axes, found)
        figure.savefig(path)


def _residuals(axes: Axes, found: Calibration) -> None:
    characteristic = found.characteristic
    assert characteristic is not None
    (scale, unit), (small, small_unit) = SHOWN[found.quantity]
    applied = np.array([one.applied for one in characteristic.standstills])
    direction = np.array([one.direction for one in characteristic.standstills])
    for sign, words, (colour, marker, _) in ((1, "rising", STYLES[0]), (-1, "falling", STYLES[1])):
        mine = direction == sign
        residuals = characteristic.residuals[mine] * small
        axes.plot(applied[mine] * scale, residuals, marker, color=colour, ms=4, label=words)
    x = np.linspace(applied.min(), applied.max(), 100)
    own = COVERAGE * max(one.applied_error for one in characteristic.standstills)
    band = np.array([np.hypot(characteristic.expanded_uncertainty(float(one)), own) for one in x]) * small
    options: Any = {"color": "0.85", "lw": 0, "zorder": 0, "label": "expanded uncertainty of both (k = 2)"}
    axes.fill_between(x * scale, -band, band, **options)
    what = "stage" if found.quantity == "compliance" else found.instrument or found.quantity
    axes.set_title(f"{found.quantity}: {what}, {len(applied)} standstills")
    axes.set_xlabel(f"{'force' if found.quantity == 'compliance' else 'standard'} / {unit}")
    axes.set_ylabel(f"sensor - standard / {small_unit}")
    axes.legend(loc="upper left")


def _lags(axes: Axes, found: Calibration) -> None:
    roles = sorted(found.lags)
    values = [found.lags[role].lag * 1e3 for role in roles]
    errors = [2 * found.lags[role].uncertainty * 1e3 for role in roles]
    axes.errorbar(values, roles, xerr=errors, fmt="o", color=STYLES[0][0], capsize=4)
    axes.axvline(0.0, color="0.5", lw=0.8)
    axes.set_ylim(-0.5, len(roles) - 0.5)
    axes.set_title("Lag behind the stage, with expanded uncertainty (k = 2)")
    axes.set_xlabel("lag / ms")
