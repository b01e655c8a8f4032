"""Campaigns on the simulated bench: each specimen once, in its order, whatever interrupts; the logs are the record."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.base.errors import ConfigError
from rig.base.toml_text import parse_toml
from rig.base.toml_write import toml_of
from rig.campaign.campaign import load_campaign
from rig.campaign.progress import Standing, progress_of
from rig.cli.app import main
from rig.log.catalogue import INDEX
from rig.log.reader import read_log
from tests.protocols import TO_THE_FILM

FIXTURES = Path(str(files("sim_fixtures")))
HEAD = TO_THE_FILM
BREAKDOWN = HEAD + '[[step]]\ndo = "breakdown"\nceiling_V = 1200\n'
LONG = HEAD + "".join(f'[[step]]\ndo = "hold"\nduration_s = {n}\n' for n in (1, 2, 3))
CAMPAIGN = """
title = "Three films"
scene = "../bench/scene.toml"
protocol = "breakdown.toml"
"""
FILMS = {"film-1": (34.0, "A"), "film-2": (70.0, "A"), "film-3": (38.0, "B")}  # strength, V/um; the ceiling: about 45


def film(name: str, strength: float, batch: str) -> str:
    truth = f"{{film = {{breakdown_field_MV_per_m = {strength}}}}}"
    return (
        f'[[specimen]]\nname = "{name}"\nbatch = "{batch}"\n'
        f"scene = {{simulation = {truth}, specimen = {{thickness_um = 40.5}}}}\n"
    )


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a bench, and beside it one with a campaign of three films."""
    bench, folder = tmp_path / "bench", tmp_path / "films"
    bench.mkdir()
    folder.mkdir()
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
    text = text.replace("approach_from_mm = 36.0", "approach_from_mm = 13.0")
    text = text.replace("contact_position_mm = 40.0", "contact_position_mm = 17.0")
    (bench / "scene.toml").write_text(text.replace("../calibrations", str(FIXTURES / "calibrations")))
    (folder / "breakdown.toml").write_text(BREAKDOWN)
    (folder / "campaign.toml").write_text(CAMPAIGN + "".join(film(name, *rest) for name, rest in FILMS.items()))
    return folder


def say(*words: object) -> Result:
    return CliRunner().invoke(main, ["campaign", *map(str, words)])


def standings(folder: Path) -> dict[str, Standing]:
    return {one.specimen.name: one.standing for one in progress_of(load_campaign(folder / "campaign.toml"))}


@pytest.mark.slow
def test_each_specimen_once_and_a_table(place: Path) -> None:
    file = place / "campaign.toml"
    done = say("run", file, "--arm", "--yes", "--most", 1)
    assert done.exit_code == 0, done.output
    assert list(standings(place).values()) == [Standing.DONE, Standing.WAITING, Standing.WAITING]
    done = say("run", file, "--arm", "--yes")
    assert done.exit_code == 0 and "nothing is left to do" in done.output, done.output
    logs = sorted(path.name for path in (place / "logs").glob("*.mcap*"))
    assert logs == ["film-1.mcap", "film-2.mcap", "film-3.mcap"]
    # The scene in each log is the specimen's own, and the simulated film was its own too.
    for name in FILMS:
        scene = parse_toml(read_log(place / "logs" / f"{name}.mcap").attachments["scene.toml"].data.decode(), "", "")
        assert scene["specimen"]["name"] == name and scene["specimen"]["thickness_um"] == 40.5
    assert say("run", file, "--arm", "--yes").exit_code == 0
    assert sorted(path.name for path in (place / "logs").glob("*.mcap*")) == logs
    done = say("report", file, "-o", place / "out.csv")
    assert done.exit_code == 0, done.output
    with (place / "out.csv").open() as text:
        rows = {row["specimen"]: row for row in csv.DictReader(text)}
    assert [row["found"] for row in rows.values()] == ["breakdown", "ceiling", "breakdown"]
    for name in ("film-1", "film-3"):
        assert float(rows[name]["field_at_disk [V/m]"]) == pytest.approx(FILMS[name][0] * 1e6, rel=0.08)
    # The index is made of the logs alone.
    before = [(one.specimen.name, one.runs) for one in progress_of(load_campaign(file))]
    (place / "logs" / INDEX).unlink()
    assert [(one.specimen.name, one.runs) for one in progress_of(load_campaign(file))] == before


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_a_killed_one_is_taken_up_at_its_step_and_none_is_repeated_or_skipped(place: Path) -> None:
    (place / "breakdown.toml").write_text(LONG)
    file = place / "campaign.toml"
    command = [sys.executable, "-m", "rig", "campaign", "run", str(file), "--yes"]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60.0
    while not (place / "logs" / "film-2.mcap.part").exists() and running.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.002)
    time.sleep(0.3)
    running.send_signal(signal.SIGKILL)
    running.wait()
    if standings(place)["film-2"] is Standing.DONE:
        pytest.skip("the run was faster than the signal")
    assert standings(place) == {
        "film-1": Standing.DONE, "film-2": Standing.INTERRUPTED, "film-3": Standing.WAITING,
    }  # fmt: skip
    refused = say("run", file, "--yes")
    assert refused.exit_code == 2 and "campaign resume" in refused.output and "film-2" in refused.output
    done = say("resume", file, "--yes")
    assert done.exit_code == 0, done.output
    assert set(standings(place).values()) == {Standing.DONE}
    logs = {path.name for path in (place / "logs").glob("*.mcap*")}
    assert logs == {"film-1.mcap", "film-2.mcap.part", "film-2.2.mcap", "film-3.mcap"}


@pytest.mark.slow
def test_runs_that_fail_stop_the_campaign_and_are_not_done_again_by_themselves(place: Path) -> None:
    file = place / "campaign.toml"
    text = file.read_text().replace('title = "Three films"', 'title = "Three films"\nmost_failed_in_a_row = 2')
    fault = "simulation = {fault = [{role = 'force', kind = 'silent', at_s = 6.0}], "
    file.write_text(text.replace("simulation = {", fault, 2).replace("film = {film", "film = {"))
    done = say("run", file, "--arm", "--yes")
    assert done.exit_code == 1 and "2 runs in a row did not end complete" in done.output, done.output
    assert list(standings(place).values()) == [Standing.FAILED, Standing.FAILED, Standing.WAITING]
    done = say("run", file, "--arm", "--yes")
    assert done.exit_code == 0, done.output
    assert list(standings(place).values()) == [Standing.FAILED, Standing.FAILED, Standing.DONE]


def test_by_chance_in_blocks_of_one_of_each_batch_and_the_same_again(place: Path) -> None:
    file = place / "campaign.toml"
    names = [(f"{batch}{k}", batch) for batch in "ABC" for k in range(4)]
    rest = "".join(film(name, 50.0, batch) for name, batch in names)
    file.write_text(CAMPAIGN + 'order = "random"\nseed = 3\n' + rest)
    found = [one.name for one in load_campaign(file).specimens]
    assert sorted(found) == sorted(name for name, _ in names) != found
    assert all({name[0] for name in found[k : k + 3]} == set("ABC") for k in range(0, 12, 3))
    assert [one.name for one in load_campaign(file).specimens] == found
    file.write_text(file.read_text().replace("seed = 3", "seed = 4"))
    assert [one.name for one in load_campaign(file).specimens] != found


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "film-2"', 'name = "FILM-1"', "stands twice"),
        ('name = "film-2"', 'name = "../film"', "letters, digits"),
        ('name = "film-2"', 'name = "film-1.2"', "a second run"),
        ('protocol = "breakdown.toml"\n', "", "has no protocol"),
        ("thickness_um = 40.5", "thicknes_um = 40.5", "thickness_um"),
        ('scene = "../bench/scene.toml"', 'scene = "none.toml"', "none.toml"),
        ("[[specimen]]", "[[specimens]]", "specimen"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_mounted(place: Path, old: str, new: str, said: str) -> None:
    file = place / "campaign.toml"
    file.write_text(file.read_text().replace(old, new, 1))
    done = say("run", file, "--arm", "--yes")
    assert done.exit_code == 2 and said in done.output, done.output
    assert not list(place.glob("logs/*"))


def test_a_bench_that_is_not_there_ends_the_campaign_at_once(place: Path) -> None:
    ports = {role: {"port": "/dev/no-such-port"} for role in ("stage", "force", "displacement")}
    ports["hv"] = {"interface": "slcan", "can_channel": "/dev/no-such-port"}
    (place / "ports.json").write_text(json.dumps(ports))
    words = ["campaign", "run", str(place / "campaign.toml"), "--ports", str(place / "ports.json"), "--arm"]
    done = CliRunner().invoke(main, words, input="y\n" * 5)
    assert done.exit_code == 4 and "no-such-port" in done.output, done.output
    assert done.output.count("is mounted") == 1 and not list(place.glob("logs/*.mcap*"))


def test_a_name_that_is_none_is_refused_with_those_there_are(place: Path) -> None:
    done = say("run", place / "campaign.toml", "--skip", "film-9")
    assert done.exit_code == 2 and "film-1, film-2, film-3" in done.output


def test_tables_survive_as_toml() -> None:
    table = {"a": 1, "b c": [1.5, 'x"\\'], "t": {"u": {"v": True}, "w": [{"k": "é"}, {"k": 1e-9}]}, "z": {}}
    assert parse_toml(toml_of(table), "a test", "here") == table


def test_a_folder_without_logs_has_everything_waiting(place: Path) -> None:
    assert set(standings(place).values()) == {Standing.WAITING}
    done = say("status", place / "campaign.toml")
    assert done.exit_code == 0 and "3 waiting" in done.output
    with pytest.raises(ConfigError):
        load_campaign(place / "nothing.toml")


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
@pytest.mark.parametrize(
    "times",
    [
        pytest.param(3, marks=pytest.mark.long),  # one kill: `test_a_killed_one_is_taken_up_at_its_step_...`
        pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(7200)]),
    ],
)
def test_killed_at_random_instants_it_goes_on_at_the_right_specimen_and_step(place: Path, times: int) -> None:
    """Of two specimens, killed at any instant; then resumed: each is complete once, from the step where it was."""
    (place / "breakdown.toml").write_text(LONG)
    file, rng = place / "campaign.toml", random.Random(5)
    file.write_text(CAMPAIGN + film("one", 70.0, "A") + film("two", 70.0, "A"))
    command = [sys.executable, "-m", "rig", "campaign", "run", str(file), "--yes"]

    def start(*, wait_for_log: bool) -> subprocess.Popen[bytes]:
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while wait_for_log and running.poll() is None and not list(place.glob("logs/*.part")):
            time.sleep(0.01)
        return running

    running = start(wait_for_log=True)
    began = time.monotonic()
    assert running.wait(120) == 0
    lasts = time.monotonic() - began  # from the first log on
    killed = 0
    for k in range(times):
        shutil.rmtree(place / "logs", ignore_errors=True)
        running = start(wait_for_log=k % 4 > 0)
        with contextlib.suppress(subprocess.TimeoutExpired):
            running.wait(rng.uniform(0.0, 1.0) * lasts)
        running.kill()
        running.wait()
        before = standings(place)
        parts = list(place.glob("logs/*.part"))
        killed += bool(parts)
        reached = [max((m.fields["step"] for m in read_log(part).messages("/phase")), default=0) for part in parts]
        assert say("resume", file, "--yes").exit_code == 0
        assert set(standings(place).values()) == {Standing.DONE}
        for name, was in before.items():
            complete = [one for one in place.glob(f"logs/{name}*.mcap") if is_complete(one)]
            assert len(complete) == 1, (name, was, complete)
        for part, step in zip(parts, reached, strict=True):
            rest = part.with_name(part.name.replace(".mcap.part", ".2.mcap"))
            begun = read_log(rest).metadata.get("resumed", {}).get("at_step")
            assert begun == (str(step) if step else begun), (part, step, begun)
    assert killed > 0.3 * times  # some instants come before the runs or between them


def is_complete(log: Path) -> bool:
    return (read_log(log).outcome or {}).get("status") == "complete"
