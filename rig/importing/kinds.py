"""Which homogeneous test a table holds, by the many names that laboratories give it."""

from __future__ import annotations

import re
from collections.abc import Iterable

from rig.importing.headings import fold

# In this order: "strip biaxial" is pure shear, and a name with "equibiaxial" holds "biaxial" too.
NAMES: tuple[tuple[str, str], ...] = (
    ("simple shear", r"simple shear|einfache scherung|cisaillement simple|lap shear|double shear"),
    (
        "pure shear",
        r"pure ?shear|planar|strip biaxial|wide strip|constrained (width|tension)|reine scherung|"
        r"cisaillement pur|pureshear|\bps\b",
    ),
    (
        "equibiaxial",
        r"equi ?(bi ?axial|biax)|equal biaxial|gleich ?biaxial|aqui ?biaxial|bulge|bubble|inflation|balloon|"
        r"gonflement|\bet\b|\bebt?\b|\bequi\b",
    ),
    ("biaxial", r"bi ?axial|zweiachsig|biaxe"),
    (
        "uniaxial",
        r"uni ?axial|einachsig|zug(versuch|prufung|test)?\b|zugversuch|tensile|simple tension|tension test|"
        r"tensile|traction|\but\b|\bst\b|dumbbell|dogbone|schulterstab|"
        r"uniax|compression|druckversuch|trazione|traccion",
    ),
    ("uniaxial", r"\btension\b"),
)
# Standards that describe a tensile test of a strip or dumb-bell.
STANDARDS = re.compile(r"(astm )?d ?(412|638|882)\b|iso (37|527)\b|din (en iso )?(53504|527)\b|jis k ?6251")
KINDS = ("uniaxial", "equibiaxial", "pure shear", "biaxial")


def kind_in(text: str) -> str | None:
    """The kind of test that a text names; "simple shear" is known but not supported, None names none.

    >>> [kind_in(t) for t in ("equi-biaxial_test", "Zugversuch_3", "planar", "strip_biaxial", "shear", "UT.txt")]
    ['equibiaxial', 'uniaxial', 'pure shear', 'pure shear', None, 'uniaxial']
    """
    folded = re.sub(r"(?<=[a-z])(?=[0-9])", " ", fold(text))  # Zug1
    return next((kind for kind, pattern in NAMES if re.search(pattern, folded)), None)


def kind_of_standard(texts: Iterable[str]) -> tuple[str, str] | None:
    """The kind that a testing standard stands for, and the text that names it."""
    for text in texts:
        if STANDARDS.search(fold(text)):
            return "uniaxial", text
    return None
