"""A computer that must not go to sleep while high voltage may be on, where the system can be asked for that."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress

INHIBITOR = "systemd-inhibit"
WHAT = "sleep:idle:handle-lid-switch"
LEAVE_S = 1.0


@contextmanager
def kept_awake(why: str) -> Iterator[str]:
    """Within this context the system does not suspend by itself, nor when the lid is closed.

    Yields how, in words for the log. The lock is held by a process that ends with its input: should this program be
    killed, the system lets go of it.
    """
    program = shutil.which(INHIBITOR)
    held: subprocess.Popen[bytes] | None = None
    if program is not None:
        with suppress(OSError):
            held = subprocess.Popen(
                [
                    program,
                    "--what=sleep:idle:handle-lid-switch",
                    "--who=dea-rig",
                    f"--why={why}",
                    "--mode=block",
                    "cat",
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
    try:
        if held is None:
            yield f"nothing keeps this computer from going to sleep ({INHIBITOR} is missing): switch that off by hand"
        else:
            yield f"kept from going to sleep by {INHIBITOR}"
    finally:
        if held is not None and held.stdin is not None:
            with suppress(OSError):
                held.stdin.close()
            try:
                held.wait(LEAVE_S)
            except subprocess.TimeoutExpired:
                held.kill()
                held.wait(LEAVE_S)
