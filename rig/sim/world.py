"""The hidden truth of the simulated bench: where things are, what the film does, what is on the electrodes.

Instruments move the two `Path` objects (stage and supply output) and read the rest. Times at which the world is
asked must not lie before the last `advance`; the bench sees to that.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from model.specimen import Specimen
from rig.sim.electrodes import Electrodes, electrodes
from rig.sim.film import FilmTable, Solve, solve_membrane, tabulate
from rig.sim.path import Path
from rig.sim.truth import OutputTruth, RigTruth, StageTruth

Floats = npt.NDArray[np.float64]

CHARGE_S = 1e-4  # to either side of the instant at which a charging current is asked for
TICK = 0.01  # s; the film's relaxation is integrated, and its strength checked, on this grid


def true_specimen(rig: RigTruth, specimen: Specimen) -> Specimen:
    """The specimen with the film that is really mounted."""
    material = rig.film.material(specimen.material)
    if material == specimen.material:
        return specimen
    return specimen.with_material(replace(material, name=f"{specimen.material.name} as mounted"))


class World:
    r"""Stage, film and electrodes.

    The film's force is its equilibrium force at displacement and voltage, plus overstress branches
    (quasi-linear viscoelasticity, Fung 1972), each driven by the elastic force F_e at zero volts:

    .. math:: \dot q_i = g_i \dot F_e - q_i/\tau_i

    integrated exactly for F_e linear in time within a tick. Rig compliance acts on the equilibrium force.

    Attributes
    ----------
    stage : Path
        Carriage position as the lead screw means it (m).
    output : Path
        Voltage at the supply's terminals (V).
    torn, broken_down : bool
        The film was stretched beyond its reach; the film has arced and conducts from then on.
    extra_leakage : float
        Current drawn beside the film at any voltage (A), for faults.
    compliance : float
        Of the rig (m/N).
    fixture : str
        What the pusher meets: ``film``; ``target``, a plate on the pusher that the laser sees wherever it goes;
        ``dummy``, a rigid stop at stage position ``dummy_at`` (m); or ``none``.
    weight : float
        Hung on the load cell (N).
    """

    def __init__(
        self,
        rig: RigTruth,
        stage: StageTruth,
        output: OutputTruth | None,
        specimen: Specimen,
        solve: Solve = solve_membrane,
    ) -> None:
        self.specimen = true_specimen(rig, specimen)
        self._electrodes = output
        self._solve = solve
        self._contact = rig.contact_position_mm * 1e-3
        self.compliance = rig.rig_compliance_um_per_N * 1e-6
        self._screw_error = stage.screw_error_um * 1e-6
        self._screw_wave = 2 * math.pi / (stage.screw_pitch_mm * 1e-3)
        self.devices: dict[tuple[object, ...], object] = {}  # those that several instruments are on
        self.stage = Path(stage.start_position_mm * 1e-3)
        self.output = Path(0.0 if output is None else output.start_live_V)
        self.torn = False
        self.broken_down = False
        self.extra_leakage = 0.0
        self.fixture = "film"
        self.dummy_at = math.inf
        self.weight = 0.0
        self._table: FilmTable | None = None
        self._capacitance: Electrodes | None = None
        self._branches = [(b.modulus_ratio, b.time_s) for b in rig.film.maxwell]
        self._overstress = [0.0] * len(self._branches)
        self._elastic = 0.0  # F_e at the last tick
        self._tick = 0
        self._still: tuple[int, int] | None = None
        self._still_force = 0.0

    @property
    def film(self) -> FilmTable:
        """The film's table, made when it is first needed."""
        if self._table is None:
            self._table = tabulate(self.specimen, self.compliance, self._electrodes is not None, self._solve)
        return self._table

    # At one time, for instruments

    def carriage_at(self, t: float) -> float:
        """True position of the carriage (m), screw error included."""
        x = self.stage.at(t)[0]
        if self._screw_error:
            x += self._screw_error * math.sin(self._screw_wave * x)
        return x

    def indentation_at(self, t: float) -> float:
        """How far the carriage is beyond contact (m), never negative."""
        return max(self.carriage_at(t) - self._contact, 0.0)

    def force_at(self, t: float) -> float:
        """Force on the load cell (N), not more than a tick after the last one."""
        match self.fixture:
            case "film":
                return self._film_force(t) + self.weight
            case "dummy":
                return max(self.carriage_at(t) - self.dummy_at, 0.0) / self.compliance + self.weight
        return self.weight

    def _film_force(self, t: float) -> float:
        if self.torn:
            return 0.0
        if self._branches:
            s = self.indentation_at(t)
            dt = max(t - self._tick * TICK, 0.0)
            rise = self._elastic_force(s) - self._elastic
            return self._equilibrium(s, t) + sum(
                _relax(q, ratio, tau, dt, rise)
                for q, (ratio, tau) in zip(self._overstress, self._branches, strict=True)
            )
        if t < max(self.stage.end, self.output.end):
            return self._equilibrium(self.indentation_at(t), t)
        state = (self.stage.changes, self.output.changes)
        if state != self._still:  # nothing moves any more: one value for all that follows
            self._still, self._still_force = state, self._equilibrium(self.indentation_at(t), t)
        return self._still_force

    def displacement_at(self, t: float) -> float:
        """Displacement of the disk, or of the target in its place, from the flat film's position (m)."""
        if self.fixture == "target":
            return self.carriage_at(t) - self._contact
        if self.fixture != "film":
            return 0.0
        s = self.indentation_at(t)
        return s if self.torn else s - self.compliance * self._equilibrium(s, t)

    def _equilibrium(self, s: float, t: float) -> float:
        return self.film.force(s, self.output.at(t)[0]) if s > 0 else 0.0

    def _elastic_force(self, s: float) -> float:
        return self.film.force(s, 0.0) if s > 0 else 0.0

    # At many times, for whoever looks at the truth

    def carriage(self, t: Floats) -> Floats:
        """`carriage_at` for times ``t`` (n,)."""
        return np.array([self.carriage_at(time) for time in t.tolist()])

    def voltage(self, t: Floats) -> Floats:
        """Voltage on the electrodes (V) for times ``t`` (n,)."""
        return np.array([self.output.at(time)[0] for time in t.tolist()])

    def force(self, t: Floats) -> Floats:
        """`force_at` for times ``t`` (n,)."""
        return np.array([self.force_at(time) for time in t.tolist()])

    def displacement(self, t: Floats) -> Floats:
        """`displacement_at` for times ``t`` (n,)."""
        return np.array([self.displacement_at(time) for time in t.tolist()])

    # Electrodes

    @property
    def film_resistance(self) -> float:
        """Resistance between the electrodes (ohm)."""
        hv = self._electrodes
        if hv is None:
            return math.inf
        return hv.arc_resistance_kOhm * 1e3 if self.broken_down else hv.leakage_resistance_GOhm * 1e9

    def current(self, t: float) -> float:
        """Current out of the supply (A): charging, leakage, and what a fault adds."""
        if self._electrodes is None:
            return 0.0
        voltage, slope = self.output.at(t)
        extra = self.extra_leakage if voltage > 0 else 0.0
        return self._charging(self._electrodes, t, slope) + voltage / self.film_resistance + extra

    def read_current(self, t: float) -> float:
        """`current` as the supply's monitor has it (A), noise left to the supply."""
        return self.current(t) * (1.0 + (self._electrodes.current_gain_error if self._electrodes is not None else 0.0))

    def _charging(self, electrodes: OutputTruth, t: float, slope: float) -> float:
        """dQ/dt (A), Q = C V: also of a film that is moved at a constant voltage."""
        if not electrodes.capacitance_of_film:
            return electrodes.film_capacitance_nF * 1e-9 * slope
        return (self.charge(t + CHARGE_S) - self.charge(t - CHARGE_S)) / (2.0 * CHARGE_S)

    def charge(self, t: float) -> float:
        """Charge (C) on the film and on what is beside it."""
        voltage = self.output.at(t)[0]
        return self.capacitance(t) * voltage if voltage else 0.0

    def capacitance(self, t: float) -> float:
        """What the supply charges (F)."""
        hv = self._electrodes
        if hv is None:
            return 0.0
        if not hv.capacitance_of_film:
            return hv.film_capacitance_nF * 1e-9
        if self._capacitance is None:
            self._capacitance = electrodes(self.specimen, self.compliance)
        beside = hv.beside_film_nF * 1e-9
        return (
            beside
            if self.torn
            else beside + self._capacitance.capacitance(self.indentation_at(t), self.output.at(t)[0])
        )

    def prepare(self) -> None:
        """Make now the tables that take long."""
        _ = self.film
        if self._electrodes is not None and self._electrodes.capacitance_of_film:
            self._capacitance = electrodes(self.specimen, self.compliance)

    @property
    def next_time(self) -> float:
        """The next tick, inf while nothing can change."""
        if self._branches or self._tick * TICK < max(self.stage.end, self.output.end):
            return (self._tick + 1) * TICK
        return math.inf

    def advance(self, t: float) -> None:
        """Let the ticks up to ``t`` happen."""
        if self._branches:
            while (self._tick + 1) * TICK <= t:
                self._one_tick((self._tick + 1) * TICK)
                self._tick += 1
        else:
            tick = math.floor(t / TICK + 1e-9)
            if tick > self._tick:
                moved = self.next_time < math.inf
                self._tick = tick
                if moved:
                    self._check_strength(t)

    def _one_tick(self, t: float) -> None:
        elastic = self._elastic_force(self.indentation_at(t))
        rise = elastic - self._elastic
        self._overstress = [
            _relax(q, ratio, tau, TICK, rise) for q, (ratio, tau) in zip(self._overstress, self._branches, strict=True)
        ]
        self._elastic = elastic
        self._check_strength(t)

    def _check_strength(self, t: float) -> None:
        if self.fixture != "film":
            return
        s = self.indentation_at(t)
        if s > 0 and s > self.film.reach:
            self.torn = True
        voltage = self.output.at(t)[0]
        if voltage > 0 and not self.broken_down:
            self.broken_down = voltage >= self.film.breakdown_voltage(s)


def _relax(q: float, ratio: float, tau: float, dt: float, rise: float) -> float:
    """Overstress after ``dt`` of an elastic force that rises by ``rise`` at a constant rate."""
    x = dt / tau
    mean = -math.expm1(-x) / x if x > 0 else 1.0
    return q * math.exp(-x) + ratio * rise * mean
