"""Given motions of a center: Kepler's orbits, elliptic and hyperbolic, as functions of time.

With the eccentric anomaly E, M = n(t − T), n = √(μ/|a|³), in the orbit's own axes (periapsis along x)

    ellipse     E − e sin E = M,     x = a(cos E − e),       y = a√(1−e²) sin E,        r = a(1 − e cos E)
    hyperbola   e sinh E − E = M,    x = |a|(e − cosh E),    y = |a|√(e²−1) sinh E,     r = |a|(e cosh E − 1)

Everything is written with 1 − e and with E − sin E by its series, so that no digits cancel near a parabola. Derivatives
are those of the equation for E, not of the iterations that solve it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._deprecated import old_calls
from lieint_jax._numerics.power_series import horner
from lieint_jax.types import pytree

EARTH_GM = 398600.4418  # the Earth's gravitational parameter in km³/s², IERS Conventions 2010

_Function = Callable[[Array], Array]
_CORRECTIONS = 3  # by Halley's method: 2 suffice for all E, on ellipses and on hyperbolas
_GRADINGS, _PARTS = 4, 16  # passes of `graded_times`, and parts of a step in its sums
_CUBIC = [1 / math.factorial(2 * k + 3) for k in range(9)]  # (sinh E − E)/E³ = Σ E^{2k}/(2k+3)!


@pytree
class Kepler:
    """A Kepler orbit: `orbit(t)` is the position and the velocity at time t. Made by `kepler`.

    Attributes:
        mu, semi_major_axis, eccentricity, inclination, node, periapsis, periapsis_time: as in `kepler`, scalars.
    """

    mu: Array
    semi_major_axis: Array
    eccentricity: Array
    inclination: Array
    node: Array
    periapsis: Array
    periapsis_time: Array

    @property
    def mean_motion(self) -> Array:
        """n = √(μ/|a|³), in radians per unit of time; the period of an ellipse is 2π/n; NaN for no orbit."""
        a, e = self.semi_major_axis, self.eccentricity
        exists = (self.mu > 0) & ((a > 0) & (e >= 0) & (e < 1) | (a < 0) & (e > 1))
        size = jnp.where(exists, jnp.abs(a), jnp.nan)
        return jnp.sqrt(self.mu / size) / size

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) at time t, a scalar of either sign."""
        a, e = jnp.abs(self.semi_major_axis), self.eccentricity
        M = self.mean_motion * (t - self.periapsis_time)
        if concrete(e):
            in_plane = _on_hyperbola(M, e) if float(e) > 1 else _on_ellipse(M, e)
        else:
            closed = e < 1
            # In a loop over bodies that share e and t, only one branch runs, and XLA does not fuse it into each of them
            in_plane = lax.cond(
                closed,
                lambda: _on_ellipse(M, jnp.where(closed, e, 0.5)),
                lambda: _on_hyperbola(M, jnp.where(closed, 2, e)),
            )
        x, y, vx, vy = in_plane
        speed = jnp.sqrt(self.mu / a)
        P, Q = self._axes()
        return a * (x * P + y * Q), speed * (vx * P + vy * Q)

    def _axes(self) -> tuple[Array, Array]:
        """The unit vectors to periapsis and along the velocity there: the columns of R_z(Ω) R_x(i) R_z(ω)."""
        (c, s), (ci, si), (cw, sw) = ((jnp.cos(x), jnp.sin(x)) for x in (self.node, self.inclination, self.periapsis))
        P = jnp.stack([c * cw - s * sw * ci, s * cw + c * sw * ci, sw * si])
        return P, jnp.stack([-c * sw - s * cw * ci, -s * sw + c * cw * ci, cw * si])


@old_calls()
def kepler(
    mu: ArrayLike,
    semi_major_axis: ArrayLike,
    eccentricity: ArrayLike,
    inclination: ArrayLike = 0.0,
    *,
    node: ArrayLike = 0.0,
    periapsis: ArrayLike = 0.0,
    periapsis_time: ArrayLike = 0.0,
) -> Kepler:
    """The orbit of a body about a center of attraction at the origin.

    Traced elements are not checked here. Where they belong to no orbit, positions and velocities are NaN.

    The position is right to 1e-13 of the radius for e ≤ 0.9 and to 1e-12 for e = 0.99 and 1.01, beside the rounding of
    the mean anomaly n(t − T) itself, eps·n|t − T|. All elements can be differentiated, vmapped and traced.

    Args:
        mu: the gravitational parameter GM, > 0, in length³ / time².
        semi_major_axis: a, a length; a < 0 for a hyperbola.
        eccentricity: e; 0 ≤ e < 1 for a > 0, e > 1 for a < 0. Parabolas, e = 1, have no a: take e a little off 1.
        inclination, node, periapsis: i, Ω and ω, in radians: R_z(Ω) R_x(i) R_z(ω) takes the orbit's axes to those of
            space.
        periapsis_time: T, when the body is nearest, in the unit of time of mu and on the clock of t.

    Raises:
        ValueError: μ ≤ 0, a = 0, e = 1, e < 0, e and a of different kinds, a value that is no finite real number.

    Source: Markley 1995, Celest. Mech. Dyn. Astron. 63 (the first guess for E); Halley's method.

    Example:
        >>> orbit = kepler(mu=1.0, semi_major_axis=1.0, eccentricity=0.5)
        >>> position, velocity = orbit(0.0)
        >>> position.tolist()
        [0.5, 0.0, 0.0]
    """
    given = {
        "mu": mu,
        "semi_major_axis": semi_major_axis,
        "eccentricity": eccentricity,
        "inclination": inclination,
        "node": node,
        "periapsis": periapsis,
        "periapsis_time": periapsis_time,
    }
    elements = {name: _checks.real_array(name, value, ()) for name, value in given.items()}
    dtype = jnp.result_type(*elements.values())
    elements = {name: value.astype(dtype) for name, value in elements.items()}
    _check_elements(*(float(np.asarray(x)) if concrete(x) else None for x in (mu, semi_major_axis, eccentricity)))
    return Kepler(**elements)


@old_calls()
def graded_times(
    orbit: Callable[[Array], tuple[Array, Array]], t0: float, t1: float, n: int, *, c: float = 0.15
) -> np.ndarray:
    """Step boundaries for `integrate(…, times=…)` on an orbit: n steps, shorter where the body is nearer to the center.

    Steps are in proportion to 1/(r₀/r + c), where r₀ is the least distance between t0 and t1. Far away c bounds them,
    near the center they are about c/(1 + c) of that bound. They depend on the orbit alone and are the same for all
    members of an ensemble, so a symplectic step stays symplectic.

    Args:
        orbit: t ↦ (position, velocity), such as `kepler(...)` makes.
        t0, t1: first and last time, in either order.
        n: the number of steps.
        c: > 0; 0.15 serves tumbling bodies in flybys (0 would leave the body's own turning to huge steps far away).

    Returns:
        (n+1,) times from t0 to t1.

    Raises:
        ValueError: t0 = t1 or not finite, n < 1, c ≤ 0.
    """
    n, t0, t1, c = _checks.count("n", n, 1), float(t0), float(t1), float(c)
    if not (math.isfinite(t0) and math.isfinite(t1) and t0 != t1):
        raise ValueError(f"t0 and t1 must be finite and differ, got {t0} and {t1}")
    if not (0 < c < math.inf):
        raise ValueError(f"c must be positive and finite, got {c}")
    position = jax.jit(jax.vmap(lambda t: orbit(t)[0]))
    times = np.linspace(t0, t1, n + 1)
    for _ in range(_GRADINGS):  # each on a grid graded by the one before
        fine = np.interp(np.arange(_PARTS * n + 1) / _PARTS, np.arange(n + 1), times)
        r = np.linalg.norm(np.asarray(position(jnp.asarray(fine)), float), axis=1)
        rate = r.min() / r + c
        s = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) * np.diff(fine))])
        times = np.interp(np.linspace(0, 1, n + 1), s / s[-1], fine)
    return times


def _check_elements(mu: float | None, a: float | None, e: float | None) -> None:
    """ValueError if the elements that are no tracers, which are None here, belong to no orbit."""
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


def _on_ellipse(M: Array, e: Array) -> tuple[Array, ...]:
    """x, y over a and their time derivatives over √(μ/a)."""
    E = _elliptic_anomaly(M - 2 * jnp.pi * lax.stop_gradient(jnp.round(M / (2 * jnp.pi))), e)
    return _in_plane(E, e, 1 - e, jnp.sin, jnp.cos)


def _on_hyperbola(M: Array, e: Array) -> tuple[Array, ...]:
    """x, y over |a| and their time derivatives over √(μ/|a|)."""
    return _in_plane(_hyperbolic_anomaly(M, e), e, e - 1, jnp.sinh, jnp.cosh)


def _in_plane(E: Array, e: Array, rest: Array, sine: _Function, cosine: _Function) -> tuple[Array, ...]:
    """Both, with rest = |1 − e| and the circular or the hyperbolic functions."""
    r, b = _slope(E, e, rest, sine), jnp.sqrt(rest * (1 + e))
    return rest - 2 * sine(E / 2) ** 2, b * sine(E), -sine(E) / r, b * cosine(E) / r


def _slope(E: Array, e: Array, rest: Array, sine: _Function) -> Array:
    """dM/dE = 1 − e cos E or e cosh E − 1, which is also r/|a|."""
    return rest + 2 * e * sine(E / 2) ** 2


def _halley(E: Array, m: Array, e: Array, rest: Array, sine: _Function, less: _Function) -> Array:
    """Corrections of E as a root of rest·E + e·less(E) = m, with less(E) = E − sin E or sinh E − E."""
    for _ in range(_CORRECTIONS):
        f = rest * E + e * less(E) - m
        slope, bend = _slope(E, e, rest, sine), e * sine(E)
        E = E - 2 * f * slope / (2 * slope * slope - f * bend)
    return E


@jax.custom_jvp
def _elliptic_anomaly(M: Array, e: Array) -> Array:
    """E of E − e sin E = M for |M| ≤ π."""
    m, rest = jnp.abs(M), 1 - e
    alpha = (3 * jnp.pi**2 + 1.6 * jnp.pi * (jnp.pi - m) / (1 + e)) / (jnp.pi**2 - 6)
    d = 3 * rest + alpha * e
    q = 2 * alpha * d * rest - m * m
    r = 3 * alpha * d * (d - rest) * m + m**3
    w = jnp.cbrt(r + jnp.sqrt(jnp.maximum(q**3 + r * r, 0))) ** 2
    E = (2 * r * w / (w * w + w * q + q * q) + m) / d
    E = _halley(E, m, e, rest, jnp.sin, _less_sine)
    return jnp.where(M < 0, -E, E)


@_elliptic_anomaly.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    M, e = primals
    E = _elliptic_anomaly(M, e)
    return E, (tangents[0] + jnp.sin(E) * tangents[1]) / _slope(E, e, 1 - e, jnp.sin)


@jax.custom_jvp
def _hyperbolic_anomaly(M: Array, e: Array) -> Array:
    """E of e sinh E − E = M.

    The cubic (e − 1)E + eE³/6 = M gives an upper bound of |E|, and E ↦ asinh((|M| + E)/e) takes one to a lower one. The
    left side is convex, so from there the corrections come down to the root.
    """
    m, rest = jnp.abs(M), e - 1
    p = 2 * rest / e
    s = 3 * m / e
    w = jnp.cbrt(s + jnp.sqrt(s * s + p**3))
    cubic = 2 * s / (w * w + p + (p / w) ** 2)
    E = jnp.minimum(cubic, jnp.arcsinh((m + cubic) / e))
    E = _halley(E, m, e, rest, jnp.sinh, _sinh_less)
    return jnp.where(M < 0, -E, E)


@_hyperbolic_anomaly.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    M, e = primals
    E = _hyperbolic_anomaly(M, e)
    return E, (tangents[0] - jnp.sinh(E) * tangents[1]) / _slope(E, e, e - 1, jnp.sinh)


def _less_sine(E: Array) -> Array:
    """E − sin E, by its series below 1."""
    x = E * E
    return jnp.where(E < 1, E * x * horner(_CUBIC, -jnp.minimum(x, 4)), E - jnp.sin(E))


def _sinh_less(E: Array) -> Array:
    """sinh E − E, by its series below 1."""
    x = E * E
    return jnp.where(E < 1, E * x * horner(_CUBIC, jnp.minimum(x, 4)), jnp.sinh(E) - E)
