"""The energy–momentum scheme of rods by Newton's method: stiff rods, where iterations on the forces fail."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import potentials, schemes, systems
from tests.lib.differences import slopes

pytestmark = pytest.mark.long

N = 5
ELEMENT = 1 / (N - 1)
MASSES = ELEMENT * np.array([0.5, 1, 1, 1, 0.5])
STIFF, SOFT = 1e3, 1.0  # of extension; Δt Ω of the fastest vibration is 5.8 and 0.32
DT = 0.02


def rod(extension, bending=1.0, dtype=float, scale=1.0, **more):
    """A rod of unit length and mass, as thin as a hundredth of its length if it is stiff."""
    k = jnp.asarray(scale, dtype)
    potential = potentials.rod(
        np.full(N - 1, ELEMENT, dtype),
        extension * k * jnp.asarray([0.35, 0.35, 1.0], dtype),
        bending * k * jnp.asarray([1.0, 1.0, 0.8], dtype),
    )
    moments = MASSES[:, None] * np.array([0.006, 0.006, 0.002])
    return systems.rigid_bodies(MASSES.astype(dtype), moments.astype(dtype), potential, **more)


def bent(system, shift=None, angle=0.5):
    """A rod bent by an angle, without tension, that turns and vibrates."""
    s, dtype = np.linspace(0, 1, N), system.masses.dtype
    half, middle = angle * s / 2, angle * (s[1:] + s[:-1]) / 2
    q = np.stack([np.cos(half), 0 * s, np.sin(half), 0 * s], axis=1)
    along = ELEMENT / np.cos(angle * ELEMENT / 2) * np.stack([np.sin(middle), 0 * middle, np.cos(middle)], axis=1)
    x = np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    x -= MASSES @ x
    v = np.cross([0.1, 0.3, 0.2], x) + 0.1 * np.sin(2 * np.pi * s)[:, None] * np.array([0, 1, 0])
    if shift is not None:
        v = v + jnp.cos(3.0 * jnp.arange(3 * N)).reshape(N, 3) * shift
    return system.state(x.astype(dtype), q.astype(dtype), velocities=jnp.asarray(v, dtype))


@functools.cache
def run(solver, steps, every=1):
    return jax.jit(
        lambda system, state, dt: li.integrate(
            schemes.bodies_energy_momentum(system, solver=solver), state, dt, steps, save_every=every
        )
    )


def assert_drifts(system, path, *bounds):
    """On the changes of H relative to H, of P to the sum of momenta, and of L to the sum of theirs, in eps."""
    x, p = np.asarray(path.state.q[:, :, :3]), np.asarray(path.state.p)
    H, momenta = (np.asarray(jax.vmap(f)(path.state)) for f in (system.energy, system.momentum))
    sizes = np.abs(p[:, :, :3]).sum(1).max(), np.abs(np.cross(x, p[:, :, :3]) + p[:, :, 3:]).sum(1).max()
    moved = momenta - momenta[0]
    eps = np.finfo(p.dtype).eps
    found = np.abs(H / H[0] - 1).max(), np.abs(moved[:, :3]).max() / sizes[0], np.abs(moved[:, 3:]).max() / sizes[1]
    assert (np.array(found) / eps < bounds).all()


def two_ellipsoids():
    """Two bodies of any potential are a chain."""
    masses, moments = np.array([1.0, 0.4]), np.array([[0.08, 0.10, 0.13], [0.02, 0.03, 0.035]])
    system = systems.rigid_bodies(masses, moments, potentials.maccullagh(1.0, masses, moments))
    return system, system.state([[-0.6, 0, 0], [1.4, 0, 0]], velocities=[[0, -0.2, 0], [0, 0.6, 0.1]])


def with_start(system):
    return system, bent(system)


def test_newtons_method_is_as_exact_far_from_the_origin():
    """It does not see the roundness of positions; were I taken at x + Δx, 71 eps of H a step and 0.02 eps missing."""
    system = rod(STIFF)
    state = bent(system)
    path = run("newton", 1000)(system, state._replace(q=state.q.at[:, :3].add(3.0)), DT)
    H, eps = np.asarray(jax.vmap(system.energy)(path.state)), np.finfo(float).eps
    assert np.diff(H).std() < 45 * eps * H[0]  # observed 29
    assert path.info.residual.mean() < 1e-3 * eps  # 8e-5: what is missing at the end of a step


@pytest.mark.parametrize(
    ("make", "steps", "dt"),
    [(lambda: with_start(rod(SOFT, 0.01)), 100, DT), (two_ellipsoids, 50, 0.05)],
    ids=["soft rod", "two ellipsoids"],
)
def test_both_solvers_agree_where_both_converge(make, steps, dt):
    """Observed 6e-16 and 1e-16."""
    paths = [run(solver, steps)(*make(), dt) for solver in ("newton", "fixed_point")]
    assert all(path.info.converged.all() for path in paths)
    np.testing.assert_allclose(paths[0].state.q, paths[1].state.q, rtol=0, atol=5e-15)
    np.testing.assert_allclose(paths[0].state.p, paths[1].state.p, rtol=0, atol=5e-15)


CONSERVED = {  # the steps, those between saves, bounds on the drifts of H, P and L in eps; a few times those observed
    "rod": (lambda: with_start(rod(STIFF)), 100, 1, (500, 10, 40)),  # 76, 1.2 and 5; H rounds as (ΔtΩ)²
    "long": (lambda: with_start(rod(STIFF)), 20_000, 100, (4000, 100, 400)),  # 810, 18 and 92, a random walk
    "float32": (lambda: single(with_start(rod(STIFF))), 100, 1, (400, 3, 40)),  # 93, 0.63 and 10.8
    "no chain": (lambda: cage(np.zeros(2)), 200, 1, (400, 10, 40)),  # 91, 2.1 and 9.5
}


def single(tree):
    return jax.tree.map(lambda x: x.astype(np.float32), tree)


@pytest.mark.parametrize("name", CONSERVED)
def test_stiff_bodies_conserve_all_by_newton(name):
    """Where iterations on the forces fail."""
    make, steps, every, bounds = CONSERVED[name]
    system, state = make()
    dt = np.float32(DT) if name == "float32" else DT
    path = run("newton", steps, every)(system, state, dt)
    assert path.state.q.dtype == state.q.dtype
    assert path.info.converged.all()
    assert_drifts(system, path, *bounds)
    if name == "rod":
        assert path.info.residual.max() < 4 * np.finfo(float).eps
    if name in ("rod", "no chain"):
        assert not run("fixed_point", steps)(system, state, dt).info.converged.all()


@pytest.mark.parametrize(("body", "dt"), [("rod", 0.005), ("rod", 0.02), ("cage", 0.01)])
def test_energy_moves_without_a_preferred_direction(body, dt):
    """Four starts of 40,000 steps, 5000 of the cage: the mean change of H in a step, over its standard error.

    Observed 1.1, 0.4 and 1.2.
    """
    steps, means = (40_000, []) if body == "rod" else (5000, [])
    for seed in range(4):
        system, state = (rod(STIFF), bent(rod(STIFF))) if body == "rod" else cage(np.zeros(2))
        p = state.p * (1 + 0.1 * np.random.default_rng(seed).normal(size=state.p.shape))
        drift = np.sum(p[:, :3], axis=0) / np.sum(system.masses)  # else rounding grows with the distance
        state = state._replace(p=p.at[:, :3].add(-system.masses[:, None] * drift))
        path = run("newton", steps, 10)(system, state, dt)
        assert path.info.converged.all()
        change = np.diff(jax.vmap(system.energy)(path.state))
        means.append(change.mean() / change.std() * np.sqrt(len(change)))
    assert abs(np.sum(means)) / 2 < 4


def end_of_ten(system, state, solver, loop=li.integrate):
    last = loop(schemes.bodies_energy_momentum(system, solver=solver), state, DT, 10, save_every=10).state
    return jnp.concatenate([last.q[-1], last.p[-1]], axis=1).ravel()


def end(d, solver, extension, bending, loop=li.integrate, **more):
    """The end of ten steps, by the first velocities and the stiffness."""
    system = rod(extension, bending, scale=1 + d[1], **more)
    return end_of_ten(system, bent(system, d[0]), solver, loop)


AT = jnp.array([0.02, 0.01])


def both_modes(*arguments, end=end, **more):
    """The derivative in forward mode, and its product with numbers from the left, in reverse mode."""
    forward = jax.jit(jax.jacfwd(lambda d: end(d, *arguments, **more)))(AT)
    weights = jnp.cos(jnp.arange(float(len(forward))))
    reverse = jax.jit(jax.grad(lambda d: weights @ end(d, *arguments, **more)))(AT)
    np.testing.assert_allclose(reverse, weights @ forward, rtol=0, atol=1e-13)
    return forward


def test_derivatives_through_stiff_steps_are_those_of_differences():
    """Observed 1.3e-11 of 0.4, by differences; 4e-15 between the modes."""
    by_value = jax.jit(lambda d: end(d, "newton", STIFF, 1.0))
    expected = slopes(lambda d: by_value(AT + d), 2, 1e-3)
    np.testing.assert_allclose(both_modes("newton", STIFF, 1.0), expected, rtol=0, atol=1e-10)


def test_a_reverse_pass_saves_no_factors_of_matrices():
    """Each mode factors the matrix that it needs, so the forward pass of a gradient solves no linear equations."""
    system = rod(STIFF)
    step = schemes.bodies_energy_momentum(system)
    back = jax.eval_shape(lambda z: jax.vjp(lambda z: step.advance(z, DT)[0].q, z)[1], bent(system))
    assert not [x.shape for x in jax.tree.leaves(back) if x.shape[1:] == (6, 6)]


def test_derivatives_are_those_of_the_other_solver():
    """Observed 6e-17 of 0.25."""
    found = [both_modes(solver, SOFT, 0.01) for solver in ("newton", "fixed_point")]
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-15)


def spring_between_the_ends(t, x, R, v, omega):
    f = 0.5 * (x[-1] - x[0]) + 0.1 * (v[-1] - v[0])
    return jnp.zeros_like(x).at[0].set(f).at[-1].set(-f), 0 * x


def test_forces_between_distant_bodies_are_solved_and_differentiated():
    """They are no part of Newton's matrix. Work is booked; the other solver agrees, and its derivatives."""
    system = rod(STIFF, forces=spring_between_the_ends)
    path = run("newton", 100)(system, bent(system), DT)
    assert path.info.converged.all()
    H = np.asarray(jax.vmap(system.energy)(path.state))
    assert np.abs(np.ptp(path.state.work)) > 1e-3
    np.testing.assert_allclose(H - path.state.work, H[0], rtol=0, atol=1e-13)
    found = [both_modes(s, SOFT, 0.01, forces=spring_between_the_ends) for s in ("newton", "fixed_point")]
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-12)


def test_the_reversible_gradient_is_that_of_the_loop():
    loops = li.integrate, functools.partial(li.integrate, adjoint=li.ReversibleAdjoint())
    found = [jax.jit(jax.grad(lambda d, f=f: end(d, "newton", STIFF, 1.0, f).sum()))(AT) for f in loops]
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-11)


def test_a_batch_is_its_members():
    """Members that need different numbers of corrections, in one loop. Observed 0 to 1e-15."""
    system, turns = rod(STIFF), jnp.array([0.0, 0.02, 2.0])
    states = jax.vmap(lambda d: bent(system, d))(turns)
    step = schemes.bodies_energy_momentum(system)
    ends, info = jax.jit(jax.vmap(step.advance, (0, None)))(states, DT)
    assert info.converged.all()
    for i in range(3):
        one, _ = jax.jit(step.advance)(jax.tree.map(lambda x, i=i: x[i], states), DT)
        np.testing.assert_allclose(ends.q[i], one.q, rtol=0, atol=1e-14)


@pytest.mark.quick
def test_a_step_that_is_too_large_says_so():
    system = rod(STIFF)
    step = schemes.bodies_energy_momentum(system)
    path = run("newton", 100)(system, bent(system), 1.0)
    assert not path.info.converged.all()
    assert "Use a smaller dt" in step.advice(bent(system), 1.0)
    assert 'solver="newton"' in schemes.bodies_energy_momentum(system, solver="fixed_point").advice(bent(system), DT)


@pytest.mark.quick
def test_the_solver_is_chosen_by_the_potential():
    chain = rod(STIFF)
    fallen = systems.rigid_bodies(
        MASSES, np.full((N, 3), 0.1), chain.potential + potentials.uniform_field([0, 0, -9.8], MASSES)
    )
    pulled = systems.rigid_bodies(MASSES, np.full((N, 3), 0.1), potentials.point_masses(1.0, MASSES))
    two = systems.rigid_bodies(MASSES[:2], np.full((2, 3), 0.1), potentials.point_masses(1.0, MASSES[:2]))
    given = [schemes.bodies_energy_momentum(x).solver for x in (chain, fallen, pulled, two)]
    assert given == ["newton", "newton", "fixed_point", "fixed_point"]
    assert schemes.bodies_energy_momentum(two, solver="newton").solver == "newton"
    assert schemes.bodies_energy_momentum(pulled, solver="newton").solver == "newton"
    with pytest.raises(ValueError, match="solver must be 'fixed_point' or 'newton'"):
        schemes.bodies_energy_momentum(chain, solver="chords")


def cage(d, dtype=float):
    """Four bodies, each joined to each other by a spring, turning: no chain. Δt Ω of the fastest vibration is 3.4."""
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 2
    pairs = np.stack(np.triu_indices(4, 1), axis=1)
    points = 0.2 * (corners[pairs[:, ::-1]] - corners[pairs]) + 0.05
    ends = corners[pairs] + points
    stiffness = 4e3 * (1 + d[1]) * jnp.ones(6, dtype)
    V = potentials.springs(pairs, points.astype(dtype), stiffness, np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
    masses = np.array([0.4, 0.6, 0.8, 1.0], dtype)
    moments = masses[:, None] * np.array([0.05, 0.06, 0.08], dtype)
    system = systems.rigid_bodies(masses, moments, V)
    v = np.cross([0.3, 0.1, 0.5], corners) + 0.05 * np.cos(np.arange(12.0)).reshape(4, 3)
    q = np.tile(np.eye(4)[0], (4, 1))
    return system, system.state(corners.astype(dtype), q.astype(dtype), velocities=jnp.asarray((1 + d[0]) * v, dtype))


def test_derivatives_of_stiff_bodies_that_are_no_chain_are_those_of_differences():
    """Observed 3.7e-11 of 0.35."""

    end = jax.jit(lambda d: end_of_ten(*cage(d), "newton"))
    np.testing.assert_allclose(both_modes(end=end), slopes(lambda d: end(AT + d), 2, 1e-3), rtol=0, atol=1e-10)


def test_explain_names_the_engine():
    system = rod(STIFF)
    found = li.explain(lambda s: run("newton", 100)(system, s, DT), bent(system))
    assert [loop.engine for loop in found.loops] == ["native"]
