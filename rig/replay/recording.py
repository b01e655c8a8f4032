"""A log as what it was: an experiment, and everything that passed on its wires, in the order of the file."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from calibration.sensors.certificate import Certificate
from rig.base.errors import ConfigError, LimitError
from rig.base.toml_file import parse_table
from rig.log import schema
from rig.log.contents import ON_PORTS, ON_SERVED_PORTS, bench_of, certificates_in
from rig.log.decimation import KEPT
from rig.log.errors import LogError
from rig.log.reader import Log, read_log
from rig.protocol.experiment import Experiment
from rig.protocol.plan import earlier_cycles, plan, plan_resumed
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.steps.base import Action

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class Row(NamedTuple):
    """One message: its topic, its payload as it lies in the log, its fields, its two times (ns since 1970).

    ``log_ns`` is when it was written. ``about_ns`` is the time that it is about: of bytes, the beginning of the turn of
    the engine's loop in which they passed; of everything else, `t`.
    """

    topic: str
    payload: bytes
    fields: dict[str, Any]
    log_ns: int
    about_ns: int

    @property
    def t(self) -> float:
        """The row's own time, in seconds since the start of the run."""
        return float(self.fields["t_s"])


class Step(NamedTuple):
    """What the protocol was doing from ``t`` on."""

    t: float
    text: str


class OperatorAct(NamedTuple):
    """What the operator did at ``t``: as `rig.log.recorder.Recorder.operator` has it."""

    t: float
    what: str
    text: str
    by: str


@dataclass(frozen=True)
class Recording:
    """One log, ready to be replayed.

    Attributes
    ----------
    log : Log
    rows : list of Row
        In the order of the file, which is the order in which things happened, up to the first gap.
    problem : str
        What of the log cannot be replayed and why; empty when it is whole.
    """

    log: Log
    rows: list[Row]
    problem: str

    @cached_property
    def experiment(self) -> Experiment:
        """Scene, protocol and certificates from inside the log, planned anew."""
        where = f"{self.log.path} ({{}} inside)"
        scene_text, protocol_text = self.text("scene.toml"), self.text("protocol.toml")
        scene = self._as_recorded(parse_table(scene_text, Scene, "scene", where.format("scene.toml")))
        protocol = parse_table(protocol_text, Protocol, "protocol", where.format("protocol.toml"))
        try:
            actions = self._actions(protocol, scene)
        except (ConfigError, LimitError) as error:
            raise LogError(self.log.path, f"its protocol cannot be planned today ({error})") from None
        return Experiment(scene, scene_text, protocol, protocol_text, self.certificates, actions, [])

    def _as_recorded(self, scene: Scene) -> Scene:
        """The scene, with instruments that ask what the release asked that made the log, and no more."""
        sent: dict[str, list[bytes]] = {role: [] for role in scene.instruments}
        for row in self.rows:
            role = row.topic.removeprefix("/raw/").removesuffix("/tx")
            if row.topic.endswith("/tx") and role in sent:
                sent[role].append(row.fields["data"])
        for role, table in scene.instruments.items():
            table.as_recorded(sent[role])
        return scene

    def _actions(self, protocol: Protocol, scene: Scene) -> list[Action]:
        """Of the whole protocol; of a run that took up another one, of what that had left."""
        resumed = self.log.metadata.get("resumed")
        if resumed is None:
            return plan(protocol, scene)
        try:
            first = int(resumed["at_step"])
            still_valid = {int(step) for step in resumed.get("preconditioning_still_valid", "").split()}
            done = earlier_cycles(resumed)
        except (KeyError, ValueError):
            raise LogError(self.log.path, "does not say at which step it was resumed") from None
        return plan_resumed(protocol, scene, first, still_valid, "Is all as the other run left it?", done)

    @cached_property
    def certificates(self) -> dict[str, Certificate]:
        """By role, those that the log holds."""
        return certificates_in(self.log)

    @cached_property
    def operator_acts(self) -> list[OperatorAct]:
        """In the order of time."""
        if "/operator" not in self.log.topics:
            return self._acts_of_older_log()
        rows = [row.fields for row in self.rows if row.topic == "/operator"]
        return [OperatorAct(f["t_s"], f["act"], f["text"], f["by"]) for f in rows]

    def _acts_of_older_log(self) -> list[OperatorAct]:
        """Older logs say it in sentences that begin with one of these words."""
        words = {"asked": "is asked", "answered": "answers", "paused": "pauses", "continues": "continues"}
        said = [
            (row.t, row.fields["message"].split()[0].rstrip(":"))
            for row in self.rows
            if row.topic == "/event" and row.fields["source"] == "operator"
        ]
        acts = [OperatorAct(t, words[word], "", "") for t, word in said if word in words]
        reason = (self.log.outcome or {}).get("reason", "")
        if reason.startswith("stopped by "):
            acts.append(OperatorAct(math.inf, "stops", "", reason.removeprefix("stopped by ")))
        return acts

    @cached_property
    def steps(self) -> list[Step]:
        """The protocol's steps, in the order of time."""
        phases = [row.fields for row in self.rows if row.topic == "/phase"]
        return [Step(f["t_s"], f"step {f['step']} ({f['kind']}: {f['label']})") for f in phases]

    @cached_property
    def start_ns(self) -> int:
        """When the run's clock was at zero, to a nanosecond."""
        row = next((row for row in self.rows if not row.topic.startswith("/raw/")), self.rows[0])
        return row.about_ns - round(row.t * 1e9)

    def step_at(self, t: float) -> str:
        """What the protocol was doing at time ``t``."""
        return next((step.text for step in reversed(self.steps) if step.t <= t), "the set-up, before the first step")

    def text(self, name: str) -> str:
        """A text file from inside the log."""
        attachment = self.log.attachments.get(name)
        if attachment is None:
            raise LogError(self.log.path, f"has no {name} inside that can be read", "It cannot be replayed.")
        return attachment.data.decode(errors="replace")

    @property
    def in_virtual_time(self) -> bool:
        """Whether the run's clock was a virtual one, so that its times come out the same again."""
        return bench_of(self.log) not in (ON_PORTS, ON_SERVED_PORTS)


def counted_device(topic: str, fields: Mapping[str, Any]) -> str:
    """The device whose polling has ended with this row, since its counters are written; empty if none."""
    if topic == "/counter":
        return str(fields["device"])
    if topic == "/event" and str(fields["message"]).startswith("counted: "):  # as older logs say it
        return str(fields["source"])
    return ""


def numbers(argument: str) -> list[float]:
    """The numbers in the argument of a command, as they were given."""
    return [float(number) for number in _NUMBER.findall(argument)]


def load_recording(path: Path) -> Recording:
    """The log at ``path``, finished, cut short or damaged.

    Raises
    ------
    LogError
        The file cannot be read, is not a log of this schema version, or holds nothing that passed on a wire.
    """
    log = read_log(path)
    if not any(topic.startswith("/raw/") for topic in log.topics):
        raise LogError(path, "holds no bytes of any wire", "There is nothing to replay.")
    rows: list[Row] = []
    problem = "" if log.ended else "it was cut short"
    for chunk in _chunks(log):
        if chunk is None:
            problem = "something is missing after that"
            break
        rows += chunk
    left_out = next((k for k, row in enumerate(rows) if row.topic == KEPT and not row.fields["keeping"]), None)
    if left_out is not None:
        at = rows[left_out].t
        del rows[left_out:]
        return Recording(log, rows, f"from {at:.3f} s on the log keeps cycles by a rule and not every byte")
    if log.gaps:
        gap = log.gaps[0]
        problem = f"{problem or 'damaged'}; bytes {gap.start} to {gap.end} of the file: {gap.reason}"
    return Recording(log, rows, problem)


def _chunks(log: Log) -> Iterator[list[Row] | None]:
    """The rows of each chunk; None, and then nothing more, where messages are missing."""
    expected: dict[str, int] = {}
    rows: list[Row] = []
    for message in log.raw_messages():
        if message is None:
            yield rows
            rows = []
            continue
        channel, sequence, log_ns, about_ns, payload = message
        topic = channel.topic
        if topic not in schema.CHANNELS:
            continue
        if sequence != expected.get(topic, 1):
            yield None
            return
        expected[topic] = sequence + 1
        try:
            rows.append(Row(topic, payload, schema.decode(topic, payload), log_ns, about_ns))
        except ValueError as error:
            raise LogError(log.path, str(error), "Another program wrote it, or wrote into it.") from error
