import math
import random
import struct

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from rig.log import schema


def test_bytes_on_the_wire():
    """Tags, order and presence, spelled out by hand from the protobuf encoding rules."""
    data = schema.encode("/force/sample", {"t_s": 1.0, "reading": 0.0, "force_N": -2.5, "flags": 3})
    expected = (
        b"\x09" + struct.pack("<d", 1.0)
        + b"\x11" + struct.pack("<d", 0.0)  # zeros are written, so that nothing is guessed at reading
        + b"\x19" + struct.pack("<d", -2.5)
        + b"\x25" + struct.pack("<I", 3)
    )  # fmt: skip
    assert data == expected


def test_every_topic_round_trips(samples):
    for topic, fields in samples.items():
        fields = {"t_s": 0.25, **fields}
        decoded = schema.decode(topic, schema.encode(topic, fields))
        assert decoded == fields
        assert list(decoded) == [field.name for field in schema.CHANNELS[topic].fields]
    assert {t for t in schema.CHANNELS if not t.startswith("/raw")} == {t for t in samples if not t.startswith("/raw")}


NUMBERS = [0.0, -0.0, 1.5, -1e300, 5e-324, math.nan, math.inf, -math.inf, 3, True, np.float64(0.1), 2**31]
VALUES = {"double": NUMBERS, "fixed32": [0, 1, 2**32 - 1, np.int64(7)], "sfixed64": [0, -1, 2**63 - 1]}
BYTES = [
    b"",
    b"a",
    bytes(127),
    bytes(128),
    bytes(300),
    bytes(range(256)) * 63,
    bytes(16383),
    bytes(16384),
    bytes(40000),
]


def test_what_is_packed_by_hand_is_what_protobuf_makes():
    rng = random.Random(3)
    packed = [topic for topic in schema.CHANNELS if schema._packer(topic) is not None]
    frequent = {"/force/sample", "/displacement/sample", "/hv/sample", "/raw/force/rx", "/raw/hv/tx"}
    assert frequent <= set(packed) and "/stage/sample" not in packed
    for topic in packed:
        cls, _ = schema._coder(topic)
        for _ in range(50):
            row = {
                f.name: rng.choice(BYTES if f.type == "bytes" else VALUES[f.type])
                for f in schema.CHANNELS[topic].fields
            }
            assert schema.encode(topic, row) == cls(**row).SerializeToString()


def test_nan_and_infinity_survive():
    fields = {"t_s": math.inf, "reading": math.nan, "force_N": -math.inf, "flags": 0}
    decoded = schema.decode("/force/sample", schema.encode("/force/sample", fields))
    assert decoded["t_s"] == math.inf
    assert math.isnan(decoded["reading"])
    assert decoded["force_N"] == -math.inf


GOOD = {"t_s": 0.0, "reading": 0.0, "force_N": 0.0, "flags": 0}


@pytest.mark.parametrize(
    "bad",
    [
        {**GOOD, "force_N": "1"},
        {**GOOD, "flags": -1},
        {**GOOD, "flags": 1.5},
        {**GOOD, "flags": 2**32},
        {**GOOD, "force_N": None},
        {**GOOD, "force_mN": 1.0},
        {k: v for k, v in GOOD.items() if k != "flags"},
        {},
    ],
)
def test_wrong_fields_are_refused(bad):
    with pytest.raises(ValueError, match="/force/sample"):
        schema.encode("/force/sample", bad)


def test_text_that_is_not_unicode_is_refused():
    with pytest.raises(ValueError, match="/event"):
        schema.encode("/event", {"t_s": 0.0, "severity": "info", "source": "x", "message": "\ud800"})


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff", b"\x09\x00", schema.encode("/force/sample", GOOD)[:-5], b"\x0d\x00\x00\x80\x3f"],
    ids=["empty", "junk", "cut", "field missing", "wrong wire type"],
)
def test_what_is_not_a_message_is_refused(data):
    with pytest.raises(ValueError, match="/force/sample"):
        schema.decode("/force/sample", data)


def test_text_that_is_not_utf8_is_refused():
    event = schema.encode("/event", {"t_s": 0.0, "severity": "info", "source": "x", "message": "abc"})
    with pytest.raises(ValueError, match="message is not UTF-8"):
        schema.decode("/event", event.replace(b"abc", b"\xff\xfe\xfd"))


def test_units_stand_in_the_names():
    """Every double says its unit, but for references, results and decisions, which carry it in a field of their own,
    and the reading of a force sensor, whose unit is the sensor's and stands in the metadata ``units``."""
    units = ("_s", "_m", "_N", "_V", "_A", "_J", "_K", "_N_per_V2", "relative_humidity")  # the last one has none
    for topic, channel in schema.CHANNELS.items():
        for field in channel.fields:
            own = topic in ("/reference", "/result", "/decision", "/standing") or (topic, field.name) == (
                "/force/sample",
                "reading",
            )
            if field.type == "double" and not own:
                assert field.name.endswith(units), f"{topic}.{field.name}"


def test_descriptor_sets_stand_alone():
    for topic in schema.CHANNELS:
        (file,) = FileDescriptorSet.FromString(schema.schema_data(topic)).file
        assert f"{file.package}.{file.message_type[0].name}" == schema.schema_name(topic)
        assert not file.dependency
