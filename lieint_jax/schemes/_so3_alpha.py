"""The α-family of momentum-conserving schemes in L(3), of which α = ½ alone stays on SO(3) (Section 2.2).

With Λ_{n+α} = αΛ_{n+1} + (1−α)Λ_n and Π_{n+α} likewise, one step is

    Λ_{n+1} − Λ_n = Λ_{n+α} Θ̂,    Π_{n+1} − Π_n = Π_{n+(1−α)} × Θ                              (2.17)
    Θ = κ(|Θ̄|²) Θ̄,    Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1})                                            (2.28)

or Λ_{n+1} = Λ_n T_α and T_α Π_{n+1} = Π_n (2.19), so that π = ΛΠ is constant, with (2.21) corrected

    T_α(Θ) = 1 + (Θ̂ + αΘ̂²)/(1 + α²|Θ|²),    T_α T_αᵀ = 1 + νΘ̂²,    ν = (2α − 1)/(1 + α²|Θ|²).

Put a = ½Δt Π_n and Θ̄ = 2y. Then ½Δt Π_{n+1} = 2Jy − a, and the second line of (2.17) is an equation for y,

    J y + κ y × w = a,    w = 2(1−α) J y + (2α − 1) a,    κ = κ(4|y|²),

the vector form of `so3_midpoint` if α = ½.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import concrete, count, fraction, named
from lieint_jax._numerics import newton
from lieint_jax._numerics.vectors import (
    Matrix,
    Symmetric,
    Vector,
    cross,
    dot,
    hat,
    matrix,
    max_abs,
    norm,
    outer,
    symmetric,
    unit_trace,
)
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.maps import Kappa, as_kappa, kappa_cayley
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.half_rotation import (
    ITERATIONS,
    SLENDER,
    attitude_error_limit,
    gyroscopic,
    on_branch,
)
from lieint_jax.systems._equations import AbstractEmbeddedBody

__all__ = ["so3_alpha"]

PROPERTIES = SchemeProperties(
    name="so3_alpha",
    systems="free bodies whose attitude is a matrix",
    conserves=("momentum", "energy"),
    limit="|ΔtΩ| of 2 to 4",
    aliases=("α-family in L(3)",),
    source="Lewis & Simo 1994, (2.14) to (2.23), Results 1 and 2",
    accepts=(AbstractEmbeddedBody,),
    instead="; for a body that stays on SO(3), which α = 1/2 does, use so3_midpoint",
)


@pytree
class SO3Alpha(Step):
    """The α-family (2.17) with (2.28) for a free rigid body whose attitude may leave SO(3).

    | | α = ½ | another α |
    |---|---|---|
    | spatial momentum ΛΠ (Result 1) | exact, bit for bit | exact, bit for bit |
    | energy ½ Π·J⁻¹Π (2.27) | exact | exact |
    | Λ on SO(3) (Result 2) | exact | no: TTᵀ − 1 is of size \\|2α−1\\||Θ|² per step |
    | length of Π, a Casimir | exact | no: it changes at the same rate, since Π = Λ⁻¹π |
    | symplectic form | as in `so3_midpoint` | T*SO(3) is left |
    | order | 2 | 1 |

    "Exact" is to round-off at a converged step. The step of α = ½ is that of `so3_midpoint` with the same κ, its
    attitude written as a matrix. The inverse of a step of α is the step of 1 − α with −Δt, so only α = ½ is symmetric.

    The paper does not note that (2.26) and (2.27) hold for every α: all schemes of the family conserve energy. With
    α ≠ ½ Λ stretches from step to step, and for Δt > 0 the body ends up rotating about the axis where Π is shortest
    (α < ½) or longest (α > ½) for its energy, as if it had friction: use these schemes for study, not for simulations.
    T_α rotates about Θ by arctan(α|Θ|) + arctan((1−α)|Θ|), so its polar factor is a step of `so3_midpoint` with another
    κ.

    Args:
        system: `systems.embedded_body(...)`.
        alpha: α in [0, 1], a leaf of the step with respect to which it can be differentiated.
        kappa: κ as in `so3_midpoint`; by default 1, the Cayley map.
        iterations: Newton corrections per step.

    Raises:
        ValueError: not an embedded body, α out of range, κ not callable, a bad count.

    Source: Lewis & Simo 1994, (2.14)–(2.22), Results 1 and 2; T_α and ν corrected.
    """

    system: AbstractEmbeddedBody = argument(converter=PROPERTIES.check)
    alpha: Converted[Array] = argument(converter=named(fraction, "alpha"), default=0.5)
    kappa: Converted[Kappa] = argument(converter=as_kappa, default=kappa_cayley)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=ITERATIONS["vector"])
    order: float = static(init=False)
    symmetric: bool = static(init=False)

    def check_fields(self) -> dict[str, float]:
        middle = not concrete(self.alpha) or float(self.alpha) == 0.5
        return {"order": 2 if middle else 1, "symmetric": middle}

    @property
    def name(self) -> str:
        return f"so3_alpha[{self.kappa.name}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        J, r = unit_trace(self.system.inertia)
        a = 0.5 * r * dt * matrix(state.q).solve(state.p)
        y, residual, good = _solve(self.kappa, self.alpha, J, a, self.iterations)
        Theta = 2 * self.kappa(4 * dot(y, y)) * y
        info = StepInfo.of_root(norm(residual), good & J.well_conditioned & _digits_left(state), max_abs(a))
        return state._replace(q=_rotated_attitude(state.q, self.alpha, Theta)), info

    def advice(self, state: State, dt: ArrayLike) -> str:
        if not symmetric(self.system.inertia).well_conditioned:
            return f"{self.name}: {SLENDER}"
        return (
            f"{self.name} does not converge at dt = {dt}: use a smaller dt or more than {self.iterations} iterations. "
            "If Λ is far from SO(3), as after many steps with α ≠ 1/2, no digits of Π = Λ⁻¹π are left"
        )


@PROPERTIES.by_name
def examples(system: AbstractEmbeddedBody) -> list[Step]:
    """The step of α = ½ by the Cayley map, for bodies embedded in L(3)."""
    return [so3_alpha(system)]


def _solve(kappa: Kappa, alpha: Array, J: Symmetric, a: Vector, iterations: int) -> tuple[Vector, Vector, Array]:
    """y = ½Θ̄, the residual of its equation, and whether y is on the branch that starts at Δt = 0."""
    b, c = 2 * (1 - alpha), 2 * alpha - 1  # w = b J y + c a

    def residual(y: Vector) -> Vector:
        return J @ y + kappa(4 * dot(y, y)) * y_cross_w(y) - a

    def y_cross_w(y: Vector) -> Vector:
        return cross(y, b * (J @ y) + c * a)

    def jacobian(y: Vector) -> Matrix:
        """J + κ(b(ŷJ − (Jy)^) − c â) + 8κ′(y × w)⊗y."""
        G = b * gyroscopic(J, y) - c * hat(a)
        if kappa.constant:
            return J.rows + G
        k, slope = jax.jvp(kappa, (4 * dot(y, y),), (jnp.full_like(y[0], 8),))
        return J.rows + k * G + outer(slope * y_cross_w(y), y)

    def correction(y: Vector, f: Vector) -> Vector:
        return jacobian(y).solve(f)

    u = J.solve(a)
    guess = u + J.solve(cross(a, u))  # ½(ΔtΩ + ½Δt²J⁻¹(Π × Ω))
    y, f, steady = newton.root(residual, correction, guess, iterations)
    return y, f, steady & on_branch(kappa, y, jacobian(lax.stop_gradient(y)))


def _rotated_attitude(q: Array, alpha: Array, Theta: Vector) -> Array:
    """Λ T_α(Θ) = Λ + (ΛΘ̂ + αΛΘ̂²)/(1 + α²|Θ|²)."""
    r, L = 1 / (1 + alpha * alpha * dot(Theta, Theta)), matrix(q)
    first = L.times_hat(Theta)
    return (L + r * (first + alpha * first.times_hat(Theta))).array


def _digits_left(state: State) -> Array:
    """Whether Π = Λ⁻¹π is accurate enough: rounding of Λ changes it by eps |Λ⁻¹||Λ|, relative."""
    q = lax.stop_gradient(state.q)
    eps = jnp.finfo(q.dtype).eps
    A = matrix(q)
    condition = max_abs(*A.cofactors) * max_abs(*A) / jnp.abs(A.det())
    return eps * condition <= attitude_error_limit(q.dtype)


so3_alpha = SO3Alpha
