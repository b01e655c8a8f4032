"""This user's own directory for what running programs leave for each other.

The directory belongs to the user alone (0700). Where the system has one for such files (``XDG_RUNTIME_DIR``,
``/run/user/UID``, ``LOCALAPPDATA``) it is there; otherwise it is made in the temporary directory with a name that
nobody can guess, so that another user can neither read it nor make it first.
"""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from drivers.links.system import user_number

NAME = "dea-rig"


def user_directory() -> Path:
    """The user's own directory; made when it does not exist.

    Raises
    ------
    OSError
        It cannot be made.
    """
    user = user_number()
    for base in (os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("LOCALAPPDATA"), f"/run/user/{user}"):
        if not base or not _is_users(Path(base), user):  # another user's, by sudo for one, is left alone
            continue
        folder = Path(base) / NAME
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(folder, user):
            return folder
    import tempfile  # it takes longer than all the rest

    try:
        temporary = Path(tempfile.gettempdir())
    except FileNotFoundError:  # which would mean that the directory has gone meanwhile
        raise OSError(0, "no directory for temporary files can be written; set TMPDIR to one that can") from None
    existing = _ours_in(temporary, user)
    if existing is None:
        tempfile.mkdtemp(prefix=f"{NAME}-{user}-", dir=temporary)
        existing = _ours_in(temporary, user)  # of two programs that start together both take the first
    if existing is None:
        raise OSError(0, f"no directory of this user's own can be made in {temporary}")
    return existing


def remove_if_empty(folder: Path) -> None:
    """Remove the user's directory when nothing is left in it."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _ours_in(temporary: Path, user: int) -> Path | None:
    return min((one for one in temporary.glob(f"{NAME}-{user}-*") if _is_ours(one, user)), default=None)


def _is_users(base: Path, user: int) -> bool:
    try:
        return base.is_dir() and (os.name != "posix" or base.stat().st_uid == user)
    except OSError:
        return False


def _is_ours(folder: Path, user: int) -> bool:
    """Whether it is a true directory of this user, closed to everybody else."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    if os.name != "posix":
        return stat.S_ISDIR(found.st_mode)
    return stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077
