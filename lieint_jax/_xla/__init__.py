"""All hints that the package gives to XLA beyond the formulas.

A scheme consists of the equations of one body, and the machine code of ensembles (`native`) needs nothing more. XLA,
which runs what has no machine code, handles the same equations well with these exceptions.

`materialized`: On a CPU, XLA's fusion computes a shared subexpression again in each of its consumers. This is expensive
    where a long computation has a few results with many uses: without `materialized`, gradients of a batch by `exact`
    are 9 times as slow, and tangent vectors of a batch of tops 16 times. It is not used where it gains less than 20 %.
`materialized_arrays`, `with_materialized_derivatives`: The same for whole arrays, at the end of each step: for the
    results of `Step.tangent`, and for derivatives in forward mode through a step, which without it are 5 to 20 times as
    slow in a batch.
`unfused`: The same for data that all members of a batch share, such as the position on an orbit.
`rematerialized`, with `saved`: The gradient of a long loop stores the intermediate values of its
    body, about a hundred arrays over the steps, written one number at a time. Computing a step again in the backward
    pass is faster, compiles in half of the time and needs hardly any memory. Values that are expensive to compute
    again, such as a root, are saved.
`forward_mode`: A long function of a few numbers, such as an elliptic integral, has a short derivative in forward mode,
    a long one in reverse mode, and none in reverse mode if it is a `while_loop`. So it is always differentiated in
    forward mode.

`differ`, `with_common_axes`, `result_like`, `unchecked`: Inside `jax.shard_map` the types of arrays say between which
    devices they differ. A loop of the package has them, the step that it repeats is traced without.
`with_common_mesh`, `axis_spread`: Over a mesh of explicit axes the types of arrays say over which devices they are
    spread.

`reads`, `rereading_jit`, `remembered`, `Kept`, `shapes_now`: Where a user has not written `jit`, a program that is kept
    for a function is made again when the function reads other values than before.

`compiled` is `jax.jit` with options that halve the compile time of the package's own programs; `jit` is the same for
those of users.
"""

from lieint_jax._xla._compile import compiled, jit
from lieint_jax._xla._forward_mode import forward_mode, jvp_of_varied
from lieint_jax._xla._materialize import (
    materialized,
    materialized_arrays,
    rematerialized,
    saved,
    unfused,
    with_materialized_derivatives,
)
from lieint_jax._xla._reads import Kept, reads, remembered, rereading_jit, shapes_now
from lieint_jax._xla._varying import axis_spread, differ, result_like, unchecked, with_common_axes, with_common_mesh

__all__ = [
    "Kept",
    "axis_spread",
    "compiled",
    "differ",
    "forward_mode",
    "jit",
    "jvp_of_varied",
    "materialized",
    "materialized_arrays",
    "reads",
    "rematerialized",
    "remembered",
    "rereading_jit",
    "result_like",
    "saved",
    "shapes_now",
    "unchecked",
    "unfused",
    "with_common_axes",
    "with_common_mesh",
    "with_materialized_derivatives",
]
