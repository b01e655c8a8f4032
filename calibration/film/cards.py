"""Material cards: the identified film in the conventions of Abaqus, Ansys, COMSOL and FEBio.

The trap is the modulus. With ``d_n = l1^al_n + l2^al_n + l3^al_n - 3`` the energy density is

===========  ==============================  =========================
program      energy density                  its modulus from ours
===========  ==============================  =========================
this one     ``sum mu_n / al_n d_n``         ``mu_n``
Ansys        ``sum mu_n / al_n d_n``         ``mu_n``
COMSOL       ``sum mu_n / al_n d_n``         ``mu_n``
Abaqus       ``sum 2 mu_n / al_n^2 d_n``     ``mu_n al_n / 2``
FEBio        ``sum c_n / m_n^2 d_n``         ``mu_n al_n``
===========  ==============================  =========================

All are in Pa and metres. The film is incompressible; where a program asks for a bulk modulus it gets `BULK` times the
small-strain shear modulus.

Sources: Abaqus Materials Guide, "Hyperelastic behavior of rubberlike materials"; Ansys Material Reference, "Ogden
hyperelasticity"; COMSOL Structural Mechanics Module User's Guide, "Ogden"; FEBio User Manual, "Ogden".
"""

from __future__ import annotations

from collections.abc import Callable

from model.material.materials import EPSILON_0, Material
from model.material.ogden import Ogden

BULK = 1000.0
OWN = "W = sum mu_n/alpha_n (l1^alpha_n + l2^alpha_n + l3^alpha_n - 3), G = 1/2 sum mu_n alpha_n"


class CardError(ValueError):
    """A material that a program has no card for; the message says which law it has."""


def abaqus(material: Material) -> str:
    """Keywords for an input file; 8 numbers a line, D = 0 for an incompressible film (hybrid or membrane elements)."""
    values = [value for mu, alpha in _terms(material) for value in (mu * alpha / 2.0, alpha)]
    values += [0.0] * len(material.mu)
    lines = [", ".join(_number(value) for value in values[k : k + 8]) for k in range(0, len(values), 8)]
    return "\n".join(
        [
            *(
                f"** {line}"
                for line in _head(material, "W = sum 2 mu_n/alpha_n^2 (...): mu_n here is mu_n alpha_n / 2")
            ),
            f"*MATERIAL, NAME={_name(material)}",
            f"*HYPERELASTIC, OGDEN, N={len(material.mu)}",
            *lines,
            "*DIELECTRIC",
            _number(EPSILON_0 * material.eps_r),
            "",
        ]
    )


def ansys(material: Material) -> str:
    """Commands (APDL); d = 0 for an incompressible film."""
    count = len(material.mu)
    values = [value for term in _terms(material) for value in term] + [0.0] * count
    lines = [
        "TBDATA," + ",".join([str(k + 1), *(_number(value) for value in values[k : k + 6])])
        for k in range(0, len(values), 6)
    ]
    return "\n".join(
        [
            *(f"! {line}" for line in _head(material, "W = sum mu_n/alpha_n (...): the same as ours")),
            f"TB,HYPER,1,1,{count},OGDEN",
            *lines,
            f"MP,PERX,1,{_number(material.eps_r)}",
            "",
        ]
    )


def comsol(material: Material) -> str:
    """Parameters to load under Global Definitions, and how they go into the Ogden table."""
    lines = [f"% {line}" for line in _head(material, "W = sum mu_p/alpha_p (...): the same as ours")]
    lines.append("% Hyperelastic Material, Ogden, nearly incompressible or incompressible: mu_p and alpha_p as below.")
    for n, (mu, alpha) in enumerate(_terms(material), start=1):
        lines += [f'mu{n} {_number(mu)}[Pa] "Ogden modulus {n}"', f'alpha{n} {_number(alpha)} "Ogden exponent {n}"']
    lines += [f'epsilonr {_number(material.eps_r)} "relative permittivity"', ""]
    return "\n".join(lines)


def febio(material: Material) -> str:
    """A material of a model file (uncoupled Ogden, up to 6 terms)."""
    if len(material.mu) > 6:
        raise CardError(f"FEBio's Ogden material has 6 terms at most, and this one has {len(material.mu)}")
    head = _head(material, "W = sum c_n/m_n^2 (...): c_n here is mu_n alpha_n")
    terms = []
    for n, (mu, alpha) in enumerate(_terms(material), start=1):
        terms += [f"  <m{n}>{_number(alpha)}</m{n}>", f"  <c{n}>{_number(mu * alpha)}</c{n}>"]
    return "\n".join(
        [
            "<!--",
            *(line.replace("--", "- -") for line in head),
            "FEBio has no permittivity in this material.",
            "-->",
            f'<material id="1" name="{_name(material)}" type="Ogden">',
            *terms,
            f"  <k>{_number(BULK * material.shear_modulus)}</k>",
            "</material>",
            "",
        ]
    )


# File name of a card, and what writes it.
CARDS: dict[str, Callable[[Material], str]] = {
    "film_abaqus.inp": abaqus,
    "film_ansys.mac": ansys,
    "film_comsol.txt": comsol,
    "film_febio.xml": febio,
}


def material_cards(material: Material) -> dict[str, str]:
    """Text of every card, by file name.

    Raises
    ------
    CardError
        When the material has no Ogden law.
    """
    if material.law is not Ogden:
        raise CardError(f"material cards are written for Ogden's law, and this film has {material.law.title}")
    return {name: write(material) for name, write in CARDS.items()}


def _terms(material: Material) -> list[tuple[float, float]]:
    return list(zip(material.mu, material.alpha, strict=True))


def _head(material: Material, convention: str) -> list[str]:
    return [
        "Film identified by dea-rig, in Pa and m. Its density is not known; add it.",
        f"Convention of this card: {convention}",
        f"Convention of dea-rig: {OWN}",
        f"Small-strain shear modulus {_number(material.shear_modulus)} Pa, relative permittivity {material.eps_r:.6g}",
    ]


def _name(material: Material) -> str:
    return "".join(one if one.isascii() and one.isalnum() else "_" for one in material.name)[:38] or "FILM"


def _number(value: float) -> str:
    """All digits, with a point."""
    text = f"{value:.15g}"
    return text if any(one in text for one in ".en") else f"{text}."
