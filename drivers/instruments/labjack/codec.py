"""LabJack T4, T7 and T8 on Modbus TCP, port 502: frames and registers.

A frame is ``transaction u16, protocol 0000, length u16, unit u8, function u8, ...``, big-endian, ``length`` counting
what follows it; 32-bit values take two registers, the more significant first::

    0001 0000 0006 01 03 0000 0002            read 2 registers from 0 (AIN0)   -> 0001 0000 0007 01 03 04 <float32>
    0002 0000 000B 01 10 03E8 0002 04 40200000   write 2.5 to 1000 (DAC0)      -> 0002 0000 0006 01 10 03E8 0002
    an answer whose function has bit 7 set is a refusal, with its reason as one byte

Answers come in the order of the requests and bear their transaction number, which tells a late one from the right one.
TCP keeps damage away; a frame that is none is dropped byte by byte and counted.

Sources: Modbus Application Protocol 1.1b3; register numbers from the maker's ``ljm_constants.json`` (2025-12-18);
LabJack T-series datasheet, chapters Modbus, DAC, AIN, Watchdog. Not tried on hardware.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

READ, WRITE = 0x03, 0x10
UNIT = 1
LONGEST = 254  # of what the length counts: unit, and a PDU of at most 253 bytes

REFUSALS = {
    1: "the function is unknown to it",
    2: "there is no such register, or it cannot be written",
    3: "the value is not allowed",
    4: "it failed; its last error is in register 55000",
    5: "it needs longer",
    6: "it is busy",
}

AIN0, AIN0_RANGE = 0, 40_000
DAC0 = 1000
DIO_STATE, DIO_DIRECTION = 2800, 2850
DIO0 = 2000
PRODUCT_ID, FIRMWARE_VERSION, SERIAL_NUMBER, TEST = 60_000, 60_004, 60_028, 55_100
DAC1_SQUARE_WAVE = 61_532
TEST_VALUE = 0x0011_2233

WATCHDOG_ENABLE, WATCHDOG_ADVANCED, WATCHDOG_TIMEOUT_S, WATCHDOG_STARTUP_S = 61_600, 61_602, 61_604, 61_606
WATCHDOG_STRICT, WATCHDOG_KEY, WATCHDOG_CLEAR, WATCHDOG_RESET = 61_610, 61_612, 61_614, 61_620
WATCHDOG_DIO, WATCHDOG_DIO_STATE, WATCHDOG_DIO_DIRECTION, WATCHDOG_DIO_INHIBIT = 61_630, 61_632, 61_634, 61_636
WATCHDOG_DAC0, WATCHDOG_DAC0_VOLTS = 61_640, 61_642  # of DAC1: ten more


class Product(NamedTuple):
    """What a model can do: volts at the end of the DAC's range, its steps, volts at the end of the widest AIN range."""

    name: str
    dac_V: float
    dac_steps: int
    ain_V: float


PRODUCTS = {
    4: Product("LabJack T4", 5.0, 2**10, 10.0),
    7: Product("LabJack T7", 5.0, 2**12, 10.0),
    8: Product("LabJack T8", 10.0, 2**16, 11.0),
}


class Words(NamedTuple):
    """Answer to a read."""

    transaction: int
    data: bytes


class Written(NamedTuple):
    """Answer to a write."""

    transaction: int
    address: int
    registers: int


class Refused(NamedTuple):
    """The request was refused."""

    transaction: int
    function: int
    reason: int

    @property
    def meaning(self) -> str:
        return REFUSALS.get(self.reason, f"reason {self.reason}")


Message = Words | Written | Refused


def read_request(transaction: int, address: int, count: int) -> bytes:
    """Ask for ``count`` registers from ``address`` on."""
    return struct.pack(">HHHBBHH", transaction, 0, 6, UNIT, READ, address, count)


def write_request(transaction: int, address: int, data: bytes) -> bytes:
    """Write ``data``, two bytes a register."""
    count, odd = divmod(len(data), 2)
    if odd or not 1 <= count <= 123:
        raise ValueError(f"{len(data)} bytes are no whole number of registers from 1 to 123")
    head = struct.pack(">HHHBBHHB", transaction, 0, 7 + len(data), UNIT, WRITE, address, count, len(data))
    return head + data


def f32(value: float) -> bytes:
    return struct.pack(">f", value)


def u32(value: int) -> bytes:
    return struct.pack(">I", value)


def u16(value: int) -> bytes:
    return struct.pack(">H", value)


class Decoder:
    """Bytes to messages. Never raises; holds back less than one frame. ``counters``: ``dropped_bytes``."""

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("dropped_bytes", 0)
        self._buffer = b""

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes, in order."""
        buffer, at = self._buffer + data, 0
        messages: list[Message] = []
        while len(buffer) - at >= 6:
            transaction, protocol, length = struct.unpack_from(">HHH", buffer, at)
            if protocol or not 3 <= length <= LONGEST:  # one that claims to be longer is not waited for
                self.counters["dropped_bytes"] += 1
                at += 1
                continue
            if len(buffer) - at < 6 + length:
                break
            message = _message(transaction, buffer[at + 7 : at + 6 + length])
            if message is None:
                self.counters["dropped_bytes"] += 1
                at += 1
                continue
            messages.append(message)
            at += 6 + length
        self._buffer = buffer[at:]
        return messages


def _message(transaction: int, pdu: bytes) -> Message | None:
    function = pdu[0]
    if function == READ and len(pdu) >= 2 and len(pdu) == 2 + pdu[1] and pdu[1] % 2 == 0:
        return Words(transaction, pdu[2:])
    if function == WRITE and len(pdu) == 5:
        return Written(transaction, *struct.unpack(">HH", pdu[1:]))
    if function in (READ | 0x80, WRITE | 0x80) and len(pdu) == 2:
        return Refused(transaction, function & 0x7F, pdu[1])
    return None
