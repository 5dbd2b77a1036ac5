"""The tangent vectors that a step carries along: closed forms against derivatives of the step itself."""

import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import turned
from grid import examples_of
from small_steps import Rests

import lieint_jax as li
from lieint_jax import diagnostics, maps, schemes, systems

BODY = systems.rigid_body(turned([1.0, 2.0, 3.0]))
STATE = BODY.state([0.5, -0.1, 0.7, 0.5], angular_velocity=[0.3, 0.5, -0.4])
SATELLITE, START, _ = examples_of("gravity_gradient")["satellite"]
FLUID = systems.kirchhoff((3.0, 2.0, 1.0), center_of_mass=(0.0, 0.0, -0.2))
AFLOAT = FLUID.state(velocity=[0.2, 0.1, 0.5, 0.3, 0.1, 0.2])
WHEEL = systems.gyrostat([1.0, 2.0, 3.0], [0.3, 0.1, -0.2])
GRID = [pytest.param(*case, id=case[1]) for case in grid.cases()]


@jax.jit
def pushed_forward(step, state, dt):
    """By the step's own `tangent`, by that of any step, and the step."""
    T = jnp.eye(step.system.phase_space.dim)
    return step.tangent(state, dt, T), li.Step.advance_tangents(step, state, dt, T), step(state, dt)


def check(step, state, dt):
    own, generic, plain = jax.device_get(pushed_forward(step, state, dt))
    size = np.abs(generic[2]).max()
    np.testing.assert_allclose(own[2], generic[2], rtol=0, atol=1e-14 * size)  # observed 7e-16
    for a, b in zip(jax.tree.leaves(own[:1]), jax.tree.leaves(plain[:1]), strict=True):
        most = 4e-15 * np.abs(b).max(initial=1)  # observed 1.1e-15, the work of five sub-steps
        np.testing.assert_allclose(a, b, rtol=0, atol=most)
    assert own[1].converged == plain[1].converged
    return own


@pytest.mark.long
@pytest.mark.parametrize("name", ["rotations", "motions of a body in a fluid", "three bodies"])
def test_a_tangent_vector_is_the_derivative_of_a_perturbation(name):
    """And `trivialize` gives its coordinates back."""
    fluid = systems.kirchhoff((3.0, 2.0, 1.0))
    space, state = {
        "rotations": (BODY.phase_space, STATE),
        "motions of a body in a fluid": (fluid.phase_space, fluid.state(velocity=[0.2, 0.1, 0.5, 0.3, 0.1, 0.2])),
        "three bodies": ((bodies := li.phase_spaces.CotangentMotions(3)), bodies.origin),
    }[name]
    state = space.perturb(state, jnp.sin(jnp.arange(float(space.dim))))
    delta = jnp.cos(jnp.arange(float(space.dim)))
    tangent = space.tangent(state, delta)
    by_jvp = jax.jvp(lambda x: space.perturb(state, x), (0 * delta,), (delta,))[1]
    near = dict(rtol=0, atol=1e-15 * float(jnp.abs(by_jvp.q).max()))
    np.testing.assert_allclose(tangent[0], by_jvp.q, **near)
    np.testing.assert_array_equal(tangent[1], by_jvp.p)
    np.testing.assert_allclose(space.trivialize(state, by_jvp), delta, rtol=0, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize(
    ("step", "state"),
    [
        pytest.param(schemes.so3_midpoint(BODY), STATE, id="symplectic"),
        pytest.param(schemes.splitting(SATELLITE), START, id="satellite"),
        pytest.param(schemes.compose(schemes.splitting(SATELLITE), 4), START, id="composed"),
        pytest.param(schemes.compose(schemes.so3_midpoint(BODY), 8), STATE, id="commuting"),
        pytest.param(schemes.so3_midpoint(BODY, maps.kappa_cayley), STATE, id="cayley"),
        pytest.param(schemes.group_midpoint(FLUID), AFLOAT, id="motions"),
        pytest.param(schemes.group_midpoint(FLUID, maps.cayley), AFLOAT, id="motions by cayley"),
        pytest.param(schemes.splitting(WHEEL), WHEEL.state(angular_velocity=[0.2, 0.5, -0.3]), id="wheel"),
    ],
)
def test_the_closed_form_is_the_derivative(step, state):
    for dt in (0.4, -0.7):
        own = check(step, state, dt)
        if step.system is SATELLITE:
            assert own[0].t == pytest.approx(float(START.t) + dt, abs=1e-15)
        L = diagnostics.linearization(step, state, dt)
        np.testing.assert_allclose(own[2], L, rtol=0, atol=1e-14 * np.abs(L).max())


def test_the_closed_form_of_the_kicks_is_their_derivative():
    top = systems.heavy_top([1.0, 2.0, 3.0], [0.3, -0.2, 1.0])
    check(schemes.Splitting(top, Rests(top.free)), STATE, 0.4)


@pytest.mark.paper("3: (3.1), (3.2)", "symplectic maps", "diagnostics/_symplectic.py")
@pytest.mark.long
@pytest.mark.parametrize(("scheme", "name", "step", "state", "dt"), GRID)
def test_every_step_maps_tangent_vectors_by_its_derivative_and_conserves_the_form_it_declares(
    scheme, name, step, state, dt
):
    """And a symmetric step is undone by that of −Δt, with time, work and inner states."""
    state = jax.tree.map(jnp.asarray, state)
    end, info, L = check(step, state, dt)
    assert info.converged
    if grid.declares(scheme, name, "form"):
        before, after = (step.system.phase_space.omega(z) for z in (state, end))
        np.testing.assert_allclose(
            L.T @ after @ L, before, rtol=0, atol=1e-14 * np.abs(before).max() * np.abs(L).max() ** 2
        )
    if step.symmetric:
        back, _ = pushed_forward(step, end, -dt)[2]
        for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(state), strict=True):
            most = 1.2e-14 * max(np.abs(b).max(initial=0), 1)  # observed 5.3e-15, of an incompressible body
            np.testing.assert_allclose(a, b, rtol=0, atol=most)


@pytest.mark.long
def test_tangent_can_be_vmapped_and_keeps_its_dtype():
    """One tangent vector of each member, in single precision."""
    step, state = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (schemes.so3_midpoint(BODY), STATE))
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    T = jnp.asarray(np.eye(6, 2).T[:, :, None], jnp.float32)
    _, info, moved = jax.jit(jax.vmap(step.tangent, in_axes=(0, None, 0)))(states, jnp.float32(0.3), T)
    L = jax.jit(schemes.so3_midpoint(BODY).tangent)(STATE, 0.3, jnp.eye(6))[2]
    assert moved.dtype == np.float32
    assert info.converged.all()
    np.testing.assert_allclose(moved[:, :, 0], L[:, :2].T, rtol=0, atol=2e-6)
