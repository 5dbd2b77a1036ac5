"""Laws of a satellite: drag and sunlight on plates, control of wheels and torquers, unloading of wheels."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slopes
from repeated import last
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import orbits, torques
from lieint_jax.groups import so3
from lieint_jax.schemes import torqued_midpoint
from lieint_jax.systems import torqued_body

pytestmark = pytest.mark.long

LOCKED = jnp.array([1.3, 1.7, 2.2])


@jax.tree_util.Partial
def ORBIT(t):
    """A circle: as a function, it compiles in a part of the time of Kepler's equation."""
    c, s, ci, si = jnp.cos(t), jnp.sin(t), 0.8, 0.6
    return jnp.stack([c, ci * s, si * s]), jnp.stack([-s, ci * c, si * c])


FRAME = orbits.lvlh(ORBIT)
FIELD = orbits.earth_field(ORBIT, 2460676.5, [0.1, 0.2, -0.9], 0.8, rate=0.06)
AIR = orbits.atmosphere(ORBIT, 0.3, 0.1, 0.1, radius=0.8, rate=0.06)
SUN = jnp.array([0.6, 0.8, 0.0])
LIGHT = orbits.eclipse(ORBIT, SUN, 0.8, angle=0.05)
PLATES = torques.box_plates([1.0, 0.5, 0.4], [0.05, -0.1, 0.08])
AXES, MOMENTS = torques.wheel_pyramid(), jnp.full(4, 0.05)
INERTIA = torques.body_inertia(LOCKED, AXES, MOMENTS)
Q, OMEGA = so3.normalize(jnp.array([0.8, -0.3, 0.4, 0.2])), jnp.array([0.5, -0.3, 0.6])
POINTING = torques.pointing(FRAME, 8.0, 6.0, INERTIA)  # stiffer than the gravity gradient, which destabilizes
HOLDING = torques.wheels(
    AXES, MOMENTS, torques.wheel_motor(AXES, POINTING, gyroscopic=True), speeds=[1.0, 2.0, -1.0, 3]
)
LAWS = {
    "gravity_gradient": torques.gravity_gradient(ORBIT, LOCKED, mu=1.0),
    "aerodynamic": torques.aerodynamic(AIR, *PLATES),
    "solar_plates": torques.solar_plates(*PLATES, SUN, light=LIGHT, specular=0.3, diffuse=0.2),
    "unloading": torques.unloading(AXES, 0.1, FIELD, 0.2),
    "torquers": torques.torquers(torques.viscous(0.05), FIELD, max_dipole=0.1),
    "sliding_mode": torques.sliding_mode(FRAME, INERTIA, 0.7, 0.05, layer=0.2),
    "wheels": HOLDING,
}


def start(law, **options):
    body = torqued_body(INERTIA, law)
    return body, body.state(Q, angular_velocity=OMEGA, work=0.0, **options)


@functools.partial(jax.jit, static_argnums=2)
def run(step, state, num_steps, dt=0.05):
    path = li.integrate(step, state, dt, num_steps)
    return path, jax.vmap(step.system.energy)(path.state)


@pytest.fixture(scope="module")
def seven():
    """Seven laws at once, 200 steps, each law's work booked."""
    body, state = start(torques.total(LAWS.values()), works=True)
    return body, run(torqued_midpoint(body), state, 200)


def test_laws_of_a_satellite_balance_to_round_off(seven):
    """Observed: 4e-15 of the energy in 200 steps. Each law does something."""
    body, (path, H) = seven
    assert bool(path.info.converged.all())
    W = path.state.extra["works"]
    assert np.abs(H - W.sum(axis=1) - H[0]).max() < 2e-14 * np.abs(H).max()
    assert (np.abs(np.diff(W, axis=0)).max(axis=0) > 1e-6).all()
    assert torqued_midpoint(body).symmetric


def test_works_are_named_by_their_laws(seven):
    body, (path, _) = seven
    data = li.Run.of(torqued_midpoint(body), path).to_xarray()
    assert data.extra_works.dims == ("time", "law")
    assert list(data.law.values) == list(LAWS)
    np.testing.assert_array_equal(data.extra_works.sel(law="aerodynamic"), path.state.extra["works"][:, 1])
    drag = lambda t, q, omega: -0.1 * omega  # noqa: E731
    named = torques.total([drag, torques.viscous(0.1), torques.viscous(0.2), torques.pd_trace(0.1, 0.1)])
    assert li.core.labels(torqued_body(INERTIA, named)) == ["function", "viscous", "viscous_2", "pd_trace"]


def test_works_in_a_store_are_named_by_their_laws(tmp_path):
    xarray = pytest.importorskip("xarray")
    body, state = start(torques.viscous(0.1) + torques.pd_trace(0.1, 0.1), works=True)
    states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    li.run(torqued_midpoint(body), states, 0.05, 4, save_every=2, store=tmp_path / "run.zarr")
    with xarray.open_zarr(tmp_path / "run.zarr") as data:
        assert list(data.law.values) == ["viscous", "pd_trace"]
        assert data.extra_works.dims == ("time", "member", "law")


def test_a_law_that_reads_the_wheels_may_stand_before_or_after_them():
    laws = [torques.unloading(AXES, 0.1, [0.3, 0.1, 1.0]), torques.wheels(AXES, MOMENTS, speeds=[1.0, 2.0, -1.0, 3])]
    ends = []
    for order in (laws, laws[::-1]):
        body, state = start(torques.total(order))
        ends.append(jax.jit(torqued_midpoint(body))(state, 0.05)[0])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-15), *ends)
    assert float(jnp.abs(ends[0].p - state.p).max()) > 1e-4


def numpy_plates(force_of):
    """Σ r × F over the plates, one by one."""
    return sum(np.cross(r, force_of(A, n, r)) for A, n, r in zip(*(np.asarray(x) for x in PLATES), strict=True))


def test_drag_and_sunlight_are_those_of_single_plates():
    t, R = jnp.asarray(0.7), np.asarray(so3.to_matrix(Q))
    density, v = AIR(t)
    v, s = R.T @ np.asarray(v), R.T @ np.asarray(SUN)

    def drag(A, n, r):
        w = v + np.cross(OMEGA, r)
        speed = np.linalg.norm(w)
        return -0.5 * float(density) * 2.2 * A * max(n @ w / speed, 0) * speed**2 * (w / speed)

    def push(A, n, r):
        c = max(n @ s, 0)
        return -A * c * (0.7 * s + 2 * (0.3 * c + 0.2 / 3) * n)

    law = torques.solar_plates(*PLATES, SUN, specular=0.3, diffuse=0.2)
    np.testing.assert_allclose(LAWS["aerodynamic"](t, Q, OMEGA), numpy_plates(drag), rtol=0, atol=1e-15)
    np.testing.assert_allclose(law(t, Q, OMEGA), numpy_plates(push), rtol=0, atol=1e-15)
    one = torques.solar_plate(0.5, [0.0, 0.6, 0.8], [0.3, -0.2, 0.1], SUN, specular=0.3, diffuse=0.2)
    both = torques.solar_plates(
        0.5, [[0.0, 0.6, 0.8], [0.0, -0.6, -0.8]], [[0.3, -0.2, 0.1]] * 2, SUN, specular=0.3, diffuse=0.2
    )
    np.testing.assert_allclose(both(t, Q, OMEGA), one(t, Q, OMEGA), rtol=0, atol=1e-16)
    dark = torques.solar_plates(*PLATES, SUN, light=lambda t: jnp.zeros_like(t))
    assert not np.any(dark(t, Q, OMEGA))


def test_air_at_rest_removes_energy_in_every_step():
    body, state = start(torques.aerodynamic(lambda t: (jnp.asarray(2.0), jnp.zeros(3)), *PLATES))
    path, H = run(torqued_midpoint(body), state, 100)
    assert (np.diff(path.state.work) < 0).all()
    np.testing.assert_allclose(H - path.state.work, H[0], rtol=1e-14)


def test_the_sliding_variable_falls_at_its_rate():
    """ṡ = −k sat(s/φ) along the exact motion, in and out of the boundary layer."""
    law = LAWS["sliding_mode"]
    body = torqued_body(INERTIA, law)

    def s(t, q, p):
        Omega = body.angular_velocity(li.State(q, p, t))
        error = law.target.error(t, q, Omega)
        return error.velocity + 0.7 * error.vector

    @jax.jit
    def both(state):
        rate = body.vector_field(state)
        now = (state.t, state.q, state.p)
        return jax.jvp(s, now, (jnp.ones(()), rate.q, rate.p))

    for scale in (1.0, 0.01):
        state = body.state(FRAME(0.3), angular_velocity=FRAME.angular_velocity(0.3) + scale * OMEGA, t=0.3)
        value, rate = both(state)
        np.testing.assert_allclose(rate, -0.05 * np.clip(value / 0.2, -1, 1), rtol=0, atol=1e-14)


@pytest.mark.quick
def test_a_pyramid_gives_the_torque_and_has_the_same_authority_everywhere():
    g = np.asarray(AXES)
    np.testing.assert_allclose(g.T @ g, 4 / 3 * np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(torques.allocation(AXES), np.linalg.pinv(g.T), rtol=0, atol=1e-15)
    control = torques.pd_trace(0.4, 0.3) + (lambda t, q, Omega: 0.1 * Omega)  # one in space, one in the body
    u = torques.wheel_motor(AXES, control)(jnp.zeros(()), Q, OMEGA, jnp.zeros(4))
    R = so3.to_matrix(Q)
    wanted = R.T @ torques.pd_trace(0.4, 0.3)(0.0, Q, R @ OMEGA) + 0.1 * OMEGA
    np.testing.assert_allclose(-g.T @ u, wanted, rtol=0, atol=1e-15)


@pytest.mark.quick
def test_torquers_exert_the_torque_across_the_field():
    control = lambda t, q, Omega: jnp.array([0.1, 0.2, -0.3])  # noqa: E731
    t, B = jnp.asarray(0.7), np.asarray(so3.Ad_star(Q, FIELD(0.7)))
    T, unit = np.array([0.1, 0.2, -0.3]), B / np.linalg.norm(B)
    found = torques.torquers(control, FIELD)(t, Q, OMEGA)
    np.testing.assert_allclose(found, T - unit * (unit @ T), rtol=0, atol=1e-15)
    cut = torques.torquers(control, FIELD, max_dipole=0.05)(t, Q, OMEGA)
    np.testing.assert_allclose(cut, np.cross(np.clip(np.cross(B, T) / (B @ B), -0.05, 0.05), B), rtol=0, atol=1e-15)
    assert not np.any(torques.torquers(control, [0.0, 0, 0])(t, Q, OMEGA))


def test_wheels_hold_a_satellite_to_its_frame_while_torquers_unload_them():
    """From an attitude far off; the wheels' momentum falls, the error too."""
    body = torqued_body(INERTIA, LAWS["gravity_gradient"] + torques.unloading(AXES, 0.3, FIELD) + HOLDING)
    state = body.state(Q, angular_velocity=OMEGA)
    path, _ = run(torqued_midpoint(body), state, 800)
    h = np.linalg.norm(path.state.extra["wheels"] @ AXES, axis=1)
    error = np.asarray(jax.vmap(lambda t, q: so3.multiply(so3.inverse(FRAME(t)), q)[1:])(path.t, path.state.q))
    assert h[-1] < 0.2 * h.max()
    assert np.linalg.norm(error[0]) > 0.3
    assert np.linalg.norm(error[-1]) < 0.02


def rhs(body, template):
    """The vector field as a function of a vector, for scipy."""

    @jax.jit
    def f(t, y):
        rate = body.vector_field(li.State(y[:4], y[4:7], t, None, {"wheels": y[7:]}))
        return jnp.concatenate([rate.q, rate.p, rate.extra["wheels"]])

    return f, lambda z: np.concatenate([z.q, z.p, z.extra["wheels"]])


@pytest.mark.parametrize("order", [2, 4, 6])
def test_orders_against_another_package_with_saturation_in_force(order):
    """One limit of torque acts all the time, no other ever does, and plates stay lit: switches have no order."""
    motor = torques.wheel_motor(AXES, torques.pointing(FRAME, 0.8, 1.2, INERTIA), gyroscopic=True)
    free = torques.wheels(AXES, MOMENTS, motor, max_torque=[0.05, 9, 9, 9], speeds=[1.0, 2.0, -1.0, 3])
    chosen = [LAWS["gravity_gradient"], torques.unloading(AXES, 0.1, FIELD, 9.0), free]
    still = torques.aerodynamic(AIR, 0.4, [[0.0, 0.6, 0.8]], [[0.05, -0.1, 0.08]])
    body = torqued_body(INERTIA, torques.total([*chosen, still]))
    state = body.state(Q, angular_velocity=OMEGA)
    step = li.schemes.compose(torqued_midpoint(body), order) if order > 2 else torqued_midpoint(body)
    f, flat = rhs(body, state)
    T = 0.6
    path = solve_ivp(lambda t, y: np.asarray(f(t, y)), (0, T), flat(state), "DOP853", rtol=1e-13, atol=1e-14)
    end = path.y[:, -1]
    final = jax.jit(lambda dt, n: li.integrate(step, state, dt, n, save_every=n).state, static_argnums=1)
    errors = [np.abs(flat(jax.tree.map(lambda x: x[-1], final(T / n, n))) - end).max() for n in (10, 20)]
    for t, y in zip(path.t, path.y.T, strict=True):
        z = li.State(y[:4], y[4:7], t, None, {"wheels": y[7:]})
        asked = np.abs(motor(t, z.q, body.angular_velocity(z), z.extra["wheels"]))
        assert asked[0] > 0.05  # the first motor is at its limit all the time, the others never
        assert asked[1:].max() < 9
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


def test_steps_back_undo_steps_and_derivatives_agree():
    """Few steps: over a long time a controller's motion backward is unstable."""
    still = torques.pointing([1.0, 0, 0, 0], 0.8, 1.2, INERTIA)
    wheels = torques.wheels(AXES, MOMENTS, torques.wheel_motor(AXES, still, gyroscopic=True), speeds=3.0)
    wind = lambda t: (jnp.asarray(0.5), jnp.array([0.9, 0.3, 0.2]))  # noqa: E731
    body, first = start(
        torques.aerodynamic(wind, *PLATES) + torques.unloading(AXES, 0.1, [0.3, 0.1, 1.0], 0.2) + wheels
    )
    step = torqued_midpoint(body)
    state, once = first, jax.jit(step)
    for dt in [0.05] * 10 + [-0.05] * 10:
        state, info = once(state, dt)
        assert info.converged
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), state, first)
    slopes.assert_agree(step, first, 0.05)


@pytest.mark.quick
def test_motors_that_look_at_the_momentum_are_solved_with_the_step():
    """dh/dt = −kh by the midpoint rule: h((1 − ½kΔt)/(1 + ½kΔt))ⁿ, for any k > 0; a step of kΔt < −2 has no branch."""
    law = torques.wheels(AXES[:1], 0.1, jax.tree_util.Partial(lambda k, t, q, Omega, h: -k * h, 0.5), speeds=10.0)
    state = start(law)[1]

    @jax.jit
    @jax.vmap
    def after_four_steps(k):
        motor = jax.tree_util.Partial(law.motor.func, k)
        body = torqued_body(INERTIA, dataclasses.replace(law, motor=motor))
        path = li.integrate(torqued_midpoint(body), state, 1.0, 4)
        return last(path), path.info.converged, body.energy(last(path)) - body.energy(state)

    k = np.array([0.5, 1.8, 3.0, 50.0, -2.1, -3.0])
    end, converged, gained = after_four_steps(jnp.asarray(k))
    h = end.extra["wheels"][:, 0]
    exact = float(state.extra["wheels"][0]) * ((1 - k / 2) / (1 + k / 2)) ** 4
    np.testing.assert_allclose(h[:3], exact[:3], rtol=0, atol=1e-15)  # observed: 1e-16
    np.testing.assert_allclose(h[3], exact[3], rtol=6e-14)  # observed: 1.5e-14; the mean of h cancels 25-fold
    np.testing.assert_allclose(gained[:4], end.work[:4], rtol=0, atol=3e-14)  # observed: 4e-15
    assert converged[:4].all()
    assert not converged[4:, 1:].any()


def test_directions_and_attitudes_from_functions_are_normalized():
    """They cannot be checked when a law is made."""
    t, pairs = jnp.array(0.3), []
    for length in (1.0, 2.0):
        plate = torques.solar_plate(0.5, [0.0, 0.6, 0.8], [0.3, -0.2, 0.1], lambda t, c=length: c * SUN)
        control = torques.pointing(lambda t, c=length: c * jnp.stack([jnp.cos(t), 0 * t, jnp.sin(t), 0 * t]), 8.0, 6.0)
        pairs.append([jax.jit(law)(t, Q, OMEGA) for law in (plate, control)])
    np.testing.assert_allclose(pairs[1], pairs[0], rtol=1e-14)


@pytest.mark.quick
def test_motors_with_a_window_act_in_it_only():
    """From its beginning until before its end; a window that stops before it starts is refused, and one without end."""
    always, law = (torques.wheel_motor(AXES, POINTING, window=window) for window in (None, (1.0, 3.0)))
    h = jnp.array([0.1, -0.2, 0.3, 0.0])
    for t, acts in ((0.5, False), (1.0, True), (2.9, True), (3.0, False)):
        expected = always(jnp.asarray(t), Q, OMEGA, h) if acts else jnp.zeros(4)
        np.testing.assert_array_equal(law(jnp.asarray(t), Q, OMEGA, h), expected)
    with pytest.raises(ValueError, match="must not stop before it starts"):
        torques.wheel_motor(AXES, POINTING, window=(2.0, 1.0))
    with pytest.raises(ValueError, match="must be two times, start and stop"):
        torques.wheel_motor(AXES, POINTING, window=2.0)
