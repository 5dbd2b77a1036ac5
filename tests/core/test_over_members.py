"""Gradients and fits over members, split over devices."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

import lieint_jax as li

# Gradients of 3 members, by undoing steps; 16 fits of 8 parameters to 300 residuals each; on what argv says.
WORK = """
import json, sys, warnings
import jax, jax.numpy as jnp, numpy as np
import lieint_jax as li

devices = int(sys.argv[1])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", devices)
body = li.systems.rigid_body([1.0, 2.0, 3.0])

def last(J, rate):
    step = li.schemes.so3_midpoint(li.systems.RigidBody(J))
    start, undo = body.state(angular_velocity=rate), li.ReversibleAdjoint(tolerance=1e-300)
    return li.integrate(step, start, 0.05, 40, save_every=40, adjoint=undo).state.q[-1, 0]

rates = np.array([[0.2, 0.3, 1.0], [0.1, 0.2, 0.3], [1.0, 1.0, 2.0]])
with warnings.catch_warnings(record=True) as drawn:
    warnings.simplefilter("always")
    slopes = np.asarray(li.over_members(jax.grad(last), (None, 0))(np.asarray(body.inertia), rates))

x = jnp.linspace(0, 3, 300)

def residuals(c, data):
    return jnp.polyval(jnp.sin(c), x) - data

truth = np.random.default_rng(0).uniform(-1, 1, (16, 8))
data = np.stack([np.polyval(np.sin(c), x) for c in truth])
found = li.fit(residuals, truth + 0.1, starts=True, data=data, progress=False)
away = np.abs(found.starts.params - truth).max()
print(json.dumps({
    "devices": jax.device_count(), "warned": len(drawn), "slopes": slopes.tolist(), "away": float(away),
    "sigma": np.sqrt(np.diagonal(found.starts.covariance[3])).tolist(), "success": bool(found.starts.success.all()),
}))
"""


def worked(*devices):
    """What WORK prints in processes of so many devices."""
    commands = [[sys.executable, "-c", WORK, str(count)] for count in devices]
    running = [subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for c in commands]
    try:
        told = [process.communicate(timeout=200) for process in running]
    finally:
        for process in running:
            process.kill()
    for process, (_, error) in zip(running, told, strict=True):
        assert process.returncode == 0, error
    return [json.loads(out.splitlines()[-1]) for out, _ in told]


@pytest.mark.long
def test_devices_give_what_one_device_gives():
    one, two = worked(1, 2)
    assert [found["devices"] for found in (one, two)] == [1, 2]
    assert two["warned"] >= 1
    for found in (one, two):
        assert found["success"]
        assert found["away"] < 1e-9
        np.testing.assert_allclose(found["slopes"], one["slopes"], rtol=1e-13)
        np.testing.assert_allclose(found["sigma"], one["sigma"], rtol=1e-9)


@pytest.mark.long
def test_over_members_is_vmap():
    def slope(k, a):
        return jax.grad(lambda k: jnp.sum(a * jnp.exp(-k * jnp.arange(5.0))))(k)

    k = jnp.linspace(0.1, 1, 5)
    many = li.over_members(slope, (0, None))
    np.testing.assert_allclose(many(k, 2.0), jax.vmap(slope, (0, None))(k, 2.0), rtol=1e-15)
    again = jax.jit(jax.grad(lambda k: many(k, 2.0).sum()))(k)
    np.testing.assert_allclose(again, jax.vmap(lambda k: jax.grad(slope)(k, 2.0))(k), rtol=1e-13)
    with pytest.raises(ValueError, match="the same number of members"):
        li.over_members(slope)(k, jnp.ones(4))
    with pytest.raises(ValueError, match="in_axes"):
        li.over_members(slope, (None, None))(k, 2.0)
    with pytest.raises(ValueError, match="one axis"):
        li.over_members(slope, mesh=Mesh(np.array(jax.devices()), ("x",)))
