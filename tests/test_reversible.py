"""Three derivatives, one answer: forward, reverse through the scan, reverse by undoing steps; and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import steps

import lieint_jax as li
from lieint_jax import studies

N, EVERY = 6, 3
GRID = {name: rest for name, *rest in steps()}
FEW = [
    "rigid_body.asymmetric-so3_midpoint[symplectic]",
    "rigid_body.full_tensor-so3_explicit",
    "heavy_top.asymmetric_top-top_energy_momentum[exponential]",
    "pendulum.quadratic-sphere_midpoint[normalised]",
]


def plain(step, state, dt):
    return li.integrate(step, state, dt, N, EVERY)


def by_reversal(step, state, dt):
    return studies.reversible(step, state, dt, N, EVERY)


def by_checkpoints(step, state, dt):
    return studies.reversible(step, state, dt, N, EVERY, derivative="checkpoint")


def setting(name):
    """A loss of a run, as a function of (real leaves of the step, tangent vector at the state, dt), and a direction."""
    step, state, dt = GRID[name]
    space, rng = step.system.phase_space, np.random.default_rng(0)
    leaves, structure = jax.tree.flatten(step)
    weights = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=(N // EVERY + 1, *x.shape))), state)

    def loss(run, leaves, delta, dt):
        state_ = space.perturb(state, delta)
        seen = run(jax.tree.unflatten(structure, leaves), state_, dt).state
        return sum(jnp.sum(w * x) for w, x in zip(jax.tree.leaves(weights), jax.tree.leaves(seen), strict=True))

    direction = [rng.normal(size=np.shape(x)) * np.abs(x).max() for x in leaves]
    direction = [(d + d.T) / 2 if d.ndim == 2 else d for d in direction]  # inertias stay symmetric
    delta = rng.normal(size=space.dim) * np.repeat([1.0, float(jnp.abs(state.p).max())], space.dim // 2)
    at = ([jnp.asarray(x) for x in leaves], jnp.zeros(space.dim), jnp.asarray(dt))
    return loss, at, ([jnp.asarray(d) for d in direction], jnp.asarray(delta), jnp.asarray(0.3 * dt))


def agree(name):
    loss, at, along = setting(name)

    def moved(t):
        return loss(plain, *jax.tree.map(lambda x, d: x + t * d, at, along))

    forward = jax.jit(lambda: jax.jvp(moved, (0.0,), (1.0,))[1])()
    gradients = [
        jax.jit(jax.grad(lambda *x, run=run: loss(run, *x), argnums=(0, 1, 2)))(*at)
        for run in (plain, by_reversal, by_checkpoints)
    ]
    size = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(gradients[0]))
    for gradient in gradients:
        for one, other in zip(jax.tree.leaves(gradients[0]), jax.tree.leaves(gradient), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10 * size)  # floor 1e-13
        slope = sum(jnp.sum(g * d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
        scale = sum(
            jnp.sum(jnp.abs(g * d)) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True)
        )
        assert abs(slope - forward) <= 1e-9 * scale
    h = 1e-3
    at_ = jax.jit(jax.vmap(moved))(jnp.array([-2 * h, -h, h, 2 * h]))
    difference = (at_[0] - 8 * at_[1] + 8 * at_[2] - at_[3]) / (12 * h)
    assert abs(difference - forward) <= 1e-7 * scale


@pytest.mark.parametrize("name", FEW)
def test_three_derivatives_agree(name):
    agree(name)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GRID if name not in FEW])
def test_three_derivatives_agree_on_the_whole_grid(name):
    agree(name)
