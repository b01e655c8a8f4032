"""A run that ended early, taken up again from its log at the next protocol step, on the same specimen.

Scene, protocol and certificates are those inside the log, byte for byte. The step at which the run ended is begun
anew; before it the references are taken again (home, zero, approach) and the film is preconditioned again, unless that
was completed recently enough. The instruments must be those of the log, by their serial numbers, and the force
sensor's zero must still be near the one taken then.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calibration.sensors.certificate import Certificate
from drivers.roles import Identity
from rig.base.clock import VIRTUAL_EPOCH_NS, calendar_now
from rig.base.errors import ConfigError
from rig.base.toml_file import parse_table, validate
from rig.log.contents import IN_MEMORY, bench_of, bench_word, certificates_in, identities_in
from rig.log.reader import Log, read_log
from rig.protocol.experiment import Experiment, are_served
from rig.protocol.plan import CYCLES, REFERENCE, earlier_cycles, plan, plan_resumed
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.steps.rig import CyclesDone


def prepare_resumed(
    path: Path, ports: dict[str, dict[str, object]] | None = None, now_ns: int | None = None
) -> Experiment:
    """What is left to be done of the run in the log at ``path``; touches no hardware.

    Parameters
    ----------
    ports : dict, optional
        As for `rig.protocol.experiment.prepare`.
    now_ns : int, optional
        Nanoseconds since 1970 at which it is taken up; by default now, and on the bench in memory, whose film is a new
        one each time, the beginning of its time.

    Raises
    ------
    LogError, ConfigError, LimitError
        The log cannot be read, its run came to its end, or what is left of it cannot be planned.
    """
    log = read_log(path)
    scene_text, protocol_text = _text(log, "scene.toml"), _text(log, "protocol.toml")
    scene = parse_table(scene_text, Scene, "scene", f"{path} (scene.toml inside)")
    protocol = parse_table(protocol_text, Protocol, "protocol", f"{path} (protocol.toml inside)")
    if ports is not None:
        scene = scene.with_ports(ports)
    served = ports is not None and are_served(ports)
    scene = _with_serials(scene, identities_in(log), path)
    first = _next_step(log)
    if now_ns is None:
        now_ns = round(calendar_now().timestamp() * 1e9) if scene.on_real_ports else VIRTUAL_EPOCH_NS
    still_valid = _still_valid(log, protocol, first, now_ns)
    ended = datetime.fromtimestamp(log.end_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M UTC")
    question = (
        f"Going on at step {first} of {len(protocol.step)}. Is specimen {scene.specimen.name} still mounted as the run "
        f"of {ended} left it, and nothing in the way of the stage, which finds its reference position first?"
    )
    certificates = _certificates(log)
    done = counted(log, first)
    actions = plan_resumed(protocol, scene, first, still_valid, question, done)
    plan(protocol, scene)  # what is left must belong to a protocol that can be carried out
    experiment = Experiment(
        scene,
        scene_text,
        protocol,
        protocol_text,
        certificates,
        actions,
        check_plan(actions, scene, certificates["force"].noise),
        resumed={
            "log": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "scene_sha256": hashlib.sha256(scene_text.encode()).hexdigest(),
            "at_step": str(first),
            "preconditioning_still_valid": " ".join(map(str, sorted(still_valid))),
            **({} if done is None else {CYCLES: str(done.count), REFERENCE: repr(done.reference)}),
        },
        stored_zero=_force_zero(log),
        earlier=(*_earlier(log), path),
        served=served,
    )
    _check_bench(experiment, bench_of(log), path)
    return experiment


def _check_bench(experiment: Experiment, then: str, path: Path) -> None:
    """A run goes on where it was begun."""
    if then in ("", experiment.bench):
        return
    ports = " Name its ports with --ports." if experiment.bench == IN_MEMORY else ""
    raise ConfigError(
        f"{path}: this run was begun on another bench: {bench_word(then)} ({then}). Here it would go on with "
        f"{bench_word(experiment.bench)} ({experiment.bench}).{ports} Nothing was touched."
    )


def _text(log: Log, name: str) -> str:
    attachment = log.attachments.get(name)
    if attachment is None:
        raise ConfigError(f"{log.path}: holds no {name}, so its run cannot be taken up again.")
    return attachment.data.decode(errors="replace")


def _certificates(log: Log) -> dict[str, Certificate]:
    found = certificates_in(log)
    if "force" not in found:
        raise ConfigError(f"{log.path}: holds no certificate of the force sensor, so its run cannot be taken up again.")
    return found


def _with_serials(scene: Scene, identities: Mapping[str, Identity], path: Path) -> Scene:
    """The scene with the serial numbers of the log's instruments required."""
    raw: dict[str, Any] = scene.model_dump(exclude_none=True)
    for role in scene.instruments:
        if role not in identities:
            raise ConfigError(f"{path}: does not say which {role} instrument it was made with: the run never began.")
        if identities[role].serial:
            raw[role]["serial"] = identities[role].serial
    return validate(raw, Scene, "scene", f"{path} (scene.toml inside, with the serial numbers of its instruments)")


def _next_step(log: Log) -> int:
    if (log.outcome or {}).get("status") == "complete":
        raise ConfigError(f"{log.path}: this run came to its end; there is nothing to resume.")
    begun = [int(message.fields["step"]) for message in log.messages("/phase")]
    return max(begun, default=1)


def _still_valid(log: Log, protocol: Protocol, first: int, now_ns: int) -> set[int]:
    """Steps that were completed so recently that they need not be done again."""
    phases = sorted(log.messages("/phase"), key=lambda message: message.log_ns)
    found = set()
    for number, step in enumerate(protocol.step[: first - 1], start=1):
        later = [message.log_ns for message in phases if message.fields["step"] > number]
        if later and 0 <= now_ns - later[0] <= step.valid_for_s * 1e9:
            found.add(number)
    return found


def cycles_done(log: Log, step: int) -> CyclesDone | None:
    """What the run of ``log`` had counted of a step of cycles, with what it had taken over from an earlier one."""
    earlier = log.metadata.get("resumed", {})
    found = earlier_cycles(earlier) if earlier.get("at_step") == str(step) else None
    count, reference = (0, math.nan) if found is None else (found.count, found.reference)
    for message in log.messages("/cycle"):
        if message.fields["step"] == step and message.fields["whole"]:
            count = max(count, message.fields["cycle"])
    phases = [(m.log_ns, m.fields["step"]) for m in log.messages("/phase")]
    for message in log.messages("/reference"):
        began = [number for ns, number in phases if ns <= message.log_ns]
        if message.fields["name"] == "cycle_response" and began[-1:] == [step]:
            reference = message.fields["value"]
    return CyclesDone(count, reference) if count else None


def counted(log: Log, step: int) -> CyclesDone | None:
    """What the run of ``log`` had counted of a step: cycles, or the questions of a closed loop and their seconds."""
    found = cycles_done(log, step)
    for message in log.messages("/decision"):
        if message.fields["step"] == step:
            found = CyclesDone(message.fields["number"], message.fields["spent_s"])
    return found


def _earlier(log: Log) -> list[Path]:
    """Logs of the runs that this one went on with, as far as they lie beside it; the first of them first."""
    found: list[Path] = []
    name = log.metadata.get("resumed", {}).get("log", "")
    while name and (path := log.path.with_name(Path(name).name)).is_file() and path not in found:
        found.append(path)
        name = read_log(path).metadata.get("resumed", {}).get("log", "")
    return found[::-1]


def _force_zero(log: Log) -> float | None:
    zeros = [m.fields["value"] for m in log.messages("/reference") if m.fields["name"] == "force_zero"]
    return float(zeros[-1]) if zeros else None
