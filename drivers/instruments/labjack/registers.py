"""Reading and writing registers of a LabJack in a dialogue: what every device on one has in common."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from drivers.dialogue import Answer, Ask, Dialogue, label
from drivers.heard import Heard
from drivers.instruments.labjack.codec import (
    AIN0,
    AIN0_RANGE,
    FIRMWARE_VERSION,
    PRODUCT_ID,
    PRODUCTS,
    SERIAL_NUMBER,
    TEST,
    TEST_VALUE,
    Decoder,
    Message,
    Product,
    Refused,
    Words,
    Written,
    f32,
    read_request,
    write_request,
)
from drivers.links.link import ByteLink, DeviceRefused
from drivers.roles import Identity

T = TypeVar("T")
RAIL = 0.999  # a voltage beyond this part of an input's range is over range


@dataclass(frozen=True, slots=True)
class Request:
    """Read ``count`` registers, or write ``data``."""

    address: int
    count: int = 2
    data: bytes = b""

    def __str__(self) -> str:
        return f"{'write' if self.data else 'read'} of register {self.address}"


Part = Generator[Ask[Request], Answer[Message], T]
Script = Part[None]


class Registers:
    """Registers of one LabJack over one connection."""

    def __init__(
        self, name: str, link: ByteLink, counters: dict[str, int], timeout_s: float, boot_s: float = 0.0
    ) -> None:
        self.label = label(name, link)
        self._link = link
        self._counters = counters
        counters.setdefault("unexpected_replies", 0)
        self._decoder = Decoder(counters)
        self._boot_s = boot_s
        self._heard = Heard()
        self._transaction = 0
        self.dialogue: Dialogue[Request, Message] = Dialogue(
            self.label,
            self._send,
            counters,
            timeout_s=timeout_s,
            advice="Check that it is switched on, its network cable and its address.",
            heard=self._heard,
        )

    def take_in(self, now: float) -> None:
        """Read the link and give what came to the dialogue."""
        for message in self._decoder.feed(self._heard.bytes(self._link.read())):
            if not self.dialogue.offer(message, now):
                self._counters["unexpected_replies"] += 1

    def send_now(self, address: int, data: bytes) -> None:
        """Write a register at once, whatever is under way; its answer fits nothing and is dropped."""
        self._link.write(write_request(self._next(), address, data))

    def _next(self) -> int:
        self._transaction = self._transaction % 0xFFFF + 1
        return self._transaction

    def _send(self, request: Request) -> Callable[[Message], bool]:
        transaction = self._next()
        if request.data:
            self._link.write(write_request(transaction, request.address, request.data))
            size = len(request.data) // 2

            def answers(message: Message) -> bool:
                if isinstance(message, Refused):
                    return message.transaction == transaction
                return message == Written(transaction, request.address, size)

            return answers
        self._link.write(read_request(transaction, request.address, request.count))

        def fits(message: Message) -> bool:
            if message.transaction != transaction:
                return False
            return isinstance(message, Refused) or (
                isinstance(message, Words) and len(message.data) == 2 * request.count
            )

        return fits

    def _answered(self, request: Request, delay_s: float = 0.0, boot_s: float = 0.0) -> Part[Answer[Message]]:
        answer = yield Ask(request, delay_s=delay_s, boot_s=boot_s)
        if isinstance(answer.message, Refused):
            raise DeviceRefused(
                self.label, f"{request} refused: {answer.message.meaning}", "Check its model and its firmware version."
            )
        return answer

    def write(self, address: int, data: bytes) -> Part[None]:
        yield from self._answered(Request(address, data=data))

    def floats(self, address: int, count: int = 1, delay_s: float = 0.0) -> Part[tuple[tuple[float, ...], float]]:
        """(values, time) of ``count`` float32 in a row."""
        answer = yield from self._answered(Request(address, 2 * count), delay_s)
        assert isinstance(answer.message, Words)
        return struct.unpack(f">{count}f", answer.message.data), answer.t

    def number(self, address: int) -> Part[float]:
        values, _ = yield from self.floats(address)
        return values[0]

    def whole(self, address: int, boot_s: float = 0.0) -> Part[int]:
        """A 32-bit register."""
        answer = yield from self._answered(Request(address, 2), boot_s=boot_s)
        assert isinstance(answer.message, Words)
        return int(struct.unpack(">I", answer.message.data)[0])

    def identify(self, settings: dict[str, str]) -> Part[tuple[Identity, Product]]:
        """Prove that it is a LabJack whose words come in the expected order, and say which."""
        test = yield from self.whole(TEST, self._boot_s)
        if test != TEST_VALUE:
            raise DeviceRefused(
                self.label,
                f"register {TEST} holds {test:08X} in place of {TEST_VALUE:08X}",
                "This is no LabJack of the T series: check the address.",
            )
        number = yield from self.number(PRODUCT_ID)
        product = PRODUCTS.get(round(number)) if number == round(number) else None
        if product is None:
            raise DeviceRefused(self.label, f"product {number:g} is not known", "Known are the T4, T7 and T8.")
        serial = yield from self.whole(SERIAL_NUMBER)
        firmware = yield from self.number(FIRMWARE_VERSION)
        settings |= {"product": product.name, "firmware": f"{firmware:.4f}"}
        return Identity(product.name, str(serial), f"{firmware:.4f}"), product

    def widest_range(self, ain: int, product: Product, settings: dict[str, str]) -> Part[float]:
        """Set an input to its widest range, if it is not, and give what it then has (V)."""
        address = AIN0_RANGE + 2 * ain
        found = yield from self.number(address)
        if abs(found - product.ain_V) > 0.05 * product.ain_V:
            yield from self.write(address, f32(product.ain_V))
            found = yield from self.number(address)
        if not 0 < found <= 24:
            raise DeviceRefused(self.label, f"AIN{ain} has a range of {found:g} V", "Choose another input.")
        settings[f"AIN{ain}_range_V"] = f"{found:g}"
        return found

    def inputs(self, first: int, second: int | None, delay_s: float = 0.0) -> Part[tuple[float, float, float]]:
        """(volts at the first input, volts at the second or NaN, time)."""
        if second is not None and second == first + 1:
            (one, two), t = yield from self.floats(AIN0 + 2 * first, 2, delay_s)
            return one, two, t
        (one,), t = yield from self.floats(AIN0 + 2 * first, 1, delay_s)
        if second is None:
            return one, float("nan"), t
        (two,), _ = yield from self.floats(AIN0 + 2 * second)
        return one, two, t
