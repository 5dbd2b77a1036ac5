"""Derivatives of runs by every number: forward mode, reverse mode in three ways, and differences.

A number is a real leaf of the step, such as an inertia, a coefficient of a law or an element of an orbit, a coordinate
of the state, dt, and, if asked for, the time, the work and extra momenta of the state.
"""

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

N, EVERY, H = 6, 3, 1e-3
INNER = ("t", "work", "extra")


def plain(step, state, dt):
    return li.integrate(step, state, dt, N, save_every=EVERY)


def by_reversal(step, state, dt):
    return li.integrate(step, state, dt, N, save_every=EVERY, adjoint=li.ReversibleAdjoint())


def by_checkpoints(step, state, dt):
    return li.integrate(step, state, dt, N, save_every=EVERY, adjoint=li.RecursiveCheckpointAdjoint())


def setting(step, state, dt, others):
    """A loss of a run, where it is differentiated, and a direction, in the order of size of the numbers."""
    space, rng = step.system.phase_space, np.random.default_rng(0)
    leaves, structure = jax.tree.flatten(step)
    rest, unravel = jax.flatten_util.ravel_pytree({x: getattr(state, x) for x in others})
    weights = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=(N // EVERY + 1, *np.shape(x)))), state)

    def loss(run, leaves, delta, rest, dt):
        start = space.perturb(state, delta)._replace(**unravel(rest))
        seen = run(jax.tree.unflatten(structure, leaves), start, dt).state
        return sum(jnp.sum(w * x) for w, x in zip(jax.tree.leaves(weights), jax.tree.leaves(seen), strict=True))

    direction = [rng.normal(size=np.shape(x)) * np.abs(x).max(initial=0) for x in leaves]
    direction = [(d + d.T) / 2 if d.shape == d.T.shape and d.ndim == 2 else d for d in direction]  # inertias stay so
    momenta = space.dim // 2 if state.p.size else 0
    units = np.repeat([1.0, float(jnp.abs(state.p).max(initial=0))], [space.dim - momenta, momenta])
    delta = rng.normal(size=space.dim) * units
    at = ([jnp.asarray(x) for x in leaves], jnp.zeros(space.dim), rest, jnp.asarray(dt))
    along = (
        [jnp.asarray(d) for d in direction],
        jnp.asarray(delta),
        rng.normal(size=rest.shape),
        jnp.asarray(0.3 * dt),
    )
    return loss, at, along


def errors(step, state, dt, others=INNER):
    """Of gradients by their largest entry; of forward mode and of differences by the sum of their terms' sizes.

    A step that is not symmetric cannot be undone, and has one gradient.
    """
    loss, at, along = setting(step, step.start(state), dt, others)

    def loss_along(t):
        return loss(plain, *jax.tree.map(lambda x, d: x + t * d, at, along))

    forward = jax.jit(lambda: jax.jvp(loss_along, (0.0,), (1.0,))[1])()
    gradients = [
        jax.tree.leaves(jax.jit(jax.grad(lambda *x, run=run: loss(run, *x), argnums=(0, 1, 2, 3)))(*at))
        for run in ((plain, by_reversal, by_checkpoints) if step.symmetric else (plain,))
    ]
    size = max(np.abs(g).max(initial=0) for g in gradients[0])
    off = max(np.abs(a - b).max(initial=0) for g in gradients for a, b in zip(g, gradients[0], strict=True)) / size
    terms = [[np.sum(g * d) for g, d in zip(found, jax.tree.leaves(along), strict=True)] for found in gradients]
    scale = sum(np.sum(np.abs(g * d)) for g, d in zip(gradients[0], jax.tree.leaves(along), strict=True))
    f = jax.jit(jax.vmap(loss_along))(H * jnp.array([-2.0, -1, 1, 2]))
    difference = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * H)
    return off, max(abs(sum(x) - forward) for x in terms) / scale, abs(difference - forward) / scale


def assert_agree(*case):
    """The derivatives of a run of a (step, state, dt) by every number agree, and differences to their own error."""
    gradients, forward, difference = errors(*case)
    assert max(gradients, forward) < 1e-12
    assert difference < 1e-8
