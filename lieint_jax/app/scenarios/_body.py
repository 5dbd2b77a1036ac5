"""The common keys of scenarios of rigid bodies, one or several: inertia, initial state, and their spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks, maps
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._files import BodyFile, ShapeFile
from lieint_jax.app.scenarios._kind import Kind, step_of
from lieint_jax.app.scenarios._spread import INERTIA
from lieint_jax.groups import so3
from lieint_jax.plots.runs import axis_in_space, is_long_axis_mode, spin_axis
from lieint_jax.types import State, Step

__all__ = ["axis_in_space", "is_long_axis_mode", "spin_axis"]

KAPPAS = {kappa.name: kappa for kappa in maps.KAPPAS}


class InitialState(keys.GivenRate):
    """The nominal state: an attitude, given by one of two keys, and an angular velocity in the body."""

    quaternion: keys.Quaternion | None = None
    """Attitude (w, x, y, z), body to space, of unit length."""
    euler_313_deg: keys.Triple | None = None
    """Attitude R_z(α) R_x(β) R_z(γ), body to space, in degrees."""

    def _check_attitude(self) -> None:
        if (self.quaternion is None) == (self.euler_313_deg is None):
            raise ValueError("give the attitude by exactly one of quaternion and euler_313_deg")

    def attitude(self) -> Any:
        if self.euler_313_deg is not None:
            return so3.from_euler_313(jnp.deg2rad(jnp.asarray(self.euler_313_deg)))
        return jnp.asarray(self.quaternion)


class BodyKind(Kind):
    """The keys of every scenario of a rigid body."""

    inertia: Annotated[list[Any], INERTIA, keys.checked(_checks.inertia)]
    """Principal moments (3) or a tensor in body axes (3 × 3)."""
    state: InitialState
    spread: keys.RotationSpread = keys.RotationSpread()

    files: ClassVar[Mapping[str, type[keys.Table]]] = {"shape": ShapeFile}
    fixed: ClassVar[dict[str, str]] = Kind.fixed | {
        "state.quaternion": "a unit quaternion has three degrees of freedom: give attitude_deg",
        "observation.*": "it is an observed value",
    }

    def start(self, system: Any, noise: Array) -> State:
        return self.state_about(system, noise, self.state.attitude(), jnp.asarray(self.state.rate()))

    def state_about(self, body: Any, noise: Array, q: Array, Omega: Array, **options: Any) -> State:
        """A member's state about an attitude and a body angular velocity; `options` go to `body.state`."""
        rotation, change = jnp.deg2rad(self.spread.attitude_deg) * noise[0], self.spread.rate() * noise[1]
        return body.state(so3.multiply(so3.exp(rotation), q), angular_velocity=Omega + change, **options)


class TopKind(BodyKind):
    """The keys of every scenario of a rigid body in an axial potential."""

    scheme: Literal["top_energy_momentum", "splitting"] = "top_energy_momentum"
    kappa: Literal["cayley", "exponential", "symplectic"] | None = None
    """The κ of top_energy_momentum; by default cayley."""
    order: keys.Order = 2

    def _check_kappa(self) -> None:
        if self.kappa is not None and self.scheme == "splitting":
            raise ValueError("kappa is a key of top_energy_momentum; splitting uses the symplectic one")

    def make_step(self) -> Step:
        return self.step_by(self.scheme, self.make_system())

    def step_by(self, scheme: str, top: Any) -> Step:
        """The step of a scheme for tops, at the order of the scenario."""
        kappa = KAPPAS[self.kappa or "cayley"]
        return step_of(top, scheme, self.order, *[kappa] * (scheme == "top_energy_momentum"))


def direction(longitude: Any, latitude: Any) -> Array:
    """The unit vectors (…, 3) of longitudes and latitudes in rad."""
    c = jnp.cos(latitude)
    return jnp.stack([c * jnp.cos(longitude), c * jnp.sin(longitude), jnp.sin(latitude)], axis=-1)


def longitude_latitude(p: ArrayLike) -> Array:
    """Longitude in [0, 360) and latitude of vectors (…, 3), in degrees, (…, 2)."""
    x, y, z = jnp.moveaxis(jnp.asarray(p), -1, 0)
    return jnp.rad2deg(jnp.stack([jnp.arctan2(y, x) % (2 * jnp.pi), jnp.arctan2(z, jnp.hypot(x, y))], axis=-1))


def inertia_matrix(body: Any) -> np.ndarray:
    """The inertia of a body or a scenario as a matrix (3, 3), also where it is given by principal moments."""
    J = np.asarray(body.inertia, float)
    return np.diag(J) if J.ndim == 1 else J


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

    def _check_body(self) -> None:
        given = [x is not None for x in (self.mass_kg, self.moments_kg_m2, self.semi_axes_m, self.density_kg_m3)]
        if given not in ([True, True, False, False], [True, False, True, False], [False, False, True, True]):
            raise ValueError("give mass_kg and moments_kg_m2, or semi_axes_m and one of density_kg_m3 and mass_kg")

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
