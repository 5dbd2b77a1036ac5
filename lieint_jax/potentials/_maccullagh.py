"""Gravity of several bodies to second order of their size over their distance, by their moments of inertia."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._checks import named, of_shapes, real_array
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Calls, PoseMomenta, Positions, Rotations, Scalar
from lieint_jax._xla import materialized
from lieint_jax.core import Converted, argument, pytree
from lieint_jax.potentials._potential import Potential

__all__ = ["MacCullagh", "maccullagh"]


@pytree
class MacCullagh(Potential):
    """Gravity of N bodies to second order of their size over their distance (MacCullagh 1844).

    V = Σ_{i<j} −G m_i m_j/r − G (m_j tr J_i + m_i tr J_j)/2r³ + (3G/2r⁵) (m_j Γ_i·J_iΓ_i + m_i Γ_j·J_jΓ_j), where
    Γ_i = Λ_iᵀ(x_j − x_i) is the vector between the two in the axes of body i. Terms that couple the shapes of both
    bodies, of order 4, are omitted. The potential is invariant: P and L are conserved.

    Args:
        G: the constant of gravity, in units consistent with the other arguments.
        masses: (N,), or N shapes of `lieint_jax.shapes`.
        inertias: about the centers of mass, (N, 3) or (N, 3, 3), or N shapes.

    Raises:
        ValueError: the shapes of the arguments disagree.
    """

    G: Converted[Array] = argument(converter=named(real_array, "G", ()))
    masses: Converted[Array] = argument(converter=lambda given: real_array("masses", of_shapes("mass", given)))
    inertias: Converted[Array] = argument(converter=lambda given: real_array("inertias", of_shapes("inertia", given)))

    def check_fields(self) -> None:
        """Raise ValueError if the shapes disagree."""
        m, J = self.masses, self.inertias
        if m.ndim != 1 or J.shape not in ((m.size, 3), (m.size, 3, 3)):
            raise ValueError(f"masses (N,) and inertias (N, 3) or (N, 3, 3) are needed, got {m.shape} and {J.shape}")

    @property
    def count(self) -> int:
        return self.masses.shape[0]

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ, (N, 6), six times as fast as autodiff of V."""
        (i, j), m, trace = self._pairs, self.masses, self._traces
        # an axis of pairs, seen from one end and then from the other
        here, there = np.concatenate([i, j]), np.concatenate([j, i])
        d = (x[j] - x[i]).T
        both = vectors.vector(_twice(d))
        J, turned = self._entries(here), vectors.matrix(jnp.moveaxis(R[here], 0, -1))
        Gamma = turned.T @ both
        JGamma = J @ Gamma
        own, arms = vectors.dot(Gamma, JGamma), turned @ JGamma  # Γ·JΓ and ΛJΓ
        along, *arm = (jnp.sum((m[there] * y).reshape(2, -1), axis=0) for y in (own, *arms))
        masses, traces, r = m[i] * m[j], m[j] * trace[i] + m[i] * trace[j], vectors.vector(d)
        v = 1 / vectors.dot(r, r)
        third = self.G * v * jnp.sqrt(v)
        fifth = 3 * third * v  # 3G/r⁵
        size = third * (masses + 1.5 * v * (traces - 5 * v * along))
        f = jnp.stack(materialized(size * r + fifth * vectors.Vector(arm)))
        torque = jnp.stack(m[there] * _twice(fifth) * vectors.cross(both, arms))
        rows = jnp.concatenate([jnp.concatenate([f, -f], axis=1), torque]).T
        of_each = np.argsort(here, kind="stable").reshape(self.count, -1)
        return rows if self.count == 2 else jnp.sum(rows[of_each], axis=1)

    def _entries(self, n: np.ndarray) -> vectors.Symmetric:
        """The inertias of k bodies."""
        J = self.inertias[n].T
        return vectors.Symmetric(vectors.components(J)) if self.inertias.ndim == 2 else vectors.entries(J)

    def invariants(self, x: Positions, R: Rotations) -> Array:
        """r², Γ_i and Γ_j of each of k pairs, (7k,)."""
        i, j = self._pairs
        d = x[j] - x[i]
        Gamma = [jnp.sum(R[n] * d[:, :, None], axis=1) for n in (i, j)]
        return jnp.concatenate([jnp.sum(d * d, axis=1), Gamma[0].ravel(), Gamma[1].ravel()])

    def value(self, invariants: Array) -> Scalar:
        """V of the invariants."""
        (i, j), (u, *Gammas) = self._pairs, self._split(invariants)
        m, trace = self.masses, self._traces
        along = sum(m[b] * _form(self.inertias[a], Gamma) for a, b, Gamma in zip((i, j), (j, i), Gammas, strict=True))
        second = 1.5 * along / u - 0.5 * (m[j] * trace[i] + m[i] * trace[j])
        return self.G * jnp.sum((second / u - m[i] * m[j]) / jnp.sqrt(u))

    def discrete_gradient(self, start: Array, end: Array) -> Array:
        """D with D·(end − start) = V(end) − V(start), in closed form, without cancellation."""
        (i, j), (u0, *Gammas0), (u1, *Gammas1) = self._pairs, self._split(start), self._split(end)
        m, trace = self.masses, self._traces
        a, b = 1 / jnp.sqrt(u0), 1 / jnp.sqrt(u1)
        d1 = -a * a * b * b / (a + b)  # of u^−½: (b − a)/(u₁ − u₀)
        d3, d5 = d1 * (a * a + a * b + b * b), d1 * (a**4 + a**3 * b + a * a * b * b + a * b**3 + b**4)
        along_u = -m[i] * m[j] * d1 - 0.5 * (m[j] * trace[i] + m[i] * trace[j]) * d3
        along_Gamma = []
        for k, other, G0, G1 in zip((i, j), (j, i), Gammas0, Gammas1, strict=True):
            J, weight = self.inertias[k], 1.5 * m[other]
            along_u = along_u + weight * (_form(J, G0) + _form(J, G1)) / 2 * d5
            along_Gamma.append(((a**5 + b**5) / 2 * weight)[:, None] * _times(J, G0 + G1))
        return self.G * jnp.concatenate([along_u, along_Gamma[0].ravel(), along_Gamma[1].ravel()])

    @property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        return np.triu_indices(self.masses.shape[0], 1)  # pyright: ignore[reportReturnType]

    @property
    def _traces(self) -> Array:
        J = self.inertias
        return jnp.sum(J, axis=1) if J.ndim == 2 else jnp.trace(J, axis1=1, axis2=2)

    def _split(self, invariants: Array) -> tuple[Array, Array, Array]:
        """r² (k,), Γ_i (k, 3) and Γ_j (k, 3)."""
        k = invariants.size // 7
        return invariants[:k], invariants[k : 4 * k].reshape(k, 3), invariants[4 * k :].reshape(k, 3)


def _twice(x: Array) -> Array:
    return jnp.concatenate([x, x], axis=-1)


def _times(J: Array, Gamma: Array) -> Array:
    """JΓ of each of k bodies, (k, 3)."""
    return J * Gamma if J.ndim == 2 else jnp.sum(J * Gamma[:, None, :], axis=2)


def _form(J: Array, Gamma: Array) -> Array:
    """Γ·JΓ of each of k bodies, (k,)."""
    return jnp.sum(Gamma * _times(J, Gamma), axis=1)


maccullagh = MacCullagh


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    inertias = jnp.array([[1.3, 1.7, 2.2], [0.13, 0.17, 0.22]])
    return {"maccullagh": partial(maccullagh, G=1.3, masses=jnp.array([2.0, 1.0]), inertias=inertias)}
