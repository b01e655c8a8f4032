"""A computer that must not go to sleep while high voltage may be on, where the system can be asked for that."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress

INHIBITOR = "systemd-inhibit"
WHAT = "sleep:idle:handle-lid-switch"
REFUSED_S = 0.2  # one that cannot hold the lock has ended by then
LEAVE_S = 1.0
BY_HAND = "switch that off by hand"


@contextmanager
def kept_awake(why: str) -> Iterator[str]:
    """Within this context the system does not suspend by itself, nor when the lid is closed.

    Yields how, in words for the log. The lock is held by a process that ends with its input: should this program be
    killed, the system lets go of it. Nothing here waits for that process: one that hangs is ended.
    """
    held, how = _hold(why)
    try:
        yield how
    finally:
        if held is not None:
            _let_go(held)


def _hold(why: str) -> tuple[subprocess.Popen[bytes] | None, str]:
    program = shutil.which(INHIBITOR)
    if program is None:
        return None, f"nothing keeps this computer from going to sleep ({INHIBITOR} is missing): {BY_HAND}"
    try:
        held = subprocess.Popen(
            [program, f"--what={WHAT}", "--who=dea-rig", f"--why={why}", "--mode=block", "cat"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        return None, f"nothing keeps this computer from going to sleep ({INHIBITOR}: {error.strerror}): {BY_HAND}"
    with suppress(subprocess.TimeoutExpired):
        code = held.wait(REFUSED_S)
        _let_go(held)
        return None, f"nothing keeps this computer from going to sleep ({INHIBITOR} ended with {code}): {BY_HAND}"
    return held, f"kept from going to sleep by {INHIBITOR}"


def _let_go(held: subprocess.Popen[bytes]) -> None:
    if held.stdin is not None:
        with suppress(OSError):
            held.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        held.wait(LEAVE_S)
        return
    held.kill()
    with suppress(subprocess.TimeoutExpired):
        held.wait(LEAVE_S)
