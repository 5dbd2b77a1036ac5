"""Rods in motion: what each scheme conserves, loads, damping and driven ends, and the order in Δt and in ℓ."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import slopes
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import potentials, schemes, systems

SOFT = systems.Section(1.0, (0.02, 0.03), (20.0, 20.0, 30.0), (0.5, 0.7, 0.6))
CURVED = (0.5, 0.2, 0.8)


def thrown(n, **options):
    """A free rod of n elements, curved and twisted, in flight."""
    rod = systems.rod(1.0, n, SOFT, natural_curvature=CURVED, **options)
    s = np.linspace(0, 1, n + 1)[:, None]
    v = s * np.array([0.3, 0.1, -0.2]) + np.sin(3 * s) * np.array([0, -0.3, 0.2])
    return rod, rod.state(velocities=v, angular_velocities=np.cos(2 * s) * np.array([1.0, 0.3, 0.6]))


def errors(system, path, free=None):
    """H − W, and P and L, less those at the start, at all times."""
    H, momentum = (np.asarray(jax.vmap(f)(path.state)) for f in (system.energy, (free or system).momentum))
    work = 0 if path.state.work is None else np.asarray(path.state.work)
    return H - work - H[0] + np.ravel(work)[0], momentum - momentum[0]


DAMPING = [0.01, 0.01, 0.02, 0.03, 0.02, 0.04]
THROWN = {  # the rod and its start, steps, bounds on the changes of H − W and of P and L; a few times those observed
    "free": (lambda: thrown(3), 3000, 3e-14, 4e-15),  # 9e-15 and 7e-16, in which it turns and bends
    "damped": (lambda: thrown(3, damping=DAMPING), 1000, 1e-15, 2e-15),  # 1e-16 and 3e-16
    "float32": (lambda: jax.tree.map(jnp.float32, thrown(2)), 200, 1e-6, 5e-7),  # 1.9e-7 and 7.5e-8
}


@pytest.mark.long
@pytest.mark.parametrize("name", THROWN)
def test_a_rod_in_flight_conserves_energy_less_work_and_both_momenta(name):
    make, steps, most, most_momentum = THROWN[name]
    (rod, start), dt = make(), jnp.float32(0.01) if name == "float32" else 0.01
    path = li.integrate(schemes.bodies_energy_momentum(rod), start, dt, steps)
    assert path.info.converged.all()
    assert path.state.q.dtype == start.p.dtype
    energy, momentum = errors(rod, path)
    assert abs(energy).max() < most
    assert abs(momentum).max() < most_momentum
    if name == "damped":
        assert np.diff(path.state.work).max() < 0
        assert path.state.work[-1] < -0.01


@functools.cache
def shaken():
    """A damped rod under gravity with a load on its tip, whose foot moves: systems, start and path."""
    rod, start, _ = systems._rod.examples()["shaken"]
    return rod, start, li.integrate(schemes.bodies_energy_momentum(rod), start, 0.01, 1000)


@pytest.mark.long
def test_the_work_of_a_driven_end_of_loads_and_of_damping_is_counted():
    """Observed 1.4e-15, where the work varies by 1.4."""
    rod, _, path = shaken()
    assert path.info.converged.all()
    energy, _ = errors(rod, path, rod.conservative)
    assert np.ptp(path.state.work) > 1
    assert abs(energy).max() < 6e-15


@pytest.mark.long
def test_a_pair_of_sections_vibrates_and_decays_as_a_damped_oscillator():
    """Along the rod: ω² = EA (1/m + 1/m)/ℓ and the rate ½τω², of a Kelvin–Voigt material; P and L are conserved."""
    tau = 0.01
    rod = systems.rod(0.5, 1, SOFT, damping=tau)
    start = rod.state(velocities=[[0, 0, -1e-3], [0, 0, 1e-3]])
    path = li.integrate(schemes.bodies_energy_momentum(rod), start, 1e-3, 1000)
    square = 30 / 0.5 * (2 / 0.25)
    rate, t = tau * square / 2, np.asarray(path.t)
    omega = np.sqrt(square - rate**2)
    expected = 2e-3 / omega * np.exp(-rate * t) * np.sin(omega * t)
    stretch = np.asarray(path.state.q[:, 1, 2] - path.state.q[:, 0, 2]) - 0.5
    assert abs(stretch - expected).max() < 3e-4 * abs(expected).max()  # observed 1.6e-4, (Δtω)²/12 in the phase
    energy, momentum = errors(rod, path)
    assert abs(energy).max() < 1e-17  # of 2.5e-7; observed 2.3e-18
    assert abs(momentum).max() < 1e-18
    assert np.diff(path.state.work).max() < 0


def test_a_run_evaluates_the_forces_of_a_rod_once_per_step():
    """Its end is that of a loop of single steps, which evaluate them twice; observed: 3e-17, 0.76 of the operations."""
    rod, start = thrown(1)
    step = schemes.splitting(rod, schemes.preprocessed(rod.free, 4))

    def single_steps(state):
        return li.scan(lambda state, _: (step(state, 0.01)[0], None), state, length=10)[0]

    def run(state):
        return jax.tree.map(lambda x: x[-1], li.integrate(step, state, 0.01, 10, save_every=10).state)

    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=0, atol=3e-16), run(start), single_steps(start))
    whole, alone = (max(loop.operations for loop in li.explain(f, start).loops) for f in (run, single_steps))
    assert whole < 0.9 * alone


@pytest.mark.long
def test_symplectic_schemes_integrate_a_clamped_rod():
    rod = systems.rod(1.0, 2, SOFT, natural_curvature=CURVED, ends=("clamped", "free"))
    start = rod.state(velocities=[[0.1, 0, 0], [0.3, 0.1, 0]], angular_velocities=[[1.0, 0.3, 0.5], [0.4, 2.0, 0.7]])
    assert li.diagnostics.symplectic_defect(schemes.splitting(rod), start, 0.01) < 1e-13
    assert not rod.momentum(start).any()  # nothing of P and L is conserved, and nothing is claimed


def continuous_tip(section, v, degree=24):
    """x, z and the angle of one end of a free rod after a time of 1, from a straight one with velocities v(s) along x.

    The plane motion of the continuous rod by Legendre polynomials in s: quadrature by Gauss, and time by scipy.
    """
    legendre, rank = np.polynomial.legendre, np.arange(degree + 1)
    nodes, weights = legendre.leggauss(2 * degree)
    s, weights, mass = (nodes + 1) / 2, weights / 2, 1 / (2 * rank + 1)
    value, slope = (
        np.stack([f(legendre.Legendre.basis(k))(nodes) for k in rank], axis=1)
        for f in (lambda p: p, lambda p: 2 * p.deriv())
    )
    (GA, _, EA), (_, EI, _) = section.stretching, section.bending
    inertia = np.array([section.mass, section.mass, section.inertia[1]])[:, None] * mass

    def stored(c):
        x, z, angle = slope @ c[0], slope @ c[1], value @ c[2]
        shear, along = x * jnp.cos(angle) - z * jnp.sin(angle), x * jnp.sin(angle) + z * jnp.cos(angle)
        return weights @ (GA * shear**2 + EA * (along - 1) ** 2 + EI * (slope @ c[2]) ** 2) / 2

    @jax.jit
    def rate(y):
        c, velocity = y.reshape(2, 3, -1)
        return jnp.concatenate([velocity.ravel(), (-jax.grad(stored)(c) / inertia).ravel()])

    start = np.array([[0 * s, s, 0 * s], [v(s), 0 * s, v.deriv()(s)]]) @ (weights[:, None] * value) / mass
    end = solve_ivp(lambda t, y: np.asarray(rate(y)), (0, 1), start.ravel(), "DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    return end.reshape(2, 3, -1)[0].sum(axis=1)


@pytest.mark.long
def test_a_motion_converges_to_that_of_the_continuous_rod_at_order_two():
    """A free rod that is bent by its first velocities, and turns by 2.8 rad; by another discretization.

    Position and angle of the tip are off by 4.9/n² and 6.3/n² at n = 8 and 32.
    """
    v = 4000 * (np.polynomial.Polynomial([0, 1, -1]) ** 4).integ(2)
    exact, off = continuous_tip(SOFT, v), []
    for n in (8, 16, 32):
        rod, s = systems.rod(1.0, n, SOFT), np.linspace(0, 1, n + 1)
        zero, steps = 0 * s, 20 * n
        start = rod.state(
            velocities=np.stack([v(s), zero, zero], axis=1),
            angular_velocities=np.stack([zero, v.deriv()(s), zero], axis=1),
        )
        path = li.integrate(schemes.nystrom(rod, 4), start, 1 / steps, steps, save_every=steps)
        x, _, z, w, _, sin, _ = path.state.q[-1, -1]
        off.append(np.array([x, z, 2 * np.arctan2(sin, w)]) - exact)
    sizes = np.linalg.norm(off, axis=1)
    assert np.log2(sizes[0] / sizes[1]) > 1.7  # observed 1.73
    assert np.log2(sizes[1] / sizes[2]) == pytest.approx(2, abs=0.12)  # observed 1.90; 1.98 for 64 elements
    assert np.linalg.norm((4 * off[2] - off[1]) / 3) < 8e-4  # observed 5.2e-4, in part of order 4


@pytest.mark.long
def test_flying_spaghetti_conserves_once_its_load_has_ended():
    """A free rod thrown by a force and moments on one end until t = 5; H − W throughout, then H, P and L.

    The data are those of Simo & Vu-Quoc 1988, Comput. Methods Appl. Mech. Eng. 66, as repeated by later papers, here
    with five elements.
    """
    tilt = np.arctan2(6, -8) / 2

    def pull(t):
        M = 200 * jnp.maximum(0, 1 - jnp.abs(t / 2.5 - 1))
        zero = jnp.zeros_like(t)
        return jnp.stack([M / 10, zero, zero, zero, M, M / 2])

    section = systems.Section(1.0, (10.0, 10.0), (1e4, 1e4, 1e4), (500.0, 500.0, 500.0))
    rod = systems.rod(10.0, 5, section, pose=[0, 0, 8, np.cos(tilt), 0, np.sin(tilt), 0], loads={-1: pull})
    start = rod.state()
    np.testing.assert_allclose(start.q[-1, :3], [6, 0, 0], rtol=0, atol=1e-14)
    path = li.integrate(schemes.bodies_energy_momentum(rod), start, 0.0025, 4000)
    assert np.mean(path.info.converged) > 0.99  # 16 steps are flagged: the strains of a stiff rod round coarsely
    energy, momentum = errors(rod, path, rod.conservative)
    flying = np.asarray(path.t) > 5.001
    assert path.state.work[-1] == pytest.approx(691.7, abs=0.1)
    assert abs(energy).max() < 1e-11  # observed 2.4e-12
    assert np.ptp(path.state.work[flying]) == 0
    np.testing.assert_allclose(momentum[-1, :3], [50, 0, 0], rtol=0, atol=1e-12)  # the impulse of the force
    assert np.ptp(momentum[flying, :3], axis=0).max() < 4e-13  # observed 8e-14
    assert np.ptp(momentum[flying, 3:], axis=0).max() < 6e-12  # observed 1.5e-12, of 605


def unforced(t, x, R, v, omega):
    return 0 * x, 0 * x


@pytest.mark.long
@pytest.mark.parametrize("more", [{}, {"forces": unforced}], ids=["free", "forced"])
def test_a_rod_that_bends_beyond_its_range_says_so(more):
    """Two sections that rotate against each other, at step 9 of a small dt and in the first step of a large one."""
    beyond = r"\. potentials.rod has no value where an element turns by more than 103° .*: use more elements$"
    potential = potentials.rod([1.0], SOFT.stretching, SOFT.bending)
    rod = systems.rigid_bodies([1.0, 1.0], np.ones((2, 3)), potential, **more)
    start = rod.state([[0, 0, 0], [0, 0, 1.0]], angular_velocities=[[0, 0, -2.0], [0, 0, 2.0]])
    step = schemes.bodies_energy_momentum(rod)
    with pytest.warns(RuntimeWarning, match=rf"member 0 at step \d; .* \(use a smaller dt\){beyond}"):
        li.run(step, start, 0.05, 100, progress=False)
    with pytest.raises(ValueError, match=f"Use a smaller dt{beyond}"):
        step.check(start, 1.0)


@pytest.mark.long
def test_the_path_of_the_tip_has_derivatives_by_the_stiffness():
    """Forward and reverse mode against central differences."""

    def tip(EI):
        section = SOFT._replace(bending=EI * jnp.array([1.0, 1.4, 1.2]))
        rod = systems.rod(1.0, 3, section, natural_curvature=CURVED, ends=("clamped", "free"), gravity=(1.0, 0, 0))
        path = li.integrate(schemes.bodies_energy_momentum(rod), rod.state(), 0.01, 50)
        return path.state.q[-1, -1, :3]

    tip = jax.jit(tip)
    forward, reverse = jax.jacfwd(tip)(0.5), jax.jacrev(tip)(0.5)
    by_differences = slopes(lambda d: tip(0.5 + d[0]), 1, 2e-3)[:, 0]
    assert abs(by_differences).max() > 0.01
    np.testing.assert_allclose(forward, by_differences, rtol=0, atol=1e-10)  # observed 9e-12
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-14)
