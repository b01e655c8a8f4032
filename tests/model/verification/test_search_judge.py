"""What the random search tells as a difference, of answers that are given: of those it must tell each, and no other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from model.material.gent import Gent
from model.material.materials import Material
from model.membrane.solve import Status
from model.specimen import Specimen
from model.verification import search
from model.verification.search import MIDDLE, PLACES, STEP, Report, States, _Judge, draw

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("neo", (3e4,), (2.0,), 3.0))
ERROR = 1e-9


def answers(force: Any, status: Any = Status.TAUT, error: float = ERROR) -> Any:
    force = np.asarray(force, dtype=float)
    status = np.broadcast_to(np.asarray(status, dtype=np.int8), force.shape)
    fields = dict.fromkeys(
        (
            *("peak_field", "peak_field_radius", "min_hoop_stress", "min_meridional_stress", "max_stretch"),
            *("iterations", "modes", "stable", "field_exceeded", "stretch_exceeded"),
        ),
        force,
    )
    answered = status <= Status.WRINKLED
    return SimpleNamespace(
        force=force, status=status, answered=answered, error_estimate=np.full(force.shape, error), **fields
    )


def judge(found: Any) -> _Judge:
    count = len(found.force)
    states = States([FILM] * count, np.full(count, 5e-3), np.full(count, 1000.0))
    return _Judge(Report(), states, found, "tension_field")


def swept(monkeypatch: pytest.MonkeyPatch, force: Any, status: Any = Status.TAUT, along: str = "voltage") -> list[str]:
    """What is told of one sweep whose forces and statuses are given, at -2, -1, 0, 1, 2 steps."""
    asked: list[tuple[Any, Any]] = []

    def solve(films: Any, h: Any, v: Any, **how: Any) -> Any:
        asked.append((np.array(h, dtype=float), np.array(v, dtype=float)))
        return answers(np.array([force]), status)

    monkeypatch.setattr(search, "solve_many", solve)
    monkeypatch.setattr(search, "_pick", lambda found, index: answers(found.force[index], found.status[index]))
    monkeypatch.setattr(search, "jumps", lambda *a: True, raising=False)
    one = judge(answers([force[2]], np.broadcast_to(status, (5,))[2:3]))
    one.sweep(along)
    h, v = (np.broadcast_to(one_, (1, 5))[0] for one_ in asked[0])
    steps = 1.0 + STEP * np.array(PLACES)
    np.testing.assert_allclose(h, 5e-3 * (steps if along == "displacement" else 1.0))
    np.testing.assert_allclose(v, 1000.0 * (steps if along == "voltage" else 1.0))
    return [difference.way for difference in one.report.differences]


X = np.array(PLACES, dtype=float)


@pytest.mark.parametrize("along", ["voltage", "displacement"])
def test_a_force_that_is_smooth_in_a_sweep_is_no_difference(monkeypatch: pytest.MonkeyPatch, along: str) -> None:
    """A cubic goes exactly through its own middle: (4 (f1 + f3) - f0 - f4)/6."""
    assert swept(monkeypatch, 0.2 - 1e-3 * X + 2e-5 * X**2 - 3e-6 * X**3, along=along) == []


@pytest.mark.parametrize("off", [1e-4, -1e-4])
def test_a_force_that_its_neighbours_do_not_lead_to_is_told(monkeypatch: pytest.MonkeyPatch, off: float) -> None:
    force = 0.2 - 1e-3 * X
    force[2] += off
    assert swept(monkeypatch, force) == ["in a sweep of the voltage, led to"]


def test_a_force_off_within_what_is_stated_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    force = 0.2 - 1e-3 * X
    force[2] *= 1.0 + 2.0 * ERROR
    assert swept(monkeypatch, force) == []


T, W, U, S = Status.TAUT, Status.WRINKLED, Status.UNSTABLE, Status.SLACK


@pytest.mark.parametrize(
    ("statuses", "told"),
    [
        ((T, T, W, U, S), 0),
        ((T, W, U, U, U), 0),
        ((W, U, W, U, S), 1),
        ((T, T, T, S, U), 1),
        ((T, U, T, S, W), 2),
    ],
)
@pytest.mark.parametrize("along", ["voltage", "displacement"])
def test_an_answer_does_not_come_back_once_it_has_ended(
    monkeypatch: pytest.MonkeyPatch, statuses: tuple[Status, ...], told: int, along: str
) -> None:
    found = swept(monkeypatch, 0.2 - 1e-3 * X, np.array(statuses, dtype=np.int8), along)
    assert found == (["in a sweep of the voltage, then"] * told if along == "voltage" else [])


def test_statuses_and_forces_are_compared_with_what_is_stated() -> None:
    one = judge(answers([1.0, 2.0, 3.0, 4.0], [T, T, T, U]))
    one.same(answers([1.0 + 1.9 * ERROR, 2.0 + 4.2 * ERROR, 3.0, 9.0], [T, T, W, U]), "twice")
    assert [(d.way, d.status, d.other) for d in one.report.differences] == [("twice", T, W), ("twice", T, T)]
    assert one.report.differences[1].off == pytest.approx(2.1 * ERROR, rel=1e-5)
    assert one.report.differences[1].allowed == pytest.approx(2.0 * ERROR)
    assert "solve(Specimen(0.004, 0.02, 4e-05, 1.2" in str(one.report.differences[1])
    close = judge(answers([1.0, 1.0]))
    close.same(answers([1.0 + 5e-10, 1.0 + 5e-12]), "in company", 1e-12 * 10)
    assert [d.way for d in close.report.differences] == ["in company"]


def test_every_state_has_an_answer_or_a_reason() -> None:
    one = judge(answers([1.0, 1.0, 1.0], [T, U, Status.NOT_CONVERGED]))
    one.settled()
    assert [d.other for d in one.report.differences] == [Status.NOT_CONVERGED]
    rough = judge(answers([1.0], T, error=1.1 * MIDDLE))
    rough.settled()
    assert len(rough.report.differences) == 1


def test_films_are_drawn_as_it_says() -> None:
    drawn = draw(120, 7)
    materials = [one.material for one in drawn.films]
    gents = [m for m in materials if m.law is Gent]
    assert 5 <= len(gents) <= 35 and {len(m.mu) for m in materials if m.law is not Gent} == {1, 2, 3, 4}
    for film, h in zip(drawn.films, drawn.h, strict=True):
        m = film.material
        assert 0.05 <= film.disk_radius / film.ring_radius <= 0.6 and 1e-5 <= film.thickness <= 1e-4
        assert 1.0 <= film.prestretch <= 2.5
        assert 0.1 <= h / (film.ring_radius - film.disk_radius) <= 1.5
        assert 1e4 <= m.mu[0] <= 1e5
        for mu, alpha in zip(m.mu[1:], m.alpha[1:], strict=True):
            least, most = (1e-5, 1e-1) if mu > 0.0 else (1e-2, 10**-0.5)
            assert least <= abs(mu) / m.mu[0] <= most and (5.0 <= alpha <= 16.0 if mu > 0.0 else -4.0 <= alpha <= -1.0)
    again = draw(120, 7)
    assert again.films == drawn.films and (again.voltage == drawn.voltage).all()
    turned = drawn.turned()
    assert turned.films[0] == drawn.films[-1] and turned.h[0] == drawn.h[-1] and len(drawn.every(7).films) == 18
