"""A left-invariant metric and a potential on any group (Section 5.4)."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import DualVector, MomentumMap, Scalar, SquareMatrix, Time
from lieint_jax.core import Group, State, System, callable_pytree, clock, pytree, static
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractDrivenSystem, AbstractMechanicalSystem, spatial_force
from lieint_jax.systems._euler import Euler, kirchhoff
from lieint_jax.systems._shared.arguments import check_timed, explained, timed
from lieint_jax.systems._shared.on_group import OnGroup

__all__ = ["DrivenGroupPotential", "GroupPotential", "group_potential"]


@pytree
class _InPotential(OnGroup):
    """What potentials with and without a time have in common."""

    metric: Array
    potential: Callable[..., Array]
    symmetry: Array
    group: Group = static()

    @property
    def free(self) -> Euler:
        """The geodesic flow of the metric, without the potential."""
        return Euler(self.metric, self.group)

    def momentum(self, state: State) -> MomentumMap:
        """The momentum of the symmetry, ⟨π, η⟩ for each η, shape (k,)."""
        return self.symmetry @ state.p


@pytree
class GroupPotential(_InPotential, AbstractMechanicalSystem):
    """H = ½⟨Π, m⁻¹Π⟩ + V(q), Π = Ad*_q π (5.42); q̇ = qΩ̂, π̇ = −T*R dV(q) (5.41). Made by `group_potential`."""

    def energy(self, state: State) -> Scalar:
        """½⟨Π, m⁻¹Π⟩ + V(q)."""
        return self.kinetic_energy(state) + self.potential(state.q)


@pytree
class DrivenGroupPotential(_InPotential, AbstractDrivenSystem):
    """H = ½⟨Π, m⁻¹Π⟩ + V(q, t): (5.41) with a potential that is a given function of time. Made by `group_potential`.

    H − work is conserved, with work = ∫∂V/∂t dt.
    """

    @explained
    def state(
        self,
        q: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
        t: ArrayLike = 0.0,
        work: ArrayLike | None = None,
    ) -> State:
        """The state at a configuration and a time.

        Args:
            q, velocity, body_momentum, spatial_momentum: as in `GroupPotential.state`.
            t: the time of the state, a scalar; by default 0.
            work: 0.0 to track the work done on the system from here on; None not to track it.

        Raises:
            ValueError: as in `GroupPotential.state`; a time or work that is not a finite scalar.
        """
        start = super().state(q, velocity=velocity, body_momentum=body_momentum, spatial_momentum=spatial_momentum)
        return timed(start, t, work)

    def force(self, q: SquareMatrix, t: Time) -> DualVector:
        """−T*R dV, shape (d,), at a time."""
        return spatial_force(self.group, lambda q: self.potential(q, t), q)

    def power(self, q: SquareMatrix, t: Time) -> Scalar:
        """∂V/∂t, a scalar."""
        return jax.jvp(lambda t: self.potential(q, t), (t,), (jnp.ones_like(t),))[1]

    def energy(self, state: State) -> Scalar:
        """½⟨Π, m⁻¹Π⟩ + V(q, t)."""
        return self.kinetic_energy(state) + self.potential(state.q, clock(state))

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        super().check(state)
        check_timed(state)


def group_potential(
    group: Group, metric: ArrayLike, potential: Callable[..., Array], symmetry: ArrayLike | None = None
) -> GroupPotential | DrivenGroupPotential:
    """A system with a left-invariant kinetic energy and a potential on a matrix group.

    Its motion conserves energy, or energy less work if the potential depends on time, and the momenta of its symmetry.

    Args:
        group: `groups.so3`, a group of the catalogue, or `groups.matrix(basis)`.
        metric: m in the basis of the group, positive definite: (d,) or (d, d).
        potential: V(q), smooth, with q as in `State`; or V(q, t), whose states have a time. A function with parameters
            is a `jax.tree_util.Partial`. A function that can be called with q alone is a V(q).
        symmetry: directions η of the algebra, shape (k, d), under whose left action V is invariant, so that their
            momenta ⟨π, η⟩ are conserved; this is not checked. By default none.

    Raises:
        ValueError: a bad metric; V is not callable or not a scalar; `symmetry` has a wrong shape.

    Source: Lewis & Simo 1994, (5.41).

    Example:
        >>> from lieint_jax import groups
        >>> plane = groups.special_euclidean(2)
        >>> weight = group_potential(plane, [1.0, 2.0, 2.0], lambda q: 9.81 * 2.0 * q[1, 2])
        >>> weight.force(weight.state(velocity=[0.0, 0.0, 0.0]).q).tolist()
        [-0.0, -0.0, -19.62]
    """
    metric = _checks.positive_definite("metric", metric, group.dim, mixed_units=True)
    if not callable(potential):
        raise ValueError(f"potential must be a function of q, got {potential!r}")
    none = jnp.zeros((0, group.dim), metric.dtype)
    directions = _checks.real_array("symmetry", none if symmetry is None else symmetry, like=metric)
    if directions.ndim != 2 or directions.shape[1] != group.dim:
        raise ValueError(f"symmetry must have shape (k, {group.dim}), got {directions.shape}")
    driven = _takes_time(potential)
    at = (jnp.asarray(group.identity, metric.dtype), *[jnp.zeros((), metric.dtype)] * driven)
    _checks.function("potential", potential, "(q, t)" if driven else "q", (), *at)
    made = DrivenGroupPotential if driven else GroupPotential
    return made(metric=metric, group=group, potential=callable_pytree(potential), symmetry=directions)


def _takes_time(potential: Callable[..., Array]) -> bool:
    """Whether a function needs a time in addition to q."""
    try:
        inspect.signature(potential).bind(None)
    except TypeError:
        return True
    except ValueError:  # a function that does not tell
        return False
    return False


def bottom_heavy(weight: Scalar, q: SquareMatrix) -> Scalar:
    """V = −weight·R₃₃: `weight` is m g times the depth of the center of mass below the center of buoyancy."""
    return -weight * q[2, 2]


def henon_heiles(q: SquareMatrix) -> Scalar:
    """V = ½(x² + y²) + x²y − y³/3, on the translations of the plane: Hénon & Heiles, Astron. J. 69 (1964) 73."""
    x, y = q[0, 2], q[1, 2]
    return (x * x + y * y) / 2 + x * x * y - y**3 / 3


def driven_henon_heiles(q: SquareMatrix, t: Time) -> Scalar:
    """`henon_heiles` in a galaxy whose mass pulsates."""
    return (1 + 0.2 * jnp.cos(0.7 * t)) * henon_heiles(q)


PROPERTIES = SystemProperties(
    name="group_potential",
    models="a metric and a potential on a matrix group",
    phase_space="T*G: matrix (n, n), π (d,)",
    conserves=("energy (of a potential without time)", "energy less work", "momentum"),
    momentum="⟨π, η⟩ of each symmetry η",
    sizes=(),
    aliases=("simple mechanical system on a Lie group",),
    source="Lewis & Simo 1994, (5.41)",
)


def examples() -> dict[str, tuple[System, State, float]]:
    """A bottom-heavy ellipsoid in a fluid, symmetric under translations and rotations about the vertical; two stars."""
    from lieint_jax.groups import translations

    body = kirchhoff(center_of_mass=(0.0, 0.0, -0.2))
    system = group_potential(body.group, body.metric, jax.tree_util.Partial(bottom_heavy, 0.4), jnp.eye(6)[2:])
    star = group_potential(translations(2), [1.0, 1.0], henon_heiles)
    pulsating = group_potential(translations(2), [1.0, 1.0], driven_henon_heiles)
    return {
        "pulsating": (pulsating, pulsating.state(velocity=[0.3, 0.35], t=0.4, work=0.0), 0.05),  # pyright: ignore[reportCallIssue]
        "bottom_heavy": (system, system.state(velocity=[0.3, -0.4, 0.5, 0.6, 0.2, -0.3]), 0.05),
        "henon_heiles": (star, star.state(velocity=[0.3, 0.35]), 0.05),
    }
