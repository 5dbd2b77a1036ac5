"""A satellite, or any body in an orbit, under the torque of gravity's gradient (MacCullagh 1844)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import concrete, named
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Time, Vector3
from lieint_jax._xla import shapes_now
from lieint_jax.core import Converted, State, System, argument, callable_pytree, pytree
from lieint_jax.groups import so3
from lieint_jax.orbits import kepler
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._driven_top import MovedBody
from lieint_jax.systems._potential_top import QuadraticPotential
from lieint_jax.systems._shared.body import as_inertia

__all__ = ["GravityGradient", "gravity_gradient"]


@pytree
class TidalAxis:
    """γ(t) = √(3μ/r³) r̂: a vector along the line to the center of attraction, scaled so that V = ½Γ·JΓ."""

    orbit: Any  # t ↦ (position (3,), velocity (3,)) about the center
    mu: Array | None  # None for that of the orbit

    def __call__(self, t: Time) -> Vector3:
        position = self.orbit(t)[0]
        mu = self.orbit.mu if self.mu is None else self.mu
        r = vectors.norm(position)
        return jnp.sqrt(3 * mu / r) / (r * r) * position


@pytree
class GravityGradient(MovedBody):
    """A rigid body whose center moves on a given orbit, in the field of a point mass, to second order of size/distance.

    H = ½ Π·J⁻¹Π + (3μ/2r³) r̂·ΛJΛᵀr̂ with r̂(t), r(t) of the orbit; the torque in space is (3μ/r³) r̂ × ΛJΛᵀr̂. The attitude
    with the axis of least moment along r̂ is stable. The orbit is prescribed: the attitude does not influence it. Energy
    less work is conserved.

    Args:
        inertia: about the center of mass: principal moments (3,) or a symmetric tensor (3, 3).
        orbit: a function t ↦ (position, velocity), each (3,), of the center of mass about the center of attraction,
            such as `orbits.kepler(...)`, whose clock is the time of the states.
        mu: the gravitational parameter of the center of attraction, > 0; by default `orbit.mu`.

    Raises:
        ValueError: bad inertia; `orbit` is not such a function, or its axes rotate; μ is missing or not positive.

    Source: MacCullagh 1844; Hughes 1986, Spacecraft Attitude Dynamics, 8.1.

    Example: a satellite in an elliptic orbit, mean motion 1.

        >>> from lieint_jax import orbits
        >>> satellite = gravity_gradient([1.0, 2.0, 2.5], orbits.kepler(1.0, 1.0, 0.1))
        >>> state = satellite.state(angular_velocity=[0.0, 0.0, 1.0], t=0.0, work=0.0)
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    orbit: Converted[Any] = argument(converter=lambda orbit: callable_pytree(_checks.inertial(orbit)))
    mu: Converted[Array | None] = argument(
        converter=named(_checks.real_array, "mu", (), optional=True), like="inertia", default=None
    )

    def check_fields(self) -> None:
        """Raise ValueError if the orbit is no such function of time, or μ is missing or not positive."""
        orbit = self.orbit
        if not callable(orbit):
            raise ValueError(
                f"orbit must be a function t ↦ (position, velocity), such as orbits.kepler(...), got {orbit!r}"
            )
        if (mu := getattr(orbit, "mu", None) if self.mu is None else self.mu) is None:
            raise ValueError("the orbit has no attribute mu: give mu, the gravitational parameter of the center")
        if concrete(mu) and not float(mu) > 0:
            raise ValueError(f"mu must be positive, got {float(mu)}")
        try:
            shapes = [x.shape for x in shapes_now(orbit, jnp.zeros((), self.inertia.dtype))]
        except (AttributeError, TypeError, IndexError, ValueError) as error:
            raise ValueError(f"orbit must be a function t ↦ (position, velocity); it fails: {error}") from error
        if shapes != [(3,), (3,)]:
            raise ValueError(f"orbit must give (position, velocity), each of shape (3,), got shapes {shapes}")

    @property
    def potential(self) -> QuadraticPotential:
        """Ṽ(Γ) = ½Γ·JΓ; only the axis depends on time."""
        return QuadraticPotential(self.inertia)

    @property
    def axis(self) -> TidalAxis:
        """γ(t) = √(3μ/r³) r̂."""
        return TidalAxis(self.orbit, self.mu)


gravity_gradient = GravityGradient
PROPERTIES = SystemProperties(
    name="gravity_gradient",
    models="a satellite or a moon on a given orbit",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy less work",),
    momentum="none",
    sizes=(0,),
    aliases=("satellite in a gravity gradient", "spin–orbit coupling"),
    source="MacCullagh 1844; Hughes 1986",
)


def examples() -> dict[str, tuple[System, State, float]]:
    """Satellites that librate in an elliptic orbit, and a body that an Earth-like planet passes in a hyperbola."""
    attitude = so3.exp(jnp.array([0.2, -0.1, 0.4]))
    satellite = gravity_gradient([1.0, 2.0, 2.5], kepler(1.0, 1.0, 0.1, 0.4, node=0.3, periapsis=1.1))
    flyby = gravity_gradient([1.0, 1.6, 2.0], kepler(2.0, -1.5, 1.6, 0.3, node=0.2, periapsis=0.7))
    return {
        "satellite": (satellite, satellite.state(attitude, angular_velocity=[0.2, 0.3, 1.0], t=0.7, work=0.0), 0.05),
        "flyby": (flyby, flyby.state(attitude, angular_velocity=[0.5, 0.2, 0.7], t=-0.5, work=0.0), 0.05),
    }
