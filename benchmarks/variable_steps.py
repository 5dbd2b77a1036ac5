"""Does an error-controlled loop pay for the energy-momentum scheme? Hardly, and never in a batch of heavy tops.

A PI controller (exponents 0.7/3 and 0.4/3) of the error that `diagnostics.local_error` estimates; steps above the
tolerance are refused. Against constant steps, as many as the loop tried: the angle from the flow at the end, and where
a top passes a charge, against `log_hamiltonian`. Then the share of idle lanes in one vmapped
loop over 256 tops, which goes on until the last of them is done. The tables in RESULTS.md are a typical printout.

    python benchmarks/variable_steps.py
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import lieint_jax as li
from lieint_jax import State, Step, diagnostics, schemes
from lieint_jax.groups import so3
from lieint_jax.systems import potential_top
from lieint_jax.systems._heavy_top import asymmetric, kovalevskaya, lagrange


def coulomb(Gamma: Array) -> Array:
    """A charge on the body's third axis, 1 from the fixed point, and an opposite one in space at |γ|."""
    return -1 / jnp.sqrt(1 + Gamma @ Gamma - 2 * Gamma[2])


def passing() -> tuple[Any, State]:
    """A top that passes by a charge: V from −0.5 to −2 and deeper."""
    top = potential_top([1.0, 2.0, 2.5], coulomb, [0.0, 0.0, 1.05])
    return top, top.state(so3.exp(jnp.array([2.5, 0.0, 0.0])), angular_velocity=[0.1, 0.05, 0.1])


jax.config.update("jax_enable_x64", True)
TOPS = {
    "lagrange": (*lagrange(), 1.0),
    "kovalevskaya": (*kovalevskaya(), 10.0),
    "asymmetric": (*asymmetric(), 10.0),
    "passing a charge": (*passing(), 40.0),
}
TOLERANCES = (1e-3, 1e-4, 1e-5)
SAFETY, FAST, SLOW = 0.9, 0.7 / 3, 0.4 / 3
MOST = 100_000


@jax.jit
def controlled(step: Step, state: State, end: float, tolerance: float) -> tuple[State, Array]:
    """The state at the time `end`, and the number of steps tried."""

    def unfinished(carry: tuple) -> Array:
        _, t, _, _, tried = carry
        return (t < end) & (tried < MOST)

    def body(carry: tuple) -> tuple:
        state, t, h, before, tried = carry
        h = jnp.minimum(h, end - t)
        after, info = step(state, h)
        error = jnp.linalg.norm(diagnostics.local_error(step, state, h)) / tolerance
        good = info.converged & (error <= 1)
        error = jnp.where(info.converged, jnp.maximum(error, 1e-4), 1e4)
        grow = jnp.where(good, error**-FAST * before**SLOW, error ** (-1 / 3))
        state = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, state)
        t, before = jnp.where(good, t + h, t), jnp.where(good, error, before)
        return state, t, h * jnp.clip(SAFETY * grow, 0.2, 5), before, tried + 1

    start = (state, jnp.zeros(()), jnp.asarray(1e-3), jnp.ones(()), jnp.zeros((), int))
    end_state, *_, tried = lax.while_loop(unfinished, body, start)
    return end_state, tried


@partial(jax.jit, static_argnums=3)
def constant(step: Step, state: State, dt: float, num_steps: int) -> State:
    return jax.tree.map(lambda x: x[-1], li.integrate(step, state, dt, num_steps, save_every=num_steps).state)


@jax.jit
def tried_by_each(step: Step, states: State, end: float, tolerance: float) -> Array:
    """The steps that each member of a batch tries, in one loop."""
    return jax.vmap(lambda state: controlled(step, state, end, tolerance)[1])(states)


def spread(step: Step, state: State, members: int = 256) -> State:
    """States about one: half a radian in the attitude, half of its size in the momentum."""
    deltas = 0.5 * jnp.asarray(np.random.default_rng(0).normal(size=(members, 6)))
    deltas = deltas.at[:, 3:].multiply(jnp.max(jnp.abs(state.p)))
    return jax.vmap(partial(step.system.phase_space.perturb, state))(deltas)


def main() -> None:
    print("| top | tolerance | steps tried | error, controlled | constant steps | idle lanes |\n" + 6 * "|---" + "|")
    for name, (top, state, end) in TOPS.items():
        step = schemes.top_energy_momentum(top)
        true = diagnostics.flow(top, state, end, 20_000).q
        many = spread(step, state)
        for tolerance in TOLERANCES:
            last, tried = controlled(step, state, end, tolerance)
            n = int(tried)
            errors = [float(so3.angle(z.q, true)) for z in (last, constant(step, state, end / n, n))]
            tries = np.asarray(tried_by_each(step, many, end, tolerance))
            idle = 1 - tries.mean() / tries.max()
            print(f"| {name} | {tolerance:.0e} | {n} | {errors[0]:.1e} | {errors[1]:.1e} | {idle:.0%} |", flush=True)
    logarithmic()


def logarithmic() -> None:
    """Steps to t = 40 and the error there, of the logarithmic Hamiltonian of the top that passes a charge."""
    top, state, end = TOPS["passing a charge"]
    step = schemes.log_hamiltonian(top)
    print("\n| logarithmic Hamiltonian: dt | steps | error |\n|---|---|---|")
    for dt in (0.1, 0.06, 0.045):
        run = li.integrate(step, step.start(state), dt, 1000)
        n = int(np.searchsorted(run.t, end))
        error = float(so3.angle(run.state.q[n], diagnostics.flow(top, state, run.t[n], 20_000).q))
        print(f"| {dt} | {n} | {error:.1e} |")


if __name__ == "__main__":
    main()
