"""Branches of a film as the Prony series of other programs.

With the modulus ``G(t) = G (1 + sum r_k exp(-t/tau_k))`` of a relaxed film G, ``r`` the sum of the ratios:

========  ===================================  =====================================  ==========================
program   moduli of the law that it asks for   its number of branch k                 ``G(t)`` in its numbers
========  ===================================  =====================================  ==========================
Abaqus    relaxed, with MODULI=LONG TERM       ``g_k = r_k/(1 + r)``                  ``G0 (1 - sum g_k (1 - e_k))``
Ansys     those at once: ``(1 + r)`` times     ``a_k = r_k/(1 + r)``                  ``G0 (1 - sum a_k (1 - e_k))``
COMSOL    relaxed                              ``beta_v,k = r_k``                     ``G (1 + sum beta_v,k e_k)``
FEBio     relaxed, with g0 = 1                 ``g_k = r_k``                          ``G (g0 + sum g_k e_k)``
========  ===================================  =====================================  ==========================

``e_k = exp(-t/tau_k)`` and ``G0 = (1 + r) G``. At small strain all are the same film; at large strain these programs
relax the stress in another way, and their branches rest in the undeformed film: stretch it first and let it rest.

Sources: Abaqus Materials Guide, "Time domain viscoelasticity" (abaqus-docs.mit.edu/2017, simamat-c-timevisco:
``g_R(t) = G_R(t)/G_0`` with the instantaneous ``G_0``; MODULI=LONG TERM says that the hyperelastic constants are
those of ``G_inf``); Ansys Material Reference, "Viscoelasticity" (TB,PRONY; ``g_R(t) = g_inf + sum g_i e_i`` with
``g_R(0) = 1``, so the hyperelastic constants are those at once; both also at
polymerfem.com/mcalibration-prony-series); COMSOL Structural Mechanics Module User's Guide, theory of viscoelasticity
(doc.comsol.com/6.0, sme_ug_theory.06.26: branches beside the main elastic branch; at large strain energy factors over
it); FEBio, source of FEUncoupledViscoElasticMaterial (github.com/febiosoftware/FEBio: ``S = g0 S_e + sum g_i H_i``,
``g0 = 1`` unless given).
"""

from __future__ import annotations

from dataclasses import replace

from model.material.materials import Material


def stiff(material: Material) -> float:
    """Stiffness at once over that of the relaxed film."""
    return 1.0 + sum(one.ratio for one in material.branches)


def at_once(material: Material) -> Material:
    """The film with the moduli that it has at once."""
    return replace(material, mu=tuple(mu * stiff(material) for mu in material.mu))


def over_instant(material: Material) -> list[tuple[float, float]]:
    """Ratio over the stiffness at once and relaxation time (s) of every branch: Abaqus, Ansys."""
    return [(one.ratio / stiff(material), one.time) for one in material.branches]


def over_relaxed(material: Material) -> list[tuple[float, float]]:
    """Ratio over the relaxed film and relaxation time (s) of every branch: COMSOL, FEBio."""
    return [(one.ratio, one.time) for one in material.branches]
