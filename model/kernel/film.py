"""A film as the kernel reads it: `Film` in membrane.c, with `FilmLaw` in law.h."""

from __future__ import annotations

from struct import Struct

from model.material.gent import Gent
from model.material.law import Law
from model.material.materials import Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh

MOST_PARAMETERS = 8
LAWS: tuple[type[Law], ...] = (Ogden, NeoHooke, MooneyRivlin, Yeoh, Gent)  # in the order of their numbers in law.h
_LAYOUT = Struct(f"7d3q{MOST_PARAMETERS}d{MOST_PARAMETERS}d")


def record(geometry: tuple[float, float, float, float], material: Material) -> bytes:
    """Radii of disk and ring, thickness, pre-stretch; the material, whose law has number -1 where it is not known."""
    mu, alpha = material.mu, material.alpha
    known = material.law in LAWS and max(len(mu), len(alpha)) <= MOST_PARAMETERS
    kind = LAWS.index(material.law) if known else -1
    mu, alpha = (values[:MOST_PARAMETERS] + (0.0,) * (MOST_PARAMETERS - len(values)) for values in (mu, alpha))
    numbers = material.shear_modulus, material.eps_r, material.permittivity
    return _LAYOUT.pack(*geometry, *numbers, kind, len(material.mu), len(material.alpha), *mu, *alpha)
