"""By how much an elastic fit is off whose data look like a film that takes time; an estimate of first order."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from calibration.film.branches.joint import Joint
from calibration.film.branches.record import records_of_curves
from calibration.film.branches.spectrum import guess
from calibration.film.curve import Curve
from calibration.film.result import Identification
from model.material.materials import Material

MOST = 2  # branches that are tried


def error_of_elastic_fit(curves: Sequence[Curve], film: Material, held: Collection[str]) -> dict[str, float]:
    """Relative errors of "stiffness" and "eps_r" of an elastic ``film`` fitted to these curves; empty without branches.

    The film with its branches to first order in their ratios (`response`), without an exact solution.
    """
    joint = Joint(records_of_curves(curves), film, film.terms, tuple(held))
    x = joint.vector(film)
    joint.settle(x)
    here = joint.minimise(joint.evaluate(x))
    for more in range(MOST, 0, -1):
        start = guess(joint, here, more)
        if start is not None:
            joint.settle(start)
            there = joint.coordinates.film(joint.minimise(joint.evaluate(start)).x)
            found = {"stiffness": film.shear_modulus / there.shear_modulus - 1.0}
            if joint.coordinates.electric:
                found["eps_r"] = film.eps_r / there.eps_r - 1.0
            return {name: one for name, one in found.items() if math.isfinite(one)}
    return {}


def with_elastic_error(found: Identification, curves: Sequence[Curve]) -> Identification:
    """The result of an elastic fit of data that look like a film that takes time, with by how much it is off."""
    off = error_of_elastic_fit(curves, found.material, found.provenance.get("settings", {}).get("fixed", ()))
    if not off:
        return found
    shifts = " and ".join(f"{name} by about {100.0 * one:+.2g} %" for name, one in off.items())
    words = f"fitted as elastic the result is off: {shifts} (estimate of first order)"
    return replace(found, elastic_error=off, warnings=[*found.warnings, words])
