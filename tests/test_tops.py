"""Bodies in a potential: Results 6 to 8 as theorems with their refutations; the energy-momentum and split schemes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.diagnostics.order import distance
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.schemes import compose, exact, splitting, top_energy_momentum
from lieint_jax.schemes.top_energy_momentum import discrete_gradient
from lieint_jax.systems.heavy_top import asymmetric, kovalevskaya, kovalevskaya_integral, lagrange
from lieint_jax.systems.potential_top import brun, clebsch_integral, examples
from lieint_jax.types import State

KAPPAS = {k.name: k for k in (kappa_cayley, kappa_exponential, kappa_symplectic)}
AXIS = [0.3, 0.5, 0.8]
TURN = so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.4])))
FULL = TURN @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ TURN.T


def quartic(G):
    return G[0] ** 4 + 0.5 * G[1] ** 3 - G[2] + 0.3 * G[0] * G[1] * G[2]


def transcendental(G):
    return jnp.exp(G[0]) + jnp.sin(2 * G[1]) - jnp.cosh(G[2])


TOPS = {
    "linear": li.systems.heavy_top(FULL, [0.5, 0.4, 1.0], AXIS),
    "quartic": li.systems.potential_top(FULL, quartic, AXIS),
    "transcendental": li.systems.potential_top(FULL, transcendental, AXIS),
}
run = jax.jit(li.integrate, static_argnums=(3, 4))
linearization = jax.jit(diagnostics.linearization)
defect = jax.jit(diagnostics.symplectic_defect)


def start(top):
    return top.state(so3.normalise(jnp.array([0.3, 0.8, -0.4, 0.5])), angular_velocity=[0.4, 0.6, -0.5])


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("name", TOPS)
def test_results_06_and_07_momentum_about_gamma_and_energy_for_any_kappa(name, kappa):
    top = TOPS[name]
    state = start(top)
    trajectory = run(top_energy_momentum(top, KAPPAS[kappa]), state, 0.1, 1000, 1)
    assert trajectory.info.converged.all()
    energy = np.abs(diagnostics.energy_error(top, trajectory) / top.energy(state)).max()
    assert energy < 5e-14  # floor 3e-15 to 2e-14
    size = max(1, float(jnp.linalg.norm(state.p)))
    assert np.abs(diagnostics.momentum_error(top, trajectory)).max() < 1e-14 * size  # floor 3e-15
    assert np.abs(trajectory.state.p - state.p).max() > 0.1  # π itself is not constant
    assert np.abs(diagnostics.constraint_error(top, trajectory)).max() < 2e-15


def test_result_07_any_kappa_of_ones_own():
    top = TOPS["linear"]
    trajectory = run(top_energy_momentum(top, lambda x: 1 + x / 3), start(top), 0.1, 1000, 1)
    assert np.abs(diagnostics.energy_error(top, trajectory)).max() < 5e-14


@pytest.mark.parametrize("name", ["linear", "transcendental"])
def test_second_order_and_reversible(name):
    top = TOPS[name]
    state = start(top)
    end = diagnostics.flow(top, state, 3.2, 32)
    for step in (top_energy_momentum(top), splitting(top)):
        runs = [run(step, state, 3.2 / n, n, n) for n in (64, 128)]
        errors = [float(distance(jax.tree.map(lambda x: x[-1], r.state), end)) for r in runs]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)
        there = run(step, state, 0.1, 1, 1).state
        back = run(step, jax.tree.map(lambda x: x[-1], there), -0.1, 1, 1).state
        assert float(distance(jax.tree.map(lambda x: x[-1], back), state)) < 1e-15


@pytest.mark.parametrize("kappa", KAPPAS)
def test_result_08_energy_momentum_is_not_symplectic(kappa):
    """The defect of a step is of the order of 1e-3 at Δt = .2 and falls as Δt³, whatever κ."""
    top = TOPS["linear"]
    step = top_energy_momentum(top, KAPPAS[kappa])
    coarse, fine = (float(defect(step, start(top), dt)) for dt in (0.2, 0.1))
    assert coarse > 1e-4
    assert np.log2(coarse / fine) == pytest.approx(3, abs=0.15)


@pytest.mark.parametrize("name", [*TOPS, "three_wells"])
def test_splitting_is_symplectic_and_keeps_gamma_dot_pi(name):
    top = TOPS[name] if name in TOPS else examples()[name][0]
    state = start(top)
    step = splitting(top)
    for dt in (0.1, -0.3):
        assert float(defect(step, state, dt)) < 5e-15  # floor 1e-15
    trajectory = run(step, state, 0.1, 1000, 10)
    assert trajectory.info.converged.all()
    momentum = diagnostics.momentum_error(top, trajectory)
    assert momentum.shape[1] == (0 if name == "three_wells" else 1)
    assert np.abs(momentum).max(initial=0) < 1e-14 * max(1, float(jnp.linalg.norm(state.p)))
    assert 1e-5 < np.abs(diagnostics.energy_error(top, trajectory)).max() < 0.05  # bounded, and not zero: Result 8


@pytest.mark.parametrize("make", [lagrange, kovalevskaya])
def test_splitting_has_no_drift_of_energy_where_the_top_is_integrable(make):
    """The largest error of the second half of 10⁵ steps is that of the first, to 5 %."""
    top, state = make()
    error = np.abs(
        diagnostics.energy_error(top, run(splitting(top), state, 0.01 if make is lagrange else 0.05, 100_000, 4))
    )
    first, second = error[:12_500].max(), error[12_500:].max()
    assert second == pytest.approx(first, rel=0.05)


def test_splitting_has_no_drift_of_energy_where_the_top_is_chaotic():
    """The mean slope of 16 runs of 10⁵ steps, fitted to means over blocks, is within 3 of its standard errors of 0.

    The error is that of the 16 slopes. That of one fit is too small by half: blocks of 1000 steps are correlated, 0.6
    from one to the next, and only those of 10⁴ are not.
    """
    top, state = asymmetric()
    Omega = top.angular_velocity(state)
    starts = jax.vmap(lambda e: top.state(state.q, angular_velocity=(1 + e) * Omega))(0.01 * jnp.linspace(-1, 1, 16))
    runs = jax.vmap(lambda z: diagnostics.energy_error(top, li.integrate(splitting(top), z, 0.05, 100_000, 4)))
    means = np.asarray(jax.jit(runs)(starts))[:, 1:].reshape(16, 100, -1).mean(axis=2)
    x = np.arange(100) - 49.5
    slopes = means @ x / (x @ x)
    assert abs(slopes.mean()) < 3 * slopes.std(ddof=1) / 4  # -1.0 of them


@pytest.mark.long
def test_compositions_raise_the_order_and_keep_what_the_base_keeps():
    top = TOPS["linear"]
    state = start(top)
    end = diagnostics.flow(top, state, 3.2, 32)
    for base in (top_energy_momentum(top), splitting(top)):
        step = compose(base, 4)
        assert step.method == "suzuki"  # steps of tops do not commute
        runs = [run(step, state, 3.2 / n, n, 1) for n in (16, 32)]
        errors = [float(distance(jax.tree.map(lambda x: x[-1], r.state), end)) for r in runs]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.15)
        energy = np.abs(diagnostics.energy_error(top, runs[1])).max()
        assert (energy < 3e-14) == (base.name != splitting(top).name)
        assert np.abs(diagnostics.momentum_error(top, runs[1])).max() < 5e-15


@pytest.mark.long
def test_a_drift_of_ones_own():
    """With the exact drift a fast top in a weak field has a smaller error; and no step is too long."""
    top = li.systems.heavy_top([1.0, 2.0, 3.0], [0.0, 0.0, 1e-3])
    state = start(top)
    end = diagnostics.flow(top, state, 20.0, 100)
    errors = {}
    for name, step in {"symplectic": splitting(top), "exact": splitting(top, exact(top.free))}.items():
        ended = run(step, state, 0.25, 80, 80).state
        errors[name] = float(so3.angle(ended.q[-1], end.q))
        assert float(defect(step, state, 0.25)) < 5e-15
    assert errors["exact"] < 1e-2 * errors["symplectic"]


@pytest.mark.long
def test_clebsch_and_kovalevskaya():
    """The fourth integrals: constant along the exact flow, bounded along the schemes, their errors O(Δt²)."""
    for (top, state), integral, dt in (
        (brun(), partial(clebsch_integral, strength=0.8), 0.05),
        (kovalevskaya(), kovalevskaya_integral, 0.05),
    ):
        start = integral(top, state)
        assert float(integral(top, diagnostics.flow(top, state, 10.0, 100)) - start) == pytest.approx(0, abs=3e-14)
        for step in (splitting(top), top_energy_momentum(top)):
            worst = []
            for h in (dt, dt / 2):
                states = run(step, state, h, int(1000 / h), int(0.5 / h)).state
                series = np.abs(jax.vmap(integral, (None, 0))(top, states) - start)
                assert series[1000:].max() == pytest.approx(series[:1000].max(), rel=0.3)
                worst.append(series.max())
            assert 3 < worst[0] / worst[1] < 5


@pytest.mark.parametrize("name", ["linear", "transcendental"])
def test_value_and_derivatives_are_finite_where_gamma_does_not_move(name):
    """Spin about γ, Δt = 0, zero momentum: ΔΓ = 0 in the discrete gradient."""
    top = li.systems.potential_top([1.0, 2.0, 3.0], TOPS[name].potential)
    states = [top.state(angular_velocity=[0.0, 0.0, 1.0]), top.state(angular_velocity=[0.0, 0.0, 0.0]), start(top)]
    slopes = jax.jit(jax.jacfwd(lambda state, dt: top_energy_momentum(top)(state, dt)[0], argnums=(0, 1)))
    for state, dt in zip(states, (0.1, 0.1, 0.0), strict=True):
        q, p = slopes(state, dt)  # each by (state, dt)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((q, p)))
        if dt == 0:
            field = top.vector_field(state)
            assert np.abs(p[0].p - np.eye(3)).max() < 1e-15
            assert np.abs(q[1] - field.q).max() < 1e-15
            assert np.abs(p[1] - field.p).max() < 1e-15


@pytest.mark.long
def test_linearization_against_finite_differences():
    top = TOPS["transcendental"]
    state, step, space, h = start(top), top_energy_momentum(top), top.phase_space, 1e-4
    L = linearization(step, state, 0.2)
    one = jax.jit(lambda delta: step(space.perturb(state, delta), 0.2)[0])
    for k, e in enumerate(np.eye(6)):
        f = [one(jnp.asarray(c * h * e)) for c in (-2, -1, 1, 2)]
        slope = jax.tree.map(lambda a, b, c, d: (a - 8 * b + 8 * c - d) / (12 * h), *f)
        column = space.trivialise(one(jnp.zeros(6)), slope)
        assert np.abs(column - L[:, k]).max() < 1e-10  # floor 1e-12


@pytest.mark.parametrize("potential", [quartic, transcendental])
def test_discrete_gradient_is_exact_symmetric_and_consistent(potential):
    rng = np.random.default_rng(3)
    both = jax.jit(lambda a, b: (discrete_gradient(potential, a, b), discrete_gradient(potential, b, a)))
    for size in (1.0, 0.3, 1e-1, 1e-2, 1e-4, 1e-8, 0.0):
        a = rng.normal(size=3)
        b = a + size * rng.normal(size=3)
        D, back = both(a, b)
        assert np.abs(D - back).max() < 3e-14
        difference = float(potential(b) - potential(a))
        assert D @ (b - a) == pytest.approx(difference, abs=3e-15 * (1 + abs(float(potential(a)))))
        middle = jax.grad(potential)(jnp.asarray((a + b) / 2))
        assert np.abs(D - middle).max() < 20 * size**2 + 1e-14


def test_the_potential_s_own_discrete_gradients():
    for top in (TOPS["linear"], brun()[0]):
        a, b = np.array([0.3, -0.2, 0.9]), np.array([-0.5, 0.4, 0.1])
        D = top.potential.discrete_gradient(a, b)
        assert D @ (b - a) == pytest.approx(float(top.potential(b) - top.potential(a)), abs=1e-15)
        assert np.abs(D - discrete_gradient(jax.tree_util.Partial(top.potential.__call__), a, b)).max() < 1e-14


def test_poisson_error_of_a_system_with_a_potential_is_the_whole_matrix():
    """P_n − ω⁻¹: zero to round-off for splitting, O(1) growth at once for the energy-momentum scheme."""
    top = TOPS["linear"]
    state = start(top)
    kept = diagnostics.poisson_error(splitting(top), state, 0.1, 50)
    assert kept.shape == (51, 6, 6)
    assert np.abs(kept).max() < 2e-12  # floor 2e-13: the product's own round-off
    assert np.abs(kept + np.swapaxes(kept, 1, 2)).max() < 2e-12
    lost = diagnostics.poisson_error(top_energy_momentum(top), state, 0.1, 1, "product")
    assert np.abs(lost[1]).max() > 1e-5
    assert np.abs(lost[0]).max() == 0
    with pytest.raises(ValueError, match=r"recursion.*without potential, got PotentialTop.*'product'"):
        diagnostics.poisson_error(splitting(top), state, 0.1, 1, "recursion")


def test_single_precision():
    top = li.systems.heavy_top(np.array([1, 2, 3], "float32"), np.array([0.5, 0.4, 1], "float32"))
    state = jax.tree.map(lambda x: x.astype("float32"), start(top))
    for step in (top_energy_momentum(top), splitting(top)):
        trajectory = run(step, state, 0.1, 200, 200)
        assert trajectory.state.q.dtype == jnp.float32
        assert trajectory.info.converged.all()
    trajectory = run(top_energy_momentum(top), state, 0.1, 200, 200)
    assert abs(float(diagnostics.energy_error(top, trajectory)[-1])) < 2e-5


@pytest.mark.long
def test_batches_over_weights_and_gradients():
    """The weight is a leaf: vmapped and differentiated like an inertia."""
    state = start(TOPS["linear"])

    def height(weight):
        top = li.systems.heavy_top([1.0, 2.0, 3.0], weight)
        return top.Gamma(State(*(x[-1] for x in li.integrate(top_energy_momentum(top), state, 0.1, 20).state)))[2]

    weights = jnp.array([[0.0, 0.0, 1.0], [0.5, 0.4, 1.0]])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(height)))(weights)
    h = 1e-5
    many = jax.jit(jax.vmap(height))
    for k, e in enumerate(np.eye(3)):
        np.testing.assert_allclose(slopes[:, k], (many(weights + h * e) - many(weights - h * e)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(values, many(weights), atol=1e-15)


def test_a_top_made_inside_jit_checks_what_is_concrete():
    def energy(inertia, axis):
        top = li.systems.heavy_top(inertia, [0.5, 0.4, 1.0], axis)
        return top.energy(top.state(angular_velocity=[0.1, 0.2, 0.3]))

    J, axis = jnp.array([1.0, 2.0, 2.5]), jnp.array([0.0, 0.6, 0.8])
    outside = energy(J, axis)
    assert jax.jit(lambda J: energy(J, [0.0, 0.6, 0.8]))(J) == pytest.approx(float(outside), rel=1e-15)
    assert jax.jit(energy)(J, axis) == pytest.approx(float(outside), rel=1e-15)
    with pytest.raises(ValueError, match="axis must not be zero"):
        jax.jit(lambda J: energy(J, [0.0, 0.0, 0.0]))(J)


def test_bad_arguments():
    with pytest.raises(ValueError, match="axis must not be zero"):
        li.systems.potential_top([1.0, 2.0, 3.0], quartic, [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="potential must be a function of Γ"):
        li.systems.potential_top([1.0, 2.0, 3.0], 3.0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"scalar function of Γ.*got a value of shape \(3,\)"):
        li.systems.potential_top([1.0, 2.0, 3.0], lambda G: G)
    with pytest.raises(ValueError, match="potential fails as a function of the rotation matrix"):
        li.systems.potential_top([1.0, 2.0, 3.0], lambda R: R[0] @ jnp.ones(4), None)
    with pytest.raises(ValueError, match="weight"):
        li.systems.heavy_top([1.0, 2.0, 3.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="without an axis; take splitting"):
        top_energy_momentum(examples()["three_wells"][0])
    with pytest.raises(ValueError, match="potential with an axis"):
        top_energy_momentum(li.systems.rigid_body([1.0, 2.0, 3.0]))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="systems with a potential"):
        splitting(li.systems.rigid_body([1.0, 2.0, 3.0]))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="drift must be a symmetric step"):
        splitting(TOPS["linear"], "drift")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"does not converge at dt = 9.0"):
        li.integrate(top_energy_momentum(TOPS["linear"]), start(TOPS["linear"]), 9.0, 1)
    with pytest.raises(ValueError, match=r"splitting.*so3_midpoint.*does not converge"):
        li.integrate(splitting(TOPS["linear"]), start(TOPS["linear"]), 9.0, 1)
