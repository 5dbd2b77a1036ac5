"""Which steady rotations are stable: satellites in their orbits, spins with a wheel, spins with a damper."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import schemes, systems, torques
from lieint_jax.core import tangent
from lieint_jax.groups import so3
from lieint_jax.maps import KAPPAS

pytestmark = pytest.mark.long

E3 = np.array([0.0, 0.0, 1.0])
CIRCLE = li.orbits.kepler(1.0, 1.0, 0.0)


def satellites(k1, k3):
    """The moments (radius, track, normal), radius 1, of k₁ = (B − C)/A and k₃ = (B − A)/C about (A, B, C) of track,
    normal and radius; whether they are stable in a circular orbit; and how far they are from the borders.

    Stable: k₁ > k₃, k₁k₃ > 0 and 1 + 3k₁ + k₁k₃ > 4√(k₁k₃).
    """
    k1, k3 = (x.ravel() for x in np.meshgrid(k1, k3))
    track = (1 - k3) / (1 - k1)
    moments = np.stack([np.ones_like(k1), track, 1 + k1 * track], axis=1)
    margins = np.stack([k1 - k3, k1 * k3, 1 + 3 * k1 + k1 * k3 - 4 * np.sqrt(np.maximum(k1 * k3, 0))])
    return moments, (margins > 0).all(axis=0), np.abs(margins).min(axis=0)


@jax.jit
@jax.vmap
def linearized(moments, dt):
    """The derivative of a step at the rest in the orbit, seen from the orbit."""
    satellite = systems.gravity_gradient(moments, CIRCLE)
    state = satellite.state(angular_velocity=E3)
    back = so3.exp(-dt * E3)

    def step(z):
        after, _ = schemes.splitting(satellite)(z, dt)
        return after._replace(q=so3.multiply(back, after.q), p=so3.Ad(back, after.p), t=z.t), None

    return tangent.value_and_jacobian(satellite.phase_space, step, state)[2]


def power_sums(squares):
    """Σx, Σx², Σx³ of x = λ², which unlike the λ themselves have a derivative where two of them meet."""
    return np.stack([np.real(squares**k).sum(axis=1) for k in (1, 2, 3)])


def test_the_linearized_step_has_the_roots_of_the_characteristic_equation():
    """λ² = −3(A − C)/B of pitch, λ⁴ + (1 + 3k₁ + k₁k₃)λ² + 4k₁k₃ = 0 of roll and yaw: to order Δt².

    Observed 7.5e-4 of the largest sum of its kind at Δt = 0.02, and 4.00 times as much at 0.04.
    """
    moments, stable, margin = satellites(np.linspace(-0.93, 0.97, 26), np.linspace(-0.95, 0.91, 27))
    C, A, B = moments.T
    k1, k3 = (B - C) / A, (B - A) / C
    b, c = 1 + 3 * k1 + k1 * k3, 4 * k1 * k3
    root = np.sqrt(b**2 - 4 * c + 0j)
    squares = np.stack([-3 * (A - C) / B + 0j, (-b + root) / 2, (-b - root) / 2], axis=1)
    expected = 2 * power_sums(squares)  # each λ² is that of ±λ
    errors = []
    for dt in (0.04, 0.02):
        values = np.linalg.eigvals(np.asarray(linearized(moments, np.full(C.shape, dt))))
        found = power_sums((np.log(values) / dt) ** 2)
        errors.append(np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1))
    assert errors[1].max() < 2e-3
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.1)
    grows = np.log(np.abs(values).max(axis=1)) / 0.02 > 3e-3  # on a border roots meet, and an error ε moves them by √ε
    clear = margin > 0.02
    assert clear.sum() > 500
    assert 50 < (stable & clear).sum() < 400
    np.testing.assert_array_equal(grows[clear], ~stable[clear])


@jax.jit
@jax.vmap
def swing(moments):
    """The largest angle from rest in the last two orbits of twelve, after a push of 1e-3 rad; and convergence."""
    satellite = systems.gravity_gradient(moments, CIRCLE)
    start = satellite.state(so3.exp(1e-3 * jnp.array([0.6, 0.48, 0.64])), angular_velocity=E3)
    run = li.integrate(schemes.splitting(satellite), start, 2 * np.pi / 50, 600, save_every=10)
    error = jax.vmap(lambda t, q: so3.multiply(so3.exp(-t * E3), q)[1:])(run.t[-10:], run.state.q[-10:])
    return 2 * jnp.arcsin(jnp.minimum(jnp.linalg.norm(error, axis=1), 1)).max(), run.info.converged.all()


def test_stable_satellites_swing_a_little_and_the_others_turn_over():
    """In the nonlinear equations, both regions. Observed: at most 7.1e-3 rad, and at least 1.5."""
    several = [
        satellites(np.linspace(-0.9, 0.9, 10), np.linspace(-0.9, 0.9, 9)),
        satellites([-0.06, -0.04], [-0.8, -0.6, -0.4]),  # DeBra's and Delp's
    ]
    moments, stable, margin = (np.concatenate(x) for x in zip(*several, strict=True))
    clear = margin > 0.02
    angle, converged = jax.device_get(swing(moments))
    assert converged.all()
    assert (clear & stable)[90:].sum() >= 3
    assert (clear & stable)[:90].sum() > 5
    assert angle[clear & stable].max() < 2e-2
    assert angle[clear & ~stable].min() > 0.5


@li.pytree
class Wheel(torques.Law):
    """T = −Ω × h_r in the body, of a wheel of the momentum h_r: its mean in a step is −κ Ω̄ × h_r."""

    rotor: jax.Array

    def mean(self, rotation, inner):
        return rotation.kappa * jnp.cross(self.rotor, rotation.Omega), None


@pytest.mark.parametrize("kappa", KAPPAS, ids=lambda k: k.name)
def test_a_wheel_as_a_torque_is_the_gyrostat(kappa):
    """Its power is zero, body and wheel together keep their momentum, and the motion is that of `gyrostat`.

    Observed over 200 steps: work 5e-18, energy and momentum 2e-15, attitude 5e-15.
    """
    J, rotor, Omega = jnp.array([1.0, 1.3, 1.5]), jnp.array([0.2, 0.1, 0.5]), [0.3, 0.1, 1.0]
    body, gyrostat = systems.torqued_body(J, Wheel(rotor)), systems.gyrostat(J, rotor)

    @jax.jit
    def both():
        start = body.state(angular_velocity=Omega, work=0.0)
        step = schemes.torqued_midpoint(body, kappa)
        ours = li.integrate(step, start, 0.1, 200)
        other = li.integrate(schemes.so3_midpoint(gyrostat, kappa), gyrostat.state(angular_velocity=Omega), 0.1, 200)
        total = ours.state.p + jax.vmap(so3.Ad, (0, None))(ours.state.q, rotor)
        return ours, other, total, li.Run.of(step, ours).energy_error()

    ours, other, total, energy = jax.device_get(both())
    assert ours.info.converged.all()
    assert np.abs(ours.state.work).max() < 1e-16
    assert np.abs(energy).max() < 5e-15
    assert np.abs(total - total[0]).max() < 5e-15
    assert np.abs(ours.state.q - other.state.q).max() < 2e-14
    assert np.abs(ours.state.p - ours.state.p[0]).max() > 0.1  # the body alone does not keep it


@pytest.mark.parametrize("name", ["internal friction", "Kane's damper"])
def test_with_a_damper_only_the_axis_of_largest_inertia_is_stable(name):
    """A spin that wobbles by 0.01 rad, about each axis of three bodies, each twice: observed 3e-8 and
    less of it in the end about the axis of largest inertia, and 42 times as much and more about the others.

    Without a damper the axis of least inertia is stable too.
    """
    moments = np.array(
        [p for J in ([1.0, 1.4, 2.0], [1.2, 1.8, 1.9], [0.6, 1.5, 1.7]) for p in itertools.permutations(J)]
    )

    @jax.jit
    @jax.vmap
    def wobble(J):
        if name == "internal friction":
            body = systems.damped_body(J, 0.3)
        else:
            body = systems.torqued_body(J - 0.2, torques.kane_damper(0.2, 0.2))
        start = body.state(angular_velocity=jnp.array([0.01, 0.01, 1.0]))
        run = li.integrate(schemes.torqued_midpoint(body), start, 0.2, 4000, save_every=4000)
        Pi = jax.vmap(lambda z: so3.Ad_star(z.q, body.momentum(z)))(run.state)
        return jnp.arctan2(jnp.hypot(Pi[:, 0], Pi[:, 1]), Pi[:, 2]), run.info.converged.all()

    angle, converged = jax.device_get(wobble(moments))
    growth = angle[:, 1] / angle[:, 0]
    major = moments.argmax(axis=1) == 2
    assert converged.all()
    assert growth[major].max() < 2e-7
    assert growth[~major].min() > 10
