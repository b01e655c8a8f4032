"""Material cards: the identified film in the conventions of Abaqus, Ansys, COMSOL and FEBio.

The trap is the modulus of Ogden's law. With ``d_n = l1^al_n + l2^al_n + l3^al_n - 3`` the energy density is

===========  ==============================  =========================
program      energy density                  its modulus from ours
===========  ==============================  =========================
this one     ``sum mu_n / al_n d_n``         ``mu_n``
Ansys        ``sum mu_n / al_n d_n``         ``mu_n``
COMSOL       ``sum mu_n / al_n d_n``         ``mu_n``
Abaqus       ``sum 2 mu_n / al_n^2 d_n``     ``mu_n al_n / 2``
FEBio        ``sum c_n / m_n^2 d_n``         ``mu_n al_n``
===========  ==============================  =========================

With ``J1 = I1 - 3`` and ``J2 = I2 - 3`` the other laws are the same in all programs but for the neo-Hookean modulus:

=============  ==================================  ======================  =============================
law            energy density                      Abaqus                  Ansys, COMSOL, FEBio
=============  ==================================  ======================  =============================
neo-Hooke      ``mu/2 J1``                         ``C10 = mu/2``          ``mu`` (FEBio: ``G``)
Mooney-Rivlin  ``C1 J1 + C2 J2``                   ``C10, C01``            ``C10, C01`` (FEBio: ``c1, c2``)
Yeoh           ``C1 J1 + C2 J1^2 + C3 J1^3``       ``C10, C20, C30``       ``C10, C20, C30`` or ``c1, c2, c3``
Gent           ``-mu Jm/2 ln(1 - J1/Jm)``          none                    ``mu, Jm`` (FEBio: ``G, Jm``)
=============  ==================================  ======================  =============================

All are in Pa and metres. The film is incompressible; where a program asks for a bulk modulus it gets `BULK` times the
small-strain shear modulus. Branches of a film that takes time: `calibration.film.prony`.

Sources: Abaqus Materials Guide, "Hyperelastic behavior of rubberlike materials"; Ansys Material Reference,
"Hyperelasticity" (NEO, MOONEY, YEOH, GENT, OGDEN), and for the order of constants the listings of its Structural
Analysis Guide, "Hyperelasticity" (NEO: mu, d; OGDEN: mu_1, alpha_1, mu_2, alpha_2, ..., d_1, ...); COMSOL Structural
Mechanics Module User's Guide, "Hyperelastic Material"; FEBio User Manual, "Uncoupled materials" (incomp neo-Hookean,
Mooney-Rivlin, Yeoh, Gent, Ogden).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from calibration.film.prony import at_once, over_instant, over_relaxed
from model.material.gent import Gent
from model.material.law import Law
from model.material.materials import EPSILON_0, Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh

BULK = 1000.0
MOST_TERMS = {"FEBio": 6, "Ansys": 9}  # of Ogden's law
MOST_BRANCHES = {"FEBio": 6, "Ansys": 6}  # of a card


class CardError(ValueError):
    """A material that a program has no card for; the message says which law it has."""


@dataclass(frozen=True)
class Constants:
    """A law in a program: its energy density there, the key of the program, and name and value of every constant."""

    energy: str
    key: str
    values: tuple[tuple[str, float], ...]
    unit_less: frozenset[str] = frozenset()


Form = Callable[[Material], Constants]


def _form(energy: str, key: str, *names: str, factors: tuple[float, ...] = (), unit_less: tuple[str, ...] = ()) -> Form:
    """A law with moduli and shape parameters in our order, times ``factors``."""

    def of(material: Material) -> Constants:
        own = (*material.mu, *material.alpha)
        sizes = factors or (1.0,) * len(own)
        values = tuple((name, factor * value) for name, factor, value in zip(names, sizes, own, strict=True))
        return Constants(energy, key, values, frozenset(unit_less))

    return of


def _ogden(energy: str, key: str, modulus: str, exponent: str, factor: Callable[[float], float]) -> Form:
    """Ogden's law with ``mu_n factor(alpha_n)`` and ``alpha_n`` of every term in turn."""

    def of(material: Material) -> Constants:
        values: list[tuple[str, float]] = []
        for n, (mu, alpha) in enumerate(zip(material.mu, material.alpha, strict=True), start=1):
            values += [(f"{modulus}{n}", mu * factor(alpha)), (f"{exponent}{n}", alpha)]
        exponents = frozenset(name for name, _ in values[1::2])
        return Constants(energy, key.format(n=len(material.mu)), tuple(values), exponents)

    return of


OURS = "W = sum mu_n/alpha_n (l1^alpha_n + l2^alpha_n + l3^alpha_n - 3)"
MOONEY, YEOH = "W = C10 (I1 - 3) + C01 (I2 - 3)", "W = C10 (I1 - 3) + C20 (I1 - 3)^2 + C30 (I1 - 3)^3"
GENT = "W = -{0} Jm/2 ln(1 - (I1 - 3)/Jm)"

Forms = Mapping[type[Law], Form]
ABAQUS: Forms = {
    Ogden: _ogden(
        "W = sum 2 mu_n/alpha_n^2 (...): mu_n here is mu_n alpha_n / 2",
        "OGDEN, N={n}",
        "mu",
        "alpha",
        lambda al: al / 2,
    ),
    NeoHooke: _form("W = C10 (I1 - 3): C10 = mu/2", "NEO HOOKE", "C10", factors=(0.5,)),
    MooneyRivlin: _form(MOONEY, "MOONEY-RIVLIN", "C10", "C01"),
    Yeoh: _form(YEOH, "YEOH", "C10", "C20", "C30"),
}
ANSYS: Forms = {
    Ogden: _ogden("W = sum mu_n/alpha_n (...): the same as ours", "{n},OGDEN", "mu", "alpha", lambda _: 1.0),
    NeoHooke: _form("W = mu/2 (I1 - 3)", ",NEO", "mu"),
    MooneyRivlin: _form(MOONEY, "2,MOONEY", "C10", "C01"),
    Yeoh: _form(YEOH, "3,YEOH", "C10", "C20", "C30"),
    Gent: _form(GENT.format("mu"), ",GENT", "mu", "Jm", unit_less=("Jm",)),
}
COMSOL: Forms = {
    Ogden: _ogden("W = sum mu_p/alpha_p (...): the same as ours", "Ogden", "mu", "alpha", lambda _: 1.0),
    NeoHooke: _form("W = mu/2 (I1 - 3)", "Neo-Hookean (Lame parameter mu)", "mu"),
    MooneyRivlin: _form(MOONEY, "Mooney-Rivlin, two parameters", "C10", "C01"),
    Yeoh: _form("W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3", "Yeoh", "c1", "c2", "c3"),
    Gent: _form(GENT.format("mu").replace("Jm", "jm"), "Gent", "mu", "jm", unit_less=("jm",)),
}
FEBIO: Forms = {
    Ogden: _ogden("W = sum c_n/m_n^2 (...): c_n here is mu_n alpha_n", "Ogden", "c", "m", lambda al: al),
    NeoHooke: _form("W = G/2 (I1 - 3)", "incomp neo-Hookean", "G"),
    MooneyRivlin: _form("W = c1 (I1 - 3) + c2 (I2 - 3)", "Mooney-Rivlin", "c1", "c2"),
    Yeoh: _form("W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3", "Yeoh", "c1", "c2", "c3"),
    Gent: _form(GENT.format("G"), "Gent", "G", "Jm", unit_less=("Jm",)),
}


def abaqus(material: Material, law: Constants, electric: bool) -> str:
    """Keywords for an input file; 8 numbers a line, D = 0 for an incompressible film (hybrid or membrane elements)."""
    volumetric = {Ogden: len(material.mu), Yeoh: 3}.get(material.law, 1)
    values = [value for _, value in law.values] + [0.0] * volumetric
    lines = [", ".join(_number(value) for value in values[k : k + 8]) for k in range(0, len(values), 8)]
    return "\n".join(
        [
            *(f"** {line}" for line in _head(material, law, electric)),
            f"*MATERIAL, NAME={_name(material)}",
            f"*HYPERELASTIC, {law.key}" + (", MODULI=LONG TERM" if material.branches else ""),
            *lines,
            *(["*VISCOELASTIC, TIME=PRONY"] if material.branches else []),
            *(f"{_number(g)}, 0., {_number(tau)}" for g, tau in over_instant(material)),
            *(["*DIELECTRIC", _number(EPSILON_0 * material.eps_r)] if electric else []),
            "",
        ]
    )


def ansys(material: Material, law: Constants, electric: bool) -> str:
    """Commands (APDL); d = 0 for an incompressible film."""
    volumetric = {Ogden: len(material.mu), Yeoh: 3}.get(material.law, 1)
    values = [value for _, value in law.values] + [0.0] * volumetric
    lines = [
        "TBDATA," + ",".join([str(k + 1), *(_number(value) for value in values[k : k + 6])])
        for k in range(0, len(values), 6)
    ]
    return "\n".join(
        [
            *(f"! {line}" for line in _head(material, law, electric)),
            f"TB,HYPER,1,1,{law.key}",
            *lines,
            *([f"TB,PRONY,1,1,{len(material.branches)},SHEAR"] if material.branches else []),
            *(f"TBDATA,{2 * k + 1},{_number(a)},{_number(tau)}" for k, (a, tau) in enumerate(over_instant(material))),
            *([f"MP,PERX,1,{_number(material.eps_r)}"] if electric else []),
            "",
        ]
    )


def comsol(material: Material, law: Constants, electric: bool) -> str:
    """Parameters to load under Global Definitions, and the material model that they belong to."""
    lines = [f"% {line}" for line in _head(material, law, electric)]
    lines.append(f"% Hyperelastic Material, {law.key}, nearly incompressible or incompressible: constants as below.")
    for name, value in law.values:
        unit = "" if name in law.unit_less else "[Pa]"
        lines.append(f'{name} {_number(value)}{unit} "{material.law.title}: {name}"')
    for k, (factor, tau) in enumerate(over_relaxed(material), start=1):
        lines.append(f'beta_v{k} {_number(factor)} "energy factor of branch {k} of the generalized Maxwell model"')
        lines.append(f'tau_v{k} {_number(tau)}[s] "relaxation time of branch {k}"')
    lines += [f'epsilonr {_number(material.eps_r)} "relative permittivity"'] if electric else []
    return "\n".join([*lines, ""])


def febio(material: Material, law: Constants, electric: bool) -> str:
    """A material of a model file (uncoupled)."""
    elastic = [
        *(f"  <{name}>{_number(value)}</{name}>" for name, value in law.values),
        f"  <k>{_number(BULK * material.shear_modulus)}</k>",
    ]
    kind = f'<material id="1" name="{_name(material)}" type="{{}}">'
    body = [kind.format(law.key), *elastic]
    if material.branches:
        series = list(enumerate(over_relaxed(material), start=1))
        body = [
            kind.format("uncoupled viscoelastic"),
            "  <g0>1.</g0>",
            *(f"  <g{k}>{_number(ratio)}</g{k}>" for k, (ratio, _) in series),
            *(f"  <t{k}>{_number(tau)}</t{k}>" for k, (_, tau) in series),
            f'  <elastic type="{law.key}">',
            *(f"  {line}" for line in elastic),
            "  </elastic>",
        ]
    return "\n".join(
        [
            "<!--",
            *(line.replace("--", "- -") for line in _head(material, law, electric)),
            "FEBio has no permittivity in this material.",
            "-->",
            *body,
            "</material>",
            "",
        ]
    )


@dataclass(frozen=True)
class Program:
    """A program, the file of its card, its laws, and what writes a card."""

    name: str
    file: str
    forms: Forms
    write: Callable[[Material, Constants, bool], str]
    branches: str  # its convention of a Prony series
    instant: bool = False  # whether it asks for the moduli that the film has at once

    def missing(self, material: Material) -> str:
        """Why there is no card for the material; "" where there is one."""
        if material.law not in self.forms:
            return f"{self.name} has no {material.law.title} material of its own"
        most = MOST_TERMS.get(self.name, len(material.mu))
        if material.law is Ogden and len(material.mu) > most:
            return f"{self.name}'s Ogden material has {most} terms at most, and this one has {len(material.mu)}"
        if len(material.branches) > MOST_BRANCHES.get(self.name, len(material.branches)):
            return f"{self.name}'s card has {MOST_BRANCHES[self.name]} branches at most"
        return ""


PROGRAMS = (
    Program("Abaqus", "film_abaqus.inp", ABAQUS, abaqus, "moduli of the relaxed film; g_k over the modulus at once"),
    Program("Ansys", "film_ansys.mac", ANSYS, ansys, "moduli at once; alpha_k over the modulus at once", True),
    Program("COMSOL", "film_comsol.txt", COMSOL, comsol, "moduli of the relaxed film; beta_v over the relaxed film"),
    Program("FEBio", "film_febio.xml", FEBIO, febio, "moduli of the relaxed film; g_k over the relaxed film, g0 = 1"),
)


def material_cards(material: Material, *, electric: bool = True) -> dict[str, str]:
    """Text of the card of every program that has the material's law, by file name; the others: `without_card`.

    Without ``electric`` there is no permittivity in them, for tests of a sheet do not tell it.

    Raises
    ------
    CardError
        When no program has the law.
    """
    able = [one for one in PROGRAMS if not one.missing(material)]
    if not able:
        raise CardError(f"there is no material card for this film: {'; '.join(without_card(material))}")
    return {one.file: _card(one, material, electric) for one in able}


def _card(program: Program, material: Material, electric: bool) -> str:
    own = at_once(material) if material.branches and program.instant else material
    law = program.forms[material.law](own)
    if material.branches:
        law = replace(law, energy=f"{law.energy}; branches: {program.branches}")
    return program.write(own, law, electric)


def without_card(material: Material) -> list[str]:
    """Programs that no card is written for, and why."""
    return [why for one in PROGRAMS if (why := one.missing(material))]


def _head(material: Material, law: Constants, electric: bool) -> list[str]:
    own = f"{OURS}, G = 1/2 sum mu_n alpha_n" if material.law is Ogden else material.law.description.split(". ")[0]
    times = (
        ["Its branches rest in the undeformed film here: stretch it first and let it rest, as the rig does."]
        if material.branches
        else []
    )
    return [
        f"{'Film' if electric else 'Sheet'} identified by dea-rig, in Pa and m. Its density is not known; add it.",
        *times,
        f"Convention of this card: {law.energy}",
        f"Convention of dea-rig: {own}",
        f"Small-strain shear modulus {_number(material.shear_modulus)} Pa, "
        + (f"relative permittivity {material.eps_r:.6g}" if electric else "permittivity not known: add it"),
    ]


def _name(material: Material) -> str:
    return "".join(one if one.isascii() and one.isalnum() else "_" for one in material.name)[:38] or "FILM"


def _number(value: float) -> str:
    """All digits, with a point."""
    text = f"{value:.15g}"
    return text if any(one in text for one in ".en") else f"{text}."
