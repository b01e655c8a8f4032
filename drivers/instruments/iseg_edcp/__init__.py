"""High-voltage supplies of iseg on CAN: keys in a scene, how one is found and replayed."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from drivers.instrument import Instrument
from drivers.instruments.iseg_edcp.codec import (
    CHANNEL_COUNT,
    FIRMWARE_NAME,
    FIRMWARE_RELEASE,
    SERIAL_NUMBER,
    Data,
    Decoder,
    Item,
    LogOn,
    Value,
    identity,
    read_request,
)
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.link import CanFrame
from drivers.probe import Answered, BusProbe, Network
from drivers.recorded import Frames
from drivers.settings import CanSettings, SupplySettings


class IsegSettings(SupplySettings, CanSettings):
    """One channel of an iseg supply that speaks EDCP on CAN."""

    measures_current: ClassVar[bool] = True
    asks_per_sample: ClassVar[int] = 6

    driver: Literal["iseg-edcp"] = Field(description="iseg high-voltage supply, EDCP on CAN.")
    module: int = Field(default=0, ge=0, le=63, description="Module number on the bus.")
    channel: int = Field(default=0, ge=0, le=23, description="Channel of the module that the film is connected to.")
    max_ramp_percent_per_s: float = Field(
        default=20.0,
        gt=0,
        le=100,
        description="Fastest voltage ramp that the module takes, in percent of its nominal voltage per second.",
    )
    status_bit_5: Literal["unused", "limit good", "input error"] = Field(
        default="unused",
        description="What bit 5 of the module status says: nothing on most modules; that the hardware voltage limit is "
        "good on distributor modules with current mirror (EHQ); an input error on some others. See its manual.",
    )
    poll_rate_Hz: float = Field(
        default=10.0, gt=0, le=50, description="How often voltage, current and status are read (Hz). Typical: 10."
    )


def _ask(network: Network) -> list[Answered]:
    decoders = {module: Decoder(module) for module in range(64)}
    requests = [read_request(module, SERIAL_NUMBER) for module in decoders]
    modules: set[int] = set()
    for frame in network.ask_all([request for request in requests if request.id not in network.process_data]):
        message = decoders[_module_of(frame)].feed(frame)
        if isinstance(message, Data) and message.item == SERIAL_NUMBER:
            modules.add(_module_of(frame))
    return [_identified(network, module) for module in sorted(modules)]


def _hear(network: Network, frame: CanFrame) -> Answered | None:
    module = _module_of(frame)
    return _identified(network, module) if isinstance(Decoder(module).feed(frame), LogOn) else None


def _module_of(frame: CanFrame) -> int:
    return frame.id >> 3 & 0x3F


def _identified(network: Network, module: int) -> Answered:
    decoder = Decoder(module)

    def value(item: Item) -> Value | None:
        def pick(frame: CanFrame) -> Data | None:
            message = decoder.feed(frame)
            return message if isinstance(message, Data) and message.item == item else None

        data = network.ask(read_request(module, item), pick)
        return None if data is None else data.value

    found = identity(*[value(item) for item in (SERIAL_NUMBER, FIRMWARE_RELEASE, FIRMWARE_NAME)])
    channels = value(CHANNEL_COUNT)
    remark = f"module {module}" + (f", {channels} channels" if isinstance(channels, int) and channels > 1 else "")
    return Answered(found, {"module": module, "channel": 0, "serial": found.serial}, remark)


INSTRUMENTS = (
    Instrument(
        driver="iseg-edcp",
        role="hv",
        settings=IsegSettings,
        device=IsegEDCP,
        dialect=Frames(),
        probe=BusProbe(_ask, _hear, order=20),
    ),
)
