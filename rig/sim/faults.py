"""What can go wrong with a wire: each message is lost, late, torn, glued, doubled or damaged, by seeded chance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rig.sim.truth import Fault
from rig.sim.wire import Frame

DELAY_S = 0.5  # default of a delay
SPLIT_S = 0.02  # default of the gap in a split message


class Upset:
    """The wire faults of one direction of one wire, in the order they were injected."""

    def __init__(self) -> None:
        self._faults: list[tuple[Fault, np.random.Generator]] = []
        self._held = b""

    def add(self, fault: Fault, rng: np.random.Generator) -> None:
        self._faults.append((fault, rng))

    def remove(self, fault: Fault) -> None:
        self._faults = [entry for entry in self._faults if entry[0] is not fault]

    def __len__(self) -> int:
        return len(self._faults)

    def on_line(self, data: bytes, t: float) -> Sequence[tuple[float, bytes]]:
        """What becomes of a message on a serial line."""
        messages = [(t, data)]
        for fault, rng in self._faults:
            messages = [part for start, message in messages for part in self._one(fault, rng, start, message)]
        return messages

    def _one(self, fault: Fault, rng: np.random.Generator, t: float, message: bytes) -> list[tuple[float, bytes]]:
        if fault.kind == "merge" and self._held:  # goes out in one piece with this message
            held, self._held = self._held, b""
            return [(t, held + message)]
        if rng.random() >= fault.probability:
            return [(t, message)]
        match fault.kind:
            case "delay":
                return [(t + (DELAY_S if fault.value is None else fault.value), message)]
            case "split" if len(message) > 1:
                cut = int(rng.integers(1, len(message)))
                gap = SPLIT_S if fault.value is None else fault.value
                return [(t, message[:cut]), (t + gap, message[cut:])]
            case "merge":
                self._held = message
            case "duplicate":
                return [(t, message)] * 2
            case "corrupt":
                return [(t, _damaged(message, rng))]
            case "split":
                return [(t, message)]
        return []  # drop, silent

    def on_bus(self, frame: Frame, t: float) -> Sequence[tuple[float, Frame]]:
        """What becomes of a frame on CAN."""
        frames = [(t, frame)]
        for fault, rng in self._faults:
            frames = [
                (late, (identifier, piece))
                for start, (identifier, data) in frames
                for late, piece in self._one(fault, rng, start, data)
            ]
        return frames


def _damaged(message: bytes, rng: np.random.Generator) -> bytes:
    """One bit of one byte turned over."""
    if not message:
        return message
    damaged = bytearray(message)
    damaged[int(rng.integers(len(message)))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)
