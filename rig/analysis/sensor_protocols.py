"""The protocol of a calibration when none is given: standards spread over what the scene's limits allow."""

from __future__ import annotations

import math

from rig.analysis.sensors import Quantity
from rig.base.errors import ConfigError
from rig.scene.scene import Scene

GRAVITY = 9.80665
LEVELS = 4  # above zero
PART = 0.95  # of a limit; a sensor's own error must not trip it


def protocol_text(quantity: Quantity, scene: Scene) -> str:
    """A protocol file, to be run as it is or edited first.

    Raises
    ------
    ConfigError
        When the scene lacks the instrument.
    """
    if quantity in ("displacement", "hv") and scene.instruments.get(quantity) is None:
        raise ConfigError(f"This scene has no [{quantity}] instrument; there is nothing to calibrate.")
    return f'title = "Calibration: {quantity}"\n\n' + "\n".join(_STEPS[quantity](scene))


def verify_text(quantity: Quantity, scene: Scene, standard: float) -> str:
    """A one-point check: the standard nought and ``standard`` (g, mm, V), in turn."""
    match quantity:
        case "force":
            return _joined(quantity, _zero(), _mount("none"), _weigh([0.0, standard], preloads=0, creep_s=0.0))
        case "displacement":
            start = scene.stage.approach_from_mm
            return _joined(quantity, _home(), _zero(), _mount("target"), _visit([start, start + standard]))
        case "hv":
            return _joined(quantity, _zero(), _mount("none"), _meter([0.0, standard]))
    raise ConfigError(f"There is no one-point check of {quantity}; use dea-rig calibrate {quantity}.")


def _joined(quantity: str, *steps: list[str]) -> str:
    return f'title = "Check: {quantity}"\n\n' + "\n".join(line for step in steps for line in step)


def _force(scene: Scene) -> list[str]:
    heaviest = PART * scene.limits.force_N / GRAVITY * 1e3
    step = _round_down(heaviest / LEVELS)
    weights = [k * step for k in range(LEVELS + 1)]
    return [*_zero(), *_mount("none"), *_weigh(weights, preloads=2, creep_s=60.0)]


def _displacement(scene: Scene) -> list[str]:
    start, reach = scene.stage.approach_from_mm, scene.limits.displacement_mm
    positions = [round(start + k * reach / 6, 3) for k in range(7)]
    return [*_home(), *_zero(), *_mount("target"), *_visit(positions), *_glide(scene, start, start + reach)]


def _compliance(scene: Scene) -> list[str]:
    start = scene.stage.approach_from_mm
    press = [
        "[[step]]",
        'do = "press"',
        f"force_N = {0.8 * scene.limits.force_N:g}",
        "step_um = 0.5 # start small: a step must not cost more force than the sensor bears",
        "settle_s = 1.0",
        "average_s = 2.0",
        "cycles = 3",
        "",
    ]
    return [*_home(), *_zero(), *_mount("none"), *_visit([start], cycles=1), *_mount("dummy"), *press]


def _hv(scene: Scene) -> list[str]:
    # Whole volts, as near to the limit as they go: a run may not ask for more than was calibrated.
    top = math.floor(PART * (scene.limits.voltage_V or 0.0))
    if not top >= LEVELS:
        raise ConfigError("limits.voltage_V is missing or too low; there is no voltage to calibrate at.")
    return [*_zero(), *_mount("none"), *_meter([float(round(k * top / LEVELS)) for k in range(LEVELS + 1)])]


def _timing(scene: Scene) -> list[str]:
    reach = scene.limits.displacement_mm
    approach = ["[[step]]", 'do = "approach"', "speed_mm_per_s = 0.5", "threshold_mN = 8.0", ""]
    back = ["[[step]]", 'do = "return"', ""]
    return [*_home(), *_zero(), *_mount("film"), *approach, *_glide(scene, 0.15 * reach, 0.75 * reach), *back]


def _home() -> list[str]:
    return ["[[step]]", 'do = "home"', ""]


def _zero() -> list[str]:
    return ["[[step]]", 'do = "zero"', "duration_s = 2.0", ""]


def _mount(fixture: str) -> list[str]:
    return ["[[step]]", 'do = "mount"', f'fixture = "{fixture}"', ""]


def _weigh(weights: list[float], *, preloads: int, creep_s: float) -> list[str]:
    return [
        "[[step]]",
        'do = "weigh"',
        f"weights_g = {_list(weights)}",
        "weight_uncertainty_mg = 1.0 # of each; from the certificate of your weights",
        "density_kg_per_m3 = 8000.0",
        f"gravity_m_per_s2 = {GRAVITY} # put the value of your place here, and how well you know it",
        "gravity_uncertainty_m_per_s2 = 0.005",
        "cycles = 3",
        f"preloads = {preloads}",
        "settle_s = 3.0",
        "average_s = 5.0",
        f"creep_s = {creep_s}",
        "",
    ]


def _visit(positions: list[float], cycles: int = 2) -> list[str]:
    return [
        "[[step]]",
        'do = "visit"',
        f"positions_mm = {_list(positions)}",
        "accuracy_um = 5.0 # standard uncertainty of the stage; from its data sheet or certificate",
        f"cycles = {cycles}",
        "settle_s = 1.0",
        "average_s = 1.0",
        "",
    ]


def _glide(scene: Scene, start: float, end: float) -> list[str]:
    speeds = [scene.limits.speed_mm_per_s * part for part in (0.2, 0.6, 1.0)]
    return [
        "[[step]]",
        'do = "glide"',
        f"from_mm = {start:g}",
        f"to_mm = {end:g}",
        f"speeds_mm_per_s = {_list(speeds)}",
        "",
    ]


def _meter(voltages: list[float]) -> list[str]:
    return [
        "[[step]]",
        'do = "meter"',
        f"voltages_V = {_list(voltages)}",
        "meter_relative_uncertainty = 5e-4 # from the certificate of your reference meter",
        "meter_uncertainty_V = 0.5",
        "settle_s = 2.0",
        "average_s = 5.0",
        "",
    ]


def _list(values: list[float]) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


def _round_down(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not larger."""
    if not value > 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return max(k for k in (1, 2, 5) if k * power <= value * (1 + 1e-12)) * power


_STEPS = {
    "force": _force,
    "displacement": _displacement,
    "compliance": _compliance,
    "hv": _hv,
    "timing": _timing,
}
