"""The Earth's magnetic field along an orbit, by the Gauss coefficients of IGRF-14."""

from __future__ import annotations

import datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import positive
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.vectors import dot
from lieint_jax.core import callable_pytree, pytree
from lieint_jax.dates import Epoch
from lieint_jax.orbits._air import above_ground
from lieint_jax.orbits._earth import J2000, days_since_j2000, julian_date, rotation_of_earth
from lieint_jax.orbits._kepler import kepler

__all__ = ["earth_field"]

_RADIUS = 6371.2  # km, of the coefficients of IGRF
_YEARS = np.arange(2000.0, 2031.0, 5.0)
_DEGREE = 13


@pytree
class EarthField:
    """The dipole of the Earth's magnetic field along an orbit: `field(t)` is b in space. Made by `earth_field`.

    Attributes:
        orbit: t ↦ (position, velocity).
        coefficients: (g₁¹, h₁¹, g₁⁰), in axes that rotate with the Earth, (3,).
        radius: the radius of the sphere of reference.
        angle: the angle of the Earth's rotation at t = 0.
        rate: its rate.
    """

    orbit: Any
    coefficients: Array
    radius: Array
    angle: Array
    rate: Array

    def __call__(self, t: ArrayLike) -> Array:
        """b = (R/r)³ (3 r̂ (r̂·G) − G), with G of the coefficients in space, (3,)."""
        r, _ = self.orbit(t)
        angle = self.angle + self.rate * t
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y, z = self.coefficients
        G = jnp.stack([c * x - s * y, s * x + c * y, z])
        square = dot(r, r)
        size = self.radius / jnp.sqrt(square)
        return size * size * size * (3 * dot(r, G) / square * r - G)


@pytree
class HarmonicField:
    """The Earth's magnetic field along an orbit by spherical harmonics: `field(t)` is b. Made by `earth_field`.

    Attributes:
        orbit: t ↦ (position, velocity).
        weights: of V and W in the components of b, in axes that rotate with the Earth, (2, 3, N + 2, N + 2), where
            V + iW = (R/r)ⁿ⁺¹ P exp(imλ) are the solid harmonics of Schmidt's norm by degree n and order m.
        radius: the radius R of the sphere of reference.
        angle: the angle of the Earth's rotation at t = 0.
        rate: its rate.
    """

    orbit: Any
    weights: Array
    radius: Array
    angle: Array
    rate: Array

    def __call__(self, t: ArrayLike) -> Array:
        """b = −∇V, (3,), by recursions in Cartesian coordinates, which are regular at the poles too."""
        r, _ = self.orbit(t)
        angle = self.angle + self.rate * t
        c, s = jnp.cos(angle), jnp.sin(angle)
        near = self.radius / dot(r, r)
        x, y, z, square = near * (c * r[0] + s * r[1]), near * (c * r[1] - s * r[0]), near * r[2], near * self.radius
        end = self.weights.shape[-1]
        V, W = [jnp.sqrt(square)], [0 * square]  # those of n = m
        for m in range(1, end):
            k = np.sqrt(1 - 0.5 / m).item() if m > 1 else 1.0
            V, W = [*V, k * (x * V[-1] - y * W[-1])], [*W, k * (x * W[-1] + y * V[-1])]
        sums = jnp.sum(self.weights * _ratios(z, square, end)[None, None], axis=2)
        b = sums[0] @ jnp.stack(V) + sums[1] @ jnp.stack(W)
        return jnp.stack([c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]])


def _ratios(z: Array, square: Array, end: int) -> Array:
    """The solid harmonics by degree and order, each divided by that of this order m and the degree m."""
    m, one = np.arange(end), jnp.eye(end, dtype=z.dtype)
    rows = [one[0]]
    for n in range(1, end):
        size = np.sqrt(np.maximum(n * n - m * m, 1))
        a = jnp.asarray(np.where(m < n, (2 * n - 1) / size, 0), z.dtype)
        row = a * z * rows[-1] + one[n]
        if n > 1:
            b = jnp.asarray(np.where(m < n, np.sqrt(np.maximum((n - 1) ** 2 - m * m, 0)) / size, 0), z.dtype)
            row = row - b * square * rows[-2]
        rows.append(row)
    return jnp.stack(rows)


def _weights(orders: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    """The weights of a `HarmonicField`: a derivative of a harmonic is a sum of two of the next degree.

    Source: Montenbruck & Gill 2000, Satellite Orbits, (3.33), here with Schmidt's norm.
    """
    found = np.zeros((2, 3, degree + 2, degree + 2))
    for (n, order), value in zip(orders, values, strict=True):
        m = abs(order)
        same = value * np.array([order >= 0, order < 0])  # of V and W: g and h
        turned = np.array([-same[1], same[0]])
        up = np.sqrt((n + m + 1) * (n + m + 2) / (4 if m else 2))
        found[:, 0, n + 1, m + 1] += up * same
        found[:, 1, n + 1, m + 1] += up * turned
        found[:, 2, n + 1, m] += np.sqrt((n - m + 1) * (n + m + 1)) * same
        if m:
            down = np.sqrt((n - m + 1) * (n - m + 2) / (2 if m == 1 else 4))
            found[:, 0, n + 1, m - 1] -= down * same
            found[:, 1, n + 1, m - 1] += down * turned
    return found


def earth_field(
    orbit: Any,
    date: ArrayLike | Epoch | str,
    coefficients: Any = None,
    radius: ArrayLike = _RADIUS,
    *,
    rate: ArrayLike | None = None,
    degree: int = 1,
    frame: str | None = None,
) -> EarthField | HarmonicField:
    """The Earth's magnetic field along an orbit, which rotates with the Earth, in tesla: a dipole, or all of IGRF.

    The dipole is the first degree of IGRF-14; the higher degrees are 10 to 20 percent of the field in a low orbit.

    Args:
        orbit: t ↦ (position, velocity) from the Earth's center in inertial axes, z to the pole; t in seconds. An orbit
            of a file, or of the elements of one, has the names of its axes and center.
        date: the date at t = 0 in UT: a text such as "2026-03-01T12:00:00", an `Epoch`, or a Julian date.
        coefficients: of another dipole, (g₁¹, h₁¹, g₁⁰), (3,), or of another field, rows (n, m, g) of degree, order and
            Schmidt's coefficient, an order < 0 that of h, (rows, 3), in the unit of the returned field; by default
            IGRF-14 at this date, from 2000 to 2030, in tesla.
        radius: 6371.2 km in the orbit's unit of length.
        rate: the rate of the Earth's rotation, in radians per unit of time; by default in rad/s.
        degree: the degree to which the field is summed, from 1 to 13, which is all of IGRF. In machine code an
            evaluation at degree 1, 4 and 13 takes 0.1, 0.15 and 0.5 µs; at 13 the first call takes seconds more for
            each place in a law where the field is evaluated.
        frame: the orbit's axes, by default `orbit.frame` if it has one: in "TEME", "TOD" and "MOD" the Earth turns by
            Greenwich mean sidereal time, in all others, such as "GCRF" and "EME2000", by the Earth rotation angle.

    Returns:
        A function t ↦ b in space, (3,).

    Raises:
        ValueError: the orbit is below the ground or in another unit of length than the radius; its axes rotate, have
            another z (the ecliptic, B1950), or its center is not the Earth's; IGRF-14 has no coefficients for the date,
            or the date is in a scale such as TT; a degree that IGRF does not have.

    Source: Alken et al. 2021, Earth Planets Space 73 (IGRF); IAGA Working Group V-MOD 2024, IGRF-14 coefficients.
    """
    R, degree = positive("radius", radius), _checks.count("degree", degree, 1)
    if degree > (_DEGREE if coefficients is None else 1):
        most = f"{_DEGREE}, the last one of IGRF" if coefficients is None else "1 with the coefficients of a dipole"
        raise ValueError(f"degree must be at most {most}, got {degree}")
    above_ground(orbit, R)
    angle, own_rate = rotation_of_earth(orbit, date, frame)
    angle = _checks.real_array("date", angle, ())
    turning = R, angle, _checks.real_array("rate", own_rate if rate is None else rate, ())
    orbit = callable_pytree(orbit)
    if coefficients is not None and np.ndim(coefficients) == 2:
        rows = _checks.host_array("coefficients", coefficients, float)
        orders, degree = rows[:, :2].astype(int), int(rows[:, 0].max())
        return HarmonicField(orbit, jnp.asarray(_weights(orders, rows[:, 2], degree)), *turning)
    if degree > 1:
        return HarmonicField(orbit, jnp.asarray(_weights(*_gauss(date, degree), degree)), *turning)
    G = _gauss(date, 1)[1][[1, 2, 0]] if coefficients is None else coefficients
    return EarthField(orbit, _checks.real_array("coefficients", G, (3,)), *turning)


def _gauss(date: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Degree and order of the Gauss coefficients, an order < 0 that of h, and their values at a date, in tesla.

    They are linear between the epochs of IGRF.
    """
    day = float(days_since_j2000(date)) + J2000
    if not julian_date(2000, 1, 1) <= day <= julian_date(2030, 1, 1):
        raise ValueError(
            f"the field is that of IGRF-14 from 2000 to 2030, got the date {date}; give coefficients=(g11, h11, g10), "
            "those of a dipole in tesla"
        )
    year = datetime.date.fromordinal(int(day - julian_date(1, 1, 1)) + 1).year
    first, next_ = julian_date(year, 1, 1), julian_date(year + 1, 1, 1)
    year += (day - first) / (next_ - first)
    rows = _table()[: degree * (degree + 2)]
    return rows[:, :2].astype(int), 1e-9 * np.array([np.interp(year, _YEARS, row[2:]) for row in rows])


@cache
def _table() -> np.ndarray:
    """Degree, order, and the coefficients of `_YEARS` in nT."""
    return np.loadtxt(Path(__file__).with_name("igrf14.csv"), delimiter=",", skiprows=3)


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    orbit, more = kepler(1.3, 1.2, 0.1, 0.7), {"radius": 0.8, "rate": 0.06, "degree": 1, "frame": "GCRF"}
    dipole, date = jnp.array([0.1, 0.2, -0.9]), jnp.array(2460676.5)
    return {"earth_field": partial(earth_field, orbit=orbit, date=date, coefficients=dipole, **more)}
