"""Room on the disk: estimated before a run, watched during it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from drivers.instrument import role_of
from rig.log.errors import LogError, UnusableFile

LEAST_FREE = 32 * 10**6  # bytes; with less left, a run ends while its log can still be finished
WARN_FREE = 256 * 10**6
# Bytes on the disk for one sample with what went over the wire for it, by role, and for a second of nothing but
# chunks. A run of the examples takes half of what follows from them.
_BYTES_PER_SAMPLE = {"stage": 360, "force": 120, "displacement": 360, "hv": 1200, "monitor": 360}
_BYTES_PER_SECOND = 20_000
_BYTES_PER_SUMMARY = 1500  # of a cycle that fills a chunk alone


def needed(seconds: float, rates: Mapping[str, float], summaries: int = 0) -> int:
    """Bytes that ``seconds`` of samples at ``rates`` (Hz) by role may take, and so many cycles' summaries."""
    per_second = _BYTES_PER_SECOND + sum(_BYTES_PER_SAMPLE[role_of(role)] * rate for role, rate in rates.items())
    return round(seconds * per_second + summaries * _BYTES_PER_SUMMARY)


def free(folder: Path) -> int:
    """Bytes free on the disk of ``folder``."""
    return shutil.disk_usage(folder).free


def check(path: Path, seconds: float, rates: Mapping[str, float], summaries: int = 0) -> None:
    """Raise `LogError` when the disk of ``path`` has too little room for the log of a run."""
    size = needed(seconds, rates, summaries)
    try:
        room = free(path.parent)
    except OSError as error:
        raise UnusableFile(path, f"cannot be made ({error.strerror})", "Name a directory you can write to.") from error
    if not room >= size + LEAST_FREE:
        at = ", ".join(f"{role} {rate:g} Hz" for role, rate in rates.items())
        raise LogError(
            path,
            f"its disk has {room / 1e6:.0f} MB free, but {seconds:.0f} s of {at} may take {size / 1e6:.0f} MB "
            f"and {LEAST_FREE / 1e6:.0f} MB must stay free",
            "Free some space or use another disk. Nothing was moved and no output changed.",
        )
