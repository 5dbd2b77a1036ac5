"""Events: when a condition changes its sign, and what that depends on."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_steps import Leapfrog, Oscillators

import lieint_jax as li
from lieint_jax import schemes, systems

pytestmark = pytest.mark.long

TOP = systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])
TURN = jnp.array([0.9, 0.1, 0.3, 0.2]) / np.sqrt(0.95)
STATE = TOP.state(TURN, angular_velocity=[0.3, 0.5, 0.8])
SPLITTING = schemes.splitting(TOP)
BODY = systems.rigid_body([1.0, 2.0, 3.0])
SPIN = BODY.state(angular_velocity=[0.0, 0.0, 0.7])  # q = (cos 0.35 t, 0, 0, sin 0.35 t)


def level(state):
    return state.p[0]


def attitude(state):
    return state.q[0]


def spinning(start=SPIN, **options):
    return li.event(schemes.exact(BODY), start, 0.3, attitude, max_steps=100, **options)


@pytest.mark.quick
def test_crossings_of_either_direction_are_distinguished():
    """q = cos t of an oscillator falls through 0 first at π/2 and rises at 3π/2; with steps of 0.1, to 4e-3."""
    step, start = Leapfrog(Oscillators(jnp.array(1.0))), li.State(jnp.eye(3), jnp.zeros((3, 3)))
    for direction, quarters in ((0, 1), (-1, 1), (1, 3)):
        found = li.event(step, start, 0.1, lambda state: state.q[0, 0], max_steps=60, direction=direction)
        assert found.found
        assert found.t == pytest.approx(quarters * np.pi / 2, abs=4e-3)


def test_a_spin_about_an_axis_crosses_at_the_exact_times():
    """q₀ = cos 0.35 t vanishes at π/0.7 and each 2π/0.7 after, falling first; observed 4e-16 off."""
    for options, quarter in (({}, 1), (dict(direction=1), 3), (dict(direction=-1, count=2), 5)):
        found = spinning(**options)
        assert found.found
        assert found.t == pytest.approx(quarter * np.pi / 0.7, rel=4e-15, abs=0)
        assert abs(found.state.q[0]) < 5e-15
    later = spinning(SPIN._replace(t=jnp.asarray(10.0)))
    assert later.t == later.state.t == pytest.approx(10 + np.pi / 0.7, rel=4e-15, abs=0)


def test_where_the_condition_begins_at_zero_the_sign_just_after_counts():
    start = SPIN._replace(q=jnp.array([0.0, 0.0, 0.0, 1.0]))  # q₀ = −sin 0.35 t
    assert spinning(start).t == pytest.approx(2 * np.pi / 0.7, rel=4e-15, abs=0)
    assert spinning(start, direction=1).t == pytest.approx(2 * np.pi / 0.7, rel=4e-15, abs=0)
    assert spinning(start, direction=-1).t == pytest.approx(4 * np.pi / 0.7, rel=4e-15, abs=0)


def test_without_a_crossing_nothing_is_found_and_no_derivative_is_nan():
    def time(w):
        found = li.event(SPLITTING, TOP.state(TURN, angular_velocity=w), 0.05, lambda z: z.p[0] - 100, max_steps=20)
        return found.t, found.found

    (t, found), slope = jax.jit(jax.value_and_grad(time, has_aux=True))(jnp.array([0.3, 0.5, 0.8]))
    assert not found
    assert t == 1.0
    assert np.isfinite(slope).all()
    too_far = li.event(SPLITTING, STATE._replace(p=0.4 * STATE.p), 0.5, lambda z: z.q[0] - 0.2, max_steps=200)
    path = li.integrate(SPLITTING, STATE._replace(p=0.4 * STATE.p), 0.5, 200)
    assert too_far.found == path.info.converged[: int(too_far.t / 0.5) + 2].all()


@pytest.mark.parametrize("order", [2, 4])
def test_the_time_is_of_the_order_of_the_scheme(order):
    """Observed 2.02 and 4.02; 1e-18 of the condition at the event."""
    step = SPLITTING if order == 2 else schemes.compose(SPLITTING, 4)
    found = [li.event(step, STATE, 20 / n, level, max_steps=n, count=2) for n in (200, 400, 6400)]
    assert max(abs(e.state.p[0]) for e in found) < 1e-15
    coarse, fine, exact = (float(e.t) for e in found)
    assert np.log2((coarse - exact) / (fine - exact)) == pytest.approx(order, abs=0.15)


def test_derivatives_forward_reverse_and_by_differences():
    def time(w):
        return li.event(SPLITTING, TOP.state(TURN, angular_velocity=w), 0.05, level, max_steps=200, count=2).t

    w = jnp.array([0.3, 0.5, 0.8])
    value, forward = jax.jit(time), jax.jit(jax.jacfwd(time))(w)
    np.testing.assert_allclose(jax.jit(jax.grad(time))(w), forward, rtol=1e-12)
    h = 1e-4
    for i, slope in enumerate(forward):
        f = [value(w.at[i].add(k * h)) for k in (-2, -1, 1, 2)]
        assert float(f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h) == pytest.approx(float(slope), rel=1e-8)
    at = jax.jit(lambda dt: li.event(SPLITTING, STATE, dt, level, max_steps=200, count=2).t)
    f = [at(0.05 + k * 1e-5) for k in (-2, -1, 1, 2)]
    by_dt = float(f[0] - 8 * f[1] + 8 * f[2] - f[3]) / 1.2e-4
    assert by_dt == pytest.approx(float(jax.jit(jax.grad(at))(0.05)), rel=1e-6)


def test_events_of_many_members_are_found_at_once_and_in_order():
    """A batch finds what each member finds; the events in turn are those of `count`."""
    starts = jax.vmap(lambda w: TOP.state(TURN, angular_velocity=w))(jnp.array([[0.3, 0.5, 0.8], [0.1, -0.4, 0.9]]))
    many = li.diagnostics.section(SPLITTING, starts, 0.05, level, max_steps=400, count=3, direction=0)
    assert many.found.all()
    assert (np.diff(many.t, axis=1) > 0).all()
    for m in range(2):
        start = jax.tree.map(lambda x: x[m], starts)  # noqa: B023
        for k in range(3):
            alone = li.event(SPLITTING, start, 0.05, level, max_steps=400, count=k + 1)
            assert float(alone.t) == pytest.approx(float(many.t[m, k]), rel=1e-14, abs=0)  # observed 0


def test_the_event_of_a_falling_top_lies_on_its_trajectory():
    """The energy at the event is that of the steps, and its time lies between two of them."""
    found = jax.jit(lambda z: li.event(SPLITTING, z, 0.05, level, max_steps=200, count=2))(STATE)
    path = li.integrate(SPLITTING, STATE, 0.05, 200)
    changes = np.flatnonzero(np.diff(np.sign(path.state.p[:, 0])))
    assert path.t[changes[1]] < found.t < path.t[changes[1] + 1]
    assert abs(found.state.p[0]) < 1e-15
    seen = li.integrate(SPLITTING, STATE, 0.05, 200, save_at=found.t[None])
    np.testing.assert_allclose(seen.state.q[1], found.state.q, rtol=0, atol=1e-15)


ROOTS = {
    "smooth": lambda c: c,
    "steep": lambda c: jnp.tanh(1e4 * c),
    "bent": lambda c: jnp.expm1(-60 * c),
    "cusp": jnp.cbrt,
    "kink": lambda c: jnp.where(c > 0, 1e6 * c, c),
    **{f"power {k}": functools.partial(lambda c, k: c**k, k=k) for k in (3, 5, 9, 21)},
}
OTHERS = {
    "pole": lambda c: 1 / c,
    "wrap": lambda c: jnp.arctan2(c, -1.0),
    "step": lambda c: jnp.floor(c) + 0.5,
    "low step": lambda c: 100 * c + jnp.where(c < 0, -0.1, 0.1),
    "plateau": lambda c: jnp.where(jnp.abs(c) < 1e-3, 0, c),
}
CONDITIONS = [*ROOTS.values(), *OTHERS.values()]
SPINNING = schemes.so3_midpoint(BODY, li.maps.kappa_exponential)  # exact about an axis


@functools.cache
def crossings(dtype):
    """Events of each function of c = cos 0.35 t − 0.3, in one program."""
    step, start = jax.tree.map(lambda x: x.astype(dtype), (SPINNING, SPIN))
    values = jax.vmap(lambda c: jnp.stack([f(c) for f in CONDITIONS]))

    def event_of(k):
        condition = jax.tree_util.Partial(lambda k, z: values(z.q[:1] - 0.3)[0, k], k)
        return li.event(step, start, jnp.asarray(0.5, dtype), condition, max_steps=10)

    return jax.jit(jax.vmap(event_of))(jnp.arange(len(CONDITIONS)))


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(jnp.float64, 1e-14), (jnp.float32, 3e-6)], ids=["float64", "float32"]
)
def test_the_time_of_a_root_is_right_and_what_is_no_root_is_not_found(dtype, tolerance):
    """Bracketed to round-off, whatever the shape of the condition: 12 steps of regula falsi erred by up to 0.07."""
    event, time = crossings(dtype), np.arccos(0.3) / 0.35
    assert event.t.dtype == dtype
    names = [*ROOTS, *OTHERS]
    underflows = dtype == jnp.float32
    roots = [name in ROOTS and not (underflows and name.startswith("power")) for name in names]
    assert event.found[np.array(roots)].all()
    assert not event.found[len(ROOTS) :].any()
    right = np.array(event.found) | [name in OTHERS and name != "plateau" for name in names]
    np.testing.assert_allclose(event.t[right], time, rtol=0, atol=tolerance)


def test_late_on_a_clock_the_time_is_right_to_its_rounding():
    """At t = 1e7 numbers are 1.9e-9 apart, which is more than 1e-9 dt: the condition is a staircase there."""
    start = SPIN._replace(t=jnp.asarray(1e7))
    times = 1e7 + jnp.linspace(0.1, 3.3, 32)
    found = jax.jit(jax.vmap(lambda T: li.event(SPINNING, start, 0.5, lambda z: z.t - T, max_steps=10)))(times)
    assert found.found.all()
    np.testing.assert_allclose(found.t, times, rtol=0, atol=4e-9)


@pytest.mark.quick
def test_the_size_of_a_condition_does_not_matter():
    """A condition of 1e-300 underflows next to its root, which was found but not trusted: it is right to 1e-5 dt."""
    step = schemes.exact(BODY)
    sizes = jnp.array([1.0, -1e-150, 1e-200, 1e-300, -1e-300, 1e200, 1e307, 1e-306])

    def first(size, shift):
        found = li.event(step, SPIN, 0.3, lambda z: size * (attitude(z) + shift), max_steps=20)
        return found.t, found.found

    slope = jax.jit(jax.vmap(jax.value_and_grad(first, 1, has_aux=True), (0, None)))
    (t, found), by_shift = slope(sizes, 0.0)
    assert found[:-1].all()
    assert not found[-1]  # whose root is hidden
    off = abs(t[:-1] - np.pi / 0.7)  # q = cos 0.35 t
    assert off.max() < 3e-6
    assert off[jnp.array([0, 1, 2, 5, 6])].max() < 1e-14
    np.testing.assert_allclose(by_shift[:-1], 1 / 0.35, rtol=1e-5)
