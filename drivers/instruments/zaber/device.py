"""A Zaber stage: what is asked of it when, and what its answers mean."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import NamedTuple, TypeVar

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, Schedule, Script, label
from drivers.heard import Heard
from drivers.instruments.zaber.codec import (
    FAULT_ADVICE,
    FLAGS,
    POWER_CYCLE,
    REJECTIONS,
    UNREFERENCED,
    VELOCITY_UNIT,
    WARNINGS,
    WHOLE,
    Alert,
    Codec,
    Info,
    Message,
    Reply,
    encode,
)
from drivers.instruments.zaber.second import SecondDevice
from drivers.instruments.zaber.travel import FULL_STEP_UM, Peripheral, full_step_um, not_known, swapped
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import Identity, StageSample

T = TypeVar("T")

FACTS = ("resolution", "limit.min", "limit.max", "accel")
CHANGED = -1  # of a setting: it was written, and not yet said to be taken


class _Command(NamedTuple):
    words: str
    axis: int

    def __str__(self) -> str:
        return self.words or "status"


# One or more questions within a script, ending in a value.
_Part = Generator[Ask[_Command], Answer[Reply], T]


class ZaberStage:
    """A `drivers.roles.Stage` on one axis of a Zaber device.

    Set-up reads identity, resolution, travel and speed from the device, clears old warnings (kept in
    ``settings["warnings_at_start"]``) and changes no setting; then the position is polled. Before its first motion
    the driver locks the manual knob of its own axis and asks a device that answers without checksums to send them;
    motions set the axis's speed. What it will change is in ``found`` as set-up found it, and is put back by `give_back`
    and by `close`.

    Two devices with one address answer everything twice and move together: they are refused in set-up, or at the latest
    before the first motion.

    The stage refuses to move while it has no reference (warning flags WR, WH). When a reference it had is gone, most
    likely because the device restarted, `poll` raises `DeviceRefused`; so it does, once, for each fault flag that
    appears. A motion command whose reply is lost is not repeated before the state has been asked.

    Parameters
    ----------
    name : str
        The device's name in the scene.
    link : ByteLink
        Its serial line.
    device, axis : int
        Address on the line.
    poll_rate_Hz : float
        How often the position is asked for.
    timeout_s : float
        How long to wait for each reply.
    full_step_um : float, optional
        Travel per full motor step; without it, that of a stage that is known by its id, or the stage is refused.
    peripheral_id : int, optional
        What must be plugged into this axis of a controller.
    boot_s : float
        How long the first answer may take.
    """

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        device: int = 1,
        axis: int = 1,
        poll_rate_Hz: float = 50.0,
        timeout_s: float = 0.25,
        full_step_um: float | None = None,
        peripheral_id: int | None = None,
        boot_s: float = 0.0,
    ) -> None:
        self.name = name
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"alerts": 0, "infos": 0, "unexpected_replies": 0}
        self._label = label(name, link)
        self._link = link
        self._device, self._axis = device, axis
        self._schedule = Schedule(1.0 / poll_rate_Hz, self.counters)
        self._given_step, self._wanted_peripheral = full_step_um, peripheral_id
        self._codec = Codec(self.counters)
        self._boot_s = boot_s
        self._heard = Heard()
        self._dialogue: Dialogue[_Command, Reply] = Dialogue(
            self._label, self._send, self.counters, timeout_s=timeout_s, heard=self._heard
        )
        # A stop does not wait for the answer to something else, so it has a dialogue of its own; ids keep them apart.
        self._urgent: Dialogue[_Command, Reply] = Dialogue(
            self._label,
            self._send,
            self.counters,
            timeout_s=timeout_s,
            retries=5,
            advice="The stage may still be moving: cut its power.",
        )
        self._message_id = -1
        self._inbox: deque[Message] = deque()
        self._samples: list[StageSample] = []
        self._now = self._next_poll = 0.0
        self._ready = self._closed = False
        self._waiting_commands = 0
        self._next_motion: tuple[str, int | None] | None = None  # asked for, and not begun to be sent
        self._shown = "--"  # the flag in the last reply
        self._accepted_at = -math.inf
        self._busy = self._homing = False
        self._flags: tuple[str, ...] = ()
        self._referenced = self._reference_lost = False
        self._faults_told: set[str] = set()
        self._warned: set[str] = set()
        self._remarks: list[str] = []
        self._step = math.nan
        self._travel_steps = (0, 0)
        self._acceleration = math.nan  # m/s^2
        self._raw = 0
        self.found: dict[str, int] = {}
        self._present: dict[str, int] = {}  # the same settings as they are now
        self._held = False  # whether what it needs for motions has been set
        self._facts: dict[str, int] = {}  # numbers read in set-up that nothing should change
        self._second = SecondDevice(self._label, device)
        self._dialogue.begin(self._set_up())

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def travel(self) -> tuple[float, float]:
        """(lowest, highest) position in metres; NaN before set-up has ended."""
        low, high = self._travel_steps
        return low * self._step, high * self._step

    @property
    def moving(self) -> bool:
        return self._busy or self._waiting_commands > 0

    @property
    def referenced(self) -> bool:
        return self._referenced

    def braking_distance(self, speed: float) -> float:
        """How far it goes on (m) when it brakes from ``speed`` (m/s); NaN before set-up has ended."""
        return 0.5 * speed**2 / self._acceleration if self._acceleration != 0 else 0.0  # 0: it knows no ramp

    def home(self) -> None:
        """Drive to the home sensor, which gives the stage its reference."""
        self._require_ready()
        self._begin_motion("home")

    def move_to(self, position: float, speed: float) -> None:
        """Go to ``position`` (m) at ``speed`` (m/s); replaces a motion under way."""
        self._require_reference()
        low, high = self.travel
        if not low <= position <= high:
            raise DeviceRefused(
                self._label,
                f"position {position * 1e3:.6g} mm is outside the travel",
                f"Allowed: {low * 1e3:.7g} to {high * 1e3:.7g} mm.",
            )
        if not 0 < speed < math.inf:
            raise DeviceRefused(self._label, f"{speed * 1e3:.6g} mm/s is not a speed", "Give one above zero.")
        target = min(max(round(position / self._step), self._travel_steps[0]), self._travel_steps[1])
        self._begin_motion(f"move abs {target}", max_speed=max(1, self._speed_data(speed)))

    def move_by(self, distance: float, speed: float) -> None:
        """Go ``distance`` (m) further at ``speed`` (m/s), from a standstill.

        Sent as an absolute move: unlike ``move rel`` it does no harm when it arrives twice.
        """
        self._require_reference()
        if self.moving:
            raise DeviceRefused(
                self._label, "it is still moving; by how much to go on is not defined", "Stop it first."
            )
        self.move_to(self._raw * self._step + distance, speed)

    def move_velocity(self, velocity: float) -> None:
        """Move at ``velocity`` (m/s, negative towards home) until stopped or at the end of the travel."""
        self._require_reference()
        if not -math.inf < velocity < math.inf:
            raise DeviceRefused(self._label, f"{velocity * 1e3:.6g} mm/s is not a speed", "Give a finite one.")
        self._begin_motion(f"move vel {self._speed_data(velocity)}")

    def stop(self) -> None:
        """Decelerate to a standstill; overtakes everything queued."""
        self._halt("stop")

    def estop(self) -> None:
        """Stop at once, without the deceleration ramp; overtakes everything queued."""
        self._halt("estop")

    @property
    def given_back(self) -> bool:
        """Whether every setting is as it was found, by the device's own word."""
        return self._present == self.found

    def resume_found(self, found: Mapping[str, float]) -> dict[str, tuple[int, int]]:
        """Take over what an earlier run found; a knob that is enabled again shows that it was put right since."""
        if found.get("knob.enable") == 1 and self._present.get("knob.enable") == 1:
            return {}
        left = {key: (self._present[key], int(value)) for key, value in found.items() if key in self._present}
        left = {key: (now, before) for key, (now, before) in left.items() if now != before and before >= 0}
        self.found.update({key: before for key, (_, before) in left.items()})
        return left

    def give_back(self) -> None:
        """Set every setting back to what it was found as, when all that is queued has been done."""
        if self._ready and not self.given_back:
            self._dialogue.begin(self._giving_back())
            self._next_poll = self._now

    def poll(self, now: float) -> Sequence[StageSample]:
        self._now = now
        try:
            self._inbox.extend(self._codec.feed(self._heard.bytes(self._link.read())))
            while self._inbox:
                self._take(self._inbox.popleft(), now)
            if self._ready and self._dialogue.idle and self._schedule.take(now):
                self._dialogue.begin(self._watch())
            self._urgent.run(now)
            self._dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now  # there may be more to read
            raise
        due = self._schedule.due if self._dialogue.idle else math.inf
        self._next_poll = min(self._urgent.next_poll(now), self._dialogue.next_poll(now), due)
        samples, self._samples = self._samples, []
        return samples

    def remarks(self) -> list[str]:
        """Warning flags that are new, in words."""
        told, self._remarks = self._remarks, []
        return told

    def close(self) -> None:
        """Stop if moving, give settings back that were changed, all without waiting, and release the line."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(DeviceError):
            if self.moving:
                self._send(_Command("stop", self._axis))
            for key in self._changed():
                self._send(_Command(f"set {key} {self.found[key]}", self._axis_of(key)))
        self._link.close()

    def _send(self, command: _Command) -> Callable[[Reply], bool]:
        self._message_id = (self._message_id + 1) % 100
        expected = (self._device, command.axis, self._message_id)
        self._second.asked(expected, command.words)
        self._link.write(encode(self._device, command.axis, self._message_id, command.words))
        return lambda reply: (reply.device, reply.axis, reply.id) == expected

    def _take(self, message: Message, now: float) -> None:
        if isinstance(message, Alert):
            self.counters["alerts"] += 1
            self._schedule.start(now)  # something has changed: look at once
        elif isinstance(message, Info):
            self.counters["infos"] += 1
        elif self._urgent.offer(message, now) or self._dialogue.offer(message, now):
            self._second.answered(message)
        else:
            self.counters["unexpected_replies"] += 1
            self._second.heard_again(message)

    def _set_up(self) -> Script[_Command, Reply]:
        yield from self._ask("", axis=0, boot_s=self._boot_s)
        device_id = yield from self._number("get deviceid", axis=0)
        serial = yield from self._number("get system.serial", axis=0)
        version = (yield from self._ask("get version", axis=0)).message.data
        peripheral = yield from self._peripheral(device_id)
        self.identity = Identity(
            model=f"Zaber device {device_id}" + (f" peripheral {peripheral.id}" if peripheral.id else ""),
            serial=str(peripheral.serial or serial),  # the stage's own, which may be plugged in elsewhere tomorrow
            firmware=version,
        )
        self._facts = yield from self._read_facts()
        resolution, low, high, acceleration = (self._facts[key] for key in FACTS)
        max_speed = yield from self._number("get maxspeed")
        if not (resolution > 0 and low < high and max_speed > 0 and acceleration >= 0):
            raise DeviceRefused(
                self._label,
                f"its settings make no sense: resolution {resolution}, limit.min {low}, limit.max {high}, "
                f"maxspeed {max_speed}, accel {acceleration}",
                "Restore its settings in the maker's software.",
            )
        step_um = full_step_um(self._given_step, device_id, peripheral)
        if step_um is None:
            raise DeviceRefused(self._label, *not_known(device_id, peripheral, (high - low) / resolution))
        self._step = step_um * 1e-6 / resolution
        self._travel_steps = (low, high)
        self._acceleration = acceleration * 1e4 / VELOCITY_UNIT * self._step
        self.found = {"maxspeed": max_speed}
        for key in ("knob.enable", "comm.checksum"):
            answer = (yield from self._ask(f"get {key}", axis=self._axis_of(key), may_fail=True)).message
            if answer.accepted and WHOLE.fullmatch(answer.data):
                self.found[key] = int(answer.data)
        self._present = dict(self.found)
        # What is only history is cleared now, so that it is not blamed on this run; what is still there is the state.
        yield from self._read_flags()
        old_flags = self._flags
        if old_flags:
            yield from self._ask("warnings clear")
            yield from self._read_flags()
        self.settings |= {
            "deviceid": str(device_id),
            "serial": str(serial),
            "version": version,
            "resolution": str(resolution),
            "microstep_um": repr(self._step * 1e6),
            "limit.min": str(low),
            "limit.max": str(high),
            "maxspeed": str(max_speed),
            "accel": str(acceleration),
            "warnings_at_start": " ".join(old_flags),
            "knob": {0: "disabled", 1: "enabled"}.get(self.found.get("knob.enable", -1), "none"),
            "reply_checksums": "yes" if self._codec.checksums_seen else "no",
        }
        self._second.judge_all()
        self._schedule.start(self._now)
        self._ready = True

    def _peripheral(self, device_id: int) -> _Part[Peripheral]:
        """What is plugged into the axis; a stage with a controller of its own is not asked. Firmware 6 says its id."""
        if device_id in FULL_STEP_UM and self._wanted_peripheral is None:
            return Peripheral(0, 0)
        found = {}
        for key in ("peripheral.id", "peripheralid", "peripheral.serial"):
            reply = (yield from self._ask(f"get {key}", may_fail=True)).message
            found[key] = int(reply.data) if reply.accepted and WHOLE.fullmatch(reply.data) else 0
        one = Peripheral(found["peripheral.id"] or found["peripheralid"], found["peripheral.serial"])
        if one.id:
            self.settings |= {"peripheral_id": str(one.id), "peripheral_serial": str(one.serial)}
        if self._wanted_peripheral not in (None, one.id):
            raise DeviceRefused(self._label, *swapped(self._axis, one, self._wanted_peripheral))
        return one

    def _read_facts(self) -> _Part[dict[str, int]]:
        facts = {}
        for key in FACTS:
            facts[key] = yield from self._number(f"get {key}")
        return facts

    def _take_hold(self) -> _Part[None]:
        """Set what motions need, once: replies with checksums, and nobody at the knob of this axis."""
        if self._held:
            return
        if self._present.get("comm.checksum") == 0 and not self._codec.checksums_seen:
            yield from self._change("comm.checksum", 1)
            self.settings["reply_checksums"] = "yes" if self._codec.checksums_seen else "no"
            again = yield from self._read_facts()
            if again != self._facts:
                raise DeviceRefused(
                    self._label,
                    f"its settings were read as {self._facts} without checksums and are {again} with them",
                    "The line is bad: check cable and adapter. Nothing was moved.",
                )
        if self._present.get("knob.enable") == 1:
            yield from self._change("knob.enable", 0)
        self._held = True

    def _giving_back(self) -> Script[_Command, Reply]:
        self._held = False
        for key in self._changed():
            yield from self._change(key, self.found[key])

    def _changed(self) -> list[str]:
        """Which settings are not as they were found; checksums last, since they guard the others."""
        return [key for key, value in self.found.items() if self._present[key] != value]

    def _change(self, key: str, value: int) -> _Part[None]:
        """One that is not known to have been taken counts as changed."""
        present, self._present[key] = self._present[key], CHANGED
        if key == "comm.checksum" and value == 0:
            self._codec.checksums_seen = False  # its very answer may have none
        reply = (yield from self._ask(f"set {key} {value}", axis=self._axis_of(key), may_fail=True)).message
        self._present[key] = value if reply.accepted else present

    def _axis_of(self, key: str) -> int:
        """How the line works is a setting of the device, everything else one of the axis."""
        return 0 if key.startswith("comm.") else self._axis

    def _watch(self) -> Script[_Command, Reply]:
        """One position; and all flags when the one shown is not the first of those known, or motion has ended."""
        was_busy = self._busy
        answer = yield from self._ask("get pos")
        raw = self._raw = self._whole(answer.message, "get pos")
        shown = answer.message.warning
        if shown == "--":
            self._see_flags(())
        elif self._flags[:1] != (shown,) or (was_busy and not self._busy):
            yield from self._read_flags()
        self._samples.append(StageSample(answer.t, raw * self._step, self.moving, self._referenced, raw, self._flags))
        self._judge()

    def _begin_motion(self, words: str, *, max_speed: int | None = None) -> None:
        queued, self._next_motion = self._next_motion, (words, max_speed)
        if queued is None:
            self._waiting_commands += 1
            self._dialogue.begin(self._motion())
        self._next_poll = self._now

    def _motion(self) -> Script[_Command, Reply]:
        """The newest motion asked for: those that came while another was being sent have been replaced by it."""
        assert self._next_motion is not None
        (words, max_speed), self._next_motion = self._next_motion, None
        try:
            yield from self._take_hold()
            if not self._keeps_going(words):
                yield from self._check_reference(words)
                if self._flags:
                    yield from self._ask("warnings clear")
            if max_speed is not None and max_speed != self._present["maxspeed"]:
                self._present["maxspeed"] = CHANGED
                yield from self._ask(f"set maxspeed {max_speed}")
                self._present["maxspeed"] = max_speed
            was_busy = self._busy
            try:
                answer = yield from self._ask(words, repeat=False)
            except DeviceSilent:
                # Either the command or its reply was lost.
                yield from self._check_reference(words)
                if self._busy and not was_busy:
                    self._homing = words == "home"
                    return
                answer = yield from self._ask(words, repeat=False)
            self._homing = words == "home"
            self._accept(answer)
            if self._next_motion is not None and self._schedule.take(self._now):
                yield from self._watch()  # however fast motions follow each other, positions come in between
        finally:
            self._waiting_commands -= 1

    def _keeps_going(self, words: str) -> bool:
        """Whether a motion only replaces one under way, whose last reply showed no more than a note.

        A reply shows the weightiest flag; the lost reference and every fault weigh more than a note (N.).
        """
        shown = self._shown == "--" or self._shown.startswith("N")
        return words.startswith("move abs") and self._busy and not self._homing and self._referenced and shown

    def _check_reference(self, words: str) -> _Part[None]:
        yield from self._read_flags()
        self._judge()
        if words != "home":
            self._require_reference()

    def _halt(self, words: str) -> None:
        if self._ready:
            self._dialogue.clear()
        self._next_motion = None
        self._urgent.clear()
        self._waiting_commands = 1
        self._urgent.begin(self._halting(words))
        self._next_poll = self._now

    def _halting(self, words: str) -> Script[_Command, Reply]:
        try:
            self._accept((yield from self._ask(words)))
            self._homing = False
        finally:
            self._waiting_commands -= 1

    def _accept(self, answer: Answer[Reply]) -> None:
        """From here on only the reply to a later question can say that the stage stands still."""
        self._busy = True
        self._accepted_at = answer.received

    def _ask(
        self,
        words: str,
        *,
        axis: int | None = None,
        repeat: bool = True,
        may_fail: bool = False,
        boot_s: float = 0.0,
    ) -> _Part[Answer[Reply]]:
        command = _Command(words, self._axis if axis is None else axis)
        answer = yield Ask(command, repeat=repeat, boot_s=boot_s)
        reply = answer.message
        self._shown = reply.warning
        if reply.busy:
            self._busy = True
        elif answer.sent >= self._accepted_at:
            self._busy = False
        if not reply.accepted and not may_fail:
            meaning, advice = REJECTIONS.get(reply.data, ("for a reason that this driver does not know", ""))
            raise DeviceRefused(self._label, f"the stage rejected {words!r}: {meaning} ({reply.data})", advice)
        return answer

    def _number(self, words: str, axis: int | None = None) -> _Part[int]:
        return self._whole((yield from self._ask(words, axis=axis)).message, words)

    def _whole(self, reply: Reply, words: str) -> int:
        if not WHOLE.fullmatch(reply.data):
            raise DeviceRefused(self._label, f"the stage answered {reply.data!r} to {words!r}, which is no number")
        return int(reply.data)

    def _read_flags(self) -> _Part[None]:
        reply = (yield from self._ask("warnings")).message
        match = FLAGS.fullmatch(reply.data)
        flags = tuple(match[2].split()) if match else ()
        if match is None or int(match[1]) != len(flags):
            raise DeviceRefused(self._label, f"the stage answered {reply.data!r} to 'warnings', which is no list")
        self._see_flags(flags)

    def _see_flags(self, flags: tuple[str, ...]) -> None:
        had_reference = self._referenced
        self._flags = flags
        self._referenced = not UNREFERENCED.intersection(flags)
        if had_reference and not self._referenced and not self._homing:
            self._reference_lost = True
        self._faults_told.intersection_update(flags)
        warned = {flag for flag in flags if flag.startswith("W")} - UNREFERENCED
        if new := sorted(warned - self._warned):
            self._remarks.append(f"the stage warns of {_in_words(new)}")
        self._warned = warned

    def _judge(self) -> None:
        """Raise what the operator must know, once."""
        if self._reference_lost:
            self._reference_lost = False
            raise DeviceRefused(
                self._label,
                f"the stage has lost its reference position ({_in_words(self._flags)}); positions since then are wrong",
                "It has probably restarted: check its power, then home it again.",
            )
        if self._homing and not self._busy:
            self._homing = False
            if not self._referenced:
                raise DeviceRefused(
                    self._label,
                    f"homing ended without a reference position ({_in_words(self._flags)})",
                    "Check that the carriage is free, then home it again.",
                )
        faults = [flag for flag in self._flags if flag.startswith("F") and flag not in self._faults_told]
        if faults:
            self._faults_told.update(faults)
            advice = [FAULT_ADVICE[flag] for flag in faults if flag in FAULT_ADVICE] or [POWER_CYCLE]
            raise DeviceRefused(self._label, f"the stage reports {_in_words(faults)}", " ".join(advice))

    def _require_ready(self) -> None:
        if not self._ready:
            raise DeviceRefused(self._label, "the stage is not set up yet", "Poll it until it is ready.")

    def _require_reference(self) -> None:
        self._require_ready()
        if not self._referenced:
            raise DeviceRefused(
                self._label, f"the stage has no reference position ({_in_words(self._flags)})", "Home it first."
            )

    def _speed_data(self, speed: float) -> int:
        return round(speed / self._step * VELOCITY_UNIT)


def _in_words(flags: Sequence[str]) -> str:
    return ", ".join(f"{flag}: {WARNINGS.get(flag, 'unknown flag')}" for flag in flags)
