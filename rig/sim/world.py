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
from rig.sim.film import DEFAULT_FIELD, REACH, FilmTable, Solve, solve_membrane, tabulate
from rig.sim.film_course import FilmCourse
from rig.sim.path import Path
from rig.sim.truth import OutputTruth, RigTruth, StageTruth
from rig.sim.viscous_film import Moment, ViscousFilm

Floats = npt.NDArray[np.float64]

CHARGE_S = 1e-4  # to either side of the instant at which a charging current is asked for
TICK = 0.01  # s; the strength of an elastic film is checked on this grid


def true_specimen(rig: RigTruth, specimen: Specimen) -> Specimen:
    """The specimen with the film that is really mounted."""
    material = rig.film.material(specimen.material)
    if material == specimen.material:
        return specimen
    return specimen.with_material(replace(material, name=f"{specimen.material.name} as mounted"))


class World:
    """Stage, film and electrodes.

    An elastic film's force is that of its table (`rig.sim.film`); one with branches is solved on its way
    (`rig.sim.viscous_film`).

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
        self._reach = REACH * (specimen.ring_radius - specimen.disk_radius)
        self._course = self._in_time(rig)
        self._tick = 0
        self._still: tuple[int, int] | None = None
        self._still_force = 0.0

    def _in_time(self, rig: RigTruth) -> FilmCourse | None:
        """The film on its way, of one that takes time."""
        branches = [(one.modulus_ratio, one.time_s) for one in rig.film.maxwell if one.modulus_ratio > 0.0]
        if not branches:
            return None
        film = self.specimen
        strength = film.material.breakdown_field or DEFAULT_FIELD
        return FilmCourse(
            ViscousFilm(film, branches, self.compliance),
            self.stage,
            self.output,
            lambda t: self.indentation_at(t) if self.fixture == "film" and not self.torn else 0.0,
            film.ring_radius - film.disk_radius,
            strength * film.thickness / film.prestretch**2,
        )

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
        """Force on the load cell (N), not later than `next_time`."""
        match self.fixture:
            case "film":
                return self._film_force(t) + self.weight
            case "dummy":
                return max(self.carriage_at(t) - self.dummy_at, 0.0) / self.compliance + self.weight
        return self.weight

    def _film_force(self, t: float) -> float:
        if self.torn:
            return 0.0
        if self._course is not None:
            return self._course.force(t)
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
        if self.torn:
            return s
        return s - self.compliance * (self._equilibrium(s, t) if self._course is None else self._course.force(t))

    def _equilibrium(self, s: float, t: float) -> float:
        return self.film.force(s, self.output.at(t)[0]) if s > 0 else 0.0

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
        if self._course is None:
            _ = self.film
        if self._electrodes is not None and self._electrodes.capacitance_of_film:
            self._capacitance = electrodes(self.specimen, self.compliance)

    @property
    def next_time(self) -> float:
        """The next tick, or the end of the film's step; inf while nothing can change."""
        if self._course is not None:
            return self._course.end
        if self._tick * TICK < max(self.stage.end, self.output.end):
            return (self._tick + 1) * TICK
        return math.inf

    def advance(self, t: float) -> None:
        """Let the ticks up to ``t`` happen."""
        if self._course is not None:
            for moment in self._course.advance(t):
                self._check_moment(moment)
                if self.torn:
                    self._course = None
                    break
            return
        tick = math.floor(t / TICK + 1e-9)
        if tick > self._tick:
            moved = self.next_time < math.inf
            self._tick = tick
            if moved:
                self._check_strength(t)

    def _check_moment(self, moment: Moment) -> None:
        """Whether a film that takes time has torn or broken down.

        By its field, or where it has no state any more; a slack film breaks down as an elastic one does.
        """
        if self.fixture != "film":
            return
        if moment.s > self._reach:
            self.torn = True
        if moment.voltage > 0.0 and not self.broken_down:
            if moment.found == "slack":
                self.broken_down = moment.voltage >= self.film.breakdown_voltage(moment.s)
            else:
                strength = self.specimen.material.breakdown_field or DEFAULT_FIELD
                self.broken_down = moment.found == "lost" or moment.field >= strength

    def _check_strength(self, t: float) -> None:
        if self.fixture != "film":
            return
        s = self.indentation_at(t)
        if s > 0 and s > self.film.reach:
            self.torn = True
        voltage = self.output.at(t)[0]
        if voltage > 0 and not self.broken_down:
            self.broken_down = voltage >= self.film.breakdown_voltage(s)
