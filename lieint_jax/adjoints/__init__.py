"""Derivatives of whole runs: in reverse mode, by undoing steps or by checkpoints; transition matrices and covariance.

Which derivative to use, for N steps, p parameters and a loss or m residuals:

| derivative | how | time, in forward runs | memory |
|---|---|---|---|
| forward | `jax.jvp`, `jax.jacfwd` through `integrate` | about 1 + p | none |
| reverse, by undoing steps | `adjoint=ReversibleAdjoint()` | 4 to 9, for any p | the saved states |
| reverse, by checkpoints | `adjoint=RecursiveCheckpointAdjoint()` | 6 to 18, for any p | about 3 N^(1/3) states |
| reverse, through the scan | `jax.grad` through `integrate` | 10 and more | data of all N steps |
| a Hessian times a vector | `jax.jvp` of `jax.grad` through `reversible`, `observe` | about 40 | the saved states |
| a tangent flow | `transition`: step by step, by `Step.tangent` | 1 + its dimension | none |

An adjoint is an option of `integrate(…, save_every=…, adjoint=…)`. `reversible` and `observe` have the same two
derivatives: the first by default, the second with `derivative="checkpoint"`.

* Few parameters, or residuals of least squares: forward mode, as in `fit` with "levenberg_marquardt".
* Many parameters and a scalar: `ReversibleAdjoint`. The step must be symmetric, as are all steps of the package except
  `additive(…, "symplectic", alpha)`, `so3_alpha` and `group_alpha` for α ≠ ½ (see `step.symmetric`).
* A step that is not symmetric, or a motion whose neighboring trajectories separate so fast that steps cannot be undone
  (see `round_trip_error`; a warning reports it): checkpoints. Where e^(λt) exceeds 1/eps, no derivative is meaningful.
* Short runs: the scan itself, which is simplest, and the only one that supports reverse over reverse.

All agree to round-off, since they are derivatives of the same discrete flow. On a chaotic motion they agree as long as
the trajectory itself is accurate.
"""

from lieint_jax._integrate import Adjoint
from lieint_jax.adjoints._observe import observe
from lieint_jax.adjoints._options import RecursiveCheckpointAdjoint, ReversibleAdjoint
from lieint_jax.adjoints._reversible import reversible, round_trip_error
from lieint_jax.adjoints._transition import Ellipse, Transition, transition

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
