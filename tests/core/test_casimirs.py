"""Casimirs of matrix groups: how many, independent, in involution with every μ_i, constant along runs, known ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import _discover, groups

MATRIX = _discover.modules_with("examples", groups)["matrix"]
THREE = {"SU(3)": groups.special_unitary(3), "Sp(4)": groups.symplectic(4), "SE(3)": groups.special_euclidean(3)}
ALL = THREE | groups.catalogue.examples() | MATRIX.examples()
ALL |= {"SO(5)": groups.special_orthogonal(5), "SE(4)": groups.special_euclidean(4), "Aff(2)": groups.affine(2)}
MISSING = {"T(3)": 1, "Bianchi V": 1, "Bianchi IV": 1}  # those that are no polynomials
EPS = float(np.finfo(float).eps)


def whole(group):
    return MATRIX.MatrixGroup(group.basis, group.name, unrolled=False)


def sizes(group, mu):
    """Σ|terms| of each Casimir, which times eps bounds its rounding error, (k,)."""
    terms = [jnp.abs(c) @ jnp.prod(jnp.abs(mu)[monomials], axis=1) for monomials, c in group._casimirs]
    return jnp.concatenate([mu[:0], *terms])


@functools.partial(jax.jit, static_argnums=0)
def gradients_and_brackets(group, mu):
    """∂C/∂μ (k, d), {C, μ_i} (k, d) and the Poisson tensor (d, d) at each point, and the sizes of the brackets (k,)."""

    def at(mu):
        gradient = jax.jacrev(group.casimirs)(mu)
        tensor = group.ad_star_matrix(mu)
        return gradient, gradient @ tensor.T, tensor, jnp.abs(gradient) @ jnp.sum(jnp.abs(tensor), axis=1)

    return jax.vmap(at)(mu)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_as_many_independent_casimirs_as_the_corank(name):
    """By autodiff at random momenta. Floor of {C, μ_i}: 0.4 eps of its terms."""
    group = whole(ALL[name])
    mu = np.random.default_rng(5).normal(size=(8, group.dim))
    gradients, brackets, tensors, size = (np.array(x) for x in gradients_and_brackets(group, mu))
    corank = group.dim - np.linalg.matrix_rank(tensors, rtol=1e-12)
    assert (corank == group.corank).all()
    assert gradients.shape[1] == group.corank - MISSING.get(name, 0)
    assert (np.linalg.matrix_rank(gradients, rtol=1e-6) == gradients.shape[1]).all()
    assert (np.abs(brackets) <= 2 * EPS * size[:, :, None]).all()


def test_the_casimirs_of_su3_and_sp4_are_traces_of_powers():
    """tr M² and tr M³ of the Hermitian M on SU(3); tr M² and tr M⁴ on Sp(4), with ⟨μ, ξ⟩ = tr(Mξ̂). Floor: 5e-16."""
    for name, degree in (("SU(3)", 3), ("Sp(4)", 4)):
        group = whole(THREE[name])
        basis = group.basis if name == "Sp(4)" else 1j * (group.basis[:, :3, :3] + 1j * group.basis[:, 3:, :3])
        mu = np.random.default_rng(6).normal(size=(20, group.dim))
        M = np.tensordot(np.linalg.solve(np.einsum("iab,jba->ij", basis, basis), mu.T).T, basis, 1)
        traces = [np.trace(np.linalg.matrix_power(M, n), axis1=1, axis2=2) for n in (2, degree)]
        found = np.array(jax.jit(jax.vmap(group.casimirs))(mu)).T
        for value, terms in zip(found, ([traces[0]], [traces[1], *[traces[0] ** 2] * (degree == 4)]), strict=True):
            factors, *_ = np.linalg.lstsq(np.array(terms).T, value)
            assert abs(factors[0]) > 0.1
            np.testing.assert_allclose(factors @ terms, value, rtol=0, atol=2e-15 * np.abs(value).max())


def test_dependent_and_unknown_ones_are_left_out():
    """[a, xᵢ] = zᵢ for i = 1, 2, 3: zᵢ and the three zᵢxⱼ − zⱼxᵢ, of which two are independent. Degree 4 of SU(4)."""
    unit = np.eye(25).reshape(5, 5, 5, 5)
    group = MATRIX.matrix([unit[0, 1], *unit[1, 2:], *unit[0, 2:]])
    casimirs = np.array(jax.jit(group.casimirs)(np.array([7.0, 1, 2, 3, 10, 20, 40])))
    assert casimirs[:3].tolist() == [10, 20, 40]
    assert casimirs.shape == (group.corank,) == (5,)
    large = groups.special_unitary(4)
    assert large.corank == 3
    assert jax.eval_shape(large.casimirs, np.ones(15)).shape == (2,)


def test_in_other_units_and_precisions():
    """SU(3) with Eᵢ in units down to 1e-6, and in float32. Floors: 4.3 and 0.7 eps of the terms."""
    unit = np.random.default_rng(8).permutation(np.logspace(-6, 0, 8))
    group, scaled = THREE["SU(3)"], MATRIX.matrix(THREE["SU(3)"].basis * unit[:, None, None])

    @jax.jit
    @jax.vmap
    def values(mu):
        single = mu.astype(jnp.float32)
        return group.casimirs(mu), scaled.casimirs(unit * mu), group.casimirs(single), sizes(group, mu)

    value, other, single, size = (np.array(x) for x in values(np.random.default_rng(7).normal(size=(8, 8))))
    factor = np.sum(other * value, axis=0) / np.sum(other**2, axis=0)
    assert (np.abs(factor * other - value) <= 12 * EPS * size).all()
    assert single.dtype == np.float32
    assert (np.abs(single - value) <= 2 * np.finfo(np.float32).eps * size).all()


def coupled(q):
    return q[0, 1]


def zero(q):
    return 0 * q[0, 1]


def start(name):
    """A random metric and a velocity with |Ω| = 1."""
    group, rng = whole(THREE[name]), np.random.default_rng(0)
    A, v = rng.normal(size=(group.dim, group.dim)), rng.normal(size=group.dim)
    return group, A @ A.T / group.dim + np.eye(group.dim), v / np.linalg.norm(v)


@functools.partial(jax.jit, compiler_options={"xla_llvm_disable_expensive_passes": True})
def along_a_run(step, state):
    """The Casimirs of Π = Ad*_q π at some of 100 steps of 0.05, and the bound eps (|∂C/∂Π| rounding(Π) + Σ|terms|)."""
    group, system = step.system.group, step.system
    run = li.integrate(step, state, 0.05, 100, save_every=10)

    def at(state):
        Pi = system.body_momentum(state)
        by_rounding = jnp.abs(jax.jacrev(group.casimirs)(Pi)) @ group.rounding(state.q, state.p)
        return system.casimirs(state), EPS * (by_rounding + sizes(group, Pi))

    return run.info.converged, *jax.vmap(at)(run.state)


RUNS = [(name, scheme) for name in THREE for scheme in ("group_midpoint", "group_energy_momentum")]


@pytest.mark.long
@pytest.mark.parametrize(("name", "scheme"), RUNS)
def test_casimirs_are_constant_along_runs(name, scheme):
    """To the rounding of Π = Ad*_q π, which grows with Ad_q on Sp(4), SE(3). Floor: 3.4 times the bound (SU(3))."""
    group, metric, velocity = start(name)
    midpoint = scheme == "group_midpoint"
    system = li.systems.euler(group, metric) if midpoint else li.systems.group_potential(group, metric, zero)
    step = getattr(li.schemes, scheme)(system)
    converged, values, bound = (np.array(x) for x in along_a_run(step, system.state(velocity=velocity)))
    assert converged.all()
    assert values.shape[1] == group.corank
    assert (np.abs(values - values[0]) <= 8 * bound).all()


@pytest.mark.long
def test_a_potential_changes_them():
    group, metric, velocity = start("SE(3)")
    system = li.systems.group_potential(group, metric, coupled)
    step = li.schemes.group_energy_momentum(system)
    converged, values, _ = (np.array(x) for x in along_a_run(step, system.state(velocity=velocity)))
    assert converged.all()
    assert np.abs(values - values[0]).max() > 0.1
