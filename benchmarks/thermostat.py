"""Do free bodies in a heat bath have its temperature, by this package and by jax_md?

4096 bodies with the moments (1, 1.7, 2.2), or three equal ones of 2, are in a bath of kT = 1 with the friction 0.5,
without a potential; ours start at rest, those of jax_md as it draws them. The mean of Π²/J about each axis is over 20
times from 40 to 135, in steps of 0.1. jax_md runs its `nvt_langevin`, if it is installed (`pip install jax_md`).

    python benchmarks/thermostat.py [--quick] [--out DIR]
"""

from __future__ import annotations

import importlib.util
from typing import Any

from lib import command

MOMENTS = {"J = (1, 1.7, 2.2)": [1.0, 1.7, 2.2], "J = (2, 2, 2)": [2.0, 2.0, 2.0]}
DT, FRICTION, BETWEEN, FIRST, TIMES = 0.1, 0.5, 50, 8, 20  # steps between two times; times before the first, and all


def ours(moments: list[float], bodies: int) -> list[Any]:
    """Π²/J of all bodies at each time, (times, bodies, 3)."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li
    from lieint_jax.groups import so3

    body = li.systems.rigid_body(moments)
    step, at_rest = li.schemes.langevin(body, 1.0, FRICTION), body.state(angular_velocity=jnp.zeros(3))
    states = jax.vmap(lambda key: step.start(at_rest, key=key))(jax.random.split(jax.random.key(1), bodies))
    steps = BETWEEN * (FIRST + TIMES - 1)
    run = li.run(step, states, DT, steps, save_every=BETWEEN, progress=False)
    Pi = jax.vmap(jax.vmap(so3.Ad_star))(jnp.asarray(run.state.q[FIRST:]), jnp.asarray(run.state.p[FIRST:]))
    return [Pi**2 / jnp.asarray(moments)]


def jax_md(moments: list[float], bodies: int) -> list[Any]:
    """The same, and p²/m of the centers, (times, bodies, 3)."""
    import jax
    import jax.numpy as jnp
    from jax_md import rigid_body, simulate, space  # pyright: ignore[reportMissingImports]

    J = jnp.broadcast_to(jnp.asarray(moments), (bodies, 3))
    q = jnp.zeros((bodies, 4)).at[:, 0].set(1.0)
    gamma = rigid_body.RigidBody(FRICTION, FRICTION)  # pyright: ignore[reportArgumentType]
    make, step = simulate.nvt_langevin(lambda body: 0.0 * jnp.sum(body.center), space.free()[1], DT, 1.0, gamma)
    body = rigid_body.RigidBody(jnp.zeros((bodies, 3)), rigid_body.Quaternion(q))  # pyright: ignore
    state = make(jax.random.key(1), body, mass=rigid_body.RigidBody(jnp.ones(bodies), J))  # pyright: ignore

    def interval(state: Any, _: None) -> tuple[Any, tuple[Any, Any]]:
        state = jax.lax.fori_loop(0, BETWEEN, lambda _, z: step(z), state)
        Pi = rigid_body.conjugate_momentum_to_angular_momentum(state.position.orientation, state.momentum.orientation)
        return state, (Pi**2 / J, state.momentum.center**2)

    _, found = jax.jit(lambda z: jax.lax.scan(interval, z, None, FIRST + TIMES - 1))(state)
    return [x[FIRST - 1 :] for x in found]


def averages(values: Any) -> tuple[list[float], list[float]]:
    """Means over times and bodies, and their standard errors: a body's mean over time is one independent value."""
    import numpy as np

    of_bodies = np.asarray(values).mean(axis=0)
    return of_bodies.mean(axis=0).tolist(), (of_bodies.std(axis=0, ddof=1) / np.sqrt(len(of_bodies))).tolist()


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report  # float64

    bodies = 256 if options.quick else 4096
    packages = {"this package": ours} | ({"jax_md": jax_md} if importlib.util.find_spec("jax_md") else {})
    rows = []
    for name, run in packages.items():
        for title, moments in MOMENTS.items():
            for what, values in zip(("", ", centers"), run(moments, bodies), strict=False):
                mean, error = averages(values)
                rows.append({"name": f"{name}, {title}{what}", "mean": mean, "error": error})
    result = {"machine": measure.machine(), "bodies": bodies, "rows": rows}
    cells = [
        [row["name"], *(f"{x:.3f} ± {e:.3f}" for x, e in zip(row["mean"], row["error"], strict=True))] for row in rows
    ]
    sections = [
        report.machine(result),
        f"Means of Π²/J, or of p²/m of the centers, in kT: {bodies} bodies, Δt = {DT:g}",
        report.table(["", "x", "y", "z"], cells),
    ]
    if "jax_md" not in packages:
        sections.append("jax_md left out: `pip install jax_md`")
    report.publish("thermostat", sections, result, options.out)


if __name__ == "__main__":
    main()
