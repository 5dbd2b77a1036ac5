"""`explain`: which engine runs the loops of a function, and why."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, overload

import jax

from lieint_jax.native._march import Loop
from lieint_jax.native._march_code import ENGINES, loops_of, machine_code


class LoopReport(NamedTuple):
    """A loop of a function.

    Attributes:
        kind: "values", or "tangents", in forward mode.
        reverse: whether the last step comes first, as in reverse mode.
        steps: the number of steps; None if it is an argument of the loop.
        members: the number of members that run at once; 1 if the loop has no axis of members.
        engine: "native" (machine code), "kernel" (of a GPU) or "xla".
        reason: why it is XLA's loop; empty if it is not.
        operations: the number of operations of a step, 0 in XLA's loop.
        numbers: how many numbers of a step are alive at once; those beyond the processor's registers go to memory.
        lanes: the members of a vector.
        shared: how many numbers of a step the members share, such as a position on an orbit; computed once for all.
        seconds: what making the machine code took, once in this process: "walk" (from JAX's program to numbers), "llvm"
            (less from a cache on disk).
    """

    kind: str
    reverse: bool
    steps: int | None
    members: int
    engine: str
    reason: str
    operations: int
    numbers: int
    lanes: int
    shared: int
    seconds: dict[str, float]


@dataclass(frozen=True)
class Explanation(Sequence[LoopReport]):
    """The loops of a function, a sequence of them, and the seconds until its first result. `print` shows a table.

    Attributes:
        loops: the loops in machine code or by `march`, in order, each different one once.
        others: how many other loops there are, which XLA runs, such as those of `jax.lax.scan`.
        seconds: "trace" (JAX's, of the whole function) and "xla" (lowering and compiling it, with the loops made).
    """

    loops: tuple[LoopReport, ...]
    others: int
    seconds: dict[str, float]

    @property
    def engines(self) -> set[str]:
        """The engines of the loops: {"native"} if all of them are machine code."""
        return {loop.engine for loop in self.loops} | ({"xla"} if self.others else set())

    @overload
    def __getitem__(self, k: int) -> LoopReport: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[LoopReport, ...]: ...
    def __getitem__(self, k: int | slice) -> LoopReport | tuple[LoopReport, ...]:
        return self.loops[k]

    def __len__(self) -> int:
        return len(self.loops)

    def __str__(self) -> str:
        lines = [f"trace {self.seconds['trace']:.2f} s, XLA {self.seconds['xla']:.2f} s"]
        for x in self.loops:
            steps = "some" if x.steps is None else x.steps
            line = f"{x.kind}{', backward' * x.reverse}: {steps} steps, members {x.members}, {x.engine}"
            if x.engine != "xla":
                made = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in x.seconds.items())
                code = f"operations {x.operations}, alive at once {x.numbers}, lanes {x.lanes}, shared {x.shared}"
                line += f", {code}, {made}"
            lines.append(line + (f" ({x.reason})" if x.reason else ""))
        return "\n".join([*lines, *([f"other loops, by XLA: {self.others}"] if self.others else [])])


def explain(f: Callable[..., Any], *args: Any) -> Explanation:
    """Which engine runs each loop of a function, and why; for derivatives, explain `jax.grad(f)`.

    Args:
        f: a function of arrays, that may be jitted, vmapped or differentiated.
        args: its arguments, or their shapes as `jax.ShapeDtypeStruct`.

    Returns:
        An `Explanation`. The function is traced and compiled, but not called.

    Example:
        >>> import jax, lieint_jax as li
        >>> def run(x):
        ...     return li.scan(lambda x, _: (3.2 * x * (1 - x), None), x, length=100)[0]
        >>> found = li.explain(jax.vmap(run), jax.ShapeDtypeStruct((1000,), "float32"))
        >>> [(loop.kind, loop.steps, loop.members, loop.operations) for loop in found]
        [('values', 100, 1000, 3)]
    """
    begin = time.perf_counter()
    traced = jax.jit(lambda *given: f(*given)).trace(*args)  # else JAX may return what it has traced before
    seconds = {"trace": time.perf_counter() - begin}
    found = list(loops_of(traced.jaxpr))
    reports = tuple(_report(loop) for loop in dict.fromkeys(x for x in found if x is not None))
    begin = time.perf_counter()
    traced.lower().compile()
    return Explanation(reports, found.count(None), seconds | {"xla": time.perf_counter() - begin})


def _report(loop: Loop) -> LoopReport:
    found = machine_code(loop, jax.default_backend())
    steps = None if loop.every is None else loop.steps
    what = "values" if loop.origin is None else "tangents", loop.reverse, steps, loop.members or 1
    if isinstance(found, str):
        return LoopReport(*what, ENGINES[1], found, 0, 0, 0, 0, {})
    code = found.length, found.pressure, found.lanes, found.shared, found.seconds
    return LoopReport(*what, found.engine, "", *code)
