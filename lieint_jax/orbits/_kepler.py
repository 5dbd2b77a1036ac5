"""Kepler's orbits by their elements, elliptic and hyperbolic, as functions of time.

With the eccentric anomaly E, M = n(t − T), n = √(μ/|a|³), in the orbit's own axes (periapsis along x)

    ellipse     E − e sin E = M,     x = a(cos E − e),       y = a√(1−e²) sin E,        r = a(1 − e cos E)
    hyperbola   e sinh E − E = M,    x = |a|(e − cosh E),    y = |a|√(e²−1) sinh E,     r = |a|(e cosh E − 1)
"""

from __future__ import annotations

import dataclasses
import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import dot
from lieint_jax.core import pytree, static
from lieint_jax.orbits._anomaly import Function, elliptic_anomaly, hyperbolic_anomaly, slope

__all__ = ["Kepler", "encounter_speed", "hyperbola", "kepler"]


@pytree
class Kepler:
    """A Kepler orbit: `orbit(t)` is the position and the velocity at time t. Made by `kepler`.

    Attributes:
        mu, semi_major_axis, eccentricity, inclination, node, periapsis, periapsis_time: as in `kepler`, scalars.
        closed: whether it is an ellipse, where that was known when it was made: then JAX compiles the equation of one
            kind only. None: of both.
        rest: |1 − e|, where it is known to more digits than e has, near a parabola. None: by e.
    """

    mu: Array
    semi_major_axis: Array
    eccentricity: Array
    inclination: Array
    node: Array
    periapsis: Array
    periapsis_time: Array
    closed: bool | None = static(default=None)
    rest: Array | None = None

    @property
    def mean_motion(self) -> Array:
        """n = √(μ/|a|³), in radians per unit of time; the period of an ellipse is 2π/n; NaN if there is no orbit."""
        a, e = self.semi_major_axis, self.eccentricity
        exists = (self.mu > 0) & ((a > 0) & (e >= 0) & (e < 1) | (a < 0) & (e > 1))
        size = jnp.where(exists, jnp.abs(a), jnp.nan)
        return jnp.sqrt(self.mu / size) / size

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) at time t, a scalar of either sign."""
        e = self.eccentricity
        return _motion(self, t, not float(e) > 1 if concrete(e) else self.closed)

    def acceleration(self, position: Array) -> Array:
        """−μr/|r|³ at a position, (3,)."""
        square = dot(position, position)
        return position * (-self.mu / (square * jnp.sqrt(square)))

    def axes(self) -> tuple[Array, Array]:
        """The unit vectors to periapsis and along the velocity there: the columns of R_z(Ω) R_x(i) R_z(ω)."""
        (c, s), (ci, si), (cw, sw) = ((jnp.cos(x), jnp.sin(x)) for x in (self.node, self.inclination, self.periapsis))
        P = jnp.stack([c * cw - s * sw * ci, s * cw + c * sw * ci, sw * si])
        return P, jnp.stack([-c * sw - s * cw * ci, -s * sw + c * cw * ci, cw * si])


@functools.partial(jax.jit, static_argnums=2)  # traced once, although each law along an orbit evaluates it
def _motion(orbit: Kepler, t: ArrayLike, closed: bool | None) -> tuple[Array, Array]:
    """The position and the velocity, on an ellipse, on a hyperbola, or on either."""
    a, e = jnp.abs(orbit.semi_major_axis), orbit.eccentricity
    rest = _rest(e, orbit.rest)
    M = orbit.mean_motion * (t - orbit.periapsis_time)
    if closed is None:
        is_closed = e < 1
        # In a loop over bodies that share e and t, only one branch runs, and XLA does not fuse it into each of them
        in_plane = lax.cond(
            is_closed,
            lambda: _on_ellipse(M, *(jnp.where(is_closed, x, 0.5) for x in (e, rest))),
            lambda: _on_hyperbola(M, jnp.where(is_closed, 2, e), jnp.where(is_closed, 1, rest)),
        )
    elif closed:
        in_plane = _on_ellipse(jnp.where(e < 1, M, jnp.nan), e, rest)
    else:
        in_plane = _on_hyperbola(jnp.where(e > 1, M, jnp.nan), e, rest)
    x, y, vx, vy = in_plane
    speed = jnp.sqrt(orbit.mu / a)
    P, Q = orbit.axes()
    return a * (x * P + y * Q), speed * (vx * P + vy * Q)


def _rest(e: Array, known: Array | None) -> Array:
    """|1 − e| with the digits of `known` that e has not, unless e is another; its derivatives are those by e."""
    rest = jnp.abs(1 - e)
    if known is None:
        return rest
    lost = lax.stop_gradient(known - rest)
    return rest + jnp.where(jnp.abs(lost) <= 2 * jnp.finfo(e.dtype).eps * jnp.maximum(1, e), lost, 0)


def kepler(
    mu: ArrayLike,
    semi_major_axis: ArrayLike,
    eccentricity: ArrayLike,
    inclination: ArrayLike = 0.0,
    node: ArrayLike = 0.0,
    periapsis: ArrayLike = 0.0,
    periapsis_time: ArrayLike = 0.0,
) -> Kepler:
    """A Kepler orbit about a center of attraction at the origin, elliptic or hyperbolic, by its elements.

    Traced elements are not checked; where no such orbit exists, positions and velocities are NaN.

    The position is right to 1e-13 of the radius for e ≤ 0.9 and to 1e-12 for e = 0.99 and 1.01, plus the effect of
    rounding the mean anomaly n(t − T), eps·n|t − T|. All elements can be differentiated, vmapped and traced.

    Args:
        mu: the gravitational parameter GM, > 0, in length³ / time².
        semi_major_axis: a, a length; a < 0 for a hyperbola.
        eccentricity: e; 0 ≤ e < 1 for a > 0, e > 1 for a < 0. Parabolas, e = 1, have no a; use an e slightly off 1.
        inclination, node, periapsis: i, Ω and ω, in radians: R_z(Ω) R_x(i) R_z(ω) rotates the orbit's axes to those of
            space.
        periapsis_time: T, the time of periapsis, in the unit of time of mu and on the clock of t.

    Returns:
        A function t ↦ (position, velocity).

    Raises:
        ValueError: μ ≤ 0, a = 0, e = 1, e < 0, e and a contradict each other, or a value is not a finite real number.

    Source: Markley 1995, Celest. Mech. Dyn. Astron. 63 (the first guess for E); Halley's method.

    Example:
        >>> orbit = kepler(mu=1.0, semi_major_axis=1.0, eccentricity=0.5)
        >>> position, velocity = orbit(0.0)
        >>> position.tolist()
        [0.5, 0.0, 0.0]
    """
    given = mu, semi_major_axis, eccentricity, inclination, node, periapsis, periapsis_time
    names = [field.name for field in dataclasses.fields(Kepler)]
    elements = {name: _checks.real_array(name, value, ()) for name, value in zip(names, given, strict=False)}
    dtype = jnp.result_type(*elements.values())
    elements = {name: value.astype(dtype) for name, value in elements.items()}
    _check_elements(*(float(np.asarray(x)) if concrete(x) else None for x in given[:3]))
    e = elements["eccentricity"]
    return Kepler(**elements, closed=bool(float(e) < 1) if concrete(e) else None)


def hyperbola(mu: ArrayLike, distance: ArrayLike, speed: ArrayLike) -> Kepler:
    """The Kepler orbit of a flyby in the x-y plane, with its periapsis on the x axis at t = 0.

    Args:
        mu: the gravitational parameter GM, > 0, in length³ / time².
        distance: that of the periapsis, > 0.
        speed: that at infinity, > 0.

    Raises:
        ValueError: one of them is not positive.

    Example:
        >>> position, velocity = hyperbola(1.0, 2.0, 3.0)(0.0)
        >>> position.tolist(), round(float(velocity[1]) ** 2, 9)  # v² = v∞² + 2μ/r
        ([2.0, 0.0, 0.0], 10.0)
    """
    GM, size, v = (_checks.positive(*x) for x in (("mu", mu), ("distance", distance), ("speed", speed)))
    square = v**2
    excess = size * square / GM
    orbit = kepler(GM, -GM / square, 1 + excess)
    return dataclasses.replace(orbit, rest=excess.astype(orbit.eccentricity.dtype))


def encounter_speed(semi_major_axis: ArrayLike, eccentricity: ArrayLike, inclination: ArrayLike) -> Array:
    """The speed at infinity with which an orbit meets a planet on a circle, over the planet's speed.

    Args:
        semi_major_axis: of the orbit, over the radius of the planet's.
        eccentricity: of the orbit.
        inclination: to the plane of the planet's orbit, in radians.

    Returns:
        The speed, of any shape; NaN for orbits that do not meet the planet's, as far as the formula shows it.

    Source: Öpik 1951, Proc. R. Irish Acad. 54A: U² = 3 − 1/a − 2√(a(1 − e²)) cos i.

    Example: Apophis and the Earth, at 29.78 km/s on a circle, in km/s.

        >>> round(float(encounter_speed(0.9224, 0.1914, 0.0583)) * 29.78, 1)
        5.5
    """
    given = {"semi_major_axis": semi_major_axis, "eccentricity": eccentricity, "inclination": inclination}
    a, e, i = (_checks.real_array(name, x) for name, x in given.items())
    return jnp.sqrt(3 - 1 / a - 2 * jnp.sqrt(a * (1 - e * e)) * jnp.cos(i))


def _check_elements(mu: float | None, a: float | None, e: float | None) -> None:
    """ValueError if no orbit has these elements; None stands for a tracer."""
    if mu is not None and not mu > 0:
        raise ValueError(f"mu must be positive, got {mu}")
    if a == 0:
        raise ValueError("semi_major_axis must not be 0: it is > 0 for an ellipse and < 0 for a hyperbola")
    if e is None:
        return
    if e == 1:
        raise ValueError("eccentricity must not be 1: a parabola has no semi-major axis; use an e slightly off 1")
    if e < 0:
        raise ValueError(f"eccentricity must be ≥ 0, got {e}")
    if a is not None and (a > 0) != (e < 1):
        raise ValueError(
            f"an ellipse has semi_major_axis > 0 and 0 ≤ eccentricity < 1, a hyperbola semi_major_axis < 0 and "
            f"eccentricity > 1, got {a} and {e}"
        )


def _on_ellipse(M: Array, e: Array, rest: Array) -> tuple[Array, ...]:
    """x, y over a and their time derivatives over √(μ/a)."""
    E = elliptic_anomaly(M - 2 * jnp.pi * lax.stop_gradient(jnp.round(M / (2 * jnp.pi))), e, rest)
    return _in_plane(E, e, rest, jnp.sin, jnp.cos)


def _on_hyperbola(M: Array, e: Array, rest: Array) -> tuple[Array, ...]:
    """x, y over |a| and their time derivatives over √(μ/|a|)."""
    return _in_plane(hyperbolic_anomaly(M, e, rest), e, rest, jnp.sinh, jnp.cosh)


def _in_plane(E: Array, e: Array, rest: Array, sine: Function, cosine: Function) -> tuple[Array, ...]:
    """Position and velocity in the plane, with rest = |1 − e| and the circular or the hyperbolic functions."""
    r, b = slope(E, e, rest, sine), jnp.sqrt(rest * (1 + e))
    return rest - 2 * sine(E / 2) ** 2, b * sine(E), -sine(E) / r, b * cosine(E) / r


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    angles = {"inclination": 0.7, "node": 0.4, "periapsis": 0.2, "periapsis_time": 0.1}
    speeds = {"semi_major_axis": 1.1, "eccentricity": 0.3, "inclination": 0.2}
    return {
        "kepler": partial(kepler, mu=1.3, semi_major_axis=1.1, eccentricity=0.1, **angles),
        "kepler on a hyperbola": partial(kepler, mu=1.3, semi_major_axis=-1.1, eccentricity=1.3, **angles),
        "hyperbola": partial(hyperbola, mu=1.3, distance=0.4, speed=0.7),
        "encounter_speed": partial(encounter_speed, **speeds),
    }
