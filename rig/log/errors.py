"""The errors of the log."""

from __future__ import annotations

from pathlib import Path

from rig.base.errors import RigError


class LogError(RigError):
    """A log that cannot be written or read.

    Parameters
    ----------
    path : Path
        The file concerned.
    what : str
        What happened, as a sentence without its full stop.
    advice : str
        What to do about it.
    """

    def __init__(self, path: Path, what: str, advice: str = "") -> None:
        super().__init__(f"{path}: {what}." + (f" {advice}" if advice else ""))
        self.path = path
        self.what = what
        self.advice = advice


class UnusableFile(LogError):
    """A file or option of the command line that cannot be used; nothing was read or written."""

    exit_code = 2
