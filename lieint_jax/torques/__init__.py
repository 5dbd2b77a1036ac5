"""Laws of torque for `systems.torqued_body`: they add, and a step books the work of each to round-off.

| law | torque | its work W in a step of `schemes.torqued_midpoint` |
|---|---|---|
| `viscous` | −DΩ in the body | −Δt Ω̄·DΩ̄ |
| `gravity_gradient` | 3μ/r³ r̂ × Jr̂ along an orbit | the change of its potential with time |
| `dipole` | m × b of a moment that is fixed in the body | the same |
| `potential` | Γ × ∇V of any V(Γ, t) | the same |
| `wheels` | −(Ω × h_r + dh_r/dt), h_r = Σ g_j h_j | Σ Δh_j σ̄_j of the motors |
| `kane_damper` | −c(ω − ω_d), ω_d of a sphere inside | −Δt c\\|ω̄ − ω̄_d\\|² |
| `bdot` | −k(\\|b\\|²ω − b(b·ω)) in a field b(t), with or without a limit | −Δt k\\|b × ω̄\\|², never positive |
| `hysteresis` | a magnetic rod: F(w) e × b with a play operator | that of the field, less ρ\\|ΔF(w)\\| |
| `pd_trace`, `pd_quaternion` | proportional-derivative control, which unwinds or not | −Δt c\\|ω̄\\|² |
| `solar_plate` | r × F(s) of a flat plate, s the direction of the Sun | Δt Ω̄·T̄ |
| `thruster` | constant T in the body, in a time window | the same |
| `saturated` | any of them, cut at a limit | Δt Ω̄·T̄ and the change of its energy |

`a + b` and `total` add laws, plain functions (t, q, Ω) ↦ T too. A bar on Ω or ω is the step's own angular velocity,
J⁻¹ of the mean body momentum; on T, the mean torque of the step. The energy H of the body contains the energies of its
laws (potentials, wheels, a damper's sphere), and H − ΣW is conserved to round-off. A law of your own is a class with a
`mean`: see `Law`. `internal_friction` is that of `systems.damped_body`; `body_inertia` is for wheels.
"""

from lieint_jax.torques._control import PDQuaternion, PDTrace, Saturated, pd_quaternion, pd_trace, saturated
from lieint_jax.torques._damping import KaneDamper, Viscous, internal_friction, kane_damper, viscous
from lieint_jax.torques._magnetic import BDot, Hysteresis, LimitedBDot, bdot, hysteresis
from lieint_jax.torques._potential import (
    AnyPotential,
    Dipole,
    DirectionalPotential,
    GravityGradient,
    dipole,
    gravity_gradient,
    potential,
)
from lieint_jax.torques._surfaces import SolarPlate, solar_plate
from lieint_jax.torques._thruster import Thruster, thruster
from lieint_jax.torques._wheels import Wheels, body_inertia, wheels
from lieint_jax.types import Law, Rotation, total

__all__ = [
    "AnyPotential",
    "BDot",
    "Dipole",
    "DirectionalPotential",
    "GravityGradient",
    "Hysteresis",
    "KaneDamper",
    "Law",
    "LimitedBDot",
    "PDQuaternion",
    "PDTrace",
    "Rotation",
    "Saturated",
    "SolarPlate",
    "Thruster",
    "Viscous",
    "Wheels",
    "bdot",
    "body_inertia",
    "dipole",
    "gravity_gradient",
    "hysteresis",
    "internal_friction",
    "kane_damper",
    "pd_quaternion",
    "pd_trace",
    "potential",
    "saturated",
    "solar_plate",
    "thruster",
    "total",
    "viscous",
    "wheels",
]
