"""The text of a report: what its rows and published values print."""

import numpy as np
import pytest

import lieint_jax as li


def test_published_values_are_printed_with_all_their_digits():
    body = li.systems.rigid_body((1.0, 2.0, 3.0))
    state = body.state(np.array([1.0, 0.0, 0.0, 0.0]), angular_velocity=np.array([0.1, 0.2, 0.3]))
    run = li.run(li.schemes.so3_midpoint(body, li.maps.kappa_cayley), state, 0.1, 2, progress=False)
    published = li.report.Published(6.387222, 0.0000012, "somebody 2015"), li.report.Published(19596.0, 0.2)
    text = li.report.text("A body", run, [li.report.Row("period (d)", 6.387222, published)])
    assert "6.387222 ± 1.2e-06  (somebody 2015)" in text
    assert "19596 ± 0.2" in text


@pytest.mark.parametrize("order", [2, 4])
def test_a_report_promises_what_the_scheme_declares(order):
    """The drift of `splitting[so3_midpoint[symplectic]]` conserves the energy of a free body, not that of the top."""
    body, top = li.systems.rigid_body((1.0, 2.0, 3.0)), li.systems.heavy_top((2.0, 2.0, 1.0), (0.0, 0.0, 1.0))
    for system, scheme, promise in (
        (top, li.schemes.splitting(top), "bounded, not conserved"),
        (body, li.schemes.so3_midpoint(body, li.maps.kappa_symplectic), "conserved to round-off"),
    ):
        step = li.schemes.compose(scheme, order) if order > 2 else scheme
        state = system.state(angular_velocity=np.array([0.3, 0.2, 2.0]))
        energy, momentum = li.report.changes(li.run(step, state, 0.1, 4, progress=False))
        assert (energy.promise, momentum.promise) == (promise, "conserved to round-off")
        assert (energy.largest() < 1e-14) == (promise == "conserved to round-off")  # observed: 3e-16; 1.7e-8 or more


def test_the_error_of_an_energy_that_is_zero_is_relative_to_the_kinetic_energy():
    """A top that falls from rest with its axis horizontal: H is 0 and constant to round-off."""
    top = li.systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 1.0])
    fallen = top.state([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], angular_velocity=[0.0, 0.0, 0.0])
    run = li.run(li.schemes.top_energy_momentum(top), fallen, 0.05, 40, progress=False)
    energy, _ = li.report.changes(run)
    assert energy.largest() < 3e-15  # observed: 4e-16
