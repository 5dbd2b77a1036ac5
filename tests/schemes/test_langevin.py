"""The thermostat: its random numbers, the heat, and what it samples, with standard errors of the statistics.

Each statistical bound is a number of standard errors, found from the means of independent members.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse, stats
from scipy.sparse.linalg import expm_multiply

import lieint_jax as li
from lieint_jax import diagnostics, potentials, schemes, systems
from lieint_jax._numerics import random_bits
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

J = np.array([1.0, 1.7, 2.2])
AXIS = np.array([0.48, 0.6, 0.64])
EXACT = 1 / np.tanh(2) - 0.5  # ⟨cos⟩ of V = −2 cos at kT = 1
TOP = systems.potential_top(J, lambda Gamma: -2 * (AXIS[0] * Gamma[0] + AXIS[1] * Gamma[1] + AXIS[2] * Gamma[2]))
RATES = [0.5, 0.7, 1.0]


def thermostat(metropolis=False, system=TOP):
    return schemes.langevin(system, 1.0, RATES, metropolis=metropolis)


def members(step, state, count, seed=0, first=0):
    return step.start(jax.tree.map(lambda x: jnp.repeat(x[None], count, axis=0), state), key=seed, first=first)


def run(step, states, dt, num_steps, save_every=None):
    found = li.run(step, states, dt, num_steps, save_every=save_every or num_steps, progress=False)
    assert found.info.converged.all()
    return found.state


BEGIN = TOP.state([1, 0, 0, 0], angular_velocity=[0.3, -0.2, 0.5])


def body_momenta(q, p):
    """Π of quaternions (…, 4) and momenta (…, 3)."""
    turn = jax.jit(jax.vmap(so3.Ad_star))
    return np.array(turn(q.reshape(-1, 4), p.reshape(-1, 3))).reshape(p.shape)


def test_random_bits_are_those_of_jax_random():
    for seed, n, j in ((0, 0, 0), (12345, 77, 5), (2**31, 2**32 - 1, 3)):
        key = jax.random.key(seed)
        digits = random_bits.digits(key, jnp.float32)
        assert digits.dtype == jnp.float32
        folded = random_bits.fold_in(random_bits.fold_in(random_bits.key_of(digits), jnp.uint32(n)), jnp.uint32(j))
        expected = jax.random.key_data(jax.random.fold_in(jax.random.fold_in(key, jnp.uint32(n)), jnp.uint32(j)))
        np.testing.assert_array_equal(jnp.stack(folded), expected)


@pytest.mark.quick
def test_normal_numbers_are_normal():
    """By Kolmogorov & Smirnov's test, and the moments to 4 standard errors."""
    key = random_bits.key_of(random_bits.digits(jax.random.key(5), jnp.float64))
    x = np.array(jax.jit(lambda: random_bits.normal(key, 0, 100_001, jnp.float64))())
    assert x.shape == (100_001,)
    assert stats.kstest(x, "norm").pvalue > 1e-3
    for power, mean, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs((x**power).mean() - mean) < 4 * np.sqrt(variance / x.size)
    assert abs(np.corrcoef(x[:50_000], x[50_001:])[0, 1]) < 4 / np.sqrt(50_000)


@pytest.mark.quick
def test_the_smallest_uniform_number_is_not_zero_and_the_largest_not_above_one():
    ends = jnp.array([0, 2**32 - 1], jnp.uint32)
    for dtype in (jnp.float32, jnp.float64):
        x = random_bits.fraction(ends, ends, dtype)
        assert float(x[0]) > 0
        assert float(x[1]) <= 1


def test_the_heat_of_free_bodies_is_the_change_of_their_energy():
    """There is nothing else that changes it: round-off of energies of a few kT in 200 steps."""
    body = systems.rigid_body(J)
    step = thermostat(system=body)
    path = jax.jit(lambda z: li.integrate(step, z, 1.5, 200))(step.start(body.state(angular_velocity=[0.1, 0.2, 0.3])))
    K = np.array(jax.vmap(body.energy)(path.state))
    less = K - path.state.extra["heat"]
    assert np.abs(less - less[0]).max() < 5e-14
    assert np.ptp(K) > 1


def test_runs_in_parts_resumed_and_of_some_members_have_the_same_bits():
    """By machine code: 300 members × 40 steps at once; in 17 and 23 steps; and the members from 123 on."""
    step = thermostat()
    whole = run(step, members(step, BEGIN, 300), 0.3, 40)
    half = run(step, members(step, BEGIN, 300), 0.3, 17)
    last = jax.tree.map(lambda x: x[-1], half)
    resumed = run(step, step.start(last), 0.3, 23)  # start leaves the key and the counts of a state that has them
    some = run(step, members(step, BEGIN, 177, first=123), 0.3, 40)
    for a, b, c in zip(*(jax.tree.leaves(x) for x in (whole, resumed, some)), strict=True):
        np.testing.assert_array_equal(a[-1], b[-1])
        np.testing.assert_array_equal(a[-1, 123:], c[-1])
    assert len(np.unique(whole.p[-1, :, 0])) == 300
    assert (whole.extra["step"][-1] == 40).all()


def test_machine_code_and_xla_see_the_same_noise():
    """After 20 steps, in which rounding differs; and split runs of `integrate` have the same bits."""
    step = thermostat()
    states = members(step, BEGIN, 3)
    native = run(step, states, 0.3, 20)
    one = jax.tree.map(lambda x: x[1], states)
    path, pair = jax.jit(lambda z: li.integrate(step, z, 0.3, 20))(one).state, []
    pair = jax.jit(lambda z: li.integrate(step, z, 0.3, 13))(jax.tree.map(lambda x: x[7], path)).state
    np.testing.assert_allclose(native.p[-1, 1], path.p[-1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(native.q[-1, 1], path.q[-1], rtol=0, atol=1e-13)
    for a, b in zip(jax.tree.leaves(path), jax.tree.leaves(pair), strict=True):
        np.testing.assert_array_equal(a[-1], b[-1])  # split runs of `integrate`, bit for bit


def test_a_step_back_is_flagged_and_refused():
    step = thermostat()
    state = step.start(BEGIN)
    advance = jax.jit(step)
    assert advance(state, 0.1)[1].converged
    assert not advance(state, -0.1)[1].converged
    with pytest.raises(ValueError, match="no step back"):
        step.check(state, -0.1)


def test_a_count_of_steps_that_a_number_does_not_hold_is_flagged():
    step = thermostat()
    state = step.start(BEGIN)
    for dtype, most in ((jnp.float32, 2**24), (jnp.float64, 2**32)):
        for count, good in ((most - 1, True), (most, False), (-1, False)):
            late = state._replace(extra=state.extra | {"step": jnp.asarray(count, dtype)})
            late, own = jax.tree.map(lambda x, dtype=dtype: x.astype(dtype), (late, step))
            assert bool(jax.jit(own)(late, jnp.asarray(0.1, dtype))[1].converged) is good


@pytest.mark.quick
def test_the_root_of_a_tensor_squares_to_it():
    root = np.random.default_rng(0).normal(size=(3, 3))
    tensor = jnp.array(root @ root.T + np.eye(3))
    L = np.array([schemes._shared.thermalized.root_times(tensor, e) for e in jnp.eye(3)]).T
    np.testing.assert_allclose(L @ L.T, tensor, rtol=1e-14)


def within(values, exact, errors=4.0):
    """Whether the mean of independent values (members, …) is within so many standard errors of the exact one."""
    values = np.asarray(values)
    return np.all(np.abs(values.mean(axis=0) - exact) < errors * values.std(axis=0) / np.sqrt(len(values)))


@pytest.mark.parametrize("full", [False, True], ids=["principal", "full"])
def test_free_bodies_are_sampled_exactly_at_any_step(full):
    """Δt = 3: ⟨Π_i²⟩ = kT J_i on each axis and attitudes without a preferred direction, by χ²."""
    body = systems.rigid_body(np.diag(J) if full else J)
    step = schemes.langevin(body, 1.0, 0.5 if full else RATES)
    end = run(step, members(step, body.state(angular_velocity=[0.1, 0.2, 0.3]), 8192), 3.0, 12)
    Pi = body_momenta(jnp.array(end.q[-1]), jnp.array(end.p[-1]))
    assert within(Pi**2 / J, 1)
    assert within(Pi[:, [0, 1, 2]] * Pi[:, [1, 2, 0]], 0)
    z = np.array(jax.vmap(so3.to_matrix)(jnp.array(end.q[-1])))[:, 2]  # each uniform in (−1, 1)
    for k in range(3):
        counts = np.histogram(z[:, k], 20, (-1, 1))[0]
        assert stats.chisquare(counts).pvalue > 1e-3


@functools.cache
def cosines(metropolis, dt, count, num_steps):
    """The mean of cos of each member, those of Π²/J, and the last cosines."""
    step = thermostat(metropolis)
    warm = run(step, members(step, BEGIN, count, seed=11), dt, round(20 / dt))
    path = run(step, jax.tree.map(lambda x: x[-1], warm), dt, num_steps, 1)
    q, p = (jnp.array(x[1:]) for x in (path.q, path.p))
    Gamma = np.array(jax.jit(jax.vmap(so3.to_matrix))(q.reshape(-1, 4)))[:, 2].reshape(*q.shape[:2], 3)
    cos = Gamma @ AXIS
    return cos.mean(axis=0), (body_momenta(q, p) ** 2 / J).mean(axis=0), cos[-1]


PUBLISHED = {  # ⟨cos⟩ − exact and its standard error, ⟨Π_i²/J_i⟩ at the end of a step: another program, no package
    (False, 0.8): (-0.0135, 0.0009, (0.872, 0.937, 0.954)),
    (False, 0.4): (-0.0037, 0.0008, (0.969, 0.984, 0.990)),
    (True, 0.8): (-0.0014, 0.0007, (1.004, 1.001, 0.999)),
    (True, 0.4): (-0.0002, 0.0008, (0.998, 1.001, 1.000)),
}


@pytest.mark.parametrize("case", PUBLISHED)
def test_a_body_in_a_field_is_sampled_as_an_independent_program_samples_it(case):
    """4096 members × 200 steps, within three standard errors of the difference; the Metropolised one of the exact."""
    bias, error, squares = PUBLISHED[case]
    cos, found, last = cosines(*case, 4096, 200)
    own = cos.std() / np.sqrt(cos.size)
    assert abs(cos.mean() - EXACT - bias) < 3 * np.hypot(own, error)
    np.testing.assert_allclose(found.mean(axis=0), squares, rtol=0, atol=3 * 0.002 * np.sqrt(2))
    if case[0]:
        assert abs(cos.mean() - EXACT) < 3 * own
        assert within(found, 1)
        edges = np.log(np.exp(-2) + np.linspace(0, 1, 21) * (np.exp(2) - np.exp(-2))) / 2  # of equal probability
        assert stats.chisquare(np.histogram(last, edges)[0]).pvalue > 1e-3


def test_the_bias_falls_as_the_square_of_the_step():
    """The biases of ⟨cos⟩ and ⟨Π²/J⟩ at steps 0.8 and 0.4 are 4 to 1, within three standard errors or a tenth."""
    (coarse, first, _), (fine, second, _) = (cosines(False, dt, 4096, 200) for dt in (0.8, 0.4))
    a, b = coarse.mean() - EXACT, fine.mean() - EXACT
    spread = np.hypot(coarse.std(), 4 * fine.std()) / np.sqrt(4096)
    assert abs(a - 4 * b) < 3 * spread
    assert abs(a) > 10 * coarse.std() / np.sqrt(4096)  # there is a bias to compare
    ratio = (1 - first.mean(axis=0)) / (1 - second.mean(axis=0))
    assert 3.5 < ratio[0] < 4.7  # observed 4.1, of the axis with the largest


@pytest.mark.parametrize("metropolis", [False, True])
def test_several_bodies_have_their_energy_on_every_axis_of_motion_and_rotation(metropolis):
    """Three bodies on springs, each axis with a rate of its own: ⟨p²/m⟩ and ⟨Π²/J⟩ are kT, 36 numbers.

    The bias of the plain scheme, 0.006 of the stiffest by that at twice the step, is a fifth of a standard error.
    """
    masses, moments, kT = np.array([1.0, 0.5, 0.3]), np.tile([0.1, 0.2, 0.25], (3, 1)), 0.5
    V = potentials.springs([[0, 1], [1, 2], [2, 0]], [[[0.1, 0, 0], [0, 0.1, 0.2]]] * 3, [3.0, 4.0, 5.0], 1.0)
    bodies = systems.rigid_bodies(masses, moments, V)
    step = schemes.langevin(bodies, kT, [0.5, 0.6, 0.7, 1.0, 1.5, 2.0], metropolis=metropolis)
    end = run(step, members(step, bodies.state([[0, 0, 0.0], [1, 0, 0], [0, 1, 0]]), 4096), 0.05, 200)
    q, p = jnp.array(end.q[-1]), jnp.array(end.p[-1])
    assert within(p[..., :3] ** 2 / (masses[:, None] * kT), 1, 4.5)
    assert within(body_momenta(q[..., 3:], p[..., 3:]) ** 2 / (moments * kT), 1, 4.5)


BOLTZMANN = 0.00831446261815324  # kJ/(mol K)


def droplet(number=5, pull=20.0):
    """Molecules of water, which springs between all centers hold together: a droplet this small would evaporate."""
    molecule, pairs = potentials.water(), np.stack(np.triu_indices(number, 1), axis=1)
    V = molecule.potential(number) + potentials.springs(pairs, np.zeros((len(pairs), 2, 3)), pull)
    bodies = systems.rigid_bodies(np.full(number, molecule.mass), np.tile(molecule.inertia, (number, 1)), V)
    return bodies, bodies.state(0.31 * np.argwhere(np.ones((2, 2, 2)))[:number])


def member_means(bodies, kT, path):
    """Of each member: p²/m and Π²/J in kT on three axes each, averaged over bodies and times, (members, 6); and V."""

    def measured(state):
        turned = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:]) ** 2 / bodies.inertias
        squares = jnp.concatenate([state.p[:, :3] ** 2 / bodies.masses[:, None], turned], axis=1)
        return jnp.mean(squares, axis=0) / kT, bodies.energy(state) - bodies.kinetic_energy(state)

    states = li.State(*(jnp.array(x[1:]) for x in (path.q, path.p)))
    return [np.array(x).mean(axis=0) for x in jax.jit(jax.vmap(jax.vmap(measured)))(states)]


def test_a_droplet_of_water_at_298_kelvin_has_the_averages_of_energy_conserving_runs():
    """512 droplets of 5 molecules, friction 10 per ps, steps of 1 fs: 8 ps to forget the start, then 4 ps.

    Every axis of motion and rotation must have 298 K within 4 standard errors. Observed: 1.006, 0.998 and 0.997 ±
    0.004; 0.996, 0.996 and 0.996 ± 0.003; V −118.0 ± 0.2 kJ/mol. From there the energy–momentum scheme conserves the
    energy of each droplet, to 4e-12 of 118, with a spread of 15 among them; if the thermostat had another measure, the
    averages would move. Observed over 4 ps: 1.02, 1.00, 1.02 ± 0.017; 1.003, 1.005, 1.005 ± 0.009; V higher by 0.3 ±
    0.4.
    """
    bodies, state = droplet()
    kT = BOLTZMANN * 298
    step, last = schemes.langevin(bodies, kT, 10.0), lambda path: jax.tree.map(lambda x: x[-1], path)
    path = run(step, members(step, state, 512, seed=298), 0.001, 4000, 20)
    for _ in range(2):
        path = run(step, last(path), 0.001, 4000, 20)
    squares, V = member_means(bodies, kT, path)
    alone = run(schemes.bodies_energy_momentum(bodies), last(path)._replace(extra=None), 0.002, 2000, 20)
    later, after = member_means(bodies, kT, alone)
    H = np.array(jax.jit(jax.vmap(jax.vmap(bodies.energy)))(li.State(*map(jnp.array, (alone.q, alone.p)))))
    assert within(squares, 1)
    assert within(later, 1)
    assert within(after - V, 0)
    assert np.abs(H - H[0]).max() < 1e-11 * np.abs(V.mean())


def decay(kT, inertia, rate, times, largest=14):
    """⟨u(0)·u(t)⟩ of a direction fixed in a spherical body, exactly: u̇ = ω × u with ω of Ornstein and Uhlenbeck.

    In Hermite functions h_n of ω/σ, σ² = kT/J: the generator is −γ|n|, and ω_k = σ(a_k + a_kᵀ).
    """
    levels = [(i, j, k) for i in range(largest) for j in range(largest - i) for k in range(largest - i - j)]
    number = {level: n for n, level in enumerate(levels)}
    generator = sparse.kron(sparse.diags([-rate * sum(level) for level in levels]), sparse.eye(3))
    for k, cross in enumerate(np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1)):
        raised = sparse.lil_matrix((len(levels), len(levels)))
        for level, n in number.items():
            above = tuple(x + (i == k) for i, x in enumerate(level))
            if above in number:
                raised[number[above], n] = np.sqrt(above[k])
        generator = generator + np.sqrt(kT / inertia) * sparse.kron(raised + raised.T, cross)
    start = np.zeros(3 * len(levels))
    start[0] = 1
    return np.array([expm_multiply(generator.tocsc() * t, start)[0] for t in times])


def test_the_attitude_of_a_free_rotor_decorrelates_at_the_rate_of_theory():
    """A spherical body, γ = 0.5, kT/J = 1: from the persistent to the diffusive regime, within 4 standard errors."""
    body = systems.rigid_body([2.0, 2.0, 2.0])
    step = schemes.langevin(body, 2.0, 0.5)
    warm = run(step, members(step, body.state(angular_velocity=[0.1, 0.2, 0.3]), 16384), 2.0, 20)
    path = run(step, jax.tree.map(lambda x: x[-1], warm), 0.05, 80, 20)
    R = np.array(jax.jit(jax.vmap(so3.to_matrix))(jnp.array(path.q).reshape(-1, 4))).reshape(5, -1, 3, 3)
    overlap = np.einsum("tmij,mij->tm", R, R[0]) / 3
    exact = decay(2.0, 2.0, 0.5, [1.0, 2.0, 3.0, 4.0])
    assert exact[0] == pytest.approx(decay(2.0, 2.0, 0.5, [1.0], 16)[0], abs=1e-6)  # the series has ended
    for k in range(4):
        assert within(overlap[k + 1], exact[k])
    Pi = body_momenta(jnp.array(path.q), jnp.array(path.p))
    for k, t in enumerate((1.0, 2.0, 3.0, 4.0)):
        assert within((Pi[k + 1] * Pi[0]).mean(axis=1) / 4, np.exp(-0.5 * t))


@pytest.mark.parametrize("metropolis", [False, True])
def test_the_certificate_of_a_random_step_measures_heat_order_and_bias(metropolis):
    step = thermostat(metropolis)
    found = diagnostics.certify(step, step.start(BEGIN), 0.2, 400)
    assert found.exact_heat
    assert found.step_order == pytest.approx(3, abs=0.3)
    assert abs(found.slope) < 5 * found.slope_error
    assert found.unbiased is metropolis
    assert found.symplectic_defect < 1e-14
    assert found.reversibility < 1e-14
    assert found.converged
    assert "exact to round-off" in str(found)
    assert ("exact for any dt" in str(found)) is metropolis
    assert (found.rejected > 0) is metropolis
