"""Measurements of what a scheme conserves, by autodiff and by runs, never by a formula of the scheme.

| | |
|---|---|
| `certify` | all conservation properties from one state, with verdicts: energy, momentum, form, order, reversibility |
| `linearization`, `symplectic_defect`, `poisson_error` | Lₙ of a step by `jacfwd`, and whether it is symplectic |
| `order`, `local_error`, `reversibility` | accuracy of runs, and of one step; time symmetry |
| `round_trip_error` | how far a run of steps of dt and as many of −dt ends from its start |
| `flow` | the motion by collocation of order 16, as a reference |
| `RungeKutta`, `step_cost` | a step that conserves nothing, to compare with; the seconds that a step takes |
| `lyapunov`, `megno`, `section` | chaos: exponents, MEGNO, Poincaré sections |
| `exponents_of_flow`, `exponent_of_neighbors` | exponents without the tangent flow of a step, to verify them |
| `modified_energy` | the first terms of the Hamiltonian that a symplectic splitting conserves |
| `equilibrium`, `normal_modes` | relative equilibria, frequencies of small oscillations, stability with its margin |
| `group_conservation`, `random_geodesic` | what each map conserves on a matrix group, over random metrics |
| `conditions` | the residuals of the paper's own conditions, by equation number |
"""

from lieint_jax.diagnostics._certify import Certificate, certify
from lieint_jax.diagnostics._chaos import lyapunov, megno, section
from lieint_jax.diagnostics._conditions import conditions
from lieint_jax.diagnostics._equilibrium import equilibrium
from lieint_jax.diagnostics._group_conservation import group_conservation, random_geodesic
from lieint_jax.diagnostics._local_error import local_error
from lieint_jax.diagnostics._modified_energy import modified_energy
from lieint_jax.diagnostics._neighbors import exponent_of_neighbors, exponents_of_flow
from lieint_jax.diagnostics._normal_modes import normal_modes
from lieint_jax.diagnostics._order import flow, order, reversibility, round_trip_error
from lieint_jax.diagnostics._poisson import poisson_error
from lieint_jax.diagnostics._runge_kutta import RungeKutta, step_cost
from lieint_jax.diagnostics._symplectic import linearization, symplectic_defect

__all__ = [
    "Certificate",
    "RungeKutta",
    "certify",
    "conditions",
    "equilibrium",
    "exponent_of_neighbors",
    "exponents_of_flow",
    "flow",
    "group_conservation",
    "linearization",
    "local_error",
    "lyapunov",
    "megno",
    "modified_energy",
    "normal_modes",
    "order",
    "poisson_error",
    "random_geodesic",
    "reversibility",
    "round_trip_error",
    "section",
    "step_cost",
    "symplectic_defect",
]
__dir__ = __all__.copy
