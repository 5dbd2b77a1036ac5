"""Custom callables that are pytrees with leaves that are no arrays, such as a neural network with its activation."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import core


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True)
class Net:
    """A network x ↦ outer·act(inner x), all of whose fields are leaves, as in Equinox."""

    inner: object
    outer: object
    act: object = jnp.tanh
    note: object = "a leaf of text"

    def __call__(self, *x):
        x = jnp.concatenate([jnp.ravel(part) for part in x])
        return self.outer @ self.act(self.inner @ x)

    def tree_flatten(self):
        return (self.inner, self.outer, self.act, self.note), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        x = object.__new__(cls)
        for field, leaf in zip(dataclasses.fields(cls), leaves, strict=True):
            object.__setattr__(x, field.name, leaf)
        return x


def damped(x):
    return x * jnp.exp(-x * x)


def net(inputs, *outputs, act=jnp.tanh, seed=0):
    rng = np.random.default_rng(seed)
    return Net(jnp.array(rng.normal(size=(4, inputs))) / 4, jnp.array(rng.normal(size=(*outputs, 4))) / 4, act)


J = [1.0, 2.0, 3.0]
ONE = jnp.eye(3)
STATE = dict(attitude=[1, 0, 0, 0], angular_velocity=[0.2, 0.1, 1.0])
TWO = dict(positions=[[0.0, 0, 0], [1.0, 0, 0]], attitudes=[[1.0, 0, 0, 0]] * 2, velocities=np.zeros((2, 3)))
SYSTEMS = {
    "potential_top": lambda: (li.systems.potential_top(J, net(3)), STATE, "potential"),
    "driven_top": lambda: (li.systems.driven_top(J, net(4), axis=ONE[2]), STATE, "potential"),
    "torqued_body": lambda: (li.systems.torqued_body(J, net(8, 3)), STATE, "torque"),
    "sum of laws": lambda: (li.systems.torqued_body(J, li.torques.viscous(0.1) + net(8, 3)), STATE, "torque"),
    "driven_gyrostat": lambda: (li.systems.driven_gyrostat(J, net(1, 3)), STATE | {"rotor": [0.1, 0, 0]}, "motor"),
    "rigid_bodies": lambda: (
        li.systems.rigid_bodies([1.0, 2.0], [J, J], net(24)),
        TWO | {"angular_velocities": np.ones((2, 3))},
        "potential",
    ),
    "group_potential": lambda: (
        li.systems.group_potential(li.groups.special_orthogonal(3), J, net(9)),
        {"velocity": [0.1, 0.2, 0.3]},
        "potential",
    ),
    "pendulum": lambda: (
        li.systems.pendulum(1.0, net(1), [0.0, 0, 1.0]),
        {"direction": [1.0, 0, 0], "velocity": [0, 0.1, 0]},
        "potential",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_of_a_network_is_a_pytree_of_arrays_and_has_states(name):
    system, motion, field = SYSTEMS[name]()
    leaves, structure = jax.tree.flatten(system)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert structure == jax.tree.structure(SYSTEMS[name]()[0])
    assert hash(structure) == hash(jax.tree.structure(SYSTEMS[name]()[0]))
    assert getattr(system, field) is not None
    state = system.state(**motion)
    energy = jax.jit(lambda system, state: system.energy(state))(system, state)
    assert np.isfinite(energy)


def body_of(network):
    return li.systems.potential_top(J, network)


def test_the_partition_is_of_the_leaves_that_are_no_numbers():
    """Only there: what has numbers alone stays the object that the user gave."""
    plain = jax.tree_util.Partial(lambda w, g: w * g[0], 2.0)
    assert core.callable_pytree(plain) is plain
    assert body_of(plain).potential is plain
    given = net(3, act=damped)
    found = body_of(given).potential
    assert found.act is damped
    assert found.note == "a leaf of text"
    assert found(ONE[0]) == given(ONE[0])
    assert core.callable_pytree(found) is found
    assert jax.tree.structure(found) != jax.tree.structure(body_of(net(3, act=jnp.sin)).potential)
    for other in (copy.copy(found), copy.deepcopy(found), pickle.loads(pickle.dumps(body_of(given))).potential):
        assert other(ONE[0]) == found(ONE[0])
        assert jax.tree.structure(other) == jax.tree.structure(found)
    unhashable = Net(given.inner, given.outer, damped, note={2})
    assert body_of(unhashable).potential(ONE[0]) == given(ONE[0])
    assert core.callable_pytree(unhashable).note is unhashable.note


def loss_of(network):
    body = body_of(network)
    step = li.schemes.splitting(body)
    return jnp.sum(step(body.state(**STATE), 0.1)[0].p ** 2)


@pytest.mark.long
def test_derivatives_by_the_arrays_of_a_network():
    """Through a step, with respect to the weights, and with respect to the system, against differences."""
    given, h = net(3), 1e-5

    def loss(w):
        return loss_of(Net(w, given.outer))

    slope = jax.jit(jax.grad(loss))(given.inner)
    run = jax.jit(loss)
    for k in ((0, 0), (3, 2)):
        ahead, behind = (run(given.inner.at[k].add(s)) for s in (h, -h))
        np.testing.assert_allclose(slope[k], (ahead - behind) / (2 * h), rtol=1e-7, atol=1e-10)

    def of_body(body):
        return jnp.sum(li.schemes.splitting(body)(body.state(**STATE), 0.1)[0].p ** 2)

    by_system = jax.grad(of_body)(body_of(given))
    assert by_system.potential.inner.shape == given.inner.shape
    several = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), body_of(given))
    assert jax.vmap(lambda body: body.potential(ONE[2]))(several).shape == (2,)


@pytest.mark.long
def test_a_fit_finds_the_weight_of_a_network():
    given = net(3)

    def residuals(scale):
        body = body_of(Net(given.inner, scale * given.outer))
        return li.schemes.splitting(body)(body.state(**STATE), 0.5)[0].p

    goal = residuals(1.0)
    found = li.fit(lambda scale: residuals(scale) - goal, 0.5)
    np.testing.assert_allclose(found.params, 1.0, rtol=1e-6)


@pytest.mark.long
def test_an_ensemble_of_a_network_and_its_store(tmp_path):
    """The run of members, a reduced quantity that is a network too, and the system rebuilt from the store."""
    given = net(3)
    body = body_of(given)
    step = li.schemes.splitting(body)
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.array([[0.2, 0.1, 1.0], [0.1, 0.3, 0.8]]))
    run = li.run(step, states, 0.1, 4, save_every=2, store=tmp_path / "run.zarr", progress=False)
    own = {f"{Net.__module__}.Net": Net, "jax.numpy.tanh": jnp.tanh}
    name = f"{jnp.tanh.__module__}.{jnp.tanh.__qualname__}"
    found = li.open(tmp_path / "run.zarr", own=own | {name: jnp.tanh})
    system = found.system
    np.testing.assert_array_equal(found.state.p, run.state.p)
    first = jax.tree.map(lambda x: jnp.asarray(x[-1, 0]), found.state)
    np.testing.assert_allclose(system.energy(first), body.energy(first), rtol=1e-14)
    assert jax.tree.structure(system.potential) == jax.tree.structure(body.potential)
    summary = li.run(step, states, 0.1, 4, reduce=Measure(net(3)), progress=False, save_every=None).summary
    assert np.isfinite(summary.greatest).all()


@jax.tree_util.register_pytree_node_class
class Measure:
    """A reduced quantity that holds a network."""

    def __init__(self, network):
        self.network = network

    def __call__(self, step, state):
        return self.network(state.p)

    def tree_flatten(self):
        return (self.network,), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls(*leaves)


@pytest.mark.long
def test_an_equinox_network_is_a_potential_and_a_law():
    eqx = pytest.importorskip("equinox")
    mlp = eqx.nn.MLP(3, "scalar", 8, 1, key=jax.random.key(0))
    body = li.systems.potential_top(J, mlp)
    step = li.schemes.splitting(body)
    _, info = jax.jit(lambda step, z: step(z, 0.1))(step, body.state(**STATE))
    assert info.converged
    assert body.potential.layers[0].weight is mlp.layers[0].weight

    @eqx.filter_grad
    def slope(mlp):
        body = li.systems.potential_top(J, mlp)
        return jnp.sum(li.schemes.splitting(body)(body.state(**STATE), 0.1)[0].p ** 2)

    assert np.abs(slope(mlp).layers[0].weight).max() > 0

    class Law(eqx.Module):
        mlp: eqx.nn.MLP

        def __call__(self, t, q, omega):
            return self.mlp(omega) - omega

    driven = li.systems.torqued_body(J, Law(eqx.nn.MLP(3, 3, 8, 1, key=jax.random.key(1))))
    step = li.schemes.torqued_midpoint(driven)
    assert jax.jit(lambda step, z: step(z, 0.1))(step, driven.state(**STATE))[1].converged
