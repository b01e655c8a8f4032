"""What a run leaves inside its log beside the samples: the certificates it used, and who its instruments were."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from drivers.instrument import MONITORS
from drivers.roles import Identity
from rig.base.certificates import parse_certificate
from rig.base.errors import ConfigError, DataError
from rig.base.text import printable
from rig.base.text_file import decode
from rig.base.toml_file import parse_table
from rig.base.toml_text import parse_toml
from rig.log.errors import LogError
from rig.log.reader import Log
from rig.scene.scene import Scene

if TYPE_CHECKING:
    from calibration.sensors.certificate import Certificate

# In a log's metadata: on what bench it was. In memory its truth is that of its own scene.
IN_MEMORY, ON_SERVED_PORTS, ON_PORTS = "simulated in memory", "simulated on pseudo-terminals", "real ports"
REPLAY_OF = "replay of "

# Older logs say it in one sentence. A model may hold commas; serial number and firmware do not.
_SAID = re.compile(r"model (.*), serial ([^,;]*), firmware ([^,;]*)(?:;|$)")


AIR = (
    ("temperature_K", "measured_temperature_C", 1.0, -273.15),
    ("relative_humidity", "measured_humidity_percent", 100.0, 0.0),
)
"""Of a monitor's field: its name beside those of ``[session]``, and what makes that unit of it."""


def bench_of(log: Log) -> str:
    """On what bench a log was recorded, in the words above; empty where it does not say."""
    return log.metadata.get("run", {}).get("bench", "")


def is_real(bench: str) -> bool:
    """Whether a bench in these words is hardware: whatever is not known to be simulated or replayed."""
    return bench not in (IN_MEMORY, ON_SERVED_PORTS) and not bench.startswith(REPLAY_OF)


def bench_word(bench: str) -> str:
    """The word with which every run begins, and every report."""
    if is_real(bench):
        return "REAL PORTS"
    return "REPLAY" if bench.startswith(REPLAY_OF) else "SIMULATED"


def scene_in(log: Log) -> Scene:
    """The scene that the log was recorded with.

    Raises
    ------
    DataError
        A log without a scene.
    ConfigError
        A scene that today's software cannot read.
    """
    attached = log.attachments.get("scene.toml")
    if attached is None:
        raise DataError(f"{log.path}: holds no scene, so its specimen is not known.")
    return parse_table(attached.data.decode("utf-8", "replace"), Scene, "scene", f"{log.path}, scene.toml")


def session_in(log: Log) -> dict[str, str]:
    """What the scene inside says under ``[session]``: operator, sample, notes, temperature, humidity. As it stands
    there: the scene may be of another version of this program, or damaged, and then says nothing.
    """
    scene = log.attachments.get("scene.toml")
    try:
        said = parse_toml(decode(scene.data, "scene.toml", "scene"), "scene", "scene.toml") if scene else {}
    except ConfigError:
        return {}
    session = said.get("session")
    return {key: str(value) for key, value in session.items()} if isinstance(session, dict) else {}


def air_in(log: Log) -> dict[str, str]:
    """What monitors measured of the air at the film: mean, lowest and highest, in the units of ``[session]``."""
    found = {}
    topics = [f"/{name}/sample" for name in MONITORS if f"/{name}/sample" in log.topics]
    for columns in log.tables(topics).values():
        for field, key, scale, zero in AIR:
            values = columns[field][np.isfinite(columns[field])] * scale + zero
            if values.size:
                found[key] = f"{values.mean():.1f} ({values.min():.1f} to {values.max():.1f})"
    return found


def certificates_in(log: Log) -> dict[str, Certificate]:
    """The certificates of the sensors in use, by role.

    Raises
    ------
    LogError
        One of them cannot be used.
    """
    found: dict[str, Certificate] = {}
    for name, attachment in log.attachments.items():
        if name.startswith("certificate."):
            try:
                certificate = parse_certificate(attachment.data, f"{printable(name)} inside")
            except ConfigError as error:
                raise LogError(log.path, f"holds a certificate that cannot be used: {str(error).rstrip('.')}") from None
            role = name.split(".")[1]
            found[role if role in MONITORS else certificate.role] = certificate  # a voltage monitor has one of a supply
    return found


def identities_in(log: Log) -> dict[str, Identity]:
    """What each instrument stated of itself at the start of the run, by role."""
    found: dict[str, Identity] = {}
    for message in log.messages("/identity"):
        fields = message.fields
        found.setdefault(fields["device"], Identity(fields["model"], fields["serial"], fields["firmware"]))
    if found:
        return found
    for message in log.messages("/event"):
        said = _SAID.match(message.fields["message"])
        if said is not None:
            found.setdefault(message.fields["source"], Identity(*said.groups()))
    return found
