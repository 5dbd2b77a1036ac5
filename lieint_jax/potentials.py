"""Potentials of several rigid bodies, (positions (N, 3), rotations body to space (N, 3, 3)) ↦ V."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.types import pytree


@pytree
class MacCullagh:
    """Gravity of bodies to second order of size over distance. Made by `maccullagh`.

    Attributes:
        G: the constant of gravity.
        masses: (N,).
        inertias: (N, 3) or (N, 3, 3).
    """

    G: Array
    masses: Array
    inertias: Array

    def __call__(self, x: Array, R: Array) -> Array:
        """V."""
        i, j = np.triu_indices(len(self.masses), 1)
        m, J = self.masses, self.inertias
        trace = jnp.sum(J, axis=1) if J.ndim == 2 else jnp.trace(J, axis1=1, axis2=2)
        d = x[j] - x[i]
        r2 = jnp.sum(d * d, axis=1)
        r = jnp.sqrt(r2)
        along = m[j] * _form(J[i], R[i], d) + m[i] * _form(J[j], R[j], d)
        second = 1.5 * along / r2 - 0.5 * (m[j] * trace[i] + m[i] * trace[j])
        return self.G * jnp.sum((second / r2 - m[i] * m[j]) / r)


def maccullagh(G: ArrayLike, masses: ArrayLike, inertias: ArrayLike) -> MacCullagh:
    """Gravity of N bodies to second order of their size over their distance (MacCullagh 1844).

    V = Σ_{i<j} −G m_i m_j/r − G (m_j tr J_i + m_i tr J_j)/2r³ + (3G/2r⁵) (m_j Γ_i·J_iΓ_i + m_i Γ_j·J_jΓ_j), where
    Γ_i = Λ_iᵀ(x_j − x_i) is the line between the two in the axes of body i. Terms of both bodies' shapes together, of
    order 4, are left out. Invariant: P and L are conserved.

    Args:
        G: the constant of gravity, in the units of all else.
        masses: (N,).
        inertias: about the centres of mass, (N, 3) or (N, 3, 3).
    """
    m, J = _checks.real_array("masses", masses), _checks.real_array("inertias", inertias)
    if m.ndim != 1 or J.shape not in ((m.size, 3), (m.size, 3, 3)):
        raise ValueError(f"masses (N,) and inertias (N, 3) or (N, 3, 3) are needed, got {m.shape} and {J.shape}")
    return MacCullagh(_checks.real_array("G", G, ()), m, J)


def _form(J: Array, R: Array, d: Array) -> Array:
    """Γ·JΓ with Γ = Rᵀd, for each of k pairs, (k,)."""
    Gamma = jnp.sum(R * d[:, :, None], axis=1)
    if J.ndim == 2:
        return jnp.sum(J * Gamma * Gamma, axis=1)
    return jnp.sum(Gamma * jnp.sum(J * Gamma[:, None, :], axis=2), axis=1)
