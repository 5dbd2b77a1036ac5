"""The text of a report: what its rows, changes and published values print, and what it notes of them."""

import functools
import re

import jax
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.report import Change, Published, Row

BOOK = Published(2.0, 0.5, "a book")


@functools.cache
def two_members():
    """A short run of two members."""
    body = li.systems.rigid_body((1.0, 2.0, 3.0))
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.4]]))
    return li.run(li.schemes.so3_midpoint(body, li.maps.kappa_cayley), states, 0.1, 2, progress=False)


def report(*rows, **options):
    return li.report.text("Two bodies", two_members(), rows, **options)


def notes(*rows):
    """What is noted of rows with published values, as one line."""
    return " ".join(report(*rows).partition("! ")[2].split())


def test_a_change_is_relative_to_its_size_and_from_the_initial_value():
    values = np.array([[1.0, 2.0], [1.5, 2.0], [1.0, 1.0]])
    assert Change("x", values).largest() == 1.0
    assert Change("x", values, np.array([0.25, 2.0])).largest() == 2.0  # of the first member, at the second time
    assert Change("x", values[:, 0], 0.25).largest() == 2.0  # of one body


def test_the_change_of_a_vector_is_its_largest_component():
    values = np.zeros((2, 1, 3))
    values[1, 0] = [3.0, -4.0, 0.0]
    assert Change("x", values).largest() == 4
    matrices = np.stack([np.zeros((1, 2, 2)), np.full((1, 2, 2), -7.0)])
    assert Change("F", matrices, np.full((1, 1, 1), 2.0)).largest() == 3.5


def test_the_spread_is_the_standard_deviation_and_of_angles_that_of_differences():
    assert Row("x", [1.0, 2.0, 3.0]).spread == 1
    assert np.isnan(Row("x", [1.0]).spread)  # of one member there is none
    assert Row("x", [359.0, 0.0, 1.0], angle=True).spread == 1
    assert Row("longitude", [0.1, 359.9, 0.3], angle=True).spread == pytest.approx(0.2, rel=3e-13, abs=0)
    assert np.isnan(Row("x", [1.0, np.nan]).spread)


def test_columns_are_printed_where_there_is_something_to_print():
    plain = report(Row("speed (m/s)", [1.25, 1.75], digits=".2f"), remarks=["  a remark"])
    assert re.search(r"^ +nominal +± std$", plain, re.M)
    assert re.search(r"^  speed \(m/s\) +1.25 +0.35$", plain, re.M)
    assert plain.endswith("\n  a remark\n  2 of 2 members converged at every step")
    exact = report(Row("period", 1.0, closed_form=1.5), Row("rate", np.nan, closed_form=np.nan))
    assert re.search(r"nominal +± std +closed form +difference$", exact, re.M)
    assert re.search(r"^  period +1.0000000000 +— +1.5000000000 +-5.0e-01$", exact, re.M)
    assert re.search(r"^  rate +— +— +— +—$", exact, re.M)
    cited = report(Row("period", [2.25, 2.5], [BOOK, Published(3, source="another")]))
    assert re.search(r"^  period +2.2500 +0.1768   2 ± 0.5  \(a book\)\n +3  \(another\)$", cited, re.M)
    assert "!" not in cited


def test_the_largest_change_is_printed_next_to_the_promise():
    values = np.array([[1.0, 1.0], [1.0, 1.5]])
    text = report(changed=[Change("energy", values, promise="conserved to round-off"), Change("P", 0 * values)])
    assert re.search(r"^  largest change, all members and saved times +the scheme promises$", text, re.M)
    assert re.search(r"^  energy +5.0e-01   conserved to round-off$", text, re.M)
    assert re.search(r"^  P +0.0e\+00$", text, re.M)
    assert "promises" not in report(changed=[Change("P", values)])


def test_a_spread_is_named_for_several_members_only():
    assert "(1 sigma): attitude 1°" in report(spread="attitude 1°")
    assert "sigma" not in li.report.text("One body", two_members().member(1), spread="attitude 1°")


def test_a_value_far_from_the_published_one_is_noted():
    found = notes(Row("period (d)", [-4.0, -4.1], BOOK))
    assert "period (d): The nominal member differs from the published value by -6, 12 times" in found
    assert "and in its sign" in found
    assert notes(Row("period (d)", [3.4, 3.5], BOOK)) == ""
    assert notes(Row("period (d)", [-4.0, -4.1], Published(2.0, None, "a book"))) == ""


def test_a_spread_beyond_the_published_error_is_noted():
    published = Published(6.7, 0.2, "a book", "The primary is rounder.")
    far = notes(Row("precession (°/d)", [-5.8, -11.9, -3.5, -6.8], published))
    assert "differs from the published value by -12.5, 62 times the published error, and in its sign" in far
    assert "spread is 18 times the published error" in far
    assert "the median is -6.3000, and 68 % of them lie from -9.4520 to -4.6040. The primary is rounder." in far
    near = notes(Row("precession (°/d)", [6.6, 5.6, 7.4, 6.5], published))
    assert "differs" not in near
    assert "spread is 3.7 times" in near
    assert notes(Row("precession (°/d)", [6.6, 6.7, 6.65, 6.6], published)) == ""


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


def test_changes_of_members_are_measured_in_the_system_of_each():
    """Of heavy tops of their own weight, by a scheme with an error that is far above round-off."""

    def member(weight):
        top = li.systems.heavy_top((2.0, 2.0, 1.0), weight * np.array([0.0, 0.0, 1.0]))
        return li.schemes.splitting(top), top.state(angular_velocity=np.array([0.3, 0.2, 2.0]))

    run = li.run(*jax.vmap(member)(np.array([1.0, 4.0])), 0.1, 10, own_step=True, progress=False)
    energy, momentum = li.report.changes(run)
    alone = [li.report.changes(run.member(k))[0] for k in range(2)]
    for k in range(2):
        np.testing.assert_allclose(energy.values[:, k], alone[k].values, rtol=1e-14)
        assert alone[k].largest() > 1e-5
    assert energy.largest() == pytest.approx(max(x.largest() for x in alone), rel=1e-9)
    assert momentum.largest() < 1e-14


def test_a_report_states_how_far_the_nominal_member_or_the_worst_of_several_is_off():
    run = two_members()
    one, both = (float(x.max()) for count in (1, 2) if (x := run.error(count).attitude) is not None)
    assert both > 1.1 * one > 0
    for count, who, angle in (
        (1, "nominal member", one),
        (2, "worst of 2 members", both),
        (8, "worst of 2 members", both),
    ):
        assert f"\n  {who}: attitude up to {angle:.2g} rad (" in report(error=count)
    assert " off until t" not in report()


def test_a_certificate_of_a_long_run_has_the_error_at_its_end():
    """The conserved quantities are measured in the first 10 000 steps, the error until the last, by the exact flow."""
    body = li.systems.rigid_body((1.0, 2.0, 3.0))
    start = body.state(angular_velocity=[0.2, 0.0, 1.0])
    run = li.run(li.schemes.so3_midpoint(body), start, 0.01, 20_000, save_every=100, progress=False)
    exact = jax.vmap(lambda t: body.solution(start, t))(run.t).q
    head, first, *_ = li.report.certificate(run).splitlines()
    angle = max(map(float, jax.vmap(li.groups.so3.angle)(run.state.q, exact)))
    assert head == "Certificate of the nominal member, first 10000 of 20000 steps:"
    assert first.startswith(f"attitude up to {angle:.2g} rad (")
    assert first.endswith("off until t = 200, by a run with dt/2")


def test_the_momenta_of_several_bodies_are_two_rows_relative_to_the_largest_of_a_body():
    """A pair whose center is at rest, so that the sum of the linear momenta is 0, which is no size."""
    V = li.potentials.point_masses(1.0, [2.0, 1.0])
    pair = li.systems.rigid_bodies([2.0, 1.0], [[0.5, 0.6, 0.7], [0.1, 0.2, 0.2]], V)
    start = pair.state([[-1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], velocities=[[0.0, -0.2, 0.0], [0.0, 0.4, 0.0]])
    run = li.run(li.schemes.splitting(pair), start, 0.1, 20, progress=False)
    _, *momenta = li.report.changes(run)
    assert [x.name for x in momenta] == [
        f"{kind} momentum, over the largest of a body" for kind in ("linear", "angular")
    ]
    assert all(0 <= x.largest() < 1e-14 and x.promise == "conserved to round-off" for x in momenta)
    p, q = np.asarray(run.state.p), np.asarray(run.state.q)
    assert momenta[0].size == pytest.approx(np.linalg.norm(p[..., :3], axis=-1).max())
    of_body = np.cross(q[..., :3], p[..., :3]) + p[..., 3:]
    assert momenta[1].size == pytest.approx(np.linalg.norm(of_body, axis=-1).max())
    np.testing.assert_allclose(momenta[1].values, of_body.sum(axis=1), rtol=0, atol=1e-15)
