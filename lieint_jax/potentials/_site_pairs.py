"""Sums over pairs of sites fixed in different bodies: point masses, charges, Lennard-Jones sites.

V = Σ v(u_ab), u_ab = |x_i + Λ_i s_a − x_j − Λ_j s_b|², over sites a of body i and b of another body j. The u_ab are
quadratic in positions and rotations and invariant under rigid motions of all bodies together. Bodies with equally many
sites form a group, so that few arrays without padding hold them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import Calls, Positions, Rotations, Scalar
from lieint_jax.core import pytree, static
from lieint_jax.potentials._potential import Potential

__all__ = ["lennard_jones", "point_charges", "point_masses", "sites"]


Groups = tuple[tuple[int, ...], ...]
_FEW = 4  # with at most this many bodies, each is its own group


class _SitePairs(Potential):
    """A potential that is a sum over pairs of sites. Subclasses define the term of a pair.

    The bodies of a group have equally many sites. All pairs of sites of two groups form a matrix; the matrix of a group
    with itself contains each pair twice, and pairs within a body have weight 0.
    """

    points: tuple[Array, ...]  # of each group (bodies, sites, 3), in the axes of the body
    groups: tuple[tuple[int, ...], ...]  # which bodies are in it

    def _pair(self, u: Array, g: int, h: int) -> Array:
        """The terms of V of pairs of sites of the groups g and h at squared distances u, (sites of g, sites of h)."""
        raise NotImplementedError

    def _slope(self, u0: Array, u1: Array, g: int, h: int) -> Array:
        """(v(u₁) − v(u₀))/(u₁ − u₀) without cancellation."""
        raise NotImplementedError

    @property
    def count(self) -> int:
        return sum(map(len, self.groups))

    def invariants(self, x: Positions, R: Rotations) -> tuple[Array, ...]:
        """The squared distances u of every block of pairs; 1 within a body."""
        at = [site_positions(s, bodies, x, R) for s, bodies in zip(self.points, self.groups, strict=True)]
        return tuple(self._distances(at, g, h) for g, h in self._blocks())

    def value(self, invariants: tuple[Array, ...]) -> Scalar:
        """V of the squared distances."""
        blocks = zip(invariants, self._blocks(), strict=True)
        nothing = jnp.zeros((), self.points[0].dtype)
        return sum((jnp.sum(self._weight(g, h) * self._pair(u, g, h)) for u, (g, h) in blocks), nothing)

    def discrete_gradient(self, start: tuple[Array, ...], end: tuple[Array, ...]) -> tuple[Array, ...]:
        """The slopes between the squared distances of two configurations, in closed form."""
        blocks = zip(start, end, self._blocks(), strict=True)
        return tuple(self._weight(g, h) * self._slope(u0, u1, g, h) for u0, u1, (g, h) in blocks)

    def _blocks(self) -> Iterator[tuple[int, int]]:
        """The pairs of groups that interact."""
        n = len(self.groups)
        return ((g, h) for g in range(n) for h in range(g, n) if g != h or len(self.groups[g]) > 1)

    def _distances(self, at: Sequence[Array], g: int, h: int) -> Array:
        a, b = (at[k].reshape(-1, 3) for k in (g, h))
        u = sum((a[:, None, k] - b[None, :, k]) ** 2 for k in range(3))
        return u if g != h else jnp.where(self._in_different_bodies(g), u, 1)  # pyright: ignore[reportReturnType]

    def _weight(self, g: int, h: int) -> Array | float:
        return 1.0 if g != h else jnp.where(self._in_different_bodies(g), 0.5, 0.0)

    def _in_different_bodies(self, g: int) -> Array:
        """Whether two sites of a group are in different bodies."""
        body = jnp.arange(self.points[g].shape[0] * self.points[g].shape[1]) // self.points[g].shape[1]
        return body[:, None] != body[None, :]


@pytree
class InverseDistance(_SitePairs):
    """V = Σ k c_a c_b/√(u_ab + ε²). Made by `point_masses` and `point_charges`."""

    constant: Array  # k, −G for masses
    strengths: tuple[Array, ...]  # c, charges or masses, of each group (bodies, sites)
    points: tuple[Array, ...]
    softening: Array  # ε, a length
    groups: tuple[tuple[int, ...], ...] = static()
    gravity: bool = static()  # whether the strengths are masses

    @property
    def G(self) -> Scalar:
        """The constant of gravity, if the strengths are masses."""
        if not self.gravity:
            raise AttributeError("charges have no constant of gravity G")
        return -self.constant

    def _products(self, g: int, h: int) -> Array:
        return self.constant * self.strengths[g].reshape(-1, 1) * self.strengths[h].reshape(1, -1)

    def _pair(self, u: Array, g: int, h: int) -> Array:
        return self._products(g, h) / jnp.sqrt(u + self.softening**2)

    def _slope(self, u0: Array, u1: Array, g: int, h: int) -> Array:
        r0, r1 = (jnp.sqrt(u + self.softening**2) for u in (u0, u1))
        return -self._products(g, h) / (r0 * r1 * (r0 + r1))


@pytree
class LennardJones(_SitePairs):
    """V = Σ 4ε_ab (v⁶ − v³), v = σ_ab²/u_ab, σ_ab = ½(σ_a + σ_b), ε_ab = √(ε_a ε_b). Made by `lennard_jones`."""

    wells: tuple[Array, ...]  # ε, of each group (bodies, sites)
    sizes: tuple[Array, ...]  # σ, of each group (bodies, sites)
    points: tuple[Array, ...]
    groups: tuple[tuple[int, ...], ...] = static()

    def _mixed_strengths(self, g: int, h: int) -> tuple[Array, Array]:
        """4ε and σ² of the pairs."""
        product = self.wells[g].reshape(-1, 1) * self.wells[h].reshape(1, -1)
        mean = jnp.where(product == 0, 0, jnp.sqrt(jnp.where(product == 0, 1, product)))
        return 4 * mean, (self.sizes[g].reshape(-1, 1) + self.sizes[h].reshape(1, -1)) ** 2 / 4

    def _pair(self, u: Array, g: int, h: int) -> Array:
        depth, square = self._mixed_strengths(g, h)
        third = (square / u) ** 3
        return depth * (third * third - third)

    def _slope(self, u0: Array, u1: Array, g: int, h: int) -> Array:
        depth, square = self._mixed_strengths(g, h)
        v0, v1 = square / u0, square / u1
        c = v0 * v0 + v0 * v1 + v1 * v1
        return depth * c * (1 - v0**3 - v1**3) * v0 * v1 / square


def point_masses(G: ArrayLike, masses: Any, points: Any = None, softening: ArrayLike = 0.0) -> InverseDistance:
    """Gravity of bodies that are made of point masses (mascons): V = −Σ G m_a m_b/√(r_ab² + ε²).

    The potential is invariant: P and L are conserved. `systems.rigid_bodies` has its own masses and inertias of the
    bodies; they are consistent if Σ m_a is the mass and Σ m_a (|s_a|² − s_a s_aᵀ) the tensor of inertia.

    Args:
        G: the constant of gravity.
        masses: (N, n), or N arrays of the masses of each body's points; (N,) if there is one point a body.
        points: in the axes of the body, from its center of mass: (N, n, 3), or N arrays (n_i, 3). By default each body
            is a point.
        softening: ε ≥ 0, a length; by default none.

    Raises:
        ValueError: shapes disagree, or a mass or the softening is negative.
    """
    return _inverse_distance(-_checks.real_array("G", G, ()), "masses", masses, points, softening, True)


def point_charges(constant: ArrayLike, charges: Any, points: Any = None, softening: ArrayLike = 0.0) -> InverseDistance:
    """Coulomb's law between sites of different bodies: V = Σ k c_a c_b/√(r_ab² + ε²).

    Invariant: P and L are conserved.

    Args:
        constant: k = 1/4πε₀ in units consistent with the other arguments: 138.93545764 for kJ/mol, nm and elementary
            charges.
        charges: (N, n), or N arrays of the charges of each body's points; (N,) if there is one point a body.
        points: as in `point_masses`.
        softening: ε ≥ 0, a length; by default none.

    Raises:
        ValueError: shapes disagree, or the softening is negative.
    """
    return _inverse_distance(_checks.real_array("constant", constant, ()), "charges", charges, points, softening, False)


def lennard_jones(wells: Any, sizes: Any, points: Any = None) -> LennardJones:
    """Lennard-Jones' potential between sites of different bodies: V = Σ 4ε ((σ/r)¹² − (σ/r)⁶).

    For two unlike sites σ is the arithmetic and ε the geometric mean (Lorentz and Berthelot). The potential is
    invariant: P and L are conserved.

    Args:
        wells: ε ≥ 0, the depths of the wells: (N, n), or N arrays; (N,) if there is one site a body.
        sizes: σ > 0, the distances where V = 0, of the same shape.
        points: as in `point_masses`.

    Raises:
        ValueError: shapes disagree, a well is negative, or a size is not positive.
    """
    groups, at, (epsilon, sigma) = group_sites({"wells": wells, "sizes": sizes}, points)
    if concrete(epsilon) and not all(bool(np.all(np.asarray(x) >= 0)) for x in epsilon):
        raise ValueError(f"wells must be ≥ 0, got {[np.asarray(x) for x in epsilon]}")
    if concrete(sigma) and not all(bool(np.all(np.asarray(x) > 0)) for x in sigma):
        raise ValueError(f"sizes must be > 0, got {[np.asarray(x) for x in sigma]}")
    return LennardJones(epsilon, sigma, at, groups)


def sites(points: Any, charges: Any, wells: Any, sizes: Any, *, constant: ArrayLike = 138.93545764) -> Potential:
    """Molecules of charges and Lennard-Jones sites: `point_charges` and `lennard_jones` of the same points, added.

    Sites that have no charge in any body, or ε = 0 in all bodies, are omitted from the respective sum. The potential is
    invariant: P and L are conserved.

    Args:
        points: (N, n, 3), in the axes of the body, from its center of mass.
        charges: (n,) for molecules of one kind, or (N, n).
        wells: ε, (n,) or (N, n).
        sizes: σ, (n,) or (N, n); irrelevant where ε = 0.
        constant: 1/4πε₀; by default for kJ/mol, nm and elementary charges.
    """
    at = _checks.real_array("points", points)
    if at.ndim != 3 or at.shape[2] != 3:
        raise ValueError(f"points must have shape (N, n, 3), got {at.shape}")
    given = {"charges": charges, "wells": wells, "sizes": sizes}
    every = at.shape[:2]  # a number of every site, given for each body or once for all
    q, epsilon, sigma = (
        jnp.broadcast_to(_checks.real_array(name, x, every, every[1:]), every) for name, x in given.items()
    )
    charged, soft = _in_use(q), _in_use(epsilon)
    terms: list[Potential] = []
    if charged.any():
        terms.append(point_charges(constant, q[:, charged], at[:, charged]))
    if soft.any():
        terms.append(lennard_jones(epsilon[:, soft], jnp.where(epsilon == 0, 1, sigma)[:, soft], at[:, soft]))
    if not terms:
        raise ValueError("all charges and all ε are 0, so there is no force: give charges or wells that are not 0")
    return terms[0] if len(terms) == 1 else terms[0] + terms[1]


def _in_use(strengths: Array) -> np.ndarray:
    """Which sites of a molecule have a strength other than 0 in some molecule, (n,)."""
    return np.any(np.asarray(strengths) != 0, axis=0) if concrete(strengths) else np.ones(strengths.shape[1], bool)


def _inverse_distance(
    constant: Array, name: str, strengths: Any, points: Any, softening: ArrayLike, gravity: bool
) -> InverseDistance:
    length = _checks.real_array("softening", softening, ())
    if concrete(length) and not float(length) >= 0:
        raise ValueError(f"softening must be a length ≥ 0, got {float(length)}")
    groups, at, (c,) = group_sites({name: strengths}, points)
    if gravity and concrete(c) and not all(bool(np.all(np.asarray(m) >= 0)) for m in c):
        raise ValueError(f"masses must be ≥ 0, got {[np.asarray(m) for m in c]}")
    return InverseDistance(constant, c, at, length, groups, gravity)


def group_sites(numbers: dict[str, Any], points: Any) -> tuple[Groups, tuple[Array, ...], list[tuple[Array, ...]]]:
    """The groups of bodies; the points (bodies, n, 3) of each group; each of the numbers, (bodies, n) of each group.

    Args:
        numbers: by name, of every point of every body: (N, n), or N arrays (n_i,); (N,) if each body has one point.
        points: in the axes of the body, (N, n, 3), or N arrays (n_i, 3). None: one point each, the center of mass.

    Raises:
        ValueError: shapes disagree.
    """
    rows = {name: _rows(name, given) for name, given in numbers.items()}
    first, *_ = rows.values()
    centers = [jnp.zeros((1, 3), c.dtype) for c in first]
    at = centers if points is None else [_checks.real_array("points", s) for s in points]
    for name, given in rows.items():
        shapes = [c.shape for c in given]
        if shapes != [s.shape[:1] for s in at] or any(s.shape[1:] != (3,) for s in at):
            raise ValueError(
                f"{name} and points must have the same number of bodies and of points in each: got {name} of shapes "
                f"{shapes} and points of shapes {[s.shape for s in at]}"
            )
    n = len(first)
    kinds = list(range(n)) if n <= _FEW else [len(c) for c in first]
    groups = tuple(tuple(i for i in range(n) if kinds[i] == kind) for kind in dict.fromkeys(kinds))
    at, *others = (tuple(jnp.stack([x[i] for i in group]) for group in groups) for x in (at, *rows.values()))
    return groups, at, others


def _rows(name: str, given: Any) -> list[Array]:
    """The numbers of the points of each body; a single number per body belongs to its only point."""
    rows = list(given) if np.iterable(given) else []
    if not rows:
        raise ValueError(f"{name} must have an entry for each body, got {given!r}")
    return [jnp.atleast_1d(_checks.real_array(name, c)) for c in rows]


def site_positions(points: Array, bodies: tuple[int, ...], x: Positions, R: Rotations) -> Array:
    """The positions in space of the points of a group, (bodies, n, 3), of all positions x and rotations R."""
    if bodies != tuple(range(x.shape[0])):
        x, R = x[np.array(bodies)], R[np.array(bodies)]
    return x[:, None, :] + jnp.sum(R[:, None, :, :] * points[:, :, None, :], axis=3)


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    points = [jnp.array([[0.1, 0.2, 0.0], [-0.1, 0.0, 0.1]]), jnp.array([[0.0, 0.2, 0.1]])]
    rows = [jnp.array([0.3, 0.4]), jnp.array([0.7])]
    pair, wells = jnp.stack([points[0]] * 2), jnp.array([0.2, 0.7])
    return {
        "point_charges": partial(point_charges, constant=1.3, charges=rows, points=points, softening=0.1),
        "point_masses": partial(point_masses, G=1.3, masses=rows, points=points, softening=0.1),
        "lennard_jones": partial(lennard_jones, wells=rows, sizes=rows, points=points),
        "sites": partial(sites, points=pair, charges=jnp.array([0.3, -0.4]), wells=wells, sizes=wells, constant=1.3),
    }
