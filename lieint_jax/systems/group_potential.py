"""A left-invariant metric and a potential on any group (Section 5.4)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.systems._on_group import OnGroup
from lieint_jax.systems.euler import Euler, kirchhoff
from lieint_jax.types import Group, MechanicalSystem, State, callable_pytree, pytree, static


@pytree
class GroupPotential(OnGroup, MechanicalSystem):
    """H = ½⟨Π, m⁻¹Π⟩ + V(q), Π = Ad*_q π (5.42); q̇ = qΩ̂, π̇ = −T*R dV(q) (5.41). Made by `group_potential`.

    Attributes:
        metric: m in the basis of the algebra, (d,) or (d, d).
        group: the group G.
        potential: V, a callable pytree q ↦ scalar.
        symmetry: algebra elements η with V(exp(sη)q) = V(q), shape (k, d).
    """

    metric: Array
    potential: Callable[[Array], Array]
    symmetry: Array
    group: Group = static()

    @property
    def free(self) -> Euler:
        """The geodesic flow of the metric, without the potential."""
        return Euler(self.metric, self.group)

    def force(self, q: Array) -> Array:
        """−T*R dV, shape (d,): the force of the potential in π̇. Its i-th component is −d/dε V(exp(εeᵢ)q)."""
        zero = jnp.zeros(self.group.dim, q.dtype)
        _, pull = jax.vjp(lambda theta: self.group.spatial_tangent(q, theta), zero)
        return -pull(jax.grad(self.potential)(q))[0]

    def body_force(self, q: Array) -> Array:
        """−T*L dV = Ad*_q of `force`, shape (d,): its i-th component is −d/dε V(q exp(εeᵢ))."""
        zero = jnp.zeros(self.group.dim, q.dtype)
        _, pull = jax.vjp(lambda Omega: self.group.tangent(q, Omega), zero)
        return -pull(jax.grad(self.potential)(q))[0]

    def energy(self, state: State) -> Array:
        """½⟨Π, m⁻¹Π⟩ + V(q)."""
        return self.kinetic_energy(state) + self.potential(state.q)

    def momentum(self, state: State) -> Array:
        """The momentum of the symmetry, ⟨π, η⟩ for each η, shape (k,)."""
        return self.symmetry @ state.p

    def vector_field(self, state: State) -> State:
        """(qΩ̂, −T*R dV) (5.41)."""
        return State(self.group.tangent(state.q, self.velocity(state)), self.force(state.q))


def group_potential(
    group: Group, metric: ArrayLike, potential: Callable[[Array], Array], symmetry: ArrayLike | None = None
) -> GroupPotential:
    """A system of kinetic and potential energy on a group.

    Args:
        group: `groups.so3`, a group of the catalogue, or `groups.matrix(basis)`.
        metric: m in the basis of the group, positive definite: (d,) or (d, d).
        potential: V(q), smooth, q as in `State`. With parameters of its own, a `jax.tree_util.Partial`.
        symmetry: directions η of the algebra, shape (k, d), under whose left action V is invariant: their momenta
            ⟨π, η⟩ are conserved. None for none. Not checked.

    Raises:
        ValueError: a bad metric, V not callable or not a scalar, or symmetry of a wrong shape.

    Example:
        >>> from lieint_jax import groups
        >>> weight = group_potential(groups.special_euclidean(2), [1.0, 2.0, 2.0], lambda q: 9.81 * 2.0 * q[1, 2])
        >>> weight.force(weight.state(velocity=[0.0, 0.0, 0.0]).q).tolist()
        [-0.0, -0.0, -19.62]
    """
    metric = _checks.positive_definite("metric", metric, group.dim)
    if not callable(potential):
        raise ValueError(f"potential must be a function of q, got {potential!r}")
    none = jnp.zeros((0, group.dim), metric.dtype)
    directions = _checks.real_array("symmetry", none if symmetry is None else symmetry, like=metric)
    if directions.ndim != 2 or directions.shape[1] != group.dim:
        raise ValueError(f"symmetry must have shape (k, {group.dim}), got {directions.shape}")
    value = jax.eval_shape(potential, jnp.asarray(group.identity, metric.dtype))
    if getattr(value, "shape", None) != ():
        raise ValueError(f"potential must give a scalar V(q), got {value}")
    return GroupPotential(metric=metric, group=group, potential=callable_pytree(potential), symmetry=directions)


def bottom_heavy(weight: Array, q: Array) -> Array:
    """V = −weight·R₃₃: `weight` is m g times how far below the centre of buoyancy the centre of mass hangs."""
    return -weight * q[2, 2]


def henon_heiles(q: Array) -> Array:
    """V = ½(x² + y²) + x²y − y³/3, on the translations of the plane: Hénon & Heiles, Astron. J. 69 (1964) 73."""
    x, y = q[0, 2], q[1, 2]
    return (x * x + y * y) / 2 + x * x * y - y**3 / 3


def examples() -> dict[str, tuple[GroupPotential, State, float]]:
    """A bottom-heavy ellipsoid in a fluid, symmetric under translations and turns about the vertical; a star."""
    from lieint_jax.groups import translations

    body = kirchhoff(center_of_mass=(0.0, 0.0, -0.2))
    system = group_potential(body.group, body.metric, jax.tree_util.Partial(bottom_heavy, 0.4), jnp.eye(6)[2:])
    star = group_potential(translations(2), [1.0, 1.0], henon_heiles)
    return {
        "bottom_heavy": (system, system.state(velocity=[0.3, -0.4, 0.5, 0.6, 0.2, -0.3]), 0.05),
        "henon_heiles": (star, star.state(velocity=[0.3, 0.35]), 0.05),
    }
