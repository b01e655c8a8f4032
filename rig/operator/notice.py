"""Word to somebody who is elsewhere that a run has ended: a program of his own, and the desktop's notifications.

Nobody waits for either, and neither is given to a shell.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence

LONGEST = 500  # letters of a notification


def tell_end(command: Sequence[str], log: str, exit_code: int, text: str) -> str:
    """Start the operator's program, if he named one, and show a notification where there is a desktop.

    Returns
    -------
    str
        Why his program could not be started; empty if it could.
    """
    problem = ""
    if command:
        about = {"DEA_RIG_LOG": log, "DEA_RIG_EXIT_CODE": str(exit_code), "DEA_RIG_TEXT": text}
        problem = _start(command, {**os.environ, **about})
    if notifier := _notifier("dea-rig: a run has ended", text[:LONGEST]):
        _start(notifier, os.environ)
    return problem


def _notifier(title: str, text: str) -> list[str]:
    """What shows a notification on this desktop; empty where there is none."""
    if sys.platform == "darwin":
        script = "on run argv\ndisplay notification (item 2 of argv) with title (item 1 of argv)\nend run"
        return ["osascript", "-e", script, title, text]
    found = shutil.which("notify-send")
    return [found, "--", title, text] if found and os.environ.get("DBUS_SESSION_BUS_ADDRESS") else []


def _start(command: Sequence[str], environment: Mapping[str, str]) -> str:
    nothing = subprocess.DEVNULL
    try:
        process = subprocess.Popen(
            list(command), stdin=nothing, stdout=nothing, stderr=nothing, env=environment, start_new_session=True
        )
    except (OSError, ValueError) as error:  # ValueError: a zero byte in an argument
        return f"{command[0]!r} could not be started: {getattr(error, 'strerror', None) or error}"
    threading.Thread(target=process.wait, name="end of a notice", daemon=True).start()
    return ""
