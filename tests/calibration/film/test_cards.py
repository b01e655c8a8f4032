"""Material cards, read back by an evaluation of each program's own convention that shares nothing with ours."""

import re
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np
import pytest

from calibration.film.cards import BULK, PROGRAMS, CardError, material_cards, without_card
from model.material.gent import Gent
from model.material.materials import EPSILON_0, Branch, Material
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh

FILMS = [
    Material("one", (37_834.0,), (5.4985,), 1.7),
    Material("a film & <b>", (5e3, 3.5e4), (2.5, 5.6), 2.8),
    Material("three", (6.3e5, 1.2e3, -1e4), (1.3, 5.0, -2.0), 3.0),
    Material("neo-Hooke", (5e4,), (), 3.0, law=NeoHooke),
    Material("Mooney", (4e4, 7e3), (), 3.0, law=MooneyRivlin),
    Material("yeoh", (4e4, -1.5e3, 60.0), (), 3.0, law=Yeoh),
    Material("gent", (5e4,), (31.7,), 3.0, law=Gent),
]
Energy = Callable[[float, float], float]


def first(a: float, b: float) -> float:
    """I1 - 3 of an incompressible film."""
    return a**2 + b**2 + (a * b) ** -2 - 3


def second(a: float, b: float) -> float:
    """I2 - 3."""
    return a**-2 + b**-2 + (a * b) ** 2 - 3


def ogden(terms: list[tuple[float, float]], factor: Callable[[float, float], float]) -> Energy:
    return lambda a, b: sum(factor(m, k) * (a**k + b**k + (a * b) ** -k - 3) for m, k in terms)


def gent(mu: float, jm: float) -> Energy:
    return lambda a, b: -mu * jm / 2 * np.log(1 - first(a, b) / jm)


def polynomial(*c: float) -> Energy:
    return lambda a, b: sum(one * first(a, b) ** k for k, one in enumerate(c, start=1))


def mooney(c10: float, c01: float) -> Energy:
    return lambda a, b: c10 * first(a, b) + c01 * second(a, b)


def abaqus(text: str) -> tuple[Energy, float]:
    """Ogden 2 mu/alpha^2, mu and alpha in turn; C10 of the others; then D, eight a line; then eps in F/m."""
    lines = [line for line in text.splitlines() if not line.startswith("**")]
    at = next(k for k, line in enumerate(lines) if line.startswith("*HYPERELASTIC, "))
    key = lines[at].removeprefix("*HYPERELASTIC, ")
    rows = lines[at + 1 : lines.index("*DIELECTRIC")]
    assert all(len(row.split(",")) <= 8 for row in rows)
    numbers = [float(one) for row in rows for one in row.split(",")]
    permittivity = float(lines[lines.index("*DIELECTRIC") + 1])
    if key.startswith("OGDEN, N="):
        count = int(key.removeprefix("OGDEN, N="))
        assert len(numbers) == 3 * count and not any(numbers[2 * count :])
        terms = list(zip(numbers[0 : 2 * count : 2], numbers[1 : 2 * count : 2], strict=True))
        return ogden(terms, lambda m, k: 2 * m / k**2), permittivity
    count = {"NEO HOOKE": 1, "MOONEY-RIVLIN": 2, "YEOH": 3}[key]
    own, volume = numbers[:count], numbers[count:]
    assert volume == [0.0] * (3 if key == "YEOH" else 1)
    return (mooney(*own) if key == "MOONEY-RIVLIN" else polynomial(*own)), permittivity


def ansys(text: str) -> tuple[Energy, float]:
    """Ogden mu/alpha, neo-Hooke mu/2; then d; TBDATA names where its numbers begin, six at most."""
    ((count_word, key),) = re.findall(r"^TB,HYPER,1,1,(\d*),([A-Z]+)$", text, re.M)
    table: dict[int, float] = {}
    for row in re.findall(r"^TBDATA,(.*)$", text, re.M):
        begin, *numbers = row.split(",")
        assert len(numbers) <= 6
        table.update({int(begin) + k: float(one) for k, one in enumerate(numbers)})
    assert sorted(table) == list(range(1, 1 + len(table)))
    (eps,) = re.findall(r"^MP,PERX,1,(.*)$", text, re.M)
    permittivity, values = float(eps) * EPSILON_0, [table[k] for k in sorted(table)]
    if key == "OGDEN":
        count = int(count_word)
        assert len(values) == 3 * count and not any(values[2 * count :])
        return ogden([(table[2 * n + 1], table[2 * n + 2]) for n in range(count)], lambda m, k: m / k), permittivity
    own = {"NEO": 1, "MOONEY": 2, "YEOH": 3, "GENT": 2}[key]
    assert values[own:] == [0.0] * (3 if key == "YEOH" else 1)
    assert count_word == {"MOONEY": "2", "YEOH": "3"}.get(key, "")
    energy = {"NEO": lambda mu: polynomial(mu / 2), "MOONEY": mooney, "YEOH": polynomial, "GENT": gent}[key]
    return energy(*values[:own]), permittivity


def comsol(text: str) -> tuple[Energy, float]:
    """A file of parameters: name, expression, description; the model is named above."""
    values = {}
    for line in text.splitlines():
        if line and not line.startswith("%"):
            name, value, _ = line.split(" ", 2)
            values[name] = float(value.removesuffix("[Pa]"))
            assert value.endswith("[Pa]") == (name not in ("jm", "epsilonr") and not name.startswith("alpha"))
    permittivity = values.pop("epsilonr") * EPSILON_0
    (model,) = re.findall(r"^% Hyperelastic Material, (.*), nearly incompressible", text, re.M)
    if model == "Ogden":
        terms = [(values[f"mu{n}"], values[f"alpha{n}"]) for n in range(1, 1 + len(values) // 2)]
        return ogden(terms, lambda m, k: m / k), permittivity
    energies: dict[str, Callable[[], Energy]] = {
        "Neo-Hookean (Lame parameter mu)": lambda: polynomial(values["mu"] / 2),
        "Mooney-Rivlin, two parameters": lambda: mooney(values["C10"], values["C01"]),
        "Yeoh": lambda: polynomial(values["c1"], values["c2"], values["c3"]),
        "Gent": lambda: gent(values["mu"], values["jm"]),
    }
    return energies[model](), permittivity


def febio(text: str) -> tuple[Energy, float]:
    """Ogden c/m^2, the others by their own names, and a bulk modulus; no permittivity."""
    root = ElementTree.fromstring(text)
    values = {str(one.tag): float(one.text or "nan") for one in root}
    bulk = values.pop("k")
    terms = [(values[f"c{n}"], values[f"m{n}"]) for n in range(1, 7) if f"m{n}" in values]
    found: dict[str, tuple[Callable[[], Energy], Callable[[], float]]] = {
        "Ogden": (lambda: ogden(terms, lambda c, m: c / m**2), lambda: sum(c for c, _ in terms) / 2),
        "incomp neo-Hookean": (lambda: polynomial(values["G"] / 2), lambda: values["G"]),
        "Mooney-Rivlin": (lambda: mooney(values["c1"], values["c2"]), lambda: 2 * (values["c1"] + values["c2"])),
        "Yeoh": (lambda: polynomial(values["c1"], values["c2"], values["c3"]), lambda: 2 * values["c1"]),
        "Gent": (lambda: gent(values["G"], values["Jm"]), lambda: values["G"]),
    }
    energy, modulus = found[root.attrib["type"]]
    assert bulk == pytest.approx(BULK * modulus(), rel=1e-12)
    return energy(), float("nan")


READERS = {"film_abaqus.inp": abaqus, "film_ansys.mac": ansys, "film_comsol.txt": comsol, "film_febio.xml": febio}


def stress(film: Material, l1: float, l2: float) -> float:
    """Nominal stress by hand, from the definitions of the laws."""
    thin = (l1 * l2) ** -1.0
    rise, two, j = 2 * (l1 - thin**2 / l1), 2 * (l1 * l2**2 - l1**-3), first(l1, l2)
    mu = film.mu
    by_law: dict[object, Callable[[], float]] = {
        Ogden: lambda: sum(m * (l1**al - (l1 * l2) ** -al) for m, al in zip(mu, film.alpha, strict=True)) / l1,
        NeoHooke: lambda: mu[0] / 2 * rise,
        MooneyRivlin: lambda: mu[0] * rise + mu[1] * two,
        Yeoh: lambda: (mu[0] + 2 * mu[1] * j + 3 * mu[2] * j**2) * rise,
        Gent: lambda: mu[0] / 2 * rise / (1 - j / film.alpha[0]),
    }
    return by_law[film.law]()


@pytest.mark.parametrize("film", FILMS, ids=lambda film: film.name[:5])
@pytest.mark.parametrize("card", READERS)
def test_every_program_computes_the_stress_that_was_identified(card: str, film: Material) -> None:
    """The stress of the law's definition, by hand, against the slope of the program's own energy."""
    cards = material_cards(film)
    if film.law is Gent and card == "film_abaqus.inp":
        assert card not in cards
        assert without_card(film) == ["Abaqus has no Gent material of its own"]
        return
    assert (film.law is Gent) == bool(without_card(film))
    energy, permittivity = READERS[card](cards[card])
    for l1, l2 in ((1.3, 1.3), (1.8, 1.2), (2.0, 2.0**-0.5)):
        step = 1e-5
        slope = (energy(l1 + step, l2) - energy(l1 - step, l2)) / (2 * step)
        assert slope == pytest.approx(stress(film, l1, l2), rel=1e-7)
    if not np.isnan(permittivity):
        assert permittivity == pytest.approx(EPSILON_0 * film.eps_r, rel=1e-12)


def test_every_card_has_a_reader_and_states_both_conventions() -> None:
    assert {one.file for one in PROGRAMS} == set(READERS)
    for film in FILMS:
        for text in material_cards(film).values():
            assert "Convention of this card: W = " in text and "Convention of dea-rig: W = " in text


@pytest.mark.parametrize("film", FILMS, ids=lambda film: film.name[:5])
def test_the_card_of_a_sheet_is_the_same_without_a_permittivity(film: Material) -> None:
    whole = material_cards(film)
    for name, text in material_cards(film, electric=False).items():
        kept = [line for line in text.splitlines() if "Sheet identified" not in line and "Small-strain" not in line]
        gone = [line for line in whole[name].splitlines() if line not in text.splitlines()]
        assert set(kept) <= set(whole[name].splitlines()) and "permittivity not known" in text
        electric = [line for line in gone if "DIELECTRIC" in line or "PERX" in line or line.startswith("epsilonr")]
        assert bool(electric) == (name != "film_febio.xml")
        assert len(gone) == 2 + (2 if name == "film_abaqus.inp" else len(electric))


def test_what_no_program_has_is_refused_by_its_name() -> None:
    class Own(NeoHooke):
        name, title = "own", "own law"

    with pytest.raises(CardError, match="Abaqus has no own law material of its own; Ansys has no own law"):
        material_cards(Material("x", (5e4,), (), 3.0, law=Own))
    many = Material("many", (1e3,) * 7, (2.0,) * 7, 3.0)
    assert without_card(many) == ["FEBio's Ogden material has 6 terms at most, and this one has 7"]


def relaxation_abaqus(text: str, time: float) -> float:
    """G(t): the law's moduli are long-term ones, g over the instantaneous modulus (g, k, tau a line)."""
    lines = text.splitlines()
    assert any(line.startswith("*HYPERELASTIC") and line.endswith("MODULI=LONG TERM") for line in lines)
    first = lines.index("*VISCOELASTIC, TIME=PRONY") + 1
    series = [[float(one) for one in line.split(",")] for line in lines[first : lines.index("*DIELECTRIC")]]
    plain = without(text.replace(", MODULI=LONG TERM", ""), "*VISCOELASTIC", 1 + len(series))
    instant = small_modulus(READERS["film_abaqus.inp"](plain)[0]) / (1.0 - sum(g for g, _, _ in series))
    return instant * (1.0 - sum(g * (1.0 - np.exp(-time / tau)) for g, _, tau in series))


def relaxation_ansys(text: str, time: float) -> float:
    """G(t): the law's moduli are instantaneous ones, alpha over them (alpha, tau)."""
    part = text.split("TB,PRONY,1,1,")[1].splitlines()
    count = int(part[0].split(",")[0])
    series = [[float(one) for one in line.split(",")[2:4]] for line in part[1 : 1 + count]]
    instant = small_modulus(READERS["film_ansys.mac"](without(text, "TB,PRONY", count + 1))[0])
    return instant * (1.0 - sum(a * (1.0 - np.exp(-time / tau)) for a, tau in series))


def relaxation_comsol(text: str, time: float) -> float:
    """G(t): energy factors over the main branch."""
    values = dict(re.findall(r"^((?:beta|tau)_v\d) ([0-9.e+-]+)", text, re.MULTILINE))
    series = [(float(values[f"beta_v{k}"]), float(values[f"tau_v{k}"])) for k in (1, 2)]
    plain = "\n".join(line for line in text.splitlines() if "_v" not in line.split(" ")[0])
    modulus = small_modulus(READERS["film_comsol.txt"](plain)[0])
    return modulus * (1.0 + sum(factor * np.exp(-time / tau) for factor, tau in series))


def relaxation_febio(text: str, time: float) -> float:
    """G(t) = G_elastic (g0 + sum g exp(-t/tau))."""
    found = ElementTree.fromstring(text)
    assert found.get("type") == "uncoupled viscoelastic"
    number = {child.tag: float(child.text or "nan") for child in found if child.tag != "elastic"}
    elastic = found.find("elastic")
    assert elastic is not None
    elastic.tag = "material"
    modulus = small_modulus(READERS["film_febio.xml"](ElementTree.tostring(elastic, encoding="unicode"))[0])
    decay = sum(number[f"g{k}"] * np.exp(-time / number[f"t{k}"]) for k in (1, 2))
    return modulus * (number["g0"] + decay)


def without(text: str, beginning: str, count: int) -> str:
    lines = text.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith(beginning))
    return "\n".join(lines[:first] + lines[first + count :])


def small_modulus(energy: Energy) -> float:
    """Shear modulus at small strain: W = 2 G e^2 with stretches exp(e) and exp(-e)."""
    e = 1e-3
    return (energy(np.exp(e), np.exp(-e)) + energy(np.exp(-e), np.exp(e))) / (4.0 * e * e)


RELAXATIONS = {
    "film_abaqus.inp": relaxation_abaqus,
    "film_ansys.mac": relaxation_ansys,
    "film_comsol.txt": relaxation_comsol,
    "film_febio.xml": relaxation_febio,
}


@pytest.mark.parametrize("card", RELAXATIONS)
def test_the_prony_series_of_a_card_is_the_films_in_the_programs_own_convention(card: str) -> None:
    branches = (Branch(0.5, 2.0), Branch(0.25, 40.0))
    film = Material("viscous", (5e3, 3.5e4), (2.5, 5.6), 2.8, branches=branches)
    text = material_cards(film)[card]
    for time in (0.0, 1.0, 10.0, 100.0, 1e4):
        wanted = film.shear_modulus * (1.0 + sum(one.ratio * np.exp(-time / one.time) for one in branches))
        assert RELAXATIONS[card](text, time) == pytest.approx(wanted, rel=1e-4), time
    assert "branches:" in text
    assert "rest" in text
