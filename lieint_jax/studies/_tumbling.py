"""The mean periods of a free tumbling body in closed form, with derivatives, and the direction of its momentum."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import elliptic
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

_POINTS = 64  # of the midpoint rule over a quarter period, whose error falls geometrically with their number


def mean_periods(body: RigidBody, state: State) -> Array:
    """Mean precession and rotation period of a free body with principal moments, (2,), in units of time.

    The body circulates about the axis of its least moment (a; c is the greatest) if |Π|² < 2H J₂, else about that of
    the greatest (a; c is the least). Then, with J₂ = b and time from Π_b = 0,

        Π_b² = b(|Π|² − 2Ha)/(b − a) sn²(nt),   Π_c² = c(|Π|² − 2Ha)/(c − a) cn²(nt)
        n² = (2Hc − |Π|²)(b − a)/(abc),   m = (c − b)(|Π|² − 2Ha)/((b − a)(2Hc − |Π|²))

    The rotation period, 4K(m)/n, is that of Π about axis a in the body. The precession period is 2π over the mean over
    it of φ̇ = |Π| (Π_b²/b + Π_c²/c)/(Π_b² + Π_c²), the rate at which axis a turns about the angular momentum.

    Source: Landau & Lifshitz, Mechanics, § 37; `scenarios.rigid_body.mean_periods` measures them on a trajectory.
    """
    least, b, greatest = jnp.sort(body.inertia)
    twice_energy, square = 2 * body.energy(state), jnp.sum(state.p**2)
    long = square < twice_energy * b
    a, c = jnp.where(long, least, greatest), jnp.where(long, greatest, least)
    excess, lack = square - twice_energy * a, twice_energy * c - square
    n = jnp.sqrt(lack * (b - a) / (a * b * c))
    m1 = 1 - (c - b) * excess / ((b - a) * lack)
    quarter = elliptic.quarter_period(m1)
    sn, cn, _ = elliptic.jacobi(quarter * (jnp.arange(_POINTS) + 0.5) / _POINTS, jnp.full(_POINTS, m1))
    Pi_b, Pi_c = b * excess / (b - a) * sn**2, c * excess / (c - a) * cn**2
    precession = jnp.sqrt(square) * jnp.mean((Pi_b / b + Pi_c / c) / (Pi_b + Pi_c))
    return jnp.stack([2 * jnp.pi / precession, 4 * quarter / n])


def direction(p: Array) -> Array:
    """Longitude in [0, 360) and latitude of a vector (..., 3), in degrees, (..., 2)."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    return jnp.rad2deg(jnp.stack([jnp.arctan2(y, x) % (2 * jnp.pi), jnp.arctan2(z, jnp.hypot(x, y))], axis=-1))
