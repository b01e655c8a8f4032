"""The channels of a log: one table, from which the protobuf descriptors and the documentation both follow.

Every message has explicit field presence (proto2 ``optional``), and `encode` writes every field. A message whose
strings are empty therefore has a fixed size, and a column of a million samples can be read without a loop. Field
numbers follow the order of the table, from 1.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from enum import Flag
from functools import cache
from operator import itemgetter
from typing import Any, Literal, NamedTuple, get_args

from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from drivers.instrument import MONITORS
from drivers.roles import HVFlag, SampleFlag

SCHEMA_VERSION = 2
PACKAGE = "dearig.v2"
ROLES = ("stage", "force", "displacement", "hv", *MONITORS)
SETTINGS = ".settings"
"""Of the supply as a command's device: it is about its settings that were lent, not about its output."""


class Field(NamedTuple):
    """One field of a message: its name with the unit in it, its protobuf type, its meaning."""

    name: str
    type: str
    meaning: str


class Channel(NamedTuple):
    """The message that a topic carries."""

    message: str
    fields: tuple[Field, ...]


def _flag_values(flags: type[Flag]) -> str:
    return ", ".join(f"{flag.value} {flag.name}" for flag in flags)


Way = Literal["rx", "tx", "gone", "back", "failed"]
WAYS: tuple[Way, ...] = get_args(Way)
"""Read from an instrument, or sent to it; its link was lost, or works again; a poll of it ended in an error."""

_T = Field("t_s", "double", "clock time, seconds since the start of the run")
_FLAGS = Field("flags", "fixed32", f"what is wrong with the sample, a sum of: {_flag_values(SampleFlag)}")
_RAW = Channel(
    "RawBytes",
    (
        Field("t_s", "double", "clock time of the poll in which they passed, seconds since the start of the run"),
        Field(
            "data",
            "bytes",
            "as on the wire; a CAN frame is its identifier (2 bytes, big-endian) and its data. Empty where "
            "nothing passed: its link was found gone, or to work again, or the poll ended in an error",
        ),
    ),
)

_MONITOR = Channel(
    "MonitorSample",
    (
        _T,
        Field("voltage_V", "double", "voltage of the output by a reading of its own, in volts; NaN: not this, or none"),
        Field("temperature_K", "double", "temperature of the air at the film, in kelvin; NaN: not this, or none"),
        Field("relative_humidity", "double", "of the air at the film, 0 to 1; NaN: not this, or none"),
        _FLAGS,
    ),
)
MONITORED = {"voltage": "voltage_V", "temperature": "temperature_K", "humidity": "relative_humidity"}
"""The field of a monitor's sample for each quantity."""

CHANNELS: dict[str, Channel] = {
    "/stage/sample": Channel(
        "StageSample",
        (
            _T,
            Field("position_m", "double", "position of the stage in metres, in the device's own coordinate"),
            Field("moving", "bool", "true while a motion command is under way"),
            Field("referenced", "bool", "true once the stage has been homed"),
            Field("raw_steps", "sfixed64", "position in the device's own steps"),
            Field("warnings", "string", "the device's warning codes, separated by spaces"),
        ),
    ),
    "/force/sample": Channel(
        "ForceSample",
        (
            _T,
            Field(
                "reading",
                "double",
                "reading in the sensor's own unit, which the metadata `units` names; NaN when there is no value",
            ),
            Field("force_N", "double", "force on the film in newtons, zero and sensitivity applied"),
            _FLAGS,
        ),
    ),
    "/displacement/sample": Channel(
        "DisplacementSample",
        (
            _T,
            Field("reading_m", "double", "displacement as the sensor states it, in metres; NaN when there is no value"),
            Field("displacement_m", "double", "out-of-plane displacement of the film in metres, zero applied"),
            _FLAGS,
        ),
    ),
    "/hv/sample": Channel(
        "HvSample",
        (
            _T,
            Field("voltage_V", "double", "measured output voltage in volts"),
            Field(
                "current_A", "double", "measured output current in amperes; NaN where the supply does not measure it"
            ),
            Field("setpoint_V", "double", "set-point read back from the supply, in volts"),
            Field("flags", "fixed32", f"state of the channel, a sum of: {_flag_values(HVFlag)}"),
        ),
    ),
    "/target": Channel(
        "Target",
        (
            _T,
            Field("displacement_m", "double", "out-of-plane displacement asked for, in metres"),
            Field("voltage_V", "double", "voltage asked for, in volts"),
            Field("speed_m_per_s", "double", "speed of the stage asked for, in metres per second"),
        ),
    ),
    "/phase": Channel(
        "Phase",
        (
            _T,
            Field("step", "uint32", "index of the protocol step that begins here"),
            Field("kind", "string", "kind of the step: home, zero, approach, ramp, ..."),
            Field("label", "string", "the step's own name in the protocol, or its kind"),
            Field("cycle", "uint32", "cycle within the step, from 1; 0 where the step has none"),
            Field("direction", "sint32", "+1 loading, -1 unloading, 0 neither"),
            Field("voltage_V", "double", "nominal voltage of the step, in volts"),
            Field("record", "bool", "true while the samples are meant for identification"),
        ),
    ),
    "/reference": Channel(
        "Reference",
        (
            _T,
            Field("name", "string", "force_zero, displacement_zero, contact_position, ..."),
            Field("value", "double", "the reference, in `unit`"),
            Field("standard_uncertainty", "double", "its standard uncertainty, in `unit`"),
            Field("unit", "string", "unit of value and uncertainty"),
        ),
    ),
    "/result": Channel(
        "Result",
        (
            _T,
            Field("step", "uint32", "index of the protocol step that found it"),
            Field("kind", "string", "kind of that step: breakdown, ..."),
            Field("outcome", "string", "how it ended; of breakdown: breakdown, ceiling or limit"),
            Field("name", "string", "voltage, field, field_at_disk, displacement, duration, charge, ..."),
            Field("value", "double", "the value, in `unit`"),
            Field("standard_uncertainty", "double", "its standard uncertainty, in `unit`; NaN where it is not known"),
            Field("unit", "string", "unit of value and uncertainty"),
        ),
    ),
    "/decision": Channel(
        "Decision",
        (
            _T,
            Field("step", "uint32", "index of the protocol step that decides"),
            Field("number", "uint32", "of the decision, from 1; a run taken up again goes on counting"),
            Field("outcome", "string", "go: on to the next place; met, unreachable, time, failed"),
            Field("reason", "string", "in words"),
            Field("displacement_m", "double", "where to measure next, in metres; NaN where there is no next place"),
            Field("voltage_V", "double", "at what voltage, in volts; NaN likewise"),
            Field("hold_s", "double", "for how long, in seconds"),
            Field("quantity", "string", "of those wanted the one farthest from it; empty before there is a fit"),
            Field("value", "double", "of that quantity by the fit so far, in `unit`; NaN before"),
            Field("standard_uncertainty", "double", "its standard uncertainty, of the parts that count; NaN before"),
            Field("unit", "string", "unit of value and uncertainty"),
            Field("relative_uncertainty", "double", "the same over the value; NaN before"),
            Field("wanted_uncertainty", "double", "relative standard uncertainty that is wanted of it; NaN before"),
            Field("spent_s", "double", "seconds of the rig in this step so far, earlier runs included"),
            Field("expected_s", "double", "seconds that it will still take, as far as can be told; NaN: cannot"),
        ),
    ),
    "/standing": Channel(
        "Standing",
        (
            _T,
            Field("step", "uint32", "index of the protocol step that decides"),
            Field("number", "uint32", "of the decision that this stands behind"),
            Field("quantity", "string", "one of those wanted"),
            Field("value", "double", "by the fit so far, in `unit`"),
            Field("standard_uncertainty", "double", "its standard uncertainty, of the parts that count, in `unit`"),
            Field("unit", "string", "unit of value and uncertainty"),
            Field("relative_uncertainty", "double", "the uncertainty over the value"),
            Field("wanted_uncertainty", "double", "relative standard uncertainty that is wanted"),
            Field("outcome", "string", "its own: met by two fits in a row; unreachable; time: it needs more time"),
            Field("reason", "string", "of the outcome, in words"),
        ),
    ),
    "/cycle": Channel(
        "Cycle",
        (
            _T,
            Field("step", "fixed32", "index of the protocol step whose cycle ends here"),
            Field("cycle", "sfixed64", "its number within the step, from 1; a run taken up again goes on counting"),
            Field("whole", "bool", "false for one that a pause or the end of the run cut short: it is not counted"),
            Field("kept", "bool", "true where samples and bytes of the whole cycle are in this log"),
            Field("begin_s", "double", "clock time at which it began, seconds since the start of the run"),
            Field("samples", "fixed32", "samples of the force in it"),
            Field("force_valley_N", "double", "smallest force measured, in newtons"),
            Field("force_peak_N", "double", "largest force measured, in newtons"),
            Field("displacement_valley_m", "double", "smallest displacement measured, in metres"),
            Field("displacement_peak_m", "double", "largest displacement measured, in metres"),
            Field("voltage_valley_V", "double", "smallest voltage measured, in volts; NaN without a supply"),
            Field("voltage_peak_V", "double", "largest voltage measured, in volts; NaN without a supply"),
            Field("current_valley_A", "double", "smallest current measured, in amperes; NaN where it is not measured"),
            Field("current_peak_A", "double", "largest current measured, in amperes; NaN where it is not measured"),
            Field("stiffness_N_per_m", "double", "slope of force over displacement by least squares, where it cycles"),
            Field("actuation_N_per_V2", "double", "slope of force over voltage squared, likewise"),
            Field("work_J", "double", "area of the loop of force and displacement: what the film has dissipated"),
            Field("electric_J", "double", "voltage times current over the cycle; NaN where it is not measured"),
            Field("leakage_A", "double", "mean current while voltage and disk stand still at the top; NaN without"),
        ),
    ),
    "/kept": Channel(
        "Kept",
        (
            _T,
            Field(
                "keeping",
                "bool",
                "whether everything is written from here on; else samples, bytes, commands of "
                "cycling and its targets are left out until the next such message",
            ),
            Field("before_s", "double", "how many seconds before are written behind this message, late"),
            Field("cause", "string", "why: the rule of the step, or what happened"),
        ),
    ),
    "/command": Channel(
        "Command",
        (
            _T,
            Field("device", "string", "the device's name in the scene"),
            Field("command", "string", "what is about to be asked of it"),
            Field("argument", "string", "with what, unit included"),
        ),
    ),
    "/event": Channel(
        "Event",
        (
            _T,
            Field("severity", "string", "info, warning or error"),
            Field("source", "string", "who says so"),
            Field("message", "string", "what happened"),
        ),
    ),
    "/operator": Channel(
        "OperatorAct",
        (
            _T,
            Field("act", "string", "is asked, answers, pauses, continues, stops or arms"),
            Field("text", "string", "what he was asked, what he answered, what went on; of arming: what he confirmed"),
            Field("by", "string", "who did it or in what way: the keyboard, a signal, another terminal, an option"),
        ),
    ),
    "/identity": Channel(
        "Identity",
        (
            _T,
            Field("device", "string", "the device's name in the scene"),
            Field("model", "string", "as the device states it; empty where it does not"),
            Field("serial", "string", "serial number as the device states it; empty where it does not"),
            Field("firmware", "string", "firmware as the device states it; empty where it does not"),
        ),
    ),
    "/setting": Channel(
        "Setting",
        (
            _T,
            Field("device", "string", "the device's name in the scene"),
            Field("name", "string", "what was read back from the device or set on its link"),
            Field("value", "string", "its value, the unit in the name"),
        ),
    ),
    "/certificate_problem": Channel(
        "CertificateProblem",
        (
            _T,
            Field("device", "string", "the device's name in the scene"),
            Field("problem", "string", "what speaks against using the certificate: its date, another serial number"),
        ),
    ),
    "/counter": Channel(
        "Counter",
        (
            _T,
            Field("device", "string", "the device's name in the scene; after this it is no longer polled, only closed"),
            Field("name", "string", "what was counted during the run: retries, dropped bytes and the like"),
            Field("count", "sfixed64", "how often"),
        ),
    ),
    **{f"/{name}/sample": _MONITOR for name in MONITORS},
    **{f"/raw/{role}/{way}": _RAW for role in ROLES for way in WAYS},
}

_PACKED = {"double": ("d", 1), "fixed32": ("I", 5), "sfixed64": ("q", 1)}  # as struct has it; protobuf's wire type
_RAW_SHORT, _RAW_LONG = struct.Struct("<BdBB"), struct.Struct("<BdBBB")  # tag, time, tag, length of the data

_TYPES = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "fixed32": FieldDescriptorProto.TYPE_FIXED32,
    "sfixed64": FieldDescriptorProto.TYPE_SFIXED64,
    "uint32": FieldDescriptorProto.TYPE_UINT32,
    "sint32": FieldDescriptorProto.TYPE_SINT32,
    "string": FieldDescriptorProto.TYPE_STRING,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
}


def schema_name(topic: str) -> str:
    """Full protobuf name of the message on ``topic``, e.g. ``dearig.v2.ForceSample``."""
    return f"{PACKAGE}.{CHANNELS[topic].message}"


def meanings() -> dict[str, str]:
    """What every field of every message means, by ``Message.field``; each log carries it."""
    return {
        f"{channel.message}.{field.name}": field.meaning for channel in CHANNELS.values() for field in channel.fields
    }


@cache
def schema_data(topic: str) -> bytes:
    """The serialised FileDescriptorSet that describes the message on ``topic``."""
    return FileDescriptorSet(file=[_file(CHANNELS[topic])]).SerializeToString(deterministic=True)


def encode(topic: str, fields: Mapping[str, Any]) -> bytes:
    """The protobuf bytes of one message with all its fields.

    Raises
    ------
    KeyError
        No such topic.
    ValueError
        A field is missing, unknown, or of the wrong type.
    """
    packed = _packer(topic)
    if packed is not None and (data := packed(fields)) is not None:
        return data
    cls, names = _coder(topic)
    if fields.keys() != names:
        missing, unknown = sorted(names - fields.keys()), sorted(fields.keys() - names)
        parts = [f"{what} {', '.join(which)}" for what, which in (("missing", missing), ("unknown", unknown)) if which]
        raise ValueError(f"{topic}: fields {'; '.join(parts)}")
    if None in fields.values():  # protobuf would leave the field out
        raise ValueError(f"{topic}: a field is None")
    try:
        return cls(**fields).SerializeToString()
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{topic}: {error}") from error


def decode(topic: str, data: bytes) -> dict[str, Any]:
    """The fields of one message, in the order of the table.

    Raises
    ------
    KeyError
        No such topic.
    ValueError
        The bytes are not such a message, a field is missing, or a text is not UTF-8.
    """
    cls, names = _coder(topic)
    try:
        message = cls.FromString(data)
    except DecodeError as error:
        raise ValueError(f"{topic}: not a {CHANNELS[topic].message} message") from error
    if len(message.ListFields()) != len(names):
        raise ValueError(f"{topic}: a {CHANNELS[topic].message} message without all its fields")
    fields = {field.name: getattr(message, field.name) for field in CHANNELS[topic].fields}
    for field in CHANNELS[topic].fields:
        if field.type == "string" and not isinstance(fields[field.name], str):  # protobuf gives bytes then
            raise ValueError(f"{topic}: {field.name} is not UTF-8")
    return fields


Packed = Callable[[Mapping[str, Any]], "bytes | None"]


@cache
def _packer(topic: str) -> Packed | None:
    """What makes the same bytes in a fifth of the time, for the messages that come a thousand times a second.

    Those whose fields are all numbers of one size, and those of the wire. None for others; and the function gives None
    for fields that are not as they should be: protobuf then says what is wrong.
    """
    fields = CHANNELS[topic].fields
    if CHANNELS[topic] is _RAW:
        return _packed_raw
    if any(field.type not in _PACKED for field in fields):
        return None
    layout = struct.Struct("<" + "".join("B" + _PACKED[field.type][0] for field in fields))
    tags = [number << 3 | _PACKED[field.type][1] for number, field in enumerate(fields, 1)]
    values_of = itemgetter(*(field.name for field in fields))
    pack, count = layout.pack, len(fields)
    parts: list[Any] = [part for tag in tags for part in (tag, 0)]
    if max(tags) > 0x7F:  # a tag of two bytes
        return None

    def packed(row: Mapping[str, Any]) -> bytes | None:
        try:
            parts[1::2] = values_of(row)
            return pack(*parts) if len(row) == count else None
        except (KeyError, TypeError, struct.error):
            return None

    return packed


def _packed_raw(row: Mapping[str, Any]) -> bytes | None:
    try:
        t, data = row["t_s"], row["data"]
        size = len(data)
        if type(data) is not bytes or len(row) != 2 or size >= 1 << 14:
            return None
        if size < 0x80:
            return _RAW_SHORT.pack(0x09, t, 0x12, size) + data
        return _RAW_LONG.pack(0x09, t, 0x12, size & 0x7F | 0x80, size >> 7) + data
    except (KeyError, TypeError, struct.error):
        return None


def _file(channel: Channel) -> FileDescriptorProto:
    fields = [
        FieldDescriptorProto(
            name=field.name, number=number, type=_TYPES[field.type], label=FieldDescriptorProto.LABEL_OPTIONAL
        )
        for number, field in enumerate(channel.fields, 1)
    ]
    return FileDescriptorProto(
        name=f"{PACKAGE}.{channel.message}.proto",
        package=PACKAGE,
        message_type=[DescriptorProto(name=channel.message, field=fields)],
    )


@cache
def _pool() -> DescriptorPool:
    pool = DescriptorPool()
    for channel in {channel.message: channel for channel in CHANNELS.values()}.values():
        pool.Add(_file(channel))
    return pool


@cache
def _coder(topic: str) -> tuple[type[Message], frozenset[str]]:
    descriptor: Descriptor = _pool().FindMessageTypeByName(schema_name(topic))
    return GetMessageClass(descriptor), frozenset(field.name for field in CHANNELS[topic].fields)
