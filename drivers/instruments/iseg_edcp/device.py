"""One channel of an iseg supply: set-up, samples, commands that are read back."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, Schedule, label
from drivers.heard import Heard
from drivers.instruments.iseg_edcp import codec as edcp
from drivers.instruments.iseg_edcp.codec import (
    ChannelControl,
    ChannelEvents,
    ChannelStatus,
    Data,
    Decoder,
    Item,
    LogOn,
    Message,
    ModuleStatus,
    Value,
    write,
)
from drivers.instruments.iseg_edcp.exchange import (
    ATTEMPTS,
    EMERGENCY_AGAIN_S,
    EMERGENCY_LOOKS,
    EMERGENCY_OFTEN,
    EMERGENCY_SELDOM_S,
    SURVEY_S,
    SWITCH_ON_LOOKS,
    SWITCH_ON_WAIT_S,
    Exchange,
    Script,
    check_arguments,
    judge_second,
    names_of,
    value_of,
)
from drivers.instruments.iseg_edcp.protection import Protection
from drivers.links.link import CanFrame, DeviceError, DeviceRefused, DeviceSilent, FrameLink
from drivers.roles import HVSample, Identity

T = TypeVar("T")


class IsegEDCP:
    """One channel of an iseg module as an `drivers.roles.HVSupply`.

    Set-up registers the module and reads; it writes nothing else, so a channel that is found switched on stays as it
    is and shows in the samples. Each sample takes five reads at ``poll_rate_Hz`` (measured voltage and current,
    set-point, channel status and events) and one of the module's status; they also keep the registration alive. Where
    the module tells of an error in some channel that this one's status does not show, status and events are read once
    more: an error between the two reads is this channel's own. If the module has other channels, their status is read
    once a second into ``channel_status``.

    A command writes and reads back; a write that got lost is repeated, except switching on. A command that fails raises
    from ``poll`` and takes the commands queued behind it with it. ``emergency_off`` drops whatever is queued or under
    way, is the first thing that the next poll does, and goes out again every 10 ms until it is confirmed; if that
    fails, all modules on the bus are told. ``switch_off`` drops what is queued too, except a ramp that was asked for,
    which is written first. Of the channel control only this driver's own bits are changed and compared. A negative
    channel is used like a positive one: its voltages are magnitudes here.

    Parameters
    ----------
    module, channel : int
        Module number 0 to 63 on the bus, channel 0 to 255 in it.
    poll_rate_Hz : float
        Samples per second.
    timeout_s : float
        How long to wait for each answer; a read is repeated twice.
    max_ramp_percent_per_s : float
        Fastest voltage ramp that the module accepts, in percent of its nominal voltage per second.
    status_bit_5 : str
        One of `STATUS_BIT_5`: what bit 5 of the module status means for this class of module.
    boot_s : float
        How long the first answer may take.
    """

    measures_current = True

    def __init__(
        self,
        name: str,
        link: FrameLink,
        *,
        module: int = 0,
        channel: int = 0,
        poll_rate_Hz: float = 10.0,
        timeout_s: float = 0.25,
        max_ramp_percent_per_s: float = 20.0,
        status_bit_5: str = "unused",
        boot_s: float = 0.0,
    ) -> None:
        where = label(name, link)
        check_arguments(where, module, channel, poll_rate_Hz, status_bit_5)
        self.name = name
        self._label = where
        self._bit_5 = status_bit_5
        self._sign = 1.0  # of the channel's nominal voltage
        self._control = 0  # the channel's control word as last read
        self._emergency_until_confirmed = False
        self._next_emergency, self._emergencies = -math.inf, 0
        self.identity = Identity(model="iseg EDCP")
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"log_ons": 0, "unexpected_frames": 0, "bad_values": 0, "writes_repeated": 0}
        self.channel_status: dict[int, ChannelStatus] = {}
        """Last seen status of every channel of the module, if it has more than one."""
        self._link = link
        self._module = module
        self._channel = channel
        self._schedule = Schedule(1.0 / poll_rate_Hz, self.counters)
        self._max_ramp = max_ramp_percent_per_s
        self._decoder = Decoder(module, self.counters)
        self._boot_s = boot_s
        self._heard = Heard()
        self._dialogue: Dialogue[Exchange, Message] = Dialogue(
            where,
            self._transmit,
            self.counters,
            timeout_s=timeout_s,
            advice=f"Check power, CAN cable and termination, bit rate, and that module {module} is its address.",
            heard=self._heard,
        )
        self._protection = Protection(module, channel)
        self._exchange: Exchange | None = None
        self._collected: dict[int, Message] = {}
        self._nominal = (math.nan, math.nan)
        self._channels = 1
        self._ready = self._lost_settings = False
        self._wanted_ramp: float | None = None  # percent per second, asked for and not confirmed yet
        self._commands = 0
        self._inbox: deque[CanFrame] = deque()
        self._samples: list[HVSample] = []
        self._next_survey = -math.inf
        self._next_poll = -math.inf

    # -- role -------------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def nominal(self) -> tuple[float, float]:
        """(volts, amperes) read from the channel; NaN until then."""
        return self._nominal

    @property
    def fastest_ramp(self) -> float:
        """V/s, of the nominal voltage; NaN until that is known."""
        return self._max_ramp / 100 * self._nominal[0]

    @property
    def busy(self) -> bool:
        return self._commands > 0

    def set_ramp(self, volts_per_second: float) -> None:
        """Set the module's ramp, which it keeps as percent of nominal voltage per second, for all its channels."""
        self._require_ready("set the ramp")
        percent = 100.0 * volts_per_second / self._nominal[0]
        if not 0.0 < percent <= self._max_ramp * (1 + 1e-6):
            raise DeviceRefused(
                self._label,
                f"a ramp of {volts_per_second:g} V/s is {percent:g} % of {self._nominal[0]:g} V per second",
                f"The module allows above 0, at most {self._max_ramp:g} %/s: "
                f"{self._max_ramp / 100 * self._nominal[0]:g} V/s.",
            )
        self._wanted_ramp = percent
        self._command(self._write_ramp(percent))

    def set_current_limit(self, amperes: float) -> None:
        self._require_ready("set the current limit")
        if not 0.0 < amperes <= self._nominal[1]:
            raise DeviceRefused(
                self._label,
                f"a current limit of {amperes:g} A is outside the channel's range",
                f"Allowed: above 0, at most {self._nominal[1]:g} A.",
            )
        self._command(self._write_setting(edcp.SET_CURRENT, amperes, self._channel, "current_limit_A"))

    def set_voltage(self, volts: float) -> None:
        self._require_ready("set the voltage")
        if not 0.0 <= volts <= self._nominal[0]:
            raise DeviceRefused(
                self._label,
                f"a set-point of {volts:g} V is outside the channel's range",
                f"Allowed: 0 to {self._nominal[0]:g} V.",
            )
        self._command(self._write_checked(edcp.SET_VOLTAGE, self._sign * volts, self._channel))

    def switch_on(self) -> None:
        self._require_ready("switch on")
        self._emergency_until_confirmed = False
        self._command(self._switch_on())

    def switch_off(self) -> None:
        self._dialogue.clear()  # nothing that was queued before may switch on after it
        self._commands = 0
        self._command(self._switch_off())

    def emergency_off(self) -> None:
        self._dialogue.clear()
        self._commands = 0
        self._wanted_ramp = None
        self._emergency_until_confirmed, self._next_emergency, self._emergencies = True, -math.inf, 0
        self._command(self._emergency_off())

    def clear(self) -> None:
        self._emergency_until_confirmed = False
        self._command(self._clear())

    def close(self) -> None:
        self._link.close()

    # -- its own trip, and giving back what arming changed -------------------------------------------------------------

    @property
    def found(self) -> Mapping[str, float]:
        """What arming changes, as it was found."""
        return self._protection.found

    @property
    def given_back(self) -> bool:
        return self._protection.given_back

    def arm_trip(self, volts: float, amperes: float) -> None:
        """Let the channel report a voltage ``volts`` away from its set-point, and trip above ``amperes``."""
        self._require_ready("arm its trip")
        self._command(self._arm_trip(volts, amperes))

    def resume_found(self, found: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        self._protection.resume(found)
        return {key: (math.nan, value) for key, value in self.found.items()}

    def give_back(self) -> None:
        if self._ready and not self.given_back:
            self._command(self._giving_back())

    # -- polling ----------------------------------------------------------------------------------------------------

    def poll(self, now: float) -> Sequence[HVSample]:
        self._next_poll = now + LOST_AGAIN_S
        self._repeat_emergency_off(now)
        self._inbox.extend(self._heard.frames(self._link.read()))
        while self._inbox:  # an error that an answer brings on leaves the others for the next poll
            message = self._decoder.feed(self._inbox.popleft())
            if isinstance(message, LogOn):
                self.counters["log_ons"] += 1
                self._link.write(edcp.log_on(self._module))
                self._lost_settings = True  # it may have been switched off and on, and lost what was set
            elif message is not None and not self._dialogue.offer(message, now) and not self._collect(message):
                self.counters["unexpected_frames"] += 1
                judge_second(self._label, self._module, self.identity.serial, message)
        if self._dialogue.idle:
            if not self._ready:
                self._link.write(edcp.log_on(self._module))
                self._dialogue.begin(self._set_up())
            elif self._schedule.take(now):
                self._dialogue.begin(self._cycle(now))
        self._dialogue.run(now)
        if self._ready and math.isinf(self._schedule.due):
            self._schedule.start(now)
        self._next_poll = min(self._schedule.due if self._dialogue.idle else math.inf, self._dialogue.next_poll(now))
        if self._emergency_until_confirmed:
            self._next_poll = min(self._next_poll, self._next_emergency)
        samples, self._samples = self._samples, []
        return samples

    def _repeat_emergency_off(self, now: float) -> None:
        """Before anything is read: what comes in must not hold it up."""
        if self._emergency_until_confirmed and now >= self._next_emergency:
            self._emergencies += 1
            often = self._emergencies < EMERGENCY_OFTEN
            self._next_emergency = now + (EMERGENCY_AGAIN_S if often else EMERGENCY_SELDOM_S)
            word = self._control & ~edcp.OWN_CONTROL | ChannelControl.EMERGENCY_OFF
            self._link.write(write(self._module, edcp.CHANNEL_CONTROL, word, self._channel), urgent=True)

    def _command(self, script: Script[None]) -> None:
        self._commands += 1
        self._dialogue.begin(self._tracked(script))
        self._next_poll = -math.inf

    def _tracked(self, script: Script[None]) -> Script[None]:
        try:
            yield from script
        except DeviceError:
            self._dialogue.clear()
            self._commands = 0
            raise
        finally:
            self._commands = max(0, self._commands - 1)

    def _require_ready(self, what: str) -> None:
        if not self._ready:
            raise DeviceRefused(self._label, f"cannot {what} before the set-up dialogue has ended", "Poll it first.")

    def _transmit(self, exchange: Exchange) -> Callable[[Message], bool]:
        for frame in exchange.writes:
            self._link.write(frame)
        if exchange.once:
            exchange.writes = ()
        self._exchange = exchange
        self._collected = {}
        if exchange.everyone:
            self._link.write(edcp.read_many(self._module, exchange.item, exchange.everyone))
            return self._completes
        self._link.write(edcp.read_request(self._module, exchange.item, exchange.channel))
        return lambda m: isinstance(m, Data) and m.item is exchange.item and m.channel == exchange.channel

    def _completes(self, message: Message) -> bool:
        assert self._exchange is not None
        return self._collect(message) and self._collected.keys() == self._exchange.everyone

    def _collect(self, message: Message) -> bool:
        """Keep an answer to a request to several channels."""
        exchange = self._exchange
        if exchange is None or not isinstance(message, Data) or message.item is not exchange.item:
            return False
        if message.channel not in exchange.everyone:
            return False
        self._collected[message.channel] = message
        return True

    # -- dialogue ---------------------------------------------------------------------------------------------------

    def _read(
        self,
        item: Item,
        writes: tuple[CanFrame, ...] = (),
        *,
        once: bool = False,
        delay_s: float = 0.0,
        boot_s: float = 0.0,
    ) -> Script[Answer[Message]]:
        channel = self._channel if item.per_channel else None
        return (yield Ask(Exchange(item, channel, writes, once=once), delay_s=delay_s, boot_s=boot_s))

    def _integer(
        self, item: Item, writes: tuple[CanFrame, ...] = (), *, once: bool = False, delay_s: float = 0.0
    ) -> Script[int]:
        value = value_of((yield from self._read(item, writes, once=once, delay_s=delay_s)))
        assert isinstance(value, int)
        return value

    def _number(self, item: Item, limit: float) -> Script[tuple[float, float]]:
        """(value, time) of a float; one that is not finite or beyond ``limit`` is dropped, counted and read again."""
        value = math.nan
        for _ in range(ATTEMPTS):
            answer = yield from self._read(item)
            read = value_of(answer)
            assert isinstance(read, float)
            value = read
            if abs(value) <= limit:
                return value, answer.t
            self.counters["bad_values"] += 1
        raise DeviceRefused(
            self._label,
            f"reports {value:g} as {item.title}",
            f"Possible: at most {limit:g}. Switch off by hand and check the module.",
        )

    def _optional(self, item: Item, *, repeat: bool = False) -> Script[Value | None]:
        """The value of a module item that not every module has: not having it means not answering."""
        try:
            return value_of((yield Ask(Exchange(item, None), repeat=repeat)))
        except DeviceSilent:
            return None

    def _set_up(self) -> Script[None]:
        foreign = self.counters["foreign_requests"]
        yield from self._read(edcp.MODULE_STATUS, boot_s=self._boot_s)
        if self.counters["foreign_requests"] != foreign:
            raise DeviceRefused(
                self._label,
                f"someone else reads from module {self._module}, or the CAN interface returns its own frames",
                "Writes could not be verified. End the other program, or switch receive_own_messages off.",
            )
        serial = yield from self._optional(edcp.SERIAL_NUMBER, repeat=True)
        self.identity = edcp.identity(serial, None, None)
        release = yield from self._optional(edcp.FIRMWARE_RELEASE)
        firmware = yield from self._optional(edcp.FIRMWARE_NAME)
        channels = yield from self._optional(edcp.CHANNEL_COUNT)
        self._channels = channels if isinstance(channels, int) else 1
        if isinstance(channels, int) and not self._channel < channels:
            raise DeviceRefused(
                self._label,
                f"module {self._module} has {channels} channel(s), but channel {self._channel} was asked for",
                f"Channels count from 0: allowed is 0 to {channels - 1}.",
            )
        self.identity = edcp.identity(serial, release, firmware)
        volts, _ = yield from self._number(edcp.NOMINAL_VOLTAGE, 1e6)
        amperes, _ = yield from self._number(edcp.NOMINAL_CURRENT, 1e3)
        if not (volts != 0 and amperes != 0):
            raise DeviceRefused(
                self._label,
                f"states nominal values of {volts:g} V and {amperes:g} A",
                "Check the channel: it may have no output stage.",
            )
        self._sign = math.copysign(1.0, volts)
        volts, amperes = abs(volts), abs(amperes)
        self._nominal = (volts, amperes)
        yield from self._read_settings()
        setpoint, _ = yield from self._number(edcp.SET_VOLTAGE, 2 * volts)
        status = yield from self._integer(edcp.CHANNEL_STATUS)
        self._control = yield from self._integer(edcp.CHANNEL_CONTROL)
        self.settings |= {
            "polarity": "positive" if self._sign > 0 else "negative",
            "nominal_voltage_V": f"{volts:.9g}",
            "nominal_current_A": f"{amperes:.9g}",
            "setpoint_at_setup_V": f"{setpoint:.9g}",
            "channel_at_setup": "on" if status & ChannelStatus.ON else "off",
            "channels": str(self._channels),
        }
        self._ready = True

    def _read_settings(self) -> Script[None]:
        volts, amperes = self._nominal
        limit, _ = yield from self._number(edcp.SET_CURRENT, 2 * amperes)
        ramp, _ = yield from self._number(edcp.MODULE_RAMP, 1e3)
        module = yield from self._integer(edcp.MODULE_STATUS)
        self.settings |= {
            "ramp_percent_per_s": f"{ramp:.9g}",
            "ramp_V_per_s": f"{ramp / 100 * volts:.9g}",
            "current_limit_A": f"{limit:.9g}",
            "kill_enabled": "yes" if module & ModuleStatus.KILL_ENABLED else "no",
        }

    def _cycle(self, now: float) -> Script[None]:
        volts, amperes = self._nominal
        voltage, t = yield from self._number(edcp.MEASURED_VOLTAGE, 2 * volts)
        current, _ = yield from self._number(edcp.MEASURED_CURRENT, 10 * amperes)
        setpoint, _ = yield from self._number(edcp.SET_VOLTAGE, 2 * volts)
        for _ in range(2):  # an error that comes between channel and module is this channel's: a trip, and no fault
            status = yield from self._integer(edcp.CHANNEL_STATUS)
            events = yield from self._integer(edcp.CHANNEL_EVENTS)
            module = yield from self._integer(edcp.MODULE_STATUS)
            flags = edcp.hv_flags(ChannelStatus(status), ChannelEvents(events), ModuleStatus(module), self._bit_5)
            if module & ModuleStatus.NO_SUM_ERROR or flags & edcp.CHANNEL_ERRORS:
                break
        if status & ChannelStatus.EMERGENCY_OFF and not status & ChannelStatus.ON:
            self._emergency_until_confirmed = False
        if self._sign < 0:  # with which sign a negative channel states them is not settled: magnitudes
            voltage, current, setpoint = abs(voltage), abs(current), abs(setpoint)
        self._samples.append(HVSample(t, voltage, current, setpoint, flags))
        if self._lost_settings:
            self._lost_settings = False
            yield from self._read_settings()
        if self._channels > 1 and now >= self._next_survey:
            self._next_survey = now + SURVEY_S
            yield from self._survey()

    def _survey(self) -> Script[None]:
        exchange = Exchange(edcp.CHANNEL_STATUS, None)
        exchange.everyone = set(range(min(self._channels, 16)))
        yield Ask(exchange)
        for channel, message in self._collected.items():
            assert isinstance(message, Data) and isinstance(message.value, int)
            self.channel_status[channel] = ChannelStatus(message.value)

    # -- commands ---------------------------------------------------------------------------------------------------

    def _write_checked(self, item: Item, value: float, channel: int | None) -> Script[None]:
        """Write and read back; a write that did not take is repeated, since writes may get lost unnoticed."""
        frame = write(self._module, item, value, channel)
        for attempt in range(ATTEMPTS):
            self.counters["writes_repeated"] += attempt > 0
            read_back = value_of((yield from self._read(item, (frame,))))
            if read_back == value or (
                isinstance(read_back, float) and math.isclose(abs(read_back), abs(value), rel_tol=1e-5)
            ):
                return
        raise DeviceRefused(
            self._label,
            f"{item.title} reads back as {read_back!r} after {value!r} was written",
            "The module does not accept it: check its limits, its state, and who else commands it.",
        )

    def _write_control(self, word: ChannelControl) -> Script[None]:
        """Set our own bits of the channel control to ``word`` and leave all others as they are found."""
        self._control = yield from self._integer(edcp.CHANNEL_CONTROL)
        for attempt in range(ATTEMPTS):
            self.counters["writes_repeated"] += attempt > 0
            frame = write(self._module, edcp.CHANNEL_CONTROL, self._control & ~edcp.OWN_CONTROL | word, self._channel)
            self._control = yield from self._integer(edcp.CHANNEL_CONTROL, (frame,))
            if self._control & edcp.OWN_CONTROL == word:
                return
        raise DeviceRefused(
            self._label,
            f"channel control reads back as {self._control:04X} after {word:04X} was written to its bits "
            f"{edcp.OWN_CONTROL:04X}",
            "The module does not accept it: check its limits, its state, and who else commands it.",
        )

    def _write_setting(self, item: Item, value: float, channel: int | None, key: str) -> Script[None]:
        before = float(self.settings[key])
        yield from self._write_checked(item, value, channel)
        self._protection.changed(key, before, value)
        self.settings[key] = f"{value:.9g}"

    def _write_ramp(self, percent: float) -> Script[None]:
        yield from self._write_setting(edcp.MODULE_RAMP, percent, None, "ramp_percent_per_s")
        self.settings["ramp_V_per_s"] = f"{percent / 100 * self._nominal[0]:.9g}"
        self._wanted_ramp = None

    def _arm_trip(self, volts: float, amperes: float) -> Script[None]:
        self.settings |= yield from self._protection.arm(volts, amperes, alone=self._channels == 1)

    def _giving_back(self) -> Script[None]:
        refused = yield from self._protection.give_back()
        if refused:
            raise DeviceRefused(
                self._label, f"does not take {', '.join(refused)} back as found", "Set them in the maker's software."
            )

    def _switch_on(self) -> Script[None]:
        status = ChannelStatus((yield from self._integer(edcp.CHANNEL_STATUS)))
        events = ChannelEvents((yield from self._integer(edcp.CHANNEL_EVENTS))) & edcp.BLOCKING
        if events or status & ChannelStatus.EMERGENCY_OFF:
            causes = names_of(events) or "EMERGENCY_OFF"
            raise DeviceRefused(
                self._label, f"is not switched on while {causes} is latched", "Find the cause, then clear."
            )
        if status & ChannelStatus.ON:
            return
        # Written once only: a channel that trips at once must not be switched on again by a repetition.
        foreign = (yield from self._integer(edcp.CHANNEL_CONTROL)) & ~edcp.OWN_CONTROL
        frame = write(self._module, edcp.CHANNEL_CONTROL, foreign | ChannelControl.ON, self._channel)
        control = yield from self._integer(edcp.CHANNEL_CONTROL, (frame,), once=True)
        for _ in range(SWITCH_ON_LOOKS):
            status = ChannelStatus((yield from self._integer(edcp.CHANNEL_STATUS)))
            if status & ChannelStatus.ON and control & ChannelControl.ON:
                return
            control = yield from self._integer(edcp.CHANNEL_CONTROL, delay_s=SWITCH_ON_WAIT_S)
        events = ChannelEvents((yield from self._integer(edcp.CHANNEL_EVENTS)))
        module = yield from self._integer(edcp.MODULE_EVENTS)
        raise DeviceRefused(
            self._label,
            f"did not switch on: control {control:04X}, status {names_of(status) or 'off'}, latched events "
            f"{names_of(events) or 'none'}, latched events of the module {module:04X}",
            "A latched event blocks it until it is cleared. Check safety loop, inhibit input and limits; then clear.",
        )

    def _switch_off(self) -> Script[None]:
        """Ramp down and switch off, at the ramp that was asked for last; if it cannot be set, at the module's own."""
        refused: DeviceError | None = None
        if self._wanted_ramp is not None:
            try:
                yield from self._write_ramp(self._wanted_ramp)
            except DeviceError as error:
                refused = error
        # An emergency off stays latched: only `clear` takes it back.
        latched = ChannelControl((yield from self._integer(edcp.CHANNEL_CONTROL))) & ChannelControl.EMERGENCY_OFF
        yield from self._write_control(latched)
        if refused is not None:
            raise refused

    def _emergency_off(self) -> Script[None]:
        """Wait for the confirmation of what `_repeat_emergency_off` sends: our own bits only."""
        failure: DeviceError = DeviceRefused(self._label, "the channel's control does not take it")
        try:
            for attempt in range(EMERGENCY_LOOKS):
                self._control = yield from self._integer(
                    edcp.CHANNEL_CONTROL, delay_s=EMERGENCY_AGAIN_S * (attempt > 0)
                )
                if self._control & ChannelControl.EMERGENCY_OFF:
                    self._emergency_until_confirmed = False
                    return
        except DeviceError as error:
            failure = error
        self._link.write(edcp.EMERGENCY_OFF_ALL)
        raise type(failure)(
            self._label,
            f"EMERGENCY OFF IS NOT CONFIRMED ({failure.what}); it was sent to all modules on the bus as well",
            "Take the high voltage away by hand: safety loop or mains switch, then ground the electrodes.",
        )

    def _clear(self) -> Script[None]:
        yield from self._write_control(ChannelControl(0))
        yield from self._acknowledge(edcp.MODULE_EVENTS, None)
        left = ChannelEvents((yield from self._acknowledge(edcp.CHANNEL_EVENTS, self._channel))) & edcp.BLOCKING
        if left:
            raise DeviceRefused(
                self._label, f"{names_of(left)} comes back after it was cleared", "Its cause persists: remove it first."
            )

    def _acknowledge(self, item: Item, channel: int | None) -> Script[int]:
        """Clear the latched bits of an event register by writing them back; returns what is left."""
        events = yield from self._integer(item)
        for _ in range(ATTEMPTS):
            if not events:
                break
            events = yield from self._integer(item, (write(self._module, item, events, channel),))
        return events
