"""Attitudes from given rates: what does an error of 1e-9 rad cost, for one body and for 1000?

Rates with three frequencies, of some 1 rad per unit of time, to t = 100. Ours (`schemes.magnus`) against diffrax's
Tsit5 and Dopri8, with error control, and scipy's DOP853. The reference is the sixth order with 20 000 steps.

    python benchmarks/rates.py [--quick] [--out DIR]

Called in turn in one process on one core; the least of the times counts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from lib import command

SPAN, FREQUENCIES = 100.0, np.array([0.9, 1.17, 0.7])


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report

    result = command.under_load(lambda: {"machine": measure.machine(), "rows": rows(100 if options.quick else 1000)})
    head = ["", "error of one", "one, ms", "worst error of the batch", "batch, s"]
    table = [[name, *(f"{x:.2g}" if x else "–" for x in found)] for name, found in result["rows"].items()]
    load = f"load before and after: {result['load'][0]:.1f}, {result['load'][1]:.1f}"
    report.publish("rates", [report.machine(result), load, report.table(head, table)], result, options.out)


def rate(w: Any, t: Any) -> Any:
    import jax.numpy as jnp

    return w * jnp.stack([f(k * t) for f, k in zip((jnp.cos, jnp.sin, jnp.cos), FREQUENCIES, strict=True)])


def step_of(w: Any, order: int) -> Any:
    import jax

    import lieint_jax as li

    return li.schemes.magnus(li.systems.kinematics(li.groups.so3, jax.tree_util.Partial(rate, w)), order)


def contestants() -> dict[str, Callable[[Any, bool], Any]]:
    """By name, (amplitudes (3,) or (members, 3), whether these are a batch) ↦ the attitudes at the end."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    start = step_of(jnp.ones(3), 2).system.state()

    def magnus(order: int, n: int) -> Callable[[Any, bool], Any]:
        one = jax.jit(lambda w: li.integrate(step_of(w, order), start, SPAN / n, n, save_every=n).state.q[-1])

        def ends(w: Any, batch: bool) -> Any:
            if not batch:
                return one(w)
            steps = jax.vmap(partial(step_of, order=order))(w)
            states = start._replace(q=jnp.tile(start.q, (len(w), 1)), p=jnp.zeros((len(w), 0)))
            run = li.run(steps, states, SPAN / n, n, save_every=None, own_step=True, progress=False)
            return run.state.q[-1]

        return ends

    def solve(solver: Any, rtol: float, w: Any) -> Any:
        term = diffrax.ODETerm(lambda t, q, w: li.groups.so3.tangent(q, rate(w, t)))
        control, last = diffrax.PIDController(rtol=rtol, atol=rtol), diffrax.SaveAt(t1=True)
        options = {"stepsize_controller": control, "saveat": last, "max_steps": 200_000}
        found: Any = diffrax.diffeqsolve(term, solver, 0.0, SPAN, 0.05, start.q, w, **options)
        return found.ys[0]

    def compiled(solver: Any, rtol: float) -> Callable[[Any, bool], Any]:
        one = partial(solve, solver, rtol)
        programs = jax.jit(one), jax.jit(jax.vmap(one))
        return lambda w, batch: programs[batch](w)

    return {
        "magnus, order 4, 5000 steps": magnus(4, 5000),
        "magnus, order 6, 900 steps": magnus(6, 900),
        "diffrax Tsit5, rtol 1e-10": compiled(diffrax.Tsit5(), 1e-10),
        "diffrax Dopri8, rtol 1e-10": compiled(diffrax.Dopri8(), 1e-10),
        "scipy DOP853, rtol 1e-10": by_scipy,
    }


def by_scipy(w: Any, batch: bool) -> Any:
    from scipy.integrate import solve_ivp

    def field(t: float, q: Any) -> Any:
        (a, b, c), (p, x, y, z) = w * [np.cos(FREQUENCIES[0] * t), np.sin(FREQUENCIES[1] * t), np.cos(0.7 * t)], q
        return 0.5 * np.array(
            [-x * a - y * b - z * c, p * a + y * c - z * b, p * b - x * c + z * a, p * c + x * b - y * a]
        )

    return solve_ivp(field, (0, SPAN), [1.0, 0, 0, 0], "DOP853", rtol=1e-10, atol=1e-10).y[:, -1]


def rows(members: int) -> dict[str, tuple[float, float, float, float]]:
    """By contestant: error and milliseconds of one body, worst error and seconds of a batch; 0 where not measured."""
    import jax

    import lieint_jax as li

    w = np.array([0.8, 0.8, 0.5]) * (1 + 0.1 * np.random.default_rng(0).normal(size=(members, 3)))
    start, found = step_of(w[0], 6).system.state(), {}
    exact = jax.vmap(lambda w: li.integrate(step_of(w, 6), start, SPAN / 20_000, 20_000, save_every=20_000).state.q[-1])
    exact = np.asarray(jax.jit(exact)(w))
    for name, ends in contestants().items():
        several = name.startswith("scipy")
        errors = [np.abs(ends(w[0], False) - exact[0]).max(), 0 if several else np.abs(ends(w, True) - exact).max()]
        calls = {"one": partial(ends, w[0], False)} | ({} if several else {"batch": partial(ends, w, True)})
        seconds = command.least_cpu_times(calls, 3)
        found[name] = (2 * errors[0], 1e3 * seconds["one"], 2 * errors[1], seconds.get("batch", 0.0))
    return found


if __name__ == "__main__":
    main()
