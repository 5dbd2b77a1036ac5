"""`march` compiled: machine code that XLA calls on a CPU, a kernel on a GPU, or XLA's own loop."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import ArrayMapping, SdyShardingRule, custom_partitioning
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters import mlir
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lieint_jax._xla import unchecked
from lieint_jax.native._arrays import computed_before
from lieint_jax.native._kernel import KernelCode
from lieint_jax.native._march import AnyArray, AnyArrays, Arrays, Deferred, Loop, by_xla, jaxpr_of, march_p, shape_of
from lieint_jax.native._pieces import modules
from lieint_jax.native._primitives.abstract_walk import UnsupportedError, unsupported_if_it_fails
from lieint_jax.native._primitives.control_flow import jaxprs_of
from lieint_jax.native._traced import Traced, make_once

try:
    from jax._src.dispatch import prim_requires_devices_during_lowering as _of_devices  # no public name
except ImportError:  # then members are gathered
    _of_devices = set()
_log = logging.getLogger(__name__)
Places = Sequence[int | None]  # of the axis of members in each array, if it has one
_SHORT = 2e6  # the most operations of a call that runs in one thread: more threads would not make it faster
_SOME = 100  # steps of a row, if their number is not known here
_ALL = 2**30  # threads: as many as XLA's pool has
_EXPECTED = (
    "chosen by li.engine or LIEINT_ENGINE",
    "no steps or no members",
)  # reasons for XLA of which the log says nothing
NO_COMPILER = "llvmlite, the compiler of machine code, is not installed (pip install llvmlite)"
ENGINES = ("native", "xla")
_KERNEL = "kernel"  # on a GPU the one for "native", too; on a CPU it is interpreted, for tests
_chosen_engine = jax.make_user_context(None)  # one of these, or None; JAX traces again where it differs
_chosen_threads = jax.make_user_context(None)  # a number, or None


class LoopCode:
    """The step of a loop as machine code that XLA calls.

    Args:
        body: the step, its number of carries, and whether the last step comes first, the loop has one member, and it
            is one step.
        kinds: those of the arguments of the step; see `Traced`.

    Attributes:
        engine: its name.
        target, kernel: what XLA calls, and with which code.
        length: the number of operations of a step.
        pressure: how many numbers of a step are alive at once.
        lanes: the members of a vector.
        shared: about how many numbers of a step the members share.
        seconds: what it took to make, by "walk" and "llvm".
    """

    engine = ENGINES[0]

    def __init__(self, body: tuple[ClosedJaxpr | Deferred, int, bool, bool, bool], kinds: Sequence[str], _: AnyArrays):
        step, carried, reverse, is_single, runs_once = body
        try:
            from lieint_jax.native import _machine
        except (ImportError, OSError) as error:  # missing, or a library that this machine cannot load
            raise ImportError(NO_COMPILER) from error

        begin = time.perf_counter()
        traced = Traced(jaxpr_of(step), kinds, with_maps=True, runs_once=runs_once)
        self._outside, self._leaves = traced.outside, traced.leaves
        with unsupported_if_it_fails():
            results = step.out_avals
            sizes = [int(np.prod(x.shape)) for x in results[carried:]]
            lanes = 1 if is_single else _machine.lanes(traced.leaves, traced.pressure)
            of_rows = _machine.lanes(traced.leaves) if is_single else 0
            texts, self.shared = modules(traced.program, traced.leaves, sizes, lanes, reverse, of_rows)
            walked = time.perf_counter()
            inputs = len(traced.leaves) - 1  # all but the counter are in memory
            self.kernel, self.target = _machine.kernel(texts, inputs, len(results), lanes), _machine.TARGET
        self.length, self.pressure, self.lanes = traced.length, traced.pressure, lanes
        self.seconds = {"walk": walked - begin, "llvm": time.perf_counter() - walked}

    def call(self, arguments: AnyArrays, loop: Loop, is_spread: bool = False) -> Arrays:
        """The carries after the last step and the stored rows; if it `is_spread`, by each device those of its part."""
        arrays, count = list(arguments), len(arguments)
        if self._outside:
            arrays += computed_before(self._outside, self._leaves, [None, *arguments], loop.members)
        if loop.members is None or not is_spread:
            return self._call(loop, arrays, loop.members)
        places = [int(loop.is_series(k)) if own else None for k, own in enumerate(loop.owns)]
        places += [0 if leaf.varies else None for leaf in self._leaves[1 + count :]]
        of_results = [int(k >= loop.carried) for k in range(len(loop.step.out_avals))]
        return _spread(functools.partial(self._call, loop), loop.members, arrays, places, of_results)

    def _call(self, loop: Loop, arrays: AnyArrays, members: int | None) -> Arrays:
        """The results for so many members, from the arguments and what was computed before."""
        shapes = march_p.abstract_eval(*arrays[: len(loop.owns)], loop=loop._replace(members=members))[0]
        members = members or 1
        steps = loop.rows * (_SOME if loop.every is None else loop.every)
        threads = 1 if members * steps * self.length <= _SHORT else _chosen_threads.value or _ALL
        sizes = {"every": loop.every, "members": members, "stored": loop.rows, "threads": threads}
        if loop.every is None:  # the places of the arguments that they are
            sizes |= {"every": -1 - loop.carried, "stored": -2 - loop.carried}
        call = jax.ffi.ffi_call(self.target, [shape_of(x) for x in shapes])
        numbers = {name: np.int64(x) for name, x in sizes.items()}
        return list(call(*arrays, kernel=self.kernel.name, **numbers))


def _spread(
    call: Callable[[AnyArrays, int], Arrays], members: int, arrays: AnyArrays, places: Places, of_results: Places
) -> Arrays:
    """call(arrays, members), in which each device has the part of the members that XLA gives it."""

    def partition(mesh: Mesh, given: AnyArrays, found: AnyArrays) -> tuple[Any, ...]:
        axes = _axes_of_members(mesh, [*found, *given], [*of_results, *places])
        part = -(-members // math.prod(mesh.shape[x] for x in axes))
        own, of_arrays = ([NamedSharding(mesh, _spec(axes, place)) for place in of] for of in (of_results, places))
        return mesh, lambda *arrays: call(arrays, part), own, tuple(of_arrays)

    function = custom_partitioning(lambda *arrays: call(arrays, members))
    function.def_partition(
        partition,
        decode_shardings=False,
        sharding_rule=lambda mesh, given, found: _rule([*given, *found], [*places, *of_results], len(given)),
    )
    return list(function(*arrays))


def _rule(types: AnyArrays, places: Places, inputs: int) -> SdyShardingRule:
    """Only the axis of members may be spread, and is in all arrays alike."""
    names = map("x{}".format, itertools.count())
    dims = [
        ["members" if k == place else next(names) for k in range(x.rank)]
        for x, place in zip(types, places, strict=True)
    ]
    whole = tuple(x for each in dims for x in each if x != "members")
    maps = [ArrayMapping(*x) for x in dims]
    return SdyShardingRule(tuple(maps[:inputs]), tuple(maps[inputs:]), need_replication_factors=whole)


def _spec(axes: tuple[str, ...], place: int | None) -> PartitionSpec:
    return PartitionSpec() if place is None else PartitionSpec(*[None] * place, axes)


def _axes_of_members(mesh: Mesh, arrays: AnyArrays, places: Places) -> tuple[str, ...]:
    """The axes of the mesh over which one of these arrays spreads its members; none if they are parts of axes."""
    names = mesh.axis_names
    choices = [x for k in range(len(names)) for x in itertools.permutations(names, k + 1)]
    for x, place in zip(arrays, places, strict=True):
        for axes in choices if place is not None else ():
            if NamedSharding(mesh, _spec(axes, place)).is_equivalent_to(x.sharding, len(x.shape)):
                return axes
    return ()


def machine_code(loop: Loop, platform: str = "cpu") -> LoopCode | KernelCode | str:
    """The code of a loop, made once: machine code on a CPU, a kernel on a GPU; or why XLA runs it."""
    chosen = engine_name()
    if chosen == "xla":
        return _EXPECTED[0]
    if 0 in (loop.rows, loop.every, loop.members):
        return _EXPECTED[1]
    if platform not in ("cpu", "gpu"):
        return f"a {platform} is no CPU and no GPU"
    _, of_fixed, of_rows = loop.split(loop.owns)
    kinds = [
        "counter",
        *["carry"] * loop.carried,
        *("member" if own else "shared" for own in of_fixed),
        *("series" if own else "row" for own in of_rows),
    ]
    shapes = [shape_of(x) for x in loop.step.in_avals]
    try:
        if platform != "cpu" or chosen == _KERNEL:
            return make_once(KernelCode, loop.step, kinds, shapes)
        is_single, runs_once = loop.members in (None, 1), (loop.rows, loop.every) == (1, 1)
        body = loop.step, loop.carried, loop.reverse, is_single, runs_once
        return make_once(LoopCode, body, kinds, shapes)
    except (ImportError, UnsupportedError) as reason:  # no llvmlite, or on a GPU no Pallas; no program of numbers
        return str(reason)


def loops_of(closed: ClosedJaxpr | Jaxpr) -> Iterator[Loop | None]:
    """The loops of a jaxpr; None for one of XLA's own."""
    jaxpr: Any = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
    for equation in jaxpr.eqns:
        if equation.primitive is march_p:
            yield equation.params["loop"]
            continue
        inner = [x for jaxpr in jaxprs_of(equation.params) for x in loops_of(jaxpr)]
        yield from inner
        if equation.primitive.name in ("while", "scan") and not any(inner):
            yield None


def _compiled(*arguments: AnyArray, loop: Loop, platform: str, is_spread: bool) -> Arrays:
    """The loop in its own code; by XLA if its step is not a program of numbers, or if the user wants it."""
    found = machine_code(loop, platform)
    if isinstance(found, str):
        if found not in _EXPECTED:
            warn_once("a loop", found)
        return by_xla(*arguments, loop=loop)
    if isinstance(found, KernelCode):
        return found.call(arguments, loop, interpret=platform == "cpu")
    return found.call(arguments, loop, is_spread)


def engine_name() -> str:
    """The engine of loops that are lowered here."""
    found = _chosen_engine.value or os.environ.get("LIEINT_ENGINE", ENGINES[0])
    if found not in (*ENGINES, _KERNEL):
        raise ValueError(f"LIEINT_ENGINE must be one of {', '.join(ENGINES)}, got {found!r}")
    return found


def engine(name: Literal["native", "xla"]) -> contextlib.AbstractContextManager[Any]:
    """A context in which loops run in machine code ("native", the default) or by XLA ("xla").

    JAX traces and compiles a function again for each engine. The environment variable LIEINT_ENGINE sets the default.
    `jax.export` needs "xla".

    Raises:
        ValueError: there is no such engine.

    Example:
        >>> import lieint_jax as li
        >>> with li.engine("xla"):
        ...     end, _ = li.scan(lambda x, _: (x / 2, None), 1.0, length=3)
        >>> float(end)
        0.125
    """
    if name not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)}, got {name!r}")
    return _chosen_engine(name)


@contextlib.contextmanager
def computed_by(engine: str, threads: int) -> Iterator[None]:
    """A context in which loops run by an engine, and machine code in so many threads."""
    with _chosen_engine(engine), _chosen_threads(threads):
        yield


@functools.cache
def warn_once(what: str, reason: str) -> None:
    """Let the log name once why XLA runs it; without llvmlite once for everything."""
    if reason == NO_COMPILER and what != "every loop":
        warn_once("every loop", reason)
    else:
        _log.warning("XLA runs %s, which is slower than machine code: %s", what, reason)


def _lower(ctx: mlir.LoweringRuleContext, *operands: Any, loop: Loop, platform: str = "") -> Any:
    """The rule of a loop; what it lowers sees no types of arrays that differ between devices."""
    function = by_xla
    if platform:
        axes: Any = ctx.module_context.axis_context
        on_mesh = getattr(axes, "abstract_mesh", None) is not None and axes.num_devices > 1
        is_spread = on_mesh and getattr(jax.config, "jax_use_shardy_partitioner", True)
        function = functools.partial(_compiled, platform=platform, is_spread=is_spread)
    types: Any = ctx.avals_in, ctx.avals_out
    given, found = ([ShapedArray(x.shape, x.dtype) for x in of] for of in types)
    with unchecked(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The Pallas Triton backend", DeprecationWarning)
        rule = mlir.lower_fun(function, multiple_results=True)
        lowered = rule(ctx.replace(avals_in=given, avals_out=found), *operands, loop=loop)
    if platform == "cpu" and isinstance(code := machine_code(loop), LoopCode):
        ctx.module_context.add_keepalive(code.kernel)  # until XLA's program holds it
    return lowered


_of_devices.add(march_p)  # JAX lowers it for the devices of a mesh, which its rule sees in the context
mlir.register_lowering(march_p, _lower)
for _platform in ("cpu", "gpu"):
    mlir.register_lowering(march_p, functools.partial(_lower, platform=_platform), platform=_platform)
