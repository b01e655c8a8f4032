"""The law of a film in a scene, in the simulated truth, in a study and in cases: its own keys, and no others."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from model.material.gent import Gent
from model.material.law import Law
from model.material.laws import known_laws
from model.material.ogden import Ogden
from rig.analysis.cases import solve_cases
from rig.base.errors import ConfigError
from rig.base.law_tables import MOST_TERMS, law_table
from rig.scene.scene import load_scene
from rig.scene.specimen import MaterialTable
from rig.sim.truth import FilmTruth
from rig.sim.world import true_specimen

SCENE = Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml"
BELIEVED = "mu_Pa = [33e3, 32e3]\nalpha = [2.0, 5.0]"
TRUE = "mu_Pa = [5e3, 35e3]\nalpha = [2.5, 5.6]"
GENT = 'law = "gent"\nmu_Pa = 9e4\nJm = 30.0'
YEOH = 'law = "yeoh"\nC1_Pa = 5e4\nC2_Pa = -1e3\nC3_Pa = 2e2'


def scene_with(tmp_path: Path, believed: str = BELIEVED, true: str = TRUE) -> Path:
    text = SCENE.read_text()
    for old, new in ((BELIEVED, believed), (TRUE, true)):
        assert text.count(old) == 1
        text = text.replace(old, new)
    for certificate in SCENE.parent.glob("../certificates"):
        (tmp_path / "certificates").symlink_to(certificate.resolve())
    (tmp_path / "scenes").mkdir()
    path = tmp_path / "scenes" / "scene.toml"
    path.write_text(text)
    return path


def test_a_scene_names_its_law(tmp_path: Path) -> None:
    scene, _ = load_scene(scene_with(tmp_path, GENT))
    film = scene.specimen.specimen().material
    assert (film.law, film.mu, film.alpha) == (Gent, (9e4,), (30.0,))
    assert scene.simulation is not None
    true = true_specimen(scene.simulation, scene.specimen.specimen()).material
    assert (true.law, true.alpha) == (Ogden, (2.5, 5.6))


def test_without_a_law_it_is_ogden(tmp_path: Path) -> None:
    named, _ = load_scene(scene_with(tmp_path, f'law = "ogden"\n{BELIEVED}'))
    plain, _ = load_scene(SCENE)
    assert named.specimen.specimen().material == plain.specimen.specimen().material


def test_the_simulated_film_has_a_law_of_its_own(tmp_path: Path) -> None:
    scene, _ = load_scene(scene_with(tmp_path, true=YEOH))
    assert scene.simulation is not None
    believed = scene.specimen.specimen()
    true = true_specimen(scene.simulation, believed).material
    assert true.values == {"C1": 5e4, "C2": -1e3, "C3": 2e2}
    assert true.name == f"{believed.material.name} as mounted"


def test_a_simulated_film_without_parameters_is_the_believed_one(tmp_path: Path) -> None:
    scene, _ = load_scene(scene_with(tmp_path, GENT, ""))
    assert scene.simulation is not None
    true = true_specimen(scene.simulation, scene.specimen.specimen()).material
    assert (true.law, true.values) == (Gent, {"mu": 9e4, "Jm": 30.0})


@pytest.mark.parametrize(
    ("believed", "words"),
    [
        ('law = "genty"\nmu_Pa = 9e4', ("law 'genty' is not known", "gent", "Did you mean 'gent'?")),
        ('law = "gent"\nmu_Pa = 9e4', ("Jm",)),
        (f"{GENT}\nalpha = [2.0]", ("alpha", "Allowed here: Jm, branches, breakdown_V_per_um, eps_r, law, max_")),
        ('law = "gent"\nmu_Pa = 9e4\nJm = 0.0099', ("Jm", "0.01")),
        ('law = "gent"\nmu_Pa = [9e4]\nJm = 30.0', ("mu_Pa", "number")),
        ('law = "gent"\nmu_Pa = -9e4\nJm = 30.0', ("shear modulus", "must be positive")),
        ('law = "ogden"\nmu_Pa = 9e4\nalpha = [2.0]', ("mu_Pa", "list")),
        ("law = 3\nmu_Pa = 9e4", ("law = 3", "quotes")),
        (f"{BELIEVED}\nJm = 3.0", ("Jm", "unknown key")),
    ],
)
def test_errors_speak_of_the_keys_of_the_law(tmp_path: Path, believed: str, words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scene(scene_with(tmp_path, believed))
    for word in words:
        assert word in str(caught.value)
    assert "C1_Pa" not in str(caught.value)


@pytest.mark.parametrize(
    ("true", "words"),
    [
        ("mu_Pa = [5e3]", ("mu_Pa and alpha come together", "alpha is missing")),
        ("mu_Pa = [5e3]\nalpha = [2.0, 3.0]", ("pair up",)),
        ('law = "gent"\nmu_Pa = 9e4', ("mu_Pa and Jm come together",)),
        ('law = "gent"\nC1_Pa = 9e4', ("C1_Pa", "unknown key")),
    ],
)
def test_errors_of_the_simulated_film(tmp_path: Path, true: str, words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scene(scene_with(tmp_path, true=true))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("law", known_laws().values(), ids=lambda law: law.name)
def test_keys_of_every_law_are_described(law: type[Law]) -> None:
    for base, optional in ((MaterialTable, False), (FilmTruth, True)):
        table = law_table(base, law, optional=optional)  # type: ignore[type-var]
        for p in (*law.moduli, *law.shapes):
            field = table.model_fields[p.key]
            assert p.description in (field.description or "")
            assert field.is_required() is not optional
        assert (table.model_fields["law"].default == "ogden") is (law is Ogden)


def test_so_many_ogden_terms_are_taken_and_no_more(tmp_path: Path) -> None:
    for terms, taken in ((1, True), (MOST_TERMS, True), (MOST_TERMS + 1, False), (0, False)):
        given = {"mu_Pa": [1e4] * terms, "alpha": [2.0 + n for n in range(terms)]}
        table = law_table(MaterialTable, Ogden, optional=False)
        if taken:
            assert len(table(**given).material("m").mu) == terms
        else:
            with pytest.raises(ValueError, match=r"at (most 6|least 1) item"):
                table(**given)


def case(material: object) -> dict[str, object]:
    film = {"id": "x", "a": 4e-3, "b": 20e-3, "thickness": 40e-6, "prestretch": 1.2, "h": 10e-3}
    return film | {"material": material}


def test_cases_name_their_law() -> None:
    gent = {"law": "gent", "mu": 8e4, "Jm": 1e6, "eps_r": 2.0}
    answers = solve_cases(
        [
            case(gent),
            case({"law": "neo_hooke", "mu": 8e4, "eps_r": 2.0}),
            case({"mu": [8e4], "alpha": [2.0], "eps_r": 2.0}),
            case({"law": "mooney_rivlin", "C1": 4e4, "C2": 0.0, "eps_r": 2.0}),
            case({"law": "yeoh", "C1": 4e4, "C2": 0.0, "C3": 0.0, "eps_r": 2.0}),
            case(gent | {"alpha": 2.0}),
            case({"law": "gent", "mu": 8e4, "eps_r": 2.0}),
            case(gent | {"law": "genty"}),
            case(gent | {"law": 3}),
            case(gent | {"Jm": 0.001}),
            case(gent | {"mu": [8e4]}),
        ]
    )
    forces = [answer["F"] for answer in answers[:5]]
    assert forces == pytest.approx([forces[1]] * 5, rel=2e-6)  # at these stretches (I1 - 3)/Jm is 1e-6
    assert forces[1:] == pytest.approx([forces[1]] * 4, rel=1e-8)
    assert [answer["status"] for answer in answers[5:]] == ["invalid"] * 6
    for answer, words in zip(
        answers[5:],
        (
            "unknown key 'alpha'; allowed are law, mu, Jm, eps_r",
            "lacks the key 'Jm'",
            "law 'genty' is not known; known are ogden",
            "must be the name of a law",
            "Jm = 0.001: allowed are 0.01",
            "material.mu must be a number",
        ),
        strict=True,
    ):
        assert words in answer["message"]
