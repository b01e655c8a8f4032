"""SCPI meter: lines by SCPI-99, and the driver against a fake at the other end of a link."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.instruments.scpi import LONGEST, Codec, Line, ScpiMeter, ScpiSettings, value_in
from drivers.links.link import DeviceRefused, DeviceSilent
from drivers.roles import OK, MonitorSample, SampleFlag

IDN = b"ACME,DMM6500,04387,1.7.3\n"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("+1.00273100E+00", (1.002731, OK)),
        ("-3", (-3.0, OK)),
        (".5,VDC,+1", (0.5, OK)),
        ("9.9E37", (math.nan, SampleFlag.NO_VALUE | SampleFlag.OVER_RANGE)),
        ("-9.9E+37", (math.nan, SampleFlag.NO_VALUE | SampleFlag.UNDER_RANGE)),
        ("9.91E37", (math.nan, SampleFlag.NO_VALUE)),
        ("1.2.3", None),
        ("nan", None),
        ("1e999", None),
        ("1_0", None),
        ("", None),
    ],
)
def test_values_as_the_standard_has_them(text: str, value: tuple[float, SampleFlag] | None) -> None:
    found = value_in(Line(text))
    if value is None or found is None:
        assert found is value
    else:
        assert found[1] == value[1] and (found[0] == value[0] or (math.isnan(found[0]) and math.isnan(value[0])))


def test_lines_cut_at_every_place_and_damaged_ones() -> None:
    data = IDN + b"+1.5E+02\r\n\n"
    for cut in range(len(data) + 1):
        codec = Codec()
        lines = codec.feed(data[:cut]) + codec.feed(data[cut:])
        assert [line.text for line in lines] == ["ACME,DMM6500,04387,1.7.3", "+1.5E+02"]
    rng, codec = random.Random(1), Codec()
    for _ in range(2000):
        damaged = bytearray(data)
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        for line in codec.feed(bytes(damaged)):
            value_in(line)
    assert codec.counters["bad_grammar"] > 0
    codec.feed(b"\n" + b"1" * (LONGEST + 1))
    codec.feed(b"\n2\n")
    assert codec.counters["too_long"] == 1


class Fake:
    """The other end: answers queries after ``delay`` s, each with the next of ``answers``, or with its identity."""

    name = "fake"

    def __init__(self, idn: bytes = IDN) -> None:
        self.now, self.delay = 0.0, 0.01
        self.idn, self.asked = idn, []
        self.coming: list[tuple[float, bytes]] = []
        self.value = 0.0
        self.deaf = False

    def write(self, data: bytes) -> None:
        for query in data.splitlines():
            self.asked.append(query)
            if self.deaf:
                continue
            if query == b"*IDN?":
                self.coming += [(self.now + 0.01, self.idn)] if self.idn else []
            else:
                self.coming.append((self.now + self.delay, f"{self.value:+.3E}\n".encode()))

    def read(self) -> bytes:
        arrived = [data for t, data in self.coming if t <= self.now]
        self.coming = [one for one in self.coming if one[0] > self.now]
        return b"".join(arrived)

    def reopen(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing to release."""


def polled(meter: ScpiMeter, fake: Fake, seconds: float) -> list[MonitorSample]:
    samples: list[MonitorSample] = []
    end = fake.now + seconds
    while fake.now < end:
        samples += meter.poll(fake.now)
        fake.now += 2e-3
    return samples


def make(fake: Fake, **keys: Any) -> ScpiMeter:
    given = {"query": "READ?", "to_si": (1000.0, 0.0), "rate_Hz": 10.0, "timeout_s": 0.1, **keys}
    return ScpiMeter("monitor", fake, **given)


def test_it_asks_who_is_there_and_then_only_the_query() -> None:
    fake = Fake()
    fake.value = 0.5
    meter = make(fake, identity="DMM6500")
    samples = polled(meter, fake, 2.0)
    assert meter.ready and (meter.identity.model, meter.identity.serial) == ("ACME DMM6500", "04387")
    assert fake.asked[0] == b"*IDN?" and set(fake.asked[1:]) == {b"READ?"}
    assert len(samples) in range(18, 22) and {sample.value for sample in samples} == {500.0}
    assert {(sample.role, sample.quantity) for sample in samples} == {("monitor", "voltage")}


@pytest.mark.parametrize("idn", [IDN, b""])
def test_an_answer_that_comes_too_late_is_never_taken_for_the_next(idn: bytes) -> None:
    """It was 1000 V when it was asked, and is 0 V since: nobody may hear of 1000 V after that."""
    fake = Fake(idn)
    fake.value = 1.0
    meter = make(fake, asks_identity=bool(idn))
    assert polled(meter, fake, 0.5)
    fake.delay = 0.13
    polled(meter, fake, 0.11)  # this one is on its way
    fake.delay, fake.value = 0.01, 0.0
    polled(meter, fake, 0.001)
    began = fake.now
    samples = polled(meter, fake, 2.0)
    assert meter.counters["synchronised"] >= 1
    assert samples and all(sample.value == 0.0 for sample in samples if sample.t > began + 0.2)
    assert len(samples) > 10


def test_what_is_refused_says_what_came() -> None:
    fake = Fake()
    meter = make(fake, identity="34465A")
    with pytest.raises(DeviceRefused, match=r"'ACME,DMM6500,04387,1\.7\.3', and identity = '34465A' is wanted"):
        polled(meter, fake, 1.0)
    fake = Fake()
    meter = make(fake)
    while not fake.coming or fake.asked[-1:] != [b"READ?"]:
        polled(meter, fake, 0.001)
    fake.coming = [(0.0, b"VOLT:DC\n")]
    with pytest.raises(DeviceRefused, match="answers 'READ\\?' with 'VOLT:DC', which is no number"):
        polled(meter, fake, 1.0)


def test_one_that_falls_silent_is_told_and_heard_again() -> None:
    fake = Fake()
    meter = make(fake)
    assert polled(meter, fake, 0.5)
    fake.deaf = True
    with pytest.raises(DeviceSilent, match="no answer to"):
        polled(meter, fake, 2.0)
    fake.deaf = False
    assert len(polled(meter, fake, 1.5)) > 5


def test_keys_that_cannot_be_meant() -> None:
    usual = {"driver": "scpi", "quantity": "voltage"}
    ScpiSettings.model_validate(usual)
    for wrong, word in (
        ({"factor": 0.0}, "must not be 0"),
        ({"unit": "C"}, "is none of a voltage; those are V, kV, mV"),
        ({"rate_Hz": 0.5}, "at least 1 Hz"),
        ({"query": "READ?\n*RST"}, "pattern"),
        ({"query": "OUTP ON"}, "pattern"),
    ):
        with pytest.raises(ValidationError, match=word):
            ScpiSettings.model_validate({**usual, **wrong})
    air = ScpiSettings.model_validate({"driver": "scpi", "quantity": "temperature", "rate_Hz": 0.1, "offset": -1.0})
    assert air.to_si == (1.0, 272.15)
