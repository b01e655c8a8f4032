"""The report: one HTML file that needs nothing else, to be read on a screen or on paper."""

from __future__ import annotations

import base64
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from calibration.film.curve import Curve
from calibration.film.identify import secant_modulus
from calibration.film.reduction import select
from calibration.film.result import CONVENTION, IDENTIFIED, SHOWN, WEAKLY_IDENTIFIED, Identification, Quantity, Suspect
from calibration.report import figures
from calibration.rounding import percent, rounded, stated, two_digits
from model.material.materials import Material


def write_report(
    path: Path,
    identification: Identification,
    curves: Sequence[Curve],
    *,
    scene_texts: Mapping[str, str],
    provenance: Mapping[str, Any],
    truth: Material | None = None,
    comparison: Sequence[Identification] = (),
) -> None:
    """Write the report of an identification as one self-contained HTML file.

    Parameters
    ----------
    path : Path
        The file; it appears whole or not at all.
    curves : sequence of Curve
        Those that were identified, in the same order.
    scene_texts : mapping of str to str
        Name and text of every scene file, shown as they are.
    provenance : mapping
        What identifies the data; plain values, lists and mappings.
    truth : Material, optional
        The film of a simulation, to be held against what was found.
    comparison : sequence of Identification, optional
        The same data with other numbers of Ogden terms (`calibration.film.identify.compare`).

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    page = _render(identification, curves, scene_texts, provenance, truth, comparison)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with open(handle, "w", encoding="utf-8") as file:  # noqa: PTH123 # a descriptor, not a path
            file.write(page)
        Path(name).chmod(0o644)
        os.replace(name, path)  # noqa: PTH105
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


@dataclass(frozen=True)
class _Row:
    """A quantity in the unit it is shown in."""

    symbol: str
    subscript: str
    meaning: str
    unit: str
    value: str
    uncertainty: str
    relative: str
    interval: str
    verdict: str
    badge: str
    budget: dict[str, str]
    truth: str
    deviation: str


def _render(
    identification: Identification,
    curves: Sequence[Curve],
    scene_texts: Mapping[str, str],
    provenance: Mapping[str, Any],
    truth: Material | None,
    comparison: Sequence[Identification],
) -> str:
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((files("calibration.report") / "report.html.j2").read_text(encoding="utf-8"))
    selections = select(curves, identification.material, identification.wrinkling)
    known = _truth(identification, truth)
    rows = {name: _row(name, quantity, known) for name, quantity in identification.quantities.items()}
    parts = list(dict.fromkeys(part for quantity in identification.quantities.values() for part in quantity.budget))
    return template.render(
        fit=identification,
        rows=rows,
        headline=[rows[name] for name in ("stiffness", "eps_r", "G") if name in rows],
        parts=parts,
        truth=truth,
        known=known,
        comparison=comparison,
        least_bic=min((other.bic for other in comparison), default=0.0),
        convention=CONVENTION,
        thresholds=(f"{IDENTIFIED:.0%}", f"{WEAKLY_IDENTIFIED:.0%}"),
        shifted_names=[
            name for name in ("stiffness", "eps_r") if name in next(iter(identification.unseen.values()), {})
        ],
        unseen=[_unseen(identification, suspect) for suspect in identification.suspects],
        specimens=list(dict.fromkeys(curve.specimen.name or "unnamed" for curve in curves)),
        noise=" or ".join(f"{noise:.3g}" for noise in sorted({1e3 * curve.force_noise for curve in curves})),
        force_displacement=_data_uri(figures.force_displacement(identification, curves, selections)),
        residuals=_data_uri(figures.residuals(identification, curves, selections)),
        stiffness=_data_uri(figures.stiffness(identification, truth)),
        scene_texts=dict(scene_texts),
        provenance=[*_flat(provenance), *_flat({k: v for k, v in identification.provenance.items() if k != "data"})],
        misfit=math.sqrt(identification.lack_of_fit / identification.lack_of_fit_freedom),
    )


_SYMBOLS = {"mu": "μ", "alpha": "α", "eps_r": "ε", "stiffness": "G", "stiffness_end": "G", "G": "G"}


def _row(name: str, quantity: Quantity, known: Mapping[str, float]) -> _Row:
    base = name.rstrip("0123456789")
    subscript = {"eps_r": "r", "stiffness": "s", "stiffness_end": "end"}.get(name, name[len(base) :])
    meaning = {
        "eps_r": "relative permittivity",
        "stiffness": "stiffness: secant shear modulus where the data determine it best",
        "stiffness_end": "secant shear modulus at the largest stretch",
        "G": "small-strain shear modulus",
        "mu": "Ogden modulus",
        "alpha": "Ogden exponent",
    }[base if base in ("mu", "alpha") else name]
    factor, unit = (1e-3, "kPa") if quantity.unit == "Pa" else (1.0, "")
    value, uncertainty = stated(quantity.value * factor, quantity.uncertainty * factor)
    ends = quantity.interval or tuple(quantity.value + k * quantity.uncertainty for k in (-1.96, 1.96))
    low, high = (
        rounded(end * factor, quantity.uncertainty * factor)[0] if math.isfinite(end) else "no bound" for end in ends
    )
    known_here = name in known
    return _Row(
        symbol=_SYMBOLS[base if base in _SYMBOLS else name],
        subscript=subscript,
        meaning=meaning,
        unit=unit,
        value=value,
        uncertainty=uncertainty,
        relative=percent(quantity.relative),
        interval=f"{low} to {high}",
        verdict=quantity.verdict + (" (at the edge of its range)" if quantity.at_bound else ""),
        badge={"identified": "good", "weakly identified": "fair"}.get(quantity.verdict, "bad"),
        budget={part: percent(size / abs(quantity.value)) for part, size in quantity.budget.items()}
        if quantity.value
        else {},
        truth=f"{known[name] * factor:.6g} {unit}".strip() if known_here else "",
        deviation=f"{(quantity.value - known[name]) / quantity.uncertainty:+.2f}"
        if known_here and math.isfinite(quantity.uncertainty)
        else "",
    )


def _unseen(identification: Identification, suspect: Suspect) -> dict[str, Any]:
    """A suspect as a row of the table of what could be there unseen."""
    factor, unit = SHOWN[suspect.unit]
    amplitude, uncertainty = rounded(suspect.amplitude * factor, suspect.uncertainty * factor)
    shifts = []
    for name, shift in identification.unseen[suspect.name].items():
        quantity = identification.quantities[name]
        text = f"{100.0 * shift / quantity.value:+.2g} %"
        shifts.append({"text": text, "harmful": abs(shift) > quantity.uncertainty})
    return {
        "name": suspect.name,
        "found": f"{amplitude} ± {uncertainty} {unit}",
        "shows_from": f"{two_digits(suspect.shows_from * factor)} {unit}",
        "shifts": shifts,
        "remedy": suspect.remedy.replace("`", ""),
    }


def _truth(identification: Identification, truth: Material | None) -> dict[str, float]:
    """The quantities of a known film; its Ogden terms only if there are as many."""
    if truth is None:
        return {}
    known = {
        "G": truth.shear_modulus,
        "eps_r": truth.eps_r,
        "stiffness": secant_modulus(truth, *identification.stretch),
        "stiffness_end": secant_modulus(
            truth, identification.stiffness_curve.meridional_stretch[-1], identification.stretch[1]
        ),
    }
    if len(truth.mu) == identification.terms:
        for n, (alpha, mu) in enumerate(sorted(zip(truth.alpha, truth.mu, strict=True)), start=1):
            known |= {f"mu{n}": mu, f"alpha{n}": alpha}
    return known


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested mappings as rows of dotted name and text."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key} › ")
        elif isinstance(value, (list, tuple)):
            rows.append((f"{prefix}{key}", ", ".join(str(item) for item in value)))
        else:
            rows.append((f"{prefix}{key}", str(value)))
    return rows


def _data_uri(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode("utf-8")).decode("ascii")
