"""The stored energy of a rod, its natural shape, its sections, and the statics and vibrations of its chain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import potentials, schemes, systems

RNG = np.random.default_rng(8)
STIFF = {"stretching": (50.0, 40.0, 90.0), "bending": (1.0, 1.3, 0.8)}
CURVED = (0.7, -0.4, 0.9)
ROUND = systems.circular_section(0.1, 2e3, 5.0, poisson=0.25)


@jax.jit
def energy_and_slopes(V, x, R):
    return jax.value_and_grad(lambda x, R: V(x, R), (0, 1))(x, R)


def rotations(vectors):
    return Rotation.from_rotvec(vectors).as_matrix()


def helix(curvature, lengths):
    """Poses of sections along a rod of constant curvature, by exponentials of 4 × 4 matrices in scipy."""
    x, R = [np.zeros(3)], [np.eye(3)]
    for ell in lengths:
        angle = np.linalg.norm(curvature) * ell
        K = np.cross(np.eye(3), np.asarray(curvature) * ell)  # the hat
        V = np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K
        x.append(x[-1] + R[-1] @ V @ [0, 0, ell])
        R.append(R[-1] @ Rotation.from_rotvec(np.asarray(curvature) * ell).as_matrix())
    return np.array(x), np.array(R)


def anyhow(n):
    """Poses of n sections in no special shape, each turned by less than 45° from the one before."""
    turns = 0.1 * np.cumsum(RNG.uniform(-1, 1, (n, 3)), axis=0)
    return np.cumsum(RNG.normal(size=(n, 3)), axis=0), rotations(turns)


@pytest.mark.parametrize("energy", ["fourth", "directors"])
def test_a_rod_rests_on_its_helix_and_not_on_the_opposite_one(energy):
    """V and its forces vanish on the exact helix to rounding, observed 1e-31 and 3e-14, and not with a wrong sign."""
    lengths = np.array([0.2, 0.35, 0.3, 0.25])
    V = potentials.rod(lengths, natural_curvature=CURVED, energy=energy, **STIFF)
    at = helix(CURVED, lengths)
    value, slopes = energy_and_slopes(V, *at)
    assert abs(value) < 1e-29
    assert abs(slopes[0]).max() < 1e-13
    assert abs(potentials.torques(at[1], slopes[1])).max() < 5e-14
    for signs in ((-1, -1, -1), (1, 1, -1), (-1, -1, 1)):
        assert not energy_and_slopes(V, *helix(np.multiply(signs, CURVED), lengths))[0] < 0.1  # or NaN, far from there


def test_the_natural_shape_is_the_helix_from_any_first_pose():
    lengths = np.array([0.2, 0.35, 0.3, 0.25])
    V = potentials.rod(lengths, natural_curvature=CURVED, **STIFF)
    turn, start = Rotation.from_rotvec([0.4, 1.0, -0.3]), np.array([1.0, 2.0, -3.0])
    found = V.natural_shape(jnp.concatenate([start, np.roll(turn.as_quat(), 1)]))
    x, R = helix(CURVED, lengths)
    np.testing.assert_allclose(found[:, :3], turn.apply(x) + start, rtol=0, atol=3e-15)
    np.testing.assert_allclose(
        jax.vmap(li.groups.so3.to_matrix)(found[:, 3:]), turn.as_matrix() @ R, rtol=0, atol=3e-15
    )


def test_the_natural_strain_of_a_circle_is_that_of_its_chords():
    """Γ₀ = sin θ/θ along the normal, of a chord 2 sin(θ/2)/κ and the mean of two directors, cos(θ/2) long."""
    V = potentials.rod([0.5], natural_curvature=(1.4, 0, 0), **STIFF)
    np.testing.assert_allclose(V.natural_strain, [[0, 0, np.sin(0.7) / 0.7]], rtol=0, atol=2e-16)


@jax.jit
def change(V, start, end):
    """V at both ends, and D·ΔI."""
    I0, I1 = V.invariants(*start), V.invariants(*end)
    work = [jnp.sum(d * (b - a)) for d, a, b in zip(V.discrete_gradient(I0, I1), I0, I1, strict=True)]
    return V(*start), V(*end), sum(work)


@pytest.mark.parametrize("energy", ["fourth", "directors"])
def test_the_energy_is_invariant_and_its_discrete_gradient_exact(energy):
    V = potentials.rod([0.4, 0.5, 0.6], natural_curvature=CURVED, energy=energy, **STIFF)
    start, end, Q = anyhow(4), anyhow(4), rotations([0.3, -1.2, 0.7])
    at_start, at_end, work = change(V, start, end)
    assert abs(at_end - at_start) > 1
    np.testing.assert_allclose(work, at_end - at_start, rtol=2e-14)  # observed 2e-15
    moved = change(V, (start[0] @ Q.T + 3.0, Q @ start[1]), end)[0]
    np.testing.assert_allclose(moved, at_start, rtol=1e-13)


@jax.jit
def force_and_slopes(V, x, R):
    return potentials.force(V, x, R), *energy_and_slopes(V, x, R)


@pytest.mark.parametrize("energy", ["fourth", "directors"])
def test_the_force_in_closed_form_is_the_derivative_of_the_energy(energy):
    """Of a rod, alone, with its first section held, and in a sum with springs: observed 2e-15 of the largest."""
    rod = potentials.rod([0.4, 0.5, 0.6], natural_curvature=CURVED, energy=energy, **STIFF)
    (x, R), pose = anyhow(4), np.array([0.3, -0.1, -0.2, 1.0, 0, 0, 0])
    bound = potentials.springs([(0, 3)], [[(0.1, 0.2, 0.0), (0.0, 0.3, 0.1)]], 7.0, 0.2)
    assert np.linalg.norm(Rotation.from_matrix(R[0]).as_rotvec()) < 0.2  # so the held section is in the domain
    for V, k in (
        (rod, 0),
        (potentials.held(rod, first=pose), 1),
        (rod + bound, 0),
        (potentials.held(rod + bound, pose), 1),
    ):
        force, value, slopes = force_and_slopes(V, x[k:], R[k:])
        assert np.isfinite(value)
        expected = np.concatenate([-slopes[0], potentials.torques(R[k:], slopes[1])], axis=1)
        np.testing.assert_allclose(force, expected, rtol=0, atol=1e-14 * abs(expected).max())
    beyond = R @ rotations(np.outer([0, 0, 1, 0], [2.0, 0, 0]))
    assert not np.isfinite(force_and_slopes(rod, x, beyond)[0][1:]).all()


def test_a_rod_made_inside_jit_is_undamped_unless_its_damping_is_traced():
    """So `splitting` and `nystrom` integrate it, and gradients by its stiffness need no detour."""

    def kind(bending, *damping):
        made = systems.rod(
            1.0, 2, systems.Section(1.0, (0.1, 0.1), STIFF["stretching"], bending), damping=damping or 0.0
        )
        kinds.append(type(made))
        return made.masses

    kinds = []
    jax.eval_shape(kind, jnp.ones(3))
    jax.eval_shape(kind, jnp.ones(3), *jnp.zeros(6))
    assert kinds == [systems.ElasticRod, systems.DissipativeRod]
    assert isinstance(jax.eval_shape(lambda length: systems.rod(length, 2, ROUND), 1.0), systems.ElasticRod)


@jax.jit
def bending_energy(V, R):
    return V.value((V.natural_strain, *V.invariants(jnp.zeros((2, 3)), R)[1:]))


@pytest.mark.parametrize(("energy", "order", "factor"), [("fourth", 4, 1 / 90), ("directors", 2, 1 / 3)])
def test_the_error_of_the_energy_of_a_curvature_has_its_order(energy, order, factor):
    """½ℓκ·C_κκ (1 − θ⁴/90) or (1 − θ²/3) about an axis of the section; of the same order about mixed axes."""
    C = np.array(STIFF["bending"])
    for axis in (np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.array([0.48, -0.6, 0.64])):
        errors = []
        for theta in (0.2, 0.1):
            V = potentials.rod([1.0], natural_curvature=0, energy=energy, **STIFF)
            bent = bending_energy(V, rotations([np.zeros(3), theta * axis]))
            errors.append(1 - float(bent) / (theta**2 * axis @ (C * axis) / 2))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.02)
        if axis.max() == 1:
            assert errors[1] == pytest.approx(factor * 0.1**order, rel=0.01)


def test_the_energy_is_linear_in_its_stiffness():
    """So its derivative by one stiffness is the energy of that one alone."""
    x, R = helix((0.3, 0.2, 0.4), [0.4, 0.6])

    def energy(C):
        return potentials.rod([0.4, 0.6], C[:3], C[3:], natural_curvature=CURVED)(x, R)

    C = jnp.array([*STIFF["stretching"], *STIFF["bending"]])
    found, alone = jax.jit(lambda C: (jax.grad(energy)(C), jax.vmap(energy)(jnp.eye(6))))(C)
    np.testing.assert_allclose(found, alone, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("energy", "limit", "scheme"),
    [
        ("fourth", np.arccos((2 - np.sqrt(6)) / 2), schemes.splitting),
        ("directors", np.pi / 4, schemes.bodies_energy_momentum),
    ],
)
def test_an_element_that_turns_to_where_its_energy_is_not_convex_is_flagged(energy, limit, scheme):
    """There the second derivative of V about an axis changes its sign; a state is refused, a step flagged."""
    V = potentials.rod([1.0], (50.0, 50, 50), (1.0, 1, 1), energy=energy)

    def bent(angle):
        turned = li.groups.so3.to_matrix(li.groups.so3.exp(jnp.stack([angle, 0 * angle, 0 * angle])))
        return bending_energy(V, jnp.stack([jnp.eye(3), turned]))

    angles = limit - jnp.array([1e-2, 1e-5, -1e-5])
    below, near, beyond = jax.jit(jax.vmap(lambda angle: jax.grad(jax.grad(bent))(angle) + 0 * bent(angle)))(angles)
    assert below > near > 0
    assert near < 1e-4
    assert np.isnan(beyond)
    chain = systems.rigid_bodies([1.0, 1.0], np.full((2, 3), 0.1), V)
    with pytest.raises(ValueError, match="turns by more than 103°"):
        chain.state([[0, 0, 0], [0, 0, 1.0]], rotations([[0.0, 0, 0], [limit + 0.01, 0, 0]]))
    near = chain.state(
        [[0, 0, 0], [0, 0, 1.0]],
        rotations([[0.0, 0, 0], [limit - 0.01, 0, 0]]),
        angular_velocities=[[0, 0, 0], [9.0, 0, 0]],
    )
    assert not jax.jit(scheme(chain))(near, 0.02)[1].converged


def test_a_sum_and_a_held_chain_have_the_domains_of_their_terms():
    V = potentials.rod([1.0], **STIFF)
    series = potentials.mutual_gravity(1.0, [li.shapes.box([1.0, 2.0, 3.0], mass=1.0)] * 2)
    both = V + (lambda x, R: x[0, 0]) + series
    assert both.domain == f"{V.domain}. {series.domain}"
    assert potentials.held(both, first=[0, 0, 0, 1, 0, 0, 0]).domain == both.domain
    assert (potentials.springs([[0, 1]], np.zeros((1, 2, 3)), 1.0) + (lambda x, R: x[0, 0])).domain == ""


def test_ends_that_are_held_cannot_be_held_again():
    V = potentials.rod([1.0, 1.0], **STIFF)
    once = potentials.held(V, first=[0, 0, 0, 1, 0, 0, 0])
    moving = potentials.held(V, first=lambda t: jnp.stack([t, 0 * t, 0 * t, 1 + 0 * t, 0 * t, 0 * t, 0 * t]))
    with pytest.raises(ValueError, match="needs a pose"):
        potentials.held(V)
    with pytest.raises(ValueError, match="depends on time"):
        moving(jnp.zeros((2, 3)), jnp.stack([jnp.eye(3)] * 2))
    with pytest.raises(ValueError, match="are held already"):
        potentials.held(moving, last=[0, 0, 2, 1, 0, 0, 0])
    with pytest.raises(ValueError, match="before ends are held"):
        moving + potentials.uniform_field([0, 0, -1.0], [1.0, 1.0])
    assert once.count == 2
    assert once.chain


def test_sections_have_the_numbers_of_textbooks():
    """The torsion constant of a square is 0.140577 a⁴, that of a strip nearly wh³/3; a circle's is πr⁴/2."""
    G = 2e3 / 2.5
    np.testing.assert_allclose(ROUND.mass, 5 * np.pi * 0.01, rtol=1e-15)
    np.testing.assert_allclose(ROUND.bending, [2e3 * np.pi * 1e-4 / 4] * 2 + [G * np.pi * 1e-4 / 2], rtol=1e-15)
    np.testing.assert_allclose(ROUND.stretching, [G * np.pi * 0.01 * 7.5 / 8.5] * 2 + [2e3 * np.pi * 0.01], rtol=1e-15)
    square, strip = (systems.rectangular_section(w, h, 2e3, 5.0, poisson=0.25) for w, h in ((0.1, 0.1), (2.0, 0.02)))
    np.testing.assert_allclose(square.bending[2], G * 0.140577e-4, rtol=2e-6)
    np.testing.assert_allclose(strip.bending[2], G * 2.0 * 0.02**3 / 3 * (1 - 0.63025 * 0.01), rtol=1e-6)
    np.testing.assert_allclose(strip.bending[:2], [2e3 * 2.0 * 0.02**3 / 12, 2e3 * 8.0 * 0.02 / 12], rtol=1e-15)
    np.testing.assert_allclose(square.inertia, [5 * 1e-4 / 12] * 2, rtol=1e-15)


def test_the_sections_of_a_rod_share_its_mass_and_its_inertia():
    free = systems.rod([0.1, 0.3], 2, ROUND)
    np.testing.assert_allclose(free.masses, np.array([0.05, 0.2, 0.15]) * ROUND.mass, rtol=1e-15)
    np.testing.assert_allclose(free.inertias[0], 0.05 * np.array([*ROUND.inertia, np.sum(ROUND.inertia)]), rtol=1e-15)
    foot = [1.0, 0, 0, np.cos(0.5), 0, np.sin(0.5), 0]
    held = systems.rod([0.1, 0.3], 2, ROUND, ends=(foot, "free"))
    np.testing.assert_allclose(held.masses, free.masses[1:], rtol=1e-15)
    np.testing.assert_allclose(held.state().q[-1, :3], [1 + 0.4 * np.sin(1.0), 0, 0.4 * np.cos(1.0)], rtol=1e-15)


@jax.jit
def slope_and_stiffness(V, x, R):
    """The first and second derivatives of V by displacements and rotations."""

    def energy(delta):
        dx, turn = delta.reshape(2, -1, 3)
        hat = jnp.cross(jnp.eye(3)[None], turn[:, None])
        return V(x + dx, R + hat @ R + hat @ hat @ R / 2)

    zero = jnp.zeros(2 * x.size)
    return jax.grad(energy)(zero), jax.hessian(energy)(zero)


@jax.jit
def improved(V, x, R, load):
    """A Newton step to where the forces of V and a load (N, 6), a moment about a constant axis, vanish."""

    slope, stiffness = slope_and_stiffness(V, x, R)
    loads = jnp.concatenate([load[:, :3].ravel(), load[:, 3:].ravel()])
    dx, turn = jnp.linalg.solve(stiffness, loads - slope).reshape(2, -1, 3)
    turned = jax.vmap(li.groups.so3.exp)(turn)
    return x + dx, jax.vmap(li.groups.so3.to_matrix)(turned) @ R, jnp.abs(dx).max() + jnp.abs(turn).max()


def equilibrium(V, x, R, load=None):
    load = jnp.zeros((len(x), 6)) if load is None else jnp.asarray(load)
    for _ in range(40):
        x, R, change = improved(V, x, R, load)
        if change < 1e-11:
            return np.asarray(x), np.asarray(R)
    raise AssertionError(f"no equilibrium: {change}")


@pytest.mark.slow
@pytest.mark.parametrize(("n", "apart", "turn"), [(8, 0.032, 0.0126), (16, 0.0081, 7.9e-4), (32, 0.00205, 5e-5)])
def test_a_cantilever_is_rolled_up_into_a_circle_by_a_moment_at_its_end(n, apart, turn):
    """M = 2πEI/L: positions are those of the circle to O(ℓ²), the whole turn to O(ℓ⁴), as both bounds are observed."""
    cantilever = systems.rod(
        1.0, n, systems.Section(1.0, (0.01, 0.01), (100.0,) * 3, (1.0,) * 3), ends=("clamped", "free")
    )
    angle = 2 * np.pi * np.arange(1, n + 1) / n
    circle = np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=1) / (2 * np.pi)
    load = np.zeros((n, 6))
    load[-1, 4] = 2 * np.pi
    x, R = equilibrium(cantilever.potential, circle, rotations(angle[:, None] * [0, 1, 0]), load)
    assert 0.9 * apart < abs(x - circle).max() < apart
    assert 0.9 * turn < np.arctan2(R[-1, 0, 2], R[-1, 0, 0]) / (2 * np.pi) < turn


def slopes(EI, GA, mass, inertia, omega):
    """Of (w, φ, M, Q) along a beam: w′ = φ + Q/GA, φ′ = M/EI, M′ = −Q − ρIω²φ, Q′ = −ρAω²w."""
    square = omega**2
    return np.array([[0, 1, 0, 1 / GA], [0, 0, 1 / EI, 0], [0, -inertia * square, 0, -1], [-mass * square, 0, 0, 0]])


def timoshenko(EI, GA, mass, inertia, count):
    """The angular frequencies of a cantilever of length 1 by the exact matrix exponential along it, a root search."""

    def clamped(omega):
        return np.linalg.det(expm(slopes(EI, GA, mass, inertia, omega))[2:, 2:])

    grid = np.linspace(0.5, 150, 3000)
    signs = np.sign([clamped(w) for w in grid])
    return [brentq(clamped, grid[i], grid[i + 1]) for i in np.flatnonzero(np.diff(signs))[:count]]


@pytest.mark.long
@pytest.mark.parametrize("n", [16, 32])
def test_the_frequencies_of_a_cantilever_are_those_of_timoshenko(n):
    """To O(ℓ²): the first three about both axes are off by 0.076/n² to 0.303/n², the lowest by 0.261/n²."""
    mass, inertia, GA, EI = 1.0, (4e-4, 6e-4), (400.0, 500.0), (1.0, 1.5)
    section = systems.Section(mass, inertia, (*GA, 900.0), (*EI, 0.8))
    cantilever = systems.rod(1.0, n, section, ends=("clamped", "free"))
    q = cantilever.state().q
    _, stiffness = slope_and_stiffness(cantilever.potential, q[:, :3], jnp.stack([jnp.eye(3)] * n))
    inertias = np.concatenate([np.repeat(cantilever.masses, 3), np.ravel(cantilever.inertias)])
    found = np.sqrt(np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(inertias, inertias))))
    for axis in (0, 1):  # about the first axis, the rod moves along the second
        for k, expected in enumerate(timoshenko(EI[axis], GA[1 - axis], mass, inertia[axis], 3)):
            error = n**2 * min(abs(found / expected - 1))
            assert error < 0.31
            assert k > 0 or error == pytest.approx(0.261, abs=0.003)


@pytest.mark.long
def test_a_cantilever_vibrates_in_the_lowest_mode_of_timoshenko():
    """Over a period, against sin ωt times the mode: off by 1.62 to 1.63/n², from the frequency's 0.261/n²."""
    mass, inertia, GA, EI, size = 1.0, 6e-4, 400.0, 1.5, 1e-4
    section = systems.Section(mass, (4e-4, inertia), (GA, 500.0, 900.0), (1.0, EI, 0.8))
    [omega] = timoshenko(EI, GA, mass, inertia, 1)
    A, off = slopes(EI, GA, mass, inertia, omega), []
    free = np.array([1, -np.divide(*expm(A)[2, 2:])])  # M and Q at the foot by which M = Q = 0 at the tip
    for n in (8, 16, 32):
        w, turn = np.array([(expm(A * s) @ [0, 0, *free])[:2] for s in np.arange(1, n + 1) / n]).T * size
        w, turn = w / w[-1] * size, turn / w[-1] * size
        cantilever = systems.rod(1.0, n, section, ends=("clamped", "free"))
        zero, period, steps = 0 * w, 2 * np.pi / omega, 48 * n
        start = cantilever.state(
            velocities=np.stack([w, zero, zero], axis=1), angular_velocities=np.stack([zero, turn, zero], axis=1)
        )
        path = li.integrate(schemes.nystrom(cantilever, 4), start, period / steps, steps, save_every=steps // 16)
        expected = size / omega * np.sin(omega * np.asarray(path.t))
        off.append(n**2 * abs(path.state.q[:, -1, 0] - expected).max() / (size / omega))
    assert off[-1] == pytest.approx(2 * np.pi * 0.261, rel=0.02)


def test_the_directors_along_a_static_rod_move_as_a_top_in_time():
    """Kirchhoff's analogy: C_κ is the inertia of the top, s its time, the force its weight.

    It is exact with one stiffness K against shear and extension, whose strain is along the force. Along the motion of
    the top, by scipy, the forces on the sections vanish to O(ℓ²) per unit of length.
    """
    bending, force, span, K = np.array([1.0, 1.4, 0.8]), np.array([0.6, -0.3, 2.0]), 2.0, 100.0
    spin = np.array([1.1, 0.4, 2.0])

    def rate(_, y):
        R, kappa = Rotation.from_quat(y[3:7]), y[7:]
        m = bending * kappa
        q_dot = 0.5 * np.array([*(y[6] * kappa + np.cross(y[3:6], kappa)), -y[3:6] @ kappa])
        m_dot = np.cross(m, kappa) - np.cross([0, 0, 1], R.inv().apply(force))
        return np.concatenate([R.apply([0, 0, 1.0]) + force / K, q_dot, m_dot / bending])

    start = np.concatenate([np.zeros(3), [0, 0, 0, 1.0], spin])
    sections = systems.Section(1.0, (1.0, 1.0), (K,) * 3, bending)
    left = []
    for n in (32, 64):
        s = np.linspace(0, span, n + 1)
        top = solve_ivp(rate, (0, span), start, "DOP853", s, rtol=1e-12, atol=1e-13).y.T
        q = np.concatenate([top[:, :3], np.roll(top[:, 3:7], 1, axis=1)], axis=1)
        strut = systems.rod(span, n, sections, ends=(q[0], q[-1]))
        left.append(abs(forces(strut, jnp.array(q[1:-1]))).max(axis=0) * n / span)  # per unit of length
    assert left[0].max() < 0.6
    assert (np.log2(left[0] / left[1]) > 1.88).all()  # observed 1.89 to 2.00: of the largest along the rod


@jax.jit
def forces(system, q):
    return system.force(q)
