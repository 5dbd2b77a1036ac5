"""What does the gradient of a loss of 1000 final states with respect to the inertia cost, in time and memory?

Free rigid bodies as in `free_rigid_body.py`, dt = 0.01, the mean of one component of the final attitudes. Ours: reverse
mode by undoing steps, by nested checkpoints, and through the scan; forward mode. diffrax: Tsit5 with the same number of
constant steps, by RecursiveCheckpointAdjoint and BacksolveAdjoint. Contestants are called in turn; memory is that of
XLA's temporaries (`memory_analysis`). "÷ forward" is the gradient's time over that of the same integrator's forward
run.

    python benchmarks/gradients.py [--quick] [--out DIR]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from lib import command, report

DT = 0.01
SLOWEST, LARGEST = 8.0, 2.0  # bars: time over that of the forward run; MiB of temporaries
OURS, FORWARD = "reversible", "forward run"


def main() -> None:
    options = command.on_one_core(__doc__)
    bodies, steps, rounds = (100, 500, 2) if options.quick else (1000, 10_000, 3)
    rows = measure(bodies, steps, rounds)
    report.publish("gradients", [render(rows, bodies, steps)], rows, options.out)


def measure(bodies: int, steps: int, rounds: int) -> list[dict[str, Any]]:
    """The best time, the temporaries in MiB, and the gradient of each contestant."""
    import jax
    from lib import measure as common

    losses = ours(steps) | diffrax_losses(steps)
    q, p = common.bodies(bodies)
    states, J = (jax.numpy.asarray(q), jax.numpy.asarray(p)), jax.numpy.asarray(common.INERTIA)
    compiled: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    for name, function in losses.items():
        start = time.perf_counter()
        made = jax.jit(function).lower(J, *states).compile()
        memory = made.memory_analysis()
        compiled[name] = made
        rows.append(
            {
                "name": name,
                "seconds": float("inf"),
                "MiB": memory.temp_size_in_bytes / 2**20 if memory else float("nan"),
                "compile": time.perf_counter() - start,
            }
        )
    for _ in range(rounds + 1):
        for row in rows:
            start = time.perf_counter()
            value = jax.block_until_ready(compiled[row["name"]](J, *states))
            row["seconds"] = min(row["seconds"], time.perf_counter() - start)
            row["gradient"] = [float(x) for x in jax.numpy.ravel(jax.tree.leaves(value)[0])[:3]]
    return rows


def ours(steps: int) -> dict[str, Callable[..., Any]]:
    """Forward run and gradients of the symplectic scheme."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    def loss(run: Callable[..., Any], J: Any, q: Any, p: Any) -> Any:
        step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
        return jnp.mean(jax.vmap(lambda q, p: run(step, li.State(q, p)).state.q[-1, 0])(q, p))

    def scan(step: Any, z: Any) -> Any:
        return li.integrate(step, z, DT, steps, save_every=steps)

    def undone(step: Any, z: Any) -> Any:
        return li.integrate(step, z, DT, steps, save_every=steps, adjoint=li.ReversibleAdjoint())

    def checkpointed(step: Any, z: Any) -> Any:
        return li.integrate(step, z, DT, steps, save_every=steps, adjoint=li.RecursiveCheckpointAdjoint())

    found: dict[str, Callable[..., Any]] = {
        f"ours, {FORWARD}": lambda *a: loss(scan, *a),
        f"ours, {OURS}": jax.grad(lambda *a: loss(undone, *a)),
        f"ours, {OURS}, in all states": jax.grad(lambda *a: loss(undone, *a), (1, 2)),
        "ours, checkpoint": jax.grad(lambda *a: loss(checkpointed, *a)),
        "ours, forward mode (3 parameters)": jax.jacfwd(lambda *a: loss(scan, *a)),
    }
    if steps <= 2000:  # 4 GiB at 10 000 steps
        found["ours, through the scan"] = jax.grad(lambda *a: loss(scan, *a))
    return found


def diffrax_losses(steps: int) -> dict[str, Callable[..., Any]]:
    """Forward run and gradients of diffrax's Tsit5, constant steps; none if it is not installed."""
    try:
        import diffrax
    except ImportError:
        return {}
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    def loss(adjoint: Any, J: Any, q: Any, p: Any) -> Any:
        term = diffrax.ODETerm(lambda t, z, J: li.systems.RigidBody(J).vector_field(z))

        def solve(q: Any, p: Any) -> Any:
            end: Any = diffrax.diffeqsolve(
                term, diffrax.Tsit5(), 0.0, steps * DT, DT, li.State(q, p), J, max_steps=steps + 1, adjoint=adjoint
            ).ys
            return end.q[-1, 0]

        return jnp.mean(jax.vmap(solve)(q, p))

    recursive, back = diffrax.RecursiveCheckpointAdjoint(), diffrax.BacksolveAdjoint()
    return {
        f"diffrax, {FORWARD}": lambda *a: loss(recursive, *a),
        "diffrax, RecursiveCheckpointAdjoint": jax.grad(lambda *a: loss(recursive, *a)),
        "diffrax, BacksolveAdjoint": jax.grad(lambda *a: loss(back, *a)),
    }


def render(rows: list[dict[str, Any]], bodies: int, steps: int) -> str:
    """The table, and the bars."""
    base = {r["name"].split(",")[0]: r["seconds"] for r in rows if r["name"].endswith(FORWARD)}
    lines = [
        f"Gradient of a mean over {bodies} free bodies with respect to the inertia, {steps} steps of {DT}, one core",
        "",
        "| | seconds | ÷ forward | temporaries, MiB | compile s | ∂/∂J₁ |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for r in rows:
        ratio = r["seconds"] / base[r["name"].split(",")[0]]
        shown = "" if r["name"].endswith((FORWARD, "states")) else f"{r['gradient'][0]:.8f}"
        lines.append(
            f"| {r['name']} | {r['seconds']:.3g} | {ratio:.3g} | {r['MiB']:.3g} | {r['compile']:.1f} | {shown} |"
        )
    if bodies < 1000:
        return "\n".join(lines)
    for r in rows:
        if OURS in r["name"]:
            for what, value, bar in (
                ("time ÷ forward run", r["seconds"] / base["ours"], SLOWEST),
                ("MiB", r["MiB"], LARGEST),
            ):
                held = "held" if value <= bar else "MISSED"
                lines.append(f"\n{r['name'].removeprefix('ours, ')}: {what} {value:.3g}, bar ≤ {bar:g}: {held}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
