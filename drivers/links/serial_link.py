"""Serial ports: never waiting, opened for us alone, gone in one way only, and found again by the same identity.

pyserial opens and sets up the port; bytes then go through the bare descriptor, because pyserial (like python-can above
it) can wait for a port to take its data. What is framed, and how, is the codecs' business: `SerialLink.read` returns
whatever has arrived.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.links.link import DeviceError, DeviceLost
from drivers.links.port_lock import PortLock
from drivers.links.system import GONE, Port, adopted_port, open_port

if TYPE_CHECKING:
    import serial

TAKES_S = 0.5  # a port that has taken nothing for so long, with bytes waiting, is lost
MOST_WAITING = 4096  # bytes not taken yet: far more than any dialogue has outstanding
LOOK_AGAIN_S = 0.05  # how often a lost port is looked for
MODEM_S = 25.0  # how long opening waits for ModemManager
BUSY_AGAIN_S = 0.25  # how often it tries

LOG = logging.getLogger(__name__)

_BUSY = (errno.EBUSY, errno.EAGAIN)
_BY_ID = Path("/dev/serial/by-id")


# pyserial raises the last ones for a baud rate or a setting that this system's ports cannot have.
_UNUSABLE: tuple[type[Exception], ...] = (*GONE, ValueError, NotImplementedError)


class SerialLink:
    """A `drivers.links.link.ByteLink` over a serial port, 8N1.

    What the port does not take at once waits here, up to `MOST_WAITING` bytes, and goes out with the next call; a port
    that takes nothing for `TAKES_S` counts as lost. ``settings`` says what was set and what the adapter made of it:
    adapters that collect bytes for up to 16 ms before they hand them on are asked not to.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for messages.
    port : str
        ``/dev/ttyUSB0``, ``COM3``; the link's own ``name``.
    baud : int
        Bits per second.
    adopt : sequence of int, optional
        Descriptors of a port that another process has opened, as `descriptors` gives them, in place of opening it.
    clock : callable
        Seconds; a real port lives in real time.

    Raises
    ------
    DeviceError
        The port does not exist, is in use, or may not be opened.
    """

    def __init__(
        self,
        name: str,
        port: str,
        baud: int,
        *,
        adopt: Sequence[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = port
        self.counters = {"reopened": 0}
        self._label = f"{name} ({port})"
        self._path, self._baud = port, baud
        self._clock = clock
        self._closed = False
        self._waiting = bytearray()
        self._taken_at = clock()  # when the port last took something, or had nothing to take
        self._next_look = clock()
        self._lock: PortLock | None = None
        self._held: tuple[int, ...] = ()  # the lock's descriptor, of an adopted port
        self.settings = {"port": port, "baud": str(baud)}
        if adopt:
            first, *others = adopt
            self._port: Port | None = adopted_port(first)
            self._held = tuple(others)
        else:
            self._lock = PortLock(self._label, port)
            try:
                self._port = self._open_once_free()
            except _UNUSABLE as error:
                self._lock.release()
                raise _not_opened(self._label, port, error) from None
        self._identity = Identity.of(port)
        timer = Path("/sys/class/tty", Path(os.path.realpath(port)).name, "device/latency_timer")
        with contextlib.suppress(OSError):  # FTDI adapters on Linux
            self.settings["latency_timer_ms"] = timer.read_text().strip()

    def _open_once_free(self) -> Port:
        """Open it; wait for ModemManager, which keeps a port for some ten seconds after it was plugged in."""
        began = self._clock()
        told = False
        while True:
            try:
                port = self._open(exclusive=True)
            except OSError as error:
                if error.errno not in _BUSY or not modem_manager() or self._clock() - began > MODEM_S:
                    raise
            else:
                if told:
                    waited = self._clock() - began
                    self.settings["remark"] = (
                        f"ModemManager had the port for {waited:.1f} s. {_against_modem_manager(self._path)}"
                    )
                return port
            if not told:
                told = True
                advice = _against_modem_manager(self._path)
                LOG.warning("%s: ModemManager has the port; waiting up to %g s. %s", self._label, MODEM_S, advice)
            time.sleep(BUSY_AGAIN_S)

    def _open(self, *, exclusive: bool | None, path: str = "") -> Port:
        import serial

        opened = serial.Serial(path or self._path, self._baud, timeout=0, write_timeout=0, exclusive=exclusive)
        try:
            self.settings["low_latency"] = _ask_low_latency(opened)
            return open_port(opened)
        except BaseException:
            opened.close()
            raise

    def read(self) -> bytes:
        """Everything that has arrived, at most `MOST_AT_ONCE` bytes; sends what waits."""
        try:
            port = self._open_port()
            self._send(port)
            return port.read()
        except GONE as error:
            raise self._lost("reading", error) from None

    def write(self, data: bytes, *, behind: bytes | None = None) -> None:
        """Send ``data``, or keep what the port does not take now.

        ``behind`` is the end of a line: ``data`` then overtakes what waits, behind the line that is under way.
        """
        try:
            port = self._open_port()
            if not self._waiting:
                self._taken_at = self._clock()
            place = len(self._waiting) if behind is None else self._waiting.find(behind) + len(behind)
            self._waiting[place:place] = data
            self._send(port)
        except GONE as error:
            raise self._lost("writing", error) from None

    def _send(self, port: Port) -> None:
        if self._waiting:
            taken = port.write(bytes(self._waiting))
            del self._waiting[:taken]
            now = self._clock()
            if taken:
                self._taken_at = now
            if len(self._waiting) > MOST_WAITING or (self._waiting and now - self._taken_at > TAKES_S):
                self._waiting.clear()
                raise DeviceLost(
                    self._label,
                    "the port takes no more data",
                    "The adapter or the device hangs: unplug it and plug it in again.",
                )

    def fileno(self) -> int:
        """File descriptor to wait on with ``select``, on systems where serial ports have one."""
        try:
            return self._open_port().fileno()
        except GONE as error:
            raise self._lost("waiting", error) from None

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Descriptors of port and lock for another process's ``adopt``; empty where they cannot be handed over."""
        if self._port is None or self._lock is None or os.name != "posix":
            return ()
        return (self._port.fileno(), self._lock.fd)

    def reopen(self) -> bool:
        """Look whether a lost port is back under the same identity, at most every `LOOK_AGAIN_S`; True when it is open.

        Needs no lock. What was waiting for the port that vanished is dropped.
        """
        now = self._clock()
        if self._closed or now < self._next_look:
            return False
        self._next_look = now + LOOK_AGAIN_S
        path = self._identity.path(self._path)
        if path is None:
            return False
        try:
            port = self._open(exclusive=None, path=path)
        except _UNUSABLE:
            return False
        old, self._port = self._port, port
        if old is not None:
            with contextlib.suppress(*GONE):
                old.close()
        self._waiting.clear()
        self.counters["reopened"] += 1
        return True

    def resume(self) -> None:
        """Take the port over from a process that may have died in the middle of a command: nothing to do for bytes."""

    def close(self) -> None:
        """Release the port. Calling it twice does no harm."""
        self._closed = True
        port, self._port = self._port, None
        try:
            if port is not None:
                port.close()
        except GONE:
            pass  # it is gone, which is what was wanted
        finally:
            if self._lock is not None:
                self._lock.release()
            held, self._held = self._held, ()
            for descriptor in held:
                os.close(descriptor)

    def _open_port(self) -> Port:
        if self._port is None:
            raise OSError("it was closed")
        return self._port

    def _lost(self, doing: str, error: Exception) -> DeviceLost:
        return DeviceLost(
            self._label, f"the port is gone ({doing}: {_reason(error)})", "Plug it in again, check its cable and power."
        )


class Identity:
    """By what a port is known again: its name in ``/dev/serial/by-id`` and the serial number of its USB adapter."""

    def __init__(self, by_id: str, usb_serial: str) -> None:
        self.by_id, self.usb_serial = by_id, usb_serial

    @classmethod
    def of(cls, port: str) -> Identity:
        """Of a port that is there now; empty where the system knows none."""
        real = os.path.realpath(port)
        by_id = ""
        with contextlib.suppress(OSError):
            by_id = next((str(one) for one in sorted(_BY_ID.iterdir()) if os.path.realpath(one) == real), "")
        return cls(by_id, _usb_serial(real))

    def path(self, port: str) -> str | None:
        """Where the port is now; None when it is not there, or another adapter has its name."""
        path = self.by_id or port
        if os.sep in path and not Path(path).exists():
            return None
        if self.usb_serial and _usb_serial(os.path.realpath(path)) != self.usb_serial:
            return None
        return path


def _usb_serial(device: str) -> str:
    """Serial number of the USB adapter behind a port, on Linux; empty if there is none."""
    folder = Path(os.path.realpath(f"/sys/class/tty/{Path(device).name}/device"))
    for parent in (folder, *folder.parents[:3]):
        with contextlib.suppress(OSError):
            return (parent / "serial").read_text().strip()
    return ""


def modem_manager() -> bool:
    """Whether ModemManager runs here. Whose port it has it does not tell to others than root."""
    for name in Path("/proc").glob("[0-9]*/comm"):
        with contextlib.suppress(OSError):
            if name.read_text().strip() == "ModemManager":
                return True
    return False


def _against_modem_manager(port: str) -> str:
    folder = Path(os.path.realpath(f"/sys/class/tty/{Path(os.path.realpath(port)).name}/device"))
    ids = ["XXXX", "XXXX"]  # lsusb shows them
    for parent in (folder, *folder.parents[:3]):
        with contextlib.suppress(OSError):
            ids = [(parent / key).read_text().strip() for key in ("idVendor", "idProduct")]
            break
    return (
        "To end that, put this line into /etc/udev/rules.d/99-dea-rig.rules and plug it in again: "
        f'ATTRS{{idVendor}}=="{ids[0]}", ATTRS{{idProduct}}=="{ids[1]}", ENV{{ID_MM_DEVICE_IGNORE}}="1"'
    )


def ports() -> list[str]:
    """Names of the serial ports that this machine has."""
    from serial.tools import list_ports

    return sorted(port.device for port in list_ports.comports())


def _not_opened(label: str, port: str, error: Exception) -> DeviceError:
    number = getattr(error, "errno", None)
    existing = ports()
    there = f"Ports on this machine: {', '.join(existing)}." if existing else "This machine has no serial port."
    if isinstance(error, ValueError):
        return DeviceError(label, f"port {port} cannot be set up ({error})", "Check the baud rate in the scene.")
    if os.sep in port and not Path(port).exists():
        return DeviceError(label, f"port {port} does not exist", there)
    if number == 13:  # EACCES
        return DeviceError(
            label,
            f"port {port} may not be opened by this user",
            "On Linux, become a member of the group that owns it (dialout, uucp) and log in again.",
        )
    if number in _BUSY and modem_manager():
        what = f"port {port} is in use, perhaps by ModemManager, for more than {MODEM_S:g} s"
        return DeviceError(label, what, _against_modem_manager(port))
    return DeviceError(label, f"port {port} cannot be opened ({_reason(error)})", there)


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error) or type(error).__name__


def _ask_low_latency(port: serial.Serial) -> str:
    if not hasattr(port, "set_low_latency_mode"):
        return "not available (not on this operating system)"
    try:
        port.set_low_latency_mode(True)
    except _UNUSABLE as error:
        return f"not available ({_reason(error)})"
    return "on"
