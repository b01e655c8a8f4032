"""The simulated film breaks down where its true field reaches its strength, or where it has no state any more.

Judged by scanning the membrane model upwards in voltage, with the field worked out from the stretches at the disk's
rim, where a cone is thinnest; and for a slack film by the balance of a free one.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from model.material.materials import EPSILON_0, Material
from model.membrane.solve import Status, profiles, solve_many
from model.specimen import Specimen
from rig.sim.film import FilmTable, solve_membrane, tabulate

COARSE, STEP = 1.05, 1.003  # of the scan: from 500 V up, then once more over the last coarse step
FILMS = {
    # One term of a low exponent does not stiffen: under voltage it pulls in before it has its strength.
    "soft": Material("soft", (80e3,), (2.5,), 2.5, breakdown_field=80e6),
    "stiffening": Material("stiffening", (5e3, 35e3), (2.5, 5.6), 2.2, breakdown_field=78e6),
}
PULLS_IN, BY_FIELD, SLACK = "pulls in", "by its field", "slack"
CASES = [
    ("soft", 4e-3, PULLS_IN),
    ("soft", 8e-3, PULLS_IN),
    ("soft", 11e-3, PULLS_IN),
    ("soft", 17e-3, BY_FIELD),
    ("stiffening", 7e-3, BY_FIELD),
    ("stiffening", 15e-3, BY_FIELD),
]


def film(name: str) -> Specimen:
    return Specimen(4e-3, 20e-3, 40e-6, 1.2, FILMS[name])


@cache
def table(name: str) -> FilmTable:
    return tabulate(film(name), 0.0, True)


def rim_field(one: Specimen, h: float, voltage: float) -> float:
    there = profiles(one, [h], [voltage], 3, wrinkling="tension_field")
    return voltage / one.thickness * float(there.thinning[0, 0])


def end_at(name: str, h: float, voltage: float) -> str | None:
    """Why the film of this voltage has broken down; None where it has not."""
    one = film(name)
    status = solve_many(one, [h], [voltage], wrinkling="tension_field").status[0]
    if status == Status.SLACK:
        return SLACK
    if status not in (Status.TAUT, Status.WRINKLED):
        return PULLS_IN
    return BY_FIELD if rim_field(one, h, voltage) >= one.material.breakdown_field else None


@cache
def scan(name: str, h: float) -> tuple[float, str]:
    """Voltage of the last state below the film's strength, and what comes after it."""
    last = 500.0
    for step in (COARSE, STEP):
        while (found := end_at(name, h, last * step)) is None:
            last *= step
    return last, found


@pytest.mark.slow
@pytest.mark.parametrize(("name", "h", "how"), CASES)
def test_it_breaks_down_where_a_scan_of_the_model_says(name, h, how):
    voltage, found = scan(name, h)
    assert found == how
    assert table(name).breakdown_voltage(h) == pytest.approx(voltage, rel=0.008)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "h"), [(name, h) for name, h, how in CASES if how == BY_FIELD])
def test_the_field_at_the_rim_is_its_strength_then(name, h):
    field = rim_field(film(name), h, table(name).breakdown_voltage(h))
    assert field == pytest.approx(FILMS[name].breakdown_field, rel=4e-3)


@pytest.mark.slow
def test_where_it_pulls_in_the_state_is_lost_for_good():
    """Not one state that the solver happens to miss: nothing is found for a long way above."""
    h = np.array([h for name, h, how in CASES if name == "soft" and how == PULLS_IN])
    edge = np.array([table("soft").breakdown_voltage(one) for one in h])
    for part in (0.9, 0.99):
        assert solve_membrane(film("soft"), h, part * edge)[2].all()
    for part in (1.01, 1.03, 1.1):
        assert not solve_membrane(film("soft"), h, part * edge)[2].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(FILMS))
def test_a_slack_film_breaks_down_as_a_free_one(name):
    """A free film at voltage V has the stretch x at which eps (V x^2 / T)^2 = sum mu (x^a - x^-2a), if there is one."""
    m, h = FILMS[name], 1e-3
    x = np.linspace(1.01, 2.5, 100_000)
    stress = sum(mu * (x**a - x ** (-2 * a)) for mu, a in zip(m.mu, m.alpha, strict=True))
    field = np.sqrt(stress / (EPSILON_0 * m.eps_r))
    voltage = field * 40e-6 / x**2
    ends = (field >= m.breakdown_field) | np.append(np.diff(voltage) < 0, True)  # its strength; its last state
    end = int(ends.argmax())
    assert table(name).breakdown_voltage(h) == pytest.approx(voltage[end], rel=0.008)
    slack_from = next(v for v in 500.0 * STEP ** np.arange(1000) if scan_is_slack(name, h, v))
    assert slack_from < 0.99 * voltage[end]
    assert table(name).force(h, 0.5 * (slack_from + voltage[end])) == 0.0
    assert table(name).force(h, 0.97 * slack_from) > 0.0


def scan_is_slack(name: str, h: float, voltage: float) -> bool:
    return bool(solve_many(film(name), [h], [voltage], wrinkling="tension_field").status[0] == Status.SLACK)


@pytest.mark.parametrize("name", [pytest.param("soft", marks=pytest.mark.slow), "stiffening"])  # its table: 9 s
def test_the_force_is_the_models_up_to_where_the_tension_ends(name):
    one, made = film(name), table(name)
    h = np.linspace(1e-3, 19e-3, 7)[:, None]
    voltage = np.array([[made.top(float(s))] for s in h[:, 0]]) * np.array([0.0, 0.5, 0.9, 0.985])
    force, _, found = solve_membrane(one, np.broadcast_to(h, voltage.shape), voltage)
    assert found.all()
    table_force = [[made.force(float(s), v) for v in row] for s, row in zip(h[:, 0], voltage.tolist(), strict=True)]
    np.testing.assert_allclose(table_force, force, rtol=0, atol=5e-4 * made.force(made.reach, 0.0))
