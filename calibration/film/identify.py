"""Ogden parameters and permittivity of a film from its force-displacement curves, with uncertainties to be believed.

All curves, voltages and specimens are fitted at once. The film's parameters enter as stiffness shares ``g_n = mu_n
alpha_n / (2 G_0) > 0`` and exponents ``alpha_n``, all of order one, with ``eps_r`` where there is voltage. Exponents
stay between 0.2 and 30; one that the data do not determine counts as anywhere in between. The zeros of force and
displacement and the lag of the force of each run, and the rig's compliance, are nuisance parameters whose prior is
their stated uncertainty. Gains and the specimen's dimensions are not fitted, because the data must not be allowed to
excuse a wrong model with a wrong gain: their uncertainties are propagated linearly (JCGM 100:2008, 5.1) and stated
apart.

Convention of the Ogden terms: `model.material.materials.Material`.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.rows import Currents
from calibration.film.curve import Curve
from calibration.film.held_out import held_out
from calibration.film.minima import (
    confirm,
    of_law,
    other_minima,
    polish,
    representative,
    scaled,
    search,
    spread,
    starting_materials,
)
from calibration.film.problem import NODES, IdentificationError, Problem, UnknownParameter
from calibration.film.propagation import secant_modulus
from calibration.film.reduction import Selection, select
from calibration.film.result import Identification
from calibration.film.summary import summarise
from calibration.film.suspects.registry import fittable
from calibration.film.suspects.softening import KEY as SOFTENING
from model.material.law import Law
from model.material.materials import Material
from model.membrane.solve import Wrinkling

Array = NDArray[np.float64]

__all__ = ["IdentificationError", "compare", "identify", "secant_modulus"]

PASSES = 5
MOST_NODES = 36
SEARCH_TOLERANCE = 1e-6  # of the membrane's force, relative, while the minima are sought
CHARGE_OFF = 0.1  # largest error of the linear capacitances, in standard deviations of a row
INTERPOLATION = 0.1  # largest estimated error of interpolation, in standard deviations of what a node carries


def identify(
    curves: Sequence[Curve],
    *,
    law: type[Law] | None = None,
    terms: int = 2,
    starts: int = 6,
    seed: int = 0,
    negative_exponents: bool = False,
    profiles: bool = False,
    fixed: Mapping[str, float] | None = None,
    wrinkling: Wrinkling = "plain",
    near: Sequence[Material] = (),
    reach: float = math.inf,
    along: Sequence[str] = (),
    fixed_stretch: tuple[float, float] | None = None,
    currents: Currents | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Identification:
    """Fit a film to force-displacement curves.

    Parameters
    ----------
    curves : sequence of Curve
        All curves of all runs and specimens of one film material.
    law : type[Law], optional
        The law to fit; that of the specimens' material when not given.
    terms : int
        Number of terms, where the law is a series (Ogden).
    starts : int
        Starting points; the first is the material of the specimens, the others are drawn with ``seed``.
    negative_exponents : bool
        Let every third starting point have ``alpha_1 < 0`` (and ``mu_1 < 0``). A sign never changes during a fit.
    profiles : bool
        Also find the 95 % intervals of ``G``, ``stiffness`` and ``eps_r`` by profile likelihood. It takes a few times
        as long, and widens the uncertainties where the problem is too far from linear for its curvature to tell.
    fixed : mapping of str to float, optional
        Shape parameters of the law (``alpha1``..., ``Jm``) and ``eps_r`` that are known and not to be fitted, e.g.
        ``{"eps_r": 1.7}``.
    wrinkling : {"plain", "tension_field"}
        What becomes of samples at which the film is wrinkled: left out, or described by the tension field. They are
        counted either way.
    near : sequence of Material
        Further starting points, of at most as many terms.
    reach : float
        Largest displacement (m) that the rig may go to; no advice goes beyond.
    along : sequence of str
        Errors to be fitted along, run by run, within the size that usually occurs: "eps-stretch", "zero-drift",
        "softening", "voltage-loss" (`calibration.film.suspects.registry.fittable`).
    fixed_stretch : (float, float), optional
        Meridional and hoop stretch of the quantity ``stiffness_fixed``; if it is left out, 1.25 times the pre-stretch,
        and the pre-stretch.
    currents : Currents, optional
        What the supply's current says of the capacitance of the same film, in the same runs: data beside the forces.
        Where a run has several curves their softening is fitted along: it is what the charge tells from permittivity.
    provenance : mapping, optional
        Whatever identifies the data (hashes of logs, names of files), as plain JSON values; kept in the result.

    Raises
    ------
    IdentificationError
        When nothing can be identified from these curves.
    """
    held = dict(fixed or {})
    if not curves:
        raise IdentificationError("there are no curves")
    guess = curves[0].specimen.material
    law = law or guess.law
    moduli, shapes = law.counts(max(1, terms))
    allowed = [*law.names(moduli, shapes)[moduli:], "eps_r"]
    unknown = [name for name in held if name not in allowed]
    if unknown:
        raise UnknownParameter(f"cannot fix {', '.join(unknown)}; what can be fixed is {', '.join(allowed)}")
    if terms < 1 or starts < 1:
        raise IdentificationError("terms and starts must be at least 1")
    choice = fittable()
    strange = [key for key in along if key not in choice]
    if strange:
        raise IdentificationError(f"cannot fit {', '.join(strange)} along; what can be is {', '.join(sorted(choice))}")
    asked = [choice[key] for key in dict.fromkeys(along)]
    more = [choice[SOFTENING]] if currents is not None and SOFTENING not in along else []

    if "eps_r" in held:
        guess = replace(guess, eps_r=held["eps_r"])
    (material,) = scaled([of_law(guess, law, terms, seed)], curves)
    selections = select(curves, material, wrinkling)
    notes: list[str] = []
    nodes = NODES
    for number in range(PASSES):
        if number == 0:
            coarse = Problem(
                curves,
                selections,
                terms,
                material,
                tolerance=SEARCH_TOLERANCE,
                wrinkling=wrinkling,
                along=[*asked, *(more if _repeated(curves, selections) else [])],
                currents=currents,
                coarse=True,
            )
            points = starting_materials(material, terms, starts, seed, held, negative_exponents)
            points += [spread(one, terms) for one in near if law.series]
            fits = search(coarse, scaled(points, curves), held)
            best = representative(fits)
            material = coarse.film(best.x)
        problem = Problem(
            curves,
            selections,
            terms,
            material,
            nodes=nodes,
            wrinkling=wrinkling,
            compliance=best.compliance,
            along=[*asked, *(more if _repeated(curves, selections) else [])],
            currents=currents,
        )
        best = polish(problem, best, held) or best
        material = problem.film(best.x)
        previous, selections = selections, select(curves, material, wrinkling)
        if nodes < MOST_NODES and _too_coarse(problem, best.x):
            nodes = min(MOST_NODES, nodes * 3 // 2)
        elif number > 0 and _same(previous, selections) and _settled(problem, material):
            # The first pass took its weights and corrections from the search: always make a second one.
            break
    else:
        notes.append("the set of samples at which the film is taut did not settle while fitting")
    best = confirm(problem, best, held)
    notes += other_minima(fits)
    if problem.charge is not None and problem.charge.left_out:
        places = problem.charge.left_out + len(problem.charge.currents.places)
        notes.append(
            f"the currents at {problem.charge.left_out} of {places} displacements were left out: no state there"
        )
    record = {
        "data": dict(provenance or {}),
        "settings": {
            "law": law.name,
            "terms": terms,
            "starts": starts,
            "seed": seed,
            "negative_exponents": negative_exponents,
            "profiles": profiles,
            "fixed": held,
            "wrinkling": wrinkling,
            "along": list(problem.along),
            "fixed_stretch": None if fixed_stretch is None else list(fixed_stretch),
            **({"charge": True} if currents is not None else {}),
        },
        "software": {name: importlib.metadata.version(name) for name in ("dea-rig", "lmfit", "numpy", "scipy")},
    }
    return summarise(best, fits, held, notes, record, profiles=profiles, reach=reach, fixed_stretch=fixed_stretch)


def _too_coarse(problem: Problem, x: Array) -> bool:
    """Whether the interpolation of some curve is off by a tenth of the standard error of what a node carries."""
    most = max(block.samples for block in problem.blocks) / problem.nodes.shape[1]
    noise = np.array([problem.curves[i].force_noise for i in problem.active]) / math.sqrt(max(1.0, most))
    return bool((problem.interpolation_error(problem.states(x)) > INTERPOLATION * noise).any())


def _settled(problem: Problem, film: Material) -> bool:
    """Whether the capacitances, linear about the film that the pass began with, are those of the film found."""
    return problem.charge is None or problem.charge.off(film) < CHARGE_OFF


def _repeated(curves: Sequence[Curve], selections: Sequence[Selection]) -> bool:
    """Whether some run has two curves of which samples are used, and one that is used is under voltage."""
    used = [curve for curve, selection in zip(curves, selections, strict=True) if selection.parts]
    electric = any(curve.nominal_voltage != 0.0 for curve in used)
    return electric and len({curve.run for curve in used}) < len(used)


def _same(before: Sequence[Selection], after: Sequence[Selection]) -> bool:
    """Whether two selections hold the same samples in the same parts."""
    return all(
        len(a.parts) == len(b.parts)
        and all(np.array_equal(one.used, other.used) for one, other in zip(a.parts, b.parts, strict=True))
        for a, b in zip(before, after, strict=True)
    )


def compare(curves: Sequence[Curve], *, terms: Sequence[int] = (1, 2, 3), **options: Any) -> list[Identification]:
    """`identify` with each number of Ogden terms, compared by ``aicc``, ``bic`` and ``held_out``; ``options`` as there.

    Each starts from what fewer terms found, too: more terms never fit worse.
    """
    found: list[Identification] = []
    for count in terms:
        fewer = [one.material for one in found if one.terms < count]
        one = identify(curves, terms=count, near=fewer[-1:], **options)
        found.append(replace(one, held_out=held_out(curves, one.material, options.get("wrinkling", "plain"))))
    return found
