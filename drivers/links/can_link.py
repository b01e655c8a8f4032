"""CAN bus through python-can, as a `drivers.links.link.FrameLink`: never waits, survives garbage, says when the bus is
gone. `open_bus` gives the link of any interface; slcan adapters have one of their own, in `drivers.links.slcan_link`.

python-can is imported when a bus is opened, not before. No thread, no Notifier, no periodic sending: frames move only
when the owner calls ``read`` or ``write``.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any

from drivers.links.link import CanFrame, DeviceLost, DeviceRefused
from drivers.links.slcan_link import SlcanLink

if TYPE_CHECKING:
    import can

INTERFACES = ("socketcan", "slcan", "pcan", "vector", "kvaser", "ixxat", "gs_usb", "virtual", "udp_multicast")

SHARED = ("socketcan", "udp_multicast")
"""Interfaces that several programs of one computer may open at once."""

# What an interface needs beyond channel and bit rate. vector: channels are counted over all its adapters.
# udp_multicast: frames stay on this computer. virtual and udp_multicast have no bit rate; socketcan has its own from
# the system.
_OPTIONS: dict[str, dict[str, Any]] = {
    "vector": {"app_name": None},
    "udp_multicast": {"hop_limit": 0, "fd": False},
}
_WITHOUT_BITRATE = {"socketcan", "virtual", "udp_multicast"}
_NUMBERED = {"kvaser", "ixxat", "gs_usb"}  # whose channel python-can wants as a number

_ADVICE = {
    "socketcan": "It is Linux only; bring it up first: ip link set can0 up type can bitrate 125000.",
    "pcan": "Install PEAK's PCAN-Basic driver; channels are named PCAN_USBBUS1 and so on.",
    "vector": "It needs Windows and Vector's XL driver library; the channel is a number, from 0.",
    "kvaser": "Install Kvaser's CANlib drivers; the channel is a number, from 0.",
    "ixxat": "It needs Windows and IXXAT's VCI driver; the channel is a number, from 0.",
    "gs_usb": "It needs the packages gs-usb and pyusb, the library libusb 1.0 and the right to use the adapter; the "
    "channel is a number, from 0. On Linux the kernel knows such adapters: use socketcan there.",
    "udp_multicast": "It needs the package msgpack (extra `multicast`), and a multicast address such as 239.74.163.2.",
}

_NOWHERE = logging.NullHandler()
_BUS_OFF = 0x40  # SocketCAN's error class CAN_ERR_BUSOFF in the identifier of an error frame
_MOST_LOOKS = 256  # in one read, which may then take some milliseconds; the rest waits for the next
_MOST_SENT = 4096  # frames whose echo is waited for
_LOOK_AGAIN_S = 0.05  # how often a lost bus is looked for
TAKES_S = 0.5  # an interface that takes no frame for so long is lost
MOST_WAITING = 64  # frames that wait to be taken


class CanLink:
    """One CAN interface.

    Counters: ``frames_read``, ``frames_written``, ``foreign_frames`` (identifier not in ``accept``, or not a classic
    11-bit data frame), ``error_frames``, ``own_echoes`` (what udp_multicast brings back to its sender) and ``garbage``
    (what the interface could not make a frame of). A frame for which the interface has no room waits here and goes out
    with the next call; when none is taken for `TAKES_S` the bus counts as lost.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for error messages; the link's own ``name`` is interface and channel.
    interface : str
        One of `INTERFACES` but slcan: which python-can backend.
    channel : str
        "can0" (socketcan), "PCAN_USBBUS1" (pcan), a number (vector, kvaser, ixxat, gs_usb), any name (virtual), a
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
        clock: Callable[[], float] = time.monotonic,
        **options: Any,
    ) -> None:
        self.name = f"{interface} {channel}"
        self.counters = dict.fromkeys(
            ("frames_read", "frames_written", "foreign_frames", "error_frames", "own_echoes", "garbage"), 0
        )
        self._where = f"{name} ({self.name})"
        self._accept = None if accept is None else frozenset(accept)
        self._echoing = interface == "udp_multicast"
        self._sent: deque[CanFrame] = deque(maxlen=_MOST_SENT)  # whose echo has not come yet
        self._clock = clock
        self._waiting: deque[CanFrame] = deque()  # frames that the interface had no room for
        self._taken_at = clock()
        self._next_look = clock()
        self._arguments = interface, channel, bitrate, options
        self._closed = False
        self._bus: can.BusABC | None = self._open(*self._arguments)

    def _open(self, interface: str, channel: str, bitrate: int, options: dict[str, Any]) -> can.BusABC:
        import can

        _quiet()
        options = _OPTIONS.get(interface, {}) | options
        if interface not in _WITHOUT_BITRATE:
            options["bitrate"] = bitrate
        try:
            return can.Bus(
                channel=_number(channel) if interface in _NUMBERED else channel,
                interface=interface,
                ignore_config=True,
                receive_own_messages=False,
                **options,
            )
        # python-can's words for a backend that is not installed, or whose library is not there
        except (can.CanInterfaceNotImplementedError, ImportError) as error:
            raise DeviceRefused(
                self._where,
                f"the CAN interface cannot be used here ({error})",
                _ADVICE.get(interface, ""),
            ) from error
        except Exception as error:  # each maker's library has exceptions of its own
            raise DeviceLost(
                self._where,
                f"the CAN channel cannot be opened ({error})",
                _ADVICE.get(interface, ""),
            ) from error

    def read(self) -> list[CanFrame]:
        """The frames that have arrived, at most some hundred; raises `DeviceLost` when the bus is gone or off."""
        bus = self._open_bus()
        self._send_waiting(bus)
        frames: list[CanFrame] = []
        for _ in range(_MOST_LOOKS):
            try:
                message = bus.recv(0)
            except Exception as error:
                self.counters["garbage"] += 1
                self._survive(error)
                continue
            if message is not None:
                if (frame := self._frame(message)) is not None:
                    frames.append(frame)
            else:
                break
        self.counters["frames_read"] += len(frames)
        if _state(bus) == "ERROR":
            raise self._lost("the CAN controller is bus-off")
        return frames

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        """Send one frame, or keep it while there is no room; raises `DeviceLost` when it cannot be sent."""
        bus = self._open_bus()
        if not self._waiting:
            self._taken_at = self._clock()
        if urgent and frame in self._waiting:
            self._waiting.remove(frame)
        if urgent:
            self._waiting.appendleft(frame)
        elif frame not in self._waiting:  # an off that is repeated need not wait twice
            self._waiting.append(frame)
        self._send_waiting(bus)

    def _send_waiting(self, bus: can.BusABC) -> None:
        import can

        while self._waiting:
            frame = self._waiting[0]
            try:
                bus.send(
                    can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False, check=True), timeout=0
                )
            except (can.CanError, OSError) as error:
                late = self._clock() - self._taken_at > TAKES_S or len(self._waiting) > MOST_WAITING
                if _no_room(error) and not late:
                    return
                self._waiting.clear()
                raise self._lost(f"a frame cannot be sent ({error})") from error
            self._waiting.popleft()
            self._taken_at = self._clock()
            if self._echoing:
                self._sent.append(frame)
            self.counters["frames_written"] += 1

    @property
    def descriptors(self) -> tuple[int, ...]:
        """None: the libraries behind python-can do not hand a bus over to another process."""
        return ()

    def reopen(self) -> bool:
        """Open a lost bus again if it is back under its name, at most every 50 ms; True when it is open."""
        now = self._clock()
        if self._closed or now < self._next_look:
            return False
        self._next_look = now + _LOOK_AGAIN_S
        self._let_go()
        self._waiting.clear()
        try:
            self._bus = self._open(*self._arguments)
        except (DeviceLost, DeviceRefused):
            return False
        return True

    def resume(self) -> None:
        """Nothing of a predecessor is left on a bus of one's own."""

    def close(self) -> None:
        """Release the bus. Calling it twice does no harm."""
        self._closed = True
        self._let_go()

    def _let_go(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            # A bus that has vanished cannot be closed in order, but must be let go of.
            with contextlib.suppress(Exception):
                bus.shutdown()

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

    def _survive(self, error: Exception) -> None:
        """Go on after garbage; raise `DeviceLost` when the bus has vanished."""
        cause = error.__cause__ or error
        if self._echoing and cause is not error and not isinstance(cause, OSError):
            return  # any program may send any datagram to the group
        if isinstance(cause, (ValueError, IndexError, KeyError)):
            return
        raise self._lost(f"the CAN channel is gone ({cause})") from error


def open_bus(
    name: str,
    interface: str,
    channel: str,
    bitrate: int = 125_000,
    *,
    adopt: Sequence[int] = (),
) -> CanLink | SlcanLink:
    """The link of any interface; ``adopt`` as `drivers.links.slcan_link.SlcanLink` takes it.

    Raises
    ------
    DeviceError
        It cannot be opened, is in use, or there is no such interface.
    """
    if interface == "slcan":
        return SlcanLink(name, channel, bitrate, adopt=adopt)
    if interface not in INTERFACES:
        where = f"{name} ({interface} {channel})"
        raise DeviceRefused(where, f"there is no CAN interface {interface!r}", f"Allowed: {', '.join(INTERFACES)}.")
    return CanLink(name, interface, channel, bitrate)


def channels() -> list[tuple[str, str]]:
    """(interface, channel) of the CAN channels that this machine's system and installed adapter drivers can name."""
    import can

    _quiet()
    found = can.detect_available_configs(["socketcan", "pcan", "vector", "kvaser", "ixxat", "gs_usb"])
    return sorted({(str(one["interface"]), str(one["channel"])) for one in found})


def _quiet() -> None:
    """Keep python-can from telling the terminal which adapters' drivers are missing; our errors say what matters."""
    logging.getLogger("can").addHandler(_NOWHERE)


def _number(channel: str) -> int:
    if not channel.isdecimal():
        raise ValueError(f"{channel!r} is no number")
    return int(channel)


def _no_room(error: Exception) -> bool:
    """Whether an interface only had no room for a frame."""
    number = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return number in (errno.ENOBUFS, errno.EAGAIN) or "full" in str(error).lower()


def _state(bus: can.BusABC) -> str:
    """Name of the controller's state where the interface knows it."""
    try:
        return bus.state.name
    except Exception:  # interfaces without a state raise what they like
        return "ACTIVE"
