"""What is held against a run of a cone before it is used: what varies, jumps, begins at zero and suits the cone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.membrane.solve import solve
from model.specimen import Specimen
from rig.importing.branches import jumps_of, steps_of
from rig.importing.columns import Part
from rig.importing.findings import Findings
from rig.importing.source import Source

Array = NDArray[np.float64]

IMPLAUSIBLE = 20.0  # factor between the measured force and that of the cone as believed
LEAST_VOLTAGE = 50.0  # V; less bends no film
NO_REST = 0.1  # of the largest displacement or force: what begins at more does not begin at zero
MOST_FIELD = 1e9  # V/m, of the undeformed film; elastomers break down at a tenth of it


def usable(name: str, part: Part, source: Source, specimen: Specimen) -> bool:
    """Refuse what cannot be the displacement and force of this cone."""
    findings, values = source.findings, part.values
    h, force = values["displacement"], values["force"]
    voltage = values.get("voltage", np.zeros(h.size))  # there is no column where the voltage is said
    before = len(findings.of("obstacle"))
    if h.size < 5:
        findings.obstacle(
            "rows",
            f"{name}: {h.size} rows with displacement and force are left; at least 5 are needed",
            "--rows FIRST-LAST",
        )
        return False
    for quantity, column in (("displacement", h), ("force", force)):
        if not np.ptp(column) > 0.0:
            findings.obstacle(
                "constant",
                f"{name}: the {quantity} is {column[0]:g} throughout; nothing varies",
                f"--column {quantity}=NUMBER",
            )
    if len(findings.of("obstacle")) > before:
        return False
    for k in jumps_of(h, force)[:3]:
        findings.obstacle(
            "jump",
            f"{name}: the displacement jumps from {1e3 * h[k - 1]:.4g} mm to {1e3 * h[k]:.4g} mm while the "
            f"force goes on "
            f"({force[k - 1]:.4g} N, {force[k]:.4g} N): was the sensor set to zero",
            f"--rows {part.lines[0]}-{part.lines[k - 1]} keeps the rows before",
            line=int(part.lines[k]),
        )
    for k in steps_of(force, h)[:3]:
        if abs(voltage[k] - voltage[k - 1]) < 0.1 * max(1.0, float(np.abs(voltage).max())):
            findings.obstacle(
                "jump",
                f"{name}: the force jumps from {force[k - 1]:.4g} N to {force[k]:.4g} N while the displacement "
                f"goes on: was the load cell tared, or did the film break",
                f"--rows {part.lines[0]}-{part.lines[k - 1]} keeps the rows before",
                line=int(part.lines[k]),
            )
    _against_the_cone(name, h, force, specimen, source)
    largest = float(np.abs(voltage).max())
    if 0.0 < largest < LEAST_VOLTAGE:
        findings.warning(
            "voltage",
            f"{name}: the highest voltage is {largest:.4g} V, which bends no film: it is in kV, or of a monitor that "
            "shows a thousandth",
            "--unit voltage=kV",
        )
    _at_rest(name, h, force, findings)
    field = largest / specimen.thickness
    if field > MOST_FIELD:
        findings.obstacle(
            "implausible",
            f"{name}: the highest voltage is {largest:.4g} V, {1e-6 * field:.3g} V/um across this film before it is "
            "stretched, which no film stands: check the unit",
            "--unit voltage=V",
            line=source.understood.unit_line or source.understood.heading_line,
        )
    return len(findings.of("obstacle")) == before


def _at_rest(name: str, h: Array, force: Array, findings: Findings) -> None:
    """Tell of displacement and force that do not begin at zero."""
    far, low = float(h.max()), float(h.min())
    if _begins_away(h):
        findings.warning(
            "zero",
            f"{name}: the displacement begins at {1e3 * low:.4g} mm; it has to be counted from where the disk touches "
            "the film",
            "--zero displacement=first",
        )
        return
    rest = float(np.median(force[h < low + 0.02 * (far - low)]))
    if abs(rest) > NO_REST * float(np.abs(force).max()):
        findings.warning(
            "zero",
            f"{name}: the force is {rest:.3g} N where the displacement begins: was it set to zero",
            "--zero force=first",
        )


def _begins_away(h: Array) -> bool:
    """Whether the displacement never comes near zero."""
    return float(np.abs(h).min()) > NO_REST * float(np.abs(h).max())


def _against_the_cone(name: str, h: Array, force: Array, specimen: Specimen, source: Source) -> None:
    """Hold the largest force against that of the cone as believed; a factor above 20 is no matter of the material."""
    k = int(h.argmax())
    measured = float(np.median(force[np.argsort(h)[-max(3, h.size // 100) :]]))
    gap = specimen.ring_radius - specimen.disk_radius
    expected = _model_force(specimen, float(h[k]))
    ratio = measured / expected if expected and expected > 0.0 else float("nan")
    swapped = _model_force(specimen, float(force.max()) * 1e-3)  # as if its numbers were mm, and those of h N
    if 1.0 / IMPLAUSIBLE < ratio < IMPLAUSIBLE and h[k] < 5.0 * gap:
        return
    if _begins_away(h):  # a position of the stage: told by `_at_rest`, and here it forbids using the table
        source.findings.obstacle(
            "zero",
            f"{name}: the displacement runs from {1e3 * h[0]:.4g} mm; it has to be counted from where the disk touches "
            "the film, and outwards",
            "--zero displacement=first",
            line=source.understood.heading_line,
        )
        return
    told = f"{expected:.3g} N" if expected else "no force that can be computed"
    looks_swapped = swapped is not None and 1.0 / IMPLAUSIBLE < float(h.max()) * 1e3 / max(swapped, 1e-30) < IMPLAUSIBLE
    source.findings.obstacle(
        "implausible",
        f"{name}: displacement {1e3 * h[k]:.4g} mm with force {measured:.4g} N is implausible for this cone, "
        f"for which {told} "
        f"is expected"
        + (f" (a film {ratio:.3g} times as stiff as believed)" if ratio > 0.0 else "")
        + (
            ": displacement and force look exchanged"
            if looks_swapped
            else ": check the units and whether columns are exchanged"
        ),
        "--column displacement=NUMBER --column force=NUMBER, or --unit displacement=UNIT --unit force=UNIT",
        line=source.understood.heading_line,
    )


def _model_force(specimen: Specimen, h: float) -> float | None:
    """Force (N) of the cone as believed at 0 V; None where there is none."""
    if not 0.0 < h < 20.0 * specimen.ring_radius:
        return None
    found = float(solve(specimen, h, 0.0).force)
    return found if np.isfinite(found) else None
