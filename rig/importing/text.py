"""Bytes of a file -> lines of text. The size is looked at before anything is read."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from rig.importing.findings import Finding, ImportRefused

LARGEST_BYTES = 64 * 1024 * 1024  # a million rows of five columns have some 40 MB
SAMPLE_BYTES = 64 * 1024  # from which an encoding is judged
# Encodings of one byte a character that programs of laboratories write; the first is the commonest by far.
ONE_BYTE = ("cp1252", "mac_roman", "cp850", "cp1250")
MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig", "utf-8 with BOM"),
    (codecs.BOM_UTF32_LE, "utf-32", "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32", "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16", "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16", "utf-16"),
)
# What a file is that begins like this, and what to do with it.
BINARY = (
    (b"PK\x03\x04", "a workbook (XLSX or ODS)", "save the sheet as CSV first"),
    (b"\xd0\xcf\x11\xe0", "an old workbook (XLS)", "save the sheet as CSV first"),
    (b"TDSm", "a TDMS file", "export it as text first"),
    (b"PAR1", "a Parquet file", "write it as CSV first"),
    (b"MATLAB 5.0", "a MAT file", "write the arrays as CSV first"),
    (b"\x89HDF", "an HDF5 file", "write the arrays as CSV first"),
    (b"\x89MCAP0", "a log of this program", "give it to `dea-rig fit` without --scene"),
    (b"%PDF", "a PDF file", "ask for the numbers as text"),
    (b"\x1f\x8b", "a compressed file", "unpack it first"),
)
OPEN_QUOTE = re.compile(r'(?:^|[,;\t|])\s*"[^"]*$')  # a cell that begins with a quotation mark and does not end
MARKUP = (b"<html", b"<!doctype", b"<table", b"<?xml")


@dataclass(frozen=True)
class TableText:
    """Lines of a file. ``ends_whole`` is whether the last line has its end; a log that was cut off has none."""

    path: Path
    lines: list[str]
    encoding: str
    ends_whole: bool


def is_log(path: Path) -> bool:
    """Whether a file begins like an MCAP log; False where it cannot be read, which its reader will tell."""
    try:
        with path.open("rb") as file:
            return file.read(6) == b"\x89MCAP0"
    except OSError:
        return False


def read_text(path: Path, encoding: str | None = None) -> TableText:
    """Read a file of text in whatever encoding it is.

    Raises
    ------
    ImportRefused
        When it cannot be read, is too large, or is no text.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise _refused(
                path,
                f"{size / 1024**2:.0f} MB; at most {LARGEST_BYTES // 1024**2} MB are read. Keep the rows of the test, "
                "or every tenth of them",
            )
        with path.open("rb") as file:
            raw = file.read(LARGEST_BYTES + 1)
    except FileNotFoundError:
        raise _refused(path, "there is no such file; check the name") from None
    except OSError as error:
        raise _refused(path, f"cannot be read: {error.strerror}") from None
    for magic, what, remedy in BINARY:
        if raw.startswith(magic):
            raise _refused(path, f"this is {what}, not a table of text; {remedy}")
    if raw.lstrip()[:9].lower().startswith(MARKUP):
        raise _refused(
            path,
            "this is a web page, or a workbook saved as one (HTML or XML), not a table of text; save the "
            "sheet as CSV first",
        )
    text, name = _decoded(path, raw, encoding)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    ends_whole = text.endswith("\n")
    lines = _joined(text.split("\n"))
    if ends_whole:
        lines.pop()
    if not any(line.strip() for line in lines):
        raise _refused(path, "the file is empty")
    return TableText(path, lines, name, ends_whole)


def _joined(lines: list[str]) -> list[str]:
    """Lines with a quoted cell that goes on in the next ones (a heading of two lines in a spreadsheet) as one line.

    Empty lines stand in the place of the others, so that lines keep their numbers.
    """
    for k, line in enumerate(lines):
        if '"' not in line or not OPEN_QUOTE.search(line):
            continue
        for more in range(1, 4):
            whole = " ".join(lines[k : k + more + 1])
            if not OPEN_QUOTE.search(whole):
                lines[k : k + more + 1] = [whole, *[""] * more]
                break
    return lines


def _decoded(path: Path, raw: bytes, encoding: str | None) -> tuple[str, str]:
    """Text and the name of its encoding."""
    if encoding is not None:
        try:
            return raw.decode(encoding), encoding
        except (LookupError, UnicodeDecodeError) as error:
            raise _refused(path, f"cannot be read as {encoding!r}: {error}", "--encoding cp1252") from None
    for mark, codec, name in MARKS:
        if raw.startswith(mark):
            return raw.decode(codec, errors="replace"), name
    head = raw[:SAMPLE_BYTES]
    if b"\0" in head and b"\0" not in raw.rstrip(b"\0"):  # a file system that lost its power fills up with zeros
        text, name = _decoded(path, raw.rstrip(b"\0"), None)
        return text, f"{name}, zeros at its end left out"
    if b"\0" in head:
        # ASCII in UTF-16 has a zero in every other byte; a binary file has them anywhere.
        for offset, codec in ((1, "utf-16-le"), (0, "utf-16-be")):
            if head[offset::2].count(0) > 0.7 * len(head[offset::2]):
                return raw.decode(codec, errors="replace"), codec
        raise _refused(path, f"not a text file (byte {head.index(0)} is zero)")
    try:
        return raw.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        name = _one_byte(raw)
        return raw.decode(name, errors="replace"), name


def _one_byte(raw: bytes) -> str:
    """The encoding of one byte a character in which the letters beyond ASCII make most sense."""
    from charset_normalizer import from_bytes  # heavy, and seldom needed

    strange = [line for line in raw.splitlines() if any(byte > 127 for byte in line)]
    sample = b"\n".join(strange)[:SAMPLE_BYTES]
    # The marks of units decide where they are there: few other letters stand in front of an m or behind one.
    for name in ONE_BYTE:
        words = sample.decode(name, errors="replace").lower()  # casefold() would make a Greek mu of the micro sign
        if any(mark in words for mark in ("µm", "m²", "°c", "länge", "prüf", "zerst", "éprouvette", "déplacement")):
            return name
    best = from_bytes(sample, cp_isolation=list(ONE_BYTE)).best()
    if best is None or sample.decode(best.encoding, errors="replace") == sample.decode(ONE_BYTE[0], errors="replace"):
        return ONE_BYTE[0]
    return best.encoding


def _refused(path: Path, what: str, option: str = "") -> ImportRefused:
    return ImportRefused([Finding("obstacle", "file", str(path), what, option)])
