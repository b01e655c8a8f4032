"""The units that tables are written in, and their factors to SI."""

from __future__ import annotations

import re
from dataclasses import dataclass

GRAVITY = 9.80665  # m/s2, standard gravity (CGPM 1901): kgf, gf, and balances that show kg or g
POUND_FORCE = 4.4482216152605  # N, exact (0.45359237 kg at standard gravity)
INCH = 0.0254  # m, exact


@dataclass(frozen=True)
class Unit:
    """A unit: ``value * factor`` is in SI. ``dimension`` is what it measures; ``remark`` tells what was assumed."""

    name: str
    dimension: str
    factor: float
    remark: str = ""


def _table() -> dict[str, Unit]:
    rows = {
        "force": {
            "N": 1.0,
            "mN": 1e-3,
            "uN": 1e-6,
            "cN": 1e-2,
            "daN": 10.0,
            "kN": 1e3,
            "MN": 1e6,
            "kgf": GRAVITY,
            "gf": 1e-3 * GRAVITY,
            "kp": GRAVITY,
            "p": 1e-3 * GRAVITY,
            "lbf": POUND_FORCE,
            "ozf": POUND_FORCE / 16.0,
        },
        "length": {
            "m": 1.0,
            "cm": 1e-2,
            "mm": 1e-3,
            "um": 1e-6,
            "nm": 1e-9,
            "in": INCH,
            "mil": 1e-3 * INCH,
            "ft": 12 * INCH,
        },
        "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
        "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "nA": 1e-9, "pA": 1e-12},
        "stress": {
            "Pa": 1.0,
            "hPa": 1e2,
            "kPa": 1e3,
            "MPa": 1e6,
            "GPa": 1e9,
            "mPa": 1e-3,
            "bar": 1e5,
            "mbar": 1e2,
            "N/mm2": 1e6,
            "N/cm2": 1e4,
            "N/m2": 1.0,
            "kN/m2": 1e3,
            "MN/m2": 1e6,
            "mN/mm2": 1e3,
            "kgf/mm2": 1e6 * GRAVITY,
            "kgf/cm2": 1e4 * GRAVITY,
            "kg/cm2": 1e4 * GRAVITY,
            "kg/mm2": 1e6 * GRAVITY,
            "gf/mm2": 1e3 * GRAVITY,
            "psi": POUND_FORCE / INCH**2,
            "ksi": 1e3 * POUND_FORCE / INCH**2,
            "lbf/in2": POUND_FORCE / INCH**2,
        },
        "ratio": {
            "1": 1.0,
            "-": 1.0,
            "--": 1.0,
            "%": 1e-2,
            "mm/mm": 1.0,
            "m/m": 1.0,
            "in/in": 1.0,
            "um/um": 1.0,
            "cm/cm": 1.0,
            "um/m": 1e-6,
            "mm/m": 1e-3,
            "strain": 1.0,
            "ustrain": 1e-6,
            "microstrain": 1e-6,
        },
        "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
        "area": {"mm2": 1e-6, "cm2": 1e-4, "m2": 1.0, "in2": INCH**2},
        "speed": {
            "mm/min": 1e-3 / 60.0,
            "mm/s": 1e-3,
            "m/s": 1.0,
            "in/min": INCH / 60.0,
            "%/s": 1e-2,
            "%/min": 1e-2 / 60.0,
            "1/s": 1.0,
        },
        "temperature": {"degC": 1.0, "K": 1.0, "degF": 1.0},
        "other": {
            "Hz": 1.0,
            "kHz": 1e3,
            "J": 1.0,
            "mJ": 1e-3,
            "W": 1.0,
            "ohm": 1.0,
            "F": 1.0,
            "pF": 1e-12,
            "nF": 1e-9,
            "mV/V": 1.0,
            "%RH": 1.0,
        },
    }
    units = {name: Unit(name, dimension, factor) for dimension, row in rows.items() for name, factor in row.items()}
    for name in ("kg", "g", "lb", "oz"):
        factor = {"kg": GRAVITY, "g": 1e-3 * GRAVITY, "lb": POUND_FORCE, "oz": POUND_FORCE / 16.0}[name]
        units[name] = Unit(name, "force", factor, f"{name} is read as {name}f, at standard gravity 9.80665 m/s2")
    return units


UNITS = _table()
# What people write for them. The left side is compared without blanks, with ^ and ** left out.
SPELLINGS = {
    "newton": "N",
    "newtons": "N",
    "kilogramforce": "kgf",
    "gramforce": "gf",
    "lbs": "lb",
    "pound": "lb",
    "pounds": "lb",
    "lbsf": "lbf",
    "millimeter": "mm",
    "millimeters": "mm",
    "millimetre": "mm",
    "micron": "um",
    "microns": "um",
    "micrometer": "um",
    "inch": "in",
    "inches": "in",
    "zoll": "in",
    "pouce": "in",
    "meter": "m",
    "metre": "m",
    "mkm": "um",
    '"': "in",
    "volt": "V",
    "volts": "V",
    "kilovolt": "kV",
    "pascal": "Pa",
    "megapascal": "MPa",
    "kilopascal": "kPa",
    "nmm-2": "N/mm2",
    "nm-2": "N/m2",
    "lb/in2": "psi",
    "lbs/in2": "psi",
    "kp/mm2": "kgf/mm2",
    "kp/cm2": "kgf/cm2",
    "percent": "%",
    "pct": "%",
    "prozent": "%",
    "pourcent": "%",
    "proz": "%",
    "mmmm-1": "mm/mm",
    "mm/mm0": "mm/mm",
    "unitless": "1",
    "dimensionless": "1",
    "none": "1",
    "n/a": "1",
    "sec": "s",
    "hh:mm:ss": "s",  # a column of times of day is in seconds once it is read
    "h:m:s": "s",
    "hh:mm:ss.sss": "s",
    "hh:mm:ss.000": "s",
    "hh:mm:ss,000": "s",
    "mm:ss": "s",
    "mm:ss.0": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "sek": "s",
    "sekunden": "s",
    "secondes": "s",
    "seconde": "s",
    "msec": "ms",
    "millis": "ms",
    "milliseconds": "ms",
    "micros": "us",
    "minute": "min",
    "minutes": "min",
    "minuten": "min",
    "mins": "min",
    "hr": "h",
    "hours": "h",
    "std": "h",
    "hour": "h",
    "°c": "degC",
    "c": "degC",
    "degc": "degC",
    "celsius": "degC",
    "°f": "degF",
    "ohms": "ohm",
    "ω": "ohm",
    "kg-f": "kgf",
    "kg-force": "kgf",
    "lb-f": "lbf",
    "%rh": "%RH",
    "rh": "%RH",
}
# Letters in the wrong case that can mean one thing only, in a table of a laboratory.
CASELESS = {"mpa": "MPa", "mn": "mN", "mv": "mV", "pa": "Pa", "ma": "mA", "gpa": "GPa"}
NOT_A_UNIT_ALONE = {"F", "K", "W", "J", "A", "p", "C", "c"}  # as likely a name where it stands alone as a heading


def unit_of(text: str) -> Unit | None:
    """The unit that a text means; None where it means none.

    >>> unit_of("N/mm²").factor, unit_of(" (kPa) ").dimension, unit_of("Bar2")
    (1000000.0, 'stress', None)
    """
    plain = text.strip().strip("()[]{}<>").strip()
    plain = plain.replace("²", "2").replace("µ", "u").replace("μ", "u").replace("·", "").replace("⁻¹", "-1")
    plain = re.sub(r"\s*/\s*", "/", plain.replace("^", "").replace("**", "").rstrip("."))
    compact = plain.replace(" ", "")
    if not compact:
        return None
    if compact in UNITS:
        return UNITS[compact]
    lower = compact.casefold()
    if lower in SPELLINGS:
        return UNITS[SPELLINGS[lower]]
    if lower in CASELESS:
        meant = UNITS[CASELESS[lower]]
        remark = f"{text.strip()!r} is read as {meant.name}"
        return Unit(meant.name, meant.dimension, meant.factor, remark)
    alike = [unit for name, unit in UNITS.items() if name.casefold() == lower]
    return alike[0] if len(alike) == 1 else None


def known(dimension: str) -> str:
    """The names of the units of a dimension, for messages."""
    return ", ".join(unit.name for unit in UNITS.values() if unit.dimension == dimension and unit.name != "--")
