"""Equations of motion of rigid bodies in numpy, for DOP853 of scipy: the other side of comparisons. Nothing of ours."""

import numpy as np


def in_space(q, v):
    """Λv for a quaternion (w, x, y, z)."""
    return v + 2 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)


def in_body(q, v):
    """Λᵀv."""
    return in_space(q * [1, -1, -1, -1], v)


def quaternion_rate(q, Omega):
    """q̇ at the angular velocity Ω in the body."""
    return 0.5 * np.concatenate([[-q[1:] @ Omega], q[0] * Omega + np.cross(q[1:], Omega)])


def euler(J, torque):
    """The rates of y = (q, Ω) by Euler's equations, under torque(t, q, Ω) in the body."""

    def rate(t, y):
        q, Omega = y[:4], y[4:]
        return np.concatenate([quaternion_rate(q, Omega), (torque(t, q, Omega) - np.cross(Omega, J * Omega)) / J])

    return rate


def satellite(t, y, J, mu):
    """The rates of y = (Λ, Ω, r, v): Euler's equations with MacCullagh's torque, and the center's own motion."""
    R, Omega, r, v = y[:9].reshape(3, 3), y[9:12], y[12:15], y[15:]
    size, Gamma = np.linalg.norm(r), R.T @ r
    turning = np.stack([np.cross(row, Omega) for row in R])
    torque = 3 * mu / size**5 * np.cross(Gamma, J * Gamma)
    return np.concatenate([turning.ravel(), (np.cross(J * Omega, Omega) + torque) / J, v, -mu * r / size**3])
