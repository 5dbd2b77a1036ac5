"""Rigid molecules of water: four sites, of which one carries a Lennard-Jones potential and three carry charges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.potentials._molecule import Molecule, molecule

__all__ = ["water"]

_CALORIE, _OXYGEN, _HYDROGEN = 4.184, 15.9994, 1.008  # J; u


class _Model(NamedTuple):
    hydrogen: float  # its charge, in e
    to_m: float  # from the oxygen to the negative charge, in nm
    well: float  # in kcal/mol
    size: float  # in nm


_MODELS = {"TIP4P": _Model(0.52, 0.015, 0.1550, 0.31536), "TIP4P/2005": _Model(0.5564, 0.01546, 0.1852, 0.31589)}
_BOND, _ANGLE = 0.09572, np.deg2rad(104.52)


def water(model: str = "TIP4P/2005") -> Molecule:
    """A rigid molecule of water: oxygen, two hydrogens, and the negative charge M on the bisector.

    Its axis x is parallel to the line from H to H, and y is normal to the plane of the molecule.

    Args:
        model: "TIP4P" or "TIP4P/2005".

    Source: Jorgensen et al. 1983, J. Chem. Phys. 79, 926; Abascal & Vega 2005, J. Chem. Phys. 123, 234505.
    """
    if not isinstance(model, str) or model not in _MODELS:
        raise ValueError(f"model must be one of {', '.join(map(repr, _MODELS))}, got {model!r}")
    charge, to_m, well, size = _MODELS[model]
    aside, ahead = _BOND * np.sin(_ANGLE / 2), _BOND * np.cos(_ANGLE / 2)
    at = np.array([[0, 0, 0], [aside, 0, ahead], [-aside, 0, ahead], [0, 0, to_m]])
    masses = np.array([_OXYGEN, _HYDROGEN, _HYDROGEN, 0])
    oxygen = np.array([1.0, 0, 0, 0])
    return molecule(masses, at, charge * np.array([0, 1, 1, -2]), well * _CALORIE * oxygen, sizes=size * oxygen)
