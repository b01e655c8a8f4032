"""The process that fits for a closed loop: ``python -m rig.analysis.refit``, started by `rig.analysis.refitting`.

It reads one line of JSON with the logs and the step, then a line for every question, and answers each with one line:
the fields of an `rig.steps.advisor.Advice`, and under ``known`` those of each `rig.steps.advisor.Standing`. It reads
the log that the run is writing, and nothing else. It ends when its input does.
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from calibration.film.curve import Curve
from calibration.film.result import Identification
from drivers.links.link import DeviceError
from model.material.materials import Material
from rig.analysis.film import curves_in, identify_logs
from rig.analysis.learning import Learner
from rig.base.errors import DataError, RigError
from rig.base.toml_file import parse_table
from rig.log.dataset import load_run
from rig.log.errors import LogError
from rig.log.follow import growing
from rig.scene.scene import Scene
from rig.steps.advisor import Advice, Ask, Kind
from rig.steps.wanted import parse_wanted

STARTS = 2  # of a fit that goes on from the last one
NICE = 5  # the run comes first


class Refit:
    """Answers the questions of one step, from its logs."""

    def __init__(self, log: str, earlier: list[str], scene: str, step: dict[str, Any]) -> None:
        self._log = Path(log)
        self._earlier = [Path(one) for one in earlier]
        self._terms = int(step["terms"])
        self._scene = table = parse_table(scene, Scene, "scene", "scene.toml of the run")
        speed = min(step["speed_mm_per_s"], table.limits.speed_mm_per_s) * 1e-3
        self._learner = Learner(table, parse_wanted(step["until"]), step["settle_s"], speed)
        self._near: tuple[Material, ...] = ()

    def answer(self, question: Ask) -> Advice:
        """The advice; one that says why where there is none."""
        try:
            curves, found = self._fit([*self._earlier, growing(self._log)])
            return self._learner.advise(curves, found, question)
        except (RigError, LogError, DeviceError, ValueError, ArithmeticError) as error:
            return Advice(Kind.FAILED, f"the fit failed: {error}")

    def _fit(self, paths: list[Path]) -> tuple[list[Curve], Identification | None]:
        try:
            found = identify_logs(paths, terms=self._terms, starts=STARTS, near=self._near)
        except DataError:
            if self._near:
                raise
            return [curve for path in paths for curve in curves_in(load_run(path), self._scene)], None  # too few yet
        self._near = (found.identification.material,)
        return found.curves, found.identification


def main() -> None:
    """Serve until the input ends."""
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(NICE)
    refit: Refit | None = None
    for line in sys.stdin:
        told = json.loads(line)
        if refit is None:
            import lmfit  # noqa: F401 # now, before the first question

            refit = Refit(**told)
            continue
        advice = refit.answer(Ask(**told))
        known = [one.as_fields() for one in advice.known]
        sys.stdout.write(json.dumps(advice.as_fields() | {"known": known}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
