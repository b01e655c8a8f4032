"""Makes a whole log out of one that was cut short or damaged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rig.base.text import printable
from rig.log.container import ContainerWriter
from rig.log.errors import LogError
from rig.log.part_file import PartFile
from rig.log.reader import Log, read_log

COMPLETE, NOTHING, PARTIAL = 0, 1, 3


@dataclass(frozen=True)
class Recovery:
    """What came of a recovery.

    Attributes
    ----------
    exit_code : int
        0: nothing is missing, 3: what is missing is in ``report``.
    report : str
        For the operator, several lines.
    """

    exit_code: int
    report: str


def recover(path: Path, out: Path) -> Recovery:
    """Copy everything that can be read from the log at ``path`` into a whole log at ``out``.

    Damaged chunks are skipped, not stopped at. Messages keep their sequence numbers, so that what is missing stays
    visible, and the new log says in its metadata ``recovered`` what it came from.

    Raises
    ------
    LogError
        Nothing can be recovered (exit code 1), ``out`` exists, or cannot be written.
    """
    log = read_log(path)
    if not log.topics and not log.attachments:
        raise LogError(path, "holds nothing that can be recovered", "Keep the file; there is no copy to work from.")
    report = _report(log)
    file = PartFile(out, ".recovering")  # <out>.part may be what is recovered
    try:
        _copy(log, ContainerWriter(file.put), report)
        file.finish()
    except BaseException:
        if file.is_open:
            file.discard()
        raise
    return Recovery(COMPLETE if _is_complete(log) else PARTIAL, "\n".join(report))


def _copy(log: Log, container: ContainerWriter, report: list[str]) -> None:
    outcome = None
    for name, table in log.metadata.items():
        if name == "outcome":
            outcome = table
        else:
            container.add_metadata(name, table)
    for attachment in log.attachments.values():
        container.add_attachment(attachment.name, attachment.media_type, attachment.data)
    channels: dict[str, int] = {}
    for message in log.raw_messages():
        if message is None:
            container.end_chunk()
            continue
        channel, sequence, log_ns, publish_ns, payload = message
        if channel.topic not in log.topics:
            continue
        if channel.topic not in channels:
            channels[channel.topic] = container.add_channel(channel.topic, channel.schema_name, channel.schema_data)
        container.add_message(channels[channel.topic], payload, log_ns, publish_ns, sequence)
    name = "recovered"
    while name in log.metadata:
        name += "-again"
    container.add_metadata(name, {"from": log.path.name, **{f"{n:03}": line for n, line in enumerate(report)}})
    if outcome is not None:
        container.add_metadata("outcome", outcome)
    container.finish()


def _is_complete(log: Log) -> bool:
    return log.whole and log.outcome is not None


def _report(log: Log) -> list[str]:
    lines = [f"{sum(log.topics.values())} messages on {len(log.topics)} topics recovered."]
    lines += [
        f"{printable(topic)}: {n} messages left out, they are not of this program" for topic, n in log.unknown.items()
    ]
    if _is_complete(log):
        return [*lines, "Nothing is missing."]
    lines += [f"bytes {gap.start} to {gap.end}: {gap.reason}" for gap in log.gaps]
    lines += [f"{topic}: {count} messages missing" for topic, count in log.missing.items()]
    if "cut" in log.metadata:
        reason = printable(log.metadata["cut"].get("reason", "not said why"))
        lines.append(f"The run was cut short ({reason}): its last 150 ms may not have reached the log.")
    if not log.ended:
        lines.append("The log was cut short: what was recorded after the last message read is not known.")
    if log.outcome is None:
        lines.append("Why and how the run ended is not in the log.")
    return lines
