"""`lieint run heavy_top`, and Lagrange's top in closed form against references that share nothing with it."""

import functools
import re

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from grid import examples_of
from scenario_runs import run

import lieint_jax as li
from lieint_jax import measure
from lieint_jax.app import scenarios
from lieint_jax.groups import so3

pytestmark = pytest.mark.long

TOPS = [  # weight, axis, angular velocity; the third passes 0.9° from hanging, the fourth swings through a loop
    (20.0, [0.0, 0.0, 1.0], [0.0, 0.0, 50.0]),
    (20.0, [0.0, 0.6, 0.8], [1.0, 0.5, 4.0]),
    (-3.0, [0.0, 0.0, 2.0], [1.0, 0.5, 4.0]),
    (20.0, [0.0, 0.0, 1.0], [3.0, 0.0, 8.0]),
]


@jax.jit
def _facts(top, Omega):
    """Of a top with an angular velocity: its motion in closed form, γ·π, Π, energy, and e₃ in space now and after a
    period of nutation of the exact flow."""
    state = top.state(so3.exp(jnp.array([0.8, 0.1, 0.0])), angular_velocity=Omega)
    found = li.systems.lagrange_motion(top, state)
    after = li.diagnostics.flow(top, state, found.nutation_period, 200)
    east = [so3.Ad(z.q, jnp.array([0.0, 0.0, 1.0])) for z in (state, after)]
    return found, top.momentum(state)[0], top.body_momentum(state), top.energy(state), east


@pytest.mark.parametrize("case", TOPS, ids=["fast", "tilted", "hanging", "looping"])
def test_lagrange_s_top_agrees_with_quadrature_in_30_digits_and_with_the_flow(case):
    """Floors: period 3e-16, precession 3e-13 (roots close together), recurrence 2e-15."""
    weight, axis, Omega = case
    top = li.systems.heavy_top([5.0, 5.0, 1.0], [0.0, 0.0, weight], axis)
    found, momentum, Pi, energy, east = jax.device_get(_facts(top, np.array(Omega)))
    with mpmath.workdps(30):

        def number(x):
            return mpmath.mpf(float(x))

        size, Pi = number(np.linalg.norm(axis)), [number(x) for x in Pi]
        sign = int(np.sign(weight))
        alpha, a = abs(weight) * size * 2 / 5, (2 * number(energy) - Pi[2] ** 2) / 5
        b, c = number(momentum) / size / 5, sign * Pi[2] / 5
        guesses = np.sort(np.roots([float(x) for x in (alpha, -(a + c * c), 2 * b * c - alpha, a - b * b)]).real)
        speed = lambda u: (a - alpha * u) * (1 - u * u) - (b - c * u) ** 2  # noqa: E731
        u1, u2, u3 = (mpmath.findroot(speed, guess) for guess in guesses)

        def integral(f):
            def integrand(s):
                u = u1 + (u2 - u1) * mpmath.sin(s) ** 2
                return 4 * f(u) / mpmath.sqrt(alpha * (u3 - u))

            return mpmath.quad(integrand, mpmath.linspace(0, mpmath.pi / 2, 9))

        period, turned = integral(lambda u: 1), integral(lambda u: (b - c * u) / (1 - u * u))
        assert abs(number(found.nutation_period) / period - 1) < 3e-15
        assert abs(number(found.precession_rate) * period / turned - 1) < 3e-12
        np.testing.assert_allclose(np.cos(found.inclination), [float(u2), float(u1)], rtol=0, atol=1e-13)
    gamma = np.array(axis) / np.linalg.norm(axis)
    east, turn = sign * np.array(east), float(found.precession_rate * found.nutation_period)
    cosine = east @ gamma
    assert abs(cosine[1] - cosine[0]) < 2e-14
    across = np.linalg.svd(gamma[None])[2][1:]
    across[1] *= np.sign(np.linalg.det([*across, gamma]))
    angle = np.diff([np.arctan2(*(across @ x)[::-1]) for x in east])[0]
    assert abs((angle - turn + np.pi) % (2 * np.pi) - np.pi) < 3e-12


@functools.cache
def as_shipped():
    """The run of two members."""
    return run(scenarios.load("heavy_top", members=2, steps=2000))


def test_the_shipped_run_shows_the_closed_form():
    """By nystrom of order 6 at dt = 0.01, from states saved 14 times in a nutation: all to ten digits."""
    scenario = scenarios.load("heavy_top", members=2, steps=2000)
    rows = scenario.quantities(as_shipped())
    assert [row.name.split()[0] for row in rows] == ["nutation", "mean", "least", "greatest"]
    for row in rows:
        exact = pytest.approx(row.closed_form, rel=1e-11, abs=1e-12)  # 1e-15, 2e-12, 2e-12, 2e-12
        assert row.nominal == exact, row.name
        assert row.spread > 1e-4
    text = scenario.report(as_shipped())
    assert re.search(r"nutation period \(s\) +0.6822560158 +0.0\d+ +0.6822560158 +-?[\d.]+e(-1\d|\+00) *$", text, re.M)


def test_nutation_of_sparsely_saved_states_is_not_measured():
    one = as_shipped().member(0)
    sparse = li.Run.of(one.step, jax.tree.map(lambda x: x[::4], one.trajectory))
    period, rate, least, greatest = measure.nutation(sparse)
    assert np.isnan([period, rate]).all()
    assert 17 < np.rad2deg(least) < np.rad2deg(greatest) < 19


def test_tops_without_closed_form_report_what_they_have():
    top, state = jax.jit(lambda: examples_of("heavy_top")["kovalevskaya"][:2])()
    assert not li.systems.is_lagrange_top(top)
    states = jax.tree.map(lambda x: x[None], state)
    run = li.run(li.schemes.splitting(top), states, 0.02, 2000, save_every=5, progress=False)
    scenario = scenarios.load("heavy_top")
    found = {x.name: x.change().max() for x in scenario.conserved(run)}
    assert 1e-5 < found["Kovalevskaya's integral, relative"] < 1e-2
    assert found["γ·π, relative to |π|"] < 1e-14
    assert "Π₃, relative to |π|" not in found
    assert np.isnan([row.closed_form for row in scenario.quantities(run)]).all()
