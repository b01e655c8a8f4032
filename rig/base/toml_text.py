"""From TOML text to plain values: limits before the parser sees it, and errors that show the line and its likely slip.

A parser's work on hostile text can grow with the square of its length and worse (a dotted key of 10 000 parts, 10 000
brackets), so the nesting is counted first, in one pass.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from typing import Any

from rig.base.errors import ConfigError
from rig.base.text import control_in, printable

MAX_PARTS = 12  # of a dotted key
MAX_DEPTH = 24  # of lists and inline tables
MAX_DIGITS = 40  # of one number
MAX_TOKENS = 80_000  # words and signs: some 10 000 keys
MAX_VALUES = 100_000
SHOWN = 72  # letters of a line in an error

_TOKEN = re.compile(
    r"""(?P<remark>\#[^\n]*)|(?P<text>"(?:\\.|[^"\\\n])*"|'[^'\n]*')|(?P<word>[A-Za-z0-9_+-]+)|(?P<space>[ \t]+)"""
    r"""|(?P<open>[\[{])|(?P<close>[\]}])|(?P<other>.|\n)"""
)
_LONG_TEXT = {'"""': re.compile(r'"""(?:\\.|[^\\])*?"{3,5}', re.S), "'''": re.compile(r"'''.*?'{3,5}", re.S)}


def parse_toml(text: str, kind: str, source: str) -> dict[str, Any]:
    """The values in a TOML text of a ``kind`` ("scene"); ``source`` names it in errors.

    Raises
    ------
    ConfigError
        With the line, a mark under the place, and what is probably meant.
    """
    _check_nesting(text, kind, source)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(_syntax_error(text, str(error), source)) from None
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: not valid TOML, and not a usable {kind} file: {error}.") from None
    _check_values(values, source)
    return values


def _check_nesting(text: str, kind: str, source: str) -> None:
    """Refuse what only an accident or an attacker nests so deeply."""
    parts, depth = 0, 0
    awaits_part = False  # after a dot
    for number, (name, token, at) in enumerate(_tokens(text)):
        if number > MAX_TOKENS:
            raise ConfigError(f"{source}: holds more than a {kind} file can need; this is not one.")
        if name == "open":
            depth += 1
        elif name == "close":
            depth -= 1
        if name in ("word", "text"):
            parts = parts + 1 if awaits_part else 1
            awaits_part = False
            if name == "word" and len(token) > MAX_DIGITS and token.replace("_", "").lstrip("+-").isdigit():
                raise ConfigError(_at_line(text, at, source, f"a number of {len(token)} digits"))
        elif token == ".":
            awaits_part = True
        elif name != "space":
            parts, awaits_part = 0, False
        if parts > MAX_PARTS:
            raise ConfigError(_at_line(text, at, source, f"a key of more than {MAX_PARTS} parts joined by dots"))
        if depth > MAX_DEPTH:
            raise ConfigError(_at_line(text, at, source, f"brackets more than {MAX_DEPTH} deep"))


def _at_line(text: str, at: int, source: str, what: str) -> str:
    return f"{source}: line {text.count(chr(10), 0, at) + 1} holds {what}; no file of this program needs that."


def _tokens(text: str) -> Iterator[tuple[str, str, int]]:
    at = 0
    while at < len(text):
        start = text[at : at + 3]
        if start in _LONG_TEXT:
            found = _LONG_TEXT[start].match(text, at)
            if found is None:
                return  # never closed: the parser says so
            yield "text", start, at
        else:
            found = _TOKEN.match(text, at)
            assert found is not None and found.lastgroup is not None
            yield found.lastgroup, found.group(), at
        at = found.end()


def _check_values(values: dict[str, Any], source: str) -> None:
    """Refuse texts and keys that would drive a terminal, and more values than any file needs."""
    waiting: list[tuple[str, Any]] = [("", values)]
    count = 0
    while waiting:
        place, value = waiting.pop()
        count += 1
        if count > MAX_VALUES:
            raise ConfigError(f"{source}: holds more than {MAX_VALUES} values; no file of this program needs that.")
        if isinstance(value, dict):
            waiting += [(f"{place}, {key}" if place else str(key), inner) for key, inner in value.items()]
            texts = list(value)
        elif isinstance(value, list):
            waiting += [(f"{place} {number + 1}", inner) for number, inner in enumerate(value)]
            continue
        else:
            texts = [value] if isinstance(value, str) else []
        for text in texts:
            if (control := control_in(text)) is not None:
                raise ConfigError(
                    f"{source}: {printable(place) or 'a key'} = {printable(text)[:60]!r} holds the control character "
                    f"{control}. Texts and keys are plain letters; remove it."
                )


def _syntax_error(text: str, message: str, source: str) -> str:
    """The line, a mark under the place, what is wrong there, and what is probably meant."""
    place = re.search(r" \(at line (\d+), column (\d+)\)$", message)
    lines = text.split("\n")
    if place is None or message.startswith("Unclosed"):  # perhaps noticed only much further down
        number, column = _unclosed(text)
    else:
        number, column = int(place[1]), int(place[2])
        single = re.match(r"\[\[\s*(.+?)\s*\]\]", lines[number - 1].strip())
        first = next((k for k, line in enumerate(lines) if single and line.strip() == f"[{single[1]}]"), None)
        if message.startswith("Cannot overwrite") and first is not None:
            number, column, message = first + 1, len(lines[first]) - len(lines[first].lstrip()) + 1, "Single bracket"
    line = lines[min(number, len(lines)) - 1].rstrip("\r")
    what = _in_words(message)
    shown, mark = _cut(line, column)
    hint = _likely(line, message)
    told = [f"{source}: not valid TOML in line {number}: {what}.", f"  {shown}", f"  {' ' * mark}^"]
    return "\n".join(told + ([f"  {hint}"] if hint else []))


def _unclosed(text: str) -> tuple[int, int]:
    """Line and column of the bracket that is never closed; the last line if all are."""
    opened: list[int] = []
    for name, _, at in _tokens(text):
        if name == "open":
            opened.append(at)
        elif name == "close" and opened:
            opened.pop()
    at = opened[-1] if opened else len(text.rstrip())
    line = text.count("\n", 0, at)
    return line + 1, at - (text.rfind("\n", 0, at) + 1) + 1


def _cut(line: str, column: int) -> tuple[str, int]:
    """The part of a line around a column (from 1) that fits on the screen, and where the column is in it."""
    column = max(0, min(column - 1, len(line)))
    start = max(0, column - SHOWN + 20) if len(line) > SHOWN else 0
    before, after = printable(line[start:column].replace("\t", " ")), printable(line[column:].replace("\t", " "))
    lead = "..." if start else ""
    return (lead + before + after)[:SHOWN], min(len(lead + before), SHOWN - 1)


_WORDS = (  # what the parser says, and what the file's author is told
    (r"^Single bracket", "a table that stands several times has two brackets each time"),
    (r"^Expected newline or end of document", "something is left over behind the value"),
    (
        r"^Illegal character '\\n'|^Unterminated string|^Illegal character '\\r'",
        "the quotes are not closed in this line",
    ),
    (r"^Illegal character", "this character is not allowed in a text"),
    (r"^Cannot declare|^Cannot mutate|^Cannot define|^Cannot overwrite|^Duplicate", "this name is given twice"),
    (r"^Unescaped '\\\\'", "a backslash in a text in double quotes begins a special character"),
    (r"^Invalid hex value", "\\u and \\x in a text need hexadecimal digits behind them"),
    (r"^Expected '='", "an = is needed behind the key"),
    (r"^Expected '\]", "the bracket of this table's name is not closed"),
    (r"^Unclosed array", "this list is not closed"),
    (r"^Unclosed inline table", "this table in braces is not closed"),
    (r"^Unexpected end of document|^Expected '\"\"\"'|^Expected \"'''\"", "the file ends before this is closed"),
    (r"^Invalid initial character for a key part|^Invalid statement", "no key and no table begins like this"),
    (r"^Invalid date", "this is no date that exists"),
    (r"^Invalid value", "this is no number, no text in quotes and no list"),
)


def _in_words(message: str) -> str:
    return next((words for pattern, words in _WORDS if re.search(pattern, message)), "this is not understood")


_NUMBER = r"[+-]?\d[\d_]*(?:\.\d+)?(?:[eE][+-]?\d+)?"
_SLIPS = (  # pattern of a line (and of what the parser says), and what is probably meant
    (r"=\s*[+-]?\d+,\d+\s*(?:#.*)?$", "", "Decimals take a point, not a comma: 4.0."),
    ("[“”„‟«»‘’‚]", "", 'Use straight quotes: "text". These are typographic ones, as word processors put them in.'),
    ("[−–—]", "", "Use the minus of the keyboard: -. This is a longer dash."),
    ("[\u00a0\u2000-\u200b\u202f\u3000\ufeff]", "", "There is a special space here; delete it and type a plain one."),
    (
        r'"[^"]*\\',
        "",
        r"Write it in single quotes, 'C:\COM3', or with two backslashes, "
        '"C:\\\\COM3".',
    ),
    (rf"=\s*{_NUMBER}\s*(?:[A-Za-zµ%/°]|per )", "Expected newline", "No unit behind the number: the key has it."),
    (rf"=\s*{_NUMBER}\s*[;,]", "", "Nothing stands behind the value, no comma and no semicolon."),
    (r"=\s*(?:[+-]?\.\d|[+-]?\d+\.(?:\D|$))", "", "A digit is needed on both sides of the point: 0.5, 4.0."),
    (r"=\s*[+-]?0\d", "", "A number does not begin with zeros."),
    (r"=\s*(?:True|TRUE|False|FALSE)\b", "", "Write true or false, in small letters."),
    (r"=\s*(?:None|null|NULL)\b", "", "Leave the key out where it has no value."),
    (r"=\s*(?:NaN|NAN|Inf|INF|Infinity)\b", "", "This must be a number."),
    (r"^\s*[A-Za-z_][\w-]*\s*:", "", "Write key = value, with an equal sign."),
    (r"^[^=#\"']*==", "", "One equal sign is enough."),
    (r"^\s*(?://|;|--|/\*)", "", "A remark begins with #."),
    (r"=\s*[+-]?\d[\d.]*\s*(?:\*|\^|x10)", "", "Write powers of ten as 33e3."),
    (r"^\s*\[step\]", "", "Each step begins with two brackets: [[step]]."),
    (r"", "Single bracket", "Write two brackets here too, as further down in the file."),
    (r"=\s*(?:#.*)?$", "", "The value is missing behind the equal sign."),
    (r"=\s*[A-Za-z_/.~][^\"'\[{]*$", "Invalid value", 'A text needs quotes: "text".'),
    (r"^\s*\[[^\]]*$", "", "Close the bracket of the table's name: [name]."),
    (r"=\s*[\"'][^\"']*$", "", "Close the quotes."),
    (r"^\s*[A-Za-z_][\w-]*\s+[^=\s]", "Expected '='", "Write key = value, with an equal sign."),
)


def _likely(line: str, message: str) -> str:
    """What is probably meant, if that can be told from the line."""
    for pattern, said, hint in _SLIPS:
        if re.search(pattern, line) and message.startswith(said):
            return hint
    if re.match(r"Cannot|Duplicate", message):
        return "Each table and each key stands once in a file; the first one may be far above."
    return ""
