"""Stored energies W(C) of homogeneous elastic bodies, C = FᵀF, and their stresses S = 2∇W(C).

Each has two stresses, as symmetric tensors by their six entries (see `_numerics.vectors`):

    stress(C)          S(C) = 2∇W(C), the second Piola–Kirchhoff stress
    mean_stress(C, D)  a symmetric S̄ with ½ S̄:D = W(C + D) − W(C), S̄(C, 0) = S(C), free of cancellation for small D

The second is a discrete gradient: with it in place of S, energy is conserved and no equation for γ (6.13) is solved.
"""

from __future__ import annotations

import abc
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax._checks import named, positive
from lieint_jax._numerics import power_series, vectors
from lieint_jax._numerics.arrays import Matrix3, Scalar
from lieint_jax._numerics.gradients import autodiff_gradient
from lieint_jax._numerics.vectors import Symmetric
from lieint_jax.core import Converted, StoredEnergy, argument, callable_pytree, pytree, static

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class _VolumeAndTrace(StoredEnergy):
    """W = (μ/2)(I₁ − 3) + w(I₃), so S = μ1 + 2w′(I₃) cof C and, by its invariants one by one,

    S̄ = μ1 + 2 Δw/ΔI₃ · cof̄,   cof̄ = cof(C + ½D) + cof(D)/12,   ΔI₃ = cof̄:D.
    """

    mu: Array

    @abc.abstractmethod
    def volume_energy(self, I3: Scalar) -> Scalar:
        """w(I₃)."""

    @abc.abstractmethod
    def slope(self, I3: Scalar, change: Scalar) -> Scalar:
        """(w(I₃ + ΔI₃) − w(I₃))/ΔI₃, and w′(I₃) for ΔI₃ = 0."""

    def __call__(self, C: Matrix3) -> Scalar:
        S = vectors.symmetric(C)
        return self.mu / 2 * (S.trace - 3) + self.volume_energy(S.det(S.adjugate))

    def stress(self, C: Symmetric) -> Symmetric:
        cofactor = C.adjugate
        I3 = C.det(cofactor)
        return plus(self.mu, 2 * self.slope(I3, jnp.zeros_like(I3)) * cofactor)

    def mean_stress(self, C: Symmetric, D: Symmetric) -> Symmetric:
        cofactor = vectors.mean_cofactor(C, D)
        slope = self.slope(C.det(C.adjugate), cofactor.inner(D))
        return plus(self.mu, 2 * slope * cofactor)


@pytree
class MooneyRivlin(_VolumeAndTrace):
    """W = (λ/2)(I₃ − 1 − ln I₃) + (μ/2)(I₁ − 3 − ln I₃), I₁ = tr C, I₃ = det C: that of the paper's Figures 3–5.

    Args:
        lam: λ > 0, resistance to a change of volume; an energy.
        mu: μ > 0, resistance to shear; an energy.

    Raises:
        ValueError: not positive or not finite.
    """

    lam: Converted[Array] = argument(converter=named(positive, "lam"))
    mu: Converted[Array] = argument(converter=named(positive, "mu"))

    def volume_energy(self, I3: Scalar) -> Scalar:
        change = I3 - 1  # I₃ − 1 − ln I₃ is of second order in it, and λ may be large
        ratio = power_series.log1p_ratio(change)
        return change * (self.lam / 2 * (1 - ratio) - self.mu / 2 * ratio)

    def slope(self, I3: Scalar, change: Scalar) -> Scalar:
        return self.lam / 2 - (self.lam + self.mu) / 2 * power_series.log1p_ratio(change / I3) / I3


@pytree
class NeoHookean(_VolumeAndTrace):
    """W = (μ/2)(I₁ − 3 − ln I₃) + (λ/8)(ln I₃)², the common compressible neo-Hookean material; λ, μ > 0, energies."""

    lam: Converted[Array] = argument(converter=named(positive, "lam"))
    mu: Converted[Array] = argument(converter=named(positive, "mu"))

    def volume_energy(self, I3: Scalar) -> Scalar:
        log = jnp.log(I3)
        return (self.lam / 8 * log - self.mu / 2) * log

    def slope(self, I3: Scalar, change: Scalar) -> Scalar:
        logs = jnp.log(I3) + jnp.log(I3 + change)
        return (self.lam / 8 * logs - self.mu / 2) * power_series.log1p_ratio(change / I3) / I3


@pytree
class SaintVenantKirchhoff(StoredEnergy):
    """W = (λ/8)(tr C − 3)² + (μ/4)|C − 1|²; λ, μ > 0, energies. It is quadratic in C: S̄ is the stress at the middle.

    It stays finite where the volume vanishes, so strong compression can invert a body; steps check det F.
    """

    lam: Converted[Array] = argument(converter=named(positive, "lam"))
    mu: Converted[Array] = argument(converter=named(positive, "mu"))

    def __call__(self, C: Matrix3) -> Scalar:
        G = plus(-1, vectors.symmetric(C))
        return self.lam / 8 * G.trace**2 + self.mu / 4 * G.inner(G)

    def stress(self, C: Symmetric) -> Symmetric:
        G = plus(-1, C)
        return plus(self.lam / 2 * G.trace, self.mu * G)

    def mean_stress(self, C: Symmetric, D: Symmetric) -> Symmetric:
        return self.stress(C + D / 2)


@pytree
class General(StoredEnergy):
    """Any W, its stress by autodiff. S̄ = 2∫₀¹∇W(C + sD) ds by 8 Gauss nodes."""

    function: Callable[[Array], Array]
    name: str = static(default="user")

    def __call__(self, C: Matrix3) -> Scalar:
        return self.function((C + C.T) / 2)

    def stress(self, C: Symmetric) -> Symmetric:
        return vectors.symmetric(self._stress(C.rows.array))

    def mean_stress(self, C: Symmetric, D: Symmetric) -> Symmetric:
        start, change = C.rows.array, D.rows.array
        nodes = jnp.asarray((_NODES + 1) / 2, start.dtype)
        stresses = jax.vmap(lambda s: self._stress(start + s * change))(nodes)
        return vectors.symmetric(jnp.tensordot(jnp.asarray(_WEIGHTS / 2, start.dtype), stresses, 1))

    def _stress(self, C: Matrix3) -> Matrix3:
        return 2 * autodiff_gradient(self)(C)


def plus(pressure: Array | float, S: Symmetric) -> Symmetric:
    """pressure·1 + S."""
    return Symmetric((*(pressure + s for s in S[:3]), *S[3:]))


mooney_rivlin, neo_hookean, saint_venant_kirchhoff = MooneyRivlin, NeoHookean, SaintVenantKirchhoff


def as_stored_energy(energy: StoredEnergy | Callable[[Array], Array]) -> StoredEnergy:
    """A material of this module, or any callable W(C) of a matrix (3, 3) with a scalar value, smooth for C > 0.

    A function with parameters is a `jax.tree_util.Partial`.
    """
    if isinstance(energy, StoredEnergy):

        def strain() -> Array:
            return jnp.array([[1.3, 0.2, -0.1], [0.2, 0.9, 0.15], [-0.1, 0.15, 1.1]])

        _checks.closed_form(
            energy,
            "stress",
            lambda: jnp.stack(energy.stress(vectors.symmetric(strain()))),
            lambda: jnp.stack(vectors.symmetric(2 * jax.grad(energy)(strain()))),
        )
        return energy
    if not callable(energy):
        raise ValueError(
            "stored_energy must be a material such as systems.mooney_rivlin(lam, mu), or a callable W(C) of C = FᵀF, "
            f"shape (3, 3); got {energy!r}"
        )
    name = _checks.name_of(energy)
    made = General(callable_pytree(energy), name)
    _checks.function(f"stored_energy {name}", made, "C = FᵀF (3, 3)", (), jnp.zeros((3, 3)))
    return made
