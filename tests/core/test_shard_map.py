"""Inside `jax.shard_map` with its default check, which follows what differs between devices."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
import lieint_jax as li
from jax.sharding import Mesh, PartitionSpec as P

jax.config.update("jax_enable_x64", True)
mesh = Mesh(np.array(jax.devices()), ("m",))
J = jnp.array([1.0, 2.0, 2.5])
body = li.systems.rigid_body(J)
top = li.schemes.nystrom(li.systems.heavy_top(J, [0.0, 0.0, 1.0]), 6)
midpoint = li.schemes.so3_midpoint(body)
W = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))

def run(step, w, save_every=10, **options):
    start = step.system.state(angular_velocity=w)
    return li.integrate(step, start, 0.05, 30, save_every=save_every, **options).state.p[-1]

def event(w):
    return li.event(midpoint, body.state(angular_velocity=w), 0.05, lambda z: z.q[0] - 0.5, max_steps=100).t

functions = {
    "one step": lambda w: midpoint(body.state(angular_velocity=w), 0.05)[0].p,
    "one step with loops": lambda w: top(top.system.state(angular_velocity=w), 0.05)[0].p,
    "run": lambda w: run(top, w),
    "run of a body of its own": lambda w: run(li.schemes.so3_midpoint(li.systems.RigidBody(J * (1 + w[0] ** 2))), w),
    "gradient": jax.grad(lambda w: run(top, w).sum()),
    "gradient by undoing": jax.grad(lambda w: run(midpoint, w, adjoint=li.ReversibleAdjoint()).sum()),
    "tangents": lambda w: jax.jacfwd(lambda w: run(midpoint, w))(w),
    "exponents": lambda w: li.diagnostics.lyapunov(midpoint, body.state(angular_velocity=w), 0.05, 20).exponents,
    "event": event,
    "outputs": lambda w: run(top, w, save_every=1, save_at=[0.1, 0.12, 1.01]),
}
for engine in ("native", "xla"):
    with li.engine(engine):
        for name, of_member in functions.items():
            mapped = jax.vmap(of_member)
            found = jax.jit(jax.shard_map(mapped, mesh=mesh, in_specs=P("m"), out_specs=P("m")))(W)
            np.testing.assert_allclose(found, mapped(W), rtol=1e-10, atol=1e-12, err_msg=f"{engine} {name}")

def loss(scan, a, x):  # a is the same on all devices
    return jax.vmap(lambda x: scan(lambda c, _: (jnp.sin(a * c), None), x, length=10)[0])(x).sum()

x = jnp.linspace(0.1, 1.0, 8)
for scan in (li.scan, jax.lax.scan):
    def shards(f):
        return jax.jit(jax.shard_map(f, mesh=mesh, in_specs=(P(), P("m")), out_specs=P()))

    total = shards(lambda a, x: jax.lax.psum(loss(scan, a, x), "m"))
    of_shards = shards(lambda a, x: jax.grad(loss, 1)(scan, a, x))
    expected = jax.grad(loss, 1)(jax.lax.scan, 1.3, x)
    for found in (jax.grad(total)(1.3, x), of_shards(1.3, x)):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=0)
    try:  # what differs is not passed off as the same
        shards(lambda a, x: loss(scan, a, x))(1.3, x)
    except ValueError as error:
        print("refused" if "replicat" in str(error) else error)
"""


@pytest.mark.long
def test_runs_and_derivatives_pass_the_check_and_are_those_without_shards():
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["refused", "refused"]


ALL_SCHEMES = """
import sys
sys.path.insert(0, sys.argv[1])
import grid, jax, jax.numpy as jnp, numpy as np
import lieint_jax as li
from jax.sharding import Mesh, PartitionSpec as P

jax.config.update("jax_enable_x64", True)
mesh, seen = Mesh(np.array(jax.devices()), ("m",)), set()
for module, name, step, state, dt in grid.cases():
    if module in seen:
        continue
    seen.add(module)
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    for adjoint in (None, li.ReversibleAdjoint()) if step.symmetric else (None,):
        def loss(z):
            return jnp.sum(li.integrate(step, z, dt, 4, save_every=2, adjoint=adjoint).state.p[-1] ** 2)

        slopes = jax.vmap(jax.value_and_grad(loss, allow_int=True))
        try:
            jax.jit(jax.shard_map(slopes, mesh=mesh, in_specs=P("m"), out_specs=P("m"))).trace(states)
        except Exception as error:
            print(name, adjoint, error)
assert seen == grid.schemes()
"""


@pytest.mark.long
def test_gradients_of_every_scheme_pass_the_check():
    """The check is made when JAX traces."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    command = [sys.executable, "-c", ALL_SCHEMES, str(Path(__file__).parents[1] / "lib")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
