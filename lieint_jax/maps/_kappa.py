"""Scalings κ(x), x = |Θ̄|², of the Cayley map of SO(3) (Sections 2.2, 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
from jax import Array

from lieint_jax._checks import at_once, concrete, name_of
from lieint_jax._numerics import power_series
from lieint_jax._numerics.arrays import Scalar
from lieint_jax.core import callable_pytree, pytree, static


@pytree
class Kappa:
    """A scaling κ(x), x = |Θ̄|², smooth at 0 with κ(0) = 1: any κ conserves momentum and energy (Result 3).

    Attributes:
        function: x ↦ κ(x), a callable pytree. Its array leaves, if any, can be differentiated and batched.
        name: for reports.
        limit: the largest |Θ̄| at which κ is real and finite.
        solve_by: "vector", Newton for the three components of Θ̄; or "scalar", Newton for one unknown, possible for the
            symplectic κ (see `schemes.so3_midpoint`).
        symplectic: whether it satisfies (3.15).
        constant: whether κ = 1 everywhere; then its derivative is not computed.
    """

    function: Callable[[Array], Array]
    name: str = static(default="user")
    limit: float = static(default=math.inf)
    solve_by: Literal["vector", "scalar"] = static(default="vector")
    symplectic: bool = static(default=False)
    constant: bool = static(default=False)

    def __call__(self, x: Scalar) -> Scalar:
        return self.function(x)

    @property
    def branch(self) -> str:
        """The end of the branch of solutions that starts at Δt = 0, for messages."""
        return "ends at |Δt Ω| ≈ 1" if self.limit == 1 else "folds at |Δt Ω| of 2 to 4"


def as_kappa(kappa: Kappa | Callable[[Array], Array]) -> Kappa:
    """Any callable x ↦ κ(x) as a `Kappa`; a callable with parameters must be a `jax.tree_util.Partial`."""
    if isinstance(kappa, Kappa):
        return kappa
    if not callable(kappa):
        raise ValueError(f"kappa must be a callable of x = |Θ̄|², such as maps.kappa_symplectic, got {kappa!r}")
    name = name_of(kappa)
    made = Kappa(callable_pytree(kappa), name=name)
    with at_once():  # concrete inside jit too, unless κ closes over a tracer
        at_zero = made(jnp.zeros(())) if concrete(made) else 1.0
        wrong = bool(abs(at_zero - 1) > 1e-6) if concrete(at_zero) and not jnp.shape(at_zero) else False
    if jnp.shape(at_zero) or wrong:
        raise ValueError(f"κ(0) must be the number 1 for the scheme to be consistent, got κ(0) = {at_zero} of {name}")
    return made


def _cayley(x: Scalar) -> Scalar:
    return jnp.ones_like(x)


def _symplectic(x: Scalar) -> Scalar:
    return 2 / (1 + jnp.sqrt(1 - x))


def _lambert(levels: int) -> tuple[list[float], list[float]]:
    """Coefficients in u² of tan(u)/u as a quotient of polynomials: 1/(1 − u²/(3 − u²/(5 − …))), `levels` deep."""
    numerator, denominator = [1], [2 * levels + 1]
    for odd in range(2 * levels - 1, 0, -2):
        longer = [odd * c for c in denominator] + [0] * (len(numerator) + 1 - len(denominator))
        for k, c in enumerate(numerator):
            longer[k + 1] -= c
        numerator, denominator = denominator, longer
    unit = denominator[0]
    return [c / unit for c in numerator], [c / unit for c in denominator]


_TAN = _lambert(11)


def _exponential(x: Scalar) -> Scalar:
    """tan(u)/u, u² = x/4: a rational function, exact to round-off up to the pole at x = π² and smooth at 0."""
    numerator, denominator = (power_series.horner(c, x / 4) for c in _TAN)
    return numerator / denominator


kappa_cayley = Kappa(callable_pytree(_cayley), name="cayley", constant=True)
kappa_exponential = Kappa(callable_pytree(_exponential), name="exponential", limit=math.pi)
kappa_symplectic = Kappa(callable_pytree(_symplectic), name="symplectic", limit=1.0, solve_by="scalar", symplectic=True)
KAPPAS = (kappa_cayley, kappa_exponential, kappa_symplectic)
