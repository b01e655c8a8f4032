"""A log that nobody needs: of a run that is only looked at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class NoLog:
    """Takes the place of a `rig.log.writer.LogWriter` and keeps nothing; ``listener`` is told every row."""

    def __init__(self) -> None:
        self.listener: Callable[[str, Mapping[str, Any]], None] = lambda topic, fields: None

    def write(self, topic: str, fields: Mapping[str, Any], log_ns: int, publish_ns: int) -> None:
        self.listener(topic, fields)

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Nothing is kept."""

    def tick(self, now: float) -> None:
        """Nothing is due."""
