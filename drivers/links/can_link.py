"""CAN bus through python-can, as a `drivers.links.link.FrameLink`: never waits, survives garbage, says when the bus is
gone.

python-can is imported when a bus is opened, not before. No thread, no Notifier, no periodic sending: frames move only
when the owner calls ``read`` or ``write``.
"""

from __future__ import annotations

import contextlib
import logging
from collections import deque
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from drivers.links.link import CanFrame, DeviceLost, DeviceRefused
from drivers.links.serial_link import PortLock

if TYPE_CHECKING:
    import can

INTERFACES = ("socketcan", "slcan", "pcan", "vector", "virtual", "udp_multicast")

SHARED = ("socketcan", "udp_multicast")
"""Interfaces that several programs of one computer may open at once."""

# What an interface needs beyond channel and bit rate. slcan: python-can would sleep 2 s after opening for boards that
# reset, and wait 1 ms at each look for input. vector: channels are counted over all its adapters. udp_multicast: frames
# stay on this computer. virtual and udp_multicast have no bit rate; socketcan has its own from the system.
_OPTIONS: dict[str, dict[str, Any]] = {
    "slcan": {"sleep_after_open": 0, "timeout": 0},
    "vector": {"app_name": None},
    "udp_multicast": {"hop_limit": 0, "fd": False},
}
_WITHOUT_BITRATE = {"socketcan", "virtual", "udp_multicast"}

_ADVICE = {
    "socketcan": "It is Linux only; bring it up first: ip link set can0 up type can bitrate 125000.",
    "slcan": "The channel is the adapter's serial port; check that nothing else uses it.",
    "pcan": "Install PEAK's PCAN-Basic driver; channels are named PCAN_USBBUS1 and so on.",
    "vector": "It needs Windows and Vector's XL driver library; the channel is a number, from 0.",
    "udp_multicast": "It needs the package msgpack (extra `multicast`), and a multicast address such as 239.74.163.2.",
}

_NOWHERE = logging.NullHandler()
_BUS_OFF = 0x40  # SocketCAN's error class CAN_ERR_BUSOFF in the identifier of an error frame
_MOST_LOOKS = 4096  # in one read: some 4 s of a full 125 kbit/s bus
# pyserial takes a process that was kept waiting for the processor for a port that takes no data, although all has gone.
_SEND_TIMEOUT_S = 0.5


class CanLink:
    """One CAN interface.

    Counters: ``frames_read``, ``frames_written``, ``foreign_frames`` (identifier not in ``accept``, or not a classic
    11-bit data frame), ``error_frames``, ``own_echoes`` (what udp_multicast brings back to its sender) and ``garbage``
    (what the interface could not make a frame of).

    Frames on slcan carry no checksum between adapter and host: a corrupted hexadecimal digit is a different frame. What
    is not hexadecimal, or shorter than its length says, is dropped and counted.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for error messages; the link's own ``name`` is interface and channel.
    interface : str
        One of `INTERFACES`: which python-can backend.
    channel : str
        "can0" (socketcan), a serial port (slcan), "PCAN_USBBUS1" (pcan), a number (vector), any name (virtual), a
        multicast address (udp_multicast).
    bitrate : int
        Bits per second.
    accept : collection of int, optional
        Identifiers to pass on; all if it is left out.
    **options
        Passed to python-can, for interfaces with needs of their own (``app_name`` for vector, say).
    """

    def __init__(
        self,
        name: str,
        interface: str,
        channel: str,
        bitrate: int = 125_000,
        *,
        accept: Collection[int] | None = None,
        **options: Any,
    ) -> None:
        self.name = f"{interface} {channel}"
        self.counters = dict.fromkeys(
            ("frames_read", "frames_written", "foreign_frames", "error_frames", "own_echoes", "garbage"), 0
        )
        self._where = f"{name} ({self.name})"
        self._accept = None if accept is None else frozenset(accept)
        self._echoing = interface == "udp_multicast"
        self._sent: deque[CanFrame] = deque(maxlen=_MOST_LOOKS)  # whose echo has not come yet
        self._lock: PortLock | None = None
        self._bus: can.BusABC | None = self._open(interface, channel, bitrate, options)

    def _open(self, interface: str, channel: str, bitrate: int, options: dict[str, Any]) -> can.BusABC:
        if interface not in INTERFACES:
            raise DeviceRefused(
                self._where, f"there is no CAN interface {interface!r}", f"Allowed: {', '.join(INTERFACES)}."
            )
        import can

        _quiet()
        options = _OPTIONS.get(interface, {}) | options
        if interface not in _WITHOUT_BITRATE:
            options["bitrate"] = bitrate
        # Another program on the same adapter would be heard and answered as if it were us.
        self._lock = PortLock(self._where, channel.partition("@")[0]) if interface == "slcan" else None
        try:
            return can.Bus(
                channel=channel, interface=interface, ignore_config=True, receive_own_messages=False, **options
            )
        except can.CanInterfaceNotImplementedError as error:  # python-can's word for a backend that is not installed
            self._release()
            raise DeviceRefused(
                self._where,
                f"the CAN interface cannot be used here ({error})",
                _ADVICE.get(interface, ""),
            ) from error
        except (can.CanError, OSError, ValueError, TypeError) as error:
            self._release()
            raise DeviceLost(
                self._where,
                f"the CAN channel cannot be opened ({error})",
                _ADVICE.get(interface, ""),
            ) from error

    def read(self) -> list[CanFrame]:
        """All frames that have arrived; raises `DeviceLost` when the bus is gone or off."""
        bus = self._open_bus()
        frames: list[CanFrame] = []
        for _ in range(_MOST_LOOKS):
            try:
                message = bus.recv(0)
            except Exception as error:
                self.counters["garbage"] += 1
                self._survive(bus, error)
                continue
            if message is not None:
                if (frame := self._frame(message)) is not None:
                    frames.append(frame)
            # python-can also returns nothing for an adapter's acknowledgement, with frames waiting behind it.
            elif not self._more_waits(bus):
                break
        self.counters["frames_read"] += len(frames)
        if _state(bus) == "ERROR":
            raise self._lost("the CAN controller is bus-off")
        return frames

    def write(self, frame: CanFrame) -> None:
        """Send one frame; raises `DeviceLost` when it cannot be sent."""
        import can

        bus = self._open_bus()
        if self._echoing:
            self._sent.append(frame)
        try:
            bus.send(
                can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False, check=True),
                timeout=_SEND_TIMEOUT_S,
            )
        except (can.CanError, OSError) as error:
            raise self._lost(f"a frame cannot be sent ({error})") from error
        self.counters["frames_written"] += 1

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            # A port that has vanished cannot be closed in order, but must be let go of.
            with contextlib.suppress(Exception):
                bus.shutdown()
            with contextlib.suppress(Exception):
                _serial_port(bus).close()
        self._release()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()

    def _open_bus(self) -> can.BusABC:
        if self._bus is None:
            raise self._lost("the CAN channel is closed")
        return self._bus

    def _lost(self, what: str) -> DeviceLost:
        return DeviceLost(self._where, what, "Check adapter, cable, termination and bit rate, then start again.")

    def _frame(self, message: can.Message) -> CanFrame | None:
        if message.is_error_frame:
            self.counters["error_frames"] += 1
            if message.arbitration_id & _BUS_OFF:
                raise self._lost("the CAN controller is bus-off")
            return None
        if message.is_remote_frame or message.is_fd or message.is_extended_id or message.arbitration_id > 0x7FF:
            self.counters["foreign_frames"] += 1
            return None
        data = bytes(message.data)
        if len(data) != message.dlc or len(data) > 8:
            self.counters["garbage"] += 1
            return None
        if self._accept is not None and message.arbitration_id not in self._accept:
            self.counters["foreign_frames"] += 1
            return None
        frame = CanFrame(message.arbitration_id, data)
        return None if self._echoing and self._is_echo(frame) else frame

    def _is_echo(self, frame: CanFrame) -> bool:
        """Whether a frame is one that was sent from here. Echoes come in order, and before any answer to them."""
        if frame not in self._sent:
            return False
        while self._sent.popleft() != frame:
            pass  # the echoes of these got lost
        self.counters["own_echoes"] += 1
        return True

    def _survive(self, bus: can.BusABC, error: Exception) -> None:
        """Go on after garbage; raise `DeviceLost` when the port has vanished.

        python-can's slcan wraps everything in CanOperationError. A byte that is not ASCII stays in its line buffer
        and fails every later read until the buffer is flushed.
        """
        cause = error.__cause__ or error
        if self._echoing and cause is not error and not isinstance(cause, OSError):
            return  # any program may send any datagram to the group
        if isinstance(cause, UnicodeDecodeError):
            with contextlib.suppress(Exception):
                bus.flush()  # type: ignore[attr-defined]
                return
        elif isinstance(cause, (ValueError, IndexError, KeyError)):
            return
        raise self._lost(f"the CAN channel is gone ({cause})") from error

    def _more_waits(self, bus: can.BusABC) -> bool:
        port = _serial_port(bus)
        if port is None:
            return False
        try:
            return bool(port.in_waiting)
        except Exception as error:
            raise self._lost(f"the CAN channel is gone ({error})") from error


def channels() -> list[tuple[str, str]]:
    """(interface, channel) of the CAN channels that this machine's system and installed adapter drivers can name."""
    import can

    _quiet()
    found = can.detect_available_configs(["socketcan", "pcan", "vector"])
    return sorted({(str(one["interface"]), str(one["channel"])) for one in found})


def _quiet() -> None:
    """Keep python-can from telling the terminal which adapters' drivers are missing; our errors say what matters."""
    logging.getLogger("can").addHandler(_NOWHERE)


def _serial_port(bus: can.BusABC) -> Any:
    """The serial port under an slcan bus; None for other interfaces."""
    return getattr(bus, "serialPortOrig", None)


def _state(bus: can.BusABC) -> str:
    """Name of the controller's state where the interface knows it."""
    try:
        return bus.state.name
    except Exception:  # interfaces without a state raise what they like
        return "ACTIVE"
