"""Integers of NumPy and JAX are accepted as Python's, as lengths often are; truth values and floats are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
STATE = BODY.state(angular_velocity=[0.1, 0.2, 1.0])
TWO = jax.tree.map(lambda x: jnp.stack([x, x]), STATE)
TOP = li.systems.heavy_top([1.0, 2.0, 3.0], [0.0, 0.0, 1.0])
KICKED, TOP_STATE = li.schemes.splitting(TOP), TOP.state(angular_velocity=[0.1, 0.2, 1.0])
T = 0.1 * np.arange(64)


def level(state):
    return state.q[3] - 0.05


def logistic(c, _):
    return 3.2 * c * (1 - c), c


def slope(**options):
    """Reverse mode through a run, which needs the number of steps while JAX traces."""
    return jax.grad(lambda dt: li.integrate(STEP, STATE, dt, **options).state.q[-1, 1])(0.1)


TRACED = {  # functions of one integer, and its value
    "integrate(num_steps)": (lambda n: li.integrate(STEP, STATE, 0.1, n), 4),
    "integrate(save_every)": (lambda n: li.integrate(STEP, STATE, 0.1, 4, save_every=n), 2),
    "reverse mode (num_steps)": (lambda n: slope(num_steps=n), 4),
    "reverse mode (save_every)": (lambda n: slope(num_steps=4, save_every=n), 2),
    "reversible": (lambda n: slope(num_steps=4, save_every=n, adjoint=li.ReversibleAdjoint()), 4),
    "scan(length)": (lambda n: jax.grad(lambda c: li.scan(logistic, c, length=n)[0])(0.5), 4),
    "scan(every)": (lambda n: jax.grad(lambda c: li.scan(logistic, c, length=4, every=n)[0])(0.5), 2),
    "event(max_steps)": (lambda n: li.event(STEP, STATE, 0.1, level, n), 5),
    "event(count)": (lambda n: li.event(STEP, STATE, 0.1, level, 5, count=n), 2),
    "event(direction)": (lambda n: li.event(STEP, STATE, 0.1, level, 5, direction=n), 1),
    "section(count)": (lambda n: li.diagnostics.section(STEP, TWO, 0.1, level, max_steps=5, count=n), 2),
    "transition": (lambda n: li.transition(STEP, STATE, 0.1, n), 4),
    "lyapunov(num_steps)": (lambda n: li.diagnostics.lyapunov(STEP, STATE, 0.1, n, batches=2), 4),
    "lyapunov(exponents)": (lambda n: li.diagnostics.lyapunov(STEP, STATE, 0.1, 4, batches=2, exponents=n), 2),
    "lyapunov(every)": (lambda n: li.diagnostics.lyapunov(STEP, STATE, 0.1, 4, batches=2, every=n), 2),
    "lyapunov(batches)": (lambda n: li.diagnostics.lyapunov(STEP, STATE, 0.1, 4, batches=n), 2),
    "flow": (lambda n: li.diagnostics.flow(BODY, STATE, 0.1, n), 2),
    "exponents_of_flow": (lambda n: li.diagnostics.exponents_of_flow(BODY, STATE, 0.1, n), 2),
    "exponent_of_neighbors(every)": (lambda n: li.diagnostics.exponent_of_neighbors(STEP, STATE, 0.1, 4, every=n), 2),
    "modified_energy": (lambda n: li.diagnostics.modified_energy(KICKED, TOP_STATE, 0.1, order=n), 4),
    "gauss": (lambda n: li.schemes.gauss(BODY, n)(STATE, 0.1), 3),
    "so3_midpoint(iterations)": (lambda n: li.schemes.so3_midpoint(BODY, iterations=n)(STATE, 0.1), 4),
}
MADE = {
    "compose": (lambda n: li.schemes.compose(STEP, n).gammas, 4),
    "nystrom": (lambda n: li.schemes.nystrom(TOP, n).name, 4),
    "extrapolate": (lambda n: li.schemes.extrapolate(BODY, n).name, 8),
    "preprocessed": (lambda n: li.schemes.preprocessed(BODY, n).name, 4),
    "special_unitary": (lambda n: li.groups.special_unitary(n).basis, 2),
    "heisenberg": (lambda n: li.groups.heisenberg(n).basis, 1),
    "mutual_gravity": (lambda n: li.potentials.mutual_gravity(1.0, [1.0, 2.0], n).order, 2),
    "moments": (lambda n: li.shapes.box([3.0, 2.0, 1.0], mass=2.0).moments(n), 2),
    "ellipsoid_facets": (lambda n: li.shapes.ellipsoid_facets([1.0, 2.0, 3.0], rings=n).areas, 4),
    "wheel_pyramid": (lambda n: li.torques.wheel_pyramid(wheels=n), 4),
    "random_geodesic": (lambda n: li.diagnostics.random_geodesic(li.groups.special_orthogonal(3), n)[1].p, 1),
}
INTEGERS = [np.int64, np.int32, np.uint8, np.array, jnp.array]
OTHERS = [bool, np.bool_, float, np.float64, lambda n: np.array(float(n)), lambda n: jnp.array([n])]


def told_apart(call, n, kinds=INTEGERS):
    """The results of integers of these kinds, of which the first is Python's, after the others were refused."""
    for other in OTHERS:
        with pytest.raises(ValueError, match="must be "):
            call(other(n))
    return [call(kind(n)) for kind in (int, *kinds)]


@pytest.mark.parametrize("name", TRACED)
def test_a_run_takes_integers_of_every_kind(name):
    """Traced only: an array where JAX needs a number, as in reverse mode, is refused while it traces."""
    call, n = TRACED[name]
    first, *others = told_apart(lambda k: jax.tree.leaves(jax.eval_shape(lambda: call(k))), n, [np.int64, jnp.array])
    assert all(other == first for other in others)


@pytest.mark.parametrize("name", MADE)
def test_what_is_made_by_an_integer_of_any_kind_is_the_same(name):
    first, *others = told_apart(*MADE[name])
    for other in others:
        if isinstance(first, str):
            assert other == first
        else:
            np.testing.assert_array_equal(other, first)


def test_a_run_on_the_host_takes_integers_of_every_kind():
    for k in (kind(2) for kind in INTEGERS):
        run = li.run(STEP, TWO, 0.1, 2 * k, save_every=k, part=(0, 1 + 0 * k), progress=False)
        assert run.state.q.shape == (3, 2, 4)
        np.testing.assert_array_equal(run.member(k - 1).state.q, run.state.q[:, 1])
    with pytest.raises(ValueError, match="numbered from 0, got True"):
        run.member(True)
    for part in ((0, 2.0), (True, 2), (0.0, 1)):
        with pytest.raises(ValueError, match="part must be"):
            li.run(STEP, TWO, 0.1, 2, part=part, progress=False)
