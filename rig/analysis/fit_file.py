"""The file that `dea-rig fit -o` writes, read back: the film that was identified, and how well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.material.laws import find_law
from model.material.materials import Branch, Material
from model.material.ogden import Ogden
from rig.base.errors import ConfigError
from rig.base.json_text import parse_json
from rig.base.text_file import read_text

MOST_TERMS = 6


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
    fit = parse_json(read_text(path, "fit"), "a fit", str(path))
    try:
        names = _names(fit["parameters"])
        values = {name: _number(fit["quantities"][name]["value"], name) for name in names}
        covariance = _covariance(fit["covariance"], len(names))
        law = find_law(str(fit.get("law", Ogden.name)))
        moduli, shapes = law.counts(_terms(fit["terms"]))
        numbers = [values[name] for name in law.names(moduli, shapes)]
        material = replace(
            believed,
            name=f"identified ({path.name})",
            mu=tuple(numbers[:moduli]),
            alpha=tuple(numbers[moduli:]),
            eps_r=values.get("eps_r", believed.eps_r),
            source=str(path),
            law=law,
            branches=_branches(fit["spectrum"]["branches"]) if "spectrum" in fit else believed.branches,
        )
    except KeyError as error:
        raise ConfigError(f"{path}: not a usable result of `dea-rig fit -o`: the key {error} is missing.") from None
    except (TypeError, ValueError, OverflowError, IndexError) as error:
        raise ConfigError(f"{path}: not a usable result of `dea-rig fit -o`: {error}.") from None
    return FittedFilm(material, names, covariance)


def _branches(found: object) -> tuple[Branch, ...]:
    """The Maxwell branches that `dea-rig fit --branches` found."""
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise ValueError("spectrum.branches must be a list of objects")
    return tuple(Branch(_number(one["ratio"], "a ratio"), _number(one["time_s"], "a time")) for one in found)


def _names(parameters: object) -> tuple[str, ...]:
    if not isinstance(parameters, list) or not all(isinstance(name, str) for name in parameters):
        raise ValueError("parameters must be a list of names")
    if len(set(parameters)) < len(parameters):
        raise ValueError("a parameter stands twice")
    return tuple(parameters)


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"the value of {name} must be a number")
    return float(value)


def _terms(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_TERMS:
        raise ValueError(f"terms must be a whole number from 1 to {MOST_TERMS}")
    return value


def _covariance(rows: object, size: int) -> NDArray[np.float64]:
    """The covariance matrix: complete, finite, symmetric, and no variance negative."""
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == size for row in rows):
        raise ValueError(f"the covariance must have {size} rows of {size} numbers")
    covariance = np.array([[_number(value, "the covariance") for value in row] for row in rows]).reshape(-1, size)
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise ValueError("its covariance is not complete")
    if (np.diag(covariance) < 0).any():
        raise ValueError("its covariance holds a negative variance")
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
        raise ValueError("its covariance is not symmetric")
    return covariance
