"""Maps τ from the algebra to the group, and the scalings κ that tell them apart on SO(3) (Sections 2.1.2, 2.2, 3.2).

On SO(3) every map of the paper is a scaled Cayley map, cay[κ(|Θ̄|²) Θ̄]:

    κ = 1                        Cayley: Austin, Krishnaprasad & Wan 1993
    κ = tan(½√x)/(½√x)           exponential (2.29): Simo & Wong 1991
    κ = 2/(1 + √(1 − x))         symplectic (3.16): Lewis & Simo 1994; also the Moser–Veselov (RATTLE) step

A τ here is called `tau(group, theta)`, so that one map serves every group.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax import small
from lieint_jax.types import Group, callable_pytree, concrete, pytree, static

Map = Callable[[Group, Array], Array]


def exponential(group: Group, theta: Array) -> Array:
    """exp Θ."""
    return group.exp(theta)


def cayley(group: Group, theta: Array) -> Array:
    """cay Θ = (1 − Θ/2)⁻¹(1 + Θ/2) (2.5)."""
    return group.cayley(theta)


def scaled_cayley(kappa: Callable[[Array], Array]) -> Map:
    """The map Θ̄ ↦ cay[κ(|Θ̄|²) Θ̄] of SO(3) (3.17)."""

    def tau(group: Group, theta: Array) -> Array:
        return group.cayley(kappa(small.dot(theta, theta)) * theta)

    return tau


def derivative(tau: Map, group: Group, theta: Array) -> Array:
    """H(Θ) of Dτ(Θ)·δΘ = τ(Θ)(HδΘ)^ (5.28), shape (d, d), by autodiff."""
    value, tangents = tau(group, theta), jax.jacfwd(lambda x: tau(group, x))(theta)
    return jax.vmap(lambda t: group.body_velocity(value, t), in_axes=-1, out_axes=-1)(tangents)


@pytree
class Kappa:
    """A scaling κ(x), x = |Θ̄|², smooth at 0 with κ(0) = 1: momentum and energy are exact for any (Result 3).

    Attributes:
        function: x ↦ κ(x), a callable pytree. Its array leaves, if any, can be differentiated and batched.
        name: for reports.
        limit: the largest |Θ̄| where κ is real and finite.
        solve_by: "vector", Newton for the three components of Θ̄; or "scalar", Newton for the one unknown that is
            left when κ is the symplectic one (see `schemes.so3_midpoint`).
        symplectic: whether it satisfies (3.15).
    """

    function: Callable[[Array], Array]
    name: str = static(default="user")
    limit: float = static(default=math.inf)
    solve_by: Literal["vector", "scalar"] = static(default="vector")
    symplectic: bool = static(default=False)

    def __call__(self, x: Array) -> Array:
        return self.function(x)


def as_kappa(kappa: Kappa | Callable[[Array], Array]) -> Kappa:
    """Any callable x ↦ κ(x) as a `Kappa`. Parameters of its own travel in a `jax.tree_util.Partial`."""
    if isinstance(kappa, Kappa):
        return kappa
    if not callable(kappa):
        raise ValueError(f"kappa must be a callable of x = |Θ̄|², such as maps.kappa_symplectic, got {kappa!r}")
    name = getattr(kappa, "__name__", type(kappa).__name__)
    made = Kappa(callable_pytree(kappa), name=name)
    with jax.ensure_compile_time_eval():
        at_zero = made(jnp.zeros(())) if concrete(made) else 1.0
    if jnp.shape(at_zero) or (concrete(at_zero) and abs(at_zero - 1) > 1e-6):
        raise ValueError(f"κ(0) must be the number 1 for the scheme to be consistent, got κ(0) = {at_zero} of {name}")
    return made


def _symplectic(x: Array) -> Array:
    return 2 / (1 + jnp.sqrt(1 - x))


def _lambert(levels: int) -> tuple[list[float], list[float]]:
    """Coefficients in u² of tan(u)/u as a quotient of polynomials: 1/(1 − u²/(3 − u²/(5 − …))), so many levels deep."""
    numerator, denominator = [1], [2 * levels + 1]
    for odd in range(2 * levels - 1, 0, -2):
        longer = [odd * c for c in denominator] + [0] * (len(numerator) + 1 - len(denominator))
        for k, c in enumerate(numerator):
            longer[k + 1] -= c
        numerator, denominator = denominator, longer
    unit = denominator[0]
    return [c / unit for c in numerator], [c / unit for c in denominator]


_TAN = _lambert(11)


def _exponential(x: Array) -> Array:
    """tan(u)/u, u² = x/4: a rational function, exact to round-off up to the pole at x = π² and smooth at 0."""
    numerator, denominator = (small.horner(c, x / 4) for c in _TAN)
    return numerator / denominator


kappa_cayley = Kappa(callable_pytree(jnp.ones_like), name="cayley")
kappa_exponential = Kappa(callable_pytree(_exponential), name="exponential", limit=math.pi)
kappa_symplectic = Kappa(callable_pytree(_symplectic), name="symplectic", limit=1.0, solve_by="scalar", symplectic=True)


def examples() -> dict[str, Map]:
    """Maps of SO(3)."""
    kappas = (kappa_cayley, kappa_exponential, kappa_symplectic)
    return {"exponential": exponential, "cayley": cayley} | {
        f"scaled_cayley[{k.name}]": scaled_cayley(k) for k in kappas
    }
