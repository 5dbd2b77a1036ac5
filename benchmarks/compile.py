"""How long does one wait for the first call: of a run, and of its gradient, by every scheme on every kind of system?

For each kind of system and every scheme, the first example that the scheme takes, float64, one core, no program kept
from before: seconds of the first call of `jax.jit` of `integrate` (tracing and compiling, then 16 steps) and of the
second one, each the shorter of two, and the lines of the program that XLA compiles; the same for the gradient of a sum
over the end with respect to the state, through the scan. Then first and second calls of both by `li.jit`, and of
`integrate` by itself, outside of jit. Last, other calls that people wait for.

    python benchmarks/compile.py [--quick] [--out DIR] [--only NAME …]

`--only so3_midpoint gauss` measures these schemes.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from lib import command, report

STEPS, FORWARD, REVERSE, COMMON = 16, 3.5, 10.0, 0.5  # steps of a run; bars in seconds
LATER = 50  # calls after the first, where the host's part of a call is measured
_EVERYDAY = ("so3_midpoint", "so3_explicit", "splitting", "preprocessed")  # of free bodies and tops: the common ones
_FIRST = ("rigid_body", "heavy_top")


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="the schemes to measure")
    options = command.parsed(parser)
    command.pin()
    data = command.under_load(lambda: {"rows": list(rows(options.quick, options.only)), "others": others()})
    report.publish("compile", render(data), data, options.out)


def rows(quick: bool, only: list[str] | None) -> Iterator[dict[str, Any]]:
    """A row for each system and scheme; `quick` takes free bodies and tops."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li
    from lieint_jax import _discover

    jax.config.update("jax_enable_x64", True)
    for name, module in _discover.modules_with("examples", li.systems).items():
        if quick and name not in _FIRST:
            continue
        examples = list(module.examples().values())
        for scheme, schemes in _discover.modules_with("examples", li.schemes).items():
            if only and scheme not in only:
                continue
            for step, state, dt in itertools.islice(accepted_steps(schemes, examples), 1):
                start = step.start(state)

                def run(z: Any, step: Any = step, dt: float = dt) -> Any:
                    return li.integrate(step, z, dt, STEPS, save_every=STEPS).state

                def loss(p: Any, z: Any = start, run: Any = run) -> Any:
                    return sum(jnp.sum(x**2) for x in run(z._replace(p=p))[:2])

                gradient = jax.grad(loss)
                yield {
                    "system": name,
                    "scheme": scheme,
                    "step": step.name,
                    "forward": of_program(run, start),
                    "reverse": of_program(gradient, start.p),
                    "quick forward": waited(functools.partial(li.jit(run), start)),
                    "quick reverse": waited(functools.partial(li.jit(gradient), start.p)),
                    "all states": waited(functools.partial(li.integrate, step, start, dt, STEPS)),
                    "last state": waited(functools.partial(run, start)),
                }


def accepted_steps(scheme: Any, examples: Iterable[tuple[Any, Any, float]]) -> Iterator[tuple[Any, Any, float]]:
    """A step by the scheme, a state and Δt, for each example that the scheme takes."""
    for system, state, dt in examples:
        for step in scheme.examples(system).values():
            yield step, state, dt


def waited(call: Callable[[], Any], later: int = 1) -> dict[str, float]:
    """Seconds of the first call and of the shortest of `later` ones, each the shorter of two: timings are noisy."""
    import jax

    def seconds() -> float:
        begin = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(call()))
        return time.perf_counter() - begin

    def time_twice() -> tuple[float, float]:
        jax.clear_caches()
        return seconds(), min(seconds() for _ in range(later))

    first, second = map(min, zip(time_twice(), time_twice(), strict=True))
    return {"first": first, "second": second}


def of_program(function: Callable[[Any], Any], argument: Any) -> dict[str, float]:
    """What one waits for a jitted function, and the lines of its program."""
    import jax

    compiled = jax.jit(function)
    return {**waited(lambda: compiled(argument)), "lines": compiled.lower(argument).as_text().count("\n")}


def others() -> list[dict[str, Any]]:
    """Other calls: the closed form of many bodies, an unjitted run, ensembles (their later calls cost the host)."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li
    from lieint_jax import _discover

    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(jnp.eye(4, 3) + 0.1)
    one = jax.tree.map(lambda x: x[0], states)
    step, solution = li.schemes.so3_midpoint(body), jax.jit(jax.vmap(body.solution, (0, None)))
    run = functools.partial(li.ensemble.run, num_steps=STEPS, progress=False)
    modules = functools.partial(_discover.modules_with, "examples")
    satellite = modules(li.systems)["gravity_gradient"].examples().values()
    orbiting, start, dt = next(accepted_steps(modules(li.schemes)["splitting"], satellite))
    satellites = jax.tree.map(lambda x: jnp.stack([x] * 4), orbiting.start(start))

    calls = {
        "integrate, not jitted": lambda: li.integrate(step, one, 0.05, STEPS),
        "ensemble.run": lambda: run(step, states, 0.05),
        "ensemble.run, the range of the energy": lambda: run(step, states, 0.05, reduce="energy"),
        "ensemble.run, satellites on an orbit": lambda: run(orbiting, satellites, dt),
        "body.solution, vmapped": lambda: solution(states, 1.0),
    }
    return [{"call": name, **waited(call, LATER)} for name, call in calls.items()]


def render(data: dict[str, Any]) -> list[str]:
    """The tables and the bars."""
    before, after = data["load"]
    head = ["system", "step", "forward: first", "second", "lines", "reverse: first", "second", "lines"]
    ours = ["system", "step", "`li.jit`, forward: first", "second", "reverse: first", "second"]
    ours += ["`integrate`, all states: first", "second", "the last one: first", "second"]
    everyday = [r for r in data["rows"] if r["system"] in _FIRST and r["scheme"] in _EVERYDAY]
    bars = [
        _bar("forward", data["rows"], "forward", FORWARD),
        _bar("reverse", data["rows"], "reverse", REVERSE),
        _bar("forward by `li.jit`", data["rows"], "quick forward", FORWARD),
        _bar("reverse by `li.jit`", data["rows"], "quick reverse", REVERSE),
        _bar("`integrate`, all states", data["rows"], "all states", FORWARD),
        _bar("`integrate`, the last state", data["rows"], "last state", FORWARD),
        _bar("forward, the common schemes of free bodies and tops", everyday, "forward", COMMON),
    ]
    others = [[r["call"], f"{r['first']:.2f}", f"{1e3 * r['second']:.1f} ms"] for r in data["others"]]
    return [
        f"Seconds of the first and second call of {STEPS} steps, one core, load {before:.1f} to {after:.1f}",
        "By `jax.jit`, with the options of the user's XLA",
        report.table(head, _lines(data["rows"], "forward", "reverse")),
        "By the package's own options: by `li.jit`, and by `integrate` outside of jit",
        report.table(ours, _lines(data["rows"], "quick forward", "quick reverse", "all states", "last state")),
        report.table(["", "longest, s", "of", "bar", ""], [bar for bar in bars if bar]),
        f"Other calls, seconds of the first and of the shortest of {LATER} later ones",
        report.table(["", "first", "later"], others),
    ]


def _lines(rows: list[dict[str, Any]], *ways: str) -> list[list[str]]:
    return [[r["system"], r["step"], *(x for way in ways for x in _cells(r[way]))] for r in rows]


def _cells(waited: dict[str, float]) -> list[str]:
    times = [f"{waited['first']:.2f}", f"{waited['second']:.4f}"]
    return [*times, f"{waited['lines']:.0f}"] if "lines" in waited else times


def _bar(name: str, rows: list[dict[str, Any]], way: str, bar: float) -> list[str]:
    if not rows:
        return []
    worst = max(rows, key=lambda r: r[way]["first"])
    seconds = worst[way]["first"]
    verdict = report.verdict(seconds, seconds <= bar)
    return [name, f"{seconds:.2f}", f"{worst['system']}, {worst['step']}", f"≤ {bar:g}", verdict]


if __name__ == "__main__":
    main()
