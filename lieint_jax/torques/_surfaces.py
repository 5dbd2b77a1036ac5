"""Forces on the surface of a body: the pressure of sunlight on plates, the drag of a thin atmosphere."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._deprecated import old_calls
from lieint_jax._numerics.vec3 import add, cross, dot, scale
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import VectorOfTime, not_negative, unit_vector, value_at, vector_of_time
from lieint_jax.types import Law, Rotation, pytree


@pytree
class SolarPlate(Law):
    """The torque of sunlight on a flat plate, in the body. Made by `solar_plate`."""

    force: Array
    normal: Array
    arm: Array
    sun: VectorOfTime
    specular: Array
    diffuse: Array

    def mean(self, rotation: Rotation, inner: Any) -> tuple[Array, Any]:
        """r × F(Λᵀs)."""
        s = so3.Ad_star(rotation.q_mid, value_at(self.sun, rotation.t))
        cosine = dot(self.normal, s)
        lit = self.force * jnp.abs(cosine)  # either side may face the Sun
        outward = 2 * (self.specular * cosine + jnp.sign(cosine) * self.diffuse / 3)
        push = add(scale(-lit * (1 - self.specular), s), scale(-lit * outward, self.normal))
        return jnp.stack(cross(self.arm, push)), inner


@old_calls()
def solar_plate(
    force: ArrayLike,
    normal: ArrayLike,
    arm: ArrayLike,
    sun: Any,
    *,
    specular: ArrayLike = 0.0,
    diffuse: ArrayLike = 0.0,
) -> SolarPlate:
    """The pressure of sunlight on a flat plate, both sides of which reflect alike: T = r × F with

        F = −f|cos ϑ| [(1 − ρ_s)s + 2(ρ_s cos ϑ ± ρ_d/3)n],    cos ϑ = n·s,

    ± the sign of cos ϑ, as of a sail or a panel without a shadow. Energy changes by ΔtΩ̄·T̄ in a step.

    Args:
        force: f, pressure × area, such as 4.56e-6 N/m² × A at 1 au.
        normal: n in the body, (3,), a unit vector.
        arm: r, from the body's center of mass to the plate's center of pressure, in the body, (3,).
        sun: s in space, (3,), the unit vector to the Sun, or a function of time with such values.
        specular, diffuse: ρ_s and ρ_d ≥ 0, the parts of the light that are reflected so, ρ_s + ρ_d ≤ 1.

    Raises:
        ValueError: a vector of another shape, a normal or a Sun that is not of unit length, parts out of range.

    Source: McInnes 1999, Solar Sailing, chapter 2 (the optical model of a plate, without thermal emission).
    """
    parts = [not_negative(name, x) for name, x in (("specular", specular), ("diffuse", diffuse))]
    if concrete(*parts) and float(parts[0]) + float(parts[1]) > 1:
        raise ValueError(f"specular + diffuse must be at most 1, got {parts[0]} + {parts[1]}")
    return SolarPlate(
        not_negative("force", force),
        unit_vector("normal", normal),
        _checks.real_array("arm", arm, (3,)),
        vector_of_time("sun", sun) if callable(sun) else unit_vector("sun", sun),
        *parts,
    )
