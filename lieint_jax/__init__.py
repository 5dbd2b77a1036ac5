"""Conserving time integrators for Hamiltonian systems on Lie groups, in JAX.

A system and a scheme make a step; a step makes everything else.

    import lieint_jax as li

    body = li.systems.rigid_body(inertia=[1.0, 2.0, 3.0])
    step = li.schemes.so3_midpoint(body, kappa=li.maps.kappa_symplectic)
    state = body.state(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.0, 1.0])
    state, info = step(state, 0.05)

float64 is the user's choice: `jax.config.update("jax_enable_x64", True)`.
"""

from lieint_jax import (
    adjoints,
    diagnostics,
    ensemble,
    fitting,
    groups,
    maps,
    orbits,
    phase_spaces,
    potentials,
    schemes,
    studies,
    systems,
    torques,
    types,
)
from lieint_jax._version import __version__
from lieint_jax.integrate import Event, event, integrate, interpolate
from lieint_jax.types import State, Step, StepInfo, Trajectory, pytree, static

__all__ = [
    "Event",
    "State",
    "Step",
    "StepInfo",
    "Trajectory",
    "__version__",
    "adjoints",
    "diagnostics",
    "ensemble",
    "event",
    "fitting",
    "groups",
    "integrate",
    "interpolate",
    "maps",
    "orbits",
    "phase_spaces",
    "potentials",
    "pytree",
    "schemes",
    "static",
    "studies",
    "systems",
    "torques",
    "types",
]


def __dir__() -> list[str]:
    return sorted(__all__)
