"""CAN bus through an adapter that speaks slcan (Lawicel's ASCII protocol) on a serial port.

A line ends with CR. ``C`` closes the bus, ``S4`` sets 125 kbit/s, ``O`` opens it, ``tiiildd..`` is a classic frame with
an 11-bit identifier (three hexadecimal digits), its length and its data. Adapters acknowledge with CR, ``z`` or ``Z``
and refuse with BEL; canable's firmware answers nothing but ``V``. Reports of a bus that is off (``sb...``, as the Linux
driver takes them) are understood; other lines are ignored.

Opening waits for nothing: the lines go out, frames after them, and `SlcanLink.read` sees whether they were taken. An
adapter that restarts when its port is opened (an Arduino does) is deaf for some two seconds and loses them: they are
sent again until it answers. An adapter whose version is a text (canable, Elmue) may have been left silent by an earlier
program, hearing all and sending nothing: it is set to normal (``M0``). ``L`` and ``M1``, which silence, are never sent,
nor is ``M0`` to any other firmware, where it may set a filter.

Own code in place of python-can's, which waits for the port to send after each frame, and reads byte by byte.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Collection, Sequence

from drivers.lines import LineSplitter
from drivers.links.device_server import open_line
from drivers.links.link import CanFrame, DeviceError, DeviceLost

LOG = logging.getLogger(__name__)

BITRATES = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    750_000: "S7",  # some firmware means 800 kbit/s by it
    800_000: "S7",
    1_000_000: "S8",
}
BAUD = 115_200  # of the serial port; USB adapters ignore it
MOST_READS = 16  # of the port in one `SlcanLink.read`
MOST_BYTES = 16_384  # after which it takes no more: about 700 frames
AGAIN_S = 0.5  # how often the opening lines are sent while the adapter is deaf
OPENING_S = 6.0  # how long: two seconds are usual
LONGEST_LINE = 128
BEL = b"\x07"

_FRAME = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")
_OTHER_FRAMES = b"TrRdDbB"  # extended, remote, CAN FD
_VERSION = re.compile(rb"V[0-9A-Fa-f]{4}")
_TEXT = re.compile(rb"(?!V)[\t -~]*(?:git|http|Board:)[\t -~]*|[0-9a-f]{7,40}(?: [ -~]*)?", re.IGNORECASE)
_ANSWERED = 4  # lines of the opening that were answered: C, S, O and V; adapters differ in whether an empty one is
_TIME_STAMP = 4  # digits behind a frame, where the adapter has been told to give the time


class Decoder:
    """Bytes from an adapter to frames. Never raises.

    Counters: ``garbage`` (what looks like a frame and is none, or is not ASCII), ``foreign_frames`` (other identifiers,
    extended, remote and FD frames), ``refused`` (a frame or command that the adapter did not take: BEL). ``bus_off`` is
    True once the adapter has said that its controller is off the bus. ``version`` is what it answered to ``V``,
    ``answers`` how many lines and refusals have come, frames left out.
    """

    def __init__(self, counters: dict[str, int], accept: frozenset[int] | None = None) -> None:
        self.counters = counters
        for key in ("garbage", "foreign_frames", "refused"):
            counters.setdefault(key, 0)
        self.bus_off = False
        self.version = ""
        self.answers = 0
        self._accept = accept
        self._lines = LineSplitter(b"\r", LONGEST_LINE, counters)

    def feed(self, data: bytes) -> list[CanFrame]:
        """The frames that ``data`` completes."""
        if BEL in data:
            self.counters["refused"] += data.count(BEL)
            data = data.replace(BEL, b"\r")
        frames = []
        for line in self._lines.feed(data):
            if line.startswith((b"z", b"Z")):
                line = line[1:]
            line = line.lstrip(b"\n")
            if is_version(line):
                self.version = line.decode("ascii")
            elif line and (frame := self._frame(line)) is not None:
                frames.append(frame)
                continue
            self.answers += 1
        return frames

    def _frame(self, line: bytes) -> CanFrame | None:
        found = _FRAME.fullmatch(line)
        if found is not None:
            length, digits = int(found[2]), len(found[3])
            if digits in (2 * length, 2 * length + _TIME_STAMP):
                identifier = int(found[1], 16)
                if self._accept is None or identifier in self._accept:
                    return CanFrame(identifier, bytes.fromhex(found[3][: 2 * length].decode()))
                self.counters["foreign_frames"] += 1
                return None
        if line.startswith((b"sb", b"sa", b"sw", b"sp")):
            self.bus_off = line.startswith(b"sb")
        elif line[:1] in {bytes((kind,)) for kind in _OTHER_FRAMES}:
            self.counters["foreign_frames"] += 1
        elif line.startswith(b"t") or not line.isascii():
            self.counters["garbage"] += 1
        return None


def is_version(line: bytes) -> bool:
    """Whether a line is what an adapter answers to ``V``."""
    return bool(_VERSION.fullmatch(line) or _TEXT.fullmatch(line))


def encode(frame: CanFrame) -> bytes:
    """The line that sends a frame."""
    return f"t{frame.id:03X}{len(frame.data)}{frame.data.hex().upper()}\r".encode()


def opening(bitrate: int) -> bytes:
    """The lines that open the bus; the first ends whatever an earlier program left unfinished."""
    return f"\rC\r{BITRATES[bitrate]}\rO\rV\r".encode()


def opening_as_text(bitrate: int) -> bytes:
    """The lines for an adapter whose version is a text: its mode can be set while the bus is closed only."""
    return f"C\rM0\r{BITRATES[bitrate]}\rO\r".encode()


class _Opening:
    """Where the opening of an adapter stands, from ``now`` on."""

    def __init__(self, now: float) -> None:
        self.begun = now
        self.sent = 1  # times
        self.repeat_at = now + AGAIN_S
        self.heard = False  # frames: the bus is open


class SlcanLink:
    """A `drivers.links.link.FrameLink` on an slcan adapter; nothing in it waits.

    Counters: ``frames_read``, ``frames_written``, and those of `Decoder`. Frames carry no checksum between adapter and
    host: a corrupted hexadecimal digit is a different frame.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for error messages.
    channel : str
        The adapter's serial port, perhaps with ``@`` and its baud rate; also at a device server.
    bitrate : int
        Of the bus, one of `BITRATES`.
    accept : collection of int, optional
        Identifiers to pass on; all if it is left out.
    adopt : sequence of int, optional
        As `drivers.links.serial_link.SerialLink` takes it: the bus is open already then.

    Raises
    ------
    DeviceError
        The port cannot be opened, or there is no such bit rate.
    """

    def __init__(
        self,
        name: str,
        channel: str,
        bitrate: int = 125_000,
        *,
        accept: Collection[int] | None = None,
        adopt: Sequence[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = f"slcan {channel}"
        self.counters = dict.fromkeys(("frames_read", "frames_written"), 0)
        self._where = f"{name} ({self.name})"
        self._accept = None if accept is None else frozenset(accept)
        if bitrate not in BITRATES:
            allowed = ", ".join(str(rate) for rate in BITRATES)
            raise DeviceError(
                self._where, f"the CAN channel cannot be opened at {bitrate} bit/s", f"Allowed: {allowed}."
            )
        self._bitrate = bitrate
        port, _, baud = channel.partition("@")
        try:
            rate = int(baud) if baud else BAUD
            self._port = open_line(name, port, rate, adopt=adopt, clock=clock)
        except DeviceError as error:
            raise type(error)(self._where, f"the CAN channel cannot be opened: {error.what}", error.advice) from None
        except ValueError as error:
            raise DeviceLost(
                self._where, f"the CAN channel cannot be opened ({error})", "Name the adapter's serial port."
            ) from None
        self.settings = self._port.settings
        self._clock = clock
        self._decoder = Decoder(self.counters, self._accept)
        self._opening: _Opening | None = None
        if not adopt:
            self._begin_opening()

    def read(self) -> list[CanFrame]:
        """All frames that have arrived; raises `DeviceLost` when the adapter is gone or off the bus."""
        frames: list[CanFrame] = []
        taken = 0
        for _ in range(MOST_READS):
            try:
                data = self._port.read()
            except DeviceLost as error:
                raise self._lost(error) from None
            frames += self._decoder.feed(data)
            taken += len(data)
            if not data or taken > MOST_BYTES:
                break
        if self._opening is not None:
            self._go_on_opening(self._opening, heard=bool(frames))
        self.counters["frames_read"] += len(frames)
        if self._decoder.bus_off:
            raise DeviceLost(
                self._where,
                "the CAN controller is bus-off",
                "Check adapter, cable, termination and bit rate, then start again.",
            )
        return frames

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        """Send one frame, or keep it while the adapter takes nothing; `DeviceLost` when that lasts."""
        self._write(encode(frame), urgent)
        self.counters["frames_written"] += 1

    def _begin_opening(self) -> None:
        self._opening = _Opening(self._clock())
        self._write(opening(self._bitrate))

    def _go_on_opening(self, under_way: _Opening, *, heard: bool) -> None:
        """Look whether the opening lines were taken; ``heard`` says that frames have come.

        An open bus is no answer yet: a silent adapter gives frames too.
        """
        decoder, now = self._decoder, self._clock()
        under_way.heard |= heard
        if _TEXT.fullmatch(decoder.version.encode()):
            self._write(opening_as_text(self._bitrate))
        elif decoder.answers < _ANSWERED:
            if now < under_way.repeat_at:
                return
            if not under_way.heard and now - under_way.begun < OPENING_S:
                under_way.sent += 1
                under_way.repeat_at = now + AGAIN_S
                decoder.answers = 0
                self._write(opening(self._bitrate))
                return
        self._opening = None
        if decoder.version:
            self.settings["adapter"] = decoder.version
        deaf_s = now - under_way.begun
        if decoder.answers == 0 and not under_way.heard:
            self.settings["remark"] = f"the CAN adapter has answered nothing for {deaf_s:.1f} s; the bus may be closed"
        elif under_way.sent > 1:
            self.settings["remark"] = (
                f"the CAN adapter was deaf for {deaf_s:.1f} s after its port was opened, as one that restarts is; "
                "it was opened again"
            )
        if "remark" in self.settings:
            LOG.warning("%s: %s.", self._where, self.settings["remark"])

    def _write(self, data: bytes, urgent: bool = False) -> None:
        try:
            self._port.write(data, behind=b"\r" if urgent else None)
        except DeviceLost as error:
            raise self._lost(error) from None

    @property
    def descriptors(self) -> tuple[int, ...]:
        """For another process's ``adopt``."""
        return self._port.descriptors

    def reopen(self) -> bool:
        """As `SerialLink.reopen`; opens the bus again too."""
        if not self._port.reopen():
            return False
        self._decoder = Decoder(self.counters, self._accept)
        self._begin_opening()
        return True

    def resume(self) -> None:
        """Take the adapter over from a process that may have died in the middle of a line."""
        self._decoder = Decoder(self.counters, self._accept)
        self._write(b"\r")

    def close(self) -> None:
        """Release the adapter. Calling it twice does no harm."""
        self._port.close()

    def _lost(self, error: DeviceLost) -> DeviceLost:
        return DeviceLost(self._where, f"the CAN channel is gone: {error.what}", error.advice)
