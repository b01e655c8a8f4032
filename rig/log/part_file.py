"""A file that has its name only once it is complete."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from rig.log.errors import LogError, UnusableFile


class PartFile:
    """Written as ``<path>.part`` (or with another ``ending``), unbuffered; `finish` syncs it and gives it its name.

    It never overwrites another.
    The first failed write closes the file for good: what had been written before stays, cut after the last whole
    `put`, and every later call raises. Raises `LogError`, from the constructor too.
    """

    def __init__(self, path: Path, ending: str = ".part") -> None:
        self.path = path
        self.part = path.with_name(path.name + ending)
        self._failure: LogError | None = None
        self._size = 0
        self._synced = 0
        for existing in (self.path, self.part):
            if existing.exists():
                advice = "Nothing is overwritten: name another file, or move this one away."
                if existing == self.part:
                    advice = f"An interrupted run left it; save what it holds: dea-rig recover {existing} -o OUT.mcap"
                raise UnusableFile(existing, "exists already", advice)
        try:
            self._fd: int | None = os.open(
                self.part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o644
            )
            _sync_directory(self.part.parent)
        except OSError as error:
            raise UnusableFile(
                path, f"cannot be made ({error.strerror})", "Name a directory you can write to."
            ) from error

    @property
    def is_open(self) -> bool:
        return self._fd is not None

    def check(self) -> None:
        """Raise unless more can be written."""
        if self._failure is not None:
            raise LogError(self._failure.path, self._failure.what, self._failure.advice)
        if self._fd is None:
            raise LogError(self.path, "is finished; nothing can be added")

    def check_place(self) -> None:
        """Raise when the file was deleted or replaced while it is written, which no write would notice.

        What was written is then copied beside it, or to the temporary directory where that cannot be.
        """
        self.check()
        assert self._fd is not None
        here = os.fstat(self._fd)
        try:
            there = self.part.stat()
        except OSError:
            there = None
        if there is not None and os.path.samestat(here, there):
            return
        what = "was deleted or moved" if there is None else "was replaced by another file"
        saved = self._save_elsewhere()
        advice = "It could not be saved." if saved is None else f"What was recorded is saved in {saved}."
        raise self._fail(f"{self.part.name} {what} while it was written; nothing more is written", advice)

    def _save_elsewhere(self) -> Path | None:
        assert self._fd is not None
        for folder in (self.part.parent, Path(tempfile.gettempdir())):
            for number in range(100):
                target = folder / f"{self.path.name}.saved-{number}"
                try:
                    copy = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o644)
                except FileExistsError:
                    continue
                except OSError:
                    break
                with os.fdopen(copy, "wb") as file, suppress(OSError):
                    os.lseek(self._fd, 0, os.SEEK_SET)
                    while data := os.read(self._fd, 1 << 20):
                        file.write(data)
                    self._close()
                    return target
        self._close()
        return None

    def put(self, data: bytes) -> None:
        """Append all of ``data``."""
        self.check()
        assert self._fd is not None
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except BaseException as error:  # an interrupt may leave a torn record just as a full disk does
            with suppress(OSError):
                os.ftruncate(self._fd, self._size)
            self._close()
            reason = error.strerror if isinstance(error, OSError) else type(error).__name__
            failure = self._fail(f"writing failed ({reason}); nothing more is written")
            if isinstance(error, OSError):
                raise failure from error
            raise
        self._size += len(data)

    def sync(self) -> None:
        """Return when all that was put is on the disk. A disk that does not confirm it closes the file for good."""
        self.check()
        if self._synced == self._size:
            return
        assert self._fd is not None
        try:
            getattr(os, "fdatasync", os.fsync)(self._fd)
        except OSError as error:
            self._close()
            raise self._fail(f"the disk did not confirm what was written ({error.strerror})") from error
        self._synced = self._size

    def finish(self) -> None:
        """Sync the file and give it its name."""
        self.end()
        if self.path.exists():
            raise self._fail(f"a file of this name appeared meanwhile; this one is complete in {self.part}")
        try:
            self.part.rename(self.path)
            _sync_directory(self.path.parent)
        except OSError as error:
            raise self._fail(f"cannot be given its name ({error.strerror}); it is complete in {self.part}") from error

    def end(self) -> None:
        """Sync and close the file, and leave it as ``.part``."""
        self.check()
        assert self._fd is not None
        try:
            os.fsync(self._fd)
        except OSError as error:
            raise self._fail(f"the disk did not confirm the end of the file ({error.strerror})") from error
        finally:
            self._close()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._close()
        self.part.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._fd is not None:
            fd, self._fd = self._fd, None
            with suppress(OSError):
                os.close(fd)

    def _fail(self, what: str, advice: str = "Free some space or use another disk, then repeat the run.") -> LogError:
        self._failure = LogError(self.path, what, advice)
        return self._failure


def _sync_directory(directory: Path) -> None:
    if os.name == "nt":  # a directory cannot be opened there, and its entries need no sync
        return
    fd = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
