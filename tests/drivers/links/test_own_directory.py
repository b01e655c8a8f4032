"""The user's own directory where the environment is another user's, or has no place for it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from drivers.links import own_directory
from drivers.links.link import DeviceError
from drivers.links.own_directory import user_directory
from drivers.links.port_lock import PortLock

NOBODY = 54_321
pytestmark = pytest.mark.skipif(os.name != "posix", reason="files have owners on POSIX")


def no_place() -> str:
    raise FileNotFoundError(2, "No usable temporary directory found")


def test_nothing_is_made_in_the_directory_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert user_directory() == tmp_path / "dea-rig"
    (tmp_path / "dea-rig").rmdir()
    monkeypatch.setattr(own_directory, "user_number", lambda: NOBODY)
    monkeypatch.setattr(tempfile, "gettempdir", no_place)
    with pytest.raises(OSError, match="set TMPDIR"):
        user_directory()
    assert list(tmp_path.iterdir()) == []


def test_a_port_without_a_place_for_its_lock_says_what_to_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(own_directory, "user_number", lambda: NOBODY)
    monkeypatch.setattr(tempfile, "gettempdir", no_place)
    with pytest.raises(DeviceError, match=r"no directory for temporary files.*TMPDIR"):
        PortLock("hv", str(tmp_path / "tty"))
