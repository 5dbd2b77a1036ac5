"""Bodies in a potential: Results 6 to 8 as theorems with their refutations; the energy-momentum and split schemes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import paper
import pytest
from grid import examples_of
from kappas import chosen
from repeated import state_after

import lieint_jax as li
from lieint_jax import diagnostics, maps
from lieint_jax._numerics.gradients import discrete_gradient
from lieint_jax.core import State, gradient
from lieint_jax.groups import so3
from lieint_jax.schemes import compose, exact, splitting, top_energy_momentum
from lieint_jax.systems import LinearPotential, QuadraticPotential, clebsch_integral, kovalevskaya_integral

KAPPAS = {kappa.name: kappa for kappa in maps.KAPPAS}


SHARED = {name: chosen(row) for name, row in zip(KAPPAS, np.eye(3), strict=True)}
AXIS = [0.3, 0.5, 0.8]
TURN = paper.exp(np.array([0.3, -0.5, 0.4]))
FULL = TURN @ np.diag([1.0, 2.0, 3.0]) @ TURN.T


def quartic(G):
    return G[0] ** 4 + 0.5 * G[1] ** 3 - G[2] + 0.3 * G[0] * G[1] * G[2]


def transcendental(G):
    return jnp.exp(G[0]) + jnp.sin(2 * G[1]) - jnp.cosh(G[2])


def either(which, G):
    """One of the two: the coefficients are leaves, so both tops share compilations."""
    return which[0] * quartic(G) + which[1] * transcendental(G)


POTENTIALS = {
    "quartic": jax.tree_util.Partial(either, np.array([1.0, 0.0])),
    "transcendental": jax.tree_util.Partial(either, np.array([0.0, 1.0])),
}
TOPS = {"linear": li.systems.heavy_top(FULL, [0.5, 0.4, 1.0], AXIS)} | {
    name: li.systems.potential_top(FULL, potential, AXIS) for name, potential in POTENTIALS.items()
}
ATTITUDE = np.array([0.3, 0.8, -0.4, 0.5]) / np.sqrt(1.14)
flow = jax.jit(diagnostics.flow, static_argnums=3)
defect = jax.jit(diagnostics.symplectic_defect)


@jax.jit
def _state(inertia, q, Omega):
    return li.systems.RigidBody(inertia).state(q, angular_velocity=Omega)


def start(top, q=ATTITUDE, Omega=(0.4, 0.6, -0.5)):
    return _state(top.inertia, q, np.array(Omega))


@functools.partial(jax.jit, static_argnums=(3, 4))
def _run(step, state, dt, num_steps, save_every):
    trajectory = li.integrate(step, state, dt, num_steps, save_every=save_every)
    run = li.Run.of(step, trajectory)
    return trajectory, step.system.energy(state), [run.energy_error(), run.momentum_error(), run.constraint_error()]


def run(step, state, dt, num_steps=1000, save_every=1):
    """The trajectory, H₀, and the errors of energy, momentum and constraint; one program serves every dt."""
    return jax.device_get(_run(step, state, dt, num_steps, save_every))


def own_and_shared(name, *others):
    """Cases of a top: the κ's as they are, and as leaves of one program, which stand in for them in quick runs."""
    own = [pytest.param(top, KAPPAS, id=f"{top}-own", marks=pytest.mark.long) for top in others]
    return [pytest.param(name, KAPPAS, id=name), *(pytest.param(top, SHARED, id=top) for top in others), *own]


@pytest.mark.long
def test_a_kappa_selected_by_a_leaf_is_each_of_the_three():
    """Its value and slope are theirs, and it is they that decide where a top goes."""
    both = jax.jit(lambda kappa, x: jax.vmap(jax.value_and_grad(kappa))(x))
    x = np.array([0.0, 0.1, 0.6])
    for name, kappa in KAPPAS.items():
        np.testing.assert_allclose(both(SHARED[name], x), both(kappa, x), rtol=4e-16)
    top = TOPS["quartic"]
    ends = [run(top_energy_momentum(top, kappa), start(top), 0.1)[0].state.q[50] for kappa in SHARED.values()]
    assert min(np.abs(a - b).max() for a, b in itertools.combinations(ends, 2)) > 1e-5


@pytest.mark.paper("4.1: (4.3)–(4.12), Results 6, 7", "energy and momentum of tops", "schemes/_top_energy_momentum.py")
@pytest.mark.slow
@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize(("name", "kappas"), own_and_shared("linear", *POTENTIALS))
def test_results_06_and_07_momentum_about_gamma_and_energy_for_any_kappa(name, kappas, kappa):
    top = TOPS[name]
    state = start(top)
    step = top_energy_momentum(top, kappas[kappa])
    trajectory, H, (energy, momentum, constraint) = run(step, state, 0.1)
    assert trajectory.info.converged.all()
    assert np.abs(energy / H).max() < 5e-14  # floor 3e-15 to 2e-14
    size = max(1, float(np.linalg.norm(state.p)))
    assert np.abs(momentum).max() < 1e-14 * size  # floor 3e-15
    assert np.abs(trajectory.state.p - trajectory.state.p[0]).max() > 0.1  # π itself is not constant
    assert np.abs(constraint).max() < 2e-15


@pytest.mark.long
def test_result_07_holds_for_a_custom_kappa():
    top = TOPS["linear"]
    _, _, (energy, *_) = run(top_energy_momentum(top, lambda x: 1 + x / 3), start(top), 0.1)
    assert np.abs(energy).max() < 5e-14


@pytest.mark.long
@pytest.mark.parametrize(("name", "kappas"), own_and_shared("linear", "transcendental"))
def test_a_step_back_undoes_a_step(name, kappas):
    for step in (top_energy_momentum(TOPS[name], kappas["cayley"]), splitting(TOPS[name])):
        assert diagnostics.reversibility(step, start(TOPS[name]), 0.1) < 1e-15


@pytest.mark.long
@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("kappas", [SHARED, KAPPAS], ids=["shared", "own"])
def test_result_08_energy_momentum_is_not_symplectic(kappas, kappa):
    """The defect of a step is of the order of 1e-3 at Δt = 0.2 and falls as Δt³, whatever κ."""
    top = TOPS["linear"]
    step = top_energy_momentum(top, kappas[kappa])
    coarse, fine = (float(defect(step, start(top), dt)) for dt in (0.2, 0.1))
    assert coarse > 1e-4
    assert np.log2(coarse / fine) == pytest.approx(3, abs=0.15)


@functools.cache
def energy_errors():
    """Of 10⁵ steps of splitting, every fourth: 16 motions of the asymmetric top, Kovalevskaya's top, Lagrange's."""

    def errors(top, state, dt):
        step = splitting(top)
        return li.Run.of(step, li.integrate(step, state, dt, 100_000, save_every=4)).energy_error()

    @jax.jit
    def all_of_them():
        tops = examples_of("heavy_top")
        top, (q, p, *_), dt = tops["asymmetric_top"]
        motions = [(top, State(q, (1 + e) * p), dt) for e in 0.01 * np.linspace(-1, 1, 16)]
        motions += [tops["kovalevskaya"], tops["lagrange"]]
        return jax.vmap(errors)(*jax.tree.map(lambda *x: jnp.stack(x), *motions))

    return np.asarray(all_of_them())


@pytest.mark.long
@pytest.mark.parametrize("top", ["lagrange", "kovalevskaya"])
def test_splitting_has_no_drift_of_energy_where_the_top_is_integrable(top):
    """The largest error of the second half of 10⁵ steps is that of the first, to 5 %."""
    error = np.abs(energy_errors()[-1 if top == "lagrange" else -2])
    first, second = error[:12_500].max(), error[12_500:].max()
    assert second == pytest.approx(first, rel=0.05)


@pytest.mark.long
def test_splitting_has_no_drift_of_energy_where_the_top_is_chaotic():
    """The mean slope of 16 runs of 10⁵ steps, fitted to means over blocks, is within 3 of its standard errors of 0.

    The error is that of the 16 slopes. That of one fit is too small by half: blocks of 1000 steps are correlated, 0.6
    from one to the next, and only those of 10⁴ are not. The first 20 blocks are left out: the runs start close together
    and the mean of their errors takes so long to settle, from -6.3e-4 to -6.7e-4; of 192 runs of 4·10⁵ steps it then
    stays there.
    """
    means = energy_errors()[:16, 1:].reshape(16, 100, -1).mean(axis=2)[:, 20:]
    x = np.arange(80) - 39.5
    slopes = means @ x / (x @ x)
    assert abs(slopes.mean()) < 3 * slopes.std(ddof=1) / 4  # 0.6 of them; 1.8 with jaxlib 0.12


@pytest.mark.long
def test_compositions_conserve_what_the_base_conserves():
    top = TOPS["linear"]
    for base in (top_energy_momentum(top), splitting(top)):
        step = compose(base, 4)
        assert step.method == "suzuki"  # steps of tops do not commute
        _, _, (energy, momentum, _) = run(step, start(top), 0.1, 32)
        assert (np.abs(energy).max() < 3e-14) == (base.name != splitting(top).name)
        assert np.abs(momentum).max() < 5e-15


@pytest.mark.long
def test_a_custom_drift_lowers_the_error_of_a_fast_top():
    """With the exact drift a fast top in a weak field has a smaller error; and no step is too long."""
    top = li.systems.heavy_top([1.0, 2.0, 3.0], [0.0, 0.0, 1e-3])
    state = start(top)
    end = flow(top, state, 20.0, 100)
    errors = {}
    for name, step in {"symplectic": splitting(top), "exact": splitting(top, exact(top.free))}.items():
        errors[name] = float(so3.angle(state_after(run(step, state, 0.25)[0], 80).q, end.q))
        assert float(defect(step, state, 0.25)) < 5e-15
    assert errors["exact"] < 1e-2 * errors["symplectic"]


@pytest.mark.long
def test_the_fourth_integrals_of_clebsch_and_kovalevskaya_are_bounded():
    """The fourth integrals: constant along the exact flow, bounded along the schemes, their errors O(Δt²)."""
    for (top, state, dt), integral in (
        (examples_of("potential_top")["brun"], functools.partial(clebsch_integral, strength=0.8)),
        (examples_of("heavy_top")["kovalevskaya"], kovalevskaya_integral),
    ):
        start = integral(top, state)
        assert float(integral(top, flow(top, state, 10.0, 100)) - start) == pytest.approx(0, abs=3e-14)
        for step in (splitting(top), top_energy_momentum(top)):
            worst = []
            for h in (dt, dt / 2):
                states = run(step, state, h, int(1000 / h), int(0.5 / h))[0].state
                series = np.abs(jax.vmap(integral, (None, 0))(top, states) - start)
                assert series[1000:].max() == pytest.approx(series[:1000].max(), rel=0.3)
                worst.append(series.max())
            assert 3 < worst[0] / worst[1] < 5


@pytest.mark.long
@pytest.mark.parametrize("name", ["linear", "transcendental"])
def test_values_and_derivatives_are_finite_where_gamma_is_at_rest(name):
    """Spin about γ, Δt = 0, zero momentum: ΔΓ = 0 in the discrete gradient."""
    top = li.systems.potential_top([1.0, 2.0, 3.0], TOPS[name].potential)
    one = np.array([1.0, 0.0, 0.0, 0.0])
    states = [start(top, one, [0.0, 0.0, 1.0]), start(top, one, [0.0, 0.0, 0.0]), start(top)]

    @jax.jit
    def slopes(state, dt):
        step = top_energy_momentum(top)
        return jax.jacfwd(lambda state, dt: step(state, dt)[0], argnums=(0, 1))(state, dt), top.vector_field(state)

    for state, dt in zip(states, (0.1, 0.1, 0.0), strict=True):
        (q, p, *_), field = jax.device_get(slopes(state, dt))  # each by (state, dt)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((q, p)))
        if dt == 0:
            assert np.abs(p[0].p - np.eye(3)).max() < 1e-15
            assert np.abs(q[1] - field.q).max() < 1e-15
            assert np.abs(p[1] - field.p).max() < 1e-15


@jax.jit
def _discrete_gradients(potential, a, b):
    """D̄(a, b) and D̄(b, a), by quadrature; Ṽ at a and b; and the gradient in the middle."""
    plain = lambda G: potential(G)  # noqa: E731  # which has no discrete gradient of its own
    both = discrete_gradient(plain, a, b, 1e-4), discrete_gradient(plain, b, a, 1e-4)
    return *both, potential(a), potential(b), jax.grad(potential)((a + b) / 2)


@pytest.mark.parametrize("name", POTENTIALS)
def test_discrete_gradient_is_exact_symmetric_and_consistent(name):
    rng = np.random.default_rng(3)
    for size in (1.0, 0.3, 1e-1, 1e-2, 1e-4, 1e-8, 0.0):
        a = rng.normal(size=3)
        b = a + size * rng.normal(size=3)
        D, back, before, after, middle = jax.device_get(_discrete_gradients(POTENTIALS[name], a, b))
        assert np.abs(D - back).max() < 3e-14
        assert D @ (b - a) == pytest.approx(after - before, abs=3e-15 * (1 + float(abs(before))))
        rounding = 5e-16 * (1 + np.abs(middle).max())  # observed: 2e-16 of the greatest component
        assert np.abs(D - middle).max() < 20 * size**2 + rounding


def test_discrete_gradient_does_not_depend_on_the_length_of_the_axis():
    """Bit for bit, for powers of 2: also where it begins to be corrected."""

    @jax.jit
    @jax.vmap
    def found(unit, size):
        a = unit * jnp.array(AXIS)
        return unit * discrete_gradient(lambda G: transcendental(G / unit), a, a + size * unit, 1e-4)

    D = np.asarray(found(np.array([1, 2.0**-30, 2.0**30] * 2), np.repeat([1e-4, 0.3], 3))).reshape(2, 3, 3)
    assert (D[:, :1] == D).all()


def test_the_potential_s_own_discrete_gradients():
    for top in (TOPS["linear"], examples_of("potential_top")["brun"][0]):
        a, b = np.array([0.3, -0.2, 0.9]), np.array([-0.5, 0.4, 0.1])
        by_quadrature, _, before, after, _ = jax.device_get(_discrete_gradients(top.potential, a, b))
        D = np.asarray(top.potential.discrete_gradient(a, b))
        assert D @ (b - a) == pytest.approx(after - before, abs=1e-15)
        assert np.abs(D - by_quadrature).max() < 1e-14


def test_poisson_error_of_a_system_with_a_potential_is_the_whole_matrix():
    """P_n − ω⁻¹: zero to round-off for splitting, O(1) growth at once for the energy-momentum scheme."""
    top = TOPS["linear"]
    state = start(top)
    poisson_error = jax.jit(diagnostics.poisson_error, static_argnames=("num_steps", "method"))
    kept = np.asarray(poisson_error(splitting(top), state, 0.1, 50))
    assert kept.shape == (51, 6, 6)
    assert np.abs(kept).max() < 2e-12  # floor 2e-13: the product's own round-off
    assert np.abs(kept + np.swapaxes(kept, 1, 2)).max() < 2e-12
    lost = np.asarray(poisson_error(top_energy_momentum(top), state, 0.1, 1, method="product"))
    assert np.abs(lost[1]).max() > 1e-5
    assert np.abs(lost[0]).max() == 0
    with pytest.raises(ValueError, match=r"recursion.*without potential, got PotentialTop.*'product'"):
        poisson_error(splitting(top), state, 0.1, 1, method="recursion")


def test_a_top_made_inside_jit_checks_what_is_concrete():
    def energy(inertia, axis):
        top = li.systems.heavy_top(inertia, [0.5, 0.4, 1.0], axis)
        return top.energy(top.state(angular_velocity=[0.1, 0.2, 0.3]))

    J, axis = jnp.array([1.0, 2.0, 2.5]), jnp.array([0.0, 0.6, 0.8])
    outside = energy(J, axis)
    assert jax.jit(lambda J: energy(J, [0.0, 0.6, 0.8]))(J) == pytest.approx(float(outside), rel=1e-15, abs=0)
    assert jax.jit(energy)(J, axis) == pytest.approx(float(outside), rel=1e-15, abs=0)
    with pytest.raises(ValueError, match="axis must not be zero"):
        jax.jit(lambda J: energy(J, [0.0, 0.0, 0.0]))(J)


def test_declared_gradients_of_potentials_agree_with_autodiff():
    """It is what autodiff finds; observed: 1e-16."""
    Gamma, S = jnp.array([0.3, -0.5, 0.9]), jnp.array([[1.1, 0.2, 0.1], [0.2, 1.8, -0.3], [0.1, -0.3, 2.2]])
    for potential in (LinearPotential(Gamma[::-1]), QuadraticPotential(S), QuadraticPotential(jnp.diag(S))):
        np.testing.assert_allclose(gradient(potential, Gamma), jax.grad(potential)(Gamma), rtol=0, atol=5e-16)
    np.testing.assert_array_equal(gradient(lambda Gamma, t: t * Gamma[1], Gamma, jnp.array(2.0)), [0, 2, 0])
