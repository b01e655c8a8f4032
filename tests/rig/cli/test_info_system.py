"""``dea-rig info --system``: what this installation runs on, the membrane solver's path in one line."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from model.kernel import library
from rig.cli.app import main


def test_the_solver_says_which_path_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "_found", lambda: (None, "NumPy: no compiled kernel: cc is not there"))
    told = CliRunner().invoke(main, ["info", "--system"])
    assert told.exit_code == 0
    assert "membrane solver: NumPy: no compiled kernel: cc is not there" in told.output.splitlines()
    assert "numpy" in told.output and "Python" in told.output


def test_without_a_log_or_a_question_it_is_a_wrong_call() -> None:
    told = CliRunner().invoke(main, ["info"])
    assert told.exit_code == 2 and "--system" in told.output
