"""A first scene, with protocols and data-sheet certificates, for a film that somebody has: numbers from the model.

What the supply may give and the load cell must bear follows from the film's law; the rest are usual values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from typing import cast

import numpy as np
from numpy.typing import NDArray

from calibration.sensors.certificate import DisplacementFile, ForceFile, HVFile
from drivers.registry import instrument
from model.material.laws import find_law
from model.membrane.solve import Solutions, solve_many
from model.specimen import Specimen
from rig.base.commented import Value, commented
from rig.base.errors import ConfigError
from rig.base.law_tables import law_table
from rig.base.toml_file import validate
from rig.scene.presets import Preset
from rig.scene.scene import LimitsTable, Scene, SessionTable
from rig.scene.specimen import MaterialTable, SpecimenTable
from rig.sim.settings import SimulationSettings
from rig.sim.truth import MonitorTruth
from rig.sim.twins import of_role

CELLS_N = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # rated forces of load cells
SUPPLY_V = 5000.0
DEPTH = 0.45  # of the gap between disk and ring
FIELD_PART = 0.6  # of the film's strength
CONTACT_MM, APPROACH_MM = 40.0, 36.0
Instruments = dict[str, dict[str, Value]]  # the keys of each instrument's table, "driver" among them, by role
DRIVERS = {"stage": "zaber", "force": "gsv8", "displacement": "keyence-lkg", "hv": "iseg-edcp"}
ONE_YEAR = (date(2019, 1, 1), date(2099, 12, 31))  # a data sheet does not expire; a calibration does


@dataclass(frozen=True)
class Film:
    """The film as mounted."""

    preset: Preset
    name: str
    disk_radius_mm: float
    ring_radius_mm: float
    thickness_um: float
    prestretch: float

    def material(self) -> dict[str, Value]:
        """The keys of [specimen.material]."""
        return {
            "law": self.preset.law,
            **self.preset.parameters,
            "eps_r": self.preset.eps_r,
            "breakdown_V_per_um": self.preset.breakdown_V_per_um,
            "max_stretch": self.preset.max_stretch,
            "source": self.preset.source,
        }

    def keys(self) -> dict[str, Value]:
        """The keys of [specimen]."""
        return {
            "name": self.name,
            "disk_radius_mm": self.disk_radius_mm,
            "ring_radius_mm": self.ring_radius_mm,
            "thickness_um": self.thickness_um,
            "prestretch": self.prestretch,
        }

    def specimen(self) -> Specimen:
        """The same in SI units."""
        raw = {**self.keys(), "material": self.material()}
        return validate(raw, SpecimenTable, "scene", "scene.toml, not yet written").specimen()


@dataclass(frozen=True)
class Extent:
    """How far to go with a film: displacement (mm), voltage (V), peak force (N) and true field (V/um) there."""

    displacement_mm: float
    voltage_V: float
    force_N: float
    field_V_per_um: float
    cell_N: float


def extent(film: Film) -> Extent:
    """From the model: part of the gap deep, and as much voltage as leaves the film taut and well below its strength.

    Raises
    ------
    ConfigError
        When the film is taut at no voltage, or no load cell bears its force.
    """
    specimen = film.specimen()
    deepest = rounded(DEPTH * (film.ring_radius_mm - film.disk_radius_mm))
    h = np.linspace(0.02, 1.0, 12) * deepest * 1e-3
    volts = np.array([0.0, *np.geomspace(100.0, SUPPLY_V, 40)])
    strongest = film.preset.breakdown_V_per_um * FIELD_PART * 1e6
    rest = solve_many(specimen, h, 0.0)
    if not _good(rest, strongest).all():
        raise ConfigError(
            f"With these dimensions the model has no taut film from 0 to {deepest:g} mm even without voltage. "
            "Check radii, thickness and pre-stretch."
        )
    last, too_high = 0, len(volts)  # by halves: a voltage that no film bears takes longest to answer
    while too_high - last > 1:
        middle = (last + too_high) // 2
        if _good(solve_many(specimen, h, volts[middle]), strongest).all():
            last = middle
        else:
            too_high = middle
    voltage = rounded(volts[last], down=True)
    at = solve_many(specimen, h, voltage)
    force = float(np.abs(np.concatenate([at.force, rest.force])).max())
    cell = next((size for size in CELLS_N if size >= 1.4 * force), None)
    if cell is None:
        raise ConfigError(f"The model expects {force:.3g} N at {deepest:g} mm; no usual load cell bears that.")
    return Extent(deepest, voltage, force, float(at.peak_field.max()) * 1e-6, cell)


def _good(found: Solutions, strongest: float) -> NDArray[np.bool_]:
    """Which states are answered, taut, and below a field (V/m)."""
    with np.errstate(invalid="ignore"):
        return found.answered & (found.min_hoop_stress > 0) & ~(found.peak_field > strongest)


def rounded(value: float, *, down: bool = False) -> float:
    """To two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return float(f"{(math.floor if down else round)(value / step) * step:.6g}")


def simulated_instruments(*, hv: bool, displacement: bool, monitor: str = "") -> Instruments:
    """The instruments of the simulated bench, by role; ``monitor`` is the driver of a second reading of the voltage."""
    roles = [role for role in DRIVERS if (role != "displacement" or displacement) and (role != "hv" or hv)]
    made: Instruments = {role: {"driver": DRIVERS[role]} for role in roles}
    if monitor:
        truth = of_role("monitor")[monitor].truth()  # type: ignore[call-arg] # each has a default driver
        factor = cast(MonitorTruth, truth).units_per_number
        made["monitor"] = {"driver": monitor, "quantity": "voltage", "factor": factor}
    return made


def scene_text(film: Film, reach: Extent, instruments: Instruments, *, real: bool = False) -> str:
    """The scene, every key explained; ``real``: its instruments have ports."""
    volts = "hv" in instruments and reach.voltage_V > 0
    limits: dict[str, Value] = {
        "force_N": 0.9 * reach.cell_N,
        "displacement_mm": rounded(1.2 * reach.displacement_mm),
        "speed_mm_per_s": 5.0,
    }
    if volts:
        field = min(1.3 * reach.field_V_per_um, 0.9 * film.preset.breakdown_V_per_um)
        limits |= {"voltage_V": rounded(1.1 * reach.voltage_V), "current_uA": 100.0, "field_V_per_um": rounded(field)}
    law = law_table(MaterialTable, find_law(film.preset.law), optional=False)
    parts = [
        "#:schema schema/scene.json",
        f"# {film.preset.title}, "
        + ("on the instruments found." if real else "simulated. `dea-rig devices` tells the ports of a real bench."),
        "",
        commented("", Scene, {"title": f"{film.preset.title}, disk {film.disk_radius_mm:g} mm"}),
        commented("[session]", SessionTable, {}),
        commented("[specimen]", SpecimenTable, film.keys()),
        commented("[specimen.material]", law, film.material()),
        commented("[limits]", LimitsTable, limits),
    ]
    given: dict[str, dict[str, Value]] = {
        "stage": {} if real else {"approach_from_mm": APPROACH_MM},  # where a real film is, nobody knows yet
        "force": {"rate_Hz": 100.0, "certificate": "certificates/force.toml"},
        "displacement": {"certificate": "certificates/displacement.toml"},
        "hv": {"ramp_V_per_s": 300.0, "certificate": "certificates/hv.toml"},
    }
    for role, keys in instruments.items():
        if role in ("hv", "monitor") and not volts:
            continue
        settings = instrument(role, str(keys["driver"])).settings
        usual = {key: value for key, value in given.get(role, {}).items() if key in settings.model_fields}
        parts.append(commented(f"[{role}]", settings, {**keys, **usual}))
    if real:
        return "\n".join(parts)
    truth = of_role("force")[DRIVERS["force"]].truth
    parts += [
        "# The simulated bench; a real one has ports instead. Remove these tables then.",
        commented("[simulation]", SimulationSettings, {"seed": 1, "contact_position_mm": CONTACT_MM}),
        commented("[simulation.force]", truth, {"full_scale_N": reach.cell_N}),
    ]
    return "\n".join(parts)


def certificate_texts(reach: Extent, instruments: Instruments, *, real: bool = False) -> dict[str, str]:
    """Certificates with values of data sheets, by role, until `dea-rig calibrate` makes better ones."""

    def common(role: str, what: str) -> dict[str, Value]:
        serial = instruments[role].get("serial", "")
        if not real:
            serial = getattr(of_role(role)[DRIVERS[role]].truth(), "serial_number", "")  # type: ignore[call-arg]
        return {
            "format": "dea-rig certificate 1",
            "role": role,
            "instrument": f"{instruments[role]['driver']}, values of the data sheet",
            "serial": str(serial),
            "valid_from": ONE_YEAR[0],
            "valid_until": ONE_YEAR[1],
            "method": f"data sheet: {what}; not calibrated",
            "gain_relative_uncertainty": 0.005,
        }

    head = "#:schema ../schema/certificate.json\n# Values of a data sheet; make real ones: dea-rig calibrate.\n\n"
    cell = reach.cell_N
    in_newtons = instruments["force"]["driver"] != DRIVERS["force"]  # the others state newtons themselves
    found = {
        "force": commented(
            "",
            ForceFile,
            {
                **common("force", f"{cell:g} N at 2 mV/V"),
                **({"gain_N_per_N": 1.0} if in_newtons else {"gain_N_per_mV_per_V": cell / 2.0}),
                "noise_N": 0.005 * cell,
                "zero_uncertainty_N": 0.0005 * cell,
                "range_N": [-cell, cell],
            },
        )
    }
    if "displacement" in instruments:
        found["displacement"] = commented(
            "",
            DisplacementFile,
            {
                **common("displacement", "linearity"),
                "gain_m_per_m": 1.0,
                "noise_m": 1e-5,
                "zero_uncertainty_m": 5e-6,
                "range_m": [-0.08, 0.08],
            },
        )
    if "hv" in instruments and reach.voltage_V > 0:
        found["hv"] = commented(
            "",
            HVFile,
            {
                **common("hv", "accuracy of the monitor"),
                "gain_V_per_V": 1.0,
                "noise_V": 1.0,
                "zero_uncertainty_V": 2.0,
                "range_V": [0.0, 6000.0],
            },
        )
    return {role: head + text for role, text in found.items()}


def protocol_texts(reach: Extent, *, hv: bool) -> dict[str, str]:
    """Protocols by file name: a sweep as in the paper, a relaxation, and steps of voltage up to the limit."""
    top = reach.voltage_V if hv else 0.0
    levels = [0.0, rounded(0.6 * top), top] if top else [0.0]
    contact = rounded(8.0 * reach.cell_N)
    depth = reach.displacement_mm
    start = (
        '[[step]]\ndo = "home"\n\n[[step]]\ndo = "zero"\nduration_s = 3.0\n\n'
        f'[[step]]\ndo = "approach"\nspeed_mm_per_s = 0.5\nthreshold_mN = {contact:g}\n\n'
    )
    end = '[[step]]\ndo = "return"\n'
    volts = f"voltages_V = [{', '.join(f'{level:g}' for level in levels)}]\n"
    precondition = f'[[step]]\ndo = "precondition"\ndisplacement_mm = {depth:g}\nspeed_mm_per_s = 4.0\ncycles = 2\n\n'
    sweep = f'[[step]]\ndo = "sweep"\ndisplacement_mm = {depth:g}\nspeed_mm_per_s = 1.0\n{volts}settle_s = 1.0\n\n'
    relax = f'[[step]]\ndo = "relax"\ndisplacements_mm = [{depth:g}]\nspeed_mm_per_s = 4.0\nhold_s = 300.0\n\n'
    back = '[[step]]\ndo = "ramp"\ndisplacement_mm = 0.0\nspeed_mm_per_s = 1.0\n\n'
    made = {
        "sweep": ("Force against displacement at each voltage", start + precondition + sweep + end),
        "relaxation": ("Relaxation after a fast ramp", start + relax + back + end),
    }
    if top:
        rise = f'[[step]]\ndo = "breakdown"\nceiling_V = {top:g}\nrate_V_per_s = 50.0\nhold_s = 10.0\n\n'
        made["breakdown"] = ("Voltage up to the limit, flat film: does it bear it?", start + rise + end)
    head = "#:schema ../schema/protocol.json\n# `dea-rig keys sweep` explains the keys of a step.\n"
    return {name: f'{head}title = "{title}"\n\n{body}' for name, (title, body) in made.items()}
