"""The direction of the Sun, and the Earth's shadow."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import named, positive
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import cross, dot, norm
from lieint_jax.core import Converted, argument, callable_pytree, pytree, static
from lieint_jax.dates import Epoch
from lieint_jax.orbits._air import above_ground
from lieint_jax.orbits._anomaly import less_sine
from lieint_jax.orbits._earth import EARTH_RADIUS, days_since_j2000
from lieint_jax.orbits._kepler import kepler

__all__ = ["Eclipse", "eclipse", "sun_direction"]

SUN_ANGLE = 0.0046524  # the half-angle of the Sun at 1 au: asin(696000 km / 149597870.7 km)


@pytree
class SunDirection:
    """The unit vector from the Earth to the Sun: `sun(t)`, in space. Made by `sun_direction`.

    Attributes:
        days: the days from J2000 to t = 0.
        day: the length of a day in the unit of time.
    """

    days: Array
    day: Array

    def __call__(self, t: ArrayLike) -> Array:
        """s at time t, (3,)."""
        n = self.days + t / self.day
        degree = np.pi / 180
        anomaly = degree * jnp.mod(357.528 + 0.9856003 * n, 360)
        longitude = degree * jnp.mod(280.460 + 0.9856474 * n, 360)
        longitude = longitude + degree * (1.915 * jnp.sin(anomaly) + 0.020 * jnp.sin(2 * anomaly))
        tilt = degree * (23.439 - 0.0000004 * n)
        s = jnp.sin(longitude)
        return jnp.stack([jnp.cos(longitude), jnp.cos(tilt) * s, jnp.sin(tilt) * s])


def sun_direction(date: ArrayLike | Epoch | str, day: ArrayLike = 86400.0) -> SunDirection:
    """The unit vector to the Sun, seen from the Earth, to 0.01° from 1950 to 2050 (mean equator and equinox of date).

    Args:
        date: the date at t = 0, in any scale: a text such as "2026-03-01", an `Epoch`, or a Julian date.
        day: the length of a day in the unit of t.

    Raises:
        ValueError: the date or the day is not a finite number, or the day is not positive.

    Source: The Astronomical Almanac, low-precision formulas for the Sun's coordinates (page C5).
    """
    days = _checks.real_array("date", days_since_j2000(date, universal=False), ())
    return SunDirection(days, positive("day", day))


def _sun(sun: Any) -> Any:
    if not callable(sun):
        return _checks.unit_vector("sun", sun)
    _checks.function("sun", sun, "the time t", (3,), jnp.zeros(()))
    return callable_pytree(sun)


def _shadow(shadow: Any) -> Literal["conical", "cylindrical"]:
    if shadow not in ("conical", "cylindrical"):
        raise ValueError(f'shadow must be "conical" or "cylindrical", got {shadow!r}')
    return shadow


@pytree
class Eclipse:
    """The fraction of the sunlight that reaches a satellite, from 0 in the Earth's shadow to 1.

    Args:
        orbit: t ↦ (position, velocity) from the Earth's center.
        sun: the unit vector to the Sun in space, (3,), or a function of time whose value points to it
            (`sun_direction`).
        radius: of the Earth, in the orbit's unit of length.
        shadow: "conical", with a penumbra, continuous in time; or "cylindrical", 0 or 1.
        angle: the half-angle of the Sun's disc, in radians.

    Raises:
        ValueError: `shadow` is none of these, `sun` is no unit vector and no such function, or the orbit is below the
            ground or in another unit.

    Source: Montenbruck & Gill 2000, Satellite Orbits, 3.4.2.
    """

    orbit: Converted[Any] = argument(converter=lambda orbit: callable_pytree(_checks.inertial(orbit)))
    sun: Converted[Any] = argument(converter=_sun)
    radius: Converted[Array] = argument(converter=named(positive, "radius"), default=EARTH_RADIUS)
    shadow: Converted[Literal["conical", "cylindrical"]] = static(converter=_shadow, default="conical")
    angle: Converted[Array] = argument(converter=named(positive, "angle"), default=SUN_ANGLE, kw_only=True)

    def check_fields(self) -> None:
        """Raise ValueError if the orbit is below the ground or in another unit."""
        above_ground(self.orbit, self.radius)

    def __call__(self, t: ArrayLike) -> Array:
        """1 in the light, 0 in the shadow; the visible part of the disc in the penumbra of a cone."""
        r, _ = self.orbit(t)
        s = jnp.asarray(self.sun(t) if callable(self.sun) else self.sun)
        along, beside = dot(r, s), cross(r, s)
        off = jnp.sqrt(jnp.maximum(dot(beside, beside), jnp.finfo(r.dtype).tiny))
        if self.shadow == "cylindrical":
            edge = self.radius * norm(s)
            lit, dark = (along >= 0) | (off >= edge), (along < 0) & (off < edge)  # neither for NaN
            return jnp.where(lit, 1.0, jnp.where(dark, 0.0, jnp.nan)).astype(r.dtype)
        size = norm(r)
        return 1 - _covered_fraction(
            self.angle, jnp.arcsin(jnp.minimum(self.radius / size, 1)), jnp.arctan2(off, -along)
        )


def _covered_fraction(a: Array, b: Array, c: Array) -> Array:
    """The fraction of a disc of radius a that is covered by one of radius b, whose center is at the distance c."""
    apart, inside = c >= a + b, c <= jnp.abs(a - b)  # neither for NaN
    c_ = jnp.where(apart | inside, b, c)  # a harmless one
    x = ((c_ - b) * (c_ + b) + a * a) / (2 * c_)
    y = jnp.sqrt(jnp.maximum(a * a - x * x, 1e-12 * a * a))
    alpha, beta = jnp.arctan2(y, x), jnp.arctan2(y, c_ - x)
    area = (
        a * a * less_sine(2 * alpha) + b * b * less_sine(2 * beta)
    ) / 2  # two segments, each a sector less a triangle
    whole = jnp.minimum(1, (b / a) ** 2)
    return jnp.where(apart, 0, jnp.where(inside, whole, area / (jnp.pi * a * a)))


eclipse = Eclipse


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    night = {"orbit": kepler(1.3, 1.2, 0.1), "sun": jnp.array([-0.6, -0.8, 0.0]), "radius": 0.8, "angle": 0.3}
    return {
        "sun_direction": partial(sun_direction, date=jnp.array(2460676.5), day=0.1),
        "eclipse": partial(eclipse, **night, shadow="conical"),
        "eclipse by a cylinder": partial(eclipse, **night, shadow="cylindrical"),
    }
