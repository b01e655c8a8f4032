"""The commands on the pages: each is one that there is, with options that it has; those of the first page are run."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from rig.cli.app import main
from rig.scene.presets import PRESETS

ROOT = Path(__file__).resolve().parents[3]
PAGES = ("README.md", "rig/cli/README.md", "rig/design/README.md", "rig/benchmark/README.md")


def commands(page: str) -> list[list[str]]:
    """The arguments of every line of a fenced block that calls dea-rig."""
    found, fenced = [], False
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced and (at := line.find("dea-rig ")) >= 0:
            words = shlex.split(line[at + len("dea-rig ") :], comments=True)
            found.append(words[: next((k for k, word in enumerate(words) if word in (">", "&", "&&")), len(words))])
    return found


@pytest.mark.parametrize("page", PAGES)
def test_each_command_and_its_options_exist(page: str) -> None:
    found = commands(page)
    assert found, page
    for name, *arguments in found:
        top = click.Context(main, info_name="dea-rig")
        command = main.get_command(top, name)
        assert command is not None, name
        context = command.make_context(name, list(arguments), parent=top)
        if isinstance(command, click.Group):
            sub, *rest = arguments
            inner = command.get_command(context, sub)
            assert inner is not None, arguments
            inner.make_context(sub, rest, parent=context)


def test_the_first_page_fits() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.slow
def test_the_five_things_of_the_first_page_are_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    wanted = [words for words in commands("README.md") if words[0] in ("init", "check", "run", "fit", "export")]
    assert [words[0] for words in wanted] == ["init", "check", "run", "fit", "export"]
    for words in wanted:
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, (words, done.output)
    assert {"mine", "run.mcap", "fit.json", "report.html", "run.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")
    # The permittivity of the simulated film is found again.
    init = wanted[0]
    truth = PRESETS[init[init.index("--preset") + 1]].eps_r
    found = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))["quantities"]["eps_r"]
    assert abs(found["value"] - truth) < 4 * found["standard_uncertainty"] + 0.02 * truth
