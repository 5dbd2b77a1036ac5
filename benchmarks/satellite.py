"""A satellite with five laws of torque: what does a step cost, next to a torque-free one, astrojax's RK4 and Basilisk?

Gravity gradient on a circle, a dipole, limited B-dot and drag in a field that changes with time, and three wheels with
motors; 0.05 a step, work counted. Ours by `li.run`, astrojax's RK4 vmapped and jitted with a time that all bodies
share and the same equations (attitude, momentum, wheels). CPU time of one core per body and step, the contestants in
turn in one process; the least and the median of the rounds. Compilation is not counted. The ends are compared.

Basilisk has other laws and one spacecraft a simulation, so it and ours run a second satellite, `lib/spacecraft.py`. It
is none of our dependencies: name an interpreter that has it (`pip install bsk` in an environment of its own).

    python benchmarks/satellite.py [--basilisk PYTHON] [--quick] [--out DIR]
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from lib import command, spacecraft

STEPS, ROUNDS, DT = 100, 7, 0.05
OURS, FREE, RK4 = "ours, five laws", "ours, torque-free", "astrojax RK4, five laws"
BARS = (("astrojax RK4 ÷ ours, five laws", 50.0), ("ours, five laws ÷ torque-free", 5.0))


def contestants(bodies: int) -> dict[str, Callable[[], Any]]:
    """What each runs: STEPS steps of all bodies; they return the attitudes at the end."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from astrojax import set_dtype
    from astrojax.integrators import rk4_step

    import lieint_jax as li

    jax.config.update("jax_enable_x64", True)
    set_dtype(jnp.float64)  # pyright: ignore[reportArgumentType]
    locked, axes, moments = jnp.array([1.0, 2.0, 2.5]), jnp.eye(3), 0.05

    def orbit(t: Any) -> Any:
        c, s, zero = jnp.cos(t), jnp.sin(t), jnp.zeros_like(t)
        return jnp.stack([c, s, zero]), jnp.stack([-s, c, zero])

    def field(t: Any) -> Any:
        return jnp.stack([jnp.sin(t), 0.4 * jnp.ones_like(t), jnp.cos(2 * t)])

    def motor(t: Any, q: Any, Omega: Any, h: Any) -> Any:
        return 0.1 * Omega - 0.02 * h

    laws = [
        li.torques.gravity_gradient(orbit, locked, 1.0),
        li.torques.dipole([0.01, 0.0, 0.02], field),
        li.torques.bdot(0.05, field, max_dipole=0.1),
        li.torques.viscous(0.001),
        li.torques.wheels(axes, moments, motor, speeds=[1.0, -2.0, 0.5]),
    ]
    body = li.systems.torqued_body(li.torques.body_inertia(locked, axes, moments), li.torques.total(laws))
    free = li.systems.torqued_body(locked, li.torques.viscous(0.0))
    state, at_rest = (x.state([0.5, 0.5, -0.5, 0.5], angular_velocity=[0.3, -0.4, 0.6], work=0.0) for x in (body, free))
    scale = 1 + 0.05 * np.random.default_rng(1).normal(size=(bodies, 1))

    def batch(state: Any) -> Any:
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (bodies, *x.shape)), state)
        return states._replace(p=states.p * scale)

    def ours(body: Any, state: Any) -> Callable[[], Any]:
        step, states = li.schemes.torqued_midpoint(body), batch(state)
        return lambda: li.run(step, states, DT, STEPS, save_every=STEPS, progress=False).state.q[-1]

    def by_rk4() -> Callable[[], Any]:
        states = batch(state)
        extra: dict[str, Any] = dict(states.extra or {})
        names = sorted(extra)
        ends = np.cumsum([4, 3, *(extra[name][0].size for name in names)])

        def rate(t: Any, x: Any) -> Any:
            q, p, *inner = jnp.split(x, ends[:-1])
            carried = {name: part.reshape(extra[name][0].shape) for name, part in zip(names, inner, strict=True)}
            now = body.vector_field(li.State(q, p, jnp.asarray(t), None, carried))
            return jnp.concatenate([now.q, now.p, *(jnp.ravel((now.extra or {})[name]) for name in names)])

        def advance(k: Any, x: Any) -> Any:
            return jax.vmap(lambda x: rk4_step(rate, k * DT, x, DT).state)(x)

        run = jax.jit(lambda x: jax.lax.fori_loop(0, STEPS, advance, x))
        flat = [states.q, states.p, *(extra[name].reshape(bodies, -1) for name in names)]
        x = jnp.concatenate(flat, axis=1)
        return lambda: jax.block_until_ready(run(x))[:, :4]

    return {OURS: ours(body, state), FREE: ours(free, at_rest), RK4: by_rk4()}


def everything(bodies: int) -> dict[str, Any]:
    """Nanoseconds of CPU time per body and step, and how far the ends of the same motion differ."""
    import numpy as np
    from lib import measure

    entries = contestants(bodies)
    ends = {name: np.asarray(call()) for name, call in entries.items()}  # compiles
    seconds: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(ROUNDS):
        for name, call in entries.items():
            begin = time.process_time()
            call()
            seconds[name].append(time.process_time() - begin)
    each = 1e9 / (bodies * STEPS)
    return {
        "machine": measure.machine(),
        "bodies": bodies,
        "best_ns": {name: each * min(x) for name, x in seconds.items()},
        "median_ns": {name: each * statistics.median(x) for name, x in seconds.items()},
        "difference": float(np.abs(ends[OURS] - ends[RK4]).max()),
    }


def sections(result: dict[str, Any]) -> list[str]:
    """The report."""
    from lib import report

    best, median = result["best_ns"], result["median_ns"]
    rows = [[name, f"{x:.1f}", f"{median[name]:.1f}", f"{x / best[OURS]:.3g}"] for name, x in best.items()]
    over, cost = best[RK4] / best[OURS], best[OURS] / best[FREE]
    bars = [
        [BARS[0][0], f"{over:.3g}", f"≥ {BARS[0][1]:g}", report.verdict(over, over >= BARS[0][1])],
        [BARS[1][0], f"{cost:.3g}", f"≤ {BARS[1][1]:g}", report.verdict(cost, cost <= BARS[1][1])],
    ]
    return [
        report.machine(result),
        "Load of the machine before and after: {:.2f}, {:.2f}".format(*result["load"]),
        f"{result['bodies']} bodies, float64, one core: nanoseconds of CPU time per body and step",
        report.table(["", "best", "median", "÷ ours, five laws"], rows),
        f"Attitudes at t = {STEPS * DT:g}: ours, of order 2, and RK4 differ by {result['difference']:.1e}.",
        "Bars",
        report.table(["of the best", "measured", "bar", ""], bars),
        "Basilisk",
        *spacecraft.sections(result["basilisk"]),
    ]


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--basilisk", metavar="PYTHON", help="an interpreter that has Basilisk: pip install bsk")
    options = command.parsed(parser)
    command.pin()
    from lib import report

    def measured() -> dict[str, Any]:
        bodies = 200 if options.quick else 2000
        ours = everything(bodies)
        found = spacecraft.everything(options.basilisk, bodies, 2 if options.quick else ROUNDS)
        return ours | {"basilisk": found}

    result = command.under_load(measured)
    report.publish("satellite", sections(result), result, options.out)


if __name__ == "__main__":
    main()
