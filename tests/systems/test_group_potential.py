"""Potentials on any group: energy, momentum, order, reversibility of `group_energy_momentum` (Result 13)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linearized import there_and_back
from scipy.linalg import expm

import lieint_jax as li
from lieint_jax import _discover, groups
from lieint_jax.core import State
from lieint_jax.diagnostics import flow, symplectic_defect

MATRIX = _discover.modules_with("examples", groups)["matrix"]
QUICK = {"xla_llvm_disable_expensive_passes": True}


def wells(W, q):
    """A potential without any symmetry."""
    return jnp.sum(W * jnp.sin(q)) + 0.1 * jnp.sum(q * q)


def system_and_state(group, seed=0):
    rng = np.random.default_rng(seed)
    g = MATRIX.MatrixGroup(group.basis, group.name, unrolled=False)
    A = rng.normal(size=(g.dim, g.dim))
    W = jnp.array(rng.normal(size=(g.size, g.size))) / 4
    system = li.systems.group_potential(g, A @ A.T / g.dim + np.eye(g.dim), jax.tree_util.Partial(wells, W))
    v = rng.normal(size=g.dim)
    q = expm(np.tensordot(v / 5, g.basis, 1))
    carried = (np.linalg.inv(q) @ g.basis @ q).reshape(g.dim, -1)
    Ad = np.linalg.lstsq(g.basis.reshape(g.dim, -1).T, carried.T)[0]  # of q⁻¹
    p = Ad.T @ np.asarray(system.metric) @ v / np.linalg.norm(v) / 2
    return system, State(jnp.array(q), jnp.array(p))


@functools.partial(jax.jit, compiler_options=QUICK)
def measured(step, state, dt):
    system = step.system
    run = li.integrate(step, state, dt, 200, save_every=20)
    after, _, form, back = there_and_back(step, state, dt)
    exact = flow(system, state, dt, 1)
    return {
        "energy": li.Run.of(step, run).energy_error(),
        "converged": run.info.converged,
        "all": run.state.p - state.p,
        "momentum": jax.vmap(system.momentum)(run.state) - system.momentum(state),
        "error": jnp.maximum(jnp.abs(after.q - exact.q).max(), jnp.abs(after.p - exact.p).max()),
        "back": jnp.maximum(jnp.abs(back.q - state.q).max(), jnp.abs(back.p - state.p).max()),
        "form": form,
    }


def check(system, state, dt):
    """Energy, order 2, reversibility; not symplectic, Result 8: the defect is O(Δt³)."""
    step = li.schemes.group_energy_momentum(system)
    out, half = measured(step, state, dt), measured(step, state, dt / 2)
    assert out["converged"].all()
    assert np.abs(out["energy"]).max() < 2e-14
    assert out["back"] < 4e-15
    assert np.log2(out["error"] / half["error"]) == pytest.approx(3, abs=0.15)
    assert out["form"] > 1e-8
    assert np.log2(out["form"] / half["form"]) == pytest.approx(3, abs=0.15)
    return out


LARGER = [pytest.param(name, marks=pytest.mark.long) for name in ("SL(2)", "SE(3)", "SL(3)", "SO(4)")]


@pytest.mark.slow
@pytest.mark.paper("5.4: (5.49), Result 13", "energy with a potential", "schemes/_group_energy_momentum.py")
@pytest.mark.parametrize("name", ["Aff(1)", *LARGER])
def test_result_13_energy_for_any_potential(name):
    check(*system_and_state(groups.catalogue.examples()[name]), 0.05)


@pytest.mark.long
def test_momentum_of_the_symmetries_is_conserved():
    """A bottom-heavy ellipsoid in a fluid: spatial momentum and the angular momentum about the vertical."""
    g = MATRIX.MatrixGroup(groups.special_euclidean(3).basis, "SE(3)", unrolled=False)
    example, _, dt = _discover.modules_with("examples", li.systems)["group_potential"].examples()["bottom_heavy"]
    system = li.systems.group_potential(g, example.metric, example.potential, example.symmetry)
    state = system.state(velocity=[0.3, -0.4, 0.5, 0.6, 0.2, -0.3])
    out = check(system, state, dt)
    assert np.abs(out["momentum"]).max() < 4e-15
    assert np.abs(np.asarray(out["all"])).max() > 0.01  # the others are not


@pytest.mark.long
def test_splitting_uses_the_arcsine_map_where_it_is_symplectic():
    """Kick – drift – kick on SL(2): the form to round-off. On SE(3) no drift is known, and it says so."""
    system, state = system_and_state(groups.special_linear(2))
    step = li.schemes.splitting(system)
    assert step.drift.tau.name == "arcsine"
    form, back = jax.jit(
        lambda z: (symplectic_defect(step, z, 0.1), step(step(z, 0.1)[0], -0.1)[0]), compiler_options=QUICK
    )(state)
    assert form < 4e-15
    assert np.abs(back.q - state.q).max() < 4e-15
    with pytest.raises(ValueError, match="give a symmetric step"):
        li.schemes.splitting(system_and_state(groups.special_euclidean(3))[0])


def stark(x, q):
    """A potential on SU(3), real (6, 6), that the diagonal matrices leave invariant."""
    weights = jnp.array([1.0, 2.0, 4.0, 1.0, 2.0, 4.0])
    return jnp.sum(weights * (q @ x[0]) ** 2) + jnp.sum(weights * (q @ x[0]) * (q @ x[1])) ** 2


@pytest.mark.long
@pytest.mark.parametrize("metric", [np.full(8, 2.0), 0.7 * np.eye(8)], ids=["principal", "full"])
def test_a_bi_invariant_metric_drifts_exactly(metric):
    """On SU(3), where the arcsine map is not symplectic: order 2, form, momentum of the torus, and the way back."""
    g = groups.special_unitary(3)
    rng = np.random.default_rng(5)
    torus = np.eye(8)[6:]  # the diagonal matrices
    field = jax.tree_util.Partial(stark, jnp.array(rng.normal(size=(2, 6)) / 2))
    system = li.systems.group_potential(g, metric, field, torus)
    state = system.state(g.exp(jnp.array(rng.normal(size=8))), velocity=rng.normal(size=8) / 2)
    step = li.schemes.splitting(system)
    assert step.drift.order == np.inf
    out, half = measured(step, state, 0.05), measured(step, state, 0.025)
    assert out["converged"].all()
    assert max(out["form"], half["form"]) < 4e-15
    assert max(out["back"], half["back"]) < 4e-15
    assert np.log2(out["error"] / half["error"]) == pytest.approx(3, abs=0.15)
    assert np.abs(out["momentum"]).max() < 1e-14
    assert np.abs(np.asarray(out["all"])).max() > 0.01  # the others change
    free = system.free
    far, info = jax.jit(step.drift.__call__)(state, 3.0)  # exact at any dt: as far as 300 steps, with the same Π
    near = li.integrate(li.schemes.group_midpoint(free), state, 0.01, 300, save_every=300).state.q[-1]
    assert info.converged
    np.testing.assert_allclose(far.q, near, rtol=0, atol=1e-4)
    np.testing.assert_allclose(free.body_momentum(far), free.body_momentum(state), rtol=0, atol=4e-15)
    np.testing.assert_array_equal(far.p, state.p)


@pytest.mark.long
def test_the_drift_of_other_metrics_and_of_traced_ones_is_not_exact():
    g = groups.special_unitary(3)
    with pytest.raises(ValueError, match=r"this metric: give .*O.Δt³. per step unless the metric is bi-invariant$"):
        li.schemes.splitting(li.systems.group_potential(g, np.arange(1.0, 9.0), jnp.sum))

    def traced(size):
        return li.schemes.splitting(li.systems.group_potential(g, jnp.full(8, size), jnp.sum))

    with pytest.raises(
        ValueError, match="one is for a bi-invariant metric whose numbers are known when the step is made"
    ):
        jax.jit(traced)(2.0)
    line = groups.translations(2)  # where every metric is bi-invariant
    step = li.schemes.splitting(li.systems.group_potential(line, [[2.0, 1.0], [1.0, 3.0]], jnp.sum))
    assert step.drift.order == np.inf
    lopsided = li.systems.group_potential(groups.special_orthogonal(3), [1.0, 1.0, 1.0 + 1e-9], jnp.sum)
    assert li.schemes.splitting(lopsided).drift.order == 2


def a_product():
    """A rotor with a bead on a line: SO(3) × R, a metric that does not couple them, a potential that does."""
    g = groups.product(groups.special_orthogonal(3), groups.translations(1))
    W = jnp.array(np.random.default_rng(2).normal(size=(g.size, g.size))) / 4
    A = np.diag([1.0, 2.0, 3.0, 0.5])
    A[0, 1] = A[1, 0] = 0.2
    system = li.systems.group_potential(g, A, jax.tree_util.Partial(wells, W))
    return system, system.state(velocity=[0.3, -0.5, 0.4, 0.2])


def a_body_in_space():
    """SE(3) with an isotropic mass and a tensor that is not diagonal, in the field of `wells`."""
    g = groups.special_euclidean(3)
    W = jnp.array(np.random.default_rng(3).normal(size=(4, 4))) / 4
    m = np.diag([2.0, 3.0, 2.5, 1.7, 1.7, 1.7])
    m[0, 2] = m[2, 0] = 0.3
    system = li.systems.group_potential(g, m, jax.tree_util.Partial(wells, W))
    return system, system.state(
        g.exp(jnp.array([0.3, 0.2, 0.1, 1.0, 2.0, 3.0])), velocity=[0.3, 0.2, 0.5, 0.1, -0.2, 0.3]
    )


@pytest.mark.long
@pytest.mark.parametrize("made", [a_product, a_body_in_space])
def test_splitting_finds_the_drift_of_products(made):
    """The form and the way back to round-off (seen: 7e-16, 4e-16); the error of a step beside the flow is O(Δt³)."""
    system, state = made()
    step = li.schemes.splitting(system)

    @jax.jit
    def errors(dt):
        after, _, form, back = there_and_back(step, state, dt)
        exact = flow(system, state, dt, 1)
        return form, jnp.abs(back.q - state.q).max(), jnp.abs(after.q - exact.q).max(), jnp.abs(after.p - exact.p).max()

    coarse, fine = (np.asarray(errors(h)) for h in (0.1, 0.05))
    assert max(coarse[0], fine[0]) < 3e-15
    assert coarse[1] < 2e-15
    np.testing.assert_allclose(np.log2(coarse[2:] / fine[2:]), 3, rtol=0, atol=0.15)


@pytest.mark.long
@pytest.mark.parametrize("axis", [3, 0])
def test_a_metric_that_couples_the_factors_has_no_known_drift(axis):
    """SO(3) × R with a coupling, and SE(3) with a mass that is not isotropic."""
    system, _ = (a_product if axis == 3 else a_body_in_space)()
    assert li.schemes.splitting(system).order == 2
    m = np.array(system.metric)
    if axis == 3:
        m[0, 3] = m[3, 0] = 0.1
    else:
        m[5, 5] = 2.0
    with pytest.raises(ValueError, match="no symplectic drift is known"):
        li.schemes.splitting(li.systems.group_potential(system.group, m, system.potential))


def test_the_forces_in_space_and_in_the_body_agree_with_differences():
    """−dV(exp(εeᵢ)q)/dε and −dV(q exp(εeᵢ))/dε by differences; the second is Ad*_q of the first, and not the same."""
    system, state = system_and_state(groups.special_euclidean(2))
    g, V, q, h = system.group, system.potential, np.asarray(state.q), 1e-4
    forces = jax.jit(lambda q: (system.force(q), system.body_force(q), g.Ad_star(q, system.force(q))))
    space, body, carried = (np.asarray(x) for x in forces(state.q))

    def slope(moved):
        return [(V(moved(expm(-h * E))) - V(moved(expm(h * E)))) / (2 * h) for E in g.basis]

    np.testing.assert_allclose(space, slope(lambda e: e @ q), rtol=0, atol=1e-8)  # of O(h²): 4e-9
    np.testing.assert_allclose(body, slope(lambda e: q @ e), rtol=0, atol=1e-8)
    np.testing.assert_allclose(body, carried, rtol=0, atol=1e-15)
    assert np.abs(body - space).max() > 0.05


def test_advice_gives_the_iterations():
    g = groups.special_euclidean(2)
    step = li.schemes.group_energy_momentum(li.systems.group_potential(g, [1.0, 1, 1], jnp.sum))
    assert "does not converge at dt = 9.0: use a smaller dt, or more iterations than 6" in step.advice(None, 9.0)
