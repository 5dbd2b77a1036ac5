"""What XLA is given beyond formulas: all of it stands here.

A scheme is the equations of one body, and machine code of ensembles (`native`) needs nothing more. XLA, which runs
single bodies, gradients and accelerators, does well with the same equations but for four things.

`materialized`: On a CPU, XLA's fusion computes a shared subexpression again in each of its consumers. Where a long
    computation has a few results with many uses, that is dear: without it gradients of a batch by `exact` take nine
    times as long, tangent vectors of a batch of tops sixteen times. Where less than a fifth was lost it is not used.
`unfused`: The same for what all members of a batch share, such as the position on an orbit.
`rematerialized`, with `saved` and `scan_stages`: The gradient of a long loop keeps what its body computes, a hundred
    arrays over the steps, written one number at a time. To compute a step again on the way back is faster, compiles in
    half of the time and takes hardly any memory; what is dear to compute again, such as a root, is saved.
`forward_mode`: A long function of a few numbers, such as an elliptic integral, has a short derivative forwards, a long
    one in reverse, and none in reverse if it is a loop that ends by a test. So it is derived forwards, whoever asks.

`compiled` is `jax.jit` with options by which the package's own programs compile in half of the time.
"""

from lieint_jax._xla._compile import compiled
from lieint_jax._xla._forward_mode import forward_mode
from lieint_jax._xla._materialize import materialized, unfused
from lieint_jax._xla._rematerialize import rematerialized, saved, scan_stages

__all__ = ["compiled", "forward_mode", "materialized", "rematerialized", "saved", "scan_stages", "unfused"]
