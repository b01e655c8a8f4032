"""Scene and protocol, loaded, held against each other and planned: all that can be found wrong without hardware."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from calibration.sensors.certificate import Certificate
from drivers.instrument import MONITORS
from drivers.settings import CanSettings, TcpSettings
from rig.base import served
from rig.base.certificates import load_certificate
from rig.base.errors import ConfigError, LimitError
from rig.log.contents import IN_MEMORY, ON_PORTS, ON_SERVED_PORTS, REPLAY_OF
from rig.log.recorder import Gains
from rig.protocol.plan import plan
from rig.protocol.predict import Prediction, check_plan
from rig.protocol.protocol import Protocol, load_protocol
from rig.scene.scene import Scene, load_scene
from rig.steps.base import Action

HV = "hv"
TIMES_BREAKDOWN = 10.0  # a limit of the field this far above breakdown is a slip of the unit
# What ``dea-rig sim`` prints beside the ports, and where its pseudo-terminals are (Linux, macOS).
SERVED_BY, SERVER = "served_by", {"program": "dea-rig sim"}
PSEUDO_TERMINALS = ("/dev/pts/", "/dev/ttys")


@dataclass(frozen=True)
class Experiment:
    """A scene and a protocol that fit each other, with the certificates of the scene's sensors.

    Everything that can be found wrong without touching hardware has been looked for once this exists.
    """

    scene: Scene
    scene_text: str
    protocol: Protocol
    protocol_text: str
    certificates: dict[str, Certificate]
    actions: list[Action]
    predictions: list[Prediction]
    resumed: dict[str, str] | None = None  # of which log this is the rest, for the log
    stored_zero: float | None = None  # of the force sensor, from the run that this one goes on with
    campaign: dict[str, str] | None = None  # of which one this is a run, for the log
    earlier: tuple[Path, ...] = ()  # logs of the runs that this one goes on with
    served: bool = False  # the ports are those that ``dea-rig sim`` printed

    @property
    def bench(self) -> str:
        """On what bench it runs, in the words of `rig.log.contents`.

        Ports are simulated only when ``dea-rig sim`` printed them and a simulated bench serves these very
        pseudo-terminals at this moment; ports that somebody typed, into a scene or into a file, are real, and so are
        those of a list whose server has ended.
        """
        if self.scene.bench is not None:
            return f"{REPLAY_OF}{Path(self.scene.bench.log).name}"
        if not self.scene.on_real_ports:
            return IN_MEMORY
        return ON_SERVED_PORTS if self.served and _all_served(self.scene) else ON_PORTS

    @property
    def highest_voltage(self) -> float:
        """The highest voltage planned (V)."""
        return max((action.highest_voltage for action in self.actions), default=0.0)

    @property
    def duration(self) -> float:
        """Planned duration in seconds."""
        return sum(action.duration for action in self.actions)

    @property
    def kept_s(self) -> float:
        """Seconds of it of which the log keeps everything."""
        return sum(action.kept_s for action in self.actions)

    @property
    def summaries(self) -> int:
        """How many summaries of cycles the log will have."""
        return sum(action.summaries for action in self.actions)


def prepare(scene_path: Path, protocol_path: Path, ports: dict[str, dict[str, object]] | None = None) -> Experiment:
    """Load and check everything; touches no hardware.

    Parameters
    ----------
    ports : dict, optional
        Ports by role as ``dea-rig sim`` prints them; they take the place of the scene's own.

    Raises
    ------
    ConfigError, LimitError
        With the file, key or step, the value and what is allowed.
    """
    scene, scene_text = load_scene(scene_path)
    if ports is not None:
        scene = scene.with_ports(ports)
    protocol, protocol_text = load_protocol(protocol_path)
    certificates = certificates_of(scene, scene_path)
    force = certificates.get("force")
    try:
        actions = plan(protocol, scene)
        predictions = check_plan(actions, scene, 0.0 if force is None else force.noise)
        _check_ranges(certificates, actions, predictions)
    except (ConfigError, LimitError) as error:
        raise type(error)(f"{protocol_path} on {scene_path}: {error}", device=error.device, cause=error.cause) from None
    _check_limits(scene, scene_path, certificates, actions)
    printed = ports is not None and are_served(ports)
    return Experiment(scene, scene_text, protocol, protocol_text, certificates, actions, predictions, served=printed)


def are_served(ports: Mapping[str, object]) -> bool:
    """Whether ``ports`` says that ``dea-rig sim`` printed it."""
    return ports.get(SERVED_BY) == SERVER


def _all_served(scene: Scene) -> bool:
    """Whether every port is a pseudo-terminal, behind whatever name, or a TCP port of this machine, that one simulated
    bench serves."""
    names = []
    for table in scene.instruments.values():
        if isinstance(table, TcpSettings) and table.host == served.LOOPBACK:
            names.append(served.tcp_port(table.tcp_port))
            continue
        name = getattr(table, "port", None)
        if isinstance(table, CanSettings) and table.interface == "slcan":
            name = table.can_channel
        if name is None or not os.path.realpath(name).startswith(PSEUDO_TERMINALS):
            return False
        names.append(name)
    return bool(names) and served.are_served(names)


def certificates_of(scene: Scene, path: Path) -> dict[str, Certificate]:
    """The certificates that the scene in the file ``path`` names, by role; ConfigError when one cannot be used."""
    found: dict[str, Certificate] = {}
    for role, table in scene.instruments.items():
        if table.certificate is None:
            continue
        try:
            certificate = load_certificate(path.parent / table.certificate)
        except ConfigError as error:
            raise ConfigError(f"{path}: {role}.certificate: {error}") from None
        if certificate.role != (HV if role == scene.second_reading else role):
            raise ConfigError(
                f"{path}: {role}.certificate = {table.certificate!r}: this one is for the role {certificate.role!r}."
            )
        found[role] = certificate
    return found


def _check_ranges(certificates: dict[str, Certificate], actions: list[Action], predictions: list[Prediction]) -> None:
    """Nothing is planned where a sensor is not calibrated. Calibrations themselves go further."""
    for action, prediction in zip(actions, predictions, strict=True):
        if action.by.calibrates:
            continue
        for role, value, unit in (("force", prediction.peak_force, "N"), ("hv", action.highest_voltage, "V")):
            used = certificates.get(role)
            if used is not None and not value <= used.high:
                raise LimitError(
                    f"Step {action.step} ({action.kind}, {action.label}): {value:.4g} {unit} are expected, and "
                    f"{used.name} is calibrated up to {used.high:.4g} {unit} only. Calibrate further, or ask for less."
                )


def _check_limits(scene: Scene, path: Path, certificates: dict[str, Certificate], actions: list[Action]) -> None:
    """Limits that protect nothing are refused, unless the scene accepts them by name; calibrations may go further."""
    found: dict[str, str] = {}
    force, most = certificates.get("force"), scene.limits.force_N
    if force is not None and not most <= force.high and not any(action.by.calibrates for action in actions):
        found["limits.force_N"] = f"{most:g} N, but {force.name} is calibrated up to {force.high:g} N only"
    field, breakdown = scene.limits.field_V_per_um, scene.specimen.specimen().material.breakdown_field
    if field is not None and breakdown is not None and not field <= TIMES_BREAKDOWN * breakdown * 1e-6:
        found["limits.field_V_per_um"] = (
            f"{field:g} V/um, more than {TIMES_BREAKDOWN:g} times the material's breakdown field of "
            f"{breakdown * 1e-6:g} V/um"
        )
    refused = {key: words for key, words in found.items() if key not in scene.accept}
    if refused:
        lines = "\n".join(f"  {key} = {words}." for key, words in refused.items())
        names = ", ".join(f'"{name}"' for name in [*scene.accept, *refused])
        raise ConfigError(
            f"{path}: limits that protect nothing.\n{lines}\n"
            f"  If they are meant, put this line above the first table of the file: accept = [{names}]"
        )


def gains_of(certificates: dict[str, Certificate]) -> Gains:
    """Quantity per reading of each sensor, by the certificates."""
    gain = {role: certificate.gain for role, certificate in certificates.items()}
    force = certificates["force"]  # every scene names it
    second = next((gain[name] for name in MONITORS if name in gain), 1.0)  # only that of a voltage has a certificate
    return Gains(
        force.gain, gain.get("displacement", 1.0), gain.get(HV, 1.0), force.reading_unit, force.stored_zero, second
    )
