"""What a conversation with an iseg module is made of: reads, with the writes that go out before them."""

from __future__ import annotations

from collections.abc import Generator
from enum import IntFlag
from typing import TypeVar

from drivers.dialogue import Answer, Ask
from drivers.instruments.iseg_edcp.codec import SERIAL_NUMBER, STATUS_BIT_5, Data, Item, Message, Value
from drivers.links.link import CanFrame, DeviceRefused

T = TypeVar("T")

ATTEMPTS = 3
SURVEY_S = 1.0  # how often the other channels of the module are looked at
EMERGENCY_OFTEN, EMERGENCY_SELDOM_S = 50, 0.1  # ... after so many at this one
EMERGENCY_LOOKS = 5
EMERGENCY_AGAIN_S = 0.01  # an emergency off that is not confirmed goes out again at this interval
SWITCH_ON_LOOKS, SWITCH_ON_WAIT_S = 5, 0.02


class Exchange:
    """A read, with writes that go out before it: each time, or (``once``) only with its first transmission."""

    def __init__(
        self, item: Item, channel: int | None, writes: tuple[CanFrame, ...] = (), *, once: bool = False
    ) -> None:
        self.item = item
        self.channel = channel
        self.writes = writes
        self.once = once
        self.everyone: set[int] = set()  # channels to be read at once with one request

    def __str__(self) -> str:
        return self.item.title + ("" if self.channel is None else f" of channel {self.channel}")


Script = Generator[Ask[Exchange], Answer[Message], T]


def value_of(answer: Answer[Message]) -> Value:
    assert isinstance(answer.message, Data)
    return answer.message.value


def names_of(flags: IntFlag) -> str:
    return " ".join(str(flag.name) for flag in flags)


def check_arguments(where: str, module: int, channel: int, poll_rate_Hz: float, status_bit_5: str) -> None:
    """Refuse what no module can have."""
    if not 0 <= module <= 63:
        raise DeviceRefused(where, f"module number {module} does not exist", "Allowed: 0 to 63.")
    if not 0 <= channel <= 255:
        raise DeviceRefused(where, f"channel {channel} does not exist", "Allowed: 0 to 255, as the module has them.")
    if not 0 < poll_rate_Hz <= 100:
        raise DeviceRefused(where, f"poll rate {poll_rate_Hz} Hz is not possible", "Allowed: above 0, at most 100.")
    if status_bit_5 not in STATUS_BIT_5:
        allowed = ", ".join(STATUS_BIT_5)
        raise DeviceRefused(where, f"status_bit_5 {status_bit_5!r} is not known", f"Allowed: {allowed}.")


def judge_second(where: str, module: int, serial: str, message: Data) -> None:
    """A late answer is the same again; another serial number is another module's."""
    if message.item is SERIAL_NUMBER and serial not in ("", f"{message.value!s}"):
        raise DeviceRefused(
            where,
            f"two modules answer as {module}, serial numbers {serial} and {message.value!s}",
            "Give each its own address, one at a time on the bus.",
        )
