"""Runs of some seconds into a store, to be killed and resumed: python tests/lib/killed.py CASE PATH PAUSE [K N].

Each file waits PAUSE seconds for the disk, so that most kills come while a commit is written, on any machine. With K
and N it is part K of N; PATH may be a URL.
"""

import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from internals import commit_every
from small_steps import Paced

import lieint_jax as li

J = jnp.array([1.0, 2.0, 2.5])
MEMBERS = 48


def tilted(Gamma, t):
    return 0.5 * Gamma[0] ** 2 + 0.2 * jnp.cos(t) * Gamma[2]


def axis(t):
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 + 0 * t])


def slowness(state):
    return 1 / (1 + state.p @ state.p)


def tops():
    """Driven tops at one time, with their work."""
    rng = np.random.default_rng(3)
    q = rng.normal(size=(MEMBERS, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    states = li.State(jnp.array(q), jnp.array(rng.normal(size=(MEMBERS, 3))), jnp.asarray(0.7), jnp.asarray(0.0))
    return li.schemes.splitting(li.systems.driven_top(J, tilted, axis)), states


def driven(steps):
    """Outputs at nodes and between them, some of them equal."""
    end = 0.7 + 0.05 * steps
    times = np.sort(np.concatenate([np.linspace(0.7, end, steps // 20), np.full(3, end / 2), [0.75, 0.8]]))
    return (*tops(), {"dt": 0.05, "num_steps": steps, "save_at": times})


def bodies(steps):
    """Pairs of bodies about each other, with outputs at given times."""
    masses, inertias = [1.0, 0.5], [[0.1, 0.12, 0.15], [0.02, 0.03, 0.04]]
    system = li.systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(1.0, masses, inertias))
    rng = np.random.default_rng(5)
    spins = 0.3 * rng.normal(size=(MEMBERS, 2, 3))
    x, v = jnp.array([[-0.5, 0, 0], [1.0, 0, 0]]), jnp.array([[0, -0.4, 0], [0, 0.8, 0]])
    states = jax.vmap(lambda w: system.state(x, velocities=v, angular_velocities=w))(jnp.array(spins))
    times = np.sort(np.random.default_rng(2).uniform(0, 0.01 * steps, steps // 20))
    return li.schemes.splitting(system), states, {"dt": 0.01, "num_steps": steps, "save_at": times}


def own_time(steps):
    """Tops whose steps adapt, each with its own time; they have no outputs at given times."""
    step, states = tops()
    controlled = Paced(step, slowness)
    own = states._replace(t=jnp.full(MEMBERS, 0.7), work=jnp.zeros(MEMBERS))
    return controlled, jax.vmap(controlled.start)(own), {"dt": 0.05, "num_steps": steps, "save_every": 20}


CASES = {"driven": (driven, 120_000), "bodies": (bodies, 120_000), "own_time": (own_time, 120_000)}


def main(case, path, pause, *part):
    sync = os.fsync
    os.fsync = lambda descriptor: (time.sleep(float(pause)), sync(descriptor))[1]
    jax.config.update("jax_enable_x64", True)
    commit_every(pytest.MonkeyPatch(), 100, in_bucket=1000)
    make, steps = CASES[case]
    step, states, options = make(steps)
    numbers = tuple(map(int, part)) or None
    li.run(step, states, store=path, resume=True, progress=False, part=numbers, **options)


if __name__ == "__main__":
    main(*sys.argv[1:])
