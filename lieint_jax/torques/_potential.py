"""Laws that have a potential of a direction in space, which may depend on time: gravity gradient, dipole, any."""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from lieint_jax import _checks
from lieint_jax._checks import named
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.gradients import discrete_gradient
from lieint_jax._numerics.vectors import cross, dot
from lieint_jax.core import Converted, Law, Rotation, argument, callable_pytree, pytree
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import VectorOfTime, evaluate, example_of_time, value_at, vector_of_time
from lieint_jax.torques._body_axes import end_axes, start_axes

__all__ = ["Dipole", "GravityGradient", "dipole", "gravity_gradient", "potential"]


class DirectionalPotential(Law):
    """V(Γ, t) with Γ = Λᵀγ(t): T̄ = κ Γ̄ × D̄, with Γ̄ = ½(Λ_n + Λ_{n+1})ᵀγ at the middle of the step.

    D̄ is a discrete gradient of V at that time: D̄·(Γ_{n+1} − Γ_n) = V(Γ_{n+1}) − V(Γ_n). So the torque itself changes
    the energy by exactly −ΔV at a fixed time, and the work that is booked is the change of V with time alone:
    [V(t_{n+1}) − V(t_m)] at Λ_{n+1} and [V(t_m) − V(t_n)] at Λ_n.
    """

    @abc.abstractmethod
    def axis(self, t: Array) -> Array:
        """γ(t) in space, (3,)."""

    @abc.abstractmethod
    def value(self, Gamma: Array, t: Array) -> Array:
        """V(Γ, t)."""

    @abc.abstractmethod
    def gradient(self, a: Array, b: Array, t: Array) -> Array:
        """D̄ between Γ_n = a and Γ_{n+1} = b, (3,)."""

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """κ Γ̄ × D̄."""
        axis = self.axis(rotation.t)
        a, b = start_axes(rotation, axis), end_axes(rotation, axis)
        return rotation.kappa * jnp.stack(cross((a + b) / 2, self.gradient(a, b, rotation.t))), inner

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """V."""
        return self.value(so3.Ad_star(q, self.axis(t)), t)

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        """The change of V with time, half of it at each attitude."""

        def change_in_time(q: Array, first: Array, last: Array) -> Array:
            return self.energy(last, q, None) - self.energy(first, q, None)

        t = rotation
        return change_in_time(t.q_n, t.start, t.t) + change_in_time(t.q_next, t.t, t.end)


@pytree
class GravityGradient(DirectionalPotential):
    """The torque 3μ/r³ r̂ × Jr̂ of the gravity of a distant center on a body along an orbit; its work in closed form.

    Args:
        orbit: t ↦ (position, velocity) of the body's center from that of attraction, such as `orbits.kepler(…)`.
        inertia: J of the body with everything in it, such as wheels at rest ("locked"), (3,) or (3, 3), in body axes.
        mu: the gravitational parameter; by default `orbit.mu`.

    Raises:
        ValueError: an orbit that is no such function, or in axes that rotate; bad inertia, no mu.

    Source: Hughes 1986, Spacecraft Attitude Dynamics, 8.1; the mean torque of a step: this package.
    """

    orbit: Converted[Any] = argument(converter=lambda orbit: callable_pytree(_checks.inertial(_checks.orbit(orbit))))
    inertia: Converted[Array] = argument(converter=partial(_checks.inertia, stacklevel=4))
    mu: Converted[Array] = argument(converter=named(_checks.real_array, "mu", (), optional=True), default=None)

    def check_fields(self) -> dict[str, Array]:
        """mu, by default that of the orbit; ValueError if it has none."""
        mu = getattr(self.orbit, "mu", None) if self.mu is None else self.mu
        if mu is None:
            raise ValueError("this orbit has no mu: give gravity_gradient(orbit, inertia, mu=…)")
        return {"mu": _checks.real_array("mu", mu, ())}

    def axis(self, t: Array) -> Array:
        """r̂ |√(3μ/r³)|: the direction of the body from the center, in a length that leaves V = ½ Γ·JΓ."""
        r, _ = evaluate(self.orbit, t)
        square = dot(r, r)
        return r * (jnp.sqrt(3 * self.mu / jnp.sqrt(square)) / square)

    def value(self, Gamma: Array, t: Array) -> Array:
        """½ Γ·JΓ."""
        return dot(Gamma, self._times(Gamma)) / 2

    def gradient(self, a: Array, b: Array, t: Array) -> Array:
        """J Γ̄."""
        return self._times((a + b) / 2)

    def _times(self, Gamma: Array) -> Array:
        return jnp.stack(vectors.symmetric(self.inertia) @ Gamma)


@pytree
class Dipole(DirectionalPotential):
    """A magnetic moment that is fixed in the body, in a field: T = m × b. Its potential −m·b is counted in the energy.

    Args:
        moment: m in the body, (3,), torque / field.
        field: b in space, (3,), or a function of time with such values, such as the field along an orbit.

    Raises:
        ValueError: no vector, or no function with such values.
    """

    moment: Converted[Array] = argument(converter=named(_checks.real_array, "moment", (3,)))
    field: Converted[VectorOfTime] = argument(converter=named(vector_of_time, "field"))

    def axis(self, t: Array) -> Array:
        """b(t)."""
        return value_at(self.field, t)

    def value(self, Gamma: Array, t: Array) -> Array:
        """−m·Γ."""
        return -dot(self.moment, Gamma)

    def gradient(self, a: Array, b: Array, t: Array) -> Array:
        """−m."""
        return -self.moment


@pytree
class AnyPotential(DirectionalPotential):
    """V(Γ, t) of an axis. Made by `potential`."""

    function: Callable[..., Array]
    direction: VectorOfTime
    label = "potential"  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def axis(self, t: Array) -> Array:
        """γ(t)."""
        return value_at(self.direction, t)

    def value(self, Gamma: Array, t: Array) -> Array:
        """V(Γ, t)."""
        return self.function(Gamma, t)

    def gradient(self, a: Array, b: Array, t: Array) -> Array:
        """The discrete gradient of Gonzalez with the mean of four Gauss nodes."""
        return discrete_gradient(self.function, a, b, 1e-6, t)


def potential(V: Callable[..., Array], axis: Any) -> AnyPotential:
    """The torque Γ × ∇V of any potential V(Γ, t) of an axis, Γ = Λᵀγ(t) in the body; counted in the energy.

    Args:
        V: (Γ (3,), t) ↦ energy, a JAX function; numbers to be differentiated go into a `jax.tree_util.Partial`.
        axis: γ in space, (3,), or a function of time with such values.

    Raises:
        ValueError: V or axis is no such function.
    """
    _checks.function("V", V, "Gamma (3,) and t", (), jnp.zeros(3), jnp.zeros(()))
    return AnyPotential(callable_pytree(V), vector_of_time("axis", axis))


dipole, gravity_gradient = Dipole, GravityGradient


def _circle(r: Array, t: Array) -> tuple[Array, Array]:
    """An orbit, for the examples."""
    c, s = jnp.cos(t), jnp.sin(t)
    return r * jnp.stack([c, s, 0 * t]), r * jnp.stack([-s, c, 0 * t])


def _energy_of_axis(k: Array, Gamma: Array, t: Array) -> Array:
    """A potential, for the examples."""
    return k * Gamma[0] * Gamma[1] * jnp.cos(t)


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    axis = example_of_time()
    orbit, V = Partial(_circle, jnp.array(1.2)), Partial(_energy_of_axis, jnp.array(0.7))
    return {
        "dipole": partial(dipole, moment=jnp.array([0.3, -0.5, 0.7]), field=axis),
        "gravity_gradient": partial(gravity_gradient, orbit=orbit, inertia=jnp.array([1.3, 1.7, 2.2]), mu=1.3),
        "potential": partial(potential, V=V, axis=axis),
    }
