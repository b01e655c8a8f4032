"""The errors on which the operator must act, apart from those that devices and logs raise themselves.

Every one is a whole message: what happened, where, what is allowed, what to do. The command line prints it without a
traceback and ends with ``exit_code``.
"""

from __future__ import annotations


class RigError(Exception):
    """Base of the family."""

    exit_code = 1


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


class Stopped(RigError):
    """The operator ended the run."""

    exit_code = 130


class DataError(RigError):
    """Logs from which what was asked cannot be worked out."""
