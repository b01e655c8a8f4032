"""Zaber's own library, in native units, on the simulated stage."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.conformance

TOUR = """
import json, sys, threading, time
from zaber_motion.ascii import Connection

out = {}
def error_of(call):
    try:
        call()
    except Exception as error:
        return type(error).__name__
    return "none"

with Connection.open_serial_port(sys.argv[1]) as connection:
    alerts = []
    connection.alert.subscribe(lambda a: alerts.append([a.device_address, a.axis_number, a.status]))
    connection.enable_alerts()
    [device] = connection.detect_devices(identify_devices=False)
    axis = device.get_axis(1)
    out["address"] = device.device_address
    out["homed at first"] = axis.is_homed()
    out["flags at first"] = sorted(axis.warnings.get_flags())
    out["move unhomed"] = error_of(lambda: axis.move_absolute(1000))
    axis.home()
    out["homed"] = axis.is_homed()
    out["flags"] = sorted(axis.warnings.get_flags())
    axis.move_absolute(20000)
    out["absolute"] = axis.get_position()
    axis.move_relative(-5000)
    out["relative"] = axis.get_position()
    out["too far"] = error_of(lambda: axis.move_absolute(10**9))
    out["unknown"] = error_of(lambda: connection.generic_command("sing", 1, 1))
    axis.move_absolute(300000, wait_until_idle=False)
    time.sleep(0.5)
    out["busy"] = axis.is_busy()
    axis.stop()
    out["stopped"] = [axis.is_busy(), axis.get_position()]
    axis.move_velocity(-20000)
    time.sleep(0.3)
    axis.stop()
    out["after velocity"] = axis.get_position()
    axis.settings.set("maxspeed", 30000)
    out["maxspeed"] = axis.settings.get("maxspeed")
    out["limit"] = axis.settings.get("limit.max")
    out["resolution"] = axis.settings.get("resolution")
    result = []
    mover = threading.Thread(target=lambda: result.append(error_of(lambda: axis.move_absolute(300000))))
    mover.start()
    time.sleep(0.4)
    connection.generic_command_no_response("move abs 0", 1, 1)
    mover.join()
    out["pre-empted"] = result[0]
    axis.wait_until_idle()
    connection.checksum_enabled = False
    out["without checksum"] = axis.get_position()
    time.sleep(0.2)
    out["alerts"] = [len(alerts), alerts[0]]
print(json.dumps(out))
"""


def test_it_homes_moves_stops_and_reads_warnings_and_alerts(serve):
    stage = serve("stage")
    out = stage.client(TOUR, stage.server.ports["stage"]["port"])
    assert out["address"] == 1
    assert out["homed at first"] is False and out["flags at first"] == ["WH", "WR"]
    assert out["move unhomed"] == "BadDataException"
    assert out["homed"] is True and out["flags"] == []
    assert out["absolute"] == 20000 and out["relative"] == 15000
    assert out["too far"] == "BadDataException" and out["unknown"] == "BadCommandException"
    assert out["busy"] is True
    assert out["stopped"][0] is False and 15000 < out["stopped"][1] < 300000
    assert out["after velocity"] < out["stopped"][1]
    assert (out["maxspeed"], out["limit"], out["resolution"]) == (30000, 305381, 64)
    assert out["pre-empted"] == "MovementInterruptedException"
    assert out["without checksum"] == 0
    assert out["alerts"][0] >= 6 and out["alerts"][1] == [1, 1, "IDLE"]
    assert stage.bench.world.stage.at(stage.bench.now)[0] == pytest.approx(0.0, abs=1e-9)


FURTHER = """
import json, sys
from zaber_motion import Units
from zaber_motion.ascii import Connection

out = {}
def done(name, call):
    try:
        out[name] = call()
    except Exception as error:
        out[name] = type(error).__name__

with Connection.open_serial_port(sys.argv[1]) as connection:
    [device] = connection.detect_devices(identify_devices=False)
    axis = device.get_axis(1)
    axis.home()
    done("renumber", lambda: connection.renumber_devices(1))
    done("own speed", lambda: axis.generic_command("move abs 20000 30000 500").data)
    axis.wait_until_idle()
    out["there"] = axis.get_position()
    done("too fast", lambda: axis.generic_command("move abs 1 999999999").data)
    done("park", lambda: axis.park())
    done("parked", lambda: axis.is_parked())
    done("move parked", lambda: axis.move_absolute(1000))
    done("unpark", lambda: axis.unpark())
    done("disable", lambda: axis.driver_disable())
    done("flags", lambda: sorted(axis.warnings.get_flags()))
    done("move disabled", lambda: axis.move_absolute(1000))
    done("enable", lambda: axis.driver_enable())
    done("move again", lambda: axis.move_absolute(1000))
    done("peripheral", lambda: axis.settings.get("peripheral.id"))
    done("temperature", lambda: device.settings.get("system.temperature"))
    done("count", lambda: axis.settings.get("encoder.count"))
    done("store", lambda: device.storage.set_string("rig.note", "mounted"))
    done("stored", lambda: device.storage.get_string("rig.note"))
    done("erase", lambda: device.storage.erase_key("rig.note"))
    done("gone", lambda: device.storage.get_string("rig.note"))
print(json.dumps(out))
"""


def test_what_else_its_maker_offers(serve):
    stage = serve("stage")
    out = stage.client(FURTHER, stage.server.ports["stage"]["port"])
    assert out["renumber"] == 1, out
    assert out["own speed"] == "0" and out["there"] == 20000 and out["too fast"] == "BadDataException"
    assert out["parked"] is True and out["move parked"] == "CommandFailedException"
    assert "FO" in out["flags"] and out["move disabled"] not in ("none", None)
    assert out["move again"] is None and out["peripheral"] == 0 and out["temperature"] == 33.4
    assert abs(out["count"] * 0.5 - 1000 * 0.49609375) < 10.0  # the screw is off by some micrometres
    assert out["stored"] == "mounted" and out["erase"] is True and out["gone"] == "NoValueForKeyException"


def test_it_notices_a_stage_that_lost_its_reference(serve):
    stage = serve("stage", stage={"referenced_at_start": True})
    script = """
import json, sys, time
from zaber_motion.ascii import Connection
from zaber_motion.exceptions import RequestTimeoutException
with Connection.open_serial_port(sys.argv[1]) as connection:
    axis = connection.get_device(1).get_axis(1)
    out = [axis.is_homed()]
    connection.generic_command_no_response("system reset", 1)
    for _ in range(30):  # deaf while it starts anew
        try:
            out.append(axis.is_homed())
            break
        except RequestTimeoutException:
            time.sleep(0.1)
print(json.dumps(out))
"""
    assert stage.client(script, stage.server.ports["stage"]["port"]) == [True, False]
