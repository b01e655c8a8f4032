"""The optoNCDT 1420: triples written by hand left, words and distances right; damage; a whole run with its twin."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from drivers.instruments.optoncdt import Codec, OptoNCDT
from drivers.links.link import DeviceSilent
from drivers.roles import OK, DisplacementSample, SampleFlag


class FakePort:
    """What the sensor sends; whatever is written to it is kept."""

    name = "fake"

    def __init__(self) -> None:
        self.out, self.written = b"", b""

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def write(self, data: bytes) -> None:
        self.written += data

    def reopen(self) -> bool:
        return True

    def close(self) -> None:
        pass


# The first is the manual's own example.
TRIPLES = [("007189", 40000), ("004080", 0), ("034A80", 643), ("2D758F", 64877), ("307F8F", 65520), ("397EBF", 262073)]


@pytest.mark.parametrize(("hexadecimal", "word"), TRIPLES)
def test_triples_give_words_wherever_they_are_cut(hexadecimal: str, word: int) -> None:
    data = bytes.fromhex(hexadecimal)
    for cut in range(4):
        codec = Codec()
        assert codec.feed(data[:cut]) + codec.feed(data[cut:]) == [word]
        assert not any(codec.counters.values())


def test_broken_triples_are_dropped_and_counted() -> None:
    codec = Codec()
    assert codec.feed(bytes.fromhex("89 0071 007189 0089 7189 00 007189")) == [40000, 40000]
    assert codec.counters["dropped_bytes"] == 1 + 2 + 2 + 2 + 1
    assert codec.feed(bytes.fromhex("007189 0071C9")) == [40000]
    assert codec.counters["further_values"] == 1


def test_a_million_damaged_bytes() -> None:
    """No exception and no memory; every byte is in a word, a further value, dropped or held."""
    rng = random.Random(30)
    codec, sent, words = Codec(), 0, 0
    for _ in range(2000):
        data = bytearray(bytes.fromhex("007189") * 150)
        for _ in range(20):
            data[rng.randrange(len(data))] = rng.randrange(256)
            del data[rng.randrange(len(data))]
        sent += len(data)
        words += len(codec.feed(bytes(data)))
        assert codec.held <= 2
    assert sent == 3 * (words + codec.counters["further_values"]) + codec.counters["dropped_bytes"] + codec.held
    assert codec.feed(bytes.fromhex("80 007189")) == [40000]


def samples(data: str, **keys: Any) -> tuple[OptoNCDT, list[DisplacementSample]]:
    port = FakePort()
    laser = OptoNCDT("displacement", port, **keys)
    port.out = b"\x00"
    assert not laser.poll(0.0) and not laser.ready
    port.out = bytes.fromhex(data)
    found = list(laser.poll(0.1))
    assert port.written == b""
    return laser, found


def test_words_are_distances() -> None:
    # d = (x * 102 / 65520 - 1) / 100 * MR: 40000 is 61.27106 % of the range.
    laser, (one,) = samples("007189", measuring_range_mm=50.0)
    assert laser.ready and one.flags == OK and one.displacement == pytest.approx(30.635531e-3, abs=1e-9)
    _, (one,) = samples("007189", measuring_range_mm=10.0, inverted=True)
    assert one.displacement == pytest.approx(-6.1271062e-3, abs=1e-9)


def test_reserve_errors_and_words_that_there_are_not() -> None:
    laser, found = samples("004080 307F8F 397EBF 314080 317F8F")  # 0, 65520, 262073, 49, 65521
    under, over, none = SampleFlag.UNDER_RANGE, SampleFlag.OVER_RANGE, SampleFlag.NO_VALUE
    assert [sample.flags for sample in found] == [under, over, none, under]
    assert math.isnan(found[2].displacement)
    assert found[0].displacement == pytest.approx(-0.5e-3) and found[1].displacement == pytest.approx(50.5e-3)
    assert laser.counters["bad_values"] == 1 and laser.counters["error_words"] == 1


def test_silence_is_told() -> None:
    port = FakePort()
    laser = OptoNCDT("displacement", port)
    laser.poll(0.0)
    with pytest.raises(DeviceSilent, match="no valid value"):
        laser.poll(0.3)
