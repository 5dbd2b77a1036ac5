"""The exact flow of the free rigid body as a step, in Jacobi's elliptic functions (see `_free_body`)."""

from __future__ import annotations

import math
from typing import overload

import jax.numpy as jnp
from jax.typing import ArrayLike

from lieint_jax import _free_body
from lieint_jax._numerics.vectors import symmetric
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.free_bodies import FreeFlight
from lieint_jax.schemes._shared.half_rotation import SLENDER, attitude_error_limit
from lieint_jax.systems._equations import AbstractFreeBodies, AbstractFreeBody

__all__ = ["Exact", "FreeFlight", "exact"]


@pytree
class Exact(Step):
    """The step made by `exact`."""

    system: AbstractFreeBody
    order: float = static(default=math.inf)
    symmetric: bool = static(default=True)
    commuting = True
    loops = True

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        J = self.system.inertia
        q, (length, condition) = _free_body.attitude(J, state.q, state.p, dt)
        eps = float(jnp.finfo(q.dtype).eps)
        good = (length <= 1024 * eps) & (eps * condition <= attitude_error_limit(q.dtype))
        return state._replace(q=q), StepInfo(length, good & symmetric(J).well_conditioned)

    def advice(self, state: State, dt: ArrayLike) -> str:
        if not symmetric(self.system.inertia).well_conditioned:
            return f"{self.name}: {SLENDER}"
        return (
            f"{self.name} lost its digits at dt = {dt}: rounding the state alone moves the attitude by more, as |Δt Ω| "
            "is too large, or the body passes the intermediate axis too closely and too often; or there is a NaN or an "
            "infinity in the state or the inertia. Use a smaller dt, or float64"
        )


@overload
def exact(system: AbstractFreeBody) -> Exact: ...
@overload
def exact(system: AbstractFreeBodies) -> FreeFlight: ...
def exact(system: AbstractFreeBody | AbstractFreeBodies) -> Exact | FreeFlight:
    """The exact flow of a free rigid body, or of several: any inertia, any step size of either sign.

    | conserved | to |
    |---|---|
    | energy, polhode | round-off |
    | spatial momentum | bit for bit |
    | the symplectic form | round-off |

    The attitude is right to 2e-14 at |Ω|Δt = 100, or, near the separatrix, to the change that rounding the state
    causes, if this is more. Where that change can exceed 1e-6 (in float32 3e-4), as where the sum of |Π|Δt/Jᵢ is above
    4.5e9 (2900), the step reports `converged=False`. No equation is solved; `residual` is the error of |Π|², relative.
    `order` is infinite.

    Args:
        system: `systems.rigid_body(...)`, or `systems.rigid_bodies(...).free`. For a full tensor each step computes the
            principal axes, which is slower, and energy drifts by up to 2 eps per step. For a full tensor with moments
            equal to within √eps, derivatives with respect to the inertia omit its off-diagonal elements between the
            equal axes.

    Raises:
        ValueError: not a free rigid body.

    Source: this package; another form is that of Celledoni, Fassò, Säfström & Zanna 2008, SIAM J. Sci. Comput. 30.
    """
    PROPERTIES.check(system)
    if isinstance(system, AbstractFreeBodies):
        return FreeFlight.with_step(system, Exact)
    return Exact(system)


PROPERTIES = SchemeProperties(
    name="exact",
    systems="free bodies, several free bodies",
    conserves=("energy", "momentum", "form"),
    order=float("inf"),
    limit="none",
    aliases=("Jacobi's solution of the free rigid body",),
    source="Jacobi 1849; Hairer & Vilmart 2006",
    accepts=(AbstractFreeBody, AbstractFreeBodies),
)


@PROPERTIES.by_name
def examples(system: AbstractFreeBody | AbstractFreeBodies) -> list[Step]:
    """The exact flow, for free rigid bodies."""
    return [exact(system)] if isinstance(system, AbstractFreeBody) else []
