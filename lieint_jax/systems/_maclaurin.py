"""Maclaurin's spheroids in closed form: rotating liquids under their own gravity, and the modes of their bars."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lieint_jax._checks import host_array

__all__ = ["maclaurin_modes", "maclaurin_spheroid"]


class Spheroid(NamedTuple):
    """An oblate spheroid of the volume of a ball of radius R, which rotates rigidly about its short axis.

    Attributes:
        equatorial: its equatorial semi-axis a over R; the polar one is a√(1 − e²).
        angular_velocity: Ω, in √(GM/R³).
    """

    equatorial: np.ndarray
    angular_velocity: np.ndarray


def maclaurin_spheroid(eccentricity: ArrayLike) -> Spheroid:
    """The rotating liquid of a given eccentricity e = √(1 − c²/a²), 0 < e < 1, in the units G = M = R = 1.

    Its state is that of an `incompressible_body(np.full(3, 0.2), self_gravity(1, 1, 1))`.

    Source: Chandrasekhar 1969, Ellipsoidal Figures of Equilibrium, § 32.

    Example:
        >>> a, Omega = maclaurin_spheroid(0.812670)  # from here on Jacobi's ellipsoids exist
        >>> round(float(Omega) ** 2 * 4 / 3, 5)  # over πGρ
        0.37423
    """
    e = host_array("eccentricity", eccentricity, float)
    q = np.sqrt(1 - e * e)
    _, first, second = _arcsine(e)
    square = 2 * (q * e) ** 2 * (3 * second - 2 * first)  # 2q/e³ (3 − 2e²) arcsin e − 6q²/e², over πGρ = 3/4
    return Spheroid(q ** (-1 / 3), np.sqrt(0.75 * square))


def maclaurin_modes(eccentricity: ArrayLike) -> np.ndarray:
    """Ω ± √(4B₁₁ − Ω²), complex, (…, 2): the rates σ at which a small bar e^{iσt} of a spheroid rotates in space.

    They are twice the rates of the bar's axes. The faster is first; of two of one speed the growing one, Im σ < 0.
    From e = 0.812670 on a bar may grow by friction, where the second is 0, from e = 0.952887 on it must grow.

    Args:
        eccentricity: (…), as in `maclaurin_spheroid`, with its units.

    Source: Chandrasekhar 1969, Ellipsoidal Figures of Equilibrium, § 33 (105), in space.
    """
    e = host_array("eccentricity", eccentricity, float)
    Omega, q = maclaurin_spheroid(e).angular_velocity, np.sqrt(1 - e * e)
    _, first, second = _arcsine(e)
    A1 = q * q * first  # q/e³ arcsin e − q²/e²; A₃ = 2/e² − 2q/e³ arcsin e
    A13 = 3 * (first - second)  # (A₁ − A₃)/(q² − 1) times a², and so are A₁₁ and B₁₁
    B11 = A1 - (2 - A13) / 4
    root = np.conj(np.sqrt(3 * B11 - Omega**2 + 0j))  # 4B₁₁ over πGρ
    return np.stack([Omega + root, Omega - root], axis=-1)


def _arcsine(e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g = arcsin e/(e√(1 − e²)) = 1 + ⅔e² + …, (g − 1)/e², and ((g − 1)/e² − ⅔)/e²: by the series of g for e² < ½."""
    x = e * e
    k = np.arange(1, 60)
    coefficients = np.cumprod(2 * k / (2 * k + 1))[1:]
    small = np.polynomial.polynomial.polyval(np.where(x < 0.5, x, 0), coefficients)
    large = np.where(x < 0.5, 0.5, x)
    g = np.arcsin(np.sqrt(large)) / np.sqrt(large * (1 - large))
    second = np.where(x < 0.5, small, ((g - 1) / large - 2 / 3) / large)
    first = 2 / 3 + x * second
    return 1 + x * first, first, second
