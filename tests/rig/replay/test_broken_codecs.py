"""A codec that decodes wrongly is caught, with the place in the instrument's bytes."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest

import drivers.instruments.cia404.codec
import drivers.instruments.cia404.device
import drivers.instruments.gsv8.codec
import drivers.instruments.gsv8.device
import drivers.instruments.iseg_edcp.codec
import drivers.instruments.iseg_edcp.device
import drivers.instruments.keyence_lkg
import drivers.instruments.shvps
import drivers.instruments.zaber.codec
import drivers.instruments.zaber.device
import drivers.roles
from rig.replay.verify import verify


def received(recording, role):
    """All that the instrument sent, in one piece."""
    return b"".join(row.fields["data"] for row in recording.rows if row.topic == f"/raw/{role}/rx")


def zaber_sign(patch):
    read = drivers.instruments.zaber.device.ZaberStage._whole
    patch.setattr(
        drivers.instruments.zaber.device.ZaberStage, "_whole", lambda self, reply, words: -read(self, reply, words)
    )


def zaber_scale(patch):
    patch.setattr(
        drivers.instruments.zaber.device.ZaberStage,
        "_whole",
        lambda self, reply, words: int(reply.data) + (words == "get pos"),
    )


def zaber_moving(patch):
    patch.setattr(drivers.instruments.zaber.device.ZaberStage, "moving", property(lambda self: False))


def gsv8_byte_order(patch):
    patch.setattr(drivers.instruments.gsv8.codec, "struct", ByteOrder(">", "<", "f"))


def gsv8_wrong_width(patch):
    patch.setitem(drivers.instruments.gsv8.codec.WIDTH, "float32", 3)
    patch.setattr(drivers.instruments.gsv8.codec, "struct", ByteOrder(">", "<", "f"))


def gsv8_failing(patch):
    patch.setattr(
        drivers.instruments.gsv8.codec.Decoder, "_parse", lambda self, buffer, at, length: struct.unpack(">f", buffer)
    )


def gsv8_sign(patch):
    sample = drivers.instruments.gsv8.device.GSV8._sample
    patch.setattr(
        drivers.instruments.gsv8.device.GSV8,
        "_sample",
        lambda self, frame: replace(s := sample(self, frame), reading=-s.reading),
    )


def gsv8_last_digit(patch):
    sample = drivers.instruments.gsv8.device.GSV8._sample

    def wrong(self, frame):
        right = sample(self, frame)
        return replace(right, reading=math.nextafter(right.reading, math.inf))

    patch.setattr(drivers.instruments.gsv8.device.GSV8, "_sample", wrong)


def keyence_sign(patch):
    value = drivers.instruments.keyence_lkg._value
    patch.setattr(drivers.instruments.keyence_lkg, "_value", lambda field: replace(v := value(field), number=-v.number))


def keyence_scale(patch):
    value = drivers.instruments.keyence_lkg._value
    patch.setattr(
        drivers.instruments.keyence_lkg, "_value", lambda field: replace(v := value(field), number=v.number * 1.001)
    )


def iseg_byte_order(patch):
    patch.setattr(drivers.instruments.iseg_edcp.codec, "struct", ByteOrder(">", "<", "f"))


def iseg_flags(patch):
    patch.setattr(
        drivers.instruments.iseg_edcp.codec,
        "hv_flags",
        lambda status, events, module, bit_5: drivers.roles.HVFlag(0),
    )


def iseg_scale(patch):
    feed = drivers.instruments.iseg_edcp.codec.Decoder.feed

    def wrong(self, frame):
        message = feed(self, frame)
        if (
            isinstance(message, drivers.instruments.iseg_edcp.codec.Data)
            and message.item is drivers.instruments.iseg_edcp.codec.MEASURED_CURRENT
        ):
            return replace(message, value=message.value * 1e-3)
        return message

    patch.setattr(drivers.instruments.iseg_edcp.codec.Decoder, "feed", wrong)


def cia404_sign(patch):
    take = drivers.instruments.cia404.codec.Layout.take

    def wrong(self, data):
        value, status = take(self, data)
        return -value, status

    patch.setattr(drivers.instruments.cia404.codec.Layout, "take", wrong)


def cia404_byte_order(patch):
    patch.setattr(drivers.instruments.cia404.codec, "struct", ByteOrder("<", ">", "f"))


def shvps_off_by_one(patch):
    number = drivers.instruments.shvps.Codec.feed

    def wrong(self, data):
        return [str(int(line) + 1) if line == "799" or line == "800" else line for line in number(self, data)]

    patch.setattr(drivers.instruments.shvps.Codec, "feed", wrong)


def shvps_flags(patch):
    patch.setattr(drivers.instruments.shvps, "STEADY", 2)


class ByteOrder:
    """The module struct with ``old`` byte order read as ``new`` where ``kind`` is unpacked."""

    def __init__(self, old, new, kind):
        self._old, self._new, self._kind = old, new, kind

    def __getattr__(self, name):
        return getattr(struct, name)

    def _swap(self, layout):
        return layout.replace(self._old, self._new) if layout.endswith(self._kind) else layout

    def unpack(self, layout, data):
        return struct.unpack(self._swap(layout), data)

    def unpack_from(self, layout, data, offset=0):
        return struct.unpack_from(self._swap(layout), data, offset)

    def Struct(self, layout):  # the module's own name
        return struct.Struct(self._swap(layout))


CASES = [
    ("stage", "paper", zaber_sign),
    ("stage", "paper", zaber_scale),
    ("stage", "paper", zaber_moving),
    ("force", "paper", gsv8_byte_order),
    ("force", "paper", gsv8_wrong_width),
    ("force", "paper", gsv8_failing),
    ("force", "paper", gsv8_sign),
    ("force", "paper", gsv8_last_digit),
    ("displacement", "paper", keyence_sign),
    ("displacement", "paper", keyence_scale),
    ("hv", "paper", iseg_byte_order),
    ("hv", "paper", iseg_flags),
    ("hv", "paper", iseg_scale),
    ("force", "killed", cia404_sign),
    ("force", "killed", cia404_byte_order),
    ("hv", "killed", shvps_off_by_one),
    ("hv", "killed", shvps_flags),
]


@pytest.mark.parametrize(("role", "name", "breaking"), CASES, ids=[case[2].__name__ for case in CASES])
def test_a_broken_codec_is_caught_with_its_bytes(recorded, monkeypatch, role, name, breaking):
    recording = recorded(name)
    breaking(monkeypatch)
    found = verify(recording)
    difference = found.difference
    assert difference is not None
    assert found.exit_code == 1
    assert difference.role == role
    stream = received(recording, role)
    assert len(difference.data) > 0
    assert stream[difference.offset : difference.offset + len(difference.data)] == difference.data
    assert difference.recorded != difference.decoded
    for part in (role, f"bytes {difference.offset} to", difference.data[:8].hex(" "), difference.recorded):
        assert part in found.report


def test_the_offset_is_that_of_the_frame(recorded, monkeypatch):
    """One frame, far into the run, is decoded wrongly: the bytes that are blamed hold it and little else."""
    recording = recorded("paper")
    stream = received(recording, "force")
    frames = [row.fields["data"] for row in recording.rows if row.topic == "/raw/force/rx"]
    wrong = next(frame for frame in frames[800:] if len(frame) == 36 and stream.count(frame) == 1)
    value = struct.unpack(">f", wrong[3:7])[0]
    sample = drivers.instruments.gsv8.device.GSV8._sample

    def broken(self, frame):
        right = sample(self, frame)
        return replace(right, reading=right.reading + 1e-9) if frame.values[0] == value else right

    monkeypatch.setattr(drivers.instruments.gsv8.device.GSV8, "_sample", broken)
    difference = verify(recording).difference
    at = stream.find(wrong)
    assert difference.offset <= at
    assert at + len(wrong) <= difference.offset + len(difference.data)
    assert len(difference.data) <= 3 * len(wrong)
    assert difference.kind == "sample"
    assert "step 4" in difference.step or "step 5" in difference.step


def test_a_wrong_gain_is_caught(recorded, monkeypatch):
    """The derived quantity is compared too, not only the reading."""
    import rig.log.recorder

    quantity = rig.log.recorder.Recorder.quantity_of
    monkeypatch.setattr(
        rig.log.recorder.Recorder, "quantity_of", lambda self, sample: quantity(self, sample) * 1.0000001
    )
    difference = verify(recorded("paper")).difference
    assert difference is not None and difference.role in ("force", "displacement")
    assert "force_N" in difference.recorded or "displacement_m" in difference.recorded


def test_a_wrong_time_is_caught(recorded, monkeypatch):
    import drivers.dialogue

    monkeypatch.setattr(drivers.dialogue.Answer, "t", property(lambda self: self.received))
    difference = verify(recorded("paper")).difference
    assert difference is not None
    assert difference.kind == "sample"
