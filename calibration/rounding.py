"""Numbers as text, to the digits that their uncertainty allows."""

from __future__ import annotations

import math


def rounded(value: float, uncertainty: float) -> tuple[str, str]:
    """Value and uncertainty as text, to two significant digits of the uncertainty."""
    if not math.isfinite(uncertainty) or uncertainty <= 0.0:
        return f"{value:.4g}", "not determined" if uncertainty > 0.0 else "0"
    digits = max(0, 1 - math.floor(math.log10(float(f"{uncertainty:.1e}"))))
    return f"{value:.{digits}f}", f"{uncertainty:.{digits}f}"


def stated(value: float, uncertainty: float) -> tuple[str, str]:
    """As `rounded`; of an uncertainty above ten times the value, which by then is a guess, only that it is."""
    if not 0.0 < 10.0 * abs(value) < uncertainty < math.inf:
        return rounded(value, uncertainty)
    return two_digits(value), f"> {two_digits(10.0 * abs(value))}"


def two_digits(value: float) -> str:
    """A number as text, to two significant digits, without a power of ten where people write none."""
    return f"{float(f'{value:.1e}'):g}"


def percent(fraction: float) -> str:
    """A relative uncertainty as text, to two significant digits."""
    if not math.isfinite(fraction) or fraction > 10.0:
        return "> 1000 %"
    if fraction < 5e-6:
        return "0 %"
    value = float(f"{100 * fraction:.1e}")
    return f"{value:.{max(0, 1 - math.floor(math.log10(value)))}f} %"
