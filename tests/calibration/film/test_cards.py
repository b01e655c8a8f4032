"""Material cards, read back by an evaluation of each program's own convention that shares nothing with ours."""

import re
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np
import pytest

from calibration.film.cards import BULK, CARDS, CardError, material_cards
from model.material.materials import EPSILON_0, Material
from model.material.neo_hooke import NeoHooke

FILMS = [
    Material("one", (37_834.0,), (5.4985,), 1.7),
    Material("a film & <b>", (5e3, 3.5e4), (2.5, 5.6), 2.8),
    Material("three", (6.3e5, 1.2e3, -1e4), (1.3, 5.0, -2.0), 3.0),
]
Energy = Callable[[float, float], float]


def abaqus(text: str) -> tuple[Energy, float]:
    """W = sum 2 mu/alpha^2 (...); mu and alpha in turn, then as many D, eight a line; then the permittivity in F/m."""
    lines = [line for line in text.splitlines() if not line.startswith("**")]
    at = next(k for k, line in enumerate(lines) if line.startswith("*HYPERELASTIC, OGDEN"))
    count = int(lines[at].rsplit("=", 1)[1])
    rows = lines[at + 1 : lines.index("*DIELECTRIC")]
    assert all(len(row.split(",")) <= 8 for row in rows)
    numbers = [float(one) for row in rows for one in row.split(",")]
    assert len(numbers) == 3 * count and not any(numbers[2 * count :])
    terms = list(zip(numbers[0 : 2 * count : 2], numbers[1 : 2 * count : 2], strict=True))
    permittivity = float(lines[lines.index("*DIELECTRIC") + 1])
    return lambda a, b: sum(2 * m / k**2 * (a**k + b**k + (a * b) ** -k - 3) for m, k in terms), permittivity


def ansys(text: str) -> tuple[Energy, float]:
    """W = sum mu/alpha (...); mu and alpha in turn, then d; TBDATA names where its numbers begin, six at most."""
    (head,) = re.findall(r"^TB,HYPER,1,1,(\d),OGDEN$", text, re.M)
    table: dict[int, float] = {}
    for row in re.findall(r"^TBDATA,(.*)$", text, re.M):
        begin, *numbers = row.split(",")
        assert len(numbers) <= 6
        table.update({int(begin) + k: float(one) for k, one in enumerate(numbers)})
    count = int(head)
    assert sorted(table) == list(range(1, 3 * count + 1))
    terms = [(table[2 * n + 1], table[2 * n + 2]) for n in range(count)]
    (eps,) = re.findall(r"^MP,PERX,1,(.*)$", text, re.M)
    return lambda a, b: sum(m / k * (a**k + b**k + (a * b) ** -k - 3) for m, k in terms), float(eps) * EPSILON_0


def comsol(text: str) -> tuple[Energy, float]:
    """W = sum mu/alpha (...); a file of parameters: name, expression, description."""
    values = {}
    for line in text.splitlines():
        if line and not line.startswith("%"):
            name, value, _ = line.split(" ", 2)
            values[name] = float(value.removesuffix("[Pa]"))
    terms = [(values[f"mu{n}"], values[f"alpha{n}"]) for n in range(1, 1 + (len(values) - 1) // 2)]
    energy: Energy = lambda a, b: sum(m / k * (a**k + b**k + (a * b) ** -k - 3) for m, k in terms)  # noqa: E731
    return energy, values["epsilonr"] * EPSILON_0


def febio(text: str) -> tuple[Energy, float]:
    """W = sum c/m^2 (...) and a bulk modulus; no permittivity."""
    root = ElementTree.fromstring(text)
    assert root.attrib["type"] == "Ogden"
    values = {str(one.tag): float(one.text or "nan") for one in root}
    terms = [(values[f"c{n}"], values[f"m{n}"]) for n in range(1, 1 + (len(values) - 1) // 2)]
    assert values["k"] == pytest.approx(BULK * sum(c for c, _ in terms) / 2.0, rel=1e-12)
    return lambda a, b: sum(c / m**2 * (a**m + b**m + (a * b) ** -m - 3) for c, m in terms), float("nan")


READERS = {"film_abaqus.inp": abaqus, "film_ansys.mac": ansys, "film_comsol.txt": comsol, "film_febio.xml": febio}


@pytest.mark.parametrize("film", FILMS, ids=lambda film: film.name[:5])
@pytest.mark.parametrize("card", READERS)
def test_every_program_computes_the_stress_that_was_identified(card: str, film: Material) -> None:
    """The stress of the definition in README, by hand, against the slope of the program's own energy."""
    energy, permittivity = READERS[card](material_cards(film)[card])
    for l1, l2 in ((1.3, 1.3), (1.8, 1.2), (2.0, 2.0**-0.5)):
        step = 1e-5
        slope = (energy(l1 + step, l2) - energy(l1 - step, l2)) / (2 * step)
        stress = sum(mu * (l1**al - (l1 * l2) ** -al) for mu, al in zip(film.mu, film.alpha, strict=True)) / l1
        assert slope == pytest.approx(stress, rel=1e-7)
    if not np.isnan(permittivity):
        assert permittivity == pytest.approx(EPSILON_0 * film.eps_r, rel=1e-12)


def test_every_card_has_a_reader_and_states_both_conventions() -> None:
    assert set(CARDS) == set(READERS)
    for text in material_cards(FILMS[1]).values():
        assert "Convention of this card" in text and "Convention of dea-rig" in text


def test_another_law_is_refused_by_its_name() -> None:
    other = Material("nh", (5e4,), (), 3.0, law=NeoHooke)
    with pytest.raises(CardError, match="Ogden's law"):
        material_cards(other)
