"""The simulated CiA 404 load cell judged by the canopen package: it reads, maps, starts and tares it over slcan."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("canopen", reason="needs the conformance dependency group")
pytestmark = pytest.mark.conformance

CLIENT = """
import json, sys, time
import canopen
from canopen import objectdictionary as od

def variable(index, sub, kind):
    it = od.ODVariable(f"{index:04X}_{sub}", index, sub)
    it.data_type, it.access_type, it.pdo_mappable = kind, "rw", True
    return it

d = od.ObjectDictionary()
for index, kind in ((0x1000, od.UNSIGNED32), (0x1008, od.VISIBLE_STRING), (0x1017, od.UNSIGNED16)):
    d.add_object(variable(index, 0, kind))
subs = {
    0x1018: {k: od.UNSIGNED32 for k in (1, 2, 3, 4)},
    0x1800: {1: od.UNSIGNED32, 2: od.UNSIGNED8, 5: od.UNSIGNED16},
    0x1A00: {k: od.UNSIGNED32 for k in range(1, 9)},
    0x6125: {1: od.UNSIGNED32}, 0x6130: {1: od.REAL32}, 0x6131: {1: od.UNSIGNED32}, 0x6150: {1: od.UNSIGNED8},
    0x9130: {1: od.INTEGER32},
}
for index, entries in subs.items():
    record = od.ODRecord(f"{index:04X}", index)
    record.add_member(variable(index, 0, od.UNSIGNED8))
    for sub, kind in entries.items():
        record.add_member(variable(index, sub, kind))
    d.add_object(record)

network = canopen.Network()
network.connect(interface="slcan", channel=sys.argv[1], bitrate=125000)
node = network.add_node(5, d)
out = {"type": node.sdo[0x1000].raw, "name": node.sdo[0x1008].raw, "serial": node.sdo[0x1018][4].raw}
out["unit"] = node.sdo[0x6131][1].raw
node.sdo[0x1017].raw = 200
node.tpdo.read()
pdo = node.tpdo[1]
pdo.clear()
pdo.add_variable(0x9130, 1)
pdo.add_variable(0x6150, 1)
pdo.event_timer = 20
pdo.enabled = True
node.tpdo.save()
seen = []
pdo.add_callback(lambda message: seen.append([v.raw for v in message]))
node.nmt.state = "OPERATIONAL"
node.nmt.wait_for_heartbeat(2.0)
out["state"] = node.nmt.state
seen.clear()
begin = time.monotonic()
time.sleep(1.0)
out["before"], out["lasted"] = seen[:], time.monotonic() - begin
node.sdo[0x6125][1].raw = int.from_bytes(b"zero", "little")
time.sleep(0.1)
seen.clear()
time.sleep(0.5)
out["after"] = seen[:]
try:
    node.sdo[0x6131][1].raw = 0
except canopen.SdoAbortedError as error:
    out["abort"] = error.code
network.disconnect()
print(json.dumps(out))
"""


def test_canopen_maps_starts_and_tares(serve: Callable[..., Any]) -> None:
    served = serve("force", force={"driver": "cia404", "noise_fraction": 0.0, "zero_offset_N": 0.0123})
    out = served.client(CLIENT, served.server.ports["force"]["can_channel"])
    assert out["type"] == 0x0002_0194 and out["serial"] == 77_120 and out["name"] == "simulated load cell"
    assert out["unit"] == struct.unpack("<I", bytes.fromhex("00002100"))[0]
    assert out["state"] == "OPERATIONAL"
    assert len(out["before"]) == pytest.approx(out["lasted"] / 0.02, rel=0.1)
    assert all(sample == [123, 0] for sample in out["before"])
    assert len(out["after"]) >= 15 and all(sample == [0, 0] for sample in out["after"])
    assert out["abort"] == 0x0601_0002
