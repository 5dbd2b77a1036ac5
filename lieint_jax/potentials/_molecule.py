"""Rigid molecules: masses, charges and Lennard-Jones sites, in principal axes; water among them."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls
from lieint_jax.potentials._potential import Potential
from lieint_jax.potentials._site_pairs import sites

__all__ = ["molecule", "water"]

_ALIGNED = 1e-12  # of the largest moment: smaller products of inertia are rounding


@_checks.MassDistribution.register
class Molecule(NamedTuple):
    """A rigid molecule in the consistent units nm, ps, u, kJ/mol and elementary charges.

    Attributes:
        mass: in u.
        inertia: principal moments about the center of mass, (3,), in u nm².
        points: sites in the principal axes, from the center of mass, (n, 3), in nm.
        charges: (n,).
        wells: ε of Lennard-Jones, (n,), in kJ/mol.
        sizes: σ of Lennard-Jones, (n,), in nm.
    """

    mass: float
    inertia: np.ndarray
    points: np.ndarray
    charges: np.ndarray
    wells: np.ndarray
    sizes: np.ndarray

    def potential(self, number: int) -> Potential:
        """The potential of `number` of these molecules."""
        at = jnp.tile(jnp.asarray(self.points), (_checks.count("number", number, 2), 1, 1))
        return sites(at, self.charges, self.wells, self.sizes)


def molecule(
    masses: ArrayLike,
    points: ArrayLike,
    charges: ArrayLike | None = None,
    wells: ArrayLike | None = None,
    *,
    sizes: ArrayLike | None = None,
) -> Molecule:
    """A rigid molecule from its sites: center of mass, principal axes and moments are computed.

    The axes are rotated to principal axes, moments ascending, unless they are principal axes already.

    Args:
        masses: of the sites, in u, (n,), ≥ 0; 0 for a charge without mass.
        points: in any axes, from any origin, in nm, (n, 3), not all on one line.
        charges: in elementary charges, (n,); by default 0.
        wells: ε of Lennard-Jones, in kJ/mol, (n,), ≥ 0; by default 0.
        sizes: σ of Lennard-Jones, in nm, (n,); needed where ε > 0.

    Raises:
        ValueError: shapes disagree, masses or wells are negative, the total mass is 0, the masses lie on one line (no
            inertia about it), or sizes are missing where wells are given.
    """
    m, at = _checks.host_array("masses", masses, float), _checks.host_array("points", points, float)
    if m.ndim != 1 or not m.size or at.shape != (m.size, 3):
        raise ValueError(f"masses (n,) and points (n, 3) are needed, got shapes {m.shape} and {at.shape}")
    given = {"charges": charges, "wells": wells, "sizes": sizes}
    numbers = {name: np.zeros(m.size) if x is None else _checks.host_array(name, x, float) for name, x in given.items()}
    for name, x in {"masses": m, "points": at, **numbers}.items():
        if name != "points" and x.shape != m.shape:
            raise ValueError(f"{name} must have shape {m.shape}, as masses, got {x.shape}")
        if not np.isfinite(x).all() or (name in ("masses", "wells") and (x < 0).any()):
            raise ValueError(f"{name} must be finite{'' if name in ('points', 'charges') else ' and ≥ 0'}, got {x}")
    if not m.sum() > 0:
        raise ValueError(f"the total mass must be positive, got {m.sum()}")
    if ((numbers["wells"] > 0) & (numbers["sizes"] <= 0)).any():
        raise ValueError(f"sizes must be positive where wells are, got {numbers['sizes']}")
    at = at - m @ at / m.sum()
    inertia, at = _principal(m, at)
    if not inertia.min() > _ALIGNED * inertia.max():
        raise ValueError(f"masses must not lie on one line, where a body has no inertia: the moments are {inertia}")
    return Molecule(float(m.sum()), inertia, at, **numbers)


def _principal(m: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The principal moments of masses, and their positions in principal axes."""
    second = (m[:, None] * at).T @ at
    if np.abs(second - np.diag(np.diag(second))).max() > _ALIGNED * second.max():
        _, axes = np.linalg.eigh(np.trace(second) * np.eye(3) - second)
        axes[:, 2] *= np.linalg.det(axes)
        at = at @ axes
    squares = m @ (at * at)
    return squares.sum() - squares, at


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


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    masses, points = np.array([2.0, 1.0, 1.5]), np.array([[0.1, 0.2, 0.0], [-0.1, 0.0, 0.1], [0.3, 0.0, 0.0]])
    more = {"charges": np.array([0.3, -0.4, 0.1]), "wells": np.array([0.2, 0.7, 0.0]), "sizes": np.full(3, 0.3)}
    return {
        "molecule": partial(molecule, masses=masses, points=points, **more),
        "water": partial(water, model="TIP4P/2005"),
    }
