"""The base class for states of T*G with a left-invariant metric, for any group."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import at_once, concrete
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import MomentumMap, Scalar
from lieint_jax._numerics.small_linalg import flat
from lieint_jax._xla import compiled
from lieint_jax.core import Group, State
from lieint_jax.groups import so3
from lieint_jax.systems._equations import AbstractMetricSystem
from lieint_jax.systems._shared.arguments import explained


class OnGroup(AbstractMetricSystem):
    """A motion on T*G whose states are made from a configuration q and a motion; free, unless a subclass has more."""

    velocity_kind: ClassVar = "body_velocity"  # what the argument `velocity` of `state` is

    @explained
    def state(
        self,
        q: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        body_momentum: ArrayLike | None = None,
        spatial_momentum: ArrayLike | None = None,
    ) -> State:
        """The state at a configuration, with one of three ways to give the motion.

        Args:
            q: a group element, shape (n, n), within 1e-6 of the group; for `groups.so3` an attitude as in `rigid_body`,
                a unit quaternion (w, x, y, z) or a scipy `Rotation`. By default the identity.
            velocity: body velocity Ω; for a right-invariant metric the spatial velocity ω, with π = mω. Shape (d,).
            body_momentum: Π = mΩ, shape (d,).
            spatial_momentum: π, with Π = Ad*_q π, shape (d,).

        Raises:
            ValueError: not exactly one of the three, a wrong shape, a NaN, or a q off the group.
        """
        element = group_element(self.group, q, self.metric.dtype)
        name, given = _checks.one_of(velocity=velocity, body_momentum=body_momentum, spatial_momentum=spatial_momentum)
        value = _checks.real_array(name, given, (self.group.dim,))
        kind = self.velocity_kind if name == "velocity" else name
        p = _momentum(self.group, self.metric, element, value, kind)
        dtype = jnp.result_type(element, p)
        return State(element.astype(dtype), _checks.real_array("the spatial momentum", p.astype(dtype)))

    def kinetic_energy(self, state: State) -> Scalar:
        """½⟨Π, m⁻¹Π⟩ (5.18)."""
        return vectors.dot(self.body_momentum(state), self.velocity(state)) / 2

    def energy(self, state: State) -> Scalar:
        """½⟨Π, m⁻¹Π⟩ (5.18)."""
        return self.kinetic_energy(state)

    def momentum(self, state: State) -> MomentumMap:
        """The momentum map of the left action (5.21): π itself, shape (d,)."""
        return state.p

    def casimirs(self, state: State) -> MomentumMap:
        """The known Casimirs of body momentum (`group.casimirs`), (k,): constant along every motion without a
        potential."""
        return self.group.casimirs(self.body_momentum(state))

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or the system is a batch of systems."""
        _checks.of_one_system("metric", self.metric, self.group.dim)
        check_element("state.q", self.group, state.q)
        _checks.real_array("state.p", state.p, (self.group.dim,))


@partial(compiled, static_argnums=(0, 4), once=True)
def _momentum(group: Group, metric: Array, q: Array, motion: Array, kind: str) -> Array:
    """π of a body or spatial velocity or momentum."""
    if kind.endswith("velocity"):
        motion = flat(metric, motion)
    return motion if kind.startswith("spatial") else group.Ad_star(group.inverse(q), motion)


@partial(compiled, static_argnums=0, once=True)
def _defect(group: Group, q: Array) -> Array:
    return group.defect(q)


def group_element(group: Group, q: Any, dtype: DTypeLike) -> Array:
    """The element that a user gives as q; of this type the identity for None; on SO(3) any form of an attitude."""
    checked = _checks.unit_quaternion if group is so3 else _checks.real_array
    if q is None:
        return _checks.as_array(group.identity, dtype)
    element = checked("q", q)
    check_element("q", group, element)
    return element


def check_element(name: str, group: Group, q: Array) -> None:
    """Raise ValueError if a concrete q is off the group."""
    shape = np.shape(group.identity)
    if np.shape(q) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(q)}; use jax.vmap for batches")
    if concrete(q):
        with at_once():
            defect = abs(float(_defect(group, q)))
        if not defect <= 2 * _checks.UNIT_TOLERANCE:
            raise ValueError(
                f"{name} is off the group by {defect:.3g}, allowed is {2 * _checks.UNIT_TOLERANCE:g}; make it by "
                "group.exp and group.multiply"
            )
