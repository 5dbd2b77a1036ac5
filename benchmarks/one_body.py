"""What do a long run and a gradient cost for one body or few, where vectors of members do not help?

Runs of one body, by `integrate` and by `li.run` of one member. Gradients by undoing steps, `ReversibleAdjoint`, of a
mean over 1, 100 and 1000 free bodies, as in `gradients.py`, compiled by `jax.jit` and by `li.jit`, over the forward run
of `integrate` by `jax.jit`. CPU time of one core, the contestants in turn in one process, the least of the rounds.

    python benchmarks/one_body.py [--quick] [--out DIR]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lib import command


def long_runs(steps: int, rounds: int) -> list[dict[str, Any]]:
    """Nanoseconds a step, for each system."""
    import jax

    import lieint_jax as li

    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])
    law = li.torques.gravity_gradient(li.orbits.kepler(1.0, 1.0, 0.1), [1.0, 2.0, 2.5])
    satellite = li.systems.torqued_body([1.0, 2.0, 2.5], law)
    cases = {
        "free body, so3_midpoint": (li.schemes.so3_midpoint(body), {}),
        "free body, so3_explicit": (li.schemes.so3_explicit(body), {}),
        "heavy top, splitting": (li.schemes.splitting(top), {}),
        "heavy top, top_energy_momentum": (li.schemes.top_energy_momentum(top), {}),
        "satellite, torqued_midpoint": (li.schemes.torqued_midpoint(satellite), {"t": 0.0, "work": 0.0}),
    }
    rows = []
    for name, (step, more) in cases.items():
        state = step.system.state(angular_velocity=[0.2, 0.1, 1.0], **more)
        member = jax.tree.map(lambda x: x[None], state)
        found = command.least_cpu_times(
            {
                "integrate": lambda: li.integrate(step, state, 0.02, steps, save_every=steps).state.q,  # noqa: B023
                "ensemble": lambda: li.run(step, member, 0.02, steps, progress=False, save_every=None).state.q,  # noqa: B023
            },
            rounds,
        )
        rows.append({"name": name, **{key: x / steps * 1e9 for key, x in found.items()}})
    return rows


def gradients(steps: int, rounds: int, sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    """Seconds of the forward run and of the gradient, for each number of bodies."""
    import jax
    import jax.numpy as jnp
    from lib import measure as common

    import lieint_jax as li

    def loss(run: Callable[..., Any], J: Any, q: Any, p: Any) -> Any:
        step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
        return jnp.mean(jax.vmap(lambda q, p: run(step, li.State(q, p)).state.q[-1, 0])(q, p))

    def forward(*args: Any) -> Any:
        return loss(lambda step, z: li.integrate(step, z, 0.01, steps, save_every=steps), *args)

    def backward(*args: Any) -> Any:
        adjoint = li.ReversibleAdjoint()
        return loss(lambda step, z: li.integrate(step, z, 0.01, steps, save_every=steps, adjoint=adjoint), *args)

    rows = []
    for bodies in sizes:
        q, p = common.bodies(bodies)
        arguments = [jnp.asarray(x) for x in (common.INERTIA, q, p)]
        compiled = {"forward": jax.jit(forward), "jax": jax.jit(jax.grad(backward)), "li": li.jit(jax.grad(backward))}
        calls = {name: (lambda f=f: f(*arguments)) for name, f in compiled.items()}  # noqa: B023
        rows.append({"bodies": bodies, **command.least_cpu_times(calls, rounds)})
    return rows


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report  # float64

    steps, rounds, sizes = (1000, 1, (1, 10)) if options.quick else (100_000, 4, (1, 100, 1000))
    result = command.under_load(
        lambda: {
            "machine": measure.machine(),
            "runs": long_runs(steps, rounds),
            "gradients": gradients(steps // 20, rounds, sizes),
        }
    )
    runs = [
        [x["name"], f"{x['integrate']:.0f}", f"{x['ensemble']:.0f}", f"{x['integrate'] / x['ensemble']:.1f}"]
        for x in result["runs"]
    ]
    over = [
        [f"{x['bodies']}", *(f"{x[key] / x['forward']:.2g}" for key in ("jax", "li")), f"{x['li'] / x['jax']:.2f}"]
        for x in result["gradients"]
    ]
    sections = [
        report.machine(result) + ", load {:.1f} to {:.1f}".format(*result["load"]),
        f"Nanoseconds a step of one body, {steps} steps",
        report.table(["", "integrate", "li.run", "integrate ÷ li.run"], runs),
        f"Gradients by undoing {steps // 20} steps: time over that of the forward run",
        report.table(["bodies", "jax.jit", "li.jit", "li.jit ÷ jax.jit"], over),
    ]
    report.publish("one_body", sections, result, options.out)


if __name__ == "__main__":
    main()
