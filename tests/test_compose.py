"""Compositions: every order condition to 38 digits, measured orders, every invariant of the base step kept."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import diagnostics
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_symplectic
from lieint_jax.schemes import compose, so3_midpoint
from lieint_jax.schemes._compositions import METHODS
from lieint_jax.types import Step

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = BODY.state(so3.normalise(jnp.array([1.0, 2, -1, 0.5])), angular_velocity=[0.3, 0.6, 0.8])
SYMPLECTIC, CAYLEY = (so3_midpoint(BODY, kappa, iterations=5) for kappa in (kappa_symplectic, kappa_cayley))
END = diagnostics.flow(BODY, STATE, 3.2, 16)


def words(weight):
    """Words in letters 1, 3, 5, … (the Y's) of weight at most `weight`: a basis of the free algebra, truncated."""
    found, last = [()], [()]
    while last:
        last = [(*w, k) for w in last for k in range(1, weight + 1, 2) if sum(w) + k <= weight]
        found += last
    return found


def product(gammas, weight):
    """Coefficients of exp(Σ γ₁ᵏY_k) … exp(Σ γ_sᵏY_k) on every word."""
    coefficients = {w: mpmath.mpf(not w) for w in words(weight)}
    for g in gammas:
        factor = {w: g ** sum(w) / mpmath.factorial(len(w)) for w in coefficients}
        coefficients = {
            w: mpmath.fsum(coefficients[w[:i]] * factor[w[i:]] for i in range(len(w) + 1)) for w in coefficients
        }
    return coefficients


def digits(method):
    values = [mpmath.mpf(v) for v in method.values]
    if not method.counts:
        return [*values, *values[-2::-1]]
    return [v for v, count in zip(values, method.counts, strict=True) for _ in range(count)]


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if not method.counts])
def test_order_conditions_of_published_methods_to_38_digits(name):
    """The product of exponentials is exp(Y₁) up to the order, and not beyond."""
    method = METHODS[name]
    with mpmath.workdps(50):
        found = product(digits(method), method.order + 1)
        residual = {w: abs(c - (1 / mpmath.factorial(len(w)) if set(w) == {1} else 0)) for w, c in found.items() if w}
        assert max(r for w, r in residual.items() if sum(w) <= method.order) < mpmath.mpf(10) ** -38
        assert max(residual.values()) > 1e-8


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.counts])
def test_power_sums_of_commuting_methods_to_38_digits(name):
    method = METHODS[name]
    with mpmath.workdps(50):
        gammas = digits(method)
        for power in range(1, method.order, 2):
            assert abs(mpmath.fsum(g**power for g in gammas) - (power == 1)) < mpmath.mpf(10) ** -38
        assert abs(mpmath.fsum(g ** (method.order + 1) for g in gammas)) > 1e-7


@pytest.mark.parametrize(("order", "stages", "constant"), [(4, 9, 2.12), (6, 13, 3.41), (8, 19, 4.67), (10, 23, 6.11)])
def test_table_of_commuting_methods(order, stages, constant):
    """The stages and error constants that the docstring tabulates, and that each beats every general one."""

    def cost(gammas):
        return len(gammas) * abs(sum(np.array(gammas) ** (order + 1))) ** (1 / order)

    gammas = METHODS[f"commuting_{order}"].gammas
    assert len(gammas) == stages
    assert cost(gammas) == pytest.approx(constant, abs=0.005)
    assert all(cost(m.gammas) > cost(gammas) for m in METHODS.values() if m.order == order and not m.counts)
    assert np.abs(np.cumsum(gammas)).max() < 1.1  # the sub-steps do not stray


def test_steps_of_the_symplectic_scheme_commute_and_others_do_not():
    for step, bound in ((SYMPLECTIC, (0, 1e-15)), (CAYLEY, (1e-5, 1))):
        ends = [step(step(STATE, a)[0], b)[0].q for a, b in ((0.5, 0.2), (0.2, 0.5))]
        assert bound[0] <= np.abs(ends[0] - ends[1]).max() < bound[1]
        assert step.commuting == (bound[0] == 0)


def measured_order(step, counts):
    runs = [li.integrate(step, STATE, 3.2 / n, n, n) for n in counts]
    errors = [float(np.abs(run.state.q[-1] - END.q).max()) for run in runs]
    return np.log2(errors[0] / errors[1]), errors


@pytest.mark.parametrize("order", [4, 6, 8, 10])
def test_commuting_orders(order):
    rate, errors = measured_order(compose(SYMPLECTIC, order), (4, 8))
    assert rate == pytest.approx(order, abs=0.35)
    assert errors[1] > 1e-12  # above the floor, so that the rate means something


@pytest.mark.parametrize(
    ("order", "method"),
    [(4, "triple_jump"), (4, "suzuki"), (6, "yoshida_6"), (6, "kahan_li_6"), (8, "suzuki_umeno_8"), (8, "kahan_li_8")],
)
def test_published_orders_on_steps_that_do_not_commute(order, method):
    rate, _ = measured_order(compose(CAYLEY, order, method), (8, 16))
    assert rate == pytest.approx(order, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("order", [10])
def test_published_order_10(order):
    rate, errors = measured_order(compose(CAYLEY, order), (3, 6))
    assert rate == pytest.approx(order, abs=1)
    assert errors[1] > 1e-13


def test_suzuki_is_far_better_than_the_triple_jump():
    """70 times smaller on the symplectic step, as the power sums say: 5.29 / .0744 = 71."""
    jump, suzuki = (measured_order(compose(SYMPLECTIC, 4, m), (16, 32))[1][1] for m in ("triple_jump", "suzuki"))
    assert jump / suzuki == pytest.approx(71, rel=0.05)


@pytest.mark.parametrize("order", [4, 6, 8, 10])
def test_every_invariant_of_the_base_step_is_kept(order):
    step = compose(SYMPLECTIC, order)
    run = li.integrate(step, STATE, 0.4, 300)
    assert run.info.converged.all()
    assert np.abs(diagnostics.energy_error(BODY, run)).max() < 2e-14  # floor 4e-15: 300 × 23 base steps
    assert np.abs(diagnostics.momentum_error(BODY, run)).max() == 0
    assert np.abs(diagnostics.constraint_error(BODY, run)).max() < 2e-15
    assert diagnostics.symplectic_defect(step, STATE, 0.4) < 8e-15  # floor 2e-15
    assert diagnostics.reversibility(step, STATE, 0.4) < 4e-15  # floor 8e-16


def test_the_defect_of_a_base_step_that_is_not_symplectic_stays():
    """Composing raises the order of the defect with that of the scheme; it does not make it vanish."""
    step = compose(CAYLEY, 4)
    coarse, fine = (float(diagnostics.symplectic_defect(step, STATE, dt)) for dt in (0.4, 0.2))
    assert coarse > 1e-6
    assert np.log2(coarse / fine) == pytest.approx(5, abs=0.3)


def test_a_thousand_bodies_to_the_accuracy_that_is_claimed():
    """Order 8, Δt = .25, t = 10: 2.5e-9 by Kahan & Li's 17 stages; the 19 commuting ones do better."""
    rng = np.random.default_rng(0)
    Omega = rng.normal(size=(200, 3))
    Omega *= rng.uniform(size=(200, 1)) ** (1 / 3) / np.linalg.norm(Omega, axis=1, keepdims=True)
    states = jax.vmap(lambda v: BODY.state(angular_velocity=v))(jnp.array(Omega))
    true = jax.jit(jax.vmap(lambda z: diagnostics.flow(BODY, z, 10.0, 40)))(states)

    def worst(step):
        run = jax.jit(jax.vmap(lambda z: li.integrate(step, z, 0.25, 40, 40)))(states)
        assert run.info.converged.all()
        return float(jax.vmap(so3.angle)(run.state.q[:, -1], true.q).max())

    ours, published = (worst(compose(SYMPLECTIC, 8, m)) for m in ("commuting_8", "kahan_li_8"))
    assert ours < published / 5
    assert ours < 2.5e-9


class Skew(Step):
    """A step that is not symmetric."""

    order, symmetric, name = 2, False, "skew"

    def __call__(self, state, dt):
        raise NotImplementedError


def test_bad_arguments():
    for call, message in (
        (lambda: compose(Skew(), 4), "symmetric step of order 2, got 'skew'"),
        (lambda: compose(compose(SYMPLECTIC, 4), 4), "symmetric step of order 2"),
        (lambda: compose("step", 4), "symmetric step of order 2"),
        (lambda: compose(SYMPLECTIC, 5), "order must be one of 4, 6, 8, 10, got 5"),
        (lambda: compose(SYMPLECTIC, 4, "kahan_li_6"), "triple_jump, suzuki, commuting_4"),
        (lambda: compose(CAYLEY, 4, "commuting_4"), "method must be one of triple_jump, suzuki for so3_midpoint"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_sub_step_past_the_branch_says_so():
    step = compose(SYMPLECTIC, 8)
    assert step(STATE, 2.0)[1].converged  # sub-steps are small: .39 of it at most
    assert not step(STATE, 4.0)[1].converged
    with pytest.raises(ValueError, match=r"sub-steps up to -0\.393 dt; so3_midpoint"):
        li.integrate(step, STATE, 4.0, 1)


def test_derivatives_go_through():
    def end(J):
        return compose(so3_midpoint(li.systems.RigidBody(J)), 6)(STATE, 0.5)[0].q[1]

    forward, reverse = jax.jit(jax.jacfwd(end))(BODY.inertia), jax.jit(jax.grad(end))(BODY.inertia)
    np.testing.assert_allclose(forward, reverse, atol=4e-15)
    h = 1e-5
    for k in range(3):
        step = h * np.eye(3)[k]
        assert forward[k] == pytest.approx(
            float(end(BODY.inertia + step) - end(BODY.inertia - step)) / (2 * h), rel=1e-7
        )
