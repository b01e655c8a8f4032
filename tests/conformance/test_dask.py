"""Design maps on somebody else's scheduler: a local Dask cluster gives the same table as one process."""

from __future__ import annotations

import pytest

from model.actuator.bias import Mass, Spring
from model.actuator.design import SameFilm, Treatment, points, sweep
from model.actuator.stroke import Criteria
from model.material.materials import NAMED
from model.specimen import Specimen

distributed = pytest.importorskip("distributed", reason="needs the conformance dependency group")
pytestmark = pytest.mark.conformance


def test_a_dask_cluster_gives_the_same_table() -> None:
    films = [Specimen(a * 1e-3, 20e-3, 40e-6, 1.1, NAMED["parker-cao2018"]) for a in (3, 6)]
    recipes = {"I": Spring(0.8, 50.0), "II": Mass(0.25), "III": SameFilm(20e-3)}
    wanted = points(films, recipes, list(Treatment), Criteria(field=80e6, stretch=2.4))
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        carried = sweep(wanted, executor=client.get_executor())
    alone = sweep(wanted)
    assert repr(carried.rows) == repr(alone.rows)
    assert len(carried.rows) == 18
