"""A satellite with five laws of torque: the rate of its steps, next to a torque-free step and to astrojax's RK4.

    python benchmarks/satellite.py [members]

CPU time, of all threads, per step and member, in one process, the contestants in turn; the least of several rounds. astrojax integrates
the same equations of motion (attitude, momentum, rod and wheels), vmapped and jitted.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from astrojax.integrators import rk4_step

import lieint_jax as li
from lieint_jax.systems._torqued_body import examples

jax.config.update("jax_enable_x64", True)
STEPS, ROUNDS, DT = 100, 5, 0.05


def batch(state: li.State, members: int) -> li.State:
    """Copies of a state, with momenta that differ by some percent."""
    scale = 1 + 0.05 * np.random.default_rng(1).normal(size=(members, 1))
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), state)
    return states._replace(p=states.p * scale)


def ours(body: li.systems.TorquedBody, states: li.State) -> Callable[[], object]:
    """STEPS steps of `torqued_midpoint` by `ensemble.run`."""
    step = li.schemes.torqued_midpoint(body)
    return lambda: li.ensemble.run(step, states, DT, STEPS, save_every=STEPS)


def by_rk4(body: li.systems.TorquedBody, states: li.State) -> Callable[[], object]:
    """STEPS steps of astrojax's RK4."""
    names = sorted(states.extra or {})

    def rate(t: jax.Array, x: jax.Array) -> jax.Array:
        sizes = np.cumsum([4, 3, *[1 if name == "rod" else 3 for name in names]])
        q, p, *inner = jnp.split(x, sizes[:-1])
        extra = {name: part[0] if name == "rod" else part for name, part in zip(names, inner, strict=True)}
        now = body.vector_field(li.State(q, p, t, None, extra))
        return jnp.concatenate([now.q, now.p, *(jnp.atleast_1d(now.extra[name]) for name in names)])

    def path(x: jax.Array) -> jax.Array:
        step = lambda k, x: rk4_step(rate, k * DT, x, DT).state  # noqa: E731
        return jax.lax.fori_loop(0, STEPS, step, x)

    extra = states.extra or {}
    flat = [states.q, states.p, *(extra[name].reshape(len(states.q), -1) for name in names)]
    run, x = jax.jit(jax.vmap(path)), jnp.concatenate(flat, axis=1)
    return lambda: jax.block_until_ready(run(x))


def main(members: int) -> None:
    """Print nanoseconds of CPU time per step and member, and the ratios."""
    body, state, _ = examples()["satellite"]
    free = li.systems.torqued_body([1.0, 2.0, 2.5], li.torques.viscous(0.0))
    start = free.state(state.q, angular_velocity=body.angular_velocity(state), work=0.0)
    contestants = {
        "five laws": ours(body, batch(state, members)),
        "torque-free": ours(free, batch(start, members)),
        "astrojax RK4, five laws": by_rk4(body, batch(state, members)),
    }
    best = dict.fromkeys(contestants, np.inf)
    for turn in range(ROUNDS + 1):
        for name, call in contestants.items():
            begin = time.process_time()
            call()
            if turn:  # the first compiles
                best[name] = min(best[name], time.process_time() - begin)
    for name, seconds in best.items():
        print(f"{name:26} {1e9 * seconds / (members * STEPS):9.1f} ns   {seconds / best['five laws']:6.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4000)
