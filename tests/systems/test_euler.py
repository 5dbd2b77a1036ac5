"""Generalized Euler equations: coadjoint invariants, Kirchhoff's ellipsoid against Lamb, Manakov's integrals."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import _discover, groups

EULER = _discover.modules_with("examples", li.systems)["euler"]
MATRIX = _discover.modules_with("examples", groups)["matrix"]
QUICK = {"xla_llvm_disable_expensive_passes": True}


def so4(mu):
    return np.array([mu[0] * mu[5] - mu[1] * mu[4] + mu[2] * mu[3], mu @ mu])  # the Pfaffian, and the square


CASIMIRS = {
    "SO(4)": so4,
    "SE(3)": lambda mu: np.array([mu[:3] @ mu[3:], mu[3:] @ mu[3:]]),  # Π·P, |P|²
    "SL(2)": lambda mu: np.array([4 * mu[0] * mu[1] + mu[2] ** 2]),  # the Killing form of e, f, h on the dual
    "Heis(3)": lambda mu: mu[2:],  # the center
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASIMIRS)
def test_casimirs_are_constant_on_coadjoint_orbits(name):
    """Constant on coadjoint orbits, so along every motion and every step, whatever the metric."""
    g = MATRIX.MatrixGroup(groups.catalogue.examples()[name].basis, name, unrolled=False)
    invariant, rng = CASIMIRS[name], np.random.default_rng(0)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def transported(xi, mu):
        after = g.Ad_star(g.exp_near(xi), mu)
        return after, g.casimirs(after), g.casimirs(mu)

    for xi, mu in rng.normal(size=(4, 2, g.dim)) / 2:
        after, *casimirs = (np.array(x) for x in transported(xi, mu))
        np.testing.assert_allclose(invariant(after), invariant(mu), rtol=0, atol=1e-14)
        np.testing.assert_allclose(*casimirs, rtol=0, atol=1e-14)
        assert casimirs[0].size
        assert np.abs(after - mu).max() > 1e-2


@pytest.mark.long
def test_the_computed_casimirs_are_the_known_ones():
    """By name; the same numbers up to a constant. On Aff(1) there is none, on SU(2) and quaternions |Π|²."""
    rng = np.random.default_rng(1)
    for name, invariant in CASIMIRS.items():
        g = groups.catalogue.examples()[name]
        points = rng.normal(size=(12, g.dim))
        found, known = np.array(jax.jit(jax.vmap(g.casimirs))(points)), np.array([invariant(x) for x in points])
        assert np.linalg.lstsq(found, known, rcond=None)[1].max(initial=0) < 1e-26
        assert found.shape == known.shape
    mu = np.array([1.0, 2.0, 3.0])
    assert groups.affine(1).casimirs(mu[:2]).size == 0
    for group in (groups.special_unitary(2), groups.so3, groups.special_orthogonal(3)):
        system = li.systems.euler(group, [1.0, 2.0, 3.0])
        of_momentum = jax.jit(lambda mu, system=system: system.casimirs(system.state(body_momentum=mu)))
        assert of_momentum(mu) == pytest.approx([14.0], rel=1e-14, abs=0)
    assert groups.translations(3).casimirs(mu).tolist() == [1, 2, 3]
    assert groups.upper_triangular(3).casimirs(np.arange(6.0)).tolist() == [8]  # the trace


@pytest.mark.slow
@pytest.mark.paper("5.1.6: (5.13), (5.14)", "Euler's equations on a group", "systems/_euler.py")
@pytest.mark.parametrize("name", ["SL(2)", "SE(2)", "Heis(3)"])
def test_body_and_spatial_pictures_agree(name):
    """With π̇ = 0 and q̇ = qΩ̂ (5.14), Π = Ad*_q π follows Π̇ = ad*_Ω Π (5.13); energy from either is the same."""
    g, rng = groups.catalogue.examples()[name], np.random.default_rng(3)
    A = rng.normal(size=(3, 3))
    system = li.systems.euler(g, A @ A.T + np.eye(3))

    @jax.jit
    def pictures(xi, velocity):
        state = system.state(g.exp_near(xi), velocity=velocity)
        Pi, rate = jax.jvp(system.body_momentum, (state,), (system.vector_field(state),))
        return Pi, rate, g.ad_star(jnp.linalg.solve(system.metric, Pi), Pi), system.energy(state)

    Pi, rate, by_body, energy = (np.array(x) for x in pictures(rng.normal(size=3) / 3, rng.normal(size=3)))
    Omega = np.linalg.solve(system.metric, Pi)
    np.testing.assert_allclose(rate, by_body, rtol=0, atol=4e-15)
    assert np.abs(rate).max() > 1e-2
    assert float(energy) == pytest.approx(float(Pi @ Omega) / 2, rel=1e-15, abs=0)


def lamb(axes):
    """α₀, β₀, γ₀ of Lamb §114 by mpmath."""
    a, b, c = map(mpmath.mpf, axes)

    def f(i):
        return lambda s: 1 / ((i * i + s) * mpmath.sqrt((a * a + s) * (b * b + s) * (c * c + s)))

    with mpmath.workdps(25):
        return [float(a * b * c * mpmath.quad(f(i), [0, 1, 10, mpmath.inf])) for i in (a, b, c)]


@pytest.mark.parametrize("axes", [(3.0, 2.0, 1.0), (5.0, 1.0, 0.4)])
def test_kirchhoff_added_mass_and_inertia_are_lamb_s(axes):
    a0, b0, c0 = lamb(axes)
    _, b, c = axes
    m = np.array(EULER.kirchhoff(axes).metric)
    np.testing.assert_allclose(np.diag(m)[3:], [1 + x / (2 - x) for x in (a0, b0, c0)], rtol=1e-13)
    about_a = (b**2 - c**2) ** 2 * (c0 - b0) / (2 * (b**2 - c**2) + (b**2 + c**2) * (b0 - c0)) / 5
    assert m[0, 0] == pytest.approx((b**2 + c**2) / 5 + about_a, rel=1e-13, abs=0)
    assert np.abs(m - np.diag(np.diag(m))).max() == 0


def test_kirchhoff_has_the_added_masses_of_a_sphere_and_a_spheroid():
    """½ of the displaced mass for a sphere, no added inertia; Lamb's closed forms (§114) of a spheroid with a = 2b."""
    sphere = np.diag(EULER.kirchhoff((1.0, 1.0, 1.0)).metric)
    np.testing.assert_allclose(sphere, [0.4] * 3 + [1.5] * 3, rtol=1e-13)
    m = np.diag(EULER.kirchhoff((2.0, 1.0, 1.0)).metric)
    e = np.sqrt(3) / 2
    log = np.log((1 + e) / (1 - e))
    a0, b0 = 2 * (1 - e**2) / e**3 * (log / 2 - e), 1 / e**2 - (1 - e**2) / (2 * e**3) * log
    np.testing.assert_allclose(m[3:] - 1, [a0 / (2 - a0), b0 / (2 - b0), b0 / (2 - b0)], rtol=5e-15)
    assert m[0] == pytest.approx(0.4, rel=1e-14, abs=0)  # a body of revolution does not stir the fluid


@pytest.mark.parametrize("thick", [1e-2, 1e-4])
def test_kirchhoff_of_a_disc_has_lamb_s_added_mass_and_inertia(thick):
    """An oblate spheroid's closed forms (Lamb, §§114, 115) in 40 digits; observed: 2e-16."""
    m = np.diag(EULER.kirchhoff((1.0, 1.0, thick)).metric)
    with mpmath.workdps(40):
        square = mpmath.mpf(thick) ** 2
        e = mpmath.sqrt(1 - square)
        c0 = 2 / e**2 * (1 - thick / e * mpmath.asin(e))
        a0 = 1 - c0 / 2
        about_a = (1 - square) ** 2 * (c0 - a0) / (2 * (1 - square) + (1 + square) * (a0 - c0)) / 5
        wanted = [(1 + square) / 5 + about_a] * 2 + [0.4] + [1 + x / (2 - x) for x in (a0, a0, c0)]
    np.testing.assert_allclose(m, np.array(wanted, float), rtol=2e-15)


def test_kirchhoff_energy_with_the_center_of_mass_off_the_center():
    """½m|v + Ω × r|² and so on, from the parts."""
    r, (Omega, v) = np.array([0.1, -0.2, 0.3]), np.random.default_rng(0).normal(size=(2, 3))
    whole, centered = EULER.kirchhoff(center_of_mass=r), np.diag(EULER.kirchhoff().metric)
    moving = whole.energy(whole.state(velocity=np.concatenate([Omega, v])))
    parts = centered[:3] @ Omega**2 + (centered[3:] - 1) @ v**2 + np.sum((v + np.cross(Omega, r)) ** 2)
    assert moving == pytest.approx(parts / 2, rel=1e-14, abs=0)


@functools.cache
def four_dimensional_body():
    body = EULER.manakov()
    system = li.systems.Euler(body.metric, MATRIX.MatrixGroup(body.group.basis, "SO(4)", unrolled=False))
    Omega = np.array([0.5, -0.3, 0.4, 0.2, 0.6, -0.4])
    state = li.State(jnp.array(np.eye(4)), jnp.array(np.asarray(body.metric) * Omega))  # where Π = π
    step = li.schemes.group_midpoint(system)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def run(state, dt):
        out = li.integrate(step, state, dt, 1000, save_every=10)
        Pi = jax.vmap(system.body_momentum)(out.state)
        energy = li.Run.of(step, out).energy_error() / system.energy(state)
        return out, Pi, jax.vmap(lambda x: EULER.manakov_integrals((1.0, 2.0, 3.5, 5.0), x))(Pi), energy

    return system, state, run


def test_manakov_s_integrals_are_constants_of_the_flow():
    system, state, _ = four_dimensional_body()

    @jax.jit
    def along_the_flow(Pi):
        rate = system.group.ad_star(Pi / system.metric, Pi)
        integrals = lambda x: EULER.manakov_integrals((1.0, 2.0, 3.5, 5.0), x)  # noqa: E731
        return rate, *jax.jvp(integrals, (Pi,), (rate,))

    rate, value, change = along_the_flow(state.p)
    assert np.abs(rate).max() > 0.1
    assert np.abs(change).max() < 1e-14 * np.abs(value).max()


def test_manakov_energy_exact_and_the_extra_integrals_bounded():
    """4000 steps of 0.1: energy and Casimirs at round-off; the other integrals are off by 2e-4, without drift."""
    _, state, run = four_dimensional_body()
    z, first, worst = state, None, []
    for _ in range(4):
        out, Pi, integrals, energy = run(z, 0.1)
        integrals = np.asarray(integrals)
        first = integrals[0] if first is None else first
        assert out.info.converged.all()
        worst.append(np.abs(integrals - first).max() / np.abs(first).max())
        assert np.abs(energy).max() < 4e-14  # floor 4e-15
        casimirs = np.array([so4(x) for x in np.asarray(Pi)])
        assert np.abs(casimirs - casimirs[0]).max() < 2e-14 * np.abs(casimirs).max()
        z = jax.tree.map(lambda x: jnp.array(np.asarray(x)[-1]), out.state)
    assert min(worst) > 1e-6
    assert max(worst) < 3e-4  # 2.1e-4, and no more in 10 000 steps


def test_the_spin_needed_is_where_the_linearized_equations_turn_unstable():
    """Kirchhoff's equations Π' = Π × Ω + P × v, P' = P × Ω about a steady motion, by autodiff: growth or none."""
    body = li.systems.kirchhoff((1.0, 1.0, 2.99))
    need = li.systems.kirchhoff_spin(body)
    assert need == pytest.approx(1.9785, abs=1e-4)

    metric = np.diag(body.metric)
    slope = jax.jit(jax.jacfwd(lambda mu: body.group.ad_star(mu / metric, mu)))
    for spin, stable in ((1.01 * need, True), (0.99 * need, False)):
        slopes = np.linalg.eigvals(slope(np.array([0.0, 0.0, spin, 0.0, 0.0, 1.0])))
        assert (np.abs(slopes.real).max() < 1e-6) == stable
    assert li.systems.kirchhoff_spin(li.systems.kirchhoff((2.0, 2.0, 1.0))) == 0  # broadside on, a disc needs no spin
    assert np.isnan(li.systems.kirchhoff_spin(li.systems.kirchhoff((3.0, 2.0, 1.0))))  # no body of revolution
    for unit in (1e-13, 1.0, 1e9):  # the center of mass is above the center
        above = li.systems.kirchhoff((unit, unit, 3 * unit), (0, 0, 1e-7 * unit))
        assert np.isnan(li.systems.kirchhoff_spin(above))
