"""The geomagnetic field of IGRF-13 along a low orbit, in numpy: an input of published cases."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lieint_jax import orbits

_RADIUS = 6371.2e3  # m, of the coefficients
_DEGREE = 13
_TABLE = Path(__file__).with_name("igrf13_2020.csv")
_ByDegree = dict[tuple[int, int], np.ndarray]
_PRECESSION = np.deg2rad(2004.19 / 3600) / 36525  # rad per day, by which the pole moves toward x, IAU 2006


def orbit_with_j2(state: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """Positions (steps + 1, 3), in m, along an orbit about an oblate Earth, by RK4 with steps of dt (s).

    `state` is position and velocity at the start, m and m/s, (6,).
    """
    mu, J2, radius = orbits.EARTH_GM * 1e9, orbits.EARTH_J2, orbits.EARTH_RADIUS * 1e3

    def rate(y: np.ndarray) -> np.ndarray:
        r = y[:3]
        R = np.linalg.norm(r)
        oblate = 1.5 * J2 * (radius / R) ** 2 * (np.array([1.0, 1.0, 3.0]) - 5 * (r[2] / R) ** 2)
        return np.concatenate([y[3:], -mu / R**3 * r * (1 + oblate)])

    y, positions = np.asarray(state, float), [state[:3]]
    for _ in range(steps):
        k1 = rate(y)
        k2 = rate(y + dt / 2 * k1)
        k3 = rate(y + dt / 2 * k2)
        y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + dt * k3))
        positions.append(y[:3])
    return np.stack(positions)


def igrf(julian_date: float, t: np.ndarray, positions: np.ndarray, year: float) -> np.ndarray:
    """The field in the inertial axes of J2000, in T, (times, 3).

    Args:
        julian_date: of t = 0, in UT.
        t: times in s.
        positions: in the same axes, m, (times, 3).
        year: for which the coefficients are evaluated, such as 2018.5.

    Source: Alken et al. 2021, Earth Planets Space 73, 49: the coefficients of 2020 and their rates.
    """
    days = julian_date - orbits.J2000
    angle = np.asarray(orbits.earth_rotation_angle(julian_date)) + orbits.EARTH_RATE * t
    tilt = _PRECESSION * days
    precession = np.array([[1.0, 0.0, -tilt], [0.0, 1.0, 0.0], [tilt, 0.0, 1.0]])
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rotate = np.stack([[c, s, zero], [-s, c, zero], [zero, zero, zero + 1]]).transpose(2, 0, 1) @ precession
    field = _field_on_earth(np.einsum("kij,kj->ki", rotate, positions), year)
    return 1e-9 * np.einsum("kji,kj->ki", rotate, field)


def _field_on_earth(x: np.ndarray, year: float) -> np.ndarray:
    """−∇V in axes that rotate with the Earth, nT: V = R Σ (R/r)ⁿ⁺¹ (g cos mλ + h sin mλ) P of Schmidt's norm."""
    r, rho = np.linalg.norm(x, axis=1), np.hypot(x[:, 0], x[:, 1])
    ct, st, longitude = x[:, 2] / r, rho / r, np.arctan2(x[:, 1], x[:, 0])
    P, dP = _schmidt(ct, st)
    up, south, east = np.zeros((3, len(r)))
    for n, m, g, h, g_rate, h_rate in np.loadtxt(_TABLE, delimiter=",", skiprows=1):
        g, h = g + (year - 2020) * g_rate, h + (year - 2020) * h_rate
        cos, sin = np.cos(m * longitude), np.sin(m * longitude)
        part, key = (_RADIUS / r) ** (n + 2), (int(n), int(m))
        up += (n + 1) * part * (g * cos + h * sin) * P[key]
        south -= part * (g * cos + h * sin) * dP[key]
        east += m * part * (g * sin - h * cos) * P[key] / st
    c, s = np.cos(longitude), np.sin(longitude)
    to_south, to_east = np.stack([ct * c, ct * s, -st], axis=1), np.stack([-s, c, np.zeros_like(r)], axis=1)
    return up[:, None] * x / r[:, None] + south[:, None] * to_south + east[:, None] * to_east


def _schmidt(ct: np.ndarray, st: np.ndarray) -> tuple[_ByDegree, _ByDegree]:
    """The associated Legendre functions of cos θ with Schmidt's norm, and their derivatives by θ, by (n, m)."""
    P, dP = {(0, 0): np.ones_like(ct)}, {(0, 0): np.zeros_like(ct)}
    none = np.zeros_like(ct)
    for n in range(1, _DEGREE + 1):
        for m in range(n):
            size = np.sqrt(n * n - m * m)
            a, b = (2 * n - 1) / size, np.sqrt(max((n - 1) ** 2 - m * m, 0)) / size
            one, two = (n - 1, m), (n - 2, m)
            P[n, m] = a * ct * P[one] - b * P.get(two, none)
            dP[n, m] = a * (ct * dP[one] - st * P[one]) - b * dP.get(two, none)
        k = np.sqrt(1 - 0.5 / n) if n > 1 else 1.0
        P[n, n] = k * st * P[n - 1, n - 1]
        dP[n, n] = k * (st * dP[n - 1, n - 1] + ct * P[n - 1, n - 1])
    return P, dP
