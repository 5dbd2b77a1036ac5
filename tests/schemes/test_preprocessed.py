"""Preprocessed inertia: the order rises; energy, momentum and the reduced structure stay; the form does not."""

import functools
from fractions import Fraction

import clock_series
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import moving, rows, turned
from linearized import there_and_back
from paper import hat

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.core import State
from lieint_jax.groups import so3
from lieint_jax.schemes import preprocessed
from lieint_jax.schemes._shared import clock_coefficients
from lieint_jax.systems import RigidBody

BODIES = {
    "principal": RigidBody(jnp.array([1.0, 2.0, 3.0])),
    "full": RigidBody(turned([1.0, 2.0, 3.0])),
    "large": RigidBody(jnp.array([1e20, 2e20, 2.5e20])),
}


@jax.jit
def measured(step, state):
    """What 500 steps of 0.4 keep; a step and back."""
    run = li.Run.of(step, li.integrate(step, state, 0.4, 500))
    return {
        "converged": run.info.converged,
        "energy": run.energy_error() / step.system.energy(state),
        "momentum": run.momentum_error(),
        "back": diagnostics.reversibility(step, state, 0.4),
    }


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("name", BODIES)
def test_energy_momentum_and_symmetry_are_exact(name, order):
    body = BODIES[name]
    out = measured(preprocessed(body, order), moving(body.inertia))
    assert out["converged"].all()
    assert np.abs(out["energy"]).max() < 1e-14  # floor 3e-15
    assert np.abs(out["momentum"]).max() == 0
    assert out["back"] < 1e-15


@jax.jit
def forms(step, state):
    """Of steps of 0.4 and 0.2: the state after them, L and the symplectic defect."""
    return jax.lax.map(lambda dt: there_and_back(step, state, dt)[:3], jnp.array([0.4, 0.2]))


@pytest.mark.long
@pytest.mark.parametrize("order", [4, 6])
def test_reduced_lie_poisson_structure_is_exact_and_the_canonical_form_is_not(order):
    """The map of Π alone is Poisson, DΠ̂₀Dᵀ = Π̂₁, to round-off; on T*SO(3) the defect is O(Δt^{order+1})."""
    body = BODIES["full"]
    Pi = np.asarray(body.inertia) @ [0.3, 0.6, 0.8]
    start = State(jnp.array([1.0, 0, 0, 0]), jnp.array(Pi))  # where Π₀ = π, and Π₁ = Λ₁ᵀπ
    after, L, defects = jax.tree.map(np.asarray, forms(preprocessed(body, order), start))
    back = np.array(rows(*after.q[0]))  # Λ₁ᵀ
    D = back @ (np.eye(3) + hat(Pi) @ L[0, :3, 3:])  # with δΛ₁ = δθ̂Λ₁
    assert np.abs(D @ hat(Pi) @ D.T - hat(back @ Pi)).max() < 8e-15  # floor 2e-15
    assert defects[0] > 1e-6
    assert np.log2(defects[0] / defects[1]) == pytest.approx(order + 1, abs=0.15)


@pytest.mark.parametrize("kind", ["s", "d"])
def test_the_series_of_the_clock_give_those_of_any_body_by_exact_arithmetic(kind):
    """Each coefficient as the fraction that it stands for, at two bodies of no special kind."""
    table = getattr(clock_coefficients, f"_{kind.upper()}")
    for C, H, (e1, e2, e3), found in clock_series.samples(2, 4):
        for m, terms in enumerate(table, 1):
            total = sum(
                fraction(number) * C**a * H**b * e1 ** (m + b - "sd".index(kind) - 2 * i - 3 * j) * e2**i * e3**j
                for (a, b), polynomial in terms.items()
                for (i, j), number in polynomial.items()
            )
            assert total / e3**m == found["sd".index(kind)][m - 1]


def fraction(number):
    """The fraction of denominator 45360 at most that is this float."""
    exact = Fraction(number).limit_denominator(45360)
    assert float(exact) == number
    return exact


@pytest.mark.long
@pytest.mark.parametrize("kind", ["s", "d"])
def test_the_series_of_the_clock_are_those_that_exact_arithmetic_gives(kind):
    table = getattr(clock_coefficients, f"_{kind.upper()}")
    cases = clock_series.samples(38, 4)  # 34 unknowns
    for m, terms in enumerate(table, 1):
        found = clock_series.series("sd".index(kind), m, cases)
        assert {powers: set(polynomial) for powers, polynomial in terms.items()} == {
            powers: set(polynomial) for powers, polynomial in found.items()
        }
        assert all(terms[p][e] == float(x) for p, polynomial in found.items() for e, x in polynomial.items())


@pytest.mark.long
@pytest.mark.parametrize("order", [10, 8, 6, 4])
def test_a_converged_step_is_near_the_exact_flow(order):
    """Of 3000 steps with |ΔtΩ| from 0.05 to 5 none that converged is off by 0.1 rad, and all below 0.5 converge."""
    rng, B = np.random.default_rng(0), 3000
    J, Omega = rng.uniform(0.01, 1, (B, 3)), rng.normal(size=(B, 3))
    J = (J.sum(1, keepdims=True) - J) / 2
    J[0], Omega[0] = [1.0, 2.0, 2.9], [2.0, 1.5, 1.0]  # once off by 0.65 rad, converged
    turn = np.append(np.linalg.norm(Omega[0]), 10 ** rng.uniform(-1.3, 0.7, B - 1))
    Omega *= (turn / np.linalg.norm(Omega, axis=1))[:, None]
    angle, converged = map(np.asarray, _from_exact(order, J, Omega))
    assert angle[converged].max() < 0.07  # observed: 0.016, 0.032, 0.002, 0.048 from order 10 to 4
    assert converged[turn < 0.5].all()
    assert not converged[0]


@functools.partial(jax.jit, static_argnums=0)
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def _from_exact(order, J, Omega):
    """The angle between the ends of a step by series and of the exact flow, and whether the former converged."""
    body = RigidBody(J)
    start = State(jnp.array([1.0, 0, 0, 0]), J * Omega)
    end, info = preprocessed(body, order)(start, 1.0)
    return so3.angle(end.q, li.schemes.exact(body)(start, 1.0)[0].q), info.converged


@pytest.mark.long
def test_the_canonical_defect_is_that_of_the_literature():
    """4.2e-7 at Δt = 0.1, order 4, is the size of the canonical defect."""
    body = BODIES["principal"]
    defect = jax.jit(diagnostics.symplectic_defect)(preprocessed(body, 4), moving(body.inertia), 0.1)
    assert 1e-8 < defect < 1e-6
