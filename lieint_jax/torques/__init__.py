"""Laws of torque for `systems.torqued_body`: they can be added, and a step counts the work of each to round-off.

| law | torque | its work W in a step of `schemes.torqued_midpoint` |
|---|---|---|
| `viscous` | −DΩ in the body | −Δt Ω̄·DΩ̄ |
| `gravity_gradient` | 3μ/r³ r̂ × Jr̂ along an orbit | the change of its potential with time |
| `dipole` | m × b of a moment that is fixed in the body | the same |
| `potential` | Γ × ∇V of any V(Γ, t) | the same |
| `wheels` | −(Ω × h_r + dh_r/dt), h_r = Σ g_j h_j | Σ Δh_j σ̄_j of the motors |
| `kane_damper` | −c(ω − ω_d), ω_d of a sphere inside | −Δt c\\|ω̄ − ω̄_d\\|² |
| `bdot` | −k(\\|b\\|²ω − b(b·ω)) in a field b(t), with or without a limit | −Δt k\\|b × ω̄\\|², never positive |
| `eddy_current` | M(Ω × B) × B of a conducting body in a field | −Δt (Ω̄ × B̄)·M(Ω̄ × B̄), never positive |
| `hysteresis` | a magnetic rod: F(w) e × b with a play operator | that of the field, less ρ\\|ΔF(w)\\| |
| `pd_trace`, `pd_quaternion` | proportional-derivative control, which unwinds or not | −Δt c\\|ω̄\\|² |
| `pointing`, `sliding_mode` | control to a frame that moves, such as `orbits.lvlh` | Δt Ω̄·T̄ |
| `torquers`, `unloading` | m × b of torquers that carry out a control law, that unload wheels | the same |
| `solar_plate`, `solar_plates` | r × F(s) of flat plates, s the direction of the Sun | the same |
| `aerodynamic` | r × F(v) of flat plates in a thin atmosphere | the same |
| `thruster` | constant T in the body, in a time window | the same |
| `sampled` | any control law, at the samples of a digital controller | Δt Ω̄·T of the torque held |
| `saturated` | any of them, cut at a limit | Δt Ω̄·T̄ and the change of its energy |
| `windowed` | any of them, in a window of time | Δt Ω̄·T̄ |

`a + b` and `total` add laws, plain functions (t, q, Ω) ↦ T too. A bar on Ω or ω is the step's own angular velocity,
J⁻¹ of the mean body momentum; on T, the mean torque of the step. The energy H of the body contains the energies of its
laws (potentials, wheels, a damper's sphere), and H − ΣW is conserved to round-off. A law of your own is a class with a
`mean`: see `Law`. `internal_friction` is that of `systems.damped_body`. For wheels: `body_inertia`, `wheel_pyramid`,
`allocation`, and `wheel_motor`, whose motors carry out a control law; for plates: `box_plates`.
"""

from lieint_jax._discover import publish as _publish

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
