"""Tides between rigid bodies: laws that dissipate energy, but conserve linear and angular momentum.

| | |
|---|---|
| `constant_lag` | the tide of each body lags by a constant time (Mignard) |
| `constant_q` | by a constant angle, at a constant quality factor Q (MacDonald; Goldreich & Soter) |
| `double_synchronous` | where tides come to an end: both bodies locked, in closed form |

Pass a law to `systems.rigid_bodies(…, dissipation=law)`, and add its conservative part, `law.potential`, to the
potential of the bodies. `schemes.bodies_energy_momentum` conserves linear and angular momentum and energy less work,
all to round-off. A custom law inherits `PairLaw`, or is a function (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._checks import all_plain, concrete, for_each, host_array, named, positive, real_array
from lieint_jax.core import Converted, PairLaw, argument, pytree
from lieint_jax.potentials import Potential

__all__ = ["LaggingTides", "PairLaw", "constant_lag", "constant_q", "double_synchronous"]
__dir__ = __all__.copy


@pytree
class PairOfTides(PairLaw):
    """The tides of two bodies: f = −ΣA_k u_k, τ_k = r × A_k u_k, u_k = v − ω_k × r, A_k = 3B_kΔt_k/r⁸ (1 + 2r̂r̂ᵀ).

    Here B_k = k₂G m² R⁵, with m the mass of the other body, and the lag Δt_k is a constant over √(1 + (σ_kT_k)²), with
    σ_k = |u_k|/r the rate of the body's surface relative to the other body.

    Attributes:
        strengths: k₂Δt G m of each at σ = 0, (2,).
        masses: m, of the other body, (2,).
        radii: R of each, (2,).
        times: T of each, (2,).
    """

    strengths: Array
    masses: Array
    radii: Array
    times: Array

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
        along, square, near = jnp.sum(radial * u), jnp.sum(u * u), self.radii[k] * inverse
        # powers one by one: R⁵ and r⁸ of planets in kilometers are too large for float32
        factor = 3 * self.strengths[k] * (self.masses[k] * inverse * inverse * inverse) * near**2 * near**2 * near
        factor = factor / jnp.sqrt(1 + (self.times[k] * inverse) ** 2 * square)
        return factor * (u + 2 * along * radial), factor * (square + 2 * along * along)


@pytree
class TidalPotential(Potential):
    """V = −½ Σ B_k/r⁶ over all pairs, B_k = k₂G m² R⁵: the potential of a tide without lag.

    Attributes:
        coefficients: B_i + B_j of each pair i < j, (pairs,), in the order (0, 1), (0, 2), (1, 2), …
    """

    coefficients: Array

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


def _masses(masses: ArrayLike) -> Array:
    m = real_array("masses", masses)
    if m.ndim != 1 or m.size < 2:
        raise ValueError(f"masses must have shape (N,), N ≥ 2, got {m.shape}")
    return positive("masses", m, m.shape)


def _not_negative(name: str, value: ArrayLike, *shapes: tuple[int, ...]) -> Array:
    x = real_array(name, value, *shapes)
    if concrete(x) and not bool(np.all(np.asarray(x) >= 0)):
        raise ValueError(f"{name} must be ≥ 0, got {np.asarray(x)}; 0 means a body without a tide")
    return x


@pytree
class LaggingTides(PairLaw):
    """Tides of constant time lag, to first order in the lag: each body raises a tide on every other.

    With A_k = (3k₂G m² R⁵ Δt_k/r⁸)(1 + 2r̂r̂ᵀ), m the mass of the other body and u_k = v − ω_k × r, the force on the
    second body is −ΣA_k u_k and the torque on body k is r × A_k u_k: Mignard's equations without their conservative
    part, which is `.potential`. They conserve linear and angular momentum, and dissipate the power Σu_k·A_k u_k ≥ 0.

    Args:
        G: the constant of gravity, in units consistent with the other arguments.
        masses, radii: (N,), > 0.
        k2: Love's numbers of degree 2, ≥ 0, (N,), or one for all; 0 for a body without a tide.
        lags: ≥ 0, in units of time, (N,), or one for all. A quality factor Q at the tidal frequency σ is a lag 1/(Qσ).
        times: T ≥ 0, (N,), or one for all: at rates σ = |v − ω_k × r|/r above 1/T the lag is Δt/√(1 + (σT)²), as in
            `constant_q`; by default 0, a constant lag.

    Raises:
        ValueError: masses or radii are not positive, another number is negative, or shapes disagree.

    Other conventions: Δt is Hut's τ, also in REBOUNDx's `tides_constant_time_lag`. Eggleton's dissipation constant is
    σ = 2GΔt/(3k₂R⁵). REBOUNDx's `tides_spin` sets σ = 4Gτ/(3k₂R⁵), so that its `tau` is Δt/2.

    Example:
        >>> import lieint_jax as li
        >>> tide = li.tides.constant_lag(1.0, [1.0, 0.1], [0.3, 0.1], 0.3, [0.01, 0.0])
        >>> tide.potential.count
        2

    Source: Mignard 1979, Moon and Planets 20, (5) and (6); the form with A_k: this package. Other conventions: Hut
    1981, Astron. Astrophys. 99; Eggleton, Kiseleva & Hut 1998, Astrophys. J. 499, (45).
    """

    G: Converted[Array] = argument(converter=named(positive, "G"))
    masses: Converted[Array] = argument(converter=_masses)
    radii: Converted[Array] = argument(converter=named(real_array, "radii"))
    k2: Converted[Array] = argument(converter=named(real_array, "k2"))
    lags: Converted[Array] = argument(converter=named(real_array, "lags"))
    times: Converted[Array] = argument(converter=named(real_array, "times", optional=True), default=None, kw_only=True)

    def check_fields(self) -> dict[str, Array]:
        """A number for each body; ValueError if shapes disagree or a number is out of range."""
        positive("radii", self.radii, self.masses.shape)
        k2, lags = (for_each(_not_negative, *x, self.count) for x in (("k2", self.k2), ("lags", self.lags)))
        times = jnp.zeros_like(lags) if self.times is None else for_each(_not_negative, "times", self.times, self.count)
        return {"k2": k2, "lags": lags, "times": times}

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
        own = (self.k2, self.lags, self.radii, self.times)
        k2, lags, radii, times = (jnp.stack([x[k] for k in bodies]) for x in own)
        masses = jnp.stack([self.masses[k] for k in others])
        return PairOfTides(k2 * lags * (self.G * masses), masses, radii, times)

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


def constant_q(
    G: ArrayLike, masses: ArrayLike, radii: ArrayLike, k2: ArrayLike, *, Q: ArrayLike, threshold: ArrayLike
) -> LaggingTides:
    """Tides of a constant quality factor Q: the bulge is ahead of, or behind, the other body by a constant angle 1/2Q.

    The law of `constant_lag` with the lag Δt_k = 1/(2Q√(σ_k² + σ₀²)), σ_k = |v − ω_k × r|/r: a friction whose size does
    not depend on the speed, but for rates below the threshold σ₀. There the lag is 1/(2Qσ₀), so that bodies that show
    each other one face are at rest relative to one another and the law is smooth. As the law is −A_k u_k with A_k ≥ 0
    for any lag, linear and angular momentum and the energy plus the energy lost are conserved as well. On a circular
    orbit in the plane of the equator ȧ = ±3 (k₂/Q)(m/M)(R/a)⁵ na, to (σ₀/σ)²/2 of it.

    On an eccentric orbit one bulge that lags by a constant angle is a convention: only a constant lag in time follows
    from a linear response (Efroimsky & Williams 2009, Celest. Mech. Dyn. Astron. 104).

    Args:
        G, masses, radii, k2: as in `constant_lag`.
        Q: quality factors, > 0, (N,), or one for all.
        threshold: σ₀, rates in radians per unit time, > 0, (N,), or one for all; such as a hundredth of the orbit's.
            The smaller it is, the shorter must steps be where both rates agree. There relative rotation decays at the
            rate c = 3k₂G m² R⁵/(2Qσ₀a⁶) (1/J + a²/μ), and steps of cΔt above 1 to 2 do not converge, with a flag.

    Raises:
        ValueError: as `constant_lag`; a Q or a threshold that is not positive.

    Example:
        >>> import lieint_jax as li
        >>> masses, radii, k2 = [1.0, 0.1], [0.3, 0.1], [0.3, 0.0]
        >>> tide = li.tides.constant_q(1.0, masses, radii, k2, Q=100.0, threshold=0.01)
        >>> float(tide.lags[0])
        0.5

    Source: MacDonald 1964, Rev. Geophys. 2; Goldreich & Soter 1966, Icarus 5; ȧ: Murray & Dermott 1999, (4.160).
    """
    m = _masses(masses)
    quality, slow = (for_each(real_array, *x, m.size) for x in (("Q", Q), ("threshold", threshold)))
    for name, x in (("Q", quality), ("threshold", slow)):
        if concrete(x) and not bool(np.all(np.asarray(x) > 0)):
            raise ValueError(f"{name} must be positive, got {np.asarray(x)}; a body without a tide has k2 = 0")
    return LaggingTides(G, m, radii, k2, 1 / (2 * quality * slow), times=1 / slow)


class LockedOrbit(NamedTuple):
    """Two bodies on a circle that always show each other the same faces.

    Attributes:
        distance: that of their centers.
        period: of the circle and of both rotations.
    """

    distance: float
    period: float


def double_synchronous(G: float, masses: ArrayLike, inertia: float, momentum: float) -> LockedOrbit:
    """The outer locked motion of two bodies with a given angular momentum: where tides come to an end.

    The greater root a of L = μ√(GMa) + J√(GM/a³), with μ the reduced mass. NaN below the least value of L, which it has
    where the orbit's part is three times that of the bodies.

    Args:
        G: the constant of gravity.
        masses: (2,).
        inertia: J, the sum of both moments of inertia about the normal of the orbit.
        momentum: L, of the orbit and the bodies.

    Source: Hut 1980, Astron. Astrophys. 92, 167.

    Example: a body of mass 0.1 about one of mass 1, without moments of inertia of their own.

        >>> found = double_synchronous(1.0, [1.0, 0.1], 0.0, 0.1 / 1.1 * 1.1**0.5)
        >>> round(found.distance, 9), round(found.period, 6)
        (1.0, 5.990782)
    """
    all_plain(G=G, inertia=inertia, momentum=momentum)
    m = host_array("masses", masses, float)
    GM, mu = G * m.sum(), m.prod() / m.sum()
    least = np.sqrt(3 * inertia / mu)
    if inertia and mu * np.sqrt(GM * least) + inertia * np.sqrt(GM / least**3) > momentum:
        return LockedOrbit(np.nan, np.nan)
    roots = np.roots([mu, -momentum / np.sqrt(GM), 0, 0, inertia])  # of the equation for √a, times a^(3/2)
    a = float(roots.real.max() ** 2)
    return LockedOrbit(a, float(2 * np.pi * np.sqrt(a**3 / GM)))


constant_lag = LaggingTides
