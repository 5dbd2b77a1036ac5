"""Two bodies under gravity to second order by DOP853, on equations of motion that share nothing with the package."""

import jax
import numpy as np
from scipy.integrate import solve_ivp

from lieint_jax.groups import so3


def rates(t, y, m, J, G):
    """The equations of motion of two bodies, from their textbook form, for (x, Λ, p, Π) of each."""
    x, R, p, Pi = y[:6].reshape(2, 3), y[6:24].reshape(2, 3, 3), y[24:30].reshape(2, 3), y[30:].reshape(2, 3)
    d = x[1] - x[0]
    r = np.linalg.norm(d)
    force, torque = -G * m[0] * m[1] * d / r**3, np.zeros((2, 3))  # on the second
    for i in range(2):
        other, Gamma = m[1 - i], R[i].T @ d
        JG = J[i] * Gamma
        force += G * other * (7.5 * (Gamma @ JG) * d / r**7 - 1.5 * J[i].sum() * d / r**5 - 3 * R[i] @ JG / r**5)
        torque[i] = 3 * G * other / r**5 * np.cross(Gamma, JG)
    w = Pi / J
    R_dot = [np.cross(R[i], w[i]) for i in range(2)]  # RŴ, row by row
    Pi_dot = [np.cross(Pi[i], w[i]) + torque[i] for i in range(2)]
    return np.concatenate([(p / m[:, None]).ravel(), np.ravel(R_dot), -force, force, np.ravel(Pi_dot)])


def reference(bodies, state, t, rtol=1e-12, atol=1e-13):
    """Positions (2, 3) and rotations (2, 3, 3) after the time t, computed in the pair's own units.

    These are the distance, the mass of both and the time √(d³/GM): there the tolerances mean digits.
    """
    (q, p), m, J = (np.array(x) for x in state[:2]), np.array(bodies.masses), np.array(bodies.inertias)
    length, mass = np.linalg.norm(q[1, :3] - q[0, :3]), m.sum()
    time = np.sqrt(length**3 / (float(bodies.potential.G) * mass))
    R = np.array(jax.vmap(so3.to_matrix)(q[:, 3:]))
    Pi = np.einsum("nji,nj->ni", R, p[:, 3:])
    y = [q[:, :3] / length, R, p[:, :3] * time / (mass * length), Pi * time / (mass * length**2)]
    end = solve_ivp(
        rates,
        (0, t / time),
        np.concatenate([np.ravel(x) for x in y]),
        "DOP853",
        rtol=rtol,
        atol=atol,
        args=(m / mass, J / (mass * length**2), 1.0),
    ).y[:, -1]
    return end[:6].reshape(2, 3) * length, end[6:24].reshape(2, 3, 3)
