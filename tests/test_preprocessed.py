"""Preprocessed inertia: the order rises; energy, momentum and the reduced structure stay; the form does not."""

import functools

import clock_series
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import moving, rows, turned
from linearised import there_and_back
from paper import hat

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.diagnostics.order import distance
from lieint_jax.groups import so3
from lieint_jax.integrate import steps
from lieint_jax.schemes import _clock_series, preprocessed, so3_midpoint
from lieint_jax.systems import RigidBody
from lieint_jax.types import State

BODIES = {
    "principal": RigidBody(jnp.array([1.0, 2.0, 3.0])),
    "full": RigidBody(turned([1.0, 2.0, 3.0])),
    "large": RigidBody(jnp.array([1e20, 2e20, 2.5e20])),
}


@jax.jit
def measured(step, state):
    """Angles from the exact flow at t = 3.2 after 8 and 16 steps; what 500 steps of .4 keep; a step and back."""
    body = step.system
    base = so3_midpoint(body)
    end = diagnostics.flow(body, state, 3.2, 16)

    def walk(case):
        h, ahead, total = case
        return jax.lax.fori_loop(0, total, lambda k, z: step(z, jnp.where(k < ahead, h, -h))[0], state)

    n = jnp.array([8, 16, 1])
    ends = jax.lax.map(walk, (jnp.array([0.4, 0.2, 0.4]), n, jnp.array([8, 16, 2])))  # the last goes back again
    back = jax.tree.map(lambda x: x[2], ends)
    run = li.integrate(step, state, 0.4, 500)
    return {
        "errors": jax.vmap(so3.angle, (0, None))(ends.q[:2], end.q),
        "error of order 2": so3.angle(steps(base, state, 0.2, 16)[0].q, end.q),
        "converged": run.info.converged,
        "energy": diagnostics.energy_error(body, run) / body.energy(state),
        "momentum": diagnostics.momentum_error(body, run),
        "back": distance(back, state),
    }


@functools.cache
def of(name, order):
    body = BODIES[name]
    return measured(preprocessed(body, order), moving(body.inertia))


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 6, 8, 10])
@pytest.mark.parametrize("name", BODIES)
def test_order_against_the_exact_flow(name, order):
    out = of(name, order)
    assert np.log2(out["errors"][0] / out["errors"][1]) == pytest.approx(order, abs=0.15 if order < 8 else 0.4)
    assert out["errors"][1] < 1e-2 * out["error of order 2"]


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("name", BODIES)
def test_energy_momentum_and_symmetry_are_exact(name, order):
    out = of(name, order)
    assert out["converged"].all()
    assert np.abs(out["energy"]).max() < 1e-14  # floor 3e-15
    assert np.abs(out["momentum"]).max() == 0
    assert out["back"] < 1e-15


@jax.jit
def forms(step, state):
    """Of steps of .4 and .2: the state after them, L and the symplectic defect."""
    return jax.lax.map(lambda dt: there_and_back(step, state, dt)[:3], jnp.array([0.4, 0.2]))


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["s", "d"])
def test_the_series_of_the_clock_are_those_that_exact_arithmetic_gives(kind):
    table = getattr(_clock_series, f"_{kind.upper()}")
    cases = clock_series.samples(38, 4)  # 34 unknowns
    for m, terms in enumerate(table, 1):
        found = clock_series.series("sd".index(kind), m, cases)
        assert {powers: set(polynomial) for powers, polynomial in terms.items()} == {
            powers: set(polynomial) for powers, polynomial in found.items()
        }
        assert all(terms[p][e] == float(x) for p, polynomial in found.items() for e, x in polynomial.items())


def test_the_literature_s_number():
    """4.2e-7 at Δt = .1, order 4, is the size of the canonical defect."""
    body = BODIES["principal"]
    defect = jax.jit(diagnostics.symplectic_defect)(preprocessed(body, 4), moving(body.inertia), 0.1)
    assert 1e-8 < defect < 1e-6


def test_derivatives_and_batches():
    J = BODIES["principal"].inertia
    state = moving(J)

    def end(J, dt):
        return preprocessed(RigidBody(J), 6)(state, dt)[0].q[1]

    by_J, by_dt = jax.jit(jax.grad(end, argnums=(0, 1)))(J, 0.3)
    h = 1e-6
    changes = h * np.array([*np.eye(4), *-np.eye(4)])
    ends = jax.jit(jax.vmap(end))(np.asarray(J) + changes[:, :3], 0.3 + changes[:, 3])
    assert ends.shape == (8,)
    for slope, plus, minus in zip([*by_J, by_dt], ends[:4], ends[4:], strict=True):
        assert slope == pytest.approx(float(plus - minus) / (2 * h), rel=1e-7)


def test_bad_arguments():
    body = BODIES["principal"]
    with pytest.raises(ValueError, match="order must be 4, 6, 8 or 10, got 12"):
        preprocessed(body, 12)
    with pytest.raises(ValueError, match="free rigid bodies"):
        preprocessed("top", 4)
    for iterations in (0, -1, 2.5):
        with pytest.raises(ValueError, match="iterations must be an integer ≥ 1"):
            preprocessed(body, 4, iterations)
    with pytest.raises(ValueError, match=r"preprocessed\[4\] takes the step of another inertia; .*does not converge"):
        li.integrate(preprocessed(body, 4), moving(body.inertia), 3.0, 1)
