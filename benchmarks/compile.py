"""How long does one wait for the first call: of a run, and of its gradient, by every scheme on every kind of system?

For each kind of system and every scheme, the first example that the scheme takes, float64, one core, in a fresh process
with nothing cached: CPU seconds of the first call of `jax.jit` of `integrate` (tracing and compiling, then 16 steps)
and of the second one; the same for `integrate` by itself, outside of jit, and for the gradient of a sum over the end
with respect to the state, through the scan, by `jax.jit` and by `li.jit`. Last, other calls that people wait for.

    python benchmarks/compile.py [--quick] [--out DIR] [--only NAME …]

`--only so3_midpoint gauss` measures these schemes.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable
from typing import Any

from lib import command, report
from lib.pairs import example, in_a_process, pairs

STEPS, FORWARD, REVERSE, COMMON = 16, 3.5, 10.0, 0.5  # steps of a run; bars in seconds
WAYS = ("forward", "all states", "reverse", "quick reverse")
LATER = 50  # calls after the first, where the host's part of a call is measured
_EVERYDAY = ("so3_midpoint", "so3_explicit", "splitting", "preprocessed")  # of free bodies and tops: the common ones
_FIRST = ("rigid_body", "heavy_top")


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="the schemes to measure")
    parser.add_argument("--one", nargs=4, metavar="NAME", help="way, system, scheme and step: measured in this process")
    options = command.parsed(parser)
    command.pin()
    if options.one:
        print(json.dumps(of_pair(*options.one)))
        return
    data = command.under_load(lambda: {"rows": rows(options.quick, options.only), "others": others()})
    report.publish("compile", render(data), data, options.out)


def rows(quick: bool, only: list[str] | None) -> list[dict[str, Any]]:
    """A row for each system and scheme, each way in a process of its own; `quick` takes free bodies and tops."""
    found = [x for x in pairs(_FIRST if quick else ()) if not only or x[1] in only]
    return [
        {"system": x[0], "scheme": x[1], "step": x[2]} | {way: in_a_process(__file__, way, *x) for way in WAYS}
        for x in found
    ]


def of_pair(way: str, *names: str) -> dict[str, float]:
    """CPU seconds of the first and the second call, in one of the ways."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    step, start, dt = example(*names)

    def run(z: Any) -> Any:
        return li.integrate(step, z, dt, STEPS, save_every=STEPS).state

    def loss(p: Any) -> Any:
        return sum(jnp.sum(x**2) for x in run(start._replace(p=p))[:2])

    gradient = jax.grad(loss)
    calls = {
        "forward": functools.partial(jax.jit(run), start),
        "all states": functools.partial(li.integrate, step, start, dt, STEPS),
        "reverse": functools.partial(jax.jit(gradient), start.p),
        "quick reverse": functools.partial(li.jit(gradient), start.p),
    }
    return waited(calls[way])


def waited(call: Callable[[], Any], later: int = 1) -> dict[str, float]:
    """CPU seconds of the first call and of the shortest of `later` ones."""
    import jax

    def seconds() -> float:
        begin = time.process_time()
        jax.block_until_ready(jax.tree.leaves(call()))
        return time.process_time() - begin

    first = seconds()
    return {"first": first, "second": min(seconds() for _ in range(later))}


def others() -> list[dict[str, Any]]:
    """Other calls: the closed form of many bodies, an unjitted run, ensembles (their later calls cost the host)."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(jnp.eye(4, 3) + 0.1)
    one = jax.tree.map(lambda x: x[0], states)
    step, solution = li.schemes.so3_midpoint(body), jax.jit(jax.vmap(body.solution, (0, None)))
    run = functools.partial(li.run, num_steps=STEPS, save_every=None, progress=False)
    orbiting, start, dt = example(*next(x for x in pairs(("gravity_gradient",)) if x[1] == "splitting"))
    satellites = jax.tree.map(lambda x: jnp.stack([x] * 4), start)

    calls = {
        "integrate, not jitted": lambda: li.integrate(step, one, 0.05, STEPS),
        "li.run": lambda: run(step, states, 0.05),
        "li.run, the range of the energy": lambda: run(step, states, 0.05, reduce="energy"),
        "li.run, satellites on an orbit": lambda: run(orbiting, satellites, dt),
        "body.solution, vmapped": lambda: solution(states, 1.0),
    }
    return [{"call": name, **waited(call, LATER)} for name, call in calls.items()]


def render(data: dict[str, Any]) -> list[str]:
    """The tables and the bars."""
    before, after = data["load"]
    head = ["system", "step", "forward", "second", "`integrate`", "second"]
    head += ["reverse", "second", "by `li.jit`", "second"]
    everyday = [r for r in data["rows"] if r["system"] in _FIRST and r["scheme"] in _EVERYDAY]
    bars = [
        _bar("forward", data["rows"], "forward", FORWARD),
        _bar("reverse", data["rows"], "reverse", REVERSE),
        _bar("reverse by `li.jit`", data["rows"], "quick reverse", REVERSE),
        _bar("`integrate`, outside of jit", data["rows"], "all states", FORWARD),
        _bar("forward, the common schemes of free bodies and tops", everyday, "forward", COMMON),
    ]
    others = [[r["call"], f"{r['first']:.2f}", f"{1e3 * r['second']:.1f} ms"] for r in data["others"]]
    return [
        f"CPU seconds of the first and second call of {STEPS} steps, one core, load {before:.1f} to {after:.1f}",
        report.table(head, _lines(data["rows"], *WAYS)),
        report.table(["", "longest, s", "of", "bar", ""], [bar for bar in bars if bar]),
        f"Other calls, seconds of the first and of the shortest of {LATER} later ones",
        report.table(["", "first", "later"], others),
    ]


def _lines(rows: list[dict[str, Any]], *ways: str) -> list[list[str]]:
    return [[r["system"], r["step"], *(x for way in ways for x in _cells(r[way]))] for r in rows]


def _cells(waited: dict[str, float]) -> list[str]:
    return [f"{waited['first']:.2f}", f"{waited['second']:.4f}"]


def _bar(name: str, rows: list[dict[str, Any]], way: str, bar: float) -> list[str]:
    if not rows:
        return []
    worst = max(rows, key=lambda r: r[way]["first"])
    seconds = worst[way]["first"]
    verdict = report.verdict(seconds, seconds <= bar)
    return [name, f"{seconds:.2f}", f"{worst['system']}, {worst['step']}", f"≤ {bar:g}", verdict]


if __name__ == "__main__":
    main()
