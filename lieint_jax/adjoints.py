"""Derivatives of whole runs: in reverse mode, by checkpoints or by undoing steps; transition matrices and covariance.

Which derivative to use, for N steps, p parameters and a loss or m residuals:

| derivative | how | time, in forward runs | memory |
|---|---|---|---|
| forward | `jax.jvp`, `jax.jacfwd` through `integrate` | 1.5 to 2.3 for p = 1 | none |
| reverse, by checkpoints | `jax.grad` through `integrate` | 3.5 to 5.5, for any p | about 2√N states |
| reverse, by undoing steps | `adjoint=ReversibleAdjoint()` | 3.5 to 5, for any p | the saved states |
| a Hessian times a vector | `jax.jvp` of `jax.grad` | 9 to 14; 7 to 9 by undoing steps | as the gradient |
| a tangent flow | `transition`: step by step, by `Step.tangent` | 1 + its dimension | none |

The times were measured on a CPU, in machine code, for 1000 free bodies and tops and 256 satellites. An adjoint is an
option of `integrate(…, save_every=…, adjoint=…)`. `reversible` and `observe` undo steps by default; with
`derivative="checkpoint"` they have checkpoints.

* Few parameters, or residuals of least squares: forward mode, as in `fit` with "levenberg_marquardt".
* Many parameters and a scalar: reverse mode, by checkpoints, for any step. It alone supports reverse over reverse.
* A run so long that 2√N states are too many: `ReversibleAdjoint`. The step must be symmetric, as are all steps of the
  package except `additive(…, "symplectic", alpha)`, `so3_alpha` and `group_alpha` for α ≠ ½ (see `step.symmetric`), and
  neighboring trajectories must not separate so fast that steps cannot be undone (see `round_trip_error`; a warning
  reports it). Where e^(λt) exceeds 1/eps, no derivative is meaningful.

All agree to round-off, since they are derivatives of the same discrete flow. On a chaotic motion they agree as long as
the trajectory itself is accurate.
"""

from lieint_jax.runs import (
    Adjoint,
    Ellipse,
    RecursiveCheckpointAdjoint,
    ReversibleAdjoint,
    Transition,
    observe,
    reversible,
    round_trip_error,
    transition,
)

__all__ = [
    "Adjoint",
    "Ellipse",
    "RecursiveCheckpointAdjoint",
    "ReversibleAdjoint",
    "Transition",
    "observe",
    "reversible",
    "round_trip_error",
    "transition",
]
