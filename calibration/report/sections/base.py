"""What a section of the report is made of: the data that it may show, quantities as text, tables."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from calibration.electrical.charge import ByCharge
from calibration.film.curve import Curve
from calibration.film.propagation import secant_modulus, sorted_terms
from calibration.film.reduction import Selection
from calibration.film.result import Identification, Quantity
from calibration.rounding import percent, rounded, stated
from model.material.materials import Material

# A quantity of the result: base of its name -> symbol, subscript, meaning.
_SHOWN = {
    "stiffness": ("G", "s", "stiffness: secant shear modulus where the data determine it best"),
    "stiffness_fixed": ("G", "fix", "secant shear modulus at fixed stretches, to be compared between runs"),
    "stiffness_end": ("G", "end", "secant shear modulus at the largest stretch"),
    "eps_r": ("ε", "r", "relative permittivity"),
    "G": ("G", "", "small-strain shear modulus"),
    "mu": ("μ", "", "modulus"),
    "alpha": ("α", "", "exponent"),
}
BADGES = {"identified": "good", "weakly identified": "fair"}  # how a verdict is marked; else "bad"


@dataclass(frozen=True)
class Row:
    """A quantity as text, in the unit it is shown in."""

    symbol: str
    subscript: str
    meaning: str
    unit: str
    value: str
    uncertainty: str
    relative: str
    interval: str
    conditional: str  # relative uncertainty given the dimensions
    conditional_verdict: str
    doubt: str
    verdict: str
    badge: str
    truth: str
    deviation: str


@dataclass(frozen=True)
class Table:
    """A table that stays readable on a narrow screen, where every cell repeats its heading.

    ``headings`` that begin with ``>`` are of numbers, set to the right. Cells are text, or markup that is safe.
    """

    headings: Sequence[Any]
    rows: Sequence[Sequence[Any]]
    caption: Any = ""


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything that a section may show.

    ``truth`` is the film of a simulation, ``comparison`` the same data with other numbers of terms, ``scene_texts``
    name and text of each scene, ``provenance`` whatever identifies the data, ``charge`` the permittivity by the charge.
    """

    identification: Identification
    curves: Sequence[Curve]
    selections: Sequence[Selection]
    scene_texts: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    truth: Material | None = None
    comparison: Sequence[Identification] = ()
    charge: ByCharge | None = None

    @cached_property
    def known(self) -> dict[str, float]:
        """The true values of the quantities of a simulated film; of its Ogden terms only if there are as many."""
        truth, found = self.truth, self.identification
        if truth is None:
            return {}
        known = {
            "G": truth.shear_modulus,
            "eps_r": truth.eps_r,
            "stiffness": secant_modulus(truth, *found.stretch),
            "stiffness_fixed": secant_modulus(truth, *found.fixed_stretch),
            "stiffness_end": secant_modulus(truth, found.stiffness_curve.meridional_stretch[-1], found.stretch[1]),
        }
        if (truth.law, truth.terms) == (found.material.law, found.terms):
            known |= sorted_terms(truth).values
        return known

    @cached_property
    def specimens(self) -> list[str]:
        """Their names."""
        return list(dict.fromkeys(curve.specimen.name or "unnamed" for curve in self.curves))

    @cached_property
    def rows(self) -> dict[str, Row]:
        """Every quantity as text."""
        return {name: self._row(name, quantity) for name, quantity in self.identification.quantities.items()}

    def _row(self, name: str, quantity: Quantity) -> Row:
        symbol, subscript, meaning = shown(name)
        factor, unit = (1e-3, "kPa") if quantity.unit == "Pa" else (1.0, "")
        value, uncertainty = stated(quantity.value * factor, quantity.uncertainty * factor)
        ends = quantity.interval or tuple(quantity.value + k * quantity.uncertainty for k in (-1.96, 1.96))
        low, high = (
            rounded(end * factor, quantity.uncertainty * factor)[0] if math.isfinite(end) else "no bound"
            for end in ends
        )
        truth = self.known.get(name)
        off = None if truth is None else (quantity.value - truth) / quantity.uncertainty
        return Row(
            symbol=symbol,
            subscript=subscript,
            meaning=meaning,
            unit=unit,
            value=value,
            uncertainty=uncertainty,
            relative=percent(quantity.relative),
            interval=f"{low} to {high}",
            conditional=percent(quantity.conditional / abs(quantity.value)) if quantity.value else "–",
            conditional_verdict=quantity.conditional_verdict,
            doubt=quantity.doubt,
            verdict=quantity.verdict + (" (at the edge of its range)" if quantity.at_bound else ""),
            badge=BADGES.get(quantity.verdict, "bad"),
            truth="" if truth is None else f"{truth * factor:.6g} {unit}".strip(),
            deviation="" if off is None or not math.isfinite(quantity.uncertainty) else f"{off:+.2f}",
        )


@dataclass(frozen=True)
class Section:
    """One section of the report.

    Attributes
    ----------
    name : str
        Its own name in the registry.
    place : int
        Sections are shown in rising order; those that come with the package leave room between them.
    context : callable
        From `ReportData` to the names that the template uses, or None where there is nothing to show.
    template : str
        Jinja2, text escaped. Besides ``context`` it knows ``symbol(name)``, the sign of a quantity, and
        ``table(of)``, which sets a `Table`.
    """

    name: str
    place: int
    context: Callable[[ReportData], Mapping[str, Any] | None]
    template: str


def shown(name: str) -> tuple[str, str, str]:
    """Symbol, subscript and meaning of a quantity."""
    if name in _SHOWN:
        return _SHOWN[name]
    base = name.rstrip("0123456789")
    symbol, subscript, meaning = _SHOWN.get(base, (base, "", base.replace("_", " ")))
    return symbol, subscript + name[len(base) :], meaning


def symbol(name: str) -> Any:
    """The sign of a quantity as markup."""
    from markupsafe import Markup

    sign, subscript, _ = shown(name)
    below = Markup("<sub>{}</sub>").format(subscript) if subscript else ""
    return Markup("<i>{}</i>{}").format(sign, below)


def picture(svg: str) -> str:
    """A figure inside the page."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode("utf-8")).decode("ascii")
