"""What may go into a log: looked at by whoever records, before anything is written or sent to a writer."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rig.log import schema
from rig.log.errors import LogError

_NAME = re.compile(r"(?!\.)[A-Za-z0-9._-]{1,64}")
_MAX_ATTACHMENT = 32 * 1024 * 1024
_MAX_MESSAGE = 64 * 1024
_MAX_NS = 2**63 - 1


class Checks:
    """Refuses with `LogError` what does not belong into the log at ``path``; the log stays as it was."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: set[tuple[str, str]] = set()

    def message(self, topic: str, fields: Mapping[str, Any], log_ns: int, publish_ns: int) -> bytes:
        """The bytes of a message; every field must be there and of its type."""
        if topic not in schema.CHANNELS:
            raise LogError(self._path, f"there is no topic {topic!r}", f"Topics: {', '.join(schema.CHANNELS)}.")
        if not (type(log_ns) is type(publish_ns) is int and 0 <= log_ns <= _MAX_NS and 0 <= publish_ns <= _MAX_NS):
            self._wrong_time(topic, log_ns, publish_ns)
        try:
            data = schema.encode(topic, fields)
        except ValueError as error:
            raise LogError(self._path, str(error), "See rig.log.schema.CHANNELS.") from error
        if len(data) > _MAX_MESSAGE:
            raise LogError(
                self._path, f"a message of {len(data)} bytes on {topic}", f"At most {_MAX_MESSAGE} are allowed."
            )
        return data

    def _wrong_time(self, topic: str, log_ns: int, publish_ns: int) -> None:
        for name, ns in (("log_ns", log_ns), ("publish_ns", publish_ns)):
            if type(ns) is not int or not 0 <= ns <= _MAX_NS:
                raise LogError(self._path, f"{name} is {ns!r} on {topic}", "It must be nanoseconds since 1970, an int.")

    def attachment(self, name: str, data: bytes) -> None:
        """A file; each name once."""
        if len(data) > _MAX_ATTACHMENT:
            raise LogError(
                self._path, f"attachment {name} has {len(data)} bytes", f"At most {_MAX_ATTACHMENT} are allowed."
            )
        self._name("attachment", name)

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """A table of text; each name once."""
        for text in (part for item in mapping.items() for part in item):
            if not isinstance(text, str) or any("\ud800" <= letter <= "\udfff" for letter in text):
                raise LogError(self._path, f"metadata {name}: {text!r} is not text", "Keys and values must be text.")
        self._name("metadata", name)

    def _name(self, kind: str, name: str) -> None:
        if not _NAME.fullmatch(name):
            raise LogError(
                self._path, f"{kind} name {name!r}", "Allowed: 1 to 64 of A-Z a-z 0-9 . _ -, no leading dot."
            )
        if (kind, name) in self._names:
            raise LogError(self._path, f"{kind} {name!r} is in the log already", "Each name once.")
        self._names.add((kind, name))
