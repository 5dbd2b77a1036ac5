"""What do loops of the package cost in users' own code: a run inside jit, its gradient, a short call, a first call?

CPU time of one core, contestants in turn in one process, the least of the rounds. Runs of 1000 members by
`li.run` and by `jax.jit(jax.vmap(integrate))`; gradients of a mean over their ends with respect to all numbers of
the step, such as the inertia, by undoing steps and by checkpoints (the default); the same of one body. Short calls, of
one step of free bodies, over a jitted addition; what the step itself takes is found from a longer run. First calls in
fresh processes with nothing cached; imports are not counted. Last, `li.fit` of the same function twice.

    python benchmarks/loops.py [--quick] [--out DIR]
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from lib import command, motions, report

DT = 0.05
STEPS = {  # of a run
    "free body, so3_midpoint": 2000,
    "heavy top, splitting": 2000,
    "heavy top, nystrom 6": 400,
    "satellite, three laws": 400,
    "two bodies, splitting": 200,
}
ALONE = ("free body, so3_midpoint", "heavy top, splitting")
VALUE, UNDONE, STORED = "integrate", "gradient by undoing", "gradient by checkpoints"
FIRST = {  # bars of first calls in seconds: of a value, and of a gradient
    "free body, so3_midpoint": (1.0, 2.5),
    "heavy top, splitting": (1.0, 2.5),
    "heavy top, nystrom 6": (3.0, 5.0),
    "satellite, three laws": (3.0, 8.0),
}
SIZES = (1, 64, 1000)  # members of a short call
MORE = 100  # steps of a longer run


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--first", nargs=2, metavar="NAME", help="a motion and what is computed, in this process")
    options = command.parsed(parser)
    command.pin()
    if options.first:
        print(json.dumps(first_call(*options.first)))
        return
    data = command.under_load(lambda: everything(options.quick))
    report.publish("loops", render(data), data, options.out)


def everything(quick: bool) -> dict[str, Any]:
    """All measurements."""
    from lib import measure

    cases = {name: (step, state) for name, step, state, _ in motions.cases() if name in STEPS}
    part, members, rounds = (20, 16, 1) if quick else (1, 1000, 5)
    names = ALONE if quick else STEPS
    return {
        "machine": measure.machine(),
        "many": [{"name": x, **time_members(*cases[x], STEPS[x] // part, members, rounds)} for x in names],
        "one": [
            {"name": x, **time_one_body(*cases[x], 1_000_000 // part**2, 100_000 // part**2, rounds)} for x in ALONE
        ],
        "short": short_calls(*cases[ALONE[0]], rounds),
        "first": [in_a_process(name, what) for name in FIRST if name in names for what in (VALUE, UNDONE, STORED)],
        "fit": fitted_twice(),
    }


def contestants(step: Any, state: Any, steps: int, is_one: bool = False) -> dict[str, Callable[..., Any]]:
    """Functions of (leaves of the step, momenta): the mean over the ends, and its gradients."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    structure = jax.tree.structure(step)

    def loss(leaves: Any, p: Any, adjoint: Any = None) -> Any:
        def end(p: Any) -> Any:
            own = jax.tree.unflatten(structure, leaves)
            return li.integrate(own, state._replace(p=p), DT, steps, save_every=steps, adjoint=adjoint).state.q[-1]

        return jnp.mean(end(p) if is_one else jax.vmap(end)(p))

    undoing = li.ReversibleAdjoint(1e300)
    return {
        VALUE: jax.jit(loss),
        UNDONE: jax.jit(jax.grad(lambda leaves, p: loss(leaves, p, undoing))),
        STORED: jax.jit(jax.grad(loss)),
    }


def arguments(step: Any, state: Any, members: int | None) -> tuple[Any, Any]:
    """The leaves of a step, and momenta of so many members, or of one body."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    leaves = [jnp.asarray(x) for x in jax.tree.leaves(step)]
    scales = np.linspace(0.9, 1.1, members or 1)
    p = jnp.asarray(scales.reshape(-1, *[1] * state.p.ndim) * np.asarray(state.p))
    return leaves, p if members else p[0]


def time_members(step: Any, state: Any, steps: int, members: int, rounds: int) -> dict[str, Any]:
    """Seconds of runs and gradients, and the engines."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    given = arguments(step, state, members)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), state)._replace(p=given[1])
    shared = states._replace(t=state.t)  # the time that the members share
    calls = contestants(step, state, steps)
    engines = {name: sorted({x.engine for x in li.explain(call, *given).loops}) for name, call in calls.items()}
    timed: dict[str, Callable[[], Any]] = {name: partial(call, *given) for name, call in calls.items()}
    timed["li.run"] = lambda: li.run(step, shared, DT, steps, progress=False, save_every=None).state.q
    return {"steps": steps, "members": members, "engines": engines, **command.least_cpu_times(timed, rounds)}


def time_one_body(step: Any, state: Any, steps: int, short: int, rounds: int) -> dict[str, Any]:
    """Seconds of a long run of one body, and of its gradient over fewer steps."""
    import jax

    import lieint_jax as li

    member = jax.tree.map(lambda x: x[None], state)
    calls = contestants(step, state, short, is_one=True)
    given = arguments(step, state, None)
    timed: dict[str, Callable[[], Any]] = {name: partial(call, *given) for name, call in calls.items()}
    timed["long run"] = lambda: li.integrate(step, state, DT, steps, save_every=steps).state.q
    timed["li.run"] = lambda: li.run(step, member, DT, steps, progress=False, save_every=None).state.q
    return {"steps": steps, "short": short, **command.least_cpu_times(timed, rounds)}


def short_calls(step: Any, state: Any, rounds: int, calls: int = 500) -> list[dict[str, Any]]:
    """Microseconds of a jitted call of one step, of an addition and of a step in a longer run, by number of members."""
    import jax

    def repeated(function: Callable[..., Any], *given: Any) -> Callable[[], Any]:
        def call() -> Any:
            for _ in range(calls - 1):
                function(*given).block_until_ready()
            return function(*given)

        return call

    runs = {"empty": jax.jit(lambda _, p: p + 1)}
    runs |= {name: contestants(step, state, steps)[VALUE] for name, steps in (("ours", 1), ("longer", MORE + 1))}
    found = []
    for members in SIZES:
        given = arguments(step, state, members)
        least = command.least_cpu_times({name: repeated(run, *given) for name, run in runs.items()}, rounds)
        each = {name: x / calls * 1e6 for name, x in least.items()}
        each["step"] = (each["longer"] - each["ours"]) / MORE
        found.append({"members": members, **each})
    return found


def of_call(x: dict[str, float]) -> float:
    """What a call takes beside an addition and the step."""
    return x["ours"] - x["empty"] - x["step"]


def first_call(name: str, what: str) -> dict[str, float]:
    """CPU seconds of the first and of the second call."""
    import jax

    jax.config.update("jax_enable_x64", True)
    step, state = next((step, state) for x, step, state, _ in motions.cases() if x == name)
    given = arguments(step, state, 100)
    call = contestants(step, state, 200)[what]
    seconds = []
    for _ in range(2):
        begin = time.process_time()
        jax.block_until_ready(call(*given))
        seconds.append(time.process_time() - begin)
    return dict(zip(("first", "second"), seconds, strict=True))


def in_a_process(name: str, what: str) -> dict[str, Any]:
    """What `first_call` measures, the least of two fresh processes."""
    command_line = [sys.executable, __file__, "--first", name, what]
    runs = [subprocess.run(command_line, check=True, stdout=subprocess.PIPE, text=True).stdout for _ in range(2)]
    return {"name": name, "what": what, **min(map(json.loads, runs), key=lambda x: x["first"])}


def fitted_twice() -> dict[str, float]:
    """CPU seconds of a fit of a body's inertia to its attitudes, and of the same function with other data."""
    import jax.numpy as jnp

    import lieint_jax as li

    def attitudes(J: Any) -> Any:
        body = li.systems.RigidBody(J)
        start = body.state(angular_velocity=jnp.array([0.2, 0.1, 1.0]))
        return li.integrate(li.schemes.so3_midpoint(body), start, DT, 100, save_every=10).state.q

    def residuals(J: Any, data: Any) -> Any:
        return (attitudes(J) - data).ravel()

    seconds = []
    for shift in (0.0, 0.01):
        data = attitudes(jnp.array([1.0, 2.0, 2.5 + shift]))
        begin = time.process_time()
        li.fit(residuals, jnp.array([1.1, 2.1, 2.4]), data=data, progress=False)
        seconds.append(time.process_time() - begin)
    return dict(zip(("first", "again"), seconds, strict=True))


def render(data: dict[str, Any]) -> list[str]:
    """The tables; * where a bar is missed."""

    def over(value: float, bar: float) -> str:
        return f"{value:.2f}{' *' * (value > bar)}"

    runs = [
        [
            f"{x['name']}{'' if x['engines'][UNDONE] == ['native'] else ' (not machine code)'}",
            f"{x['members'] * x['steps'] / x[VALUE] / 1e6:.1f}",
            over(x[VALUE] / x["li.run"], 1.2),
            over(x[UNDONE] / x[VALUE], 6),
            over(x[STORED] / x[VALUE], 8 if "free" in x["name"] else 6),
        ]
        for x in data["many"]
    ]
    alone = [
        [
            x["name"],
            over(x["long run"] / x["li.run"], 1.2),
            *(over(x[way] / x[VALUE], 12) for way in (UNDONE, STORED)),
        ]
        for x in data["one"]
    ]
    first = [
        [x["name"], x["what"], over(x["first"], FIRST[x["name"]][x["what"] != VALUE]), f"{x['second']:.4f}"]
        for x in data["first"]
    ]
    short = [
        [*(f"{x[name]:.4g}" for name in ("members", "empty", "ours", "step")), over(of_call(x), 15)]
        for x in data["short"]
    ]
    fit = data["fit"]
    return [
        report.machine(data) + ", load {:.1f} to {:.1f}; * above the bar".format(*data["load"]),
        f"Runs of {data['many'][0]['members']} members. Bars: 1.2 × `li.run`; gradients 6 × the run (free bodies "
        "by checkpoints 8)",
        report.table(["", "million steps a second", "÷ li.run", "by undoing ÷ run", "by checkpoints ÷ run"], runs),
        f"One body: {data['one'][0]['steps']} steps, gradients {data['one'][0]['short']}. Bars: 1.2 × `li.run`; "
        "gradients 12 × the run",
        report.table(["", "÷ li.run", "by undoing ÷ run", "by checkpoints ÷ run"], alone),
        "A call of one step, microseconds. Bar: 15 over an addition and the step",
        report.table(["members", "addition", "one step", "in a longer run", "difference"], short),
        "First calls in fresh processes, CPU seconds. Bars: values 1 s (3 s), gradients 2.5, 2.5, 5 and 8 s",
        report.table(["", "", "first", "second"], first),
        f"`li.fit`: {fit['first']:.2f} s, again {fit['again']:.3f} s: {over(fit['again'] / fit['first'], 0.2)} of it, "
        "bar 0.2",
    ]


if __name__ == "__main__":
    main()
