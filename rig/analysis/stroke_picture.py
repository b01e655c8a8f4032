"""Strokes of a virtual bias, measured beside expected, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calibration.report.figures import RC, STYLES
from rig.analysis.strokes import Stroke


def draw(strokes: Sequence[Stroke], path: Path) -> None:
    """Write the picture; its format follows from the file's ending."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(RC):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2)
        for kind, (colour, marker, dash) in zip(dict.fromkeys(one.kind for one in strokes), STYLES, strict=False):
            mine = sorted((one for one in strokes if one.kind == kind), key=lambda one: one.voltage)
            volts = [one.voltage for one in mine]
            for axes, name, scale in ((left, "stroke", 1e3), (right, "work", 1e3)):
                values = [getattr(one, name) * scale for one in mine]
                errors = [2 * getattr(one, f"{name}_uncertainty") * scale for one in mine]
                expected = [getattr(one, f"expected_{name}") * scale for one in mine]
                axes.plot(volts, expected, ls=dash, color=colour, lw=1.2)
                axes.errorbar(volts, values, yerr=errors, fmt=marker, color=colour, ms=5, capsize=3, label=kind)
        for axes, words in ((left, "stroke / mm"), (right, "work / mJ")):
            axes.set_xlabel("voltage / V")
            axes.set_ylabel(words)
            axes.set_ylim(bottom=0.0)
            axes.margins(x=0.1)
        left.legend(title="measured (k = 2); lines: model", title_fontsize=8)
        figure.savefig(path)
