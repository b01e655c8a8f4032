"""LabJack: pymodbus' client against the simulated instrument, and our drivers against pymodbus' server."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("pymodbus", reason="needs the conformance dependency group")

from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.instruments.labjack import PRESETS
from drivers.instruments.labjack.amplifier import LabJackAmplifier
from drivers.instruments.labjack.analog_input import AnalogForce
from drivers.links.link import DeviceRefused
from drivers.links.tcp_link import TcpLink

pytestmark = [pytest.mark.conformance, pytest.mark.timeout(60)]
FLOAT32, UINT32, UINT16 = (ModbusTcpClient.DATATYPE[name] for name in ("FLOAT32", "UINT32", "UINT16"))


# pymodbus' client against the simulated LabJack


@contextmanager
def client_of(port: int) -> Iterator[ModbusTcpClient]:
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=2)
    assert client.connect()
    try:
        yield client
    finally:
        client.close()


def read(client: ModbusTcpClient, address: int, kind: Any = FLOAT32) -> Any:
    answer = client.read_holding_registers(address, count=kind.value[1], device_id=1)
    assert not answer.isError(), answer
    return client.convert_from_registers(answer.registers, kind)


def write(client: ModbusTcpClient, address: int, value: float, kind: Any = FLOAT32) -> None:
    answer = client.write_registers(address, client.convert_to_registers(value, kind), device_id=1)
    assert not answer.isError(), answer


@pytest.fixture
def labjack(serve: Callable[..., Any]) -> Iterator[ModbusTcpClient]:
    served = serve("hv", hv={"driver": "labjack-amplifier"})
    with client_of(int(served.server.ports["hv"]["tcp_port"])) as client:
        yield client


def test_it_states_itself_in_the_words_of_the_map(labjack: ModbusTcpClient) -> None:
    assert read(labjack, 60_000) == 7.0
    assert read(labjack, 55_100, UINT32) == 0x0011_2233
    assert read(labjack, 60_028, UINT32) == 470_010_000


def test_the_dac_is_clamped_and_read_back(labjack: ModbusTcpClient) -> None:
    write(labjack, 1000, 0.05)
    assert read(labjack, 1000) == pytest.approx(0.05, abs=5 / 4096)
    write(labjack, 1000, 6.0)
    assert read(labjack, 1000) == pytest.approx(5.0, abs=2 * 5 / 4096)
    write(labjack, 1000, 0.0)


def test_the_output_follows_only_when_enabled(labjack: ModbusTcpClient) -> None:
    write(labjack, 1000, 0.5)
    time.sleep(0.3)
    assert read(labjack, 0) == pytest.approx(0.0, abs=0.01)  # the line floats high: disabled
    write(labjack, 2000, 0, UINT16)
    time.sleep(0.3)
    assert read(labjack, 0) == pytest.approx(0.5, abs=0.01)
    write(labjack, 2000, 1, UINT16)
    time.sleep(0.5)
    assert read(labjack, 0) == pytest.approx(0.0, abs=0.01)


def test_what_is_not_there_is_refused_with_its_code(labjack: ModbusTcpClient) -> None:
    for address, count, code in ((12_345, 2, 2), (1000, 1, 3)):
        answer = labjack.read_holding_registers(address, count=count, device_id=1)
        assert answer.isError() and answer.exception_code == code


def test_the_watchdog_acts_when_its_key_does_not_come(labjack: ModbusTcpClient) -> None:
    for address, value in ((61_604, 1), (61_610, 1), (61_612, 77), (61_640, 1)):
        write(labjack, address, value, UINT32)
    write(labjack, 61_642, 0.0)
    write(labjack, 1000, 0.5)
    write(labjack, 61_600, 1, UINT32)
    for _ in range(6):  # kept from acting by the key, and by nothing else
        time.sleep(0.25)
        write(labjack, 61_614, 77, UINT32)
    assert read(labjack, 1000) == pytest.approx(0.5, abs=2e-3)
    for _ in range(6):
        time.sleep(0.25)
        write(labjack, 61_614, 78, UINT32)
        read(labjack, 0)
    assert read(labjack, 1000) == 0.0
    refused = labjack.write_registers(61_604, labjack.convert_to_registers(5, UINT32), device_id=1)
    assert refused.isError()  # its settings cannot be changed while it runs


# Our drivers against pymodbus' server


def floats(*values: float) -> list[int]:
    return list(struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}f", *values)))


def words(value: int) -> list[int]:
    return list(struct.unpack(">2H", struct.pack(">I", value)))


REGISTERS = {
    0: floats(0.0, 0.001, 2.5, 0.0),
    1000: floats(0.0, 0.0),
    2000: [1],
    2800: words(1),
    2850: words(1),
    40_000: floats(10.0, 10.0, 10.0, 10.0),
    55_100: words(0x0011_2233),
    60_000: floats(7.0),
    60_004: floats(1.0292),
    60_028: words(470_099_999),
    **{address: words(0) for address in (*range(61_600, 61_608, 2), 61_610, 61_612, 61_614, 61_620)},
    **{address: words(0) for address in (61_630, 61_632, 61_634, 61_636, 61_640, 61_642)},
}


class Foreign:
    """pymodbus' server with a LabJack's registers, in a thread."""

    def __init__(self) -> None:
        self.port = 0
        self._ready = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(10)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)

        async def serve() -> None:
            blocks = [SimData(at, values=found, datatype=DataType.REGISTERS) for at, found in sorted(REGISTERS.items())]
            self.server = ModbusTcpServer(SimDevice(1, simdata=blocks), address=("127.0.0.1", 0))
            await self.server.listen()
            self.port = self.server.transport.sockets[0].getsockname()[1]
            self._ready.set()
            await self.server.serving

        self._loop.run_until_complete(serve())
        self._loop.close()

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self.server.shutdown(), self._loop).result(10)
        self._thread.join(10)


@pytest.fixture
def foreign() -> Iterator[Foreign]:
    server = Foreign()
    yield server
    server.close()


def poll(device: Any, seconds: float, until: Callable[[], bool] = lambda: False) -> list[Any]:
    samples: list[Any] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end and not until():
        samples += device.poll(time.monotonic())
        time.sleep(0.001)
    return samples


def test_a_sensor_reads_its_input(foreign: Foreign) -> None:
    force = AnalogForce("force", TcpLink("force", "127.0.0.1", foreign.port), newtons_per_V=0.2)
    samples = poll(force, 1.5)
    force.close()
    assert force.identity.model == "LabJack T7" and force.identity.serial == "470099999"
    assert len(samples) > 20 and all(sample.reading == pytest.approx(0.5) for sample in samples)
    assert not {key for key in ("unexpected_replies", "dropped_bytes", "retries") if force.counters[key]}


def test_the_supply_sets_up_and_refuses_a_dead_monitor(foreign: Foreign) -> None:
    link = TcpLink("hv", "127.0.0.1", foreign.port)
    supply = LabJackAmplifier("hv", link, amplifier=PRESETS["trek-610e"], settle_s=0.05)
    poll(supply, 5.0, lambda: supply.ready)
    assert supply.ready and supply.nominal == pytest.approx((5000.0, 2e-3))
    with client_of(foreign.port) as look:
        assert read(look, 1000) == 0.0 and read(look, 61_600, UINT32) == 0  # nothing has been changed
        supply.set_voltage(500.0)
        supply.switch_on()
        with pytest.raises(DeviceRefused, match="dead or unplugged"):
            poll(supply, 10.0)
        assert read(look, 1000) == 0.0
        assert read(look, 61_600, UINT32) == 1 and read(look, 61_610, UINT32) == 1  # the watchdog is armed, strict
        assert read(look, 61_604, UINT32) == 3 and read(look, 61_640, UINT32) == 1 and read(look, 61_642) == 0.0
    supply.close()
