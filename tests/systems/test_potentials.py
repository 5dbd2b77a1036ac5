"""Potentials of several bodies: against plain sums and quadrature, their symmetry, and what each scheme keeps."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_numbers
import slopes
from scipy.integrate import quad
from scipy.optimize import brentq, minimize
from scipy.special import elliprd, elliprf

import lieint_jax as li
from lieint_jax import potentials, schemes, systems
from lieint_jax._numerics.elliptic import carlson_rf_rd
from lieint_jax.groups import so3

RNG = np.random.default_rng(5)
UNEVEN = [RNG.normal(size=(n, 3)) * 0.2 for n in (3, 1, 3, 2, 1, 3)]  # six bodies, three groups
NUMBERS = [RNG.uniform(0.5, 1.5, n) for n in (3, 1, 3, 2, 1, 3)]
PLACES = jnp.array([[2.0 * i, np.sin(2 * i), np.cos(3 * i)] for i in range(6)])
TURNS = jax.vmap(lambda a: so3.to_matrix(so3.exp(a)))(jnp.asarray(RNG.normal(size=(6, 3))))
KINDS = {
    "masses": (potentials.point_masses(2.0, NUMBERS, UNEVEN, 0.3), lambda r, a, b: -2 * a * b / np.hypot(r, 0.3)),
    "charges": (potentials.point_charges(3.0, NUMBERS, UNEVEN), lambda r, a, b: 3 * a * b / r),
    "Lennard-Jones": (
        potentials.lennard_jones(NUMBERS, [2 * c for c in NUMBERS], UNEVEN),
        lambda r, a, b: 4 * np.sqrt(a * b) * (((a + b) / r) ** 12 - ((a + b) / r) ** 6),
    ),
}
SPRINGS = potentials.springs([[0, 1], [1, 3], [4, 5]], RNG.normal(size=(3, 2, 3)), [1.0, 2.0, 0.5], [2.0, 0.0, 1.0])
ELLIPSOID = potentials.ellipsoid_sphere(1.0, [2.0, 3.0], [2.0, 1.5, 0.7])
FIELD = potentials.uniform_field([0.3, -0.2, -1.0], NUMBERS, UNEVEN)
WATER = potentials.water("TIP4P")


def molecules(x, q, **motion):
    """So many molecules of water, and their state."""
    n = len(x)
    bodies = systems.rigid_bodies([WATER.mass] * n, np.tile(WATER.inertia, (n, 1)), WATER.potential(n))
    return bodies, bodies.state(x, q, **motion)


DIMER, NEAR = molecules(
    jnp.array([[-0.14, 0, 0], [0.14, 0, 0]]),
    jax.vmap(so3.exp)(jnp.array([[0.4, 1.2, 0.3], [-0.3, 0.5, 0.2]])),
    velocities=jnp.array([[0.1, 0.2, -0.1], [-0.1, -0.2, 0.1]]),
    angular_velocities=jnp.array([[5.0, -3.0, 4.0], [-6.0, 2.0, 3.0]]),
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_sum_over_sites_is_the_sum_over_all_pairs_of_different_bodies(kind):
    potential, pair = KINDS[kind]
    at = [np.asarray(x + s @ np.asarray(R).T) for x, R, s in zip(PLACES, TURNS, UNEVEN, strict=True)]
    total = sum(
        pair(np.linalg.norm(a - b), c, d)
        for i, j in itertools.combinations(range(6), 2)
        for a, c in zip(at[i], NUMBERS[i], strict=True)
        for b, d in zip(at[j], NUMBERS[j], strict=True)
    )
    assert len(potential.groups) == 3
    assert float(jax.jit(potential)(PLACES, TURNS)) == pytest.approx(total, rel=1e-13, abs=0)


@pytest.mark.long
def test_one_number_a_body_is_a_point_at_its_center():
    V = potentials.point_masses(1.0, [2.0, 3.0])
    assert float(V(jnp.array([[0.0, 0, 0], [0, 0, 2]]), TURNS[:2])) == -3
    assert float(V.G) == 1
    with pytest.raises(AttributeError, match="charges have no constant of gravity"):
        _ = KINDS["charges"][0].G


def test_a_spring_obeys_hooke_s_law():
    V = potentials.springs([[0, 1]], [[[1.0, 0, 0], [0, 1, 0]]], 2.0, 1.5)
    ends = PLACES[0] + TURNS[0][:, 0], PLACES[1] + TURNS[1][:, 1]
    length = np.linalg.norm(ends[0] - ends[1])
    assert float(jax.jit(V)(PLACES[:2], TURNS[:2])) == pytest.approx((length - 1.5) ** 2, rel=1e-14, abs=0)
    slack = potentials.springs([[0, 1]], np.zeros((1, 2, 3)), 2.0, 0.0)
    pull = jax.jit(jax.grad(slack))(jnp.zeros((2, 3)), TURNS[:2])
    assert float(jnp.abs(pull).max()) == 0  # finite where its ends meet


@jax.jit
def gradients(potential):
    """Discrete gradients between states far apart, forth and back, and 1e-9 apart; the mean gradient of the latter."""
    V = potentials.invariant_form(potential)
    start, near = V.invariants(PLACES, TURNS), V.invariants(PLACES + 1e-9 * jnp.sin(PLACES), TURNS)
    far = V.invariants(1.1 * PLACES + 0.1, TURNS[::-1])
    slope = jax.tree.map(lambda a, b: (a + b) / 2, *(jax.grad(V.value)(at) for at in (start, near)))
    found = [V.discrete_gradient(*pair) for pair in ((start, far), (far, start), (start, near))]
    return *found, slope, jax.tree.map(jnp.subtract, far, start), V.value(start), V.value(far)


@pytest.mark.long
@pytest.mark.parametrize("name", [*KINDS, "springs", "field", "MacCullagh", "sum"])
def test_discrete_gradients_give_the_difference_without_cancellation(name):
    """D·(I₁ − I₀) = V₁ − V₀ far apart; between states 1e-9 apart D is the mean gradient to round-off."""
    J = np.array([[1.0, 1.2, 1.5]] * 6)
    named = {name: V for name, (V, _) in KINDS.items()} | {
        "springs": SPRINGS,
        "field": FIELD,
        "MacCullagh": potentials.maccullagh(1.0, np.ones(6), J),
        "sum": KINDS["charges"][0] + SPRINGS + FIELD,
    }
    D, back, close, slope, change, before, after = jax.device_get(gradients(named[name]))
    terms = np.concatenate([np.ravel(x) for x in jax.tree.leaves(jax.tree.map(np.multiply, D, change))])
    assert abs(terms.sum() - after + before) < 1e-14 * (np.abs(terms).sum() + abs(before))
    for d, e in zip(jax.tree.leaves(D), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(d, e, rtol=1e-14, atol=1e-15)
    for d, e in zip(jax.tree.leaves(close), jax.tree.leaves(slope), strict=True):
        np.testing.assert_allclose(d, e, rtol=1e-12, atol=1e-14 * np.abs(e).max())


def test_the_discrete_gradient_of_a_pair_of_sites_gives_the_difference():
    """Of each law, from a squared distance to another; for molecules of more sites see above."""
    start, end = np.array([[1.3]]), np.array([[2.9]])
    for V in (
        potentials.point_masses(2.0, [1.5, 0.7], softening=0.3),
        potentials.point_charges(3.0, [1.5, -0.7]),
        potentials.lennard_jones([1.5, 0.7], [0.9, 1.2]),
    ):
        [D] = V.discrete_gradient((start,), (end,))
        assert float(D[0, 0]) * 1.6 == pytest.approx(float(V.value((end,)) - V.value((start,))), rel=1e-14, abs=0)
    spring = potentials.springs([[0, 1]], np.zeros((1, 2, 3)), 2.0, 0.8)
    [D] = spring.discrete_gradient(start[0], end[0])
    assert float(D) * 1.6 == pytest.approx(float(spring.value(end[0]) - spring.value(start[0])), rel=1e-14, abs=0)


def test_a_uniform_field_of_many_bodies_acts_on_the_sum_over_their_points():
    at = [np.asarray(x + s @ np.asarray(R).T) for x, R, s in zip(PLACES, TURNS, UNEVEN, strict=True)]
    total = sum(w @ (r @ [0.3, -0.2, -1.0]) for w, r in zip(NUMBERS, at, strict=True))
    assert float(jax.jit(FIELD)(PLACES, TURNS)) == pytest.approx(-total, rel=1e-14, abs=0)


def test_carlson_s_integrals_agree_with_scipy():
    """Beside scipy's, over six decades of each argument; observed 7e-16."""
    evaluate = jax.jit(carlson_rf_rd)
    for x, y, z in 10 ** np.random.default_rng(0).uniform(-3, 3, (50, 3)):
        known = elliprf(x, y, z), elliprd(y, z, x), elliprd(z, x, y), elliprd(x, y, z)
        np.testing.assert_allclose(evaluate(*map(jnp.asarray, (x, y, z))), known, rtol=3e-15)


@pytest.mark.slow
@pytest.mark.parametrize("place", [[3.0, 0.4, 0.5], [2.01, 0, 0], [0, 0, 0.71], [0.1, 0.1, 0.1], [100.0, 30, 20]])
def test_an_ellipsoid_attracts_by_dirichlet_s_integral(place):
    """By quadrature to its 1e-10; Laplace's and Poisson's equation to round-off."""
    Gamma, squares = np.array(place), np.array([4.0, 2.25, 0.49])
    inside = (Gamma**2 / squares).sum() < 1
    confocal = 0 if inside else brentq(lambda s: (Gamma**2 / (squares + s)).sum() - 1, 0, 1e6, xtol=1e-14, rtol=1e-15)

    def integrand(t):  # s = λ + (t/(1 − t))²
        at = squares + confocal + (t / (1 - t)) ** 2
        return (1 - (Gamma**2 / at).sum()) / np.sqrt(at.prod()) * 2 * t / (1 - t) ** 3

    known = -0.75 * 6 * quad(integrand, 0, 1, epsabs=0, epsrel=1e-11, limit=200)[0]
    value, hessian = jax.jit(lambda at: (ELLIPSOID.value(at), jax.jacfwd(jax.jacfwd(ELLIPSOID.value))(at)))(Gamma)
    assert float(value) == pytest.approx(known, rel=1e-9)
    density = 2 / (4 / 3 * np.pi * np.sqrt(squares.prod()))
    assert float(jnp.trace(hessian)) == pytest.approx(
        4 * np.pi * density * 3 if inside else 0, abs=1e-13 * float(jnp.abs(hessian).max())
    )


def test_a_distant_ellipsoid_attracts_by_maccullagh_s_formula():
    """Their difference, of the fourth order of size over distance, falls by 2⁵ from r to 2r."""
    a, along = np.array([2.0, 1.5, 0.7]), np.array([[0.0, 0, 0], [0.6, 0.48, 0.64]])
    inertias = np.array([2.0 / 5 * ((a**2).sum() - a**2), [0.4, 0.4, 0.4]])
    second = potentials.maccullagh(1.0, [2.0, 3.0], inertias)
    difference = jax.jit(lambda r: ELLIPSOID(r * along, TURNS[:2]) - second(r * along, TURNS[:2]))
    differences = [float(difference(r)) for r in (20.0, 40.0)]
    assert np.log2(differences[0] / differences[1]) == pytest.approx(5, abs=0.05)


@pytest.mark.long
def test_outer_fields_declare_the_momenta_that_they_conserve():
    """P across a uniform field and L about it; of two fields P across both; of a central one what is declared."""
    z, x = (potentials.uniform_field(g, np.ones(6)) for g in ([0.0, 0, -2], [1.0, 0, 0]))
    np.testing.assert_allclose(np.diag(z.symmetry), [1, 1, 0, 0, 0, 1], rtol=0, atol=1e-15)
    np.testing.assert_allclose((z + KINDS["masses"][0]).symmetry, z.symmetry, rtol=1e-15)
    np.testing.assert_allclose((z + x).symmetry, np.diag([0.0, 1, 0, 0, 0, 0]), rtol=0, atol=1e-14)
    central = potentials.outer_field(lambda r: -1 / jnp.sqrt(r @ r), np.ones(6), conserved=np.eye(6)[3:])
    np.testing.assert_allclose(central.symmetry, np.diag([0.0, 0, 0, 1, 1, 1]), rtol=0, atol=1e-15)
    assert (KINDS["masses"][0] + SPRINGS).symmetry is None
    assert not potentials.outer_field(lambda r: r[0] ** 4, np.ones(6)).symmetry.any()


TWO = [np.array([[0.2, 0, 0.1], [0, -0.3, 0]]), np.array([[0.1, 0.1, 0]])]
WEIGHTS = [np.array([0.7, 0.3]), np.array([2.0])]
HANGING = {
    "uniform": potentials.uniform_field([0.1, 0.0, -0.5], WEIGHTS, TWO),
    "central": potentials.outer_field(lambda r: 0.1 * (r @ r) + 0.02 * r[2], WEIGHTS, TWO, np.eye(6)[[5]]),
}


def test_momentum_shows_what_an_outer_field_leaves_and_zero_for_the_rest():
    bodies = systems.rigid_bodies([1.0, 2.0], np.ones((2, 3)), HANGING["central"])
    rng = np.random.default_rng(6)
    state = li.State(rng.normal(size=(2, 7)), rng.normal(size=(2, 6)))
    turning = np.cross(state.q[:, :3], state.p[:, :3]) + state.p[:, 3:]
    np.testing.assert_allclose(bodies.momentum(state), [0, 0, 0, 0, 0, turning[:, 2].sum()], rtol=0, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize(
    ("field", "scheme"),
    [("uniform", "splitting"), ("uniform", "bodies_energy_momentum"), ("central", "splitting")],
)
def test_two_bodies_and_a_spring_conserve_the_momenta_that_an_outer_field_leaves(field, scheme):
    """What is left of P and L is kept: 3e-15 at most was observed; and energy, by the scheme that keeps it, 2e-15."""
    both = HANGING[field] + potentials.springs([[0, 1]], [[[0.1, 0, 0], [0, 0.2, 0]]], 3.0, 1.0)
    bodies = systems.rigid_bodies([1.0, 2.0], [[0.3, 0.4, 0.5], [0.5, 0.6, 0.7]], both)
    state = bodies.state(PLACES[:2] / 2, velocities=PLACES[2:4] / 9, angular_velocities=PLACES[3:5] / 9)
    step = getattr(schemes, scheme)(bodies)
    path = li.Run.of(step, li.integrate(step, state, 0.02, 200, save_every=20))
    moved = jnp.abs(path.momentum_error()).max()
    assert float(moved) < 1e-14 * float(jnp.abs(path.state.p).max())
    assert float(jnp.abs(bodies.momentum(state)).max()) > 0.1
    H = jnp.abs(path.energy_error()).max()
    assert float(H) < (1e-3 if scheme == "splitting" else 1e-14)


@pytest.mark.parametrize("model", reference_numbers.numbers("water"))
def test_water_has_the_published_geometry_and_dipole(model):
    to_m, dipole, size, well = reference_numbers.numbers("water")[model]
    molecule = potentials.water(model)
    oxygen, *hydrogens, m = 10 * molecule.points
    for hydrogen in hydrogens:
        assert np.linalg.norm(hydrogen - oxygen) == pytest.approx(0.9572, abs=1e-12)
        assert np.linalg.norm(m - hydrogen) < np.linalg.norm(hydrogen - oxygen)  # M lies between them
    cosine = np.dot(hydrogens[0] - oxygen, hydrogens[1] - oxygen) / 0.9572**2
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(104.52, abs=1e-9)
    assert np.linalg.norm(m - oxygen) == pytest.approx(to_m, abs=1e-12)
    moment = 10 * molecule.charges @ molecule.points
    assert np.linalg.norm(moment) * 4.80320 == pytest.approx(dipole, abs=1e-3)  # 1 e Å = 4.80320 D
    assert (molecule.sizes[0] * 10, molecule.wells[0]) == pytest.approx((size, well), rel=1e-4)
    np.testing.assert_allclose(molecule.charges.sum(), 0, rtol=0, atol=1e-15)


def test_a_molecule_built_from_its_sites_has_its_moments_in_any_axes():
    """Water in other axes and from another origin: the same moments and distances."""
    water = potentials.water("TIP4P")
    masses = np.array([15.9994, 1.008, 1.008, 0.0])
    R = np.array(so3.to_matrix(so3.exp(jnp.array([0.3, -0.5, 0.8]))))
    other = potentials.molecule(masses, water.points @ R.T + [1, 2, 3], water.charges, water.wells, sizes=water.sizes)
    np.testing.assert_allclose(np.sort(other.inertia), np.sort(water.inertia), rtol=1e-13)
    products = (masses[:, None] * other.points).T @ other.points
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(masses @ other.points, 0, rtol=0, atol=1e-14)
    distances = [np.linalg.norm(x.points[:, None] - x.points, axis=2) for x in (water, other)]
    np.testing.assert_allclose(distances[0], distances[1], rtol=0, atol=1e-15)


@pytest.mark.long
def test_the_tip4p_dimer_has_the_published_energy():
    """Its energy least by minimization, −26.09 kJ/mol."""
    V = WATER.potential(2)

    def energy(z):
        R = jax.vmap(lambda a: so3.to_matrix(so3.exp(a)))(z[3:].reshape(2, 3))
        return V(jnp.stack([jnp.zeros(3), z[:3]]), R)

    slope = jax.jit(jax.value_and_grad(energy))
    start = np.array([0.05, 0.0, 0.27, 0.0, 0.9, 0.0, 0.0, 2.5, 1.5])
    found = [
        minimize(lambda z: tuple(map(np.asarray, slope(jnp.asarray(z)))), start + k * 0.3, jac=True, method="BFGS").fun
        for k in range(4)
    ]
    assert min(found) == pytest.approx(reference_numbers.numbers("tip4p_dimer")["energy, kJ/mol"], rel=3e-3)


def water_errors(num_steps, every):
    step = schemes.bodies_energy_momentum(DIMER)
    path = li.Run.of(step, li.integrate(step, NEAR, 1e-3, num_steps, save_every=every))
    assert path.info.converged.all()
    H = jnp.abs(path.energy_error()).max() / jax.vmap(DIMER.kinetic_energy)(path.state).min()
    moved = jnp.abs(path.momentum_error()).max(axis=0)
    x, p, spin = path.state.q[..., :3], path.state.p[..., :3], path.state.p[..., 3:]
    arm = jnp.maximum(jnp.abs(jnp.cross(x, p)).max(), jnp.abs(spin).max())
    return SimpleNamespace(H=H, P=moved[:3].max() / jnp.abs(p).max(), L=moved[3:].max() / arm)


@pytest.mark.long
def test_water_conserves_energy_and_both_momenta():
    """Two molecules, ten thousand steps of 1 fs; observed 2e-13, 3e-15 and 2e-14."""
    error = water_errors(10_000, 100)
    assert error.H < 5e-12
    assert error.P < 1e-14
    assert error.L < 3e-13


@pytest.mark.long
def test_gradients_by_the_numbers_of_a_potential_agree_with_differences():
    """Of a path and its energy, in masses, charges, wells, sizes, axes and the field."""
    V = potentials.point_masses(1.0, WEIGHTS, TWO, 0.1) + potentials.lennard_jones(WEIGHTS, WEIGHTS, TWO)
    V = V + potentials.ellipsoid_sphere(1.0, [0.7, 0.4], [1.3, 1.1, 1.0])
    V = V + potentials.uniform_field([1.0, 1.1, 1.3], WEIGHTS, TWO)
    bodies = systems.rigid_bodies([1.0, 2.0], [[0.3, 0.4, 0.5], [0.5, 0.6, 0.7]], V)
    slopes.assert_agree(schemes.splitting(bodies), bodies.state([[0.0, 0, 0], [3.0, 0.5, 0.2]]), 0.05)


@pytest.mark.long
def test_potentials_in_single_precision_stay_single():
    def f32(tree):
        return jax.tree.map(lambda a: a.astype(jnp.float32), tree)

    V = KINDS["charges"][0] + KINDS["Lennard-Jones"][0] + SPRINGS + FIELD
    single = f32(V)(*f32((PLACES, TURNS)))
    assert single.dtype == jnp.float32
    assert float(single) == pytest.approx(float(V(PLACES, TURNS)), rel=1e-5)
    near = f32(ELLIPSOID).value(jnp.array([2.1, 0.1, 0.2], jnp.float32))
    assert near.dtype == jnp.float32
    assert float(near) == pytest.approx(float(ELLIPSOID.value(jnp.array([2.1, 0.1, 0.2]))), rel=2e-6)
