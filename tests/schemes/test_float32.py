"""Everything works in float32, at its own precision: no float64 creeps in, the flags mean the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import steps

import lieint_jax as li
from lieint_jax.groups import so3
from lieint_jax.maps import kappa_cayley, kappa_exponential, kappa_symplectic

EPS = np.finfo(np.float32).eps


@pytest.fixture(autouse=True)
def single():
    with jax.enable_x64(False):
        yield


SINGLE = np.float32
MOMENTS, START = np.array([1, 2, 3], SINGLE), li.State(np.array([1, 0, 0, 0], SINGLE), np.array([0.2, 0, 3], SINGLE))


def _body():
    return li.systems.rigid_body(MOMENTS)  # Ω = (0.2, 0, 1)


@jax.jit
def _measured(step, state, dt):
    """1000 steps, and their errors of energy, relative to it, and of the constraint."""
    run = li.Run.of(step, li.integrate(step, state, dt, 1000, save_every=10))
    return run.trajectory, run.energy_error() / step.system.energy(state), run.constraint_error()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Explicitly requested dtype float64:UserWarning")  # of JAX
def test_a_step_and_a_state_made_with_x64_run_in_float32_without_it():
    with jax.enable_x64(True):
        body = li.systems.rigid_body([1.0, 2.0, 3.0])
        step, state = li.schemes.so3_midpoint(body), body.state(angular_velocity=[0.2, 0.0, 1.0])
    run = li.integrate(step, state, 0.05, 4)
    assert run.state.q.dtype == run.t.dtype == SINGLE
    assert bool(run.info.converged.all())
    assert li.integrate(step, state, 0.05, save_at=[0.07], adjoint=li.ReversibleAdjoint()).state.p.dtype == SINGLE


@pytest.mark.long
@pytest.mark.parametrize("kappa", [kappa_cayley, kappa_exponential, kappa_symplectic], ids=lambda k: k.name)
def test_runs_in_single_precision_conserve_to_its_round_off(kappa):
    step = li.schemes.so3_midpoint(_body(), kappa)
    run, energy, constraint = _measured(step, START, 0.05)
    assert all(x.dtype == jnp.float32 for x in (run.t, *jax.tree.leaves(run.state), run.info.residual))
    assert np.all(run.info.converged)
    assert np.abs(energy).max() < 16 * EPS  # floor 4 eps
    assert np.abs(constraint).max() < 8 * EPS
    assert (np.asarray(run.state.p) == START.p).all()
    assert not _measured(step, START, 1.2 if kappa.name == "symplectic" else 40.0)[0].info.converged[1]


@pytest.mark.long
def test_the_form_in_single_precision_is_conserved_to_its_round_off():
    defect = jax.jit(li.diagnostics.symplectic_defect)
    defects = [
        defect(li.schemes.so3_midpoint(_body(), kappa), START, 0.4) for kappa in (kappa_symplectic, kappa_cayley)
    ]
    assert defects[0] < 16 * EPS
    assert defects[1] > 1e-3


@pytest.mark.long
def test_certificates_name_single_precision():
    state = jax.tree.map(jnp.asarray, START)
    certificate = li.diagnostics.certify(li.schemes.so3_midpoint(_body()), state, 0.2, 200)
    assert "float32" in str(certificate)
    assert certificate.symplectic_order == np.inf
    assert certificate.order == pytest.approx(2, abs=0.05)


def test_exp_and_log_in_single_precision_are_inverse():
    v = np.array([0.3, -0.5, 0.4], SINGLE)

    @jax.jit
    def there_and_back(v):
        return so3.log(so3.exp(v))

    slope = jax.jit(jax.jacfwd(there_and_back))
    for scale in (0.0, 1e-20, 1e-4, 1.0, 4.0):
        x = SINGLE(scale) * v
        np.testing.assert_allclose(there_and_back(x), x, rtol=0, atol=8 * EPS)
        assert np.isfinite(slope(x)).all()
    assert jax.eval_shape(so3.exp, v).dtype == jnp.float32
    q = jax.eval_shape(lambda v: so3.multiply(so3.exp(v), so3.identity), v)
    assert q.dtype == jnp.float32


def test_an_asteroid_in_si_units_does_not_overflow():
    """Moments of 1e20 kg m²: their cube is beyond float32, no intermediate is."""
    body = li.systems.rigid_body([3.0836e20, 3.235e20, 1e20])
    step = jax.jit(lambda v: li.schemes.so3_midpoint(body)(body.state([1, 0, 0, 0], angular_velocity=v), 1000.0))
    after, info = step(np.array([1e-6, 2e-6, -2e-5], SINGLE))
    assert info.converged
    assert np.isfinite(after.q).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "step", "state", "dt"), steps(), ids=[x[0] for x in steps()])
def test_a_step_of_singles_makes_no_doubles_where_doubles_are_on(name, step, state, dt):
    """By its trace alone, so for loops too, whose carries must keep their types."""
    with jax.enable_x64(True):
        numbers = (step, state, jnp.asarray(dt))
        single = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(jnp.shape(x), np.float32 if jnp.result_type(x) == np.float64 else x.dtype),
            numbers,
        )
        end, info = jax.eval_shape(lambda step, state, dt: step(state, dt), *single)
    assert {x.dtype for x in jax.tree.leaves((end, info.residual))} == {np.dtype(np.float32)}


@pytest.mark.long
def test_defaults_and_python_numbers_do_not_decide_the_type_where_doubles_are_on():
    """No leaf is a double but weakly typed ones, which a run of singles converts."""
    laws, bodies, at = li.torques, li.potentials, np.array([[1, 0, 0], [0, 1, 0]], SINGLE)
    with jax.enable_x64(True):
        one, q, rate = SINGLE(1), jnp.asarray(START.q), jnp.asarray(START.p)
        outer = bodies.outer_field(lambda x: x[0], at[0])
        made = {
            "state": _body().state(angular_velocity=rate),
            "integer": laws.viscous(1),
            "pd_trace": laws.pd_trace(0.3, 0.2),
            "pd_quaternion": laws.pd_quaternion(one, one),
            "pointing": laws.pointing(q, 0.3, 0.2),
            "sliding_mode": laws.sliding_mode(q, MOMENTS, one, one, layer=one),
            "wheel_pyramid": laws.wheel_pyramid(SINGLE(0.6)),
            "box_plates": laws.box_plates(MOMENTS),
            "point_masses": bodies.point_masses(one, at[0]),
            "uniform_field": bodies.uniform_field(at[0], at[0]),
            "outer_field": (outer.strengths, outer.points, outer.kept),
        }
        law = laws.pd_trace(0.3, 1)
        step = li.schemes.torqued_midpoint(li.systems.torqued_body(MOMENTS, law))
        end = jax.eval_shape(step, step.system.state(q, angular_velocity=rate), 0.1)[0]
    leaves = [(name, jnp.asarray(x)) for name, tree in made.items() for x in jax.tree.leaves(tree)]
    wide = {name for name, x in leaves if x.dtype == np.float64 and not x.weak_type}
    assert not wide
    assert end.p.dtype == SINGLE
