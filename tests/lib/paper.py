"""The paper's formulas in its own letters, on numpy matrices: the other side of the comparisons. Nothing of ours."""

import numpy as np

ONE = np.eye(3)


def close(a, b):
    """The largest difference."""
    return np.max(np.abs(np.asarray(a) - np.asarray(b)))


def hat(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rot(M):
    return np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) / 2


def skew(M):
    return (M - M.T) / 2


def cay(Theta):
    """(2.5)"""
    return (ONE + hat(Theta) / 2) @ np.linalg.inv(ONE - hat(Theta) / 2)


def exp(Theta):
    """(2.3)"""
    t = np.linalg.norm(Theta)
    return np.cos(t) * ONE + np.sin(t) / t * hat(Theta) + (1 - np.cos(t)) / t**2 * np.outer(Theta, Theta)


def T(alpha, Theta):
    """(2.20)"""
    return np.linalg.inv(ONE - alpha * hat(Theta)) @ (ONE + (1 - alpha) * hat(Theta))


def omega(pi):
    """(2.9)"""
    return np.block([[hat(pi), ONE], [-ONE, 0 * ONE]])


def omega_inverse(pi):
    return np.block([[0 * ONE, -ONE], [ONE, hat(pi)]])


KAPPAS = {
    "cayley": (lambda x: 1.0, lambda x: 0.0),
    "exponential": (
        lambda x: np.tan(np.sqrt(x) / 2) / (np.sqrt(x) / 2),
        lambda x: (1 / (2 * np.cos(np.sqrt(x) / 2) ** 2) - np.tan(np.sqrt(x) / 2) / np.sqrt(x)) / x,
    ),
    "symplectic": (lambda x: 2 / (1 + np.sqrt(1 - x)), lambda x: 1 / (np.sqrt(1 - x) * (1 + np.sqrt(1 - x)) ** 2)),
}  # κ and κ′


def H_cay(Theta):
    """D cay(Θ)·δΘ = cay(Θ) (H δΘ)^"""
    return np.linalg.inv((ONE - hat(Theta) / 2 + np.outer(Theta, Theta) / 4).T)  # (3.20)


def P(name, bar):
    """ℙ of (3.20)"""
    kappa, slope = (f(bar @ bar) for f in KAPPAS[name])
    return kappa * ONE + 2 * slope * np.outer(bar, bar)


def H(name, bar):
    """H of (3.19): the derivative of Θ̄ ↦ cay[κ Θ̄], left-trivialized"""
    kappa = KAPPAS[name][0](bar @ bar)
    return H_cay(kappa * bar) @ P(name, bar)


def mu(name, bar):
    """(3.23)"""
    x = bar @ bar
    kappa, slope = (f(x) for f in KAPPAS[name])
    return (1 - 2 * slope * (4 + kappa**2 * x) / (kappa**3 + 2 * kappa**2 * x * slope)) / 4
