"""isegcan (University of Helsinki) on the simulated supply, over slcan on a pseudo-terminal."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.conformance

TOUR = """
import json, os, sys, time
from isegcan.can_edcp import Resource

supply = Resource(3, channel=sys.argv[1], interface="slcan", bitrate=int(sys.argv[2]))
out = {"channels": supply.module_channel_number}
out["nominal"] = supply.query_channel_nominal_voltage(None, 0)
out["serial"] = supply.query_module_serial_number(None, None)
out["module"] = supply.module_status_query(None, 0)
out["ramp"] = supply.ramp_speed(600.0, 0)
out["set"] = supply.voltage_set(1200.0, 0)
out["limit"] = supply.current_set(1e-4, 0)
out["on"] = supply.state(1, 0)
out["ramping"] = supply.channel_status_query(None, 0)
time.sleep(2.5)
out["standing"] = supply.channel_status_query(None, 0)
out["volts"] = supply.voltage_out_query(None, 0)
out["amperes"] = supply.current_out_query(None, 0)
out["off"] = supply.state(0, 0)
time.sleep(2.5)
out["volts off"] = supply.voltage_out_query(None, 0)
out["status off"] = supply.channel_status_query(None, 0)
out["events"] = supply.query_channel_event_status(None, 0)
out["cleared"] = supply.reset_trip(None, 0)
print()
print(json.dumps(out), flush=True)
os._exit(0)  # its notifier thread would spin
"""


def test_it_logs_on_ramps_reads_and_switches_off(serve):
    served = serve("hv", hv={"module": 3})
    supply = served.bench.instruments["hv"]
    assert not supply.registered
    out = served.client(TOUR, served.server.ports["hv"]["can_channel"], "125000")
    assert supply.registered  # the client logged on by itself; nobody else talks to the module
    on, ramping, constant_voltage = 1 << 3, 1 << 4, 1 << 7
    assert (out["channels"], out["nominal"], out["serial"]) == (1, 6000.0, 484_216)
    assert out["module"] & 0x7700 == 0x7700  # temperature, supply, module, safety loop, no ramp, no sum error
    assert (out["ramp"], out["set"]) == (600.0, 1200.0)
    assert out["limit"] == pytest.approx(1e-4)
    assert out["on"] is True and out["ramping"] == on | ramping | constant_voltage
    assert out["standing"] == on | constant_voltage
    assert out["volts"] == pytest.approx(1200.0, abs=2.0)
    assert out["amperes"] == pytest.approx(1200.0 / 20e9, abs=25e-9)
    assert out["off"] is False and out["status off"] == 0
    assert out["volts off"] == pytest.approx(0.0, abs=2.0)
    assert out["events"] == 1 << 4 | 1 << 3 and out["cleared"] == 0
    assert served.bench.world.output.at(served.bench.now)[0] == 0.0


def test_at_the_wrong_bit_rate_nobody_answers(serve):
    served = serve("hv", hv={"module": 3, "bitrate": 250_000})
    script = """
import json, sys, can
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=125000, sleep_after_open=0)
bus.send(can.Message(arbitration_id=0x219, data=bytes.fromhex("1208"), is_extended_id=False))
answer = bus.recv(1.0)
bus.shutdown()
print(json.dumps(answer is None))
"""
    assert served.client(script, served.server.ports["hv"]["can_channel"]) is True


TABLE = """
import json, os, sys
from isegcan.can_edcp import Resource
from isegcan._edcp_definitions import c_cmd

supply = Resource(3, channel=sys.argv[1], interface="slcan", bitrate=int(sys.argv[2]))
asked = sys.argv[3].split()
out = {name: getattr(supply, "query_" + name)(None, 0) for name in asked}
# Its setters wait for an answer, which writes do not have.
for name, value in (("power_set", 1.5), ("resistor_external", 1e6), ("voltage_ramp_priority", 1), ("power_set", 1e9)):
    supply._command(c_cmd["channel_" + name], value, 0, is_write=True)  # the last one is beyond what it has: refused
out["power then"] = supply.query_channel_power_set(None, 0)
out["resistor then"] = supply.query_channel_resistor_external(None, 0)
out["priority then"] = supply.query_channel_voltage_ramp_priority(None, 0)
print()
print(json.dumps(out), flush=True)
os._exit(0)
"""
ITEMS = {
    "channel_voltage_ramp_priority": 0,
    "channel_nominal_power": 6.0,
    "channel_voltage_bottom": 0.0,
    "channel_vct_coefficient": 0.0,
    "channel_temperature_external": 25.0,
    "channel_resistor_external": 0.0,
    "channel_current_ramp_speed_min": 0.0,
    "channel_current_ramp_speed_max": 2e-4,
    "channel_power_set": 6.0,
    "module_event_group_mask": 0,
}


def test_items_beside_the_voltage_are_there_and_keep_what_is_written(serve):
    served = serve("hv", hv={"module": 3})
    out = served.client(TABLE, served.server.ports["hv"]["can_channel"], "125000", " ".join(ITEMS))
    assert {name: out[name] for name in ITEMS} == pytest.approx(ITEMS, rel=1e-6)
    assert (out["power then"], out["resistor then"], out["priority then"]) == (1.5, 1e6, 1)
