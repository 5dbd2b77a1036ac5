"""A rigid body with internal friction, which loses energy but no angular momentum: the double bracket."""

from __future__ import annotations

from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import concrete, named
from lieint_jax.core import Converted, State, argument, pytree
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractDampedBody
from lieint_jax.systems._shared.body import TimedBody, as_inertia

__all__ = ["DampedBody", "damped_body"]


@pytree
class DampedBody(TimedBody, AbstractDampedBody):
    """A free rigid body with internal friction, such as that of a fluid or of bending: the energy-sink model.

    H = ½ Π·J⁻¹Π; Λ̇ = Λ(Ω + αΠ × Ω)^, π̇ = 0, so that Ḣ = −α|Π × Ω|². The energy decreases to |π|²/2J₃, where the body
    rotates about its axis of largest inertia.

    Args:
        inertia: principal moments (3,) or a symmetric tensor in body axes (3, 3).
        friction: α ≥ 0, an inverse angular momentum: Ω relaxes within about 1/(α|Π||ΔΩ|).

    Raises:
        ValueError: bad inertia, or a friction that is negative or not a number.

    Source: the energy sink, Likins 1966, JPL TR 32-860; the double bracket, Bloch, Krishnaprasad, Marsden & Ratiu 1996,
    Commun. Math. Phys. 175.

    Example:
        >>> body = damped_body([1.0, 2.0, 3.0], 0.1)
        >>> state = body.state(angular_velocity=[1.0, 0.1, 0.1], work=0.0)
    """

    inertia: Converted[Array] = argument(converter=as_inertia)
    friction: Converted[Array] = argument(converter=named(_checks.real_array, "friction", ()), like="inertia")

    def check_fields(self) -> None:
        """Raise ValueError if the friction is negative."""
        if concrete(alpha := self.friction) and float(alpha) < 0:
            raise ValueError(f"friction must not be negative, got {float(alpha):g}: it would give energy to the body")


damped_body = DampedBody
PROPERTIES = SystemProperties(
    name="damped_body",
    models="a rigid body with internal friction",
    phase_space="T*SO(3): unit quaternion, π",
    conserves=("energy less work", "momentum", "Casimirs"),
    momentum="π in space",
    sizes=(3,),
    aliases=("energy sink", "double bracket"),
    source="Likins 1966; Bloch, Krishnaprasad, Marsden & Ratiu 1996",
)


def examples() -> dict[str, tuple[DampedBody, State, float]]:
    """A body that starts about its axis of least inertia and ends about that of the largest, as Explorer 1 did."""
    body = damped_body([1.0, 2.0, 2.5], 0.1)
    return {"explorer": (body, body.state(angular_velocity=[1.0, 0.1, 0.2], work=0.0), 0.05)}
