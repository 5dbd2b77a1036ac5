"""What cannot be trusted is flagged or refused: inputs that once gave wrong numbers, or NaN, with `converged=True`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import State, maps, schemes
from lieint_jax._numerics import vectors
from lieint_jax.core import Step, StepInfo

pytestmark = pytest.mark.long

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STATE = BODY.state(angular_velocity=[0.2, 0.1, 1.0])


FREE = {
    "cayley": lambda body: schemes.so3_midpoint(body, maps.kappa_cayley),
    "symplectic": schemes.so3_midpoint,
    "so3_explicit": schemes.so3_explicit,
    "exact": schemes.exact,
    "calibrated": schemes.calibrated,
    "preprocessed": lambda body: schemes.preprocessed(body, 6),
}


@pytest.mark.parametrize("scheme", FREE)
def test_a_narrower_inertia_is_widened_to_the_state(scheme):
    """float32 moments are the numbers that they are: same bits as from their float64 values."""
    moments = jnp.array([1.1, 2.3, 3.3], jnp.float32)
    state = State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.3, 0.7, -1.1]))
    narrow, wide = (FREE[scheme](li.systems.rigid_body(J)) for J in (moments, moments.astype(float)))
    step = jax.jit(lambda step, state: step.prepare(state, 0.1)(state, 0.1))
    (a, info), (b, _) = step(narrow, state), step(wide, state)
    assert info.converged
    np.testing.assert_array_equal(a.q, b.q)
    run = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))(narrow, state, 0.1, 500, save_every=500)
    assert run.info.converged.all()
    H = [float(narrow.system.energy(jax.tree.map(lambda leaf, i=i: leaf[i], run.state))) for i in (0, -1)]
    assert H[1] == pytest.approx(H[0], rel=1e-14, abs=0)  # floor 3e-15


@pytest.mark.quick
def test_energy_of_a_narrower_full_tensor_has_the_digits_of_the_state():
    J = jnp.array([[1.1, 0.1, 0.2], [0.1, 2.3, 0.0], [0.2, 0.0, 3.3]], jnp.float32)
    narrow, wide = (li.systems.rigid_body(J).energy(STATE) for J in (J, J.astype(float)))
    assert float(narrow) == pytest.approx(float(wide), rel=1e-15, abs=0)


STEPS = {
    **{name: make(BODY) for name, make in FREE.items()},
    "compose": schemes.compose(schemes.so3_midpoint(BODY), 4),
    "splitting": schemes.splitting(li.systems.heavy_top([1.0, 2.0, 3.0], [0.0, 0.0, 1.0])),
}


@pytest.mark.parametrize("name", STEPS)
def test_step_sizes_that_are_no_number_of_the_type(name):
    step = STEPS[name]
    with pytest.raises(ValueError, match="dt must be a real number"):
        step(STATE, [0.05])
    with pytest.raises(ValueError, match="dt must be below"):
        step(STATE, 10**400)
    for dt in (2**70, 1e308, float("nan")):
        assert not step(STATE, dt)[1].converged
        with pytest.raises(ValueError, match="dt"):
            li.integrate(step, STATE, dt, 2)


@li.pytree
class Careless(Step):
    """A step that reports convergence, whatever it returns."""

    system: Any
    last: jax.Array
    order: float = li.static(default=2)
    symmetric: bool = li.static(default=True)

    @property
    def name(self):
        return "careless"

    def advance(self, state, dt):
        return state._replace(p=state.p.at[1].set(self.last)), StepInfo(dt * 0, jnp.array(True))


@pytest.mark.parametrize("last", [jnp.nan, jnp.inf, -jnp.inf])
def test_no_step_reports_convergence_with_an_end_that_is_not_finite(last):
    """Whatever the scheme: the flag is set where all steps are wrapped."""
    assert Careless(BODY, jnp.array(1.0))(STATE, 0.1)[1].converged
    step = Careless(BODY, jnp.array(last))
    assert not step(STATE, 0.1)[1].converged
    assert not step.tangent(STATE, 0.1, jnp.eye(6))[1].converged


def _to_the_other(x, R):
    return -1 / jnp.sqrt(jnp.sum((x[0] - x[1]) ** 2))


def test_bodies_at_one_place_and_infinite_ends_are_flagged():
    """Two bodies fall on one another; one leaves the numbers of its type."""
    bodies = li.systems.rigid_bodies([1.0, 1.0], [[0.1] * 3] * 2, _to_the_other)
    step = schemes.splitting(bodies)
    resting = bodies.state([[-0.5, 0, 0], [0.5, 0, 0]])
    leaving = resting._replace(p=resting.p.at[0, 0].set(1e308))
    taken = jax.jit(lambda state, dt: step(state, dt))
    for state, dt in ((resting, 1.0), (leaving, 10.0)):
        end, info = taken(state, dt)
        assert not all(bool(jnp.isfinite(x).all()) for x in (end.q, end.p))
        assert not info.converged
    assert taken(resting, 0.1)[1].converged


def log_well(Gamma):
    return jnp.log(Gamma[2] - 0.2)


UNDEFINED = {
    "splitting": schemes.splitting,
    "nystrom": lambda top: schemes.nystrom(top, 6),
    "compose": lambda top: schemes.compose(schemes.splitting(top), 4),
    "top_energy_momentum": schemes.top_energy_momentum,
    "gauss": schemes.gauss,
    "extrapolate": schemes.extrapolate,
}


@pytest.mark.parametrize("scheme", UNDEFINED)
def test_no_step_ends_where_the_potential_is_not_defined(scheme):
    """log(Γ₃ − 0.2) has a slope where Γ₃ < 0.2, and no value."""
    top = li.systems.potential_top([1.0, 2.0, 2.5], log_well)
    step = UNDEFINED[scheme](top)
    run = li.integrate(step, step.start(top.state(angular_velocity=[2.0, 0, 0.3])), 0.05, 20)
    defined = np.isfinite(jax.vmap(top.potential_energy)(run.state.q))
    assert not defined.all()
    assert not np.any(np.asarray(run.info.converged) & ~defined)


@pytest.mark.parametrize("scheme", ["cayley", "symplectic", "so3_explicit", "exact"])
def test_a_full_tensor_of_a_needle_is_flagged(scheme):
    """Energy is kept to 1e-10 wherever a step converged: 2000 turned rods and needles each of 1 : 1e3 … 1e10."""
    rng, B = np.random.default_rng(0), 2000
    q = rng.normal(size=(B, 4))
    R = jax.vmap(li.groups.so3.to_matrix)(jnp.array(q / np.linalg.norm(q, axis=1, keepdims=True)))
    turn = rng.normal(size=(B, 3)) * np.exp(rng.uniform(-4, -1, (B, 1)))

    @jax.jit
    @jax.vmap
    def change(R, moments, turn):
        body = li.systems.RigidBody(R @ jnp.diag(moments) @ R.T)
        state = State(jnp.array([1.0, 0, 0, 0]), body.inertia @ turn)
        after, info = FREE[scheme](body)(state, 0.5)
        return body.energy(after) / body.energy(state) - 1, info.converged

    for ratio, some in ((1e3, True), (3e4, True), (1e6, False), (1e10, False)):
        thick = np.where(rng.uniform(size=B) < 0.5, 1.0, 1.5 / ratio)
        error, converged = map(np.asarray, change(R, np.stack([np.full(B, 1 / ratio), thick, np.ones(B)], 1), turn))
        assert np.abs(error[converged]).max(initial=0) < 1e-10  # floor 3e-11
        assert converged.any() == some
    needle = li.systems.rigid_body(np.asarray(R[0] @ jnp.diag(jnp.array([1.0, 1e6, 1e6])) @ R[0].T))
    with pytest.raises(ValueError, match=r"give principal moments \(3,\)"):
        li.integrate(FREE[scheme](needle), needle.state(angular_velocity=[0.1, 0.1, 0.1]), 0.01, 1)


def test_exact_is_flagged_when_no_digits_are_left():
    """The error of q is some eps |Ω| dt: 7e-15, 7e-10, 9e-5, 1e-2, 0.4 for these."""
    body = li.systems.rigid_body([1.0, 1.0, 2.0])
    state = body.state(angular_velocity=[0.2, 0.1, 1.0])
    sizes = jnp.array([1e2, 1e8, 1e12, 1e15, 1e17, -1e17])
    converged = jax.vmap(lambda dt: schemes.exact(body)(state, dt)[1].converged)(sizes)
    assert converged.tolist() == [True, True, False, False, False, False]
    q = jnp.array([0.11147991333969803, -0.911808763296381, 0.015036712434796751, -0.3949061982000927])
    p = jnp.array([0.2970454372468422, -0.04988043605843836, 0.30964415274753095])
    assert not schemes.exact(body)(State(q, p), 1e300)[1].converged  # NaN


def test_exact_is_flagged_when_it_passed_the_separatrix_too_closely():
    """1e-10 from the separatrix, each passage of the middle axis loses digits: rounding the state decides the rest."""
    step, later = schemes.exact(BODY), jnp.linspace(0, 300, 60)
    state = BODY.state(body_momentum=[1.0, 1.0, 3**0.5 * (1 + 1e-10)])
    nearby = state._replace(p=state.p * (1 + 4e-16 * jnp.array([1.0, -1.0, 1.0])))
    both = jax.jit(jax.vmap(lambda dt: (step(state, dt), step(nearby, dt)[0].q)))
    ((early, at_first), others), ((late, at_last), shifted) = both(later / 30), both(1e5 + later)
    assert at_first.converged.all()
    assert not at_last.converged.any()
    assert jnp.abs(early.q - others).max() < 1e-13
    assert jnp.abs(late.q - shifted).max() > 1e-5


def test_a_jump_over_a_fold_is_flagged():
    """Two roots past the end of the branch from dt = 0, both with det F′ > 0."""
    step = schemes.sphere_midpoint(li.systems.pendulum(1.0, 1.0), normalized=True)
    q = jnp.array([0.17885378429657858, -0.030030534896956382, 0.9834173722516636568])
    q = q.at[2].set(0.9834172516366568)
    p = jnp.array([-0.03945539383141044, -0.03153286465004606, 0.006223812392326269])
    assert not step(State(q, p), 2.4257573623134023)[1].converged
    assert step(State(q, p), 1.2)[1].converged
    body = li.systems.rigid_body([0.1292207167132653, 0.37077928328673465, 0.5])
    state = State(
        jnp.array([1.0, 0, 0, 0]), jnp.array([-0.06057743431492972, -0.3154155694002977, 0.11892673725310745])
    )
    for iterations in (8, 40):
        step = schemes.so3_midpoint(body, maps.kappa_cayley, iterations)
        assert not step(state, 5.82877592143546)[1].converged
        with pytest.raises(ValueError, match=r"\|Δt Ω\| = 5.83(?!.*more iterations)"):
            step.check(state, 5.82877592143546)


KAPPAS = {
    "cayley": maps.kappa_cayley,
    "exponential": maps.kappa_exponential,
    "user": maps.as_kappa(lambda x: 1 + x / 2),
}


@pytest.mark.parametrize("name", KAPPAS)
def test_every_converged_root_is_that_of_the_branch_from_zero(name):
    """Against a homotopy in dt of 600 steps, with |dt Ω| up to 7: most solves are flagged there, and none is wrong."""
    kappa, B, rng = KAPPAS[name], 4000, np.random.default_rng(0)
    moments = rng.uniform(0.01, 1, (B, 3))
    J = (moments.sum(1, keepdims=True) - moments) / (2 * moments.sum(1, keepdims=True))
    turn = rng.normal(size=(B, 3))
    turn *= np.exp(rng.uniform(np.log(0.3), np.log(7), (B, 1))) / np.linalg.norm(turn, axis=1, keepdims=True)

    def step(J, turn):
        made = schemes.SO3Midpoint(li.systems.RigidBody(J), kappa, 40)
        after, info = made(State(jnp.array([1.0, 0, 0, 0]), J * turn), 1.0)
        return after.q, info.converged

    def branch(J, turn):
        def residual(y, s):
            """Of (3.4), J y + κ y × J y = ½Δt Π at a fraction s of Δt, for h = κy."""
            return J * y + kappa(4 * y @ y) * jnp.cross(y, J * y) - s * J * turn / 2

        def follow(y, s):
            for _ in range(3):  # corrections by Newton
                y = y - jnp.stack(vectors.matrix(jax.jacfwd(residual)(y, s)).solve(residual(y, s)))
            return y, None

        y, _ = jax.lax.scan(follow, jnp.zeros(3), jnp.linspace(0, 1, 601)[1:])
        h = kappa(4 * y @ y) * y
        return li.groups.so3.cayley_increment(jnp.array([1.0, 0, 0, 0]), h)

    q, converged = map(np.asarray, jax.jit(jax.vmap(step))(J, turn))
    wrong = converged & ~(np.abs(q - jax.jit(jax.vmap(branch))(J, turn)).max(1) < 1e-8)
    assert not wrong.any()
    assert converged.sum() > B / 2
    assert converged[np.linalg.norm(turn, axis=1) < 1.2].all()


def test_steps_can_be_constructed_inside_jit():
    """κ by a closure; the drift of a potential on SE(2), whose metric is then a tracer."""
    made = jax.jit(lambda J: schemes.so3_midpoint(li.systems.rigid_body(J), lambda x: 1 + 0.3 * x)(STATE, 0.05)[0].q)
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    eager = schemes.so3_midpoint(body, lambda x: 1 + 0.3 * x)(STATE, 0.05)[0].q
    np.testing.assert_allclose(made(body.inertia), eager, rtol=0, atol=2e-16)
    with pytest.raises(ValueError, match=r"κ\(0\) must be the number 1"):
        jax.jit(lambda J: schemes.so3_midpoint(li.systems.rigid_body(J), lambda x: 1.1 + x)(STATE, 0.05))(body.inertia)

    group = li.groups.special_euclidean(2)
    metric = jnp.array([1.0, 2.0, 3.0])
    state = State(jnp.eye(3), jnp.array([0.3, 0.2, 0.1]))

    def drifted(metric):
        system = li.systems.group_potential(group, metric, lambda q: 0.1 * q[0, 2])
        return schemes.splitting(system)(state, 0.1)[0].q

    np.testing.assert_allclose(jax.jit(drifted)(metric), drifted(metric), rtol=0, atol=1e-15)
    assert jnp.isfinite(jax.grad(lambda m: drifted(m)[0, 2])(metric)).all()


@pytest.mark.quick
def test_kirchhoff_can_be_constructed_inside_jit_without_arguments_only():
    metric = jax.jit(lambda: li.systems.kirchhoff().metric)()
    np.testing.assert_array_equal(metric, li.systems.kirchhoff().metric)
    with pytest.raises(ValueError, match="call kirchhoff outside jit"):
        jax.jit(lambda axes: li.systems.kirchhoff(axes).metric)(jnp.array([3.0, 2.0, 1.0]))
