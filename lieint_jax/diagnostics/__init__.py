"""Measurements of what a scheme conserves, by autodiff and by runs, never by a formula of the scheme.

| | |
|---|---|
| `certify` | all conservation properties from one state, with verdicts: energy, momentum, form, order, reversibility |
| `energy_error`, `momentum_error`, `constraint_error` | along a trajectory |
| `linearization`, `symplectic_defect`, `poisson_error` | Lₙ of a step by `jacfwd`, and whether it is symplectic |
| `order`, `local_error`, `reversibility` | accuracy of runs, and of one step; time symmetry |
| `flow` | the motion by collocation of order 16, as a reference |
| `lyapunov`, `megno`, `section`, `delay` | chaos: exponents, MEGNO, Poincaré sections, delay plots |
| `modified_energy` | the first terms of the Hamiltonian that a symplectic splitting conserves |
| `equilibrium`, `normal_modes` | relative equilibria, frequencies of small oscillations, stability with its margin |
| `conditions` | the residuals of the paper's own conditions, by equation number |
"""

from lieint_jax.diagnostics._certify import Certificate, certify
from lieint_jax.diagnostics._chaos import Lyapunov, Megno, lyapunov, megno, section
from lieint_jax.diagnostics._conditions import Conditions, conditions
from lieint_jax.diagnostics._equilibrium import Equilibrium, equilibrium
from lieint_jax.diagnostics._local_error import local_error
from lieint_jax.diagnostics._modified_energy import modified_energy
from lieint_jax.diagnostics._normal_modes import NormalModes, normal_modes
from lieint_jax.diagnostics._order import flow, order, reversibility
from lieint_jax.diagnostics._poisson import poisson_error
from lieint_jax.diagnostics._series import constraint_error, delay, energy_error, momentum_error
from lieint_jax.diagnostics._symplectic import linearization, symplectic_defect
from lieint_jax.diagnostics._thermal import ThermalCertificate

__all__ = [
    "Certificate",
    "Conditions",
    "Equilibrium",
    "Lyapunov",
    "Megno",
    "NormalModes",
    "ThermalCertificate",
    "certify",
    "conditions",
    "constraint_error",
    "delay",
    "energy_error",
    "equilibrium",
    "flow",
    "linearization",
    "local_error",
    "lyapunov",
    "megno",
    "modified_energy",
    "momentum_error",
    "normal_modes",
    "order",
    "poisson_error",
    "reversibility",
    "section",
    "symplectic_defect",
]
