"""Damaged bytes against the Keyence codec: no exception, no memory, no value that the line's grammar could refuse."""

from __future__ import annotations

import math
import random
import re

import pytest

from drivers.keyence_lkg import Codec, Measured, Message, Pushed, Response, Value

# The value field as the manual words it: a sign and seven characters, of which one is the point.
DIGITS = re.compile(r"[+-][0-9.]{7}")


def valid_field(rng: random.Random) -> str:
    if rng.random() < 0.2:
        return rng.choice(["+FFFFFFF", "-FFFFFFF", "XXXXXXXX"])
    digits, point = f"{rng.randrange(10**6):06d}", rng.randint(1, 5)
    return f"{rng.choice('+-')}{digits[:point]}.{digits[point:]}"


def valid_line(rng: random.Random) -> bytes:
    text = rng.choice(
        [
            f"M1,{valid_field(rng)}",
            f"M0,{valid_field(rng)},{valid_field(rng)}",
            f"TG,{rng.randint(1, 2)},{valid_field(rng)}",
            rng.choice(["Q0", "R0", "ER,M1,01", "SR,CA,3", "SR,OC,1,0,4", "PR,0"]),
        ]
    )
    return text.encode() + rng.choice([b"\r", b"\r\n"])


def values(messages: list[Message]) -> list[Value]:
    found: list[Value] = []
    for message in messages:
        if isinstance(message, Measured):
            found += message.values.values()
        elif isinstance(message, Pushed):
            found.append(message.value)
    return found


def one_edit(rng: random.Random, data: bytes) -> tuple[bytes, bool]:
    """One byte changed, lost or added; and whether it could be a digit for a digit or a sign for a sign."""
    at, byte = rng.randrange(len(data)), bytes([rng.randrange(256)])
    match rng.randrange(4):
        case 0:
            byte = bytes([data[at] ^ 1 << rng.randrange(8)])
            damaged = data[:at] + byte + data[at + 1 :]
        case 1:
            damaged = data[:at] + byte + data[at + 1 :]
        case 2:
            return data[:at] + data[at + 1 :], False
        case _:
            return data[:at] + byte + data[at:], False
    pair = data[at : at + 1] + byte
    return damaged, pair.isdigit() or set(pair) <= set(b"+-")


def many_edits(rng: random.Random, data: bytes) -> bytes:
    for _ in range(rng.randint(1, 4)):
        a, b = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
        match rng.randrange(5):
            case 0:
                data = data[:a] + data[b:]
            case 1:
                data = data[:b] + data[a:]
            case 2:
                data = data[:a] + rng.randbytes(rng.randint(1, 8)) + data[b:]
            case 3:
                data = data[:a] + valid_line(rng) + data[a:]
            case _:
                data = data[:a] + data[a:b][::-1] + data[b:]
    return data


def decode(rng: random.Random, data: bytes) -> list[Message]:
    codec = Codec()
    cut = rng.randrange(len(data) + 1)
    messages = codec.feed(data[:cut]) + codec.feed(data[cut:])
    assert codec.feed(b"\rR0\rQ0\r")[-2:] == [Response("R0"), Response("Q0")]
    return messages


def single_edits(count: int) -> None:
    rng = random.Random(30)
    for _ in range(count):
        intact = b"".join(valid_line(rng) for _ in range(rng.randint(1, 3)))
        genuine = [repr(value) for value in values(Codec().feed(intact))]
        damaged, unseen = one_edit(rng, intact)
        got = [repr(value) for value in values(decode(rng, damaged))]
        if not unseen:
            assert set(got) <= set(genuine), (intact, damaged)


def arbitrary_edits(count: int) -> None:
    rng = random.Random(31)
    for _ in range(count):
        damaged = many_edits(rng, b"".join(valid_line(rng) for _ in range(rng.randint(1, 3))))
        on_the_wire = {float(f) for f in DIGITS.findall(damaged.decode("latin-1")) if f.count(".") == 1}
        for value in values(decode(rng, damaged)):
            assert math.isnan(value.number) == bool(value.flag)
            assert value.flag or value.number in on_the_wire


def garbage(count: int) -> None:
    rng = random.Random(32)
    alphabet = b"M01TG,ER+-.0123456789FX\r\nSRQ"
    codec = Codec()
    for _ in range(count):
        codec.feed(bytes(rng.choices(alphabet, k=30)) if rng.random() < 0.5 else rng.randbytes(30))
        assert codec._lines.held <= 128


def test_one_byte_changed_lost_or_added_is_a_wrong_value_only_where_the_driver_says_so() -> None:
    single_edits(40_000)


def test_any_damage_gives_only_values_that_stand_on_the_wire_in_full() -> None:
    arbitrary_edits(30_000)


def test_garbage() -> None:
    garbage(30_000)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_million_damaged_streams() -> None:
    single_edits(400_000)
    arbitrary_edits(300_000)
    garbage(300_000)
