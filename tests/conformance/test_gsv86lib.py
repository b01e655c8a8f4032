"""The vendor's gsv86lib on the simulated load cell."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.conformance

TOUR = """
import json, os, sys, time
from gsv86lib import gsv86

def error_of(call):
    try:
        call()
    except Exception as error:
        return str(error)
    return "none"

cell = gsv86(sys.argv[1], 230400)  # stops the stream that it finds
out = {"rate": [cell.readDataRate()]}
cell.writeDataRate(200.0)
out["rate"].append(cell.readDataRate())
out["too fast"] = error_of(lambda: cell.writeDataRate(1e6))
cell.setTXmodefloat()
value = cell.ReadValue()
out["mV/V"] = value.getChannel1()
out["overload"] = value.isInputOverload()
out["range"] = cell.getInputType(1, 0xFF)[2]
cell.setUserScaleBySensor(1, 0.5, 2.0)  # 0.5 N at 2 mV/V
out["newton"] = cell.ReadValue().getChannel1()
cell.SetZero(1)
out["zeroed"] = cell.ReadValue().getChannel1()
cell.ReadMultiple()
start = time.monotonic()
cell.StartTransmission()
time.sleep(3.0)
cell.StopTransmission()
out["seconds"] = time.monotonic() - start
time.sleep(0.2)
frames = cell.ReadMultiple()
out["frames"] = len(frames)
out["channels"] = len(frames[0][1])
out["stream"] = [frame[1]["channel0"] for frame in frames]
print(json.dumps(out), flush=True)
os._exit(0)  # its threads never end
"""


LINES = """
import json, os, sys
from gsv86lib import gsv86

cell = gsv86(sys.argv[1], 230400)
out = {}
def done(name, call):
    try:
        out[name] = call()
    except Exception as error:
        out[name] = f"{type(error).__name__}: {error}"

done("direction", lambda: cell.getDIOdirection(1))
done("is output", lambda: cell.isDIOgroupOutput(1))
done("is input", lambda: cell.isDIOgroupInput(1))
done("type", lambda: cell.getDIOtype(16))
done("level", lambda: cell.getDIOlevel(1))
done("high", lambda: cell.isPinHigh(1))
done("low", lambda: cell.isPinLow(1))
done("initial", lambda: cell.getDIOinitialLevel(3))
done("lower", lambda: cell.readLowerDIOthreshold(2))
done("upper", lambda: cell.readUpperDIOthreshold(2))
done("temperature", lambda: cell.get1wireTempValue())
done("no such pin", lambda: cell.getDIOlevel(17))
print(json.dumps(out), flush=True)
os._exit(0)
"""


def test_its_digital_lines(serve):
    served = serve("force")
    out = served.client(LINES, served.server.ports["force"]["port"])
    assert out["is output"] is False and out["is input"] is True, out
    assert out["type"] == {"DIOtype": 0, "assignedDMSchannel": 0}
    assert (out["level"], out["initial"], out["lower"], out["upper"]) == (0, 0, 0.0, 0.0)
    assert out["high"] is False and out["low"] is True
    assert out["temperature"] == 23.5 and "GSV_CommunicationException" in out["no such pin"]


def test_it_configures_and_streams(serve):
    served = serve("force", force={"noise_fraction": 0.001, "zero_offset_mV_per_V": 0.4})
    out = served.client(TOUR, served.server.ports["force"]["port"])
    noise = 0.001 * 2.0  # mV/V
    assert out["rate"] == [100.0, 200.0]
    assert "0x54" in out["too fast"]
    assert out["mV/V"] == pytest.approx(0.4, abs=5 * noise)
    assert out["overload"] is False
    assert out["range"] == 350
    # the library scales capacity / sensitivity x range: that must come out as newtons
    assert out["newton"] == pytest.approx(0.4 / 2.0 * 0.5, abs=5 * noise / 2.0 * 0.5)
    assert out["zeroed"] == pytest.approx(0.0, abs=5 * noise / 2.0 * 0.5)
    assert out["channels"] == 8
    assert out["frames"] == pytest.approx(200 * out["seconds"], abs=0.05 * 200 * out["seconds"])
    assert max(map(abs, out["stream"])) < 6 * noise / 2.0 * 0.5
