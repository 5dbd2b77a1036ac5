"""Matrix groups: axioms, exp and log, adjoint actions and derivative maps over the whole catalogue; bad bases."""

import functools
import tracemalloc

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import lieint_jax as li
from lieint_jax import _discover, groups, maps
from lieint_jax._numerics import small_linalg as la
from lieint_jax.groups import bases

pytestmark = pytest.mark.long

MATRIX = _discover.modules_with("examples", groups)["matrix"]
CATALOGUE = groups.catalogue.examples() | MATRIX.examples()
QUICK = {"xla_llvm_disable_expensive_passes": True}  # compiled to be run once
FEW = ("SO(3)", "SE(3)", "SO(3) x Aff(1)")
FIRST = sorted(CATALOGUE, key=lambda name: (name not in FEW, name != "SU(2)"))
catalogue = pytest.mark.parametrize(
    "name", [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in FIRST]
)
LANDS_NOT = {"SL(3)", "Bianchi IV"}  # where cay leaves the group


def light(group):
    """The same group, worked out whole where entry by entry takes long to compile."""
    return MATRIX.MatrixGroup(group.basis, group.name, unrolled=group.name in {"SL(2)", "SE(2)"})


@functools.cache
def sample(name):
    """Everything a group answers, at one random point, in one compilation."""
    g = light(CATALOGUE[name])
    rng = np.random.default_rng(3)
    xi, eta, mu = (jnp.array(rng.normal(size=g.dim)) for _ in range(3))

    def matrix(M):
        return la.as_array(M, xi)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def answers(xi, eta, mu):
        a, b, small = g.exp(xi), g.exp(eta), 0.3 * xi
        v = g._vector(small)
        return {
            "a": a,
            "b": b,
            "ab": g.multiply(a, b),
            "inverse": g.inverse(a),
            "near": g.exp_near(small),
            "log": g.log(g.exp_near(small)),
            "Ad": g.Ad(a, eta),
            "Ad_ab": g.Ad(g.multiply(a, b), mu),
            "Ad_a_Ad_b": g.Ad(a, g.Ad(b, mu)),
            "Ad_star": g.Ad_star(a, mu),
            "ad": g.ad(xi, eta),
            "ad_star": g.ad_star(xi, mu),
            "jacobi": g.ad(xi, g.ad(eta, mu)) + g.ad(eta, g.ad(mu, xi)) + g.ad(mu, g.ad(xi, eta)),
            "ad_star_matrix": matrix(g.ad_star_matrix(g._vector(mu))),
            "defects": jnp.stack([g.defect(a), g.defect(g.multiply(a, b)), g.defect(g.cayley(small))]),
            "cay": g.cayley(small),
            "H_exp": matrix(g.exp_slope(v)),
            "H_closed": None if (H := g.closed_slope(v)) is None else matrix(H),
            "H_exp_autodiff": maps.derivative(maps.exponential, g, small),
            "H_cay": matrix(g.cayley_slope(v)),
            "H_cay_autodiff": maps.derivative(maps.cayley, g, small),
            "velocities": jnp.stack([g.body_velocity(a, g.tangent(a, eta)), g.spatial_velocity(a, g.tangent(a, eta))]),
        }

    return g, *(np.array(x) for x in (xi, eta, mu)), jax.tree.map(np.array, answers(xi, eta, mu))


def hat(g, xi):
    return np.tensordot(xi, g.basis, 1)


def expm(X):
    """exp X to the last bit: scipy's is off by 2e-13 at the sample of Bianchi IV, which has a Jordan block."""
    with mpmath.workdps(40):
        return np.array(mpmath.expm(mpmath.matrix(X.tolist())).tolist(), float)


def close(a, b, bound):
    assert np.abs(np.asarray(a) - np.asarray(b)).max() < bound


@catalogue
def test_group_axioms_and_adjoint_actions(name):
    """Against the matrices themselves. Floors: 4e-15 of numbers of size 10."""
    g, xi, eta, mu, out = sample(name)
    X, Y = hat(g, xi), hat(g, eta)
    a, b = expm(X), expm(Y)
    size = (
        np.linalg.norm(a)
        * np.linalg.norm(np.linalg.inv(a))
        * (1 + np.linalg.norm(b) * np.linalg.norm(np.linalg.inv(b)))
    )
    bound = 1e-15 * size * 8
    close(out["ab"], a @ b, bound)
    close(out["inverse"] @ a, np.eye(g.size), bound)
    close(hat(g, out["Ad"]), a @ Y @ np.linalg.inv(a), bound)
    close(out["Ad_ab"], out["Ad_a_Ad_b"], bound * 4)
    close(out["Ad_star"] @ eta, mu @ out["Ad"], bound * 4)
    close(hat(g, out["ad"]), X @ Y - Y @ X, 1e-14)
    close(out["ad_star"] @ eta, mu @ out["ad"], 2e-14)
    close(out["ad_star_matrix"] @ xi, out["ad_star"], 1e-14)
    close(out["ad_star_matrix"], -out["ad_star_matrix"].T, 1e-15)
    close(out["jacobi"], 0, 4e-14)
    close(out["velocities"][0], eta, bound * 4)
    close(out["velocities"][1], out["Ad"], bound * 4)
    close(g.vee(g.hat(xi)), xi, 1e-15)


@pytest.mark.quick
@catalogue
def test_exp_log_and_the_derivative_maps(name):
    """Against scipy and autodiff: H of (5.28)."""
    g, xi, _, _, out = sample(name)
    close(out["a"] / np.abs(out["a"]).max(), expm(hat(g, xi)) / np.abs(out["a"]).max(), 1e-14)
    close(out["near"], expm(hat(g, 0.3 * xi)), 1e-15)
    close(out["log"], 0.3 * xi, 2e-15)
    close(out["H_exp"], out["H_exp_autodiff"], 4e-15)
    if out["H_closed"] is not None:
        close(out["H_closed"], out["H_exp_autodiff"], 4e-15)
    assert out["defects"][:2].max() < 2e-14 * np.abs(out["ab"]).max() ** 2
    if name in LANDS_NOT:
        assert not g.cayley_lands
    else:
        assert g.cayley_lands
        assert out["defects"][2] < 4e-15
        close(out["H_cay"], out["H_cay_autodiff"], 4e-15)
    X = hat(g, 0.3 * xi) / 2
    close(out["cay"], np.linalg.solve(np.eye(g.size) - X, np.eye(g.size) + X), 1e-15)


@pytest.mark.parametrize("name", ["SL(2)", "SE(3)", "SO(4)"])
@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_the_units_of_a_basis_do_not_matter(name, unit):
    """Brackets and inverses, of which only numpy's rounding is left: 2e-16 of the same in equal units."""
    of_one, rng = light(CATALOGUE[name]), np.random.default_rng(6)
    units = np.where(np.arange(of_one.dim) % 2, 1, unit)
    g = groups.matrix(of_one.basis * units[:, None, None], unrolled=False)
    c = of_one.structure * units[:, None, None] * units[:, None] / units
    np.testing.assert_allclose(g.structure, c, rtol=1e-14, atol=0)
    x = 0.5 * rng.normal(size=g.dim)
    q = expm(hat(of_one, x))
    close(g.inverse(q) @ q, np.eye(g.size), 1e-14)
    close(g.exp_near(x / units), q, 1e-14)
    if name != "SO(4)":
        close(maps.arcsine(g, x / 3 / units), maps.arcsine(of_one, x / 3), 1e-14)
    assert g.corank == of_one.corank
    assert g.has_bounded_adjoint == of_one.has_bounded_adjoint


@pytest.mark.parametrize("name", ["SE(3)", pytest.param("SO(4)", marks=pytest.mark.long)])
def test_log_of_rotations_by_up_to_three_radians(name):
    """In any unit of length, in which a rotation by more is NaN too. Observed 2e-15 for angles, 2e-14 for lengths."""
    g, rng = light(CATALOGUE[name]), np.random.default_rng(5)
    log = jax.jit(jax.vmap(g.log), compiler_options=QUICK)
    angles, xi = np.repeat([0.5, 1.9, 2.4, 3.0], 4), rng.normal(size=(16, g.dim))
    xi *= (angles / np.abs(np.linalg.eigvals(np.array([hat(g, x) for x in xi])).imag).max(axis=1))[:, None]
    units = np.where(np.arange(g.dim) < 3, 1, 1e6) if name == "SE(3)" else np.ones(g.dim)
    q = np.array([expm(hat(g, x * units)) for x in xi])
    np.testing.assert_allclose(log(q) / units, xi, rtol=0, atol=1e-13)
    near = np.array([expm(hat(g, -x * units)) for x in xi]) @ q  # the identity but for rounding, with a logarithm too
    np.testing.assert_allclose(log(near) / units, 0, rtol=0, atol=2e-15)  # observed 5e-16
    if name == "SE(3)":
        farther = [3.13 / 3 * x * units for x in xi[12:] for units in (np.ones(6), [1, 1, 1, 1e9, 1e9, 1e9])]
        assert np.isnan(log(np.array([expm(hat(g, x)) for x in farther]))).all()


def test_log_of_matrices_with_real_eigenvalues_and_its_derivative():
    """Each correction multiplied rounding errors by up to e^2λ: log was wrong by 2e-9 at λ = 3 and by 8e-7 at 3.5."""
    g, (a, b) = light(CATALOGUE["SL(2)"]), np.random.default_rng(4).normal(size=(2, 3))
    frames = [np.eye(2), expm(hat(g, 0.3 * a)), expm(hat(g, 0.3 * b))]
    matrices = [R @ np.diag([size, -size]) @ np.linalg.inv(R) for size in (1.0, 2.5, 3.0, 3.5, 4.0) for R in frames]
    xi, q = np.array([g.vee(X) for X in matrices]), np.array([expm(X) for X in matrices])
    condition = np.array([np.linalg.cond(x) for x in q])
    found, slopes = jax.jit(jax.vmap(lambda q, xi: (g.log(q), jax.jacfwd(lambda x: g.log(g.exp(x)))(xi))))(q, xi)
    assert (np.abs(found - xi).max(axis=1) / condition).max() < 1e-16  # observed: 3e-17
    assert (np.abs(slopes - np.eye(3)).max(axis=(1, 2)) / condition).max() < 3e-16  # observed: 6e-17


@jax.jit
def exp_and_tangents(xi):
    g = groups.special_euclidean(3)
    return g.exp(xi), jax.jacfwd(g.exp)(xi)


@pytest.mark.parametrize("size", [1e-8, 1.9, 2.1, 7.0, 60.0, 120.0])
def test_exp_and_its_derivative_on_both_sides_of_every_scaling(size):
    g = groups.special_euclidean(3)
    xi = np.array([0.3, -0.5, 0.4, 0.2, 0.1, -0.3])
    xi *= size / np.abs(hat(g, xi)).sum(0).max()
    X = hat(g, xi)
    value, tangents = exp_and_tangents(xi)
    close(value, expm(X), 4e-15 * max(1, size))
    for i, E in enumerate(g.basis):
        exact = scipy.linalg.expm_frechet(X, E, compute_expm=False)
        close(tangents[..., i], exact, 4e-15 * max(1, size) ** 2)
    if size < 2.2:
        assert g.near(xi)
        close(g.exp_near(xi), expm(X), 2e-15)


def test_exp_is_nan_beyond_its_range_and_near_is_false():
    g = groups.special_orthogonal(3)
    assert np.isnan(g.exp(jnp.array([200.0, 0, 0]))).all()
    assert not g.near(jnp.array([2.5, 0, 0]))
    xi = jnp.array([0.5, 0, 0, 1e4, 0, 0])  # a long translation is no obstacle
    assert groups.special_euclidean(3).near(xi)
    close(groups.special_euclidean(3).exp(xi)[:3, 3], [1e4, 0, 0], 2e-12)
    close(groups.special_euclidean(3).exp(xi)[:3, :3], expm(groups.special_euclidean(3).hat(xi)[:3, :3]), 2e-15)


def test_entry_by_entry_and_whole_are_the_same_group():
    rng = np.random.default_rng(1)
    for g in (groups.special_euclidean(3), groups.heisenberg(2)):
        h = MATRIX.MatrixGroup(g.basis, g.name, unrolled=False)
        assert g.unrolled
        assert g != h
        xi, mu = jnp.array(rng.normal(size=(2, g.dim)))
        q = g.exp_near(xi)
        for ours, theirs in (
            (q, h.exp_near(xi)),
            (g.Ad(q, mu), h.Ad(q, mu)),
            (g.Ad_star(q, mu), h.Ad_star(q, mu)),
            (g.cayley(xi), h.cayley(xi)),
            (g.rounding(q, mu), h.rounding(q, mu)),
            (g.drift(q), h.drift(q)),
            (g.exp_near(-xi), la.as_array(g.exp_both(la.unrolled(xi))[1], xi)),
            (g.cayley(-xi), la.as_array(g.cayley_both(la.unrolled(xi))[1], xi)),
            (h.Ad_star(q, mu), jnp.stack(g.exp_coadjoint(*map(la.unrolled, (xi, mu))))),
        ):
            close(ours, theirs, 2e-15)


@pytest.mark.parametrize("name", ["SE(3)", "Heis(5)", "SO(4)"])  # with a closed form; nilpotent; with none
def test_exp_along_a_curve_is_the_product_with_exp(name):
    g = CATALOGUE[name]
    q, xi, tangent = jnp.array(np.random.default_rng(2).normal(size=(3, g.dim)))
    q, s = scipy.linalg.expm(hat(g, np.asarray(q))), jnp.array([0.0, 0.5, -1.0, 1.0])

    @functools.partial(jax.jit, compiler_options=QUICK)
    def along(xi, tangent):
        curve, slopes = jax.jvp(lambda xi: g.exp_along(jnp.asarray(q), xi, s), (xi,), (tangent,))
        return curve, slopes, g.exp_along(jnp.asarray(q), xi, s[1])

    curve, slopes, middle = along(xi, tangent)
    X, dX = hat(g, np.asarray(xi)), hat(g, np.asarray(tangent))
    size = np.abs(q).max() * np.abs(scipy.linalg.expm(X)).max()
    for k, t in enumerate(np.asarray(s)):
        value, derivative = scipy.linalg.expm_frechet(t * X, t * dX)
        close(curve[k], q @ value, 4e-15 * size)
        close(slopes[k], q @ derivative, 1e-14 * size)
    close(middle, curve[1], 2e-15 * size)


CLOSED = {  # Xʲ(X² − x)ᵏ = 0: (j, k)
    "SO(3)": (1, 1),
    "SU(2)": (0, 1),
    "SE(2)": (1, 1),
    "SE(3)": (2, 1),
    "SL(2)": (0, 1),
    "Aff(1)": (1, 1),
    "Heis(5)": (3, 0),
    "E(1,1)": (1, 1),
    "R^3": (2, 0),
}


@pytest.mark.quick
def test_closed_forms_where_there_is_one_pair_of_eigenvalues():
    """Rodrigues' formula among them; x = −|θ|² on SO(3) and SE(3), −det on SL(2). Others have none."""
    for name, group in CATALOGUE.items():
        closed = group._closed
        if name in CLOSED:
            assert (closed.nilpotent, closed.pairs) == CLOSED[name], name
            xi = np.random.default_rng(0).normal(size=group.dim)
            largest = np.linalg.eigvals(hat(group, xi)) ** 2
            np.testing.assert_allclose(np.abs(largest - closed.square(jnp.array(xi))).min(), 0, rtol=0, atol=1e-14)
        elif name in ("SO(4)", "SL(3)", "Sp(4)", "T(3)", "SO(3) x Aff(1)"):
            assert closed is None, name
    sine, cosine = groups.special_orthogonal(3)._closed.series([1, 1, 1 / 2, 1 / 6, 1 / 24, 1 / 120])[1:]
    assert sine == pytest.approx([1, 1 / 6, 1 / 120], rel=1e-15, abs=0)  # of x = −θ²
    assert cosine == pytest.approx([1 / 2, 1 / 24], rel=1e-15, abs=0)


def test_groups_by_their_known_structure():
    cross = groups.special_orthogonal(3)
    u, v = np.array([[0.3, -0.5, 0.4], [0.1, 0.7, -0.2]])
    close(cross.ad(u, v), np.cross(u, v), 1e-16)
    close(groups.special_unitary(2).ad(u, v), np.cross(u, v), 1e-16)
    close(groups.so3.to_matrix(groups.so3.exp(jnp.array(u))), cross.exp(jnp.array(u)), 1e-15)
    q = groups.symplectic(4).exp(jnp.array(np.random.default_rng(0).normal(size=10) / 3))
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    close(q.T @ J @ q, J, 1e-14)
    dims = {"SO(4)": 6, "SU(2)": 3, "SE(3)": 6, "SL(3)": 8, "Sp(4)": 10, "Heis(5)": 5, "T(3)": 6}
    assert {name: CATALOGUE[name].dim for name in dims} == dims
    assert groups.special_unitary(3).dim == 8


def test_the_defect_detects_matrices_off_the_group():
    for name, wrong in {
        "SO(3)": np.diag([1.0, 1.0, -1.001]),
        "SE(3)": np.diag([1.001, 1.001, 1.001, 1.0]),
        "SL(3)": np.eye(3) * 1.001,
        "Heis(5)": np.diag([1.0, 1.001, 1.0, 1.0]),
        "Aff(1)": np.array([[1.0, 0.0], [0.0, 1.001]]),
        "Sp(4)": np.diag([1.0, 1.001, 1.0, 1.0]),
    }.items():
        assert CATALOGUE[name].defect(jnp.array(wrong)) > 5e-4, name
        assert CATALOGUE[name].defect(jnp.eye(len(wrong))) == 0


@pytest.mark.quick
def test_building_a_group_again_is_the_same_group_and_hits_the_same_cache():
    traced = []

    @jax.jit
    def energy(system, state):
        traced.append(1)
        return system.energy(state)

    for _ in range(2):
        system = li.systems.euler(groups.special_euclidean(2), [1.0, 2.0, 3.0])
        energy(system, system.state(velocity=[1.0, 0.0, 0.0]))
    assert len(traced) == 1
    assert groups.special_linear(2) == groups.special_linear(2)
    assert hash(groups.special_linear(2)) == hash(groups.special_linear(2))
    assert groups.special_linear(2) != groups.special_orthogonal(3)


def test_custom_groups_are_made_from_a_basis():
    """Complex matrices too: the unit quaternions from Pauli matrices are SU(2)."""
    x, y, z = np.array([[[0, 1], [1, 0]], [[0, -1j], [1j, 0]], [[1, 0], [0, -1]]])
    own = groups.matrix([-0.5j * x, -0.5j * y, -0.5j * z])
    assert own == groups.special_unitary(2)
    system = li.systems.euler(own, [1.0, 2.0, 3.0])
    step = li.schemes.group_midpoint(system)
    run = jax.jit(step, compiler_options=QUICK)
    assert run(system.state(velocity=[0.3, 0.2, 0.1]), 0.1)[1].converged


@pytest.mark.quick
def test_a_product_of_many_groups_needs_little_memory():
    """The equations of all invariant forms at once, and their full SVD, took 5.8 GB for four times SU(3)."""
    one, factors = groups.special_unitary(3), 4
    group = functools.reduce(groups.product, [one] * factors)
    E = group._unit_basis
    tracemalloc.start()
    forms = bases.invariant_forms(E)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e7  # 1.5e7
    assert len(forms) == 2 * factors  # 1 and i of each factor
    assert max(np.abs(e.T @ S + S @ e).max() for e in E for S in forms) < 1e-13
    assert np.linalg.matrix_rank(np.reshape(forms, (len(forms), -1))) == len(forms)


@pytest.mark.parametrize("name", CATALOGUE)
def test_invariant_forms_are_the_null_space_of_their_equations(name):
    """All equations at once, as a dense matrix, have the same solutions."""
    E = CATALOGUE[name]._unit_basis
    one = np.eye(E.shape[1])
    dense = scipy.linalg.null_space(np.concatenate([np.kron(e.T, one) + np.kron(one, e.T) for e in E]), 1e-10).T
    forms = bases.invariant_forms(E)
    assert len(forms) == len(dense)
    found = np.reshape(forms, dense.shape)
    assert np.linalg.matrix_rank(np.concatenate([found, dense]), 1e-9) == len(dense)
