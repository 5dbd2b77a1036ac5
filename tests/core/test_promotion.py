"""Nothing depends on implicit promotion of types or ranks (`jax_numpy_dtype_promotion`, `jax_numpy_rank_promotion`)."""

import contextlib

import jax
import jax.numpy as jnp
import pytest
from grid import cases

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = BODY.state(angular_velocity=[0.2, 0.0, 1.0])
STEP = li.schemes.so3_midpoint(BODY)
DRIVEN = li.systems.torqued_body(BODY.inertia, li.torques.viscous(0.1))
SHAPES = [li.shapes.box([3.0, 2.0, 1.0], mass=2.0), li.shapes.ellipsoid([1.0, 1.0, 0.5], mass=1.0)]


@contextlib.contextmanager
def strict():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=lambda case: case[1])
def test_a_step_of_every_scheme_and_system(case):
    """Traced only: a promotion is refused while JAX traces."""
    with strict():
        jax.eval_shape(*case[2:])


def worked():
    step, state = li.schemes.torqued_midpoint(DRIVEN), DRIVEN.state(angular_velocity=[0.2, 0.0, 1.0], work=0.0)
    return li.integrate(step, state, 0.05, 3, save_at=[0.07, 0.11]).info


def fallen():
    potential = li.potentials.mutual_gravity(1.0, SHAPES)
    return potential(jnp.array([[0.0, 0.0, 0.0], [9.0, 1.0, 0.0]]), jnp.stack([jnp.eye(3)] * 2))


def near():
    mesh = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    stone = li.potentials.polyhedron(1.0, mesh, 6.0)
    bodies = li.systems.rigid_bodies([1.0, 0.1], [[1.0, 2.0, 2.5]] * 2, stone)
    return bodies.force(jnp.array([[0.0, 0, 0, 1, 0, 0, 0], [3.0, 0, 0, 1, 0, 0, 0]])), stone.laplacian([1.0, 1.0, 1.0])


def undone(dt):
    options = dict(save_every=2, adjoint=li.ReversibleAdjoint())
    return li.integrate(STEP, STATE, dt, 4, **options).state.q[-1, 0]


RUNS = {
    "integrate": lambda: li.integrate(STEP, STATE, 0.05, 3),
    "works": worked,
    "undone": lambda: li.integrate(STEP, STATE, 0.05, save_at=[0.12, 0.1], adjoint=li.ReversibleAdjoint()),
    "event": lambda: li.event(STEP, STATE, 0.05, lambda z: z.q[0] - 0.99, max_steps=20),
    "saved at times": lambda: li.integrate(STEP, STATE, 0.05, 3, save_at=[0.07, 0.11]),
    "found event": lambda: li.event(STEP, STATE, 0.05, lambda z: z.q[0] - 0.99, max_steps=20),
    "fit": lambda: li.fit(lambda p: p - 1.0, jnp.array([0.0, 2.0])),
    "run": lambda: li.run(STEP, jax.tree.map(lambda x: jnp.stack([x] * 3), STATE), 0.05, 4, save_every=2),
    "transition": lambda: li.transition(STEP, STATE, 0.05, 3),
    "scan": lambda: li.scan(lambda c, _: (jnp.sin(c), c), 0.5, length=3),
    "interpolate": lambda: li.interpolate(BODY, li.integrate(STEP, STATE, 0.05, 3), [0.06]),
    "adjoint": lambda: jax.grad(undone)(0.05),
    "ensemble": lambda: li.run(STEP, jax.tree.map(lambda x: jnp.stack([x] * 3), STATE), 0.05, 3, save_every=None),
    "certify": lambda: li.diagnostics.certify(STEP, STATE, 0.05, 8),
    "lyapunov": lambda: li.diagnostics.lyapunov(STEP, STATE, 0.05, 32),
    "mutual_gravity": fallen,
    "polyhedron": near,
    "shapes": lambda: SHAPES[0] + SHAPES[1].moved([1.0, 0.0, 0.0]),
}
COMPUTED = {
    "ensemble",
    "certify",
    "shapes",
    "saved at times",
    "found event",
    "fit",
    "run",
}  # the others are traced only


@pytest.mark.long
@pytest.mark.parametrize("name", RUNS)
def test_a_run(name):
    with strict():
        RUNS[name]() if name in COMPUTED else jax.eval_shape(RUNS[name])
