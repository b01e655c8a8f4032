"""A million damaged lines against each codec of lines: no exception, no memory, no wrong value; all is counted.

Of one byte changed, lost or added, the checksum of the Zaber shows everything. The Keyence and the shvps have none: a
digit for a digit, or a sign for a sign, is a value like any other (the shvps does not even fix their number), and that
is all that may pass. After any damage whatever, only what stands on the wire in full is believed. Every line that was
complete is a message or is counted.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.instruments import ascii_stream, keyence_lkg, shvps
from drivers.instruments.zaber import codec as zaber

BATCH = 100  # lines in one stream, every other one with damage of its own
POOL = 4000


@dataclass(frozen=True)
class Language:
    """What lines an instrument sends, and what of a message would be believed."""

    line: Callable[[random.Random], bytes]
    codec: Callable[[], Any]
    believed: Callable[[Any], list[str]]
    end: bytes
    synced: bytes  # after whatever damage: end of it, then a line that must be understood
    alike: Callable[[bytes, bytes], bool]  # whether one byte for another (or for none) cannot be seen
    on_the_wire: Callable[[str, bytes], bool]
    longest: int
    alphabet: bytes
    is_line: Callable[[bytes], bool] = field(default=bool)  # what has to be a message or counted


# -- Zaber


def checked(text: str) -> bytes:
    return f"{text}:{(256 - sum(text[1:].encode())) % 256:02X}\r\n".encode()


def zaber_line(rng: random.Random) -> bytes:
    state, flag = rng.choice(["BUSY", "IDLE"]), rng.choice(["--", *zaber.WARNINGS])
    head = f"{rng.randint(1, 99):02d} {rng.randint(0, 9)}"
    kind = rng.randrange(10)
    if kind == 0:
        return checked(f"!{head} {state} {flag}")
    if kind == 1:
        return checked(f"#{head} {rng.randint(0, 99):02d} stall threshold 12")
    data = rng.choice(["0", "BADDATA", "02 FS NI", str(rng.randint(-400_000, 400_000)), "7.14"])
    return checked(f"@{head} {rng.randint(0, 99):02d} {rng.choice(['OK', 'RJ'])} {state} {flag} {data}")


def zaber_codec() -> zaber.Codec:
    codec = zaber.Codec()
    # From here on lines without a checksum are refused.
    assert len(codec.feed(checked("@01 1 29 OK BUSY -- 0") + checked("!01 1 IDLE --"))) == 2
    return codec


def zaber_believed(message: zaber.Message) -> list[str]:
    # The first character is not in the checksum: a reply may turn into an info, whose text nobody uses.
    return [] if isinstance(message, zaber.Info) else [repr(message)]


def stands_with_its_sum(value: str, wire: bytes) -> bool:
    """Whether a line with this message's own text is on the wire, its sum right."""
    for line in wire.split(b"\n"):
        text, colon, total = line.removesuffix(b"\r").rpartition(b":")
        if colon and text and total == b"%02X" % (-sum(text[1:]) % 256):
            found = zaber.Codec().feed(line + b"\n")
            if any(repr(message) == value for message in found):
                return True
    return False


# -- Keyence


def field_of_eight(rng: random.Random) -> str:
    if rng.random() < 0.2:
        return rng.choice(["+FFFFFFF", "-FFFFFFF", "XXXXXXXX"])
    digits, point = f"{rng.randrange(10**6):06d}", rng.randint(1, 5)
    return f"{rng.choice('+-')}{digits[:point]}.{digits[point:]}"


def keyence_line(rng: random.Random) -> bytes:
    text = rng.choice(
        [
            f"M1,{field_of_eight(rng)}",
            f"M0,{field_of_eight(rng)},{field_of_eight(rng)}",
            f"TG,{rng.randint(1, 2)},{field_of_eight(rng)}",
            rng.choice(["Q0", "R0", "ER,M1,01", "SR,CA,3", "SR,OC,1,0,4", "PR,0"]),
        ]
    )
    return text.encode() + rng.choice([b"\r", b"\r\n"])


def keyence_believed(message: keyence_lkg.Message) -> list[str]:
    match message:
        case keyence_lkg.Measured(_, values):
            return [repr(value) for value in values.values()]
        case keyence_lkg.Pushed(_, value):
            return [repr(value)]
    return []


def a_number_on_the_wire(value: str, wire: bytes) -> bool:
    found = re.findall(r"[+-][0-9.]{7}", wire.decode("latin-1"))
    numbers = {repr(keyence_lkg.Value(float(text))) for text in found if text.count(".") == 1}
    special = [text for text in ("+FFFFFFF", "-FFFFFFF", "XXXXXXXX") if text.encode() in wire]
    return value in numbers or ("nan" in value and bool(special))


# -- ASCII stream: the value is the second of three columns


def ascii_line(rng: random.Random) -> bytes:
    value = rng.choice([f"{rng.uniform(-9, 9):.5f}", f"{rng.randrange(-(2**23), 2**23)}", "1.5e-3", "nan", "-inf"])
    return f"{rng.randrange(10**6)}, {value},ok".encode() + rng.choice([b"\r\n", b"\n"])


def ascii_codec() -> ascii_stream.Codec:
    codec = ascii_stream.Codec(",", 3, 2)
    assert codec.feed(b"\n") == []  # what comes before the first line end may lack its beginning
    return codec


def ascii_believed(message: ascii_stream.Value) -> list[str]:
    assert math.isfinite(message.number) or message.flags
    return [repr(message)]


def ascii_on_the_wire(value: str, wire: bytes) -> bool:
    """Whether a line of three columns has it as its second."""
    columns = [line.decode("latin-1").split(",") for line in wire.split(b"\n")]
    words = [c[1].strip().lower() for c in columns if len(c) == 3]
    if "nan" in value:
        return bool({"nan", "inf", "+inf", "-inf", "ovf"} & set(words))
    numbers = [word for word in words if re.fullmatch(r"[-+]?[0-9]*\.?[0-9]*(e[-+]?[0-9]+)?", word)]
    return value in {repr(ascii_stream.Value(float(word))) for word in numbers if re.match(r"[-+]?\.?[0-9]", word)}


# -- shvps


def shvps_line(rng: random.Random) -> bytes:
    text = rng.choice(
        [str(rng.randrange(5001)), str(rng.randrange(4)), f"slave {rng.randrange(1, 20)}", "HVPS 7", "Err"]
    )
    return text.encode() + b"\r\n"


def shvps_believed(message: str) -> list[str]:
    number = re.fullmatch(r"-?[0-9]{1,6}", message) or any(shvps.version_of(message))
    return [message] if number else []


LANGUAGES = {
    "zaber": Language(
        zaber_line,
        zaber_codec,
        zaber_believed,
        b"\n",
        b"\n@01 1 29 OK BUSY -- 0:DC\r\n",
        lambda before, after: False,
        stands_with_its_sum,
        512,
        b"@#!/:\\\r\n -0123456789ABCDEFOKRJBUSYIDLE",
        lambda line: bool(line.removesuffix(b"\r")),
    ),
    "keyence": Language(
        keyence_line,
        keyence_lkg.Codec,
        keyence_believed,
        b"\r",
        b"\rPR,5\r",
        lambda before, after: (
            ((before + after).isdigit() and len(after) == len(before)) or {before, after} == {b"+", b"-"}
        ),
        a_number_on_the_wire,
        128,
        b"M01TG,ER+-.0123456789FX\r\nSRQ",
        lambda line: bool(line.removeprefix(b"\n")),
    ),
    "ascii-stream": Language(
        ascii_line,
        ascii_codec,
        ascii_believed,
        b"\n",
        b"\n1,2,3\n",
        lambda before, after: all(byte in b"+-.,eE \t\r\n0123456789NAFINnafi" for byte in before + after),
        ascii_on_the_wire,
        ascii_stream.LONGEST,
        b"0123456789+-.,eE nanifov\r\n",
        lambda line: bool(line.removesuffix(b"\r")),
    ),
    "shvps": Language(
        shvps_line,
        shvps.Codec,
        shvps_believed,
        b"\n",
        b"\r\nslave 8\r\nslave 8\r\n",
        lambda before, after: all(byte in b"-0123456789" for byte in before + after),
        lambda value, wire: value.encode() in [line.removesuffix(b"\r") for line in wire.split(b"\n")],
        64,
        b"slave master-0123456789\r\nErHVPS",
        lambda line: True,
    ),
}


def make_pool(language: Language, rng: random.Random) -> list[tuple[bytes, list[str]]]:
    """Good lines, with what is believed of each."""
    lines = [language.line(rng) for _ in range(POOL)]
    return [(line, [v for m in language.codec().feed(line) for v in language.believed(m)]) for line in lines]


def one_edit(rng: random.Random, data: bytes) -> tuple[bytes, bytes, bytes]:
    """One byte changed (perhaps in one bit only), lost or added; and what was there before and is after."""
    at, kind = int(rng.random() * len(data)), int(rng.random() * 4)
    before = data[at : at + 1]
    if kind == 0:
        after = bytes((data[at] ^ 1 << int(rng.random() * 8),))
    elif kind == 2:
        after = b""
    else:
        after = bytes((int(rng.random() * 256),))
        if kind == 3:
            return data[:at] + after + data[at:], b"", after
    return data[:at] + after + data[at + 1 :], before, after


def many_edits(rng: random.Random, data: bytes, other: bytes) -> bytes:
    for _ in range(rng.randint(1, 4)):
        a, b = sorted((int(rng.random() * (len(data) + 1)), int(rng.random() * (len(data) + 1))))
        match int(rng.random() * 5):
            case 0:
                data = data[:a] + data[b:]
            case 1:
                data = data[:b] + data[a:]
            case 2:
                data = data[:a] + rng.randbytes(rng.randint(1, 8)) + data[b:]
            case 3:
                data = data[:a] + other + data[a:]
            case _:
                data = data[:a] + data[a:b][::-1] + data[b:]
    return data


def decode(language: Language, rng: random.Random, wire: bytes) -> list[str]:
    """What is believed of ``wire``, fed in pieces; and that each line of it is a message or counted."""
    codec = language.codec()
    cuts = sorted(int(rng.random() * len(wire)) for _ in range(4))
    messages = [
        message for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for message in codec.feed(wire[a:b])
    ]
    assert codec._lines.held <= language.longest
    lines = sum(map(language.is_line, wire.split(language.end)[:-1]))
    waiting = len(getattr(codec, "_unfinished", ()))
    # An over-long line that has not ended yet is counted already.
    assert lines <= len(messages) + sum(codec.counters.values()) + waiting <= lines + 1
    # Whatever came, from the next line on all is well again.
    assert len(codec.feed(language.synced)) >= 1
    return [value for message in messages for value in language.believed(message)]


def single_edits(language: Language, count: int) -> None:
    rng = random.Random(20)
    pool = make_pool(language, rng)
    seen = 0
    for _ in range(2 * count // BATCH):
        intact = rng.choices(pool, k=BATCH)
        allowed = {value for _, values in intact for value in values}
        edited = []
        for number, (line, _) in enumerate(intact):
            if number % 2:  # a good line between, so that the damage of two never adds up to none
                edited.append(line)
                continue
            damaged, before, after = one_edit(rng, line)
            edited.append(damaged)
            if language.alike(before, after):
                allowed.update(v for m in language.codec().feed(damaged) for v in language.believed(m))
            else:
                seen += 1
        got = decode(language, rng, b"".join(edited))
        assert set(got) <= allowed, (set(got) - allowed, edited)
    assert seen > 0.5 * count


def arbitrary_edits(language: Language, count: int) -> None:
    rng = random.Random(21)
    pool = make_pool(language, rng)
    passed = 0
    for _ in range(count // 20):
        intact = rng.choices(pool, k=20)
        genuine = {value for _, values in intact for value in values}
        wire = b"".join(many_edits(rng, line, rng.choice(pool)[0]) for line, _ in intact)
        for value in set(decode(language, rng, wire)) - genuine:
            assert language.on_the_wire(value, wire), (value, wire)
            passed += 1
    if language.codec is zaber_codec:  # damage that leaves the sum as it was, or a line that was pasted whole
        assert passed < 0.1 * count


def garbage(language: Language, count: int) -> None:
    rng = random.Random(22)
    codec = language.codec()
    for _ in range(count // BATCH):
        data = b"".join(
            bytes(rng.choices(language.alphabet, k=30)) if rng.random() < 0.5 else rng.randbytes(30)
            for _ in range(BATCH)
        )
        codec.feed(data)
        assert codec._lines.held <= language.longest
        assert len(getattr(codec, "_unfinished", ())) <= 16


@pytest.mark.parametrize("language", LANGUAGES.values(), ids=LANGUAGES)
@pytest.mark.parametrize(
    "count",
    [
        10_000,
        pytest.param(100_000, marks=pytest.mark.slow),
        pytest.param(1_000_000, marks=[pytest.mark.long, pytest.mark.timeout(900)]),
    ],
    ids=["some", "many", "million"],
)
def test_damaged_lines_are_dropped_and_counted(language: Language, count: int) -> None:
    single_edits(language, count * 6 // 10)
    arbitrary_edits(language, count * 2 // 10)
    garbage(language, count * 2 // 10)
