"""The free rigid body with its attitude in L(3), where the α-family of Section 2.2 moves (Step 1)."""

from __future__ import annotations

from jax import Array

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax.core import Converted, State, argument, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractEmbeddedBody
from lieint_jax.systems._shared.body import Body, as_inertia

__all__ = ["EmbeddedBody", "embedded_body"]


@pytree
class EmbeddedBody(Body, AbstractEmbeddedBody):
    """A free rigid body whose attitude is a matrix Λ, which a scheme may move out of SO(3).

    H = ½ Π·J⁻¹Π with Π = Λ⁻¹π; Λ̇ = ΛΩ̂, π̇ = 0, Λ any matrix of L(3) with det Λ > 0. From a rotation the flow is that of
    `rigid_body`.

    Args:
        inertia: J, principal moments, shape (3,), or a symmetric tensor in body axes, shape (3, 3), as in `rigid_body`.

    Raises:
        ValueError: as in `rigid_body`.

    Source: Lewis & Simo 1994, Section 2.2.

    Example:
        >>> body = embedded_body([1.0, 2.0, 3.0])
        >>> state = body.state([1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
        >>> state.q.shape, float(body.energy(state))
        ((3, 3), 1.52)
    """

    inertia: Converted[Array] = argument(converter=as_inertia)

    configuration = staticmethod(so3.to_matrix)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""
        q = _checks.real_array("state.q", state.q, (3, 3))
        _checks.real_array("state.p", state.p, (3,))
        if _checks.concrete(q) and not (det := float(vectors.matrix(q).det())) > 0:
            raise ValueError(f"state.q must have a positive determinant, got {det:.3g}")


embedded_body = EmbeddedBody
PROPERTIES = SystemProperties(
    name="embedded_body",
    models="a free rigid body with its attitude in L(3)",
    phase_space="L(3) × ℝ³: matrix, π",
    conserves=("energy", "momentum"),
    momentum="π in space",
    sizes=(3,),
    aliases=("rigid body with embedded rotations",),
    source="Lewis & Simo 1994, Section 2.2",
)


def examples() -> dict[str, tuple[EmbeddedBody, State, float]]:
    """The body of the paper's Figure 1."""
    body = embedded_body([1.0, 2.0, 3.0])
    return {"embedded": (body, body.state(angular_velocity=[0.2, 0.0, 1.0]), 0.05)}
