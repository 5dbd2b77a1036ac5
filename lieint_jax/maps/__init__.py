"""Maps τ from the algebra to the group, and the scalings κ that define them on SO(3) (Sections 2.1.2, 2.2, 3.2).

On SO(3) every map of the paper is a scaled Cayley map, cay[κ(|Θ̄|²) Θ̄]:

    κ = 1                        Cayley: Austin, Krishnaprasad & Wan 1993
    κ = tan(½√x)/(½√x)           exponential (2.29): Simo & Wong 1991
    κ = 2/(1 + √(1 − x))         symplectic (3.16): Lewis & Simo 1994; also the Moser–Veselov (RATTLE) step

A map τ is called as `tau(group, theta)`, so that one map serves every group.
"""

from lieint_jax.maps._arcsine import arcsine, arcsine_forms
from lieint_jax.maps._kappa import KAPPAS, Kappa, as_kappa, kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.maps._maps import (
    Map,
    cayley,
    cayley_lands,
    defined_on,
    derivative,
    examples,
    exponential,
    scaled_cayley,
)
from lieint_jax.maps._residuals import axis_residual, is_symplectic, symplectic_residual
from lieint_jax.maps._tau import Tau, as_tau

__all__ = [
    "KAPPAS",
    "Kappa",
    "Map",
    "Tau",
    "arcsine",
    "arcsine_forms",
    "as_kappa",
    "as_tau",
    "axis_residual",
    "cayley",
    "cayley_lands",
    "defined_on",
    "derivative",
    "examples",
    "exponential",
    "is_symplectic",
    "kappa_cayley",
    "kappa_exponential",
    "kappa_symplectic",
    "scaled_cayley",
    "symplectic_residual",
]
__dir__ = __all__.copy
