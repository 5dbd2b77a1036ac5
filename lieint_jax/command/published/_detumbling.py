"""A CubeSat that magnetic torquers detumble in the field of IGRF-13: the simulations of Willis et al. 2024."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import orbits, schemes, systems, torques
from lieint_jax.command.published._case import case
from lieint_jax.core import State
from lieint_jax.groups import so3

_INERTIA = 1.58 / 1.504 * np.array([[0.0043, -0.0003, 0.0], [-0.0003, 0.0049, 0.0], [0.0, 0.0, 0.0035]])  # kg m²
_TURNS, _OHMS, _AREAS = np.array([40, 56, 28]), np.array([12.2, 16.8, 14.4]), np.array([4218e-6, 3150e-6, 7091e-6])
_MAX_DIPOLE = _TURNS * 5.06 / _OHMS * _AREAS  # A m², of the three coils at 5.06 V
_ORBIT = [1.9394507081343518e6, 4.766642029817451e6, -4.411438134177178e6, 5444.6283277223, -4691.101972534811]
_ORBIT += [-2675.140215905073]  # m and m/s, at 2018 January 1, 0 h
_ATTITUDE = [-0.7353624981952477, 0.32177790229023334, 0.4367418868778419, 0.4061496055545587]
_RATES = [0.0713423406637996, 0.3955777863977627, 0.3355356361778791]  # rad/s; only their size is used
_TABLE = Path(__file__).with_name("igrf13_2020.csv")
_PRECESSION = np.deg2rad(2004.19 / 3600) / 36525  # rad per day, by which the pole moves toward x, IAU 2006
_SAMPLING = 0.1  # s, between two measurements; the dipole is constant in between
_GAINS = (4e-5, 4e-3)
_SCHEME = "torqued_midpoint(body) with torques.dipole, constant for each of 36 000 samples, Δt = 0.1 s"
_HOURS = np.array([0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])  # of the published momenta


def field_of_case() -> orbits.VectorTable:
    """The field along the orbit for the first hour, T, in the axes of J2000, by all degrees of IGRF-13.

    Source: Alken et al. 2021, Earth Planets Space 73, 49: the coefficients of 2020 and their rates.
    """
    t, date = np.arange(0.0, 3601.0, 10.0), orbits.julian_date(2018, 1, 1)
    n, m, g, h, g_rate, h_rate = np.loadtxt(_TABLE, delimiter=",", skiprows=1).T
    years = 2018 + 1 / 365.2425 - 2020
    g, h = 1e-9 * (g + years * g_rate), 1e-9 * (h + years * h_rate)
    rows = np.concatenate([np.stack([n, m, g], axis=1), np.stack([n, -m, h], axis=1)[m > 0]])
    tilt = _PRECESSION * (date - orbits.J2000)
    precession = np.array([[1.0, 0.0, -tilt], [0.0, 1.0, 0.0], [tilt, 0.0, 1.0]])
    of_date = orbits.vector_table(t, _positions(t) @ precession.T)
    field = orbits.earth_field(lambda s: (of_date(s), None), date, rows, radius=6371.2e3)
    return orbits.vector_table(t, np.asarray(jax.vmap(field)(jnp.asarray(t))) @ precession)


def _positions(t: np.ndarray) -> np.ndarray:
    """Positions (times, 3), in m, along the orbit about an oblate Earth."""
    from scipy.integrate import solve_ivp

    mu, J2, radius = orbits.EARTH_GM * 1e9, orbits.EARTH_J2, orbits.EARTH_RADIUS * 1e3

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        R = np.linalg.norm(y[:3])
        oblate = 1.5 * J2 * (radius / R) ** 2 * (np.array([1.0, 1.0, 3.0]) - 5 * (y[2] / R) ** 2)
        return np.concatenate([y[3:], -mu / R**3 * y[:3] * (1 + oblate)])

    return solve_ivp(rate, (t[0], t[-1]), _ORBIT, "DOP853", t, rtol=1e-12, atol=1e-6).y[:3].T


def start_of_case(field: Any) -> tuple[Array, Array]:
    """The attitude, and the angular velocity in the body, which is along the field: there control is weakest."""
    q = jnp.asarray(_ATTITUDE) / jnp.linalg.norm(jnp.asarray(_ATTITUDE))
    B = so3.Ad_star(q, field(0.0))
    return q, jnp.linalg.norm(jnp.asarray(_RATES)) * B / jnp.linalg.norm(B)


def commanded_dipole(gain: Array, B: Array, Omega: Array) -> Array:
    """k Ω × B/|B|², each component cut at its limit: the law of Avanzini & Giulietti 2012."""
    return jnp.clip(gain * jnp.cross(Omega, B) / jnp.dot(B, B), -jnp.asarray(_MAX_DIPOLE), jnp.asarray(_MAX_DIPOLE))


@partial(jax.jit, static_argnames="samples")
def _momenta(field: Any, q: Array, Omega: Array, gain: Array, samples: int) -> Array:
    """|JΩ| at every sample, (samples + 1,)."""
    inertia = jnp.asarray(_INERTIA)
    start = systems.TorquedBody(inertia, torques.Dipole(jnp.zeros(3), field)).state(q, angular_velocity=Omega, t=0.0)

    def sample(state: State, _: None) -> tuple[State, Array]:
        B = so3.Ad_star(state.q, field(state.t))
        spin = jnp.linalg.solve(inertia, so3.Ad_star(state.q, state.p))
        body = systems.TorquedBody(inertia, torques.Dipole(commanded_dipole(gain, B, spin), field))
        after, _info = schemes.torqued_midpoint(body)(state, _SAMPLING)
        return after, jnp.linalg.norm(after.p)

    _, momenta = jax.lax.scan(sample, start, None, samples)
    return jnp.concatenate([jnp.linalg.norm(start.p)[None], momenta])


@case("magnetic_detumbling", _SCHEME)
def magnetic_detumbling() -> dict[str, np.ndarray]:
    """The "B-cross" law with two gains, from a rotation about the field; the greater gain gets stuck there."""
    field = field_of_case()
    q, Omega = start_of_case(field)
    samples = np.round(3600 * _HOURS / _SAMPLING).astype(int)
    return {
        f"momentum for 1 h, gain {gain:g} N m s, mN m s": 1e3
        * np.asarray(_momenta(field, q, Omega, jnp.asarray(gain), int(samples[-1])))[samples]
        for gain in _GAINS
    }
