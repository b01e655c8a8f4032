"""What the commands `stop`, `pause` and `continue` share: the run that they speak to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig.base.errors import ConfigError
from rig.operator.live import LiveRun, live_run

LOOK_S = 0.2


@contextmanager
def speaking_to(log: Path | None) -> Iterator[LiveRun]:
    """The run that is going on; ``log`` names it when there are several.

    Raises
    ------
    ConfigError
        When there is no such run, it does not answer, or it ends meanwhile.
    """
    run = live_run(log)
    try:
        yield run
    except ConnectionError:
        raise ConfigError(f"The run has ended; its log is {run.log}.") from None
