"""``dea-rig plan`` for a film that takes time: quick moves with holds, beside the uniform sweep in the same time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.planning import expected_of_branches, planned_record
from calibration.film.propagation import FIXED
from calibration.sensors.certificate import Certificate
from model.material.materials import Material
from model.specimen import Specimen
from rig.analysis.proposal import SETTLE_S, framed, protocol_text, reachable, recorded, uniform_sweep
from rig.base.errors import LimitError
from rig.protocol.experiment import certificates_of
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene, load_scene
from rig.steps.base import Step
from rig.steps.relax import Relax
from rig.steps.voltage import Voltage

Array = NDArray[np.float64]

PATTERNS = ((1.0, 0.5), (1.0, 0.6, 0.8, 0.4))  # places of the holds at a voltage, over the largest displacement
SPEEDS = (1.0, 0.3)  # of the moves, over the largest that the scene allows
SHARES = (1.0, 2.0)  # time at 0 V over that at a voltage
LEAST_HOLD_S = 3.0
TO_TENTH = 10.0


@dataclass(frozen=True)
class Judged:
    """A protocol, its duration (s), and relative standard uncertainties by noise and zeros of what is fitted."""

    protocol: Protocol
    duration: float
    expected: dict[str, float]

    @property
    def value(self) -> float:
        """Sum of the logarithms: smaller is better."""
        return sum(math.log(one) for one in self.expected.values())


@dataclass(frozen=True)
class RelaxProposal:
    """The best protocol of quick moves and holds, the uniform sweep in the same time, and the protocol file."""

    film: Material
    planned: Judged
    sweep: Judged
    text: str


def propose_relaxation(scene_path: Path, time: float, film: Material | None = None) -> RelaxProposal:
    """Plan ``time`` seconds of the rig for the scene's film, or ``film``, which has branches.

    Raises
    ------
    ConfigError, LimitError
        When the scene cannot be used, or the time does not suffice.
    """
    scene, _ = load_scene(scene_path)
    certificates = certificates_of(scene, scene_path)
    specimen = scene.specimen.specimen()
    specimen = specimen if film is None else specimen.with_material(film)
    _, _, top_h, top_v = reachable(scene, specimen)
    judge = _Judge(scene, certificates, specimen)
    sweep = judge(uniform_sweep(scene, certificates, time, top_h, top_v))
    best: Judged | None = None
    for protocol in _candidates(scene, certificates, time, top_h, top_v):
        check_plan(plan(protocol, scene), scene)
        found = judge(protocol)
        if best is None or found.value < best.value:
            best = found
    if best is None:
        raise LimitError(f"{time:.0f} s are not enough for quick moves with holds at every voltage; give more time.")
    title = f"# Planned for {scene.specimen.name}, a film that takes time: {time / 60:.3g} min of the rig.\n"
    return RelaxProposal(specimen.material, best, sweep, title + protocol_text(best.protocol))


class _Judge:
    """What protocols of a scene tell of a film."""

    def __init__(self, scene: Scene, certificates: Mapping[str, Certificate], specimen: Specimen) -> None:
        self.scene, self.certificates, self.specimen = scene, certificates, specimen

    def __call__(self, protocol: Protocol) -> Judged:
        actions = plan(protocol, self.scene)
        errors = recorded(protocol, self.scene, self.certificates, self.specimen)[0]
        t, h, v, parts = [0.0], [0.0], [0.0], []
        for action in actions:
            if action.duration <= 0.0:
                continue
            begin = t[-1]
            t.append(begin + action.duration)
            h.append(max(0.0, action.h[1]))
            v.append(action.voltage[1])
            if action.record:
                parts.append((begin, t[-1]))
        force = self.certificates["force"]
        errors = replace(errors, force_noise=force.noise)
        record = planned_record(errors, np.array(t), np.array(h), np.array(v), self.scene.rates["force"])
        used = np.zeros(record.t.size, dtype=np.bool_)
        for begin, end in parts:
            used |= (record.t >= begin) & (record.t <= end)
        record = replace(record, used=record.used & used)
        rest = self.specimen.prestretch
        expected = expected_of_branches(record, self.specimen.material, (round(FIXED * rest, 2), rest))
        return Judged(protocol, t[-1], expected)


def _candidates(
    scene: Scene, certificates: Mapping[str, Certificate], time: float, top_h: float, top_v: float
) -> Iterator[Protocol]:
    voltages = [0.0, *(float(round(part * top_v / 10.0) * 10.0) for part in (2.0 / 3.0, 1.0))] if top_v else [0.0]
    for places in PATTERNS:
        for speed in SPEEDS:
            for share in SHARES if len(voltages) > 1 else SHARES[:1]:
                found = _filled(scene, certificates, time, top_h, voltages, (places, speed, share))
                if found is not None:
                    yield found


def _filled(
    scene: Scene,
    certificates: Mapping[str, Certificate],
    time: float,
    top_h: float,
    voltages: Sequence[float],
    how: tuple[Sequence[float], float, float],
) -> Protocol | None:
    """The protocol with holds as long as the time allows; None where that is too short."""
    places, speed, share = how

    def at(hold: float) -> Protocol:
        steps: list[Step] = []
        for voltage in voltages:
            if voltage:
                steps.append(Voltage(do="voltage", voltage_V=voltage, settle_s=SETTLE_S))
            steps.append(
                Relax(
                    do="relax",
                    displacements_mm=[round(1e3 * top_h * one, 2) for one in places],
                    speed_mm_per_s=round(scene.limits.speed_mm_per_s * speed, 3),
                    hold_s=math.floor(TO_TENTH * hold * (share if voltage == 0.0 else 1.0)) / TO_TENTH,
                )
            )
        if voltages[-1]:
            steps.append(Voltage(do="voltage", voltage_V=0.0, settle_s=SETTLE_S))
        return framed(scene, certificates, steps, top_h, "Quick moves and holds")

    def lasts(protocol: Protocol) -> float:
        return sum(action.duration for action in plan(protocol, scene))

    if lasts(at(LEAST_HOLD_S)) > time:
        return None
    low, high = LEAST_HOLD_S, time
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lasts(at(middle)) <= time else (low, middle)
    return at(low)
