"""Finite-time Lyapunov exponents of a chaotic heavy top, from the linearisation of the step itself.

The tangent flow carries a frame along, W ← L_n W with L_n the derivative of the step in (δθ, δπ), and a QR
decomposition after each step keeps it a frame; the logarithms of R's diagonal add up to the exponents. Their sum is
zero to round-off for a symplectic step, and in the limit they come in pairs ±λ. The chaotic motion has one pair that is
not zero in the limit: the flow itself with energy, and the turn about the vertical with its momentum, take the others
to zero like log(t)/t.

The independent value: the variational equations of the vector field in its own coordinates, by another integrator
(`reference`), or two neighbours that are let part and are brought together again (`shadow`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from matplotlib.figure import Figure

from lieint_jax import plots, schemes
from lieint_jax.diagnostics.order import flow
from lieint_jax.diagnostics.symplectic import pushed
from lieint_jax.integrate import saves
from lieint_jax.systems.heavy_top import asymmetric
from lieint_jax.types import State, Step, System

_BLOCKS = 10


class Found(NamedTuple):
    """What the study found.

    Attributes:
        t: times, (n,).
        exponents: finite-time exponents at these times, (n, 6), 1/time unit.
        total: sum of the exponents at the end.
        pairs: largest |λ_i + λ_{7−i}| at the end, of exponents in descending order.
        short: exponents at the end of a short run by `exponents`, (6,).
        independent: the same by `reference`.
        apart: exponent by two neighbours over the whole run.
        limit: the largest exponent over the second half of the run, and its standard error by `_BLOCKS` blocks of it.
    """

    t: np.ndarray
    exponents: np.ndarray
    total: float
    pairs: float
    short: np.ndarray
    independent: np.ndarray
    apart: float
    limit: tuple[float, float]


def exponents(step: Step, state: State, dt: float, num_steps: int, save_every: int = 1) -> tuple[Array, Array]:
    """Finite-time Lyapunov exponents along a run.

    Args:
        step: a step; the linearisation is that of this very step.
        state: the initial state.
        dt: step size.
        num_steps: how many steps, a multiple of `save_every`.
        save_every: steps between saved values.

    Returns:
        Times (n,), and exponents (n, 2d) in units of 1/time in the order of the frame, which grow less from one to the
        next in the limit; in the phase space's own coordinates, momenta in the units of the state.

    Raises:
        ValueError: `num_steps` is no multiple of `save_every`; the first step fails.
    """
    num_saves = saves(num_steps, save_every)
    step.check(state, dt)
    space = step.system.phase_space
    frame = jnp.eye(space.dim, dtype=state.p.dtype)

    def one(carry: tuple[State, Array, Array], _: None) -> tuple[tuple[State, Array, Array], None]:
        state, frame, sums = carry
        state, _, L = pushed(space, lambda z: step(z, dt), state)
        frame, growth = _orthonormal(L @ frame)
        return (state, frame, sums + growth), None

    def interval(carry: tuple[State, Array, Array], _: None) -> tuple[tuple[State, Array, Array], Array]:
        carry, _ = lax.scan(one, carry, None, length=save_every)
        return carry, carry[2]

    _, sums = lax.scan(interval, (state, frame, jnp.zeros_like(frame[0])), None, length=num_saves)
    t = dt * save_every * jnp.arange(1, num_saves + 1)
    return t, sums / t[:, None]


def _orthonormal(W: Array) -> tuple[Array, Array]:
    Q, R = jnp.linalg.qr(W)
    return Q, jnp.log(jnp.abs(jnp.diagonal(R)))


def reference(system: System, state: State, t: float, pieces: int) -> Array:
    """The exponents at time t by the vector field alone, (2d,): collocation of order 16, its derivative by autodiff."""
    space = system.phase_space

    def one(carry: tuple[State, Array, Array], _: None) -> tuple[tuple[State, Array, Array], None]:
        state, frame, sums = carry
        end, _, L = pushed(space, lambda z: (flow(system, z, t / pieces, 2), None), state)
        frame, growth = _orthonormal(L @ frame)
        return (end, frame, sums + growth), None

    start = (state, jnp.eye(space.dim), jnp.zeros(space.dim))
    return lax.scan(one, start, None, length=pieces)[0][2] / t


def shadow(step: Step, state: State, dt: float, num_steps: int, every: int = 20, distance: float = 1e-8) -> Array:
    """The largest exponent by two neighbours that are brought together again after every `every` steps.

    Source: Benettin, Galgani & Strelcyn 1976, Phys. Rev. A 14.
    """
    space = step.system.phase_space

    def apart(a: State, b: State) -> Array:
        return space.trivialise(a, jax.tree.map(jnp.subtract, b, a))

    def one(carry: tuple[State, State, Array], _: None) -> tuple[tuple[State, State, Array], None]:
        a, b, total = carry
        a, b = lax.fori_loop(0, every, lambda _, z: (step(z[0], dt)[0], step(z[1], dt)[0]), (a, b))
        delta = apart(a, b)
        size = jnp.linalg.norm(delta)
        return (a, space.perturb(a, delta * (distance / size)), total + jnp.log(size / distance)), None

    first = jnp.zeros(space.dim).at[0].set(distance)
    total = lax.scan(one, (state, space.perturb(state, first), jnp.zeros(())), None, length=num_steps // every)[0][2]
    return total / (dt * every * (num_steps // every))


def run(quick: bool = False, progress: bool = True) -> Found:
    """The asymmetric top of `systems.heavy_top`, by the splitting scheme; `quick` follows it a fifth of the time."""
    del progress
    top, state = asymmetric()
    dt, steps = 0.05, 4000 if quick else 20_000
    step = schemes.splitting(top)
    t, values = jax.jit(exponents, static_argnums=(2, 3, 4))(step, state, dt, steps, steps // 200)
    fine, short = 0.005, 20.0
    precise = schemes.compose(step, 6)
    close = jax.jit(exponents, static_argnums=(2, 3, 4))(precise, state, 10 * fine, round(short / fine / 10), 1)[1][-1]
    independent = jax.jit(reference, static_argnums=(2, 3))(top, state, short, 100)
    near = jax.jit(shadow, static_argnums=(2, 3))(step, state, dt, steps)
    last = np.sort(np.asarray(values[-1]))[::-1]
    growth = (values[:, 0] * t)[len(t) // 2 - 1 :: len(t) // (2 * _BLOCKS)]
    rates = np.asarray(jnp.diff(growth) / jnp.diff(t[len(t) // 2 - 1 :: len(t) // (2 * _BLOCKS)]))
    return Found(
        np.asarray(t),
        np.asarray(values),
        float(last.sum()),
        float(np.abs(last + last[::-1]).max()),
        np.asarray(close),
        np.asarray(independent),
        float(near),
        (float(rates.mean()), float(rates.std(ddof=1) / np.sqrt(_BLOCKS))),
    )


def text(found: Found) -> str:
    """The report."""

    def listed(values: np.ndarray) -> str:
        return "(" + ", ".join(f"{x:9.5f}" for x in values) + ")"

    return "\n".join(
        [
            "Lyapunov exponents of a chaotic heavy top, J = (1, 2, 2.5), E = (.5, .4, 1)",
            f"  to t = 20, order 6:            {listed(found.short)}",
            f"  the same by the vector field:  {listed(found.independent)}",
            f"  largest difference             {np.abs(found.short - found.independent).max():.1e}",
            f"  to t = {found.t[-1]:g}, splitting:      {listed(found.exponents[-1])}",
            f"  their sum                      {found.total:.1e}; pairs ±λ to {found.pairs:.1e}",
            f"  largest by two neighbours      {found.apart:.5f}",
            "  largest, over the second half  {:.4f} ± {:.4f}, a standard error".format(*found.limit),
        ]
    )


def draw(found: Found) -> Figure:
    """The exponents against time."""
    fig, axes = plots.figure(1)
    curves = {f"λ{k + 1}": found.exponents[:, k] for k in range(found.exponents.shape[1])}
    plots.series(axes[0, 0], found.t, curves, "finite-time exponent").axhline(0, lw=0.5, color=plots.GREY)
    return fig
