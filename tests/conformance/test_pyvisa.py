"""SCPI: pyvisa-py's raw socket against the simulated meter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("pyvisa_py", reason="needs the conformance dependency group")

pytestmark = [pytest.mark.conformance, pytest.mark.timeout(60)]

CLIENT = """
import json, sys
import pyvisa
meter = pyvisa.ResourceManager("@py").open_resource(f"TCPIP::127.0.0.1::{sys.argv[1]}::SOCKET")
meter.read_termination = meter.write_termination = "\\n"
meter.timeout = 2000
said = {"idn": meter.query("*IDN?")}
said["volts"] = [meter.query_ascii_values(query)[0] for query in ("MEAS:VOLT:DC?", "measure:voltage:dc? 10", "READ?")]
meter.write("NO:SUCH:THING?")
said["errors"] = [meter.query("SYST:ERR?"), meter.query("SYST:ERR:NEXT?")]
said["done"] = meter.query("*CLS;*OPC?")
meter.close()
print(json.dumps(said))
"""


def test_it_is_a_meter_to_somebody_elses_client(serve: Callable[..., Any]) -> None:
    served = serve("hv", "monitor", monitor={"driver": "scpi", "noise": 0.0, "zero_offset": 40.0})
    said = served.client(CLIENT, str(served.server.ports["monitor"]["tcp_port"]))
    assert said["idn"] == "ACME,DMM6500,04387,1.7.3"
    assert said["volts"] == pytest.approx([0.04] * 3)
    assert said["errors"] == ['-113,"Undefined header"', '+0,"No error"']
    assert said["done"] == "1"
