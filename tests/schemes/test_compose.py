"""Compositions: every order condition to 38 digits, measured orders, every invariant of the base step kept."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from repeated import after
from small_steps import Oscillators

import lieint_jax as li
from lieint_jax import _discover, diagnostics
from lieint_jax.core import State, Step, StepInfo
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_symplectic
from lieint_jax.schemes import calibrated, compose, so3_explicit, so3_midpoint

METHODS = _discover.modules_with("examples", li.schemes)["compose"].METHODS
BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = jax.jit(BODY.state)(np.array([1.0, 2, -1, 0.5]) / 2.5, angular_velocity=[0.3, 0.6, 0.8])
SYMPLECTIC, CAYLEY = (so3_midpoint(BODY, kappa, iterations=5) for kappa in (kappa_symplectic, kappa_cayley))
defect = jax.jit(diagnostics.symplectic_defect)


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
def test_the_table_of_commuting_methods_lists_their_stages_and_errors(order, stages, constant):
    """The stages and error constants that the docstring tabulates, and that each beats every general one."""

    def cost(gammas):
        return len(gammas) * abs(sum(np.array(gammas) ** (order + 1))) ** (1 / order)

    gammas = METHODS[f"commuting_{order}"].gammas
    assert len(gammas) == stages
    assert cost(gammas) == pytest.approx(constant, abs=0.005)
    assert all(cost(m.gammas) > cost(gammas) for m in METHODS.values() if m.order == order and not m.counts)
    assert np.abs(np.cumsum(gammas)).max() < 1.1  # the sub-steps do not stray


@pytest.mark.long
def test_steps_of_the_symplectic_scheme_commute_and_others_do_not():
    for step, bound in ((SYMPLECTIC, (0, 1e-15)), (CAYLEY, (1e-5, 1))):
        ends = [np.asarray(after(step, after(step, STATE, a, 1)[0], b, 1)[0].q) for a, b in ((0.5, 0.2), (0.2, 0.5))]
        assert bound[0] <= np.abs(ends[0] - ends[1]).max() < bound[1]
        assert step.commuting == (bound[0] == 0)
    for make in (so3_explicit, calibrated, li.schemes.exact):  # the same scheme, and the flow itself
        assert make(BODY).commuting
    assert compose(SYMPLECTIC, 4).commuting
    assert not compose(CAYLEY, 4).commuting


@pytest.mark.long
def test_suzuki_s_composition_has_a_smaller_error_than_the_triple_jump():
    """70 times smaller on the symplectic step, as the power sums say: 5.29 / 0.0744 = 71."""
    ends = [after(compose(SYMPLECTIC, 4, method), STATE, 0.1, 32)[0].q for method in ("triple_jump", "suzuki")]
    exact = jax.jit(lambda: diagnostics.flow(BODY, STATE, 3.2, 32).q)()
    jump, suzuki = (np.abs(q - exact).max() for q in ends)
    assert jump / suzuki == pytest.approx(71, rel=0.05)


@pytest.mark.long
def test_the_defect_of_a_base_step_that_is_not_symplectic_stays():
    """Composing raises the order of the defect with that of the scheme; it does not make it vanish."""
    step = compose(CAYLEY, 4)
    coarse, fine = (float(defect(step, STATE, dt)) for dt in (0.4, 0.2))
    assert coarse > 1e-6
    assert np.log2(coarse / fine) == pytest.approx(5, abs=0.3)


@pytest.mark.long
def test_a_thousand_bodies_to_the_accuracy_that_is_claimed():
    """Order 8, Δt = 0.25, t = 10: 2.5e-9 by Kahan & Li's 17 stages; the 19 commuting ones do better."""
    rng = np.random.default_rng(0)
    Omega = rng.normal(size=(200, 3))
    Omega *= rng.uniform(size=(200, 1)) ** (1 / 3) / np.linalg.norm(Omega, axis=1, keepdims=True)

    @jax.jit
    def run(steps):
        """Of both steps: the largest errors of the attitude, and whether all converged."""
        states = jax.vmap(lambda v: BODY.state(angular_velocity=v))(Omega)
        true = jax.vmap(lambda z: diagnostics.flow(BODY, z, 10.0, 40))(states)
        runs = [jax.vmap(lambda z, step=step: li.integrate(step, z, 0.25, 40, save_every=40))(states) for step in steps]
        worst = [jax.vmap(so3.angle)(r.state.q[:, -1], true.q).max() for r in runs]
        return worst, [r.info.converged.all() for r in runs]

    (ours, published), converged = run([compose(SYMPLECTIC, 8, m) for m in ("commuting_8", "kahan_li_8")])
    assert all(converged)
    assert ours < published / 5
    assert ours < 2.5e-9


@pytest.mark.long
def test_a_sub_step_past_the_branch_is_flagged():
    step = compose(SYMPLECTIC, 8)
    assert after(step, STATE, 2.0, 1)[1].converged  # sub-steps are small: 0.39 of it at most
    assert not after(step, STATE, 4.0, 1)[1].converged
    with pytest.raises(ValueError, match=r"sub-steps of up to 0.393 dt; so3_midpoint"):
        li.integrate(step, STATE, 4.0, 1)


@li.pytree
class Lagging(Step):
    """A step that kicks by the q before: it carries q from one sub-step to the next in `extra`."""

    system: Oscillators

    order, symmetric, name = 2, True, "lagging"

    def advance(self, state, dt):
        p = state.p - dt * self.system.stiffness * state.extra["before"]
        return state._replace(q=state.q + dt * p, p=p, extra={"before": state.q}), StepInfo.empty(p)


def test_a_tangent_vector_goes_through_what_sub_steps_carry_from_one_to_the_next():
    """The step is linear, so its differences are its derivative."""
    step = compose(Lagging(Oscillators(jnp.array(1.3))), 4, "triple_jump")
    start, T = State(jnp.eye(3), jnp.zeros((3, 3)), extra={"before": jnp.eye(3)}), np.eye(18)[:, [0, 9]]
    space = step.system.phase_space

    @jax.jit
    @jax.vmap
    def displacement(delta):
        return space.displacement(start, step(space.perturb(start, delta), 0.4)[0])

    ends = np.asarray(displacement(np.array([T[:, 0], T[:, 1], 0 * T[:, 0]])))
    tangent = jax.jit(lambda: step.tangent(start, 0.4, T)[2])()
    np.testing.assert_allclose(tangent.T, ends[:2] - ends[2], rtol=0, atol=1e-15)
