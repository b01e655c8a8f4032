"""The page on drivers tells what is there: its files exist, its examples run and stand in the example package."""

from __future__ import annotations

import doctest
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "drivers" / "README.md").read_text()
EXAMPLE = ROOT / "tests" / "example_package"


def test_every_file_that_is_named_exists() -> None:
    for name in re.findall(r"`((?:drivers|rig|tests|links|instruments)/[\w/.]+)`", PAGE):
        assert (ROOT / name).exists() or (ROOT / "drivers" / name).exists(), name
    for name in re.findall(r"\b\w+\.py\b", PAGE):
        assert (
            list(ROOT.glob(f"drivers/**/{name}"))
            + list(ROOT.glob(f"rig/**/{name}"))
            + list(ROOT.glob(f"tests/**/{name}"))
        ), name


def test_the_example_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    try:
        test = doctest.DocTestParser().get_doctest(PAGE, {}, "README", "README.md", 0)
        assert len(test.examples) == 5
        assert doctest.DocTestRunner().run(test).failed == 0
    finally:
        sys.modules.pop("acme_scale", None)


def test_what_is_shown_stands_in_the_example() -> None:
    code = (EXAMPLE / "acme_scale.py").read_text() + (EXAMPLE / "pyproject.toml").read_text()
    for block in re.findall(r"```(?:python|toml)\n(.*?)```", PAGE, re.DOTALL):
        for part in block.split("        ...\n"):
            assert ">>>" in part or part.rstrip() in code or part.strip() in code, part
