"""One step of one body as a program of numbers, compiled for the members of an ensemble.

A jaxpr is walked (`_walk`; what each primitive adds is in `_primitives`) into a program of single numbers with real
loops (`_program`). In a long program operations along an axis of bodies or elements are a loop over its rows
(`_primitives/parallel`). On a CPU LLVM compiles it with a vector of members for each number (`_emit`, `_machine`),
together with the elementary functions that it calls (`functions`); both are written as text of LLVM IR (`_llvm`). A
separate program first computes what all members share in a step, such as the position on an orbit (`_pieces`). On a GPU
Triton compiles the whole loop as one kernel (`_kernel`).

`march` (`_march`) is a loop over steps as a primitive of JAX, whose machine code XLA calls.
"""

from lieint_jax.native._explain import Explanation, LoopReport, explain
from lieint_jax.native._march import Loop, hoisted, march
from lieint_jax.native._march_code import computed_by, engine, engine_name, loops_of, machine_code, warn_once
from lieint_jax.native._primitives.abstract_walk import UnsupportedError, unsupported_if_it_fails
from lieint_jax.native._scan import scan
from lieint_jax.native._traced import make_once
from lieint_jax.native._walk import expanded

__all__ = [
    "Explanation",
    "Loop",
    "LoopReport",
    "UnsupportedError",
    "computed_by",
    "engine",
    "engine_name",
    "expanded",
    "explain",
    "hoisted",
    "loops_of",
    "machine_code",
    "make_once",
    "march",
    "scan",
    "unsupported_if_it_fails",
    "warn_once",
]
