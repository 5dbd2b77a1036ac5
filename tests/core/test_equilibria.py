"""Relative equilibria and their modes, against closed forms of satellites, tops, wheels and binaries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

CIRCLE = li.orbits.kepler(1.0, 1.0, 0.0)


def satellite_modes(J):
    """The three frequencies, and whether they are real, of J = (radial, along track, normal), mean motion 1.

    Hughes 1986, Spacecraft Attitude Dynamics, 9.2: pitch² = 3(B − A)/C, and s⁴ + (1 + 3k₁ + k₁k₃)s² + 4k₁k₃ = 0 with
    k₁ = (C − A)/B and k₃ = (C − B)/A.
    """
    A, B, C = J
    k1, k3 = (C - A) / B, (C - B) / A
    b, c = 1 + 3 * k1 + k1 * k3, 4 * k1 * k3
    squares = np.array([3 * (B - A) / C, *np.roots([1, -b, c])], complex)
    stable = bool(np.all(squares.real > 0) and np.all(squares.imag == 0))
    return np.sort(np.sqrt(squares).real), stable, B > A and k1 > 0 and k3 > 0 and C > B


def test_a_satellite_in_the_regions_of_debra_and_delp():
    """48 inertias: frequencies, verdict, and the extremum of K (the region of Lagrange). Observed 3e-15."""
    random = np.random.default_rng(1)
    seen = {(True, True): 0, (True, False): 0, (False, False): 0}
    for _ in range(48):
        # near the corner of the region of gyroscopic stability half of the time
        J = np.sort(random.uniform(0.5, 1.0, 3)) if random.random() < 0.4 else random.uniform(0.5, 1.0, 3)
        if random.random() < 0.3:
            J = np.array([0.56, 0.98, 0.52]) + random.uniform(-0.02, 0.02, 3)
        if max(J) > sum(J) / 2:
            continue
        body = li.systems.gravity_gradient(J, CIRCLE)
        modes = li.normal_modes(body, body.state(angular_velocity=[0.0, 0.0, 1.0], t=0.0))
        frequencies, stable, lagrange = satellite_modes(J)
        assert modes.stable == stable, J
        assert modes.definite == lagrange, J
        assert (modes.margin > 0) == stable
        if stable:
            np.testing.assert_allclose(modes.frequencies, frequencies, rtol=3e-14)
        seen[stable, lagrange] += 1
    assert min(seen.values()) >= 4, seen


def test_an_equilibrium_reports_how_far_it_is_from_the_guess():
    """Of a satellite at 0.9 of its orbit's rate the momentum is a tenth too small; at the equilibrium nothing moves."""
    body = li.systems.gravity_gradient([1.0, 2.0, 2.5], CIRCLE)
    found = li.equilibrium(body, body.state(angular_velocity=[0.0, 0.0, 0.9], t=0.0))
    assert float(found.moved) == pytest.approx(0.1, rel=1e-9)
    assert float(li.equilibrium(body, found.state).moved) < 1e-14


def test_newton_finds_the_satellite_at_rest_in_its_orbit():
    """From 0.2 rad off, at another time and in an inclined orbit; a wrong frame is refused."""
    orbit = li.orbits.kepler(1.0, 1.0, 0.0, inclination=0.4, node=0.3)
    body = li.systems.gravity_gradient([1.0, 2.0, 2.5], orbit)
    r, v = (np.asarray(x) for x in orbit(0.7))
    axes = np.stack([r, v, np.cross(r, v)], axis=1)
    turned = np.asarray(so3.to_matrix(so3.exp(jnp.array([0.1, -0.15, 0.1])))) @ axes
    found = li.equilibrium(body, body.state(turned, angular_velocity=[0.1, 0.1, 0.9], t=0.7))
    R = np.asarray(body.rotation_matrix(found.state))
    np.testing.assert_allclose(np.abs(R.T @ axes), np.eye(3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(body.angular_velocity(found.state), [0, 0, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.frame, axes[:, 2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(li.normal_modes(body, found).frequencies, satellite_modes([1.0, 2.0, 2.5])[0], rtol=1e-9)
    eccentric = li.systems.gravity_gradient([1.0, 2.0, 2.5], li.orbits.kepler(1.0, 1.0, 0.1))
    with pytest.raises(ValueError, match="a field at rest or one that rotates uniformly"):
        li.equilibrium(eccentric, eccentric.state(angular_velocity=[0.0, 0.0, 1.0], t=0.0))


@pytest.mark.parametrize("over", [0.999, 1.001, 1.5])
def test_a_sleeping_top_wakes_at_its_threshold(over):
    """Π₃² = 4J₁Mgl; above it, tilts rotate in space at (Π₃ ± √(Π₃² − 4J₁Mgl))/2J₁, here in axes that spin at Ω₃."""
    J1, J3, weight = 2.0, 1.0, 1.3
    threshold = np.sqrt(4 * J1 * weight)
    spin = over * threshold
    top = li.systems.heavy_top([J1, J1, J3], [0.0, 0.0, weight])
    found = li.equilibrium(top, top.state(body_momentum=[0.0, 0.0, spin]))
    modes = li.normal_modes(top, found)
    root = np.sqrt(complex(spin**2 - threshold**2))
    rates = (spin + np.array([root, -root])) / (2 * J1) - spin / J3
    np.testing.assert_allclose(found.rates, [spin / J3], rtol=1e-13)
    assert modes.stable == (over > 1)
    np.testing.assert_allclose(np.sort(modes.frequencies[:2]), np.sort(np.abs(rates.real)), rtol=1e-9)
    np.testing.assert_allclose(modes.growth[:2], np.abs(rates.imag), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(modes.frequencies[2:], [0])
    if over > 1:  # the two approach each other with opposite signs
        assert int(modes.signs[0] * modes.signs[1]) == -1
        assert modes.margin == pytest.approx(root.real / J1, rel=1e-8)
    else:
        assert modes.margin == pytest.approx(-abs(root) / (2 * J1), rel=1e-8)


@pytest.mark.parametrize("wheel", [-3.0, -0.5, 0.0, 1.1])
def test_a_wheel_steadies_a_spin_about_the_middle_axis(wheel):
    """Stable if (λ − J₁Ω)(λ − J₂Ω) > 0 with λ = J₃Ω + h; that product is the frequency squared times J₁J₂."""
    J1, J2, J3, spin = 1.0, 3.0, 2.0, 1.0
    body = li.systems.gyrostat([J1, J2, J3], [0.0, 0.0, wheel])
    modes = li.normal_modes(body, body.state(angular_velocity=[0.0, 0.0, spin]))
    carried = J3 * spin + wheel
    square = (carried - J1 * spin) * (carried - J2 * spin) / (J1 * J2)
    assert modes.stable == (square > 0)
    value = modes.frequencies[0] if square > 0 else modes.growth[0]
    assert float(value) == pytest.approx(np.sqrt(abs(square)), rel=1e-12, abs=0)
    np.testing.assert_allclose(modes.frequencies[1:], [0, spin], rtol=0, atol=1e-12)  # along the spin; a tilt of π


def planar_binary(m, J, radius):
    """ω and the frequencies of (r, λ) of a sphere m[1] and a body m[0], J = (A, B, C), to second order, G = 1.

    H = p_r²/2μ + (L − s)²/2μr² + s²/2C + V(r, λ) with the spin s and the angle λ of the axis A from the line; by
    finite differences of V and of nothing else.
    """
    (A, B, C), mu = J, m[0] * m[1] / sum(m)

    def V(r, lam):
        along = A * np.cos(lam) ** 2 + B * np.sin(lam) ** 2
        return -m[0] * m[1] / r - m[1] * (A + B + C - 3 * along) / (2 * r**3)

    def second(f, h=1e-3):
        w = np.array([2, -27, 270, -490, 270, -27, 2]) / 180
        return sum(c * f(k * h) for k, c in zip(range(-3, 4), w, strict=True)) / h**2

    def first(f, h=1e-3):
        w = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60
        return sum(c * f(k * h) for k, c in zip(range(-3, 4), w, strict=True)) / h

    rate = np.sqrt(first(lambda h: V(radius + h, 0.0)) / (mu * radius))
    Vrr, Vll = second(lambda h: V(radius + h, 0.0)), second(lambda h: V(radius, h))
    # coordinates (r, λ), momenta (p_r, s): H_ss = 1/C + 1/μr², H_rs = 2(L − s)/μr³ = 2ω/r, H_rr = 3μω² + V_rr
    Hqq = np.array([[3 * mu * rate**2 + Vrr, 0], [0, Vll]])
    Hqp = np.array([[0, 2 * rate / radius], [0, 0]])
    Hpp = np.diag([1 / mu, 1 / C + 1 / (mu * radius**2)])
    values = np.linalg.eigvals(np.block([[Hqp.T, Hpp], [-Hqq, -Hqp]]))
    return rate, np.sort(values.imag[values.imag > 0])


def test_a_synchronous_binary_librates_as_its_planar_problem():
    """The naive √(3(B − A)/C · m₁/M), with the orbit held, is off by 7 %. Observed 2e-8."""
    m, J, radius = np.array([1.0, 3.0]), np.array([0.30, 0.42, 0.48]), 6.0
    inertias = np.array([J, [0.03] * 3])
    bodies = li.systems.rigid_bodies(m, inertias, li.potentials.maccullagh(1.0, m, inertias))
    rate, expected = planar_binary(m, J, radius)
    x = np.array([[-m[1], 0, 0], [m[0], 0, 0]]) * radius / m.sum()
    spin = np.array([[0, 0, rate], [0, 0, 0.0]])
    guess = bodies.state(x, velocities=np.cross([0, 0, 0.97 * rate], x), angular_velocities=0.97 * spin)
    found = li.equilibrium(bodies, guess, free=[5, *range(12, 24)])
    np.testing.assert_allclose(found.rates, [0, 0, 0, 0, 0, rate], rtol=0, atol=1e-10)
    modes = li.normal_modes(bodies, found)
    assert modes.frequencies.shape == (12,)
    assert modes.stable
    for frequency in expected:
        assert np.abs(modes.frequencies / frequency - 1).min() < 1e-7
    naive = rate * np.sqrt(3 * (J[1] - J[0]) / J[2] * m[1] / m.sum())
    assert expected.min() / naive == pytest.approx(0.928, abs=0.002)


def fast_primary(oblate=0.045, moments=None, distance=1.2):
    """A primary that spins six times as fast as its synchronous secondary moves, near a relative equilibrium."""
    m, J = np.array([1.0, 0.1]), np.array([[0.04, 0.04, oblate], [0.0008, 0.0010, 0.0011]])
    law = li.potentials.maccullagh(1.0, m, J if moments is None else np.array([moments, J[1]]))
    x = np.array([[-m[1], 0, 0], [m[0], 0, 0]]) * distance / m.sum()
    rate = np.sqrt(m.sum() / distance**3)
    bodies = li.systems.rigid_bodies(m, J, law)
    v = np.cross([0, 0, rate], x)
    return bodies, bodies.state(x, velocities=v, angular_velocities=[[0, 0, 5.0], [0, 0, rate]])


def apart(state):
    return np.linalg.norm(state.q[..., 1, :3] - state.q[..., 0, :3], axis=-1)


def test_a_symmetric_primary_may_spin_faster_than_its_synchronous_secondary():
    """n² = GM/r³ (1 + 3/2r² ((C − A)/m₁ + (B + C − 2A)/m₂)), to 1e-14; over 1000 steps r is constant to 5e-15."""
    bodies, guess = fast_primary()
    without, found = li.equilibrium(bodies, guess), li.equilibrium(bodies, guess, spinning=(0,))
    assert apart(without.state) < 0.9
    assert float(found.residual) < 1e-13  # 2e-15: the spin about the axis of symmetry is neutral, not soft
    assert apart(found.state) == pytest.approx(1.2, rel=3e-3)
    shift = np.asarray(found.change).reshape(2, 2, 6)[0, :, 0]
    assert apart(found.state) == pytest.approx(1.2 + shift[1] - shift[0], rel=1e-12, abs=0)
    held = li.equilibrium(bodies, guess, spinning=(0,), free=range(12, 24))
    assert apart(held.state) == 1.2
    m, J, r = np.asarray(bodies.masses), np.asarray(bodies.inertias), 1.2
    bulges = (J[0, 2] - J[0, 0]) / m[0] + (J[1, 1] + J[1, 2] - 2 * J[1, 0]) / m[1]
    rate = np.sqrt(m.sum() / r**3 * (1 + 1.5 * bulges / r**2))
    spin = float(bodies.angular_velocities(held.state)[0, 2])
    np.testing.assert_allclose(held.rates[5:], [rate, spin - rate], rtol=1e-12)
    assert spin == pytest.approx(5, abs=1e-4)
    path = li.integrate(li.schemes.extrapolate(bodies, 12), held.state, 0.02, 1000)
    assert np.abs(apart(path.state) - r).max() < 1e-13


def test_modes_do_not_depend_on_the_spin_of_a_spherical_primary():
    bodies, guess = fast_primary(oblate=0.04, distance=1.5)
    found = li.equilibrium(bodies, guess, spinning=[0], free=range(12, 24))
    rate, expected = planar_binary(np.asarray(bodies.masses)[::-1], np.asarray(bodies.inertias)[1], 1.5)
    assert float(found.rates[5]) == pytest.approx(rate, rel=1e-9)
    frequencies = np.asarray(li.normal_modes(bodies, found).frequencies)
    for frequency in expected:
        assert np.abs(frequencies / frequency - 1).min() < 1e-6


@pytest.mark.parametrize("unit", [(2.0**80, 2.0**30, 2.0**17), (2.0**-87, 2.0**-33, 2.0**-43)], ids=["planet", "atom"])
def test_equilibria_and_modes_do_not_depend_on_the_units(unit):
    """A synchronous binary in kg, m and s: linear and angular momenta differ by the length, states by far more."""

    def modes(mass, length, time):
        m, J = mass * np.array([1.0, 0.1]), mass * length**2 * np.array([[0.04, 0.05, 0.06], [0.0008, 0.0010, 0.0011]])
        x, rate = np.array([[-0.1, 0, 0], [1.0, 0, 0]]) * length, np.array([0, 0, 0.95]) / time
        law = li.potentials.maccullagh(length**3 / (mass * time**2), m, J)
        bodies = li.systems.rigid_bodies(m, J, law)
        guess = bodies.state(x, velocities=np.cross(rate, x), angular_velocities=[rate, rate])
        found = li.equilibrium(bodies, guess)
        return found.state.q / np.repeat([length, 1], [3, 4]), time * li.normal_modes(bodies, found).frequencies

    for x, y in zip(modes(*unit), modes(1.0, 1.0, 1.0), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-13)  # observed 0: the units are powers of 2


@pytest.mark.long
@pytest.mark.parametrize("mass", [1e-24, 1e-8, 1e8])
@pytest.mark.parametrize("rate", [0.0, 1e-12])
def test_a_hanging_top_is_found_in_any_units_though_it_has_no_momentum(mass, rate):
    """Frequencies √(Mgl/J). With 1 as the unit of its momentum any state of 1e-8 kg m² was an equilibrium."""
    top = li.systems.heavy_top(mass * np.array([1.0, 1.5, 2.0]), mass * np.array([0.0, 0.0, 1.0]))
    guess = top.state(so3.exp(jnp.array([np.pi - 0.3, 0.2, 0.0])), angular_velocity=[rate, 0.0, 0.0])
    found = li.equilibrium(top, guess)
    np.testing.assert_allclose(top.Gamma(found.state), [0, 0, -1], rtol=0, atol=2e-15)  # observed: 4e-16
    frequencies = li.normal_modes(top, found).frequencies[:2]
    np.testing.assert_allclose(frequencies, np.sqrt(1 / np.array([1.5, 1.0])), rtol=1e-11)  # observed: 6e-13
    swung = li.equilibrium(top, top.state(guess.q, angular_velocity=[0.3, 0.0, 0.0])).moved
    assert swung == pytest.approx(0.3, abs=0.02)  # a rotation by 0.3; the momentum is 0.2 of that of a radian's swing


@pytest.mark.parametrize(
    ("more", "spinning", "message"),
    [
        ({}, (1,), "body 1 cannot spin at a rate of its own .* principal moments .* differ"),
        ({"moments": [0.04, 0.041, 0.045]}, (0,), "the potential exerts a torque about its axis"),
        ({}, (2,), "spinning must be numbers of bodies, from 0 to 1"),
        ({}, 0, "spinning must be numbers of bodies, from 0 to 1"),
    ],
)
def test_bodies_that_are_not_symmetric_cannot_spin_at_rates_of_their_own(more, spinning, message):
    bodies, guess = fast_primary(**more)
    with pytest.raises(ValueError, match=message):
        li.equilibrium(bodies, guess, spinning=spinning)
    top = li.systems.heavy_top([2.0, 2.0, 1.0], [0.0, 0.0, 1.3])
    with pytest.raises(ValueError, match="spinning is for bodies"):
        li.equilibrium(top, top.state(body_momentum=[0.0, 0.0, 1.0]), spinning=(0,))


def test_a_free_body_has_rates_and_a_spin_about_the_middle_axis_grows():
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    modes = li.normal_modes(body, body.state(angular_velocity=[0.0, 1.0, 0.0]))
    assert float(modes.growth[0]) == pytest.approx(np.sqrt(1 / 3), rel=1e-13, abs=0)
    assert modes.margin == pytest.approx(-np.sqrt(1 / 3), rel=1e-13, abs=0)
    assert modes.periods[0] == np.inf
    with pytest.raises(ValueError, match="not a relative equilibrium"):
        li.normal_modes(body, body.state(angular_velocity=[0.1, 1.0, 0.0]))
    damped = li.systems.damped_body([1.0, 2.0, 3.0], 0.1)
    with pytest.raises(ValueError, match="is not that of its energy"):
        li.equilibrium(damped, damped.state(angular_velocity=[0.1, 1.0, 0.0]))
    with pytest.raises(ValueError, match="free must be coordinates"):
        li.equilibrium(body, body.state(angular_velocity=[0.1, 1.0, 0.0]), free=[6])
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda z: li.normal_modes(body, z).frequencies)(body.state(angular_velocity=[0.0, 1.0, 0.0]))


def test_modes_are_those_of_the_motion():
    """A small displacement along a mode of a Kirchhoff-like system on SE(3) returns after its period."""
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [0.0, 0.0, -1.0])
    found = li.equilibrium(top, top.state(so3.exp(jnp.array([0.1, -0.05, 0.0])), angular_velocity=[0.0, 0.0, 0.3]))
    modes = li.normal_modes(top, found)
    assert modes.definite
    step, small = li.schemes.splitting(top, li.schemes.exact(top.free)), 1e-6
    for mode in (0, 1):
        start = top.phase_space.perturb(found.state, small * jnp.asarray(modes.vectors[:, mode].real))
        turn = float(modes.periods[mode])
        end = jax.tree.map(
            lambda x: x[-1], li.integrate(li.schemes.compose(step, 4), start, turn / 400, 400, save_every=400)
        ).state
        # in axes that moved on with the equilibrium
        back = so3.exp(-turn * found.rates[0] * jnp.array([0.0, 0.0, 1.0]))
        end = end._replace(q=so3.multiply(back, end.q), p=so3.Ad(back, end.p))
        missed = top.phase_space.displacement(start, end)
        assert float(jnp.abs(missed).max()) < 1e-3 * small
