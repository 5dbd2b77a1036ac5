"""One step of one body as a program of numbers, compiled for the members of an ensemble.

A jaxpr is walked (`_walk`; what each primitive adds is in `_primitives`) into a program of single numbers with real
loops (`_program`). On a CPU LLVM compiles it with a vector of members for each number (`_emit`, `_machine`), and
threads run it over blocks of members (`_kernel`). A separate program first computes what all members share in a step,
such as the position on an orbit (`_stream`). For an accelerator XLA compiles it with an array of all members for each
number (`_arrays`).

`march` (`_march`) is a loop over steps as a primitive of JAX, whose machine code XLA calls.
"""

from lieint_jax.native._arrays import Flattened, flatten
from lieint_jax.native._explain import Explanation, LoopReport, explain
from lieint_jax.native._kernel import Kernel, kernel
from lieint_jax.native._march import hoisted, march
from lieint_jax.native._primitives.abstract_walk import UnsupportedError, unsupported_if_it_fails
from lieint_jax.native._scan import engine, scan
from lieint_jax.native._traced import make_once

__all__ = [
    "Explanation",
    "Flattened",
    "Kernel",
    "LoopReport",
    "UnsupportedError",
    "engine",
    "explain",
    "flatten",
    "hoisted",
    "kernel",
    "make_once",
    "march",
    "scan",
    "unsupported_if_it_fails",
]
