"""What solved states have to say: arrays of answers, each with a status."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations


class Status(IntEnum):
    """What kind of answer a state has. Only TAUT and WRINKLED carry a force; elsewhere it is NaN."""

    TAUT = 0
    WRINKLED = 1
    SLACK = 2
    UNSTABLE = 3
    NOT_CONVERGED = 4
    INVALID = 5

    @property
    def message(self) -> str:
        """One sentence for the operator."""
        return _MESSAGES[self]


_MESSAGES = {
    Status.TAUT: "The film is in tension everywhere.",
    Status.WRINKLED: "Hoop tension is lost somewhere: the film wrinkles there; the plain equations do not describe it.",
    Status.SLACK: "The voltage has taken all tension out of the film: it hangs slack and no membrane answer exists.",
    Status.UNSTABLE: "No stable state on the branch that starts at 0 V: this is beyond pull-in.",
    Status.NOT_CONVERGED: "The solver found no solution to the tolerance asked for.",
    Status.INVALID: "The input does not describe a film: see the reason given.",
}


@dataclass(frozen=True)
class Solutions:
    """Answers to an array of states; every array has the broadcast shape S of the inputs.

    Where ``status`` is neither TAUT nor WRINKLED the numbers are NaN.

    Attributes
    ----------
    force : F (N), positive when it pushes the disk to positive h
    peak_field, peak_field_radius : largest true field (V/m) and the undeformed radius R where it stands (m)
    min_hoop_stress, min_meridional_stress : smallest true stresses (Pa)
    max_stretch : largest principal stretch in the film's plane
    status : `Status` numbers
    error_estimate : estimated relative error of the force
    iterations : Newton iterations spent
    modes : resolution reached
    stable : the energy has a minimum here
    field_exceeded, stretch_exceeded : above the material's stated limits (False where it states none)
    dforce : derivatives of the force with respect to "h", "voltage", "disk_radius", "ring_radius", "thickness",
        "prestretch", "eps_r" (shape S) and "mu", "alpha" (shape S + (moduli,) and S + (shape parameters,), as in
        `model.material.materials.Material`); None unless asked for
    evaluations : how many points of the material's law were computed
    """

    force: Array
    peak_field: Array
    peak_field_radius: Array
    min_hoop_stress: Array
    min_meridional_stress: Array
    max_stretch: Array
    status: NDArray[np.int8]
    error_estimate: Array
    iterations: NDArray[np.intp]
    modes: NDArray[np.intp]
    stable: NDArray[np.bool_]
    field_exceeded: NDArray[np.bool_]
    stretch_exceeded: NDArray[np.bool_]
    dforce: dict[str, Array] | None = None
    evaluations: Evaluations = field(default_factory=Evaluations, compare=False)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.force.shape

    @property
    def answered(self) -> NDArray[np.bool_]:
        """Where there is a force."""
        return self.status <= Status.WRINKLED

    @property
    def tension_margin(self) -> Array:
        """The smaller of the two least stresses (Pa): negative when tension is lost."""
        return np.minimum(self.min_hoop_stress, self.min_meridional_stress)
