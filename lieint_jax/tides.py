"""Tides between rigid bodies: laws that dissipate energy, but conserve linear and angular momentum.

| | |
|---|---|
| `constant_lag` | the tide of each body lags by a constant time (Mignard) |

Pass a law to `systems.rigid_bodies(…, dissipation=law)`, and add its conservative part, `law.potential`, to the
potential of the bodies. `schemes.bodies_energy_momentum` conserves linear and angular momentum and energy less work,
all to round-off. A custom law inherits `PairLaw`, or is a function (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax.potentials import Potential
from lieint_jax.types import PairLaw, pytree

__all__ = ["ConstantLag", "PairLaw", "PairOfTides", "TidalPotential", "constant_lag"]


@pytree
class PairOfTides(PairLaw):
    """The tides of two bodies: f = −ΣA_k u_k, τ_k = r × A_k u_k, u_k = v − ω_k × r, A_k = 3B_kΔt_k/r⁸ (1 + 2r̂r̂ᵀ).

    Here B_k = k₂G m² R⁵, with m the mass of the other body.

    Attributes:
        strengths: k₂Δt G m of each, (2,).
        masses: m, of the other body, (2,).
        radii: R of each, (2,).
    """

    strengths: Array
    masses: Array
    radii: Array

    def __call__(self, r: Array, v: Array, omega_i: Array, omega_j: Array) -> tuple[Array, Array, Array]:
        """The force on the second body, −f on the first, and the torques on both, each (3,)."""
        (first, _), (second, _) = (self._tide(k, r, v, omega) for k, omega in enumerate((omega_i, omega_j)))
        return -(first + second), jnp.cross(r, first), jnp.cross(r, second)

    def loss(self, r: Array, v: Array, omega_i: Array, omega_j: Array) -> Array:
        """Σu_k·A_k u_k, a sum of squares."""
        return self._tide(0, r, v, omega_i)[1] + self._tide(1, r, v, omega_j)[1]

    def _tide(self, k: int, r: Array, v: Array, omega: Array) -> tuple[Array, Array]:
        """A_k u_k and u_k·A_k u_k."""
        inverse = 1 / jnp.sqrt(jnp.sum(r * r))
        u, radial = v - jnp.cross(omega, r), r * inverse
        along, near = jnp.sum(radial * u), self.radii[k] * inverse
        # powers one by one: R⁵ and r⁸ of planets in kilometers are too large for float32
        factor = 3 * self.strengths[k] * (self.masses[k] * inverse * inverse * inverse) * near**2 * near**2 * near
        return factor * (u + 2 * along * radial), factor * (jnp.sum(u * u) + 2 * along * along)


@pytree
class TidalPotential(Potential):
    """V = −½ Σ B_k/r⁶ over all pairs, B_k = k₂G m² R⁵: the potential of a tide without lag.

    Attributes:
        coefficients: B_i + B_j of each pair i < j, (pairs,), in the order (0, 1), (0, 2), (1, 2), …
    """

    coefficients: Array

    def __call__(self, x: Array, R: Array) -> Array:
        """V."""
        return self.value(self.invariants(x, R))

    @property
    def count(self) -> int:
        """N, of N(N − 1)/2 pairs."""
        return round((1 + (1 + 8 * self.coefficients.shape[-1]) ** 0.5) / 2)

    def invariants(self, x: Array, R: Array) -> Array:
        """The squared distance of each pair, (pairs,)."""
        between = [x[j] - x[i] for i, j in _pairs(x.shape[0])]
        return jnp.stack([jnp.sum(d * d) for d in between])

    def value(self, invariants: Array) -> Array:
        """V of the squared distances."""
        return -jnp.sum(self.coefficients / invariants**3) / 2

    def discrete_gradient(self, start: Array, end: Array) -> Array:
        """D with D·(end − start) = V(end) − V(start), in closed form, without cancellation."""
        a, b = 1 / start, 1 / end
        return self.coefficients * (a * b) * (a * a + a * b + b * b) / 2


@pytree
class ConstantLag(PairLaw):
    """Tides that lag by a constant time. Made by `constant_lag`.

    Attributes:
        G: the constant of gravity.
        masses, radii: (N,).
        k2: Love's numbers, (N,).
        lags: times, (N,).
    """

    G: Array
    masses: Array
    radii: Array
    k2: Array
    lags: Array

    def __call__(self, r: Array, v: Array, omega_i: Array, omega_j: Array) -> tuple[Array, Array, Array]:
        """The tides of the first two bodies."""
        return self.between(0, 1)(r, v, omega_i, omega_j)

    @property
    def count(self) -> int:
        """N."""
        return self.masses.shape[-1]

    def between(self, i: int, j: int) -> PairOfTides:
        """The tides of bodies i and j, which each raises on the other."""
        bodies, others = np.array([i, j]), np.array([j, i])
        masses, k2, lags, radii = (
            jnp.stack([x[k] for k in which])
            for x, which in ((self.masses, others), (self.k2, bodies), (self.lags, bodies), (self.radii, bodies))
        )
        return PairOfTides(k2 * lags * (self.G * masses), masses, radii)

    @property
    def potential(self) -> TidalPotential:
        """The conservative part, −½ Σ k₂G m² R⁵/r⁶: a potential, to be added to that of gravity."""
        m = self.masses
        pairs = [self._coefficient(i, m[j]) + self._coefficient(j, m[i]) for i, j in _pairs(self.count)]
        return TidalPotential(jnp.stack(pairs))

    def _coefficient(self, k: int, mass: Array) -> Array:
        return self.k2[k] * (self.G * mass) * mass * self.radii[k] ** 5


def _pairs(n: int) -> list[tuple[int, int]]:
    return [(i, j) for j in range(n) for i in range(j)]


def constant_lag(G: ArrayLike, masses: ArrayLike, radii: ArrayLike, k2: ArrayLike, lags: ArrayLike) -> ConstantLag:
    """Tides of constant time lag, to first order in the lag: each body raises a tide on every other.

    With A_k = (3k₂G m² R⁵ Δt_k/r⁸)(1 + 2r̂r̂ᵀ), m the mass of the other body and u_k = v − ω_k × r, the force on the
    second body is −ΣA_k u_k and the torque on body k is r × A_k u_k: Mignard's equations without their conservative
    part, which is `.potential`. They conserve linear and angular momentum, and dissipate the power Σu_k·A_k u_k ≥ 0.

    Args:
        G: the constant of gravity, in units consistent with the other arguments.
        masses, radii: (N,), > 0.
        k2: Love's numbers of degree 2, ≥ 0, (N,), or one for all; 0 for a body without a tide.
        lags: ≥ 0, in units of time, (N,), or one for all. A quality factor Q at the tidal frequency σ is a lag 1/(Qσ).

    Raises:
        ValueError: masses or radii are not positive, another number is negative, or shapes disagree.

    Example:
        >>> import lieint_jax as li
        >>> tide = li.tides.constant_lag(1.0, [1.0, 0.1], [0.3, 0.1], 0.3, [0.01, 0.0])
        >>> tide.potential.count
        2

    Source: Mignard 1979, Moon and Planets 20, (5) and (6); the form with A_k: this package.
    """
    m = _checks.real_array("masses", masses)
    if m.ndim != 1 or m.size < 2:
        raise ValueError(f"masses must have shape (N,), N ≥ 2, got {m.shape}")
    n = (m.size,)
    g, R = _checks.real_array("G", G, ()), _checks.real_array("radii", radii, n)
    love, late = (jnp.broadcast_to(_checks.real_array(name, x, (), n), n) for name, x in (("k2", k2), ("lags", lags)))
    for name, x in (("G", g), ("masses", m), ("radii", R)):
        if concrete(x) and not bool(np.all(np.asarray(x) > 0)):
            raise ValueError(f"{name} must be positive, got {np.asarray(x)}")
    for name, x in (("k2", love), ("lags", late)):
        if concrete(x) and not bool(np.all(np.asarray(x) >= 0)):
            raise ValueError(f"{name} must be ≥ 0, got {np.asarray(x)}; 0 means a body without a tide")
    return ConstantLag(g, m, R, love, late)
