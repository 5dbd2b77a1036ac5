"""Maps over the rows of a long axis: values, derivatives and bits, of one member and of several."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

pytest.importorskip("llvmlite")

from internals import always_map
from native_members import bits

import lieint_jax as li

N, MEMBERS = 19, 5  # rows, not a multiple of those in a vector
RNG = np.random.default_rng(0)
POINTS, WEIGHTS = RNG.normal(size=(MEMBERS, N, 3)), RNG.uniform(0.5, 2, size=(N, 3))


def moved(x):
    """Shifts, strides, pads and joins along the rows, read by operations along them."""
    y = jnp.sin(x) * WEIGHTS
    apart = y[1:] - y[:-1]
    around = jnp.pad(apart, ((1, 0), (0, 0))) - jnp.pad(jnp.square(apart), ((0, 1), (0, 0)))
    thirds = jnp.exp(y[1::2]) + jnp.cos(y[:-1:2])
    joined = jnp.concatenate([y[:2], jnp.ones((1, 3)), y[3:]]) * around
    mixed = jnp.stack([thirds, 2 * thirds], axis=1).reshape(-1, 3)
    return {"around": around, "joined": joined, "mixed": jnp.tanh(mixed), "back": jnp.exp(y[::-1])[::-1]}


def combined(x):
    """Sums, products and choices of each row, and of all rows."""
    y, t = x * WEIGHTS, jnp.swapaxes(x, 0, 1)
    turned = jnp.einsum("nij,nj->ni", y[:, :, None] * x[:, None, :] + jnp.eye(3), x)
    found = {"turned": turned, "cumulated": jnp.cumsum(jnp.sin(y), axis=1), "product": turned @ jnp.ones((3, 2))}
    found |= {"of columns": jnp.cos(t) * t[:1], "most": jnp.argmax(y, axis=1), "all": jnp.sum(jnp.exp(-y), axis=0)}
    found |= {"chosen": jnp.where(y > 0, jnp.sqrt(jnp.abs(y)), t.T), "positive": jnp.all(y > -2, axis=1)}
    ordered = jnp.take_along_axis(y, jnp.argmin(y, axis=1)[:, None], axis=1)
    return found | {"least": ordered, "entry": lax.dynamic_slice_in_dim(y, jnp.argmax(x[0]), 1, 1) * y}


def repeated(x):
    """Loops whose number of iterations differs from row to row, loops over all rows at once, and over the rows."""

    def root_of(square):
        return lax.while_loop(
            lambda c: jnp.abs(c * c - square) > 1e-14 * square, lambda c: (c + square / c) / 2, square
        )

    mean, means = lax.scan(lambda c, w: ((c + jnp.sin(c * w)) / 2, c), x, jnp.linspace(0.1, 1, 9))
    total, sums = lax.scan(lambda c, row: (c + jnp.cos(row * c), c), jnp.ones(3), x)
    settled = lax.while_loop(lambda y: jnp.max(jnp.abs(y)) > 0.3, lambda y: jnp.sin(y) / 2 - jnp.roll(y, 1, 0) / 9, x)
    side = lax.cond(x[0, 0] > 0, lambda y: jnp.exp(y) + 1, lambda y: y * jnp.ones((N, 3)), mean)
    one, rows = lax.while_loop(lambda c: c[0] < 2, lambda c: (c[0] + 0.3, jnp.sin(c[1] + c[0])), (x[0, 0], x))
    found = {"mean": mean, "means": means[::3], "side": side, "one": one + jnp.exp(one), "rows": rows}
    found |= {"root": jax.vmap(root_of)(1 + jnp.sum(x * x, axis=1))}
    return found | {"total": total, "sums": sums, "settled": settled}


def differentiated(x):
    """The gradient of an energy of neighbors, and its derivative along a direction."""

    def energy(x):
        apart = x[1:] - x[:-1]
        return jnp.sum(WEIGHTS[1:] * jnp.sqrt(1 + apart**2)) + jnp.sum(jnp.sin(x) * WEIGHTS)

    return jax.jvp(jax.grad(energy), (x,), (jnp.cos(x),))


def once(function):
    return lambda x: li.scan(lambda c, _: (c, function(c)), x, length=1)[1]


@pytest.mark.parametrize("function", [moved, combined, pytest.param(repeated, marks=pytest.mark.long), differentiated])
def test_maps_mean_what_xla_does(monkeypatch, function):
    """Observed: 4e-16 of the largest entry. The rows of one member are lanes; among others it has the same bits."""
    always_map(monkeypatch)
    step = jax.jit(jax.vmap(once(function)))
    [loop] = li.explain(step, POINTS).loops
    assert loop.engine == "native", loop.reason
    several = step(POINTS)
    with li.engine("xla"):
        expected = step(POINTS)
    for (path, wanted), x in zip(jax.tree.leaves_with_path(expected), jax.tree.leaves(several), strict=True):
        assert (x.dtype, x.shape) == (wanted.dtype, wanted.shape), path
        most = 2e-15 * np.abs(np.asarray(wanted, float)).max(initial=1)
        np.testing.assert_allclose(x, wanted, rtol=0, atol=most, err_msg=jax.tree_util.keystr(path))
    assert bits(jax.jit(once(function))(POINTS[2])) == bits(jax.tree.map(lambda x: x[2], several))


def exchanged(carry, weight):
    """Arrays that change places, stay, are shifted, or are the same in all rows; what is stored was there before."""
    x, y, z, fixed = carry
    ends = lax.while_loop(lambda c: c[2] < 3, lambda c: (c[1], jnp.sin(c[0]), c[2] + 1), (x, y, 0))
    total = jnp.sum(x * fixed) + jnp.max(jnp.abs(y), axis=0) @ jnp.ones(3) + jnp.any(z > 2)
    after = y, x - 0.1 * ends[0] * weight, jnp.roll(z, 1, axis=1) + jnp.zeros_like(z).at[0].set(total / 99), fixed
    return after, {"before": x, "back": z.T[::-1], "filled": jnp.full((N, 2), weight), "total": total}


def test_arrays_that_are_carried_change_places(monkeypatch):
    """Observed: 5e-16 of the largest entry."""
    always_map(monkeypatch)
    start = POINTS, np.cos(POINTS), np.swapaxes(POINTS, 1, 2), np.broadcast_to(WEIGHTS, POINTS.shape)
    weights = jnp.linspace(0.5, 1.5, 7)
    run = jax.jit(jax.vmap(lambda *x: li.scan(exchanged, x, weights)))
    [loop] = li.explain(run, *start).loops
    assert loop.engine == "native", loop.reason
    several = run(*start)
    with li.engine("xla"):
        expected = run(*start)
    for wanted, x in zip(jax.tree.leaves(expected), jax.tree.leaves(several), strict=True):
        np.testing.assert_allclose(x, wanted, rtol=0, atol=2e-15 * np.abs(np.asarray(wanted)).max())
    one = jax.jit(lambda *x: li.scan(exchanged, x, weights))(*(x[2] for x in start))
    assert bits(one) == bits(jax.tree.map(lambda x: x[2], several))


@pytest.mark.long
def test_a_longer_rod_has_no_longer_program():
    def operations(elements):
        rod = li.systems.rod(1.0, elements, li.systems.Section(1.0, (0.02, 0.03), (40.0, 40.0, 60.0), (0.5, 0.7, 0.6)))
        run = functools.partial(li.integrate, li.schemes.splitting(rod), dt=1e-4, num_steps=4, save_every=4)
        [loop] = li.explain(run, rod.state()).loops
        return loop.engine, loop.operations

    assert operations(40) == operations(300)
    assert operations(40)[0] == "native"


@pytest.mark.long
@pytest.mark.parametrize("scheme", [li.schemes.splitting, li.schemes.bodies_energy_momentum])
def test_a_rod_and_its_derivatives_are_those_of_xla(scheme):
    """Observed: 1e-16 of values, 3e-18 of derivatives of 2e-3; each rod among others has the bits that it has alone."""

    def end(stiffness):
        section = li.systems.Section(1.0, (0.02, 0.03), (40.0, 40.0, 60.0), stiffness * jnp.array([0.5, 0.7, 0.6]))
        rod = li.systems.rod(1.0, 24, section)
        state = rod.state(angular_velocities=jnp.sin(jnp.arange(75.0)).reshape(25, 3))
        return li.integrate(scheme(rod), state, 0.002, 4, save_every=4).state.q[-1]

    def derivatives(stiffness):
        forward = jax.jvp(end, (stiffness,), (1.0,))
        return forward, jax.grad(lambda x: jnp.sum(jnp.sin(end(x))))(stiffness)

    stiffness = jnp.linspace(0.9, 1.1, 3)
    assert li.explain(end, 1.0).loops[0].engine == "native"
    several = jax.jit(jax.vmap(end))(stiffness)
    assert bits(jax.jit(end)(stiffness[1])) == bits(several[1])
    found = jax.jit(derivatives)(1.05)
    with li.engine("xla"):
        np.testing.assert_allclose(several, jax.jit(jax.vmap(end))(stiffness), rtol=0, atol=1e-15)
        for wanted, x in zip(jax.tree.leaves(jax.jit(derivatives)(1.05)), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(
                x, wanted, rtol=0, atol=1e-15 if np.ndim(x) and np.abs(wanted).max() > 0.1 else 1e-17
            )
