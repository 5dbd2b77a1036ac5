"""Motions with given rates by Magnus integrators: order conditions word by word, closed forms, logs of gyros, scipy."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import slopes
from grid import examples_of
from scipy.spatial.transform import Rotation

import lieint_jax as li
from lieint_jax import groups, schemes, systems
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

STEPS = [(2, True), (4, True), (6, True), (4, False)]  # orders, and whether with commutators
EXAMPLES = examples_of("kinematics")


def made(system, order=4, commutators=True):
    return schemes.magnus(system, order, commutators=commutators)


@functools.partial(jax.jit, static_argnums=3)
def after(step, state, dt, num_steps):
    """The last configuration of a run, and whether all steps converged."""
    run = li.integrate(step, state, dt, num_steps, save_every=num_steps)
    return run.state.q[-1], run.info.converged.all()


# Order conditions: rates Σ aₖtᵏ with free letters aₖ of weight k + 1, and so series in words of weight up to 6 --------


def compositions(n):
    return [()] if n == 0 else [(k, *rest) for k in range(1, n + 1) for rest in compositions(n - k)]


WORDS = [word for n in range(7) for word in compositions(n)]  # a word is the tuple of the weights of its letters
PLACE = {word: k for k, word in enumerate(WORDS)}
SPLITS = np.array([(k, PLACE[word[:n]], PLACE[word[n:]]) for k, word in enumerate(WORDS) for n in range(len(word) + 1)])


class FreeGroup:
    """The group of series in words that begin with 1, truncated at weight 6: a plain `Group`."""

    dim, identity = len(WORDS) - 1, np.eye(len(WORDS))[0]

    def multiply(self, a, b):
        return jnp.zeros(len(WORDS)).at[SPLITS[:, 0]].add(a[SPLITS[:, 1]] * b[SPLITS[:, 2]])

    def ad(self, x, y):
        x, y = (jnp.concatenate([jnp.zeros(1), z]) for z in (x, y))
        return (self.multiply(x, y) - self.multiply(y, x))[1:]

    def exp(self, xi):
        x, value = jnp.concatenate([jnp.zeros(1), xi]), jnp.asarray(self.identity)
        for k in range(6, 0, -1):
            value = self.identity + self.multiply(x, value) / k
        return value

    def defect(self, q):
        return abs(q[0] - 1)


def letters(t):
    """Σ aₖtᵏ."""
    return jnp.zeros(FreeGroup.dim).at[np.array([PLACE[k,] - 1 for k in range(1, 7)])].set(t ** jnp.arange(6.0))


def iterated(word):
    """∫ t₁^k₁ … tₘ^kₘ over −½ < t₁ < … < tₘ < ½, as a fraction."""
    polynomial, half = [Fraction(1)], Fraction(1, 2)
    for weight in word:
        raised = [Fraction(0)] * weight + [c / (n + weight) for n, c in enumerate(polynomial)]
        polynomial = [-sum(c * (-half) ** n for n, c in enumerate(raised)), *raised[1:]]
    return sum(c * half**n for n, c in enumerate(polynomial))


@pytest.mark.quick
@pytest.mark.parametrize("frame", ["body", "space"])
def test_all_order_conditions_hold_and_none_beyond(frame):
    """The coefficient of each word is that of the solution up to the weight p; at p + 1 some are not."""
    system = systems.kinematics(FreeGroup(), letters, frame)
    exact = np.array([float(iterated(word if frame == "body" else word[::-1])) for word in WORDS])
    weights = np.array([sum(word) for word in WORDS])
    for order, commutators in STEPS:
        end, _ = made(system, order, commutators)(system.state(t=-0.5), 1.0)
        off = np.abs(end.q - exact)
        assert off[weights <= order].max() < 3e-17  # observed: 1e-17
        if order < 6:
            assert off[weights == order + 1].max() > 1e-4


def cone(t, half_angle=0.6):
    """The attitude of the example "coning": its axis moves on a cone."""
    c, s = np.cos(half_angle / 2), np.sin(half_angle / 2)
    return np.array([c, s * np.cos(t), s * np.sin(t), 0.0])


@pytest.mark.quick
def test_a_spin_in_a_rotating_field_flips_as_rabi_found():
    system, state, _ = EXAMPLES["spin"]
    along, across, frequency = system.rate.args[0]
    q, _ = after(made(system, 6), state, 0.1, 120)
    flip = float(q[0, 1] ** 2 + q[2, 1] ** 2)  # |⟨↑|U|↓⟩|² of the real form [[Re, −Im], [Im, Re]]
    total = np.hypot(across, along - frequency)
    assert flip == pytest.approx(float((across / total * np.sin(total * 12 / 2)) ** 2), abs=1e-9)
    assert flip > 0.7


def test_sculling_on_the_group_of_motions():
    """Rotations about x and a force along y in phase: v̇ = Rf is the translation of SE(3), and has a mean along z."""
    turn, w, force = 0.3, 2.0, 1.5
    rate = lambda t: jnp.zeros(6).at[0].set(turn * w * jnp.cos(w * t)).at[4].set(force * jnp.cos(w * t))  # noqa: E731
    system, t = systems.kinematics(groups.special_euclidean(3), rate), 3.0
    q, _ = after(made(system, 6), system.state(), t / 60, 60)
    angle = turn * np.sin(w * t)
    v = force / (w * turn) * np.array([0, np.sin(angle), 1 - np.cos(angle)])
    np.testing.assert_allclose(q[:3, 3], v, rtol=0, atol=1e-9)  # observed: 1e-10


@pytest.mark.parametrize("frame", ["body", "space"])
def test_a_motion_of_se3_is_that_of_scipy(frame):
    system = systems.kinematics(groups.special_euclidean(3), EXAMPLES["screw"][0].rate, frame)
    hats, v = np.asarray(system.group.basis), np.asarray(system.rate.args[0])

    def rate(t, q):
        q, omega = q.reshape(4, 4), np.tensordot(v * np.cos(t + np.arange(6)), hats, 1)
        return (q @ omega if frame == "body" else omega @ q).ravel()

    exact = scipy.integrate.solve_ivp(rate, (0, 4), np.eye(4).ravel(), "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    for order, commutators in STEPS:
        limit = {2: 1e-2, 4: 2e-6, 6: 1e-9}[order]
        assert error(made(system, order, commutators), system.state(), 4.0, 80, exact.reshape(4, 4)) < limit


@pytest.mark.quick
def test_a_constant_rate_is_exact_and_steps_back_undo_steps():
    omega = np.array([0.3, -0.8, 0.5])
    system = systems.kinematics(so3, lambda t: jnp.asarray(omega) + 0 * t)
    q, converged = after(made(system, 6), system.state(), 5.0, 1)
    assert converged
    np.testing.assert_allclose(q, so3.exp(5.0 * omega), rtol=0, atol=4e-16)
    for system, state, dt in EXAMPLES.values():
        for order, commutators in STEPS:
            step = made(system, order, commutators)
            back = step(step(state, 3 * dt)[0], -3 * dt)[0]
            np.testing.assert_allclose(back.q, state.q, rtol=0, atol=1e-15)


def test_the_configuration_stays_on_the_group():
    """Rounding does not add up where the group preserves a form; on SE(3) it does, as √n."""
    matrices = systems.kinematics(groups.special_orthogonal(3), EXAMPLES["coning"][0].rate, "space")
    cases = {"coning": (EXAMPLES["coning"][:2], 4e-16), "screw": (EXAMPLES["screw"][:2], 1e-12)}
    for (system, state), most in (*cases.values(), ((matrices, matrices.state()), 1e-15)):
        q, _ = after(made(system), state, 0.1, 100_000)
        assert abs(system.phase_space.defect(state._replace(q=q))) < most


def means(times):
    """The means of the rate of `cone` between times, in closed form."""
    angle = [np.sin(0.6) * np.cos(times), np.sin(0.6) * np.sin(times), -2 * np.sin(0.3) ** 2 * times]
    return np.diff(np.stack(angle, axis=1), axis=0) / np.diff(times)[:, None]


def error(step, state, span, num_steps, exact):
    q, converged = after(step, state, span / num_steps, num_steps)
    assert converged
    return float(np.abs(q - exact).max())


def of_means(n, order, uneven=0.0):
    """The error at t = 5 of n increments of `cone`, one a step."""
    times = np.linspace(0, 5, n + 1)
    times = times + uneven * np.sin(2 * np.pi * times / 5)
    rate = systems.sampled_rate(times, means(times), kind="mean")
    system = systems.kinematics(so3, rate)
    if not uneven:
        return error(made(system, order), system.state(cone(0.0)), 5.0, n, cone(5.0)), rate
    run = li.integrate(made(system, order), system.state(cone(0.0)), times=times)
    return float(np.abs(run.state.q[-1] - cone(5.0)).max()), rate


@pytest.mark.parametrize("uneven", [0.0, 0.3])
def test_increments_of_a_gyro_have_the_coning_correction_at_order_4(uneven):
    """Order 2 multiplies the rotations by the increments."""
    (coarse, _), (fine, rate) = of_means(40, 4, uneven), of_means(80, 4, uneven)
    assert np.log2(coarse / fine) == pytest.approx(4, abs=0.5)  # observed: 3.9, uneven 3.6
    assert fine < 1e-6
    if not uneven:
        assert of_means(80, 2)[0] > 100 * fine
        x = means(np.linspace(0, 5, 81)) * 5 / 80
        np.testing.assert_allclose(rate.mean(5 / 80 * 7, 5 / 80) * 5 / 80, x[7], rtol=0, atol=1e-16)
        u = np.sqrt(3) / 6  # the exponent of a step inside: Δθ − (Δθ₊ − Δθ₋) × Δθ/24
        a, b = (np.asarray(rate(5 / 80 * (7.5 + s * u))) * 5 / 80 for s in (-1, 1))
        theta = (a + b) / 2 - np.sqrt(3) / 12 * np.cross(b, a)
        np.testing.assert_allclose(theta, x[7] - np.cross(x[8] - x[6], x[7]) / 24, rtol=0, atol=1e-16)


def test_a_log_of_rates_is_linear_between_its_entries():
    rng = np.random.default_rng(0)
    times, rates = np.cumsum(rng.uniform(0.05, 0.2, 300)), 0.3 * rng.normal(size=(300, 3))
    log = systems.sampled_rate(times, rates)
    at = np.linspace(times[0], times[-1], 57)
    wanted = np.stack([np.interp(at, times, x) for x in rates.T], axis=1)
    np.testing.assert_allclose(jax.vmap(log)(at), wanted, rtol=0, atol=1e-14)
    system = systems.kinematics(so3, log)
    step, nodes = made(system, 6), [times, np.interp(np.arange(0, 299.25, 0.25), np.arange(300), times)]
    ends = [li.integrate(step, system.state(t=times[0]), times=t, save_at=t[-1:]).state.q[-1] for t in nodes]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-7)  # steps of one interval each, and of a quarter of it
    with pytest.raises(ValueError, match=r"the table has times from 0\.\d+ to \d+\.\d+, got t = 99"):
        log(99.0)
    end, info = jax.jit(lambda z: step(z, 0.1))(system.state(t=99.0))
    assert not info.converged
    assert np.isnan(end.q).all()


def test_means_of_parabolas_are_the_means_given():
    """Also where the intervals differ, by 8-point quadrature."""
    rng = np.random.default_rng(1)
    times, x = np.cumsum(rng.uniform(0.5, 2.0, 8)), rng.normal(size=(7, 2))
    log = systems.sampled_rate(times, x, kind="mean")
    nodes, weights = np.polynomial.legendre.leggauss(8)
    for k in range(7):
        t = times[k] + np.diff(times)[k] * (nodes + 1) / 2
        np.testing.assert_allclose(weights @ jax.vmap(log)(t) / 2, x[k], rtol=0, atol=1e-14)
    parabola = systems.sampled_rate(times, np.diff(times**3)[:, None] / np.diff(times)[:, None], kind="mean")
    np.testing.assert_allclose(jax.vmap(parabola)(times)[:, 0], 3 * times**2, rtol=1e-12)


@pytest.mark.quick
@pytest.mark.parametrize("name", ["coning", pytest.param("spin", marks=pytest.mark.long)])
def test_derivatives_by_the_parameters_of_the_rate(name):
    """Forward, reverse by undoing steps, and differences of fourth order."""
    system, state, dt = EXAMPLES[name]
    slopes.assert_agree(made(system), state, dt)


def test_machine_code_runs_it_with_a_long_log_too():
    pytest.importorskip("llvmlite")
    times = np.linspace(0, 60, 3001)
    log = systems.sampled_rate(times, np.stack([np.cos(times), np.sin(3 * times), 0.1 * times], axis=1))
    system = systems.kinematics(so3, log)
    step, state = made(system), system.state(t=1.0)
    [loop] = li.explain(lambda z: li.integrate(step, z, 0.02, 200, save_every=200), state).loops
    assert loop.engine == "native", loop.reason
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], 3, 0), state)._replace(t=np.asarray(state.t))
    run = li.run(step, states, 0.02, 200, save_every=200, progress=False)
    with li.engine("xla"):
        q, _ = jax.jit(lambda z: after(step, z, 0.02, 200))(state)
    np.testing.assert_allclose(run.state.q[-1], np.repeat(q[None], 3, 0), rtol=0, atol=1e-14)


def test_single_precision():
    system, state, _ = EXAMPLES["coning"]
    step, state = jax.tree.map(lambda x: np.asarray(x, np.float32), (made(system), state._replace(q=cone(0.3))))
    q, converged = after(step, state, np.float32(0.02), 250)
    assert converged
    assert q.dtype == np.float32
    np.testing.assert_allclose(q, cone(5.3), rtol=0, atol=4e-6)


def test_a_certificate_reports_the_constraint_and_reversibility_only():
    system, state, dt = EXAMPLES["coning"]
    text = str(li.diagnostics.certify(made(system), state, dt, 20))
    assert [line.split()[0] for line in text.splitlines()[2:]] == ["constraint", "reversibility", "residual", "order"]
    assert np.isnan(system.energy(state))
    with pytest.raises(ValueError, match="neither momenta nor a symplectic form"):
        li.diagnostics.symplectic_defect(made(system), state, dt)


def test_a_bias_of_a_gyro_is_found_from_star_trackers_with_its_covariance():
    times, bias = np.linspace(0, 5, 51), np.array([1e-2, -2e-2, 5e-3])
    log = means(times) + bias
    clean = systems.kinematics(so3, systems.sampled_rate(times, log - bias, "mean"))
    seen = np.arange(1.0, 6.0)
    measured = li.integrate(made(clean), clean.state(cone(0.0)), 0.1, save_at=seen).state.q[1:]

    rate = systems.sampled_rate(times, log, "mean")

    def motion(b):
        return made(systems.kinematics(so3, jax.tree_util.Partial(lambda b, t: rate(t) - b, b)))

    def residuals(b):
        q = li.integrate(motion(b), clean.state(cone(0.0)), 0.1, 50, save_at=seen).state.q[1:]
        return jax.vmap(lambda a, b: so3.log(so3.multiply(a, so3.inverse(b))))(q, measured) / 1e-3

    found = li.fit(residuals, jnp.zeros(3), progress=False)
    np.testing.assert_allclose(found.params, bias, rtol=0, atol=1e-9)
    moved = li.transition(motion, clean.state(cone(0.0)), 0.1, 50, parameters=jnp.asarray(bias))
    assert moved.matrix.shape == moved.by_parameters.shape == (3, 3)
    P = moved.covariance(1e-6 * np.eye(3), 1e-6 * np.eye(3))
    assert np.linalg.eigvalsh(P).min() > 1e-6


def test_runs_are_stored_and_extended_and_give_tables(tmp_path):
    """Their momenta are arrays of no entries."""
    system, state, dt = EXAMPLES["coning"]
    step, states = made(system), jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], 3, 0), state)
    li.run(step, states, dt, 20, save_every=5, progress=False, store=tmp_path / "run.zarr")
    run = li.open(tmp_path / "run.zarr").load().extend(10)
    assert run.state.p.shape == (7, 3, 0)
    assert float(np.abs(run.constraint_error()).max()) < 1e-15
    assert run.at([0.35, 0.9]).q.shape == (2, 3, 4)
    assert [x for x in run.to_dataframe().columns if x.startswith("p")] == []
    end, info = schemes.extrapolate(system)(state, dt)
    assert info.converged
    np.testing.assert_allclose(end.q, made(system, 6)(state, dt)[0].q, rtol=0, atol=1e-9)


@pytest.mark.quick
def test_an_attitude_of_any_form_starts_a_motion_with_a_given_rate():
    """As of a rigid body: printed digits are normalized with a warning, a rotation of scipy is accepted."""
    spin = systems.kinematics(so3, lambda t: jnp.stack([t, 0 * t, 0 * t]))
    rotation = Rotation.from_euler("z", 0.4)
    np.testing.assert_allclose(spin.state(rotation).q, np.roll(rotation.as_quat(), 1), rtol=0, atol=1e-15)
    with pytest.warns(RuntimeWarning, match="printed with few digits"):
        assert abs(np.linalg.norm(spin.state([0.98007, 0.0, 0.0, 0.19867]).q) - 1) < 1e-15


def test_what_has_no_energy_shows_none(tmp_path, monkeypatch, capsys, lieint):
    """Neither a table, nor a progress bar, nor `lieint info`, nor a picture."""
    times = np.linspace(0, 1, 11)
    system = systems.kinematics(so3, systems.sampled_rate(times, np.stack([times, 0 * times, 1 - times], axis=1)))
    states = jax.tree.map(lambda x: jnp.stack([x, x]), system.state())
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    run = li.run(made(system), states, 0.1, 10, store=tmp_path / "run.zarr").load()
    shown = capsys.readouterr().err
    assert "unconverged 0" in shown
    assert "energy" not in shown
    assert not [name for name in run.to_dataframe().columns if "energy" in name]
    assert "energy" not in run.to_xarray()
    found = lieint("plot", tmp_path / "run.zarr", "--force")
    assert "2 of 2 members converged at every step" in found
    assert "largest change" not in found
    lieint.drew("run-motion.png")
    assert not list(tmp_path.glob("run-errors.*"))
