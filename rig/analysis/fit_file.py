"""The file that `dea-rig fit -o` writes, read back: the film that was identified, and how well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.material.laws import find_law
from model.material.materials import Material
from model.material.ogden import Ogden
from rig.base.errors import ConfigError
from rig.base.json_text import parse_json
from rig.base.text_file import read_text


@dataclass(frozen=True)
class FittedFilm:
    """Material, and the covariance of its fitted parameters ("mu1", "alpha1", ..., "eps_r") in SI units."""

    material: Material
    names: tuple[str, ...]
    covariance: NDArray[np.float64]


def read_fit(path: Path, believed: Material) -> FittedFilm:
    """The film in ``path``, with strength and largest stretch of the ``believed`` one, which no fit tells.

    Raises
    ------
    ConfigError
        When the file is no result of `dea-rig fit -o`.
    """
    try:
        fit = parse_json(read_text(path, "fit"), "a fit", str(path))
        names = tuple(str(name) for name in fit["parameters"])
        values = {name: float(fit["quantities"][name]["value"]) for name in names}
        covariance = np.array(fit["covariance"], dtype=float)
        if covariance.shape != (len(names), len(names)) or not np.isfinite(covariance).all():
            raise ValueError("its covariance is not complete")
        law = find_law(str(fit.get("law", Ogden.name)))
        moduli, shapes = law.counts(int(fit["terms"]))
        numbers = [values[name] for name in law.names(moduli, shapes)]
        material = replace(
            believed,
            name=f"identified ({path.name})",
            mu=tuple(numbers[:moduli]),
            alpha=tuple(numbers[moduli:]),
            eps_r=values.get("eps_r", believed.eps_r),
            source=str(path),
            law=law,
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a usable result of `dea-rig fit -o`: {error!r}.") from None
    return FittedFilm(material, names, covariance)
