"""The files of a new driver: templates of ``sim_fixtures/skeleton`` with what depends on the role filled in."""

from __future__ import annotations

import keyword
import re
import shutil
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from drivers.registry import of_role
from rig.base.errors import ConfigError
from rig.base.outputs import write_text

FILES = {
    "pyproject.txt": "pyproject.toml",
    "driver.txt": "{module}.py",
    "twin.txt": "{module}_twin.py",
    "test.txt": "test_{module}.py",
}
_NAME = re.compile(r"[a-z](?:[a-z0-9]|-(?=[a-z0-9])){1,30}")
_MARK = re.compile(r"@([A-Z_]+)@")

_ONE = r"([+-][0-9]+\.[0-9]+)"
_RATE = """    {key}: float = Field(default={default}, gt=0, le=100, description="How often it is read (Hz).")
"""
_RATE_METHOD = '''    @property
    def rate(self) -> float:
        """Values asked for per second."""
        return self._rate
'''
_NOT_YET = """        raise self._not_yet("{what}")
"""
_NOT_YET_METHOD = """
    def _not_yet(self, what: str) -> DeviceRefused:
        return DeviceRefused(self._label, f"this driver cannot {what} yet", "Write it, with its test.")
"""
_STAGE_METHODS = (
    '''    @property
    def travel(self) -> tuple[float, float]:
        """(lowest, highest) position in metres. Read it from the device."""
        return 0.0, 0.15

    @property
    def moving(self) -> bool:
        return False

    @property
    def referenced(self) -> bool:
        """Whether its position means something. Read it from the device."""
        return False

    def braking_distance(self, speed: float) -> float:
        """How far it goes on (m) when it brakes from ``speed`` (m/s)."""
        return 0.0

    def stop(self) -> None:
        """Decelerate to a standstill; overtakes everything queued. Write it first of all."""
'''
    + _NOT_YET.format(what="stop")
    + """
    def home(self) -> None:
"""
    + _NOT_YET.format(what="home")
    + '''
    def move_to(self, position: float, speed: float) -> None:
        """Mark its request with ``repeat=False``: a motion that is sent twice may move twice."""
'''
    + _NOT_YET.format(what="move")
    + _NOT_YET_METHOD
)
_HV_METHODS = (
    '''    @property
    def nominal(self) -> tuple[float, float]:
        """(volts, amperes) that it can give at most. Read it from the device."""
        return 5000.0, 1e-3

    @property
    def fastest_ramp(self) -> float:
        """V/s."""
        return 1000.0

    @property
    def busy(self) -> bool:
        """True while a command waits to be sent or verified."""
        return False

    def emergency_off(self) -> None:
        """Off at once; overtakes everything queued, is read back and sent again until it is so. Write it first."""
'''
    + _NOT_YET.format(what="take its output off")
    + """
    def switch_off(self) -> None:
"""
    + _NOT_YET.format(what="switch off")
    + """
    def switch_on(self) -> None:
"""
    + _NOT_YET.format(what="switch on")
    + '''
    def set_voltage(self, volts: float) -> None:
        """Read every write back; what does not come back as written is refused."""
'''
    + _NOT_YET.format(what="set a voltage")
    + """
    def set_ramp(self, volts_per_second: float) -> None:
"""
    + _NOT_YET.format(what="set a ramp")
    + """
    def set_current_limit(self, amperes: float) -> None:
"""
    + _NOT_YET.format(what="set a current limit")
    + '''
    def clear(self) -> None:
        """Clear latched events; leaves the output off."""
'''
    + _NOT_YET.format(what="clear anything")
    + _NOT_YET_METHOD
)

_SENSOR = {
    "TYPING": "ClassVar",
    "IMPORT_REFUSED": "",
    "IMPORT_CERTIFICATE": "",
    "SAFE_NOTE": "",
    "ROLE_METHODS": _RATE_METHOD,
    "EXAMPLE": "+0.01234",
    "EXAMPLE_VALUES": "(0.01234,)",
    "READING_GRAMMAR": _ONE,
    "CLASS_FACTS": "",
    "CLASS_KEYS": "",
    "PROPOSED": "",
    "RATE": "rate_Hz",
    "RATE_DEFAULT": "50.0",
    "MORE_ARGUMENTS": "",
    "MORE_STATE": "",
    "IMPORT_PROBE": "",
}
PARTS: dict[str, dict[str, str]] = {
    "force": _SENSOR
    | {
        "ROLE_WORDS": "force sensor",
        "ROLE_CLASS": "ForceSensor",
        "MEANING": "the force in newtons",
        "TYPING": "",
        "IMPORT_CERTIFICATE": "FORCE_CERTIFICATE, ",
        "IMPORT_ROLES": "ForceSample, Identity",
        "IMPORT_SETTINGS": "ForceSettings, SerialSettings",
        "SETTINGS_BASES": "ForceSettings, SerialSettings",
        "RATE_FIELD": _RATE.format(key="rate_Hz", default="50.0"),
        "READING_FIELDS": "    newtons: float\n",
        "CLASS_FACTS": '    reading_unit = "N"\n\n',
        "SAMPLE": "ForceSample",
        "MAKE_SAMPLE": "ForceSample(t, reading.newtons)",
        "PROPOSED": ', "certificate": FORCE_CERTIFICATE',
        "TRUTH_BASES": "LoadCellTruth, LineTruth",
        "IMPORT_TRUTH": "Fault, LineTruth, LoadCellTruth",
        "TRUE_READING": """(
            f"{world.force_at(t) * (1.0 + self._truth.gain_error) + self._noise():+.5f}"
        )

    def _noise(self) -> float:
        truth = self._truth
        return truth.noise_fraction * truth.full_scale_N * float(self._rng.standard_normal())""",
        "VALUE": "reading",
        "EXAMPLE_SI": "0.01234",
        "FAKE_WORLD": "SimpleNamespace(force_at=lambda t: 0.25)",
        "TWIN_SI": "0.25",
    },
    "displacement": _SENSOR
    | {
        "ROLE_WORDS": "displacement sensor",
        "ROLE_CLASS": "DisplacementSensor",
        "MEANING": "the displacement in millimetres",
        "IMPORT_ROLES": "DisplacementSample, Identity",
        "IMPORT_SETTINGS": "SerialSettings",
        "SETTINGS_BASES": "SerialSettings",
        "CLASS_KEYS": '    rate_key: ClassVar[str] = "rate_Hz"\n\n',
        "RATE_FIELD": _RATE.format(key="rate_Hz", default="50.0"),
        "READING_FIELDS": "    millimetres: float\n",
        "SAMPLE": "DisplacementSample",
        "MAKE_SAMPLE": "DisplacementSample(t, reading.millimetres * 1e-3)",
        "TRUTH_BASES": "LineTruth",
        "IMPORT_TRUTH": "Fault, LineTruth",
        "TRUE_READING": 'f"{world.displacement_at(t) * 1e3:+.5f}"',
        "VALUE": "displacement",
        "EXAMPLE_SI": "0.01234e-3",
        "FAKE_WORLD": "SimpleNamespace(displacement_at=lambda t: 0.25e-3)",
        "TWIN_SI": "0.25e-3",
    },
    "stage": _SENSOR
    | {
        "ROLE_WORDS": "stage",
        "ROLE_CLASS": "Stage",
        "MEANING": "the position in millimetres",
        "TYPING": "",
        "IMPORT_REFUSED": ", DeviceRefused",
        "IMPORT_ROLES": "Identity, StageSample",
        "IMPORT_SETTINGS": "SerialSettings, StageSettings",
        "SETTINGS_BASES": "StageSettings, SerialSettings",
        "RATE_FIELD": "",
        "RATE": "poll_rate_Hz",
        "SAFE_NOTE": "\n\n    It can only be read: motions are refused until they are written.\n    ",
        "ROLE_METHODS": _STAGE_METHODS,
        "READING_FIELDS": "    millimetres: float\n",
        "SAMPLE": "StageSample",
        "MAKE_SAMPLE": "StageSample(t, reading.millimetres * 1e-3, False, False, round(reading.millimetres * 1e3))",
        "TRUTH_BASES": "StageTruth, LineTruth",
        "IMPORT_TRUTH": "Fault, LineTruth, StageTruth",
        "TRUE_READING": 'f"{world.stage.at(t)[0] * 1e3:+.5f}"',
        "VALUE": "position",
        "EXAMPLE_SI": "0.01234e-3",
        "FAKE_WORLD": "SimpleNamespace(stage=SimpleNamespace(at=lambda t: (0.25e-3, 0.0)))",
        "TWIN_SI": "0.25e-3",
    },
    "hv": _SENSOR
    | {
        "ROLE_WORDS": "high-voltage supply",
        "ROLE_CLASS": "HVSupply",
        "MEANING": "volts and microamperes measured, set-point in volts, 1 if on",
        "IMPORT_REFUSED": ", DeviceRefused",
        "IMPORT_ROLES": "HVFlag, HVSample, Identity",
        "IMPORT_SETTINGS": "SerialSettings, SupplySettings",
        "SETTINGS_BASES": "SupplySettings, SerialSettings",
        "CLASS_KEYS": "    measures_current: ClassVar[bool] = True\n\n",
        "RATE_FIELD": _RATE.format(key="poll_rate_Hz", default="10.0"),
        "RATE": "poll_rate_Hz",
        "RATE_DEFAULT": "10.0",
        "SAFE_NOTE": "\n\n    It can only be read: commands are refused until they are written.\n    ",
        "CLASS_FACTS": "    measures_current = True\n\n",
        "ROLE_METHODS": _HV_METHODS,
        "EXAMPLE": "+0.25,+0.001,+0.0,0",
        "EXAMPLE_VALUES": "(0.25, 0.001, 0.0, 0.0)",
        "READING_GRAMMAR": ",".join([_ONE] * 3) + ",([01])",
        "READING_FIELDS": "    volts: float\n    microamperes: float\n    setpoint: float\n    on: float\n",
        "SAMPLE": "HVSample",
        "MAKE_SAMPLE": """HVSample(
            t,
            reading.volts,
            reading.microamperes * 1e-6,
            reading.setpoint,
            HVFlag.ON if reading.on else HVFlag(0),
        )""",
        "TRUTH_BASES": "OutputTruth, LineTruth",
        "IMPORT_TRUTH": "Fault, LineTruth, OutputTruth",
        "TRUE_READING": 'f"{world.output.at(t)[0]:+.2f},+0.000,+0.0,0"',
        "VALUE": "voltage",
        "EXAMPLE_SI": "0.25",
        "FAKE_WORLD": "SimpleNamespace(output=SimpleNamespace(at=lambda t: (0.25, 0.0)))",
        "TWIN_SI": "0.25",
    },
    "monitor": _SENSOR
    | {
        "ROLE_WORDS": "monitor",
        "ROLE_CLASS": "Monitor",
        "MEANING": "the number that it shows",
        "TYPING": "",
        "IMPORT_ROLES": "Identity, MonitorSample",
        "IMPORT_SETTINGS": "MonitorSettings, Quantity, SerialSettings",
        "SETTINGS_BASES": "MonitorSettings, SerialSettings",
        "RATE_FIELD": "",
        "RATE_DEFAULT": "5.0",
        "SAFE_NOTE": "\n\n    ``to_si`` (factor, offset) makes V, K or 1 of its number, as the scene says.\n    ",
        "MORE_ARGUMENTS": """        quantity: Quantity = "voltage",
        to_si: tuple[float, float] = (1.0, 0.0),
""",
        "MORE_STATE": """        self.quantity = quantity
        self._factor, self._offset = to_si
""",
        "READING_FIELDS": "    number: float\n",
        "SAMPLE": "MonitorSample",
        "MAKE_SAMPLE": """MonitorSample(
            t, self.name, self.quantity, reading.number * self._factor + self._offset
        )""",
        "PROPOSED": ', "quantity": "voltage"',
        "IMPORT_PROBE": "from rig.sim.probe import Probe\n",
        "TRUTH_BASES": "MonitorTruth, LineTruth",
        "IMPORT_TRUTH": "Fault, LineTruth, MonitorTruth",
        "TRUE_READING": 'f"{Probe(self._truth, world, self._rng).number(t):+.5f}"',
        "VALUE": "value",
        "EXAMPLE_SI": "0.01234",
        "FAKE_WORLD": "SimpleNamespace(output=SimpleNamespace(at=lambda t: (250.0, 0.0)))",
        "TWIN_SI": "0.25",
    },
}


def module_of(name: str) -> str:
    """Name of the driver's module."""
    return name.replace("-", "_")


def check_name(name: str, role: str) -> None:
    """Refuse a name that no scene, package or module could have, or that somebody has.

    Raises
    ------
    ConfigError
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no name for a driver: small letters, digits and single hyphens, e.g. acme-scale."
        )
    if name in of_role(role):
        raise ConfigError(f"There is a {role} driver {name!r} already; choose another name.")
    module = module_of(name)
    if keyword.iskeyword(module) or find_spec(module) is not None or find_spec(f"{module}_twin") is not None:
        raise ConfigError(f"There is a Python module {module!r} already; choose another name.")


def write_skeleton(name: str, role: str, folder: Path) -> list[str]:
    """Write the files of a package into a new folder; gives their names. Nothing stays when one cannot be written.

    Raises
    ------
    ConfigError
    """
    module = module_of(name)
    own = {"NAME": name, "MODULE": module, "ROLE": role, "CLASS": "".join(word.title() for word in name.split("-"))}
    parts = PARTS[role] | own
    written = []
    try:
        folder.mkdir()
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}.") from None
    try:
        for template, file in FILES.items():
            text = (files("sim_fixtures") / "skeleton" / template).read_text(encoding="utf-8")
            filled = _MARK.sub(lambda found: parts[found[1]], _MARK.sub(lambda found: parts[found[1]], text))
            write_text(folder / file.format(module=module), _tidy(filled))
            written.append(file.format(module=module))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return written


def _tidy(text: str) -> str:
    """What an empty part leaves behind."""
    return text.replace("import , Literal", "import Literal").replace("\n\n\n\n", "\n\n\n")
