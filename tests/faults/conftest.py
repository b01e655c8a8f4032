"""A short run on the simulated bench in memory, with faults to order and the hidden truth to look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from drivers.links.link import DeviceError
from rig.base.certificates import load_certificate
from rig.base.errors import RigError
from rig.base.toml_file import parse_table
from rig.engine import engine as engine_module
from rig.engine.engine import LONGEST_TURN_S, Engine
from rig.engine.outcome import Outcome
from rig.log.reader import read_log
from rig.log.recorder import Gains
from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.run.backend import open_bench
from rig.scene.scene import Scene
from rig.sim.bench import SimulatedBench
from tests.protocols import TO_THE_FILM, near

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
PROTOCOL = (
    TO_THE_FILM
    + """[[step]]
do = "voltage"
voltage_V = 1000
settle_s = 0.5
[[step]]
do = "ramp"
displacement_mm = 6.0
speed_mm_per_s = 2.0
[[step]]
do = "hold"
duration_s = 2.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""
)


@dataclass
class Story:
    """What became of one run: what the software says, and what the simulated hardware did."""

    outcome: Outcome
    error: RigError | DeviceError | None
    bench: SimulatedBench
    log: Path
    mischief_at: float
    end: float
    outputs: list[tuple[float, float]]  # time and the supply's own output, which no driver has seen
    final_output: float

    @property
    def took(self) -> float:
        """Seconds from the mischief to the end of the run."""
        return self.end - self.mischief_at

    @property
    def off_after(self) -> float:
        """Seconds from the mischief until the log has the output measured below 60 V."""
        hv = read_log(self.log).columns("/hv/sample")
        return float(hv["t_s"][(hv["t_s"] > self.mischief_at) & (hv["voltage_V"] < 60)][0]) - self.mischief_at

    @property
    def stage_words(self) -> list[str]:
        """What was commanded of the stage, in order, from the log."""
        return [m.fields["command"] for m in read_log(self.log).messages("/command") if m.fields["device"] == "stage"]

    @property
    def control_words(self) -> list[str]:
        """What was commanded of the supply, in order, from the log."""
        return [m.fields["command"] for m in read_log(self.log).messages("/command") if m.fields["device"] == "hv"]


Mischief = Callable[[SimulatedBench, Control], None]
Meanwhile = Callable[[float, SimulatedBench, Control], None]
Tell = Callable[..., Story]


@pytest.fixture
def tell(tmp_path: Path) -> Tell:
    """``tell(mischief, replace, scene)`` runs the short protocol on the simulated bench.

    ``mischief(bench, stop)`` is called once, with 1000 V on and the stage moving. ``replace``, and ``also``, are
    (old, new) in the text of the scene, which is named as among the fixtures. ``meanwhile(now, bench, control)`` is
    called about five times a second of the run, and as often the story tells the supply's true output. Without
    ``checked`` the plan is not held against the limits beforehand: what is left is what the rig itself refuses.
    ``nearer`` shortens the way to the film, 40 mm in the scenes. ``quick`` takes a steeper ramp than their
    300 V/s, and a loop that comes round as seldom as it may on a slow machine: half the turns.
    """

    def run(
        mischief: Mischief | None = None,
        *,
        replace: tuple[str, str] | None = None,
        also: tuple[str, str] | None = None,
        scene: str = "cone-4mm",
        meanwhile: Meanwhile | None = None,
        protocol: str = PROTOCOL,
        control: Control | None = None,
        requested: str = "a test",
        take_down: str = "",
        clear: str = "",
        checked: bool = True,
        stored_zero: float | None = None,
        nearer: bool = True,
        quick: bool = True,
    ) -> Story:
        text = (SCENES / f"{scene}.toml").read_text()
        for pair in (replace, also):
            if pair is not None:
                assert pair[0] in text
                text = text.replace(*pair)
        if nearer:
            text = near(text)
        if quick:
            text = text.replace("ramp_V_per_s = 300.0", "ramp_V_per_s = 500.0")
        parsed = parse_table(text, Scene, "scene", "test")
        actions = plan(parse_table(protocol, Protocol, "protocol", "test"), parsed)
        if checked:
            check_plan(actions, parsed)
        certificate = load_certificate(SCENES / parsed.force.certificate)
        gains = Gains(force=certificate.gain, force_unit=certificate.reading_unit, stored_zero=stored_zero)
        bench = open_bench(parsed)
        assert bench.simulated is not None
        simulated, clock, stop = bench.simulated, bench.clock, control or Control(unattended="a test")
        outputs: list[tuple[float, float]] = []
        done_at: list[float] = []

        def progress(done: float, total: float, label: str) -> None:
            now = clock.now()
            outputs.append((now, float(simulated.world.voltage(np.array([now]))[0])))
            if meanwhile is not None:
                meanwhile(now, simulated, stop)
            if mischief is not None and "ramp: 0 to 6 mm" in label and not done_at:
                moving = simulated.world.stage.end > now
                if moving:
                    done_at.append(now)
                    mischief(simulated, stop)

        path = tmp_path / "run.mcap"
        with LogWriter(path) as log:
            known = {"force": certificate}
            engine = Engine(bench, actions, log, gains, stop, progress, known, requested, take_down, clear)
            with pytest.MonkeyPatch.context() as patch:
                if quick:
                    patch.setattr(engine_module, "SHORTEST_TURN_S", LONGEST_TURN_S)
                outcome, error = engine.run()
            bench.close()
            if not engine.recorder.log_failed:
                log.finish(outcome.as_text())
        assert mischief is None or done_at, "the mischief never happened"
        now = clock.now()
        final = float(simulated.world.voltage(np.array([now]))[0])
        return Story(outcome, error, simulated, path, done_at[0] if done_at else now, now, outputs, final)

    return run
