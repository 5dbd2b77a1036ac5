"""Nyström splittings of one body in a potential, given or of time: order, form, γ·π, derivatives, and the drift."""

import jax
import jax.numpy as jnp
import pytest
import slopes
import splitting_series

import lieint_jax as li
from lieint_jax import _discover, diagnostics, orbits, schemes, systems
from lieint_jax.groups import so3

TOP = systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])
START = TOP.state(so3.exp(jnp.array([0.3, 0.2, 0.1])), angular_velocity=[0.3, 0.2, 1.0])  # |Ω| = 1.06
SATELLITE = systems.gravity_gradient([1.0, 2.0, 2.5], orbits.kepler(1.0, 1.0, 0.3))
RELEASED = SATELLITE.state(so3.exp(jnp.array([0.3, 0.2, 0.1])), angular_velocity=[0.3, 0.2, 1.0], t=0.5, work=0.0)
CASES = {"top": (TOP, START), "satellite": (SATELLITE, RELEASED)}
SIZES = {4: 0.08, 6: 0.2}


KEPT = {  # the powers of Δt to which a method is exact, for each power of ε from 1 on
    ("nystrom", 4): (4, 4, 4),
    ("nystrom", 6): (6, 6, 6),
    ("kepler_splitting", 2): (2,),
    ("kepler_splitting", (8, 4)): (8, 4),
    ("kepler_splitting", (8, 6, 4)): (8, 6, 4),
}


@pytest.mark.parametrize(("scheme", "order"), KEPT, ids=str)
def test_the_coefficients_satisfy_every_order_condition_to_their_last_digit(scheme, order):
    """In 30 digits. The errors are 1.2e-16 at most, those of the next power 6e-8 and more."""
    kept = KEPT[scheme, order]
    method = _discover.modules_with("examples", schemes)[scheme].METHODS[order]
    found = splitting_series.errors(method, max(kept) + 1, len(kept))
    assert found[:, 0].max() < 1e-15  # the drifts add up to Δt
    for k, power in enumerate(kept, 1):
        assert found[: power + 1, k].max() < 1e-15
        assert found[power + 1, k] > 1e-9


@jax.jit
def measured(step, state, dt):
    """The form after a step of 0.5; a step and back; H and momentum after 16 half steps."""
    run = li.Run.of(step, li.integrate(step, state, dt / 2, 16, save_every=16))
    defect = diagnostics.symplectic_defect(step, state, 0.5)
    balance = run.energy_error()[-1] / step.system.energy(state)
    kept = run.momentum_error()
    return defect, diagnostics.reversibility(step, state, dt), balance, kept


@pytest.mark.long
@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("name", CASES)
def test_nystrom_steps_conserve_form_and_momentum(name, order):
    """γ·π to the last bit; the form, at |ΔtΩ| = 0.5, to 2e-11 by order 4, whose drifts are longer, 4e-15 by order 6."""
    system, state = CASES[name]
    defect, back, balance, kept = measured(schemes.nystrom(system, order), state, SIZES[order])
    assert defect < {4: 1e-10, 6: 2e-14}[order]
    assert back < 2e-15
    assert abs(balance) < 1e-9
    assert jnp.abs(kept).max(initial=0) < 4e-15


@pytest.mark.long
def test_nystrom_beats_compositions_at_equal_numbers_of_kicks():
    """40 steps of 14 kicks against 30 of 19: observed 4.1e-9 and 1.6e-6 rad at t = 20."""
    exact = diagnostics.flow(TOP, START, 20.0, 200)
    composed = schemes.compose(schemes.splitting(TOP), 8)
    ends = [
        li.integrate(s, START, 20 / n, n, save_every=n).state.q[-1]
        for s, n in ((schemes.nystrom(TOP, 6), 40), (composed, 30))
    ]
    errors = [float(so3.angle(q, exact.q)) for q in ends]
    assert errors[0] < errors[1] / 20


@pytest.mark.long
def test_the_drift_decides_what_becomes_of_the_form():
    """The default drift keeps it to round-off up to |ΔtΩ| = 0.6, the exact one at any step, order 6 never."""
    defect = jax.jit(diagnostics.symplectic_defect)
    free = TOP.free
    drifts = {name: make(free) for name, make in (("exact", schemes.exact), ("calibrated", schemes.calibrated))}
    steps = {name: schemes.nystrom(TOP, 6, drift) for name, drift in drifts.items()}
    six = schemes.nystrom(TOP, 6, schemes.preprocessed(free, 6))
    assert defect(steps["exact"], START, 1.2) < 1e-13
    assert defect(steps["calibrated"], START, 0.5) < 1e-13
    assert defect(schemes.nystrom(TOP, 6), START, 0.5) < 2e-14
    assert 5e-10 > defect(schemes.nystrom(TOP, 6), START, 1.2) > 1e-11
    assert defect(six, START, 0.5) > 1e-10


@pytest.mark.long
def test_derivatives_by_all_numbers_of_a_top_agree_with_differences():
    slopes.assert_agree(schemes.nystrom(TOP, 6), START, 0.3)
