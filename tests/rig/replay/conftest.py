"""The recorded logs among the fixtures, each read once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from rig.benchmark.fixtures import LOGS
from rig.replay.recording import Recording, load_recording


@cache
def _load(name: str) -> Recording:
    return load_recording(LOGS / name / "log.mcap")


@pytest.fixture
def recorded() -> Callable[[str], Recording]:
    """``recorded(name)`` is the recording of that fixture."""
    return _load
