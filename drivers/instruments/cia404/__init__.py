"""Load cells on CANopen by device profile CiA 404: keys in a scene, how one is found and replayed."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from drivers.instrument import Instrument
from drivers.instruments.cia404.codec import PROFILE, Aborted, Decoder, Uploaded, identity, upload_request
from drivers.instruments.cia404.device import CiA404
from drivers.links.link import CanFrame
from drivers.probe import FORCE_CERTIFICATE, Answered, BusProbe, Network
from drivers.recorded import Frames
from drivers.roles import Identity
from drivers.settings import CanSettings, ForceSettings, Positive


class CiA404Settings(ForceSettings, CanSettings):
    """A load cell on CANopen by device profile CiA 404; its certificate corrects the newtons that it states."""

    asks_per_sample: ClassVar[int] = 0

    driver: Literal["cia404"] = Field(description="Load cell on CANopen, device profile CiA 404.")
    node: int = Field(default=1, ge=1, le=127, description="Node number on the bus.")
    channel: int = Field(default=1, ge=1, le=199, description="Analogue input with the load cell.")
    rate_Hz: float = Field(
        default=100.0, gt=0, le=1000, description="Samples per second (Hz): 1000 / n, n a whole number of milliseconds."
    )
    unit: Literal["N", "mV/V"] | None = Field(
        default=None,
        description="For a device that states neither newtons nor mV/V: what its values are once multiplied by factor.",
    )
    factor: float = Field(default=1.0, description="What the device's values are multiplied by, given with unit.")
    limit_N: Positive = Field(
        default=1e4,
        description="Largest force that is believed (N); set it to some times the capacity of the cell.",
    )

    @model_validator(mode="after")
    def _factor_has_a_unit(self) -> Self:
        if self.unit is None and self.factor != 1.0:
            raise ValueError("factor is given without unit: say what the values are, multiplied by it")
        if self.factor == 0.0:
            raise ValueError("factor must not be 0")
        return self


def _ask(network: Network) -> list[Answered]:
    nodes = _nodes(network)
    network.process_data |= {base + node for base in (0x200, 0x300) for node in nodes}
    return [_identified(network, node, kind) for node, kind in sorted(nodes.items())]


def _nodes(network: Network) -> dict[int, int]:
    """Device type (object 1000h) by CANopen node; 0 where it could not be told."""
    decoders = {node: Decoder(node) for node in range(1, 128)}
    nodes: dict[int, int] = {}
    for frame in network.ask_all([upload_request(node, 0x1000, 0) for node in decoders]):
        if frame.id & 0x780 == 0x580 and (node := frame.id & 0x7F):
            match decoders[node].feed(frame):
                case Uploaded(0x1000, 0, value):
                    nodes[node] = int.from_bytes(value, "little")
                case Aborted(0x1000, 0):
                    nodes.setdefault(node, 0)
    return nodes


def _identified(network: Network, node: int, kind: int) -> Answered:
    decoder = Decoder(node)

    def identity_object(sub: int) -> int | None:
        def pick(frame: CanFrame) -> tuple[int | None] | None:
            match decoder.feed(frame):
                case Uploaded(0x1018, index, value) if index == sub:
                    return (int.from_bytes(value, "little"),)
                case Aborted(0x1018, index) if index == sub:
                    return (None,)
            return None

        answer = network.ask(upload_request(node, 0x1018, sub), pick)
        return None if answer is None else answer[0]

    found = identity(*[identity_object(sub) for sub in range(1, 5)])
    if kind & 0xFFFF != PROFILE:
        return Answered(found, {}, f"CANopen node {node}, profile {kind & 0xFFFF}: no driver.", usable=False)
    keys: dict[str, str | int] = {"node": node, "serial": found.serial, "certificate": FORCE_CERTIFICATE}
    return Answered(found, keys, f"node {node}")


def _hear(network: Network, frame: CanFrame) -> Answered | None:
    if frame.id & 0x780 == 0x700 and len(frame.data) == 1:
        remark = f"CANopen node {frame.id & 0x7F} is heard but answers no question: it may be stopped."
        return Answered(Identity(), {}, remark, usable=False)
    return None


INSTRUMENTS = (
    Instrument(
        driver="cia404",
        role="force",
        settings=CiA404Settings,
        device=CiA404,
        dialect=Frames(),
        probe=BusProbe(_ask, _hear, order=10),
    ),
)
