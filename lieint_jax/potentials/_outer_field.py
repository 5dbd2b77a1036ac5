"""External fields, which act on points of the bodies: a uniform field, and any other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import Calls, Positions, Rotations, Scalar
from lieint_jax._xla import compiled
from lieint_jax.core import callable_pytree, pytree, static
from lieint_jax.potentials._potential import Potential
from lieint_jax.potentials._site_pairs import group_sites, site_positions

__all__ = ["outer_field", "uniform_field"]


@pytree
class UniformField(Potential):
    """V = −Σ g·(w_i x_i + Λ_i d_i). Made by `uniform_field`."""

    field: Array  # g, (3,)
    weights: Array  # w, masses or charges of the bodies, (N,)
    moments: Array  # d, Σ w_a s_a over the points of a body, (N, 3)
    chain = True  # it acts on each body alone

    @property
    def count(self) -> int:
        return self.weights.shape[0]

    @property
    def symmetry(self) -> Array:
        """The projector (6, 6) to P perpendicular to the field and L about it, which are conserved."""
        along = jnp.outer(self.field, self.field) / jnp.sum(self.field**2)
        return jax.scipy.linalg.block_diag(jnp.eye(3) - along, along)

    def invariants(self, x: Positions, R: Rotations) -> Array:
        """g·(w_i x_i + Λ_i d_i), (N,)."""
        moments = self.weights[:, None] * x + jnp.sum(R * self.moments[:, None, :], axis=2)
        return jnp.sum(moments * self.field[None], axis=1)

    def value(self, invariants: Array) -> Scalar:
        """V of the invariants."""
        return -jnp.sum(invariants)

    def discrete_gradient(self, start: Array, end: Array) -> Array:
        """−1 for every body."""
        return jnp.full_like(start, -1)


@pytree
class OuterField(Potential):
    """V = Σ w_a φ(x_i + Λ_i s_a), in groups of bodies with equally many points. Made by `outer_field`."""

    phi: Callable[[Array], Array]
    strengths: tuple[Array, ...]  # w of each group, (bodies, points)
    points: tuple[Array, ...]  # s of each group, (bodies, points, 3)
    kept: Array  # the projector (6, 6) to the conserved part of (P, L)
    groups: tuple[tuple[int, ...], ...] = static()  # the bodies of each group

    @property
    def count(self) -> int:
        return sum(map(len, self.groups))

    @property
    def symmetry(self) -> Array:
        return self.kept

    def __call__(self, x: Positions, R: Rotations) -> Scalar:
        terms = zip(self.strengths, self.points, self.groups, strict=True)
        return reduce(
            jnp.add,
            (jnp.sum(w * jax.vmap(jax.vmap(self.phi))(site_positions(s, bodies, x, R))) for w, s, bodies in terms),
        )


def uniform_field(field: ArrayLike, weights: Any, points: Any = None) -> UniformField:
    """A uniform external field, V = −Σ w_a g·r_a: gravity near the ground, or an electric field on charges.

    The components of P perpendicular to the field and the component of L along it are conserved.

    Args:
        field: g, force per weight, (3,), not 0.
        weights: of points of the bodies, their masses or charges: (N, n), or N arrays; (N,) if there is one point each.
        points: in the axes of the body, from its center of mass, (N, n, 3), or N arrays (n_i, 3). By default each
            body's center of mass.

    Raises:
        ValueError: the field is 0, or shapes disagree.
    """
    g = _checks.real_array("field", field, (3,))
    if _checks.concrete(g) and not bool(np.any(np.asarray(g))):
        raise ValueError("field must not be 0")
    groups, at, (w,) = group_sites({"weights": weights}, points)
    order = np.argsort([i for group in groups for i in group])
    return UniformField(g, *_moments(w, at, order))


@partial(compiled, once=True)
def _moments(w: Sequence[Array], at: Sequence[Array], order: ArrayLike) -> tuple[Array, Array]:
    """The weights of the bodies, (N,), and their first moments about the centers of mass, (N, 3)."""
    total = jnp.concatenate([jnp.sum(x, axis=1) for x in w])
    moments = jnp.concatenate([jnp.sum(x[:, :, None] * s, axis=1) for x, s in zip(w, at, strict=True)])
    return total[order], moments[order]


def outer_field(
    phi: Callable[[Array], Array], weights: Any, points: Any = None, conserved: ArrayLike | None = None
) -> OuterField:
    """Any external field that acts on points of the bodies: V = Σ w_a φ(r_a).

    It has no invariants, so `bodies_energy_momentum` does not accept it; use `splitting` or `nystrom`.

    Args:
        phi: position (3,) ↦ the potential of a unit weight.
        weights, points: as in `uniform_field`.
        conserved: the combinations of (P, L) that the field conserves, as rows (k, 6): `jnp.eye(6)[3:]`, that is L, if
            φ depends on the distance from the origin only. By default none. `momentum` returns these components, and 0
            for the others.
    """
    if not callable(phi):
        raise ValueError(f"phi must be a function of a position (3,), got {phi!r}")
    groups, at, (w,) = group_sites({"weights": weights}, points)
    dtype = jnp.result_type(*w)
    rows = jnp.zeros((0, 6), dtype) if conserved is None else _checks.real_array("conserved", conserved)
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise ValueError(f"conserved must be rows (k, 6) of combinations of (P, L), got shape {rows.shape}")
    kept = jnp.linalg.pinv(rows) @ rows if len(rows) else jnp.zeros((6, 6), dtype)
    return OuterField(callable_pytree(phi), w, at, kept, groups)


def _saddle(k: Array, x: Array) -> Array:
    """A field, for the examples."""
    return k * x[0] * x[1]


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    rows = [jnp.array([0.3, 0.4]), jnp.array([0.7])]
    points = [jnp.array([[0.1, 0.2, 0.0], [-0.1, 0.0, 0.1]]), jnp.array([[0.0, 0.2, 0.1]])]
    phi, field = Partial(_saddle, jnp.array(1.3)), jnp.array([0.3, -0.5, 0.7])
    return {
        "outer_field": partial(outer_field, phi=phi, weights=rows, points=points, conserved=None),
        "outer_field along an axis": partial(
            outer_field, phi=phi, weights=rows, points=points, conserved=jnp.array([[0, 0, 1.0, 0, 0, 0]])
        ),
        "uniform_field": partial(uniform_field, field=field, weights=rows, points=points),
    }
