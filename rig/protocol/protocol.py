"""The protocol: what is done to the specimen, step by step. A TOML file of ``[[step]]`` tables.

Displacements are of the disk out of the film's plane, from where the pusher meets the flat film. Steps do not know
the specimen; `rig.protocol.plan` turns them into moves, ramps and waits for one scene. What steps there are is known to
`rig.steps.registry`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from rig.base.choice import Choice
from rig.base.table import Table
from rig.base.toml_file import load_table
from rig.steps import registry
from rig.steps.base import Step

AnyStep = Annotated[Step, Choice("do", registry.find, registry.names)]


class Protocol(Table):
    """A titled list of steps."""

    title: str = Field(default="", description="What the protocol is for; it stands over tables and in the log.")
    accept: list[str] = Field(
        default_factory=list,
        max_length=50,
        description='Keys whose unusual values are meant, by name: ["step.threshold_mN"].',
    )
    step: list[AnyStep] = Field(min_length=1, max_length=1000, description="The steps, in order: [[step]] tables.")


def load_protocol(path: Path) -> tuple[Protocol, str]:
    """The protocol in ``path`` and its exact text.

    Raises
    ------
    ConfigError
        Naming file, step, key, value and what is allowed.
    """
    return load_table(path, Protocol, "protocol")
