"""Common parts of scenarios of several rigid bodies: the keys of a body, the members."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import model_validator

from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._files import BodyFile
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._spread import INERTIA
from lieint_jax.groups import so3


class BodySpread(keys.RateSpread, keys.AttitudeSpread):
    """Standard deviations of the members' bodies about the nominal one."""

    mass_percent: keys.NonNegative = 0.0
    """Relative standard deviation of the mass, at fixed size and shape."""
    axes_percent: Annotated[keys.NonNegative, keys.Stated("semi-axes", "%")] = 0.0
    """Relative standard deviation of each semi-axis of the equivalent ellipsoid, at fixed mass."""


class ExtendedBody(keys.GivenRate):
    """The keys of a body: mass and moments, or those of a homogeneous ellipsoid; attitude and angular velocity."""

    mass_kg: keys.PositiveFloat | None = None
    """In kg."""
    moments_kg_m2: Annotated[keys.Moments, INERTIA] | None = None
    """Principal moments about the center of mass, in kg m²."""
    semi_axes_m: keys.PositiveTriple | None = None
    """Semi-axes of an ellipsoid along the principal axes, in m."""
    density_kg_m3: keys.PositiveFloat | None = None
    """The density of the ellipsoid, in kg/m³."""
    euler_313_deg: keys.Triple = [0.0, 0.0, 0.0]
    """Attitude R_z(α) R_x(β) R_z(γ), body to space, in degrees."""
    spread: BodySpread = BodySpread()

    files: ClassVar[Mapping[str, type[keys.Table]]] = {"shape": BodyFile}

    @model_validator(mode="after")
    def _check_body(self) -> Self:
        given = [x is not None for x in (self.mass_kg, self.moments_kg_m2, self.semi_axes_m, self.density_kg_m3)]
        if given not in ([True, True, False, False], [True, False, True, False], [False, False, True, True]):
            raise ValueError("give mass_kg and moments_kg_m2, or semi_axes_m and one of density_kg_m3 and mass_kg")
        return self

    def attitude(self) -> Array:
        """The unit quaternion (4,), body to space."""
        return so3.from_euler_313(jnp.deg2rad(jnp.asarray(self.euler_313_deg)))

    def mass(self) -> Any:
        """In kg."""
        if self.mass_kg is not None:
            return self.mass_kg
        assert self.semi_axes_m is not None
        assert self.density_kg_m3 is not None
        return self.density_kg_m3 * 4 / 3 * np.pi * keys.array(self.semi_axes_m).prod()

    def second_moments(self) -> Any:
        """The second moments per mass: those of a homogeneous ellipsoid are the squared semi-axes over 5."""
        if self.semi_axes_m is not None:
            return keys.array(self.semi_axes_m) ** 2 / 5
        J = keys.array(self.moments_kg_m2) / self.mass()
        return J.sum() / 2 - J


def member_bodies(bodies: Sequence[ExtendedBody], noise: Array) -> tuple[Array, Array, Array, Array]:
    """Masses (n,), principal moments (n, 3), attitudes (n, 4) and angular velocities (n, 3) of a member's bodies.

    `noise` are standard normal deviates of mass, semi-axes, attitude and angular velocity, (n, 4 or more, 3).
    """
    m, J, q, Omega = map(jnp.stack, zip(*map(_member_body, bodies, noise), strict=True))
    return m, J, q, Omega


def _member_body(body: ExtendedBody, noise: Array) -> tuple[Array, Array, Array, Array]:
    """The mass, the principal moments, the attitude and the angular velocity of one of a member's bodies."""
    spread, (for_mass, for_axes, for_attitude, for_rate, *_) = body.spread, noise
    mass = body.mass() * (1 + spread.mass_percent / 100 * for_mass[0])
    E = body.second_moments() * (1 + spread.axes_percent / 100 * for_axes) ** 2
    q = so3.multiply(so3.exp(jnp.deg2rad(spread.attitude_deg) * for_attitude), body.attitude())
    return mass, mass * (jnp.sum(E) - E), q, jnp.asarray(body.rate()) + spread.rate() * for_rate


class MultibodyKind(Kind):
    """The keys of scenarios of several bodies, of which every member has its own: its `member` makes step and state."""

    time_unit: Literal["s"] = "s"  # pyright: ignore[reportIncompatibleVariableOverride]
    """Seconds; other units are in the names of the keys."""

    own_step = True
    unit_km = 1e-3

    def noise_shape(self) -> tuple[int, ...]:
        """The shape of a member's standard normal deviates."""
        raise NotImplementedError

    def deviates(self, indices: np.ndarray) -> Array:
        """Those of each member, the same in ensembles of every size, 0 of the nominal one."""
        key, shape = jax.random.key(self.seed), self.noise_shape()
        noise = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(key, k), shape))(jnp.asarray(indices))
        return noise.at[indices == 0].set(0.0)
