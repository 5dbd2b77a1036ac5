"""Members that plain `jax.jit` finds spread over devices: each device computes its own."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import re, sys
import jax, jax.numpy as jnp, numpy as np
import lieint_jax as li
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as P

jax.config.update("jax_enable_x64", True)
devices = np.array(jax.devices())
line, square = Mesh(devices, ("m",)), Mesh(devices.reshape(2, 2), ("a", "b"))
explicit = Mesh(devices, ("m",), (AxisType.Explicit,))  # the default of jax.make_mesh since JAX 0.12
W = np.random.default_rng(0).normal(size=(16, 3))
J = jnp.array([1.0, 2.0, 2.5])

def end(w, J=J, part="q", **options):
    step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
    run = li.integrate(step, step.system.state(angular_velocity=w), 0.05, 100, save_every=50, **options)
    return getattr(run.state, part)[-1]

def map_logistic(w):
    return li.scan(lambda c, _: (3.2 * c * (1 - c), c), 0.5 + 0.1 * w[0], length=60, every=20)

def many(f):
    return lambda w: jax.vmap(f)(w)

def slopes(f):
    return jax.grad(lambda w: jax.vmap(f)(w).sum())

by_undoing = {"adjoint": li.ReversibleAdjoint()}
cases = {  # function, mesh, axes of the members, collective operations that it needs
    "values": (many(end), line, "m", set()),
    "gradients": (slopes(end), line, "m", set()),
    "gradients, explicit": (many(jax.grad(lambda w: end(w)[0])), explicit, "m", set()),
} if sys.argv[1] == "quick" else {
    "rows and ends": (many(map_logistic), line, "m", set()),
    "rows and ends, explicit": (many(map_logistic), explicit, "m", set()),
    "gradient of what they share": (
        lambda w: jax.grad(lambda J: many(lambda w: end(w, J))(w).sum())(J), line, "m", {"all-reduce"}),
    "two axes of a mesh": (many(end), square, ("a", "b"), set()),
    "one of two axes": (slopes(end), square, "b", set()),
    "by undoing": (slopes(lambda w: end(w, **by_undoing)), line, "m", {"all-reduce", "all-gather"}),  # for its warning
    "tangents": (many(jax.jacfwd(end)), line, "m", set()),
    "tangents that they share": (  # sent from the first member's device to all
        many(jax.jacfwd(lambda w: end(w, part="p"))), line, "m", {"all-reduce"}),
    "parameters inside of members": (
        many(lambda w: jax.vmap(lambda s: end(s * w))(jnp.linspace(1.0, 1.1, 3))), line, "m", set()),
}
for name, (f, mesh, axes, wanted) in cases.items():
    x = jax.device_put(W, NamedSharding(mesh, P(axes)))
    compiled = jax.jit(f).lower(x).compile()
    text = compiled.as_text()
    assert "lieint_march" in text, name
    found = {word for word in ("all-gather", "all-reduce", "all-to-all", "collective-permute") if f"{word}(" in text}
    assert found <= wanted, (name, found)
    for y, expected in zip(jax.tree.leaves(compiled(x)), jax.tree.leaves(jax.jit(f)(W)), strict=True):
        if "they share" in name:  # the same on all devices; the gradient is summed in another order
            np.testing.assert_allclose(y, expected, rtol=1e-13, atol=0)
        else:
            np.testing.assert_array_equal(y, expected, err_msg=name)
            assert y.sharding.spec[0] == axes or y.sharding.spec[1] == axes, (name, y.sharding)
            assert y.addressable_shards[0].data.size < y.size, name
    if "explicit" in name:  # the types say it too, so that what follows in a program is spread alike
        assert all("m" in y.sharding.spec for y in jax.tree.leaves(jax.eval_shape(f, x))), name
"""


def spread_over_four_devices(which):
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    done = subprocess.run([sys.executable, "-c", SCRIPT, which], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_each_device_computes_its_members():
    spread_over_four_devices("quick")


@pytest.mark.long
def test_each_device_computes_its_members_in_other_functions():
    spread_over_four_devices("other")
