"""Hamiltonian systems. Each has `state(…)`, which returns a state from attitude and angular velocity.

Stored energies of a `pseudo_rigid_body` and an `incompressible_body` are `mooney_rivlin`, `neo_hookean`,
`saint_venant_kirchhoff`, `self_gravity`, or any function. Integrals and closed forms to test with: `lagrange_motion`,
`is_lagrange_top`, `pendulum_as_top`, `kovalevskaya_integral`, `clebsch_integral`, `manakov_integrals`,
`kirchhoff_spin`, `maclaurin_spheroid`, `maclaurin_modes`, and `body.solution(state, t)` of a `rigid_body`.
`tumbling_state` is the state of a free body with given mean periods.
The section of a `rod` is a `circular_section`, a `rectangular_section`, or any other stiffness.
Each module has `examples()`: systems with a state worth integrating and a time step.

Your own system inherits equations of motion, by which schemes know it: it subclasses a system, or `Equations` that
several systems share, the `Abstract…` classes. The decorator `equation` marks the methods that it must not override.

`catalogue()` lists what each conserves, with its phase space, names in the literature and source. They model:
"""

from lieint_jax._discover import publish as _publish
from lieint_jax.systems._catalogue import catalogue

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
__doc__ = f"{__doc__}\n{catalogue().markdown(columns=2)}\n"
