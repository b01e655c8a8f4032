"""Reading a small text file: its size, its kind and its letters are looked at before anything parses it."""

from __future__ import annotations

import stat
from pathlib import Path

from rig.base.errors import ConfigError

MAX_BYTES = 256 * 1024  # a scene is a page; anything larger is not one, and slow to parse

# How files begin that are no text, and what they are.
BEGINNINGS = {
    b"\x89MCAP": "a log (MCAP)",
    b"PK\x03\x04": "a ZIP archive or a spreadsheet",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a picture",
    b"\x1f\x8b": "a compressed file",
    b"\x7fELF": "a program",
}


def read_text(path: Path, kind: str, most: int = MAX_BYTES) -> str:
    """The text of a small UTF-8 file of a ``kind`` ("scene").

    Raises
    ------
    ConfigError
        Naming the file, what is wrong with it and what to do.
    """
    return decode(read_bytes(path, kind, most), str(path), kind)


def read_bytes(path: Path, kind: str, most: int = MAX_BYTES) -> bytes:
    """The bytes of a small file. Raises `ConfigError`."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise ConfigError(f"{path}: this is a directory, not a {kind} file.")
        if not stat.S_ISREG(mode):  # a pipe or a device may block for ever, or never end
            raise ConfigError(f"{path}: this is not a file but a pipe or a device. Name a {kind} file.")
        with path.open("rb") as file:
            data = file.read(most + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such {kind} file. Check the name and the folder.") from None
    except NotADirectoryError:
        raise ConfigError(f"{path}: there is no such {kind} file: a part of this path is a file.") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"{path}: the {kind} file cannot be read: {why}.") from None
    _check_beginning(data, str(path), kind)
    if len(data) > most:
        raise ConfigError(f"{path}: larger than {most // 1024} kB; this is not a {kind} file.")
    return data


def decode(data: bytes, source: str, kind: str) -> str:
    """The text in the bytes of a file; ``source`` names it in errors. Raises `ConfigError`."""
    _check_beginning(data, source, kind)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ConfigError(f"{source}: not UTF-8 text but UTF-16, which some editors call Unicode. Save it as UTF-8.")
    if b"\0" in data:
        raise ConfigError(f"{source}: not UTF-8 text: it holds a zero byte. This is not a {kind} file.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{source}: not UTF-8 text (byte 0x{data[error.start]:02X} in line {line}). It was probably saved in an "
            "older encoding, such as Latin-1 or Windows-1252. Save it as UTF-8."
        ) from None


def _check_beginning(data: bytes, source: str, kind: str) -> None:
    for beginning, what in BEGINNINGS.items():
        if data.startswith(beginning):
            raise ConfigError(f"{source}: this is {what}, not a {kind} file.")
