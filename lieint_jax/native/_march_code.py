"""`march` compiled: machine code that XLA calls on a CPU, or XLA's own loop."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr
from jax.interpreters import mlir

from lieint_jax._xla import unchecked
from lieint_jax.native._arrays import Flattened, computed_before, flatten
from lieint_jax.native._handler import handler
from lieint_jax.native._march import Deferred, Loop, Value, Values, by_xla, jaxpr_of, march_p, shape_of
from lieint_jax.native._primitives.abstract_walk import UnsupportedError, unsupported_if_it_fails
from lieint_jax.native._traced import Traced, make_once

_log = logging.getLogger(__name__)
_WIDEST = 160  # the most registers of 32 bits; a GPU's thread has 255, and the order of its instructions uses the rest
_MOST_CARRIED = 24  # the most numbers that an iteration of a loop reads and writes, and XLA may copy between kernels
_SHORT = 2e6  # the most operations of a call that runs in one thread: more threads would not make it faster
_SOME = 100  # steps of a row, if their number is not known here
_ALL = 2**30  # threads: as many as XLA's pool has
_EXPECTED = "chosen by li.engine or LIEINT_ENGINE", "no steps"  # reasons for XLA of which the log says nothing
ENGINES = ("native", "xla")
_FLAT = "flat"  # XLA's loop over arrays of the members, one for each number of a step: the one for accelerators
chosen_engine = jax.make_user_context(None)  # one of these, or None; JAX traces again where it differs
_chosen_threads = jax.make_user_context(None)  # a number, or None


class LoopCode:
    """The step of a loop as machine code that XLA calls by a name.

    Attributes:
        name: of the call.
        length: the number of operations of a step.
        pressure: how many numbers of a step are alive at once.
        lanes: the members of a vector.
        shared: about how many numbers of a step the members share.
        seconds: what it took to make, by "walk" and "llvm".
    """

    def __init__(self, body: _Body, kinds: Values, examples: Values):
        from lieint_jax.native import _machine
        from lieint_jax.native._pieces import modules

        begin = time.perf_counter()
        traced = Traced(jaxpr_of(body.step), kinds, examples)
        self._outside, self._leaves = traced.outside, traced.leaves
        with unsupported_if_it_fails():
            results = jax.tree.leaves(traced.results)
            sizes = [int(np.prod(x.shape)) for x in results[body.carried :]]
            pressure = traced.program.pressure() or sum(leaf.size for leaf in traced.leaves if leaf.varies)
            lanes = 1 if body.is_single else _machine.lanes(traced.leaves, pressure)
            texts, self.shared = modules(traced.program, traced.leaves, sizes, lanes, body.reverse)
            around = handler(len(traced.leaves) - 1, len(results), lanes)  # all but the counter are in memory
            walked = time.perf_counter()
            self.name = _machine.compile_handler(*texts, around)
        self.length, self.pressure, self.lanes = traced.length, pressure, lanes
        self.seconds = {"walk": walked - begin, "llvm": time.perf_counter() - walked}

    def more_arguments(self, arguments: Values, members: int | None) -> list[Value]:
        """What JAX computes before the loop, such as an eigendecomposition of the inertia, from its arguments."""
        return computed_before(self._outside, self._leaves, [None, *arguments], members)


class _Body(NamedTuple):
    """What machine code has of a loop; `is_single`: whether it has one member."""

    step: ClosedJaxpr | Deferred
    carried: int
    reverse: bool
    is_single: bool


def loop_code(loop: Loop) -> LoopCode:
    """The machine code of a loop, made once.

    Raises:
        ImportError: llvmlite is missing.
        UnsupportedError: its step is not a program of numbers.
    """
    _, of_fixed, of_rows = loop.split(loop.owns)
    kinds = [
        "counter",
        *["carry"] * loop.carried,
        *("member" if own else "shared" for own in of_fixed),
        *("series" if own else "row" for own in of_rows),
    ]
    body = _Body(loop.step, loop.carried, loop.reverse, loop.members in (None, 1))
    return make_once(LoopCode, body, kinds, [shape_of(x) for x in loop.step.in_avals])


def machine_code(loop: Loop) -> LoopCode | str:
    """The machine code of a loop, or why XLA runs it."""
    if engine_name() == "xla":
        return _EXPECTED[0]
    if not loop.rows or loop.every == 0:
        return _EXPECTED[1]
    try:
        return loop_code(loop)
    except (ImportError, UnsupportedError) as reason:
        return str(reason)


def flat_step(loop: Loop) -> Flattened | str:
    """The step of a loop on arrays of the members, one for each number, or why XLA's plain loop is better.

    XLA compiles the operations between two loops of the step into one kernel, if their numbers fit a GPU's registers.
    """
    kinds = ["shared", *("member" if own else "shared" for own in loop.owns)]  # the number of a step comes first
    try:
        flat = flatten(jaxpr_of(loop.step), kinds, [shape_of(x) for x in loop.step.in_avals])
    except UnsupportedError as reason:
        return str(reason)
    if flat.width > _WIDEST:
        return f"about {flat.width} registers, more than {_WIDEST}"
    if flat.carried > _MOST_CARRIED:
        return f"a loop with {flat.carried} numbers, more than {_MOST_CARRIED}"
    return flat


def _by_arrays(*arguments: Value, loop: Loop) -> list[Value]:
    """The loop by XLA, on flat arrays if that is better."""
    flat = "no members" if loop.members is None or engine_name() == "xla" else flat_step(loop)
    if isinstance(flat, str):
        _log.debug("XLA's plain loop: %s", flat)
        return by_xla(*arguments, loop=loop)
    return by_xla(*arguments, loop=loop, step=functools.partial(flat, members=loop.members))


def _compiled(*arguments: Value, loop: Loop) -> list[Value]:
    """The loop in machine code; by XLA if its step is not a program of numbers, or if the user wants it."""
    if engine_name() == _FLAT:
        return _by_arrays(*arguments, loop=loop)
    found = machine_code(loop)
    if isinstance(found, str):
        if found not in _EXPECTED:
            _say_once(found)
        return by_xla(*arguments, loop=loop)
    shapes = march_p.abstract_eval(*arguments, loop=loop)[0]
    members = loop.members or 1
    steps = loop.rows * (_SOME if loop.every is None else loop.every)
    threads = 1 if members * steps * found.length <= _SHORT else _chosen_threads.value or _ALL
    call = jax.ffi.ffi_call(found.name, [shape_of(x) for x in shapes])
    sizes = {"every": loop.every, "members": members, "stored": loop.rows, "threads": threads}
    if loop.every is None:  # the places of the arguments that they are
        sizes |= {"every": -1 - loop.carried, "stored": -2 - loop.carried}
    arguments = *arguments, *found.more_arguments(arguments, loop.members)
    return list(call(*arguments, **{name: np.int64(x) for name, x in sizes.items()}))


def engine_name() -> str:
    """The engine of loops that are lowered here."""
    found = chosen_engine.value or os.environ.get("LIEINT_ENGINE", ENGINES[0])
    if found not in (*ENGINES, _FLAT):
        raise ValueError(f"LIEINT_ENGINE must be one of {', '.join(ENGINES)}, got {found!r}")
    return found


@contextlib.contextmanager
def computed_by(engine: str, threads: int) -> Iterator[None]:
    """A context in which loops run by an engine, and machine code in so many threads."""
    with chosen_engine(engine), _chosen_threads(threads):
        yield


@functools.cache
def _say_once(reason: str) -> None:
    _log.warning("XLA runs a loop, which is slower than machine code: %s", reason)


def _lowering(function: Callable[..., list[Value]]) -> Callable[..., Any]:
    """The rule of a loop that `function` computes; it sees no types of arrays that differ between devices."""
    rule = mlir.lower_fun(function, multiple_results=True)

    def lower(ctx: mlir.LoweringRuleContext, *operands: Any, loop: Loop) -> Any:
        types: Any = ctx.avals_in, ctx.avals_out
        given, found = ([ShapedArray(x.shape, x.dtype) for x in of] for of in types)
        with unchecked():
            return rule(ctx.replace(avals_in=given, avals_out=found), *operands, loop=loop)

    return lower


mlir.register_lowering(march_p, _lowering(_compiled), platform="cpu")
mlir.register_lowering(march_p, _lowering(_by_arrays))
