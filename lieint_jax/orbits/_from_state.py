"""The Kepler orbit through a position and a velocity, by Lagrange's coefficients, which have no singularities."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import concrete, named, real_array
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import cross, dot, norm
from lieint_jax.core import Converted, argument, pytree
from lieint_jax.orbits._anomaly import elliptic_anomaly, hyperbolic_anomaly, less_sine, sinh_less, slope
from lieint_jax.orbits._kepler import Kepler

__all__ = ["KeplerFromState", "from_state"]

_LINE = 1e-12  # |r × v| over |r||v| below which an orbit is a line
_REST = 0.25  # |1 − e| above which e has all its digits


@pytree
class KeplerFromState:
    """The Kepler orbit through a position and a velocity, elliptic or hyperbolic: `orbit(t)` is both at the time t.

    Values and derivatives are regular for circles and for orbits in the xy-plane. `orbit.elements` has the elements of
    `kepler`. Positions on an ellipse are right to a few ulp of a, plus the effect of rounding the mean anomaly; on a
    hyperbola with e ≥ 1.3 to 20 ulp of |a|(1 + r₀r/a²). That is 4e-8 |a| from r₀ = 4500 |a| on one side to the same
    on the other, where an ulp of the state changes the position by 1.5e-9 |a|; `orbit.elements(t)` is right to 4e-10
    |a| there. Near a parabola the state determines a less well, but positions near the center to a few ulp of r.

    With x = E − E₀, the change of the eccentric anomaly, and a > 0 (an ellipse)

        r(t) = f r₀ + g v₀,    f = 1 − (a/r₀)(1 − cos x),    g = √(a/μ)[r₀ sin x + √(a/μ) r₀·v₀ (1 − cos x)]

    Args:
        mu: the gravitational parameter GM, > 0, in length³ / time².
        position, velocity: position and velocity at the time t, relative to the center of attraction, (3,) each.
        t: that time.

    Raises:
        ValueError: μ ≤ 0; the position is the center; the velocity is parallel to the position, so that the orbit is a
            line; the orbit is a parabola; or a value is not a finite real number.

    Source: Battin 1999, An Introduction to the Mathematics and Methods of Astrodynamics, 3.3 and 4.3.

    Example:
        >>> orbit = from_state(1.0, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        >>> float(orbit.eccentricity)
        0.0
    """

    mu: Converted[Array] = argument(converter=named(real_array, "mu", ()))
    position: Converted[Array] = argument(converter=named(real_array, "position", (3,)))
    velocity: Converted[Array] = argument(converter=named(real_array, "velocity", (3,)))
    t: Converted[Array] = argument(converter=named(real_array, "t", ()), default=0.0)

    def check_fields(self) -> dict[str, Array]:
        """All fields in one dtype; ValueError if no ellipse or hyperbola passes there."""
        if concrete(self):
            _check(float(self.mu), np.asarray(self.position, float), np.asarray(self.velocity, float))
        given = {"mu": self.mu, "position": self.position, "velocity": self.velocity, "t": self.t}
        dtype = jnp.result_type(*given.values())
        return {name: x.astype(dtype) for name, x in given.items()}

    @property
    def start(self) -> Array:
        """The time t of the position and the velocity."""
        return self.t

    @property
    def semi_major_axis(self) -> Array:
        """a, negative for a hyperbola."""
        return 1 / self._inverse_axis

    @property
    def eccentricity(self) -> Array:
        """e."""
        c, s, _ = self._anomaly_parts()
        return jnp.where(self._inverse_axis > 0, jnp.sqrt(c * c + s * s), 1 + self._rest)

    @property
    def mean_motion(self) -> Array:
        """n = √(μ/|a|³), in radians per unit of time; the period of an ellipse is 2π/n."""
        beta = jnp.abs(self._inverse_axis)
        return jnp.sqrt(self.mu * beta) * beta

    @property
    def elements(self) -> Kepler:
        """The same orbit by its elements. The node is 0 for an orbit in the xy-plane, the periapsis 0 for a circle."""
        c, s, _ = self._anomaly_parts()
        closed, e = self._inverse_axis > 0, self.eccentricity
        rest = self._rest
        E = jnp.where(closed, jnp.arctan2(s, c), jnp.arcsinh(s / e))
        M = jnp.where(closed, _elliptic_mean(E, s, e, rest), _hyperbolic_mean(E, s, e, rest))
        h = jnp.stack(cross(self.position, self.velocity))
        tilt = jnp.hypot(h[0], h[1])
        inclination, node = jnp.arctan2(tilt, h[2]), jnp.where(tilt == 0, 0, jnp.arctan2(h[0], -h[1]))
        N = jnp.stack([jnp.cos(node), jnp.sin(node), jnp.zeros_like(node)])
        across = jnp.stack(cross(h, N)) / norm(h)
        latitude = jnp.arctan2(dot(self.position, across), dot(self.position, N))
        half = jnp.where(closed, jnp.tan(E / 2), jnp.tanh(E / 2))
        anomaly = 2 * jnp.arctan(jnp.sqrt((1 + e) / rest) * half)
        time = self.t - M / self.mean_motion
        digits = None if concrete(rest) and float(rest) > _REST else rest
        return Kepler(self.mu, self.semi_major_axis, e, inclination, node, latitude - anomaly, time, rest=digits)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) at time t, a scalar of either sign."""
        alpha = self._inverse_axis
        if concrete(alpha):
            return self._on_ellipse(t) if float(alpha) > 0 else self._on_hyperbola(t)
        return lax.cond(alpha > 0, self._on_ellipse, self._on_hyperbola, jnp.asarray(t))

    acceleration = Kepler.acceleration

    @property
    def _inverse_axis(self) -> Array:
        """1/a = 2/r₀ − v₀²/μ."""
        return 2 / jnp.sqrt(dot(self.position, self.position)) - dot(self.velocity, self.velocity) / self.mu

    def _anomaly_parts(self) -> tuple[Array, Array, Array]:
        """e cos E₀ and e sin E₀, or e cosh E₀ and e sinh E₀, and r₀/|a|, which is never 0 here."""
        alpha = self._inverse_axis
        beta = jnp.abs(alpha)
        size = jnp.sqrt(dot(self.position, self.position))
        return 1 - size * alpha, dot(self.position, self.velocity) * jnp.sqrt(beta / self.mu), size * beta

    @property
    def _rest(self) -> Array:
        """|1 − e| by h = r₀ × v₀; by E₀ it has few digits near a parabola and far from the center of a hyperbola."""
        h, (c, s, _) = jnp.stack(cross(self.position, self.velocity)), self._anomaly_parts()
        ratio = dot(h, h) * jnp.abs(self._inverse_axis) / self.mu  # |1 − e²|
        return ratio / (1 + jnp.where(self._inverse_axis > 0, jnp.sqrt(c * c + s * s), jnp.sqrt(1 + ratio)))

    def _on_ellipse(self, t: ArrayLike) -> tuple[Array, Array]:
        M = self.mean_motion * (t - self.t)
        M = M - 2 * jnp.pi * lax.stop_gradient(jnp.round(M / (2 * jnp.pi)))
        c, s, r0 = self._anomaly_parts()  # lengths over |a|, times over 1/n
        x = _elliptic_change(M, c, s, r0, self._rest)
        S, rest = jnp.sin(x), 2 * jnp.sin(x / 2) ** 2  # rest = |1 − cos x|
        return self._propagate(S, rest, r0 * jnp.cos(x) + rest + s * S, r0 * S + s * rest)

    def _on_hyperbola(self, t: ArrayLike) -> tuple[Array, Array]:
        M = self.mean_motion * (t - self.t)
        c, s, r0 = self._anomaly_parts()
        excess = self._rest
        e = 1 + excess
        x = _hyperbolic_change(M, c, s, r0, excess)
        S, rest = jnp.sinh(x), 2 * jnp.sinh(x / 2) ** 2
        # the terms with r₀ cancel from far to far, those with M from near to far
        g = jnp.where(c + jnp.abs(s) < 2, r0 * S + s * rest, M - jnp.sign(x) * sinh_less(jnp.abs(x)))
        return self._propagate(S, rest, slope(jnp.arcsinh(s / e) + x, e, excess, jnp.sinh), g)

    def _propagate(self, S: Array, rest: Array, r: Array, g: Array) -> tuple[Array, Array]:
        """Position and velocity, from sin x, |1 − cos x|, r over |a|, and n g."""
        r0 = self._anomaly_parts()[2]
        n = self.mean_motion
        f, dg = 1 - rest / r0, 1 - rest / r
        return f * self.position + g / n * self.velocity, -n * S / (r * r0) * self.position + dg * self.velocity


def _check(mu: float, r: np.ndarray, v: np.ndarray) -> None:
    """ValueError if no ellipse or hyperbola passes there."""
    if not mu > 0:
        raise ValueError(f"mu must be positive, got {mu}")
    size, speed = np.linalg.norm(r), np.linalg.norm(v)
    if size == 0:
        raise ValueError("position must not be that of the center of attraction, got 0")
    if np.linalg.norm(np.cross(r, v)) <= _LINE * size * speed:
        raise ValueError(f"an orbit must not be a line through the center: position {r} and velocity {v} are parallel")
    if abs(2 / size - speed**2 / mu) <= 1e-14 * 2 / size:
        raise ValueError(
            f"the speed {speed:.9g} at distance {size:.9g} is that of escape, so the orbit is a parabola, which has "
            "no semi-major axis; change the speed slightly"
        )


def _elliptic_mean(E: Array, s: Array, e: Array, rest: Array) -> Array:
    """E − s for s = e sin E; near a parabola and the periapsis its terms cancel, not these."""
    size = jnp.abs(E)
    return jnp.where(size < 1, rest * E + e * jnp.sign(E) * less_sine(size), E - s)


def _hyperbolic_mean(E: Array, s: Array, e: Array, rest: Array) -> Array:
    """s − E for s = e sinh E."""
    size = jnp.abs(E)
    return jnp.where(size < 1, rest * E + e * jnp.sign(E) * sinh_less(size), s - E)


@jax.custom_jvp
def _elliptic_change(M: Array, c: Array, s: Array, r0: Array, rest: Array) -> Array:
    """x of x − c sin x + s(1 − cos x) = M for |M| ≤ π, with c = e cos E₀, s = e sin E₀, r₀ = 1 − c and rest = 1 − e."""
    first, e = jnp.arctan2(s, c), jnp.sqrt(c * c + s * s)
    mean = M + _elliptic_mean(first, s, e, rest)
    whole = 2 * jnp.pi * jnp.round(mean / (2 * jnp.pi))
    x = elliptic_anomaly(mean - whole, e, rest) + whole - first
    less = jnp.sign(x) * less_sine(jnp.abs(x))
    f = r0 * x + c * less + 2 * s * jnp.sin(x / 2) ** 2 - M  # without cancellation where x is small
    return x - f / _elliptic_slope(x, c, s, r0)


def _elliptic_slope(x: Array, c: Array, s: Array, r0: Array) -> Array:
    return r0 + 2 * c * jnp.sin(x / 2) ** 2 + s * jnp.sin(x)


@_elliptic_change.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    x = _elliptic_change(*primals)
    M, c, s, *_ = tangents
    return x, (M + jnp.sin(x) * c - 2 * jnp.sin(x / 2) ** 2 * s) / _elliptic_slope(x, *primals[1:4])


@jax.custom_jvp
def _hyperbolic_change(M: Array, c: Array, s: Array, r0: Array, rest: Array) -> Array:
    """x of c sinh x + s(cosh x − 1) − x = M, with c = e cosh E₀, s = e sinh E₀, r₀ = c − 1 and rest = e − 1."""
    e = 1 + rest
    first = jnp.arcsinh(s / e)
    x = hyperbolic_anomaly(M + _hyperbolic_mean(first, s, e, rest), e, rest) - first
    more = jnp.sign(x) * sinh_less(jnp.abs(x))
    f = r0 * x + c * more + 2 * s * jnp.sinh(x / 2) ** 2 - M
    slope = _hyperbolic_slope(x, c, s, r0)
    return jnp.where(jnp.abs(x) < 1, x - f / slope, x)  # terms of f cancel where x is large


def _hyperbolic_slope(x: Array, c: Array, s: Array, r0: Array) -> Array:
    return r0 + 2 * c * jnp.sinh(x / 2) ** 2 + s * jnp.sinh(x)


@_hyperbolic_change.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    x = _hyperbolic_change(*primals)
    M, c, s, *_ = tangents
    return x, (M - jnp.sinh(x) * c - 2 * jnp.sinh(x / 2) ** 2 * s) / _hyperbolic_slope(x, *primals[1:4])


from_state = KeplerFromState


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    at = {"position": jnp.array([0.0, 0.84, 0.91]), "velocity": jnp.array([0.14, -0.76, -0.96])}
    return {"from_state": partial(from_state, mu=1.3, **at, t=0.1)}
