"""What a conversation with an iseg module is made of: reads, with the writes that go out before them."""

from __future__ import annotations

from collections.abc import Generator
from enum import IntFlag
from typing import TypeVar

from drivers.dialogue import Answer, Ask
from drivers.instruments.iseg_edcp.codec import Data, Item, Message, Value
from drivers.links.link import CanFrame

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
