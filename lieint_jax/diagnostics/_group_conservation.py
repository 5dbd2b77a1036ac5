"""What the midpoint scheme conserves on a matrix group, over random metrics."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _checks
from lieint_jax._xla import rereading_jit
from lieint_jax.core import State
from lieint_jax.diagnostics._symplectic import symplectic_defect
from lieint_jax.groups import MatrixGroup
from lieint_jax.maps import Map
from lieint_jax.runs import Run, integrate
from lieint_jax.schemes import group_midpoint
from lieint_jax.systems import Euler

__all__ = ["GroupConservation", "group_conservation", "random_geodesic"]

_QUICK = {"xla_llvm_disable_expensive_passes": True}  # for programs that run once


class GroupConservation(NamedTuple):
    """Errors of the conserved quantities on one group with one map, the largest over several random metrics.

    Attributes:
        energy: largest |H − H₀|/H₀: over 1000 steps of 0.1 where Ad_q is bounded; else over 100 steps of 0.05, divided
            by max(1, ‖Ad_q‖²).
        momentum: largest change of π; 0 if it is conserved bit for bit.
        form: largest symplectic defect of a step of 0.05, in the basis of the group.
        converged: whether every step of these runs converged.
    """

    energy: float
    momentum: float
    form: float
    converged: bool


def random_geodesic(group: MatrixGroup, seed: int = 0) -> tuple[Euler, State]:
    """A random metric on a group, not diagonal, and a random state with |Ω| = 1.

    Its arithmetic is that of whole arrays in place of unrolled loops: quick to compile, but slow to run.
    """
    rng, d = np.random.default_rng(_checks.count("seed", seed, 0)), group.dim
    A, v, xi = rng.normal(size=(d, d)), rng.normal(size=d), rng.normal(size=d) / 3
    plain = MatrixGroup(group.basis, group.name, unrolled=False)
    system = Euler(jnp.asarray(A @ A.T / d + np.eye(d)), plain)
    with jax.ensure_compile_time_eval():
        q = plain.exp(jnp.asarray(xi))
    return system, system.state(q, velocity=v / np.linalg.norm(v))


def group_conservation(group: MatrixGroup, tau: Map, metrics: int = 4) -> GroupConservation:
    """Measure what `schemes.group_midpoint` conserves on a group with a map τ, over `metrics` random metrics.

    Every map conserves energy and spatial momentum on every group (Results 9 and 10); the symplectic form is conserved
    only where (5.31) holds (Result 11).

    Args:
        group: a group of the catalogue, or `groups.matrix(basis)`.
        tau: one of the maps that are defined on it, `maps.defined_on(group)`.
        metrics: their number.
    """
    metrics = _checks.count("metrics", metrics, 1)
    dt, steps = (0.1, 1000) if group.has_bounded_adjoint else (0.05, 100)
    systems, states = zip(*(random_geodesic(group, seed) for seed in range(metrics)), strict=True)
    stacked = [jax.tree.map(lambda *x: jnp.stack(x), *trees) for trees in (systems, states)]
    energy, growth, momentum, form, converged = jax.vmap(partial(_measure_metric, tau, dt, steps))(*stacked)
    scale = 1.0 if group.has_bounded_adjoint else np.maximum(1, np.asarray(growth) ** 2)
    energy, momentum, form = (float(np.max(x)) for x in (energy / scale, momentum, form))
    return GroupConservation(energy, momentum, form, bool(np.all(converged)))


@partial(rereading_jit, static_argnums=(0, 1, 2), compiler_options=_QUICK)
def _measure_metric(tau: Map, dt: float, steps: int, system: Euler, state: State) -> tuple[Array, ...]:
    """Energy error, largest ‖Ad_q‖, change of momentum, symplectic defect and convergence, with one metric."""
    step = group_midpoint(system, tau)
    run = Run.of(step, integrate(step, state, dt, steps, save_every=steps // 10))
    identity = jnp.eye(system.group.dim)
    Ad_q = jax.vmap(lambda q: jax.vmap(system.group.Ad, (None, 1), 1)(q, identity))(run.state.q)
    return (
        jnp.max(jnp.abs(run.energy_error())) / system.energy(state),
        jnp.max(jnp.linalg.norm(Ad_q, axis=(1, 2))),
        jnp.max(jnp.abs(run.state.p - state.p)),
        symplectic_defect(step, state, 0.05),
        jnp.all(run.info.converged),
    )
