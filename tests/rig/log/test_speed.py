"""Writing and loading against the mcap package's own writer and reader, in processor time of one and the same run.

Absolute figures depend on the machine: ``dea-rig benchmark log`` prints them.
"""

import io
import math
import time

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from rig.log import schema
from rig.log.dataset import load_run
from rig.log.writer import LogWriter

N = 20_000  # 20 s at 1 kHz, two instruments


def rows():
    for k in range(N):
        t = k * 1e-3
        x = math.sin(t)
        yield "/raw/force/rx", {"t_s": t, "data": b"\xaa\x11\x22\x33\x44\x85"}, k
        yield "/force/sample", {"t_s": t, "reading": x, "force_N": 2 * x, "flags": 0}, k
        yield "/raw/displacement/rx", {"t_s": t, "data": b"M1,+01.2345\r"}, k
        yield "/displacement/sample", {"t_s": t, "reading_m": x, "displacement_m": 3 * x, "flags": 0}, k


def stock_write():
    writer = Writer(io.BytesIO())
    writer.start()
    channels = {}
    for topic, fields, k in rows():
        if topic not in channels:
            kind = writer.register_schema(schema.schema_name(topic), "protobuf", schema.schema_data(topic))
            channels[topic] = writer.register_channel(topic, "protobuf", kind)
        writer.add_message(channels[topic], k * 1_000_000, schema.encode(topic, fields), k * 1_000_000, k)
    writer.finish()


@pytest.mark.slow
def test_a_kilohertz_against_the_stock_package(tmp_path):
    path = tmp_path / "long.mcap"
    marks = [time.process_time()]
    with LogWriter(path) as log:
        for topic, fields, k in rows():
            log.write(topic, fields, k * 1_000_000, k * 1_000_000)
            log.tick(k * 1e-3)
        log.finish({})
    marks.append(time.process_time())
    stock_write()
    marks.append(time.process_time())
    run = load_run(path)
    marks.append(time.process_time())
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = ["/force/sample", "/displacement/sample"]
        stock = [(m.channel.topic, m.decoded_message) for m in reader.iter_decoded_messages(topics)]
    marks.append(time.process_time())

    t = np.arange(N) * 1e-3
    x = np.array([math.sin(k) for k in t])
    np.testing.assert_array_equal(run.force, 2 * x)
    np.testing.assert_array_equal(run.h, 3 * x)
    np.testing.assert_array_equal([m.force_N for topic, m in stock if topic == "/force/sample"], 2 * x)
    np.testing.assert_array_equal([m.displacement_m for topic, m in stock if topic != "/force/sample"], 3 * x)
    write, stock_wrote, load, stock_read = np.diff(marks)
    assert write < 2.5 * stock_wrote  # measured: 0.6
    assert load < 0.5 * stock_read  # measured: 0.2
