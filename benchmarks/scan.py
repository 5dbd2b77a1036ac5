"""How fast are loops of others by `li.scan`, against `jax.lax.scan`, under `jax.vmap`?

Three loops that are no integrators of this package: a Runge–Kutta method for the Lorenz system, a sampled controller of
a pendulum, the logistic map; each forward, and its gradient by a parameter of all members. CPU time of one core, the
contestants in turn in one process, the least of the rounds; and the first call, with tracing and compiling.

    python benchmarks/scan.py [--quick] [--out DIR]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from lib import command

Scan = Callable[..., Any]


def lorenz(scan: Scan, member: Any, rho: Any, length: int) -> Any:
    """The end of a path by the classical Runge–Kutta method."""
    import jax.numpy as jnp

    def rate(z: Any) -> Any:
        x, y, w = z
        return jnp.stack([10.0 * (y - x), x * (rho - w) - y, x * y - 8 / 3 * w])

    def step(z: Any, _: None) -> Any:
        a = rate(z)
        b = rate(z + 0.0005 * a)
        c = rate(z + 0.0005 * b)
        d = rate(z + 0.001 * c)
        return z + 0.001 / 6 * (a + 2 * b + 2 * c + d), None

    return scan(step, jnp.stack([1.0 + member, 1.0, 20.0]), length=length)[0][0]


def controller(scan: Scan, member: Any, gain: Any, length: int) -> Any:
    """The last angle of a pendulum whose torque is computed at each tenth step."""
    import jax.numpy as jnp

    def step(carry: Any, _: None) -> Any:
        angle, rate, torque, n = carry
        torque = jnp.where(n % 10 == 0, gain * (1.0 - angle) - 2.0 * rate, torque)
        rate = rate + 0.01 * (torque - jnp.sin(angle))
        return (angle + 0.01 * rate, rate, torque, n + 1), None

    return scan(step, (member, 0.0 * member, 0.0 * member, jnp.array(0)), length=length)[0][0]


def logistic(scan: Scan, member: Any, r: Any, length: int) -> Any:
    """The last iterate, in the stable range."""
    return scan(lambda x, _: (r * x * (1 - x), None), 0.3 + 0.1 * member, length=length)[0]


LOOPS = {
    "Lorenz, Runge–Kutta": (lorenz, 14.0),
    "sampled controller": (controller, 5.0),
    "logistic map": (logistic, 2.9),
}


def contest(members: int, length: int, rounds: int) -> list[dict[str, Any]]:
    """CPU seconds, for each loop."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    x = jnp.linspace(0.0, 1.0, members)
    rows = []
    for name, (loop, parameter) in LOOPS.items():
        calls, first = {}, {}
        for by, scan in {"lax": jax.lax.scan, "li": li.scan}.items():

            def mean(a: Any, loop: Any = loop, scan: Scan = scan) -> Any:
                return jnp.mean(jax.vmap(lambda member: loop(scan, member, a, length))(x))

            for kind, function in {"value": mean, "gradient": jax.grad(mean)}.items():
                calls[f"{by} {kind}"] = call = lambda f=jax.jit(function), a=parameter: f(a)  # noqa: B008
                start = time.process_time()
                jax.block_until_ready(call())
                first[f"{by} {kind}"] = time.process_time() - start
        rows.append({"name": name, "first": first, "later": command.least_cpu_times(calls, rounds)})
    return rows


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report  # float64

    members, length, rounds = (100, 200, 1) if options.quick else (1024, 2000, 4)
    result = command.under_load(lambda: {"machine": measure.machine(), "loops": contest(members, length, rounds)})
    rows = [
        [
            f"{x['name']}, {kind}",
            f"{x['later'][f'lax {kind}'] * 1e3:.2f}",
            f"{x['later'][f'li {kind}'] * 1e3:.2f}",
            f"{x['later'][f'lax {kind}'] / x['later'][f'li {kind}']:.1f}",
            f"{x['first'][f'lax {kind}']:.2f}",
            f"{x['first'][f'li {kind}']:.2f}",
        ]
        for x in result["loops"]
        for kind in ("value", "gradient")
    ]
    head = [
        "",
        "lax.scan, ms",
        "li.scan, ms",
        "lax.scan ÷ li.scan",
        "first call, lax.scan, s",
        "first call, li.scan, s",
    ]
    sections = [
        report.machine(result) + ", load {:.1f} to {:.1f}".format(*result["load"]),
        f"{length} steps of {members} members",
        report.table(head, rows),
    ]
    report.publish("scan", sections, result, options.out)


if __name__ == "__main__":
    main()
