"""The ASCII stream: lines written by hand left, values right; and a whole run on the simulated bench."""

from __future__ import annotations

import itertools
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from pydantic import ValidationError

from drivers.instruments.ascii_stream import (
    LONGEST,
    AsciiDisplacement,
    AsciiDisplacementSettings,
    AsciiForce,
    AsciiForceSettings,
    Codec,
    ForceUnit,
)
from drivers.links.link import DeviceRefused, DeviceSilent
from drivers.roles import OK, SampleFlag
from rig.cli.app import main
from tests.protocols import TO_THE_FILM, near

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
PASSIVE = (
    TO_THE_FILM
    + """[[step]]
do = "sweep"
displacement_mm = 3.0
speed_mm_per_s = 4.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""
)


class FakePort:
    """What a board prints; whatever is written to it is kept."""

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
        self.written += b"closed"


LINES = [  # separator, columns, column, what is on the wire, the numbers
    (",", 1, 1, b"0.512\r\n-10.5\n+.25\n3.\n-1.5e-3\n8388607\n", [0.512, -10.5, 0.25, 3.0, -0.0015, 8388607.0]),
    (",", 3, 2, b"12, -0.5 ,N\n", [-0.5]),
    (";", 2, 1, b"1.5;kg\r\n", [1.5]),
    ("tab", 2, 2, b"100\t7\n", [7.0]),
    ("space", 3, 3, b"  a \t b   -2\n", [-2.0]),
]
WRONG = [  # one line each, and the counter that must rise
    (b"1,5\n", "wrong_columns"),
    (b"\xff1.0\n", "bad_grammar"),
    (b"1.0\x00\n", "bad_grammar"),
    (b"0x10\n", "bad_grammar"),
    (b"1_000\n", "bad_grammar"),
    (b"1.2.3\n", "bad_grammar"),
    (b"1e999\n", "bad_grammar"),
    (b"--1\n", "bad_grammar"),
    (b"infinity\n", "bad_grammar"),
    ("\u0663\n".encode(), "bad_grammar"),  # an Arabic digit is a digit for float()
    (b"HX711 ready\n", "bad_grammar"),
    (b"9" * (LONGEST + 1) + b"\n", "too_long"),
]


@pytest.mark.parametrize(("separator", "columns", "column", "wire", "numbers"), LINES)
def test_lines_give_numbers_wherever_they_are_cut(
    separator: Any, columns: int, column: int, wire: bytes, numbers: list[float]
) -> None:
    for cut in range(len(wire) + 1):
        codec = Codec(separator, columns, column)
        assert codec.feed(b"half a line\n") == []
        assert [v.number for v in codec.feed(wire[:cut]) + codec.feed(wire[cut:])] == numbers
        assert not any(codec.counters.values())


@pytest.mark.parametrize(("wire", "counter"), WRONG)
def test_what_is_no_value_is_counted_and_not_believed(wire: bytes, counter: str) -> None:
    codec = Codec()
    codec.feed(b"\n")
    assert codec.feed(wire) == []
    assert {key: n for key, n in codec.counters.items() if n} == {counter: 1}
    assert [v.number for v in codec.feed(b"4.5\n")] == [4.5]


def test_a_line_of_another_number_of_columns_is_not_believed() -> None:
    codec = Codec(",", 2, 1)
    codec.feed(b"\n")
    assert codec.feed(b"1\n1,2,3\n,\n") == []
    assert codec.counters["wrong_columns"] == 2 and codec.counters["bad_grammar"] == 1


def test_the_line_that_was_under_way_is_thrown_away() -> None:
    codec = Codec()
    assert codec.feed(b"0.5") == [] and codec.feed(b"12\r") == []  # of -10.512
    assert [v.number for v in codec.feed(b"\n-10.25\r\n")] == [-10.25]


def test_memory_is_bounded() -> None:
    codec = Codec()
    for _ in range(100):
        assert codec.feed(b"7" * 1000) == []
    codec.feed(b"\n")
    for _ in range(100):
        assert codec.feed(b"7" * 1000) == [] and codec._lines.held <= LONGEST
    assert codec.counters["too_long"] == 1


def test_units_are_si_inside_and_nothing_is_sent() -> None:
    cases: tuple[tuple[ForceUnit, float, float, str], ...] = (
        ("N", 1.0, 2.0, "N"),
        ("mN", -1.0, -2e-3, "N"),
        ("gf", 0.5, 9.80665e-3, "N"),
        ("kgf", 1.0, 19.6133, "N"),
        ("mV/V", 0.1, 0.2, "mV/V"),
    )
    for unit, factor, si, reads in cases:
        port = FakePort()
        force = AsciiForce("force", port, unit=unit, factor=factor)
        assert not force.ready and force.reading_unit == reads
        port.out = b"\n2\n"
        (sample,) = force.poll(1.0)
        assert sample.reading == pytest.approx(si, rel=1e-12) and sample.flags == OK and sample.t == 1.0
        assert force.ready and port.written == b""
    port = FakePort()
    gauge = AsciiDisplacement("displacement", port, unit="um", factor=2.0)
    port.out = b"\n500\n"
    assert gauge.poll(0.0)[0].displacement == pytest.approx(1e-3, rel=1e-12)


def test_words_for_no_value_are_flagged_and_what_is_too_large_is_dropped() -> None:
    port = FakePort()
    force = AsciiForce("force", port, unit="mN", limit=500.0)
    port.out = b"\nnan\ninf\n-INF\novf\n501\n-501\n500\n"
    samples = force.poll(1.0)
    flags = [sample.flags for sample in samples]
    none, over, under = SampleFlag.NO_VALUE, SampleFlag.OVER_RANGE, SampleFlag.UNDER_RANGE
    assert flags == [none, none | over, none | under, none | over, OK]
    assert all(math.isnan(sample.reading) for sample in samples[:4]) and samples[4].reading == 0.5
    assert force.counters["no_value"] == 4 and force.counters["bad_values"] == 2
    assert all(a.t < b.t for a, b in itertools.pairwise(samples)) and samples[-1].t == 1.0


def test_a_board_that_restarts_on_opening_is_waited_for_then_missed() -> None:
    port = FakePort()
    force = AsciiForce("force", port, rate_Hz=10.0, boot_s=2.0)
    assert force.poll(0.0) == [] and force.poll(2.4) == []
    with pytest.raises(DeviceSilent, match="nothing came"):
        force.poll(2.6)
    port.out = b"\n1.0\n"
    assert len(force.poll(2.7)) == 1
    port.out = b"1.0;2.0\n"
    assert force.poll(3.1) == []
    with pytest.raises(DeviceSilent, match="bad_grammar 1"):
        force.poll(3.3)


@pytest.mark.parametrize("period", [0.02, 0.5])
def test_another_rate_is_refused(period: float) -> None:
    port = FakePort()
    force = AsciiForce("force", port, rate_Hz=10.0, timeout_s=2.0)
    with pytest.raises(DeviceRefused, match="rate_Hz = 10"):
        for i in range(int(8 / period)):
            port.out = b"\n1.0\n"
            force.poll(i * period)


def test_a_clock_that_is_off_by_per_cents_is_tolerated() -> None:
    port = FakePort()
    force = AsciiForce("force", port, rate_Hz=80.0)
    times = []
    for i in range(2000):
        port.out = b"\n1.0\n"
        times += [sample.t for sample in force.poll(i / 83.0)]
    assert times == pytest.approx([i / 83.0 for i in range(2000)])


@pytest.mark.parametrize(
    ("keys", "word"),
    [({"columns": 2, "column": 3}, "column = 3"), ({"factor": 0.0}, "must not be 0"), ({"unit": "lb"}, "kgf")],
)
def test_keys_that_make_no_sense_are_refused(keys: dict[str, Any], word: str) -> None:
    table = {"driver": "ascii-stream", "certificate": "c.toml", **keys}
    for settings in (AsciiForceSettings, AsciiDisplacementSettings):
        with pytest.raises(ValidationError, match="unit" if "unit" in keys else word):
            settings.model_validate(table)


def test_a_run_and_its_replay(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    scene, protocol = tmp_path / "streams.toml", tmp_path / "p.toml"
    text = (SCENES / "streams.toml").read_text().replace("../calibrations", (SCENES.parent / "calibrations").as_posix())
    scene.write_text(near(text))
    protocol.write_text(PASSIVE)
    done = CliRunner().invoke(main, ["run", str(scene), str(protocol), "-o", str(log)])
    assert done.exit_code == 0, done.output
    done = CliRunner().invoke(main, ["replay", "--verify", str(log)])
    assert done.exit_code == 0 and "every sample comes out as recorded" in done.output
