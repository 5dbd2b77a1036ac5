"""The gyrostat: a rigid body with a rotor inside, such as a satellite with a momentum wheel."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import named
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Scalar, Vector3
from lieint_jax.core import Converted, State, argument, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractGyrostat
from lieint_jax.systems._rigid_body import WithFreeBody
from lieint_jax.systems._shared.body import Rotating, as_inertia

__all__ = ["Gyrostat", "gyrostat"]


@pytree
class Gyrostat(WithFreeBody, Rotating, AbstractGyrostat):
    """A rigid body with a symmetric rotor, or several, whose momentum in the body is constant.

    H = ½(Π − h_r)·J⁻¹(Π − h_r) with Π = Λᵀπ = JΩ + h_r; Λ̇ = ΛΩ̂, π̇ = 0.

    Two kinds of rotor obey these equations. Let a be the unit vector of the axis, I the rotor's moment about it, and J₀
    the inertia of the whole with the rotor locked.

    | rotor | inertia | rotor momentum |
    |---|---|---|
    | held at the speed s relative to the body | J₀ | I s a |
    | spinning freely on its bearings | J₀ − I a⊗a | I(s + a·Ω) a, constant |

    A spin at Ω about the principal axis 3 with h_r along it is stable if (λ − J₁Ω)(λ − J₂Ω) > 0, where λ = J₃Ω + h_r.
    If the body dissipates energy, it is stable only if Ω/λ < 1/J₁ and Ω/λ < 1/J₂, that is, if λ/Ω is above both J₁ and
    J₂ or negative. So a rotor can stabilize a spin about any axis.

    Args:
        inertia: principal moments, shape (3,), or a symmetric tensor in body axes, shape (3, 3).
        rotor: h_r, momentum in body axes, shape (3,), in the unit of inertia times angular velocity.

    Raises:
        ValueError: a bad inertia, as in `rigid_body`; a rotor of another shape, NaN or inf.

    Example:
        >>> satellite = gyrostat([1.0, 2.0, 3.0], rotor=[0.5, 0.0, 0.0])
        >>> state = satellite.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
        >>> float(satellite.energy(state))
        1.52

    Source: Kelvin & Tait 1879, Treatise on Natural Philosophy; the dual-spin satellite: Likins 1967, J. Spacecraft 4.
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    rotor: Converted[Array] = argument(converter=named(_checks.real_array, "rotor", (3,)), like="inertia")

    @property
    def own_momentum(self) -> Vector3:
        return self.rotor

    def energy(self, state: State) -> Scalar:
        """½(Π − h_r)·J⁻¹(Π − h_r)."""
        return vectors.dot(self.body_momentum(state) - self.rotor, self.angular_velocity(state)) / 2


gyrostat = Gyrostat
PROPERTIES = SystemProperties(
    name="gyrostat",
    models="a rigid body with a rotor of constant momentum",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy", "momentum", "Casimirs"),
    momentum="π in space, with the rotor",
    sizes=(3,),
    aliases=("dual-spin satellite", "Zhukovsky–Volterra gyrostat"),
    source="Kelvin & Tait 1879; Likins 1967",
)


def examples() -> dict[str, tuple[Gyrostat, State, float]]:
    """A satellite with a momentum wheel, and an oblique rotor in a body whose axes are not principal axes."""
    turn = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
    satellite = gyrostat([1.0, 2.0, 3.0], [0.0, 0.8, 0.0])
    turned = gyrostat(turn @ jnp.diag(jnp.array([1.0, 2.0, 2.5])) @ turn.T, [0.6, -0.3, 0.5])
    return {
        "satellite": (satellite, satellite.state(angular_velocity=[0.2, 0.5, -0.3]), 0.05),
        "full_tensor": (turned, turned.state(angular_velocity=[0.3, -0.4, 0.8]), 0.05),
    }
