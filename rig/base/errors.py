"""The errors on which the operator must act, apart from those that devices and logs raise themselves.

Every one is a whole message: what happened, where, what is allowed, what to do. The command line prints it without a
traceback and ends with ``exit_code``. Facts about it are fields, which go through processes as they are
(`RigError.fields` and `from_fields`); nothing reads the sentence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


class RigError(Exception):
    """Base of the family.

    Parameters
    ----------
    text : str
        The whole message.
    device : str
        Role of the instrument that it is about; empty: none.
    cause : str
        What led to it, where that is another error's message.
    """

    exit_code = 1
    breakdown = False  # whether it is the film's breakdown that shows

    def __init__(self, text: str = "", *, device: str = "", cause: str = "") -> None:
        super().__init__(text)
        self.device = device
        self.cause = cause

    def fields(self) -> dict[str, Any]:
        """All of it, for another process."""
        return {
            "kind": type(self).__name__,
            "text": str(self),
            "device": self.device,
            "cause": self.cause,
            "exit_code": self.exit_code,
        }


class ConfigError(RigError):
    """A scene, protocol or certificate file that cannot be used: names file, key, value and what is allowed."""

    exit_code = 2


class LimitError(RigError):
    """A planned, commanded or measured value outside its limit, or without a number to compare."""

    exit_code = 3


class FaultError(RigError):
    """Something went wrong while the rig was running; the run was ended and the rig made safe."""

    exit_code = 4


class StaleData(FaultError):
    """A sensor is silent, frozen or gives no values: the run ends, and the voltage is ramped down."""


class Breakdown(FaultError):
    """The film has broken down: it draws more current than charges it and may leak, or the supply reports an arc.

    Where the supply measures no current: its output has sagged, which a film that has broken down does to it.
    """

    breakdown = True


class BreakdownCurrent(LimitError):
    """The current is outside its limit, and charging the film does not explain it."""

    breakdown = True


class Stopped(RigError):
    """The operator ended the run."""

    exit_code = 130


class DataError(RigError):
    """Logs from which what was asked cannot be worked out."""


class NotSafe(FaultError):
    """The run has ended, but its high-voltage output was not measured off. Worse than whatever ended it."""


def from_fields(fields: Mapping[str, Any]) -> RigError:
    """The error that `RigError.fields` was made of; one of a kind that is not known here keeps its exit code."""
    known = {kind.__name__: kind for kind in _family(RigError) if kind.__init__ is RigError.__init__}
    error = known.get(fields["kind"], RigError)(fields["text"], device=fields["device"], cause=fields["cause"])
    error.exit_code = fields["exit_code"]
    return error


def _family(kind: type[RigError]) -> Iterator[type[RigError]]:
    yield kind
    for child in kind.__subclasses__():
        yield from _family(child)
