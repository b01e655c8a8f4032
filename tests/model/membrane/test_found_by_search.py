"""States in which the random search (`model.verification.search`) once found two answers, each with its kind."""

from __future__ import annotations

import numpy as np
import pytest

from model.material.gent import Gent
from model.material.materials import Material
from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen

# A soft film on a small disk narrows below it like a soap film between rings, and has no state from 7.474 mm on at 0 V,
# where finite elements from rest end; further states stand beyond, of a film that passes under its own disk.
NARROWING = Specimen(
    0.0016828514334271286, 0.02, 1.3757270522133256e-05, 1.752144048012767,
    Material("narrows", (29326.095153447222, -4541.490766590298), (1.2122235912685604, -3.073681047731639), 3.0),
)  # fmt: skip
ENDS = 7.474e-3


@pytest.mark.parametrize("voltage", [0.0, pytest.param(135.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("tolerance", [pytest.param(1e-4, marks=pytest.mark.slow), 1e-6])
def test_a_film_that_narrows_too_far_has_no_state_at_any_tolerance(tolerance: float, voltage: float) -> None:
    h = np.array([0.95, 1.05, 1.5]) * ENDS
    found = solve_many(NARROWING, h, voltage, tolerance=tolerance, wrinkling="tension_field")
    assert found.status.tolist() == [Status.TAUT, Status.UNSTABLE, Status.UNSTABLE]


# A cut that stood a twentieth of its element off; and narrow folds between the disk and the first point of a film.
EDGES = [
    (Specimen(0.0028381323735620677, 0.02, 2.7457615799781977e-05, 1.0041689131577993,
              Material("gent", (49680.96072649929,), (18.77223181766785,), 3.0, law=Gent)),
     0.005632927592706611, 476.88668935238866),
    (Specimen(0.0010256989961124965, 0.02, 1.0407320364249633e-05, 1.1148466045579917,
              Material("three", (86640.62249606973, -24997.52952971192, 6.207897483266936),
                       (3.467858756186587, -1.8396556604874266, 6.951890042087668), 3.0)),
     0.007729527303291478, 451.9082583557318),
    (Specimen(0.004880188738951375, 0.02, 5.4658612906117444e-05, 2.247283626587139,
              Material("four", (10557.263802621905, 6.861583907656115, 1.1177447202323028, 43.748458121739205),
                       (2.2683712358497967, 8.251370229941669, 10.706291910509446, 5.953935816851401), 3.0)),
     0.007459300435223652, 490.4246457202749),
    # Narrow folds at the ring, which the force feels by the square of the hoop stress there.
    (Specimen(0.002264320919452188, 0.02, 1.0809970257206992e-05, 1.2259341459623636,
              Material("two", (23265.63614680697, 684.1780922816571), (3.606169010186658, 8.508942419263063), 3.0)),
     0.009623585820763178, 293.37472842796075),
    (Specimen(0.0014732721086316263, 0.02, 3.758998274893242e-05, 1.001684646670073,
              Material("two", (15762.263272842258, 9.89079693623856), (2.024212119334433, 9.378546610701264), 3.0)),
     0.002096418079425675, 123.6403114992977),
    (Specimen(0.00145691563449051, 0.02, 3.830822396575603e-05, 1.0117435383891449,
              Material("one", (42552.25905180746,), (1.9039706716290732,), 3.0)),
     0.0020903117601086983, 445.90557164845035),
    # A narrow fold at the disk of a film near loss of convexity, which stretches ten times further for it.
    (Specimen(0.004664767247591862, 0.02, 2.4125851452996098e-05, 1.7301694056625856,
              Material("gent", (67175.67333901661,), (31.083922759695014,), 3.0, law=Gent)),
     0.011315633124136582, 475.7358055302598),
]  # fmt: skip


@pytest.mark.parametrize(("film", "h", "voltage"), EDGES)
def test_edges_of_folded_zones_are_in_the_stated_error(film: Specimen, h: float, voltage: float) -> None:
    truth = solve(film, h, voltage, tolerance=1e-10, wrinkling="tension_field")
    for tolerance in (1e-4, 1e-5, 1e-6, 1e-8):
        found = solve(film, h, voltage, tolerance=tolerance, wrinkling="tension_field")
        assert found.status is Status.WRINKLED
        assert abs(found.force / truth.force - 1.0) <= found.error_estimate + truth.error_estimate


def test_a_soft_state_that_does_not_settle_from_few_modes_is_begun_with_more() -> None:
    film = Specimen(
        0.0019144421315530017, 0.02, 1.0676579503179238e-05, 2.001810470010569,
        Material("two", (21982.89266199965, 7.0180668705049), (1.4479192862819448, 10.546349466101926), 3.0),
    )  # fmt: skip
    rough, fine = (solve(film, 0.0038317815956783506, 123.84649159008657, tolerance=t, wrinkling="tension_field")
                   for t in (1e-6, 1e-8))  # fmt: skip
    assert rough.status is fine.status is Status.WRINKLED
    assert abs(rough.force / fine.force - 1.0) <= rough.error_estimate + fine.error_estimate


# Folds from the disk to an edge, or to the ring, under a law that is all but flat at their outer end: no polynomial in
# R knows such a cone. And a film without hoop tension that must widen by a seventh before it has its natural width.
FLAT = [
    (Specimen(0.0011528510320284611, 0.02, 1.9456674083352933e-05, 1.983538160518702,
              Material("gent", (19456.546015388154,), (73.26214476098559,), 3.0, law=Gent)),
     0.027931634961946537, 140.43584385488276),
    (Specimen(0.001093757379240633, 0.02, 4.098253820574749e-05, 1.941739246870767,
              Material("one", (10487.93208761269,), (3.928525244564822,), 3.0)),
     0.025033491976182723, 701.1093097022718),
    (Specimen(0.0063031161071722686, 0.02, 3.650176033575362e-05, 1.8653877782309054,
              Material("three", (43326.990880290585, 204.69563530733393, 382.6161208415705),
                       (3.520811225229857, 15.949161844662829, 7.046916298188088), 3.0)),
     0.020212045887603013, 118478.95790427468),
]  # fmt: skip
# Finite elements from rest (`model.verification.continuation`), where they reach the state: the force (N), its error.
BY_ELEMENTS = [(0.0268504304, 7e-5), (0.0953324063, 3e-5), (3651.46530281, 3e-6)]


@pytest.mark.parametrize(
    ("film", "h", "voltage", "force", "error"),
    [(*state, *force) for state, force in zip(FLAT, BY_ELEMENTS, strict=True)],
)
def test_a_nearly_flat_law_has_one_answer(film: Specimen, h: float, voltage: float, force: float, error: float) -> None:
    found = [solve(film, h, voltage, tolerance=t, wrinkling="tension_field") for t in (1e-4, 1e-6, 1e-8)]
    for one in found:
        assert one.status is Status.WRINKLED
        assert abs(one.force / force - 1.0) <= one.error_estimate + error
        # What is told beside the force does not hang on the resolution either.
        assert one.max_stretch == pytest.approx(found[-1].max_stretch, rel=1e-6)
        assert one.min_meridional_stress == pytest.approx(found[-1].min_meridional_stress, rel=1e-6)
        assert one.peak_field == pytest.approx(found[-1].peak_field, rel=2e-3)


@pytest.mark.slow
def test_the_end_of_a_branch_is_the_same_at_every_tolerance() -> None:
    film = Specimen(
        0.0035061300655400947, 0.02, 3.1007780740443206e-05, 2.496652973475339,
        Material("gent", (17289.021916459118,), (77.41272715108751,), 3.0, law=Gent),
    )  # fmt: skip
    h, end = 0.017707685161067997, 209.4991423543369  # the law loses convexity within 1e-4 of this voltage
    for voltage, status in ((end, Status.UNSTABLE), (0.99 * end, Status.WRINKLED)):
        for tolerance in (1e-4, 1e-6, 1e-8):
            assert solve(film, h, voltage, tolerance=tolerance, wrinkling="tension_field").status is status


# Taut films whose first two resolutions agree by chance, and stiffening ones in which a small step of Newton leaves
# more than its square, with voltage and without.
COARSE = [
    (Specimen(0.002808155072292662, 0.02, 6.19636670614087e-05, 1.088177943476491,
              Material("two", (40713.88635160549, 1.3754320308438035), (1.724884009862802, 13.17666982029673), 3.0)),
     0.013895226132631522, 916.2442730913692),
    (Specimen(0.001062933426608048, 0.02, 2.672074267747159e-05, 1.8104472023021851,
              Material("three", (65988.67844906347, -7077.332804866498, -1198.830662118592),
                       (2.108713667916463, -1.99444279662465, -3.789447637249004), 3.0)),
     0.008851578528757379, 751.3493568776499),
    (Specimen(0.0019794055773619257, 0.02, 6.482864031758117e-05, 1.3350979735442627,
              Material("mixed", (31991.717994176426, 0.39160707726580485, -402.50774530209935),
                       (1.894360736574436, 14.289890334595134, -2.2418504535925083), 3.0)),
     0.009944166409543452, 865.5575473501722),
    (Specimen(0.003561110770767849, 0.02, 4e-05, 1.3814340571570374,
              Material("treloar", (630000.0, 1200.0, -10000.0), (1.3, 5.0, -2.0), 2.4)),
     0.008366561435835064, 724.9473017643398),
]  # fmt: skip


@pytest.mark.parametrize(("film", "h", "voltage"), COARSE)
def test_taut_films_are_within_the_stated_error_at_coarse_resolutions(film: Specimen, h: float, voltage: float) -> None:
    truth = solve(film, h, voltage, tolerance=1e-10, wrinkling="tension_field")
    for tolerance in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        found = solve(film, h, voltage, tolerance=tolerance, wrinkling="tension_field")
        assert found.status is Status.TAUT
        assert abs(found.force / truth.force - 1.0) <= found.error_estimate + truth.error_estimate


def test_stiffening_films_are_within_a_share_of_the_stated_error() -> None:
    """A thousand taut films with and without voltage: what Newton and the resolution leave, with room to spare."""
    rng = np.random.default_rng(11)
    films, h = [], []
    for _ in range(1000):
        law = (10 ** rng.uniform(4, 5), 10 ** rng.uniform(0, 3)), (rng.uniform(1.3, 3.0), rng.uniform(6.0, 16.0))
        a = 0.02 * rng.uniform(0.06, 0.5)
        films.append(Specimen(a, 0.02, 40e-6, rng.uniform(1.05, 2.5), Material("stiffens", *law, 3.0)))
        h.append((0.02 - a) * rng.uniform(0.1, 1.5))
    voltage = np.where(np.arange(1000) % 2, 300.0, 0.0)
    truth = solve_many(films, np.array(h), voltage, tolerance=1e-11)
    taut = truth.status == Status.TAUT
    assert taut.sum() > 500
    for tolerance in (1e-4, 1e-6, 1e-8):
        found = solve_many(films, np.array(h), voltage, tolerance=tolerance)
        share = (np.abs(found.force / truth.force - 1.0) / found.error_estimate)[taut]
        assert share.max() < 1.0
        assert np.quantile(share, 0.99) < 0.5
