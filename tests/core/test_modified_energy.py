"""The modified energy of splittings: its brackets against nested gradients, and its orders along runs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics, schemes, systems
from lieint_jax.diagnostics import _modified_energy
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

J = [1.0, 1.7, 2.2]
TOP = systems.potential_top(J, lambda G: 0.6 * G[0] + 0.5 * jnp.sin(G[1]) + 0.4 * G[2] ** 2 * G[0])
START = TOP.state(so3.exp(jnp.array([0.7, 0.5, -0.2])), angular_velocity=[0.4, 0.6, -0.3])
SATELLITE = systems.gravity_gradient(J, li.orbits.kepler(1.0, 1.0, 0.1))
TILTED = SATELLITE.state(so3.exp(jnp.array([0.2, -0.1, 0.4])), angular_velocity=[0.2, 0.3, 1.0], t=0.7, work=0.0)
CIRCLE = systems.driven_top(
    J,
    lambda G, t: 1.5 * jnp.sum(jnp.asarray(J) * G * G),
    lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), jnp.zeros_like(t)]),
)
WHEEL = systems.gyrostat(J, [0.2, -0.3, 0.4])
STEPS = {
    "top": (schemes.splitting(TOP, schemes.exact(TOP.free)), START),
    "satellite": (schemes.splitting(SATELLITE, schemes.exact(SATELLITE.free)), TILTED),
    "satellite on a circle": (schemes.splitting(CIRCLE, schemes.exact(CIRCLE.free)), TILTED),
    "gyrostat": (schemes.splitting(WHEEL), WHEEL.state(angular_velocity=[0.4, 0.6, -0.3])),
    "top, midpoint": (schemes.splitting(TOP), START),
    "satellite, midpoint": (schemes.splitting(SATELLITE), TILTED),
}


def drift_first(step):
    return schemes._splitting.Splitting(step.system, step.drift, kick_first=False)


STEPS["top, drift first"] = (drift_first(STEPS["top"][0]), START)
STEPS["top, midpoint first"] = (drift_first(STEPS["top, midpoint"][0]), START)


@functools.partial(jax.jit, static_argnums=3)
def energies(step, states, dt, order):
    return jax.vmap(lambda z: diagnostics.modified_energy(step, z, dt, order))(states)


def variation(step, state, dt, order):
    """The largest change of the modified energy over a run to t = 12."""
    run = li.integrate(step, state, dt, round(12 / dt))
    values = energies(step, jax.tree.map(jnp.asarray, run.state), dt, order)
    return float(jnp.max(jnp.abs(values - values[0])))


@pytest.mark.parametrize("name", STEPS)
def test_the_modified_energy_of_order_4_varies_as_the_fourth_power_of_dt(name):
    """From Δt = 0.2 to 0.05: observed orders 3.95 to 4.05, and 1.95 to 2.05 without the term."""
    step, state = STEPS[name]
    sizes = (0.2, 0.05)
    coarse, fine = (variation(step, state, dt, 4) for dt in sizes)
    assert np.log(coarse / fine) / np.log(4) == pytest.approx(4, abs=0.15)
    run = li.integrate(step, state, sizes[1], round(12 / sizes[1]))
    plain = float(jnp.max(jnp.abs(li.Run.of(step, run).energy_error())))
    assert fine < 0.05 * plain


@pytest.mark.parametrize("name", ["top", "satellite on a circle", "gyrostat", "top, drift first"])
def test_the_modified_energy_of_order_6_varies_as_the_sixth_power_of_dt(name):
    """From Δt = 0.2 to 0.1."""
    step, state = STEPS[name]
    coarse, fine = (variation(step, state, dt, 6) for dt in (0.2, 0.1))
    assert np.log2(coarse / fine) == pytest.approx(6, abs=0.25)


def test_a_wrong_share_of_the_error_of_the_drift_stays_at_order_2():
    """Two halves of a drift have a quarter of its T₂, not all of it."""
    step, state = STEPS["top, midpoint first"]
    right = variation(step, state, 0.1, 4)
    whole = lambda z, dt: dt**2 * 0.75 * _modified_energy._midpoint_error(TOP.inertia, z.q, z.p)  # noqa: E731
    run = li.integrate(step, state, 0.1, 120)
    states = jax.tree.map(jnp.asarray, run.state)
    values = energies(step, states, 0.1, 4) + jax.vmap(lambda z: whole(z, 0.1))(states)
    assert float(jnp.max(jnp.abs(values - values[0]))) > 20 * right


def test_the_brackets_are_those_of_nested_gradients():
    """{f, g} = −df ω⁻¹ dg on T*SO(3), by `perturb`, for H₂; and the closed form for tops. Observed 1e-15."""
    space = TOP.phase_space

    def bracket(f, g):
        def value(z):
            zero = jnp.zeros(6)
            df, dg = (jax.grad(lambda d, h=h: h(space.perturb(z, d)))(zero) for h in (f, g))
            return -df @ jnp.linalg.solve(space.omega(z), dg)

        return value

    T, V = TOP.free.energy, lambda z: TOP.potential_energy(z.q)
    expected = bracket(T, bracket(T, V))(START) / 12 - bracket(V, bracket(V, T))(START) / 24
    found = diagnostics.modified_energy(STEPS["top"][0], START, 1.0) - TOP.energy(START)
    assert float(found) == pytest.approx(float(expected), rel=3e-14, abs=0)
    Gamma, Pi, Omega = TOP.Gamma(START), TOP.body_momentum(START), TOP.angular_velocity(START)
    slope, bend = jax.grad(TOP.potential)(Gamma), jax.hessian(TOP.potential)(Gamma)
    N, moving = jnp.cross(Gamma, slope), jnp.cross(Gamma, Omega)
    inner = -N @ (jnp.cross(Pi, Omega) / TOP.inertia)
    inner = inner - Omega @ (jnp.cross(moving, slope) + jnp.cross(Gamma, bend @ moving))
    closed = inner / 12 - N @ (N / TOP.inertia) / 24
    assert float(found) == pytest.approx(float(closed), rel=3e-14, abs=0)


@pytest.mark.quick
def test_the_coefficients_are_those_of_a_product_of_exponentials():
    """log(e^{hA/2} e^{hB} e^{hA/2}) of matrices, by nested commutators to h⁵: the rest falls as h⁷."""
    random = np.random.default_rng(0)
    A, B = (jnp.asarray(random.normal(size=(4, 4))) / 2 for _ in range(2))

    def nested(word):
        C = A @ B - B @ A
        for letter in reversed(word):
            M = A if letter == "X" else B
            C = M @ C - C @ M
        return C

    def rest(h):
        expm = jax.scipy.linalg.expm
        terms = h * (A + B) + sum(h**3 * c * nested(w) for w, c in _modified_energy._H2.items())
        terms = terms + sum(h**5 * c * nested(w) for w, c in _modified_energy._H4.items())
        return float(jnp.abs(expm(h * A / 2) @ expm(h * B) @ expm(h * A / 2) - expm(terms)).max())

    assert np.log2(rest(0.2) / rest(0.1)) == pytest.approx(7, abs=0.1)


def test_the_modified_energy_of_two_bodies_has_its_order():
    masses, inertias = [1.0, 0.5], jnp.array([[0.10, 0.11, 0.12], [0.030, 0.034, 0.040]])
    bodies = systems.rigid_bodies(masses, inertias, li.potentials.maccullagh(1.0, masses, inertias))
    x, v = jnp.array([[-1.0, 0, 0], [2.0, 0, 0]]), jnp.array([[0.0, -0.24, -0.01], [0.0, 0.48, 0.02]])
    state = bodies.state(x, velocities=v, angular_velocities=[[0.1, 0, 1.2], [0, 0.02, 0.24]])
    step = schemes.splitting(bodies)
    coarse, fine = (variation(step, state, dt, 4) for dt in (0.1, 0.05))
    assert np.log2(coarse / fine) == pytest.approx(4, abs=0.2)
