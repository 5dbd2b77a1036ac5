"""What do tangent vectors cost beside the step that carries them, in machine code?

A thousand members, dt = 0.05, one core, loops by `li.scan`. `Step.tangent` is the closed form where a step has one; jvp
is `jax.jvp` of the step in the coordinates of the phase space, what any integrator can do; jacfwd is the same for all
vectors (`diagnostics.linearization`). The spectrum of Lyapunov exponents has one vector of each dimension, made
orthonormal after each step. Contestants are called in turn in one run, in CPU time; the best call of each counts.

    python benchmarks/tangent.py [--quick] [--out DIR]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lib import command, motions, report

DT = 0.05
PLAIN, TANGENT, JVP = "step alone", "tangent, 1 vector", "jvp, 1 vector"
TANGENTS, JACFWD, EXPONENTS = "tangent, 6 vectors", "jacfwd, 6 vectors", "6 exponents"


def main() -> None:
    options = command.on_one_core(__doc__)
    bodies, steps, rounds = (64, 20, 1) if options.quick else (1024, 200, 4)
    data = command.under_load(
        lambda: {"steps": steps, "rows": [measure(*case, bodies, steps, rounds) for case in motions.cases()]}
    )
    report.publish("tangent", [render(data, bodies)], data, options.out)


def measure(name: str, step: Any, state: Any, is_closed: bool, bodies: int, steps: int, rounds: int) -> dict[str, Any]:
    """CPU seconds of each way to carry vectors, the engines, and by how much the results differ."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import lieint_jax as li

    space = step.system.phase_space
    shifts = jnp.asarray(np.random.default_rng(0).normal(size=(bodies, space.dim)) * 0.01)
    states = jax.jit(jax.vmap(lambda x: space.perturb(state, x)))(shifts)
    given = {key: (states, vectors(space.dim, 6 if "6" in key else 1)) for key in (*ways(step), EXPONENTS)}
    runs = {key: jax.jit(loop(one, steps)) for key, one in ways(step).items()}
    runs[EXPONENTS] = jax.jit(
        lambda z, T: jax.vmap(lambda z: li.diagnostics.lyapunov(step, z, DT, steps, exponents=6).exponents)(z)
    )
    engines = {key: sorted(li.explain(runs[key], *given[key]).engines) for key in runs}
    ends = {key: jax.block_until_ready(run(*given[key])) for key, run in runs.items()}
    pairs = ((TANGENT, JVP), (TANGENTS, JACFWD))
    differ = max(float(jnp.abs(ends[a][1] - ends[b][1]).max() / jnp.abs(ends[a][1]).max()) for a, b in pairs)
    seconds = command.least_cpu_times({key: lambda key=key: runs[key](*given[key]) for key in runs}, rounds)
    return {"step": name, "closed": is_closed, "seconds": seconds, "engines": engines, "differ": differ}


def ways(step: Any) -> dict[str, Callable[..., Any]]:
    """(state, vectors (dim, k)) ↦ (new state, LT), in several ways."""
    import jax
    import jax.numpy as jnp

    space = step.system.phase_space

    def closed_form(z: Any, T: Any) -> Any:
        end, _, T = step.tangent(z, DT, T)
        return end, T

    def step_from(z: Any, delta: Any) -> Any:
        return step(space.perturb(z, delta), DT)[0]

    def jvp(z: Any, T: Any) -> Any:
        end, tangent = jax.jvp(lambda x: step_from(z, x), (jnp.zeros(space.dim),), (T[:, 0],))
        return end, space.trivialize(end, tangent)[:, None]

    def jacfwd(z: Any, T: Any) -> Any:
        end, push = jax.linearize(lambda x: step_from(z, x), jnp.zeros(space.dim))
        return end, jax.vmap(lambda x: space.trivialize(end, push(x)), -1, -1)(T)

    return {
        PLAIN: lambda z, T: (step(z, DT)[0], T),
        TANGENT: closed_form,
        JVP: jvp,
        TANGENTS: closed_form,
        JACFWD: jacfwd,
    }


def loop(function: Callable[..., Any], steps: int) -> Callable[..., Any]:
    """The states of all members, and their vectors, after so many steps."""
    import jax

    import lieint_jax as li

    def of_member(state: Any, T: Any) -> Any:
        return li.scan(lambda carry, _: (function(*carry), None), (state, T), length=steps)[0]

    return lambda states, T: jax.vmap(of_member, (0, None))(states, T)


def vectors(dim: int, count: int) -> Any:
    import jax.numpy as jnp

    return jnp.eye(dim)[:, :count] + 0.1


def render(data: dict[str, Any], bodies: int) -> str:
    """The table, as ratios to the step alone."""
    before, after = data["load"]
    names = [name for name in data["rows"][0]["seconds"] if name != PLAIN]
    lines = [
        f"Tangent vectors of {bodies} members, dt = {DT:g}, one core, load {before:.1f} to {after:.1f}: CPU time over "
        "that of the step alone; * not machine code",
        "",
        f"| | step alone, million a second | {' | '.join(names)} | jvp ÷ closed form | largest difference |",
        f"|---|{'---:|' * (len(names) + 3)}",
    ]
    for row in data["rows"]:
        seconds = row["seconds"]
        shown = [f"{seconds[x] / seconds[PLAIN]:.1f}" + "*" * (row["engines"][x] != ["native"]) for x in names]
        generic = f"{seconds[JVP] / seconds[TANGENT]:.1f}" if row["closed"] else "no closed form"
        rate = f"{bodies * data['steps'] / seconds[PLAIN] / 1e6:.1f}"
        lines.append(f"| {row['step']} | {rate} | {' | '.join(shown)} | {generic} | {row['differ']:.1g} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
