"""Measurements of what a scheme conserves, by autodiff and by running it, never by a formula of the scheme.

| | |
|---|---|
| `certify` | all of it from one state, with verdicts: energy, momentum, form, order, reversibility |
| `energy_error`, `momentum_error`, `constraint_error` | along a trajectory |
| `linearization`, `symplectic_defect`, `poisson_error` | Lₙ of a step by `jacfwd`, and the symplectic form by it |
| `order`, `local_error`, `reversibility` | accuracy by runs with several step sizes, in one step, and the way back |
| `flow` | the motion by collocation of order 16, to compare with |
| `lyapunov`, `megno`, `section`, `delay` | chaos: exponents, MEGNO, Poincaré sections, delay plots |
| `conditions` | the residuals of the paper's own conditions, by equation number |
"""

from lieint_jax.diagnostics._certify import Certificate, certify
from lieint_jax.diagnostics._chaos import Lyapunov, Megno, lyapunov, megno, section
from lieint_jax.diagnostics._conditions import Conditions, conditions
from lieint_jax.diagnostics._local_error import local_error
from lieint_jax.diagnostics._order import flow, order, reversibility
from lieint_jax.diagnostics._poisson import poisson_error
from lieint_jax.diagnostics._series import constraint_error, delay, energy_error, momentum_error
from lieint_jax.diagnostics._symplectic import linearization, symplectic_defect
from lieint_jax.diagnostics._thermal import ThermalCertificate

__all__ = [
    "Certificate",
    "Conditions",
    "Lyapunov",
    "Megno",
    "ThermalCertificate",
    "certify",
    "conditions",
    "constraint_error",
    "delay",
    "energy_error",
    "flow",
    "linearization",
    "local_error",
    "lyapunov",
    "megno",
    "momentum_error",
    "order",
    "poisson_error",
    "reversibility",
    "section",
    "symplectic_defect",
]
