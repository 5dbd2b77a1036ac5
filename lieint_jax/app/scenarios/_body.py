"""The common keys of scenarios of a rigid body: inertia, initial attitude and angular velocity, and their spread."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from pydantic import model_validator

from lieint_jax import _checks, maps
from lieint_jax.app.scenarios._files import ShapeFile
from lieint_jax.app.scenarios._keys import GivenRate, Quaternion, RotationSpread, Table, Triple, checked
from lieint_jax.app.scenarios._kind import Kind, step_of
from lieint_jax.app.scenarios._spread import INERTIA
from lieint_jax.groups import so3
from lieint_jax.types import State, Step


class InitialState(GivenRate):
    """The nominal state: an attitude, given by one of two keys, and an angular velocity in the body."""

    quaternion: Quaternion | None = None
    """Attitude (w, x, y, z), body to space, of unit length."""
    euler_313_deg: Triple | None = None
    """Attitude R_z(α) R_x(β) R_z(γ), body to space, in degrees."""

    @model_validator(mode="after")
    def _check_attitude(self) -> Self:
        if (self.quaternion is None) == (self.euler_313_deg is None):
            raise ValueError("give the attitude by exactly one of quaternion and euler_313_deg")
        return self

    def attitude(self) -> Any:
        if self.euler_313_deg is not None:
            return so3.from_euler_313(jnp.deg2rad(jnp.asarray(self.euler_313_deg)))
        return jnp.asarray(self.quaternion)


class BodyKind(Kind):
    """The keys of every scenario of a rigid body."""

    inertia: Annotated[list[Any], INERTIA, checked(_checks.inertia)]
    """Principal moments (3) or a tensor in body axes (3 × 3)."""
    state: InitialState
    spread: RotationSpread = RotationSpread()

    files: ClassVar[Mapping[str, type[Table]]] = {"shape": ShapeFile}
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
    order: Literal[2, 4, 6, 8] = 2
    """The order of accuracy; above 2 by composition."""

    @model_validator(mode="after")
    def _check_kappa(self) -> Self:
        if self.kappa is not None and self.scheme == "splitting":
            raise ValueError("kappa is a key of top_energy_momentum; splitting uses the symplectic one")
        return self

    def make_step(self) -> Step:
        return self.step_by(self.scheme, self.make_system())

    def step_by(self, scheme: str, top: Any) -> Step:
        """The step of a scheme for tops, at the order of the scenario."""
        kappa = getattr(maps, f"kappa_{self.kappa or 'cayley'}")
        return step_of(top, scheme, self.order, *[kappa] * (scheme == "top_energy_momentum"))


def axis_in_space(q: Any, axis: Any) -> np.ndarray:
    """The directions in space of a body axis, (n, 3), at attitudes (n, 4)."""
    return np.asarray(jax.vmap(so3.Ad, in_axes=(0, None))(jnp.asarray(q), jnp.asarray(axis)))


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


def is_long_axis_mode(moments: np.ndarray, Pi: np.ndarray) -> bool:
    """Whether a free body tumbles about its axis of least inertia, |Π|² < 2H J₂, or about that of greatest (Poinsot).

    Its principal moments (3,) are ascending, and Π (3,) is in the principal axes.
    """
    return bool((Pi**2).sum() < (Pi**2 / moments).sum() * moments[1])


def spin_axis(inertia: np.ndarray, Pi: np.ndarray) -> np.ndarray:
    """The principal axis (3,) about which a body of an inertia, (3,) or (3, 3), tumbles with the body momentum Π."""
    moments, axes = np.linalg.eigh(np.diag(inertia) if np.ndim(inertia) == 1 else inertia)
    axis = axes[:, 0 if is_long_axis_mode(moments, Pi @ axes) else 2]
    return axis if axis @ Pi >= 0 else -axis
