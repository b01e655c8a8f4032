"""The step ``cycle``: every cycle counted once whatever interrupts, what the log keeps, what ends it, what it says of
the film: against the simulated film's truth, which the step knows nothing of."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig.base.errors import LimitError
from rig.engine.engine import Engine
from rig.log.decimation import Decimation
from rig.log.reader import Log, read_log
from rig.log.schema import encode
from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.operator.status import Status
from rig.protocol.experiment import Experiment, gains_of, prepare
from rig.protocol.plan import plan
from rig.protocol.protocol import Protocol
from rig.replay.recording import load_recording
from rig.replay.verify import verify
from rig.run.backend import open_bench
from rig.run.rehearse import log_size
from rig.run.resume import prepare_resumed
from rig.run.run import run
from rig.scene.scene import load_scene
from rig.steps.cycle import Cycle, Drift, Ends, Slope
from tests.protocols import TO_THE_FILM
from tests.rig.steps.test_keys_of_steps import BEFORE, SCENES

FIXTURES = Path(str(files("sim_fixtures")))


def cycling(tmp_path: Path, step: str, *, replace: dict[str, str] | None = None) -> tuple[Path, Path]:
    """Scene and protocol: to the film, then the step with these keys."""
    scene, protocol = tmp_path / "scene.toml", tmp_path / "protocol.toml"
    text = (
        (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
    )
    near = {
        "approach_from_mm = 36.0": "approach_from_mm = 13.0",
        "contact_position_mm = 40.0": "contact_position_mm = 17.0",
    }
    for old, new in {**near, **(replace or {})}.items():
        assert old in text, old
        text = text.replace(old, new)
    scene.write_text(text)
    protocol.write_text(f'{TO_THE_FILM}[[step]]\ndo = "cycle"\n{step}')
    return scene, protocol


def carried_out(experiment: Experiment, out: Path) -> Log:
    run(experiment, out, lambda done, total, label: None)
    return read_log(out)


def summaries(log: Log) -> list[dict[str, Any]]:
    return [dict(message.fields) for message in log.messages("/cycle")]


def results(log: Log) -> dict[str, float]:
    return {m.fields["name"]: m.fields["value"] for m in log.messages("/result")}


BREAKS = '[[simulation.fault]]\nrole = "hv"\nkind = "breakdown"\nat_s = 23\n'
DISPLACEMENT = "from_mm = 1\nto_mm = 2.5\nperiod_s = 1.2\n"


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> tuple[Log, Experiment]:
    folder = tmp_path_factory.mktemp("many")
    experiment = prepare(*cycling(folder, DISPLACEMENT + "cycles = 24\nkeep_every = 8\n"))
    return carried_out(experiment, folder / "log.mcap"), experiment


@pytest.mark.slow
def test_every_cycle_has_its_summary_and_the_stiffness_is_the_films(many: tuple[Log, Experiment]) -> None:
    log, experiment = many
    rows = summaries(log)
    assert [row["cycle"] for row in rows] == list(range(1, 25)) and all(row["whole"] for row in rows)
    begins = np.array([row["begin_s"] for row in rows])
    assert np.diff(begins) == pytest.approx(1.2, abs=0.01) and begins[-1] - begins[0] == pytest.approx(
        23 * 1.2, rel=1e-3
    )
    assert {row["samples"] for row in rows} <= {119, 120, 121}
    from model.membrane.solve import solve_many
    from rig.sim.world import true_specimen

    simulation = experiment.scene.simulation
    assert simulation is not None
    h = np.linspace(1e-3, 2.5e-3, 60)
    truth = np.polyfit(h, solve_many(true_specimen(simulation, experiment.scene.specimen.specimen()), h, 0.0).force, 1)[
        0
    ]
    measured = np.array([row["stiffness_N_per_m"] for row in rows])
    assert measured.mean() == pytest.approx(truth, abs=4 * measured.std() / math.sqrt(len(rows)) + 0.02 * truth)
    assert [row["displacement_peak_m"] for row in rows] == pytest.approx([2.5e-3] * 24, abs=2e-5)
    assert results(log)["cycles"] == 24.0
    work = np.array([row["work_J"] for row in rows])  # an elastic film dissipates nothing
    assert abs(work.mean()) < 4 * work.std() / math.sqrt(len(work)) + 0.01 * truth * 2e-6


@pytest.mark.slow
def test_whole_waveforms_are_kept_by_the_rule_and_nowhere_else(many: tuple[Log, Experiment]) -> None:
    log, _ = many
    rows = summaries(log)
    kept = [row["cycle"] for row in rows if row["kept"]]
    assert kept == [*range(1, 11), 16, 20, 24]
    t = log.columns("/force/sample")["t_s"]
    for row in rows:
        inside = np.count_nonzero((t > row["begin_s"] + 0.01) & (t < row["t_s"] - 0.01))
        assert inside == (pytest.approx(row["samples"], abs=3) if row["kept"] else 0), row["cycle"]
    assert not log.missing and not log.gaps


@pytest.mark.slow
def test_replay_is_bit_for_bit_as_far_as_every_byte_is_there_and_says_how_far(many: tuple[Log, Experiment]) -> None:
    log, _ = many
    found = verify(load_recording(log.path))
    tenth = next(row for row in summaries(log) if row["cycle"] == 10)
    assert found.difference is None and found.exit_code == 3
    assert found.until == pytest.approx(tenth["t_s"], abs=0.05) and "keeps cycles by a rule" in found.report
    assert found.samples["force"] > 1000


@pytest.mark.slow
def test_check_says_how_long_the_log_will_be(many: tuple[Log, Experiment]) -> None:
    log, experiment = many
    stated = log_size(experiment)
    spared = sum(action.duration for action in experiment.actions) - float((log.outcome or {})["duration_s"])
    assert stated is not None  # of the plan, whose approach takes longer than this one
    assert log.path.stat().st_size == pytest.approx(stated * (1 - spared / experiment.kept_s), rel=0.1)


@pytest.mark.slow
def test_a_run_that_was_cut_goes_on_counting_with_the_same_reference(tmp_path: Path) -> None:
    scene, protocol = cycling(
        tmp_path,
        DISPLACEMENT + "cycles = 30\nreference_cycle = 2\nstop_below_percent = 50\n",
        replace={
            "[simulation.hv]": '[[simulation.fault]]\nrole = "force"\nkind = "silent"\nat_s = 20\n[simulation.hv]'
        },
    )
    with pytest.raises(Exception, match="force"):
        run(prepare(scene, protocol), tmp_path / "one.mcap", lambda done, total, label: None)
    before = read_log(tmp_path / "one.mcap")
    counted = [row["cycle"] for row in summaries(before) if row["whole"]]
    broken = [row for row in summaries(before) if not row["whole"]]
    assert counted == list(range(1, len(counted) + 1)) and 5 < len(counted) < 30
    assert [row["cycle"] for row in broken] == [len(counted) + 1]  # done to the film in part: told, not counted
    ends = before.columns("/force/sample")["t_s"]
    assert np.count_nonzero(ends > broken[0]["t_s"] - 1.5) > 80  # the seconds before it are there, whatever the rule
    rest = prepare_resumed(before.path)
    assert rest.resumed is not None and rest.resumed["cycles_done"] == str(len(counted))
    then = next(m.fields["value"] for m in before.messages("/reference") if m.fields["name"] == "cycle_response")
    assert float(rest.resumed["cycle_response_reference"]) == then


def test_the_log_leaves_out_what_repeats_and_nothing_else() -> None:
    decimation = Decimation()

    def take(topic: str, t: float, **fields: Any) -> list[str]:
        ns = round(t * 1e9)
        return [row[0] for row in decimation.take((topic, encode(topic, {"t_s": t, **fields}), ns, ns))]

    sample = {"reading": 0.0, "force_N": 0.0, "flags": 0}
    kept = {"before_s": 0.0, "cause": ""}
    assert take("/force/sample", 0.0, **sample) == ["/force/sample"]
    assert take("/kept", 1.0, keeping=False, **kept) == ["/kept"]
    for k in range(100):
        assert take("/force/sample", 1.0 + 0.1 * k, **sample) == []
    assert take("/raw/hv/tx", 11.0, data=b"x") == []
    assert take("/command", 11.0, device="stage", command="move_to", argument="") == []
    assert take("/command", 11.0, device="hv", command="emergency_off", argument="") == ["/command"]
    assert take("/event", 11.0, severity="error", source="x", message="y") == ["/event"]
    late = take("/kept", 11.0, keeping=True, before_s=1.0, cause="an event")
    assert late == ["/kept", *["/force/sample"] * 9, "/raw/hv/tx", "/command"]  # of the last second only
    assert take("/raw/hv/tx", 12.0, data=b"x") == ["/raw/hv/tx"]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"to_mm": 4.0, "period_s": 1.0}, "too fast"),
        ({"to_mm": 4.0, "period_s": 2.0, "waveform": "square"}, "too fast"),
        ({"to_V": 600.0, "period_s": 2.0}, "cannot be followed"),
        ({"to_V": 600.0, "period_s": 4.0, "waveform": "sine"}, "cannot be followed"),
        ({"to_mm": 0.1, "period_s": 0.05}, "fewer than 10 samples"),
        ({"to_V": 2500.0, "period_s": 100.0}, ""),
    ],
)
def test_what_the_bench_cannot_follow_is_refused_before_anything_moves(keys: dict[str, Any], said: str) -> None:
    scene = load_scene(SCENES / "cone-4mm.toml")[0]
    protocol = Protocol.model_validate({"step": [*BEFORE["contact"], {"do": "cycle", "cycles": 10, **keys}]})
    if said:
        with pytest.raises(LimitError, match=f"Step 4 .cycle.*{said}"):
            plan(protocol, scene)
    else:  # the voltage limit is for the prediction
        assert max(plan(protocol, scene)[-1].voltage) == 2500.0


def test_a_run_gone_on_with_plans_what_is_left_and_keeps_its_first_cycles() -> None:
    from rig.protocol.plan import plan_from
    from rig.steps.cycle import Cycling
    from rig.steps.rig import CyclesDone

    scene = load_scene(SCENES / "cone-4mm.toml")[0]
    step = {"do": "cycle", "to_mm": 4.0, "period_s": 5.0, "cycles": 10**6}
    protocol = Protocol.model_validate({"step": [*BEFORE["contact"], step]})
    (whole,) = (one for one in plan(protocol, scene) if isinstance(one, Cycling))
    done = CyclesDone(123_456, 15.0)
    (rest,) = (one for one in plan_from(protocol, scene, 4, done=done) if isinstance(one, Cycling))
    assert whole.summaries - rest.summaries == 123_456 == (whole.duration - rest.duration) / 5.0
    assert [n for n in range(123_450, 123_470) if rest.keeps(n)][-2:] == [123_457, 123_458]
    assert whole.kept_s == sum(whole.keeps(n) for n in range(1, 10**6 + 1)) * 5.0


def test_slopes_and_ends_of_one_pass_are_those_of_all_samples() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(5e-3, 1e-3, 500), rng.normal(size=500)
    y += 30.0 * x
    slope, ends = Slope(), Ends()
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        slope.add(a, b)
        ends.add(b)
    assert slope.slope == pytest.approx(np.polyfit(x, y, 1)[0], rel=1e-9)
    assert (ends.low, ends.high, ends.count) == (y.min(), y.max(), 500)
    slope.add(math.nan, 1.0)
    ends.add(math.nan)
    assert math.isfinite(slope.slope) and ends.count == 500


@pytest.mark.slow
def test_a_pause_is_told_heals_nothing_and_the_count_goes_on(tmp_path: Path) -> None:
    """What the stage did is one way more than whole cycles: told as a cycle that is not whole, and done again."""
    experiment = prepare(*cycling(tmp_path, DISPLACEMENT + "cycles = 7\n"))
    bench = open_bench(experiment.scene)
    control = Control(unattended="a test")
    begun: list[float] = []

    def show(status: Status) -> None:
        now = bench.clock.now()
        if "cycles of" in status.label and not begun:
            begun.append(now)
        if begun and begun[0] + 4.0 <= now < begun[0] + 4.5:
            control.ask_pause("a test")
        elif begun and now > begun[0] + 8.0:
            control.pausing = ""

    with LogWriter(tmp_path / "log.mcap") as writer:
        engine = Engine(
            bench, experiment.actions, writer, gains_of(experiment.certificates), control, lambda *_: None,
            experiment.certificates, show=show,
        )  # fmt: skip
        outcome, error = engine.run()
        writer.finish(outcome.as_text())
    assert error is None and outcome.safe, outcome.reason
    rows = summaries(read_log(tmp_path / "log.mcap"))
    assert [(row["cycle"], row["whole"]) for row in rows if row["cycle"] in (4, 5)][:2] == [(4, False), (4, True)]
    assert [row["cycle"] for row in rows if row["whole"]] == [1, 2, 3, 4, 5, 6, 7]
    again = next(row for row in rows if row["cycle"] == 4 and row["whole"])
    assert again["begin_s"] > begun[0] + 8.0
    acts = [message.fields["act"] for message in read_log(tmp_path / "log.mcap").messages("/operator")]
    assert [act for act in acts if act in ("pauses", "continues")] == ["pauses", "continues"]


@pytest.mark.slow
def test_a_breakdown_is_a_result_and_the_output_is_off(tmp_path: Path) -> None:
    scene, protocol = cycling(
        tmp_path,
        'waveform = "square"\nfrom_V = 100\nto_V = 500\nperiod_s = 6\ncycles = 20\n',
        replace={
            "[simulation.hv]": '[[simulation.fault]]\nrole = "hv"\nkind = "breakdown"\nat_s = 23\n[simulation.hv]'
        },
    )
    log = carried_out(prepare(scene, protocol), tmp_path / "log.mcap")
    outcome = log.outcome or {}
    assert outcome["status"] == "complete" and outcome["safe"] == "yes"
    found = {m.fields["outcome"] for m in log.messages("/result")}
    counted = [row["cycle"] for row in summaries(log) if row["whole"]]
    assert found == {"breakdown"} and results(log)["cycles"] == len(counted) == counted[-1]
    volts = log.columns("/hv/sample")
    assert volts["voltage_V"].max() > 490 and volts["voltage_V"][-1] < 60
    for row in summaries(log)[:-1]:
        assert row["voltage_peak_V"] == pytest.approx(500, abs=3) and row["leakage_A"] == pytest.approx(25e-9, abs=1e-8)


@pytest.mark.parametrize(
    ("keys", "slopes", "leak", "why", "at"),
    [
        ({"stop_below_percent": 80}, lambda n: 10.0 - 0.1 * n, 0.0, "drift", 32),
        ({"stop_above_percent": 120}, lambda n: 10.0 + 0.1 * n, 0.0, "drift", 37),
        ({"stop_leakage_nA": 50.0, "waveform": "square"}, lambda n: 10.0, 2.05e-9, "leakage", 27),
        ({}, lambda n: 10.0 - 0.1 * n, 2e-9, "", 60),
    ],
)
def test_what_ends_it_is_what_changed_against_the_reference(
    keys: dict[str, Any], slopes: Any, leak: float, why: str, at: int
) -> None:
    """The reference is the mean of cycles 10 to 14, what is judged that of the last five: two cycles behind."""
    step = Cycle.model_validate({"do": "cycle", "to_mm": 4.0, "period_s": 10.0, "cycles": 60, **keys})
    drift, references = Drift(step, math.nan), []
    recorder = SimpleNamespace(reference=lambda *words: references.append(words))
    rig: Any = SimpleNamespace(recorder=recorder)
    for n in range(1, 61):
        row = {"cycle": n, "stiffness_N_per_m": slopes(n), "actuation_N_per_V2": math.nan, "leakage_A": leak * n}
        if said := drift.judge(rig, row):
            break
    assert (said, n) == (why, at)
    assert [(name, unit) for name, _, _, unit in references] == [("cycle_response", "N/m")]
    assert drift.reference == pytest.approx(np.mean([slopes(n) for n in range(10, 15)]))
