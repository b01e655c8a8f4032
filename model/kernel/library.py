"""The compiled kernel: which file it is, and whether it may be used.

Standard library only: the build reads this file before anything else is installed.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import platform
import sys
from pathlib import Path

VERSION = 4  # of the functions and what they take; DEA_KERNEL_VERSION in version.h
HERE = Path(__file__).resolve().parent
REBUILD = "install dea-rig anew (uv sync --reinstall-package dea-rig)"


def library_path(directory: Path = HERE) -> Path:
    """Where the library of this system lies: one file for each, so that a folder can serve several systems."""
    ending = "dll" if sys.platform == "win32" else "so"
    return directory / f"dea_kernel-{sys.platform}-{platform.machine().lower()}.{ending}"


def reason_path(directory: Path = HERE) -> Path:
    """Where the build wrote why it made no library."""
    return library_path(directory).with_suffix(".txt")


def sources_digest(directory: Path = HERE) -> str:
    """Twelve digits that stand for every source of the library, and for ``build.py`` with its flags."""
    digest = hashlib.sha256()
    sources = [path for path in directory.iterdir() if path.suffix in {".c", ".h"} or path.name == "build.py"]
    for path in sorted(sources, key=lambda path: path.name):
        digest.update(f"{path.name}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def load() -> ctypes.CDLL | None:
    """The kernel; None where there is none, or one that does not belong to these sources."""
    return _found()[0]


def says() -> str:
    """Which path answers, in one line: "compiled kernel 3f2a01c9d5e7, cc", or "NumPy: no compiled kernel: ..."."""
    return _found()[1]


@functools.cache
def _found() -> tuple[ctypes.CDLL | None, str]:
    library, why = opened(HERE)
    return library, why if library is not None else f"NumPy: no compiled kernel: {why}"


def opened(directory: Path) -> tuple[ctypes.CDLL | None, str]:
    """The library in ``directory`` and what it is; or None, and why it cannot be used."""
    path = library_path(directory)
    if not path.exists():
        try:
            return None, f"{reason_path(directory).read_text(encoding='utf-8').strip()}; {REBUILD}"
        except OSError:
            return None, f"it has not been built; {REBUILD}"
    try:
        library = ctypes.CDLL(str(path))
        library.dea_kernel_version.restype = ctypes.c_int64
        library.dea_kernel_sources.restype = library.dea_kernel_compiler.restype = ctypes.c_char_p
        version, sources = library.dea_kernel_version(), library.dea_kernel_sources().decode()
        compiler = library.dea_kernel_compiler().decode()
    except (OSError, AttributeError) as error:
        return None, f"{path.name} does not load: {' '.join(str(error).split())}; {REBUILD}"
    if version != VERSION:
        return None, f"{path.name} has interface {version}, this software needs {VERSION}; {REBUILD}"
    if sources != sources_digest(directory):
        return None, f"{path.name} was built from other sources than those beside it; {REBUILD}"
    return library, f"compiled kernel {sources}, {compiler}"
