"""`li.scan` against `jax.lax.scan`: values, members, derivatives, engines."""

import logging
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

pytest.importorskip("llvmlite")

from internals import forget_fallbacks, share_short_calls

import lieint_jax as li
from lieint_jax.native import march

CASES = [(6, 1, False), (12, 3, True), (10, 2, False), (90, 1, False), (91, 1, True), (130, 13, False)]
CASES += [(200, 100, True), (97, 97, False), (202, 2, False)]  # from 65 steps on reverse mode computes pieces again


@pytest.fixture(autouse=True)
def _each_test_hears_of_a_fallback():
    forget_fallbacks()


def by_lax(f, init, xs, every, reverse):
    carry, ys = lax.scan(f, init, xs, reverse=reverse)
    return carry, jax.tree.map(lambda y: y[(0 if reverse else every - 1) :: every], ys)


def by_li(f, init, xs, every, reverse):
    return li.scan(f, init, xs, every=every, reverse=reverse)


def problem(scan, every, reverse):
    """A pendulum with a parameter that is closed over, rows of a force, a sum and a counter."""

    def run(start, r, xs):
        def step(carry, x):
            z, w, n = carry
            z = jnp.stack([z[0] + 0.1 * z[1] * r, z[1] - 0.1 * jnp.sin(z[0]) + 0.01 * x * jnp.cos(0.1 * n)])
            return (z, w + z[0] * r, n + 1), {"y": z * x, "n": n}

        (z, w, _), ys = scan(step, (*start, jnp.array(0)), xs, every, reverse)
        return z, w, ys["y"], ys["n"]

    return run


def real(run):
    return lambda *x: run(*x)[:3]


def loss(run):
    def value(*x):
        z, w, y, _ = run(*x)
        return jnp.sum(z**2) + w * jnp.sum(jnp.sin(y)) + 0.01 * jnp.sum(y * jnp.arange(y.size).reshape(y.shape))

    return value


def arguments(length):
    xs = np.random.default_rng(length).normal(size=length)
    return (jnp.array([0.3, 0.2]), jnp.array(0.1)), jnp.array(0.9), jnp.array(xs)


def near(found, expected, tolerance=4e-14):
    """Observed: 1e-14 of the largest number."""
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert x.shape == y.shape
        assert x.dtype == y.dtype
        if np.size(y):
            np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * (1 + np.abs(y).max()))


GRADIENT = dict(argnums=(0, 1, 2))
BATCHES = {"all": (0, 0, 0), "start": (0, None, None), "constant": (None, 0, None), "rows": (None, None, 0)}
FIRST = {
    "value": lambda run: run,
    "jvp": lambda run: lambda *x: jax.jvp(real(run), x, x),
    "grad": lambda run: jax.grad(loss(run), **GRADIENT),
    "jacfwd": lambda run: jax.jacfwd(real(run), **GRADIENT),
    "jacrev": lambda run: jax.jacrev(real(run), **GRADIENT),
    "linearize": lambda run: lambda *x: jax.linearize(real(run), *x)[1](*x),
    "checkpoint": lambda run: jax.grad(jax.checkpoint(loss(run)), **GRADIENT),
}
SECOND = {
    "grad of grad": lambda run: jax.grad(lambda *x: jnp.sum(jax.grad(loss(run))(*x)[0] ** 2), **GRADIENT),
    "jvp of grad": lambda run: lambda *x: jax.jvp(jax.grad(loss(run), **GRADIENT), x, x),
    "grad of jvp": lambda run: jax.grad(lambda *x: jnp.sum(jax.jvp(real(run), x, x)[1][0] ** 2), **GRADIENT),
    "vmap of hessian": lambda run: jax.vmap(jax.hessian(loss(run), argnums=1)),
}


@pytest.mark.parametrize("name", [*FIRST, *SECOND])
@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=[pytest.mark.long] * (k not in (1, 4))) for k, c in enumerate(CASES)]
)
def test_values_and_derivatives_are_those_of_lax_scan(case, name, caplog):
    length, every, reverse = case
    transform, x = (FIRST | SECOND)[name], arguments(length)
    if name == "vmap of hessian":
        x = jax.tree.map(lambda x: jnp.stack([x, 0.9 * x]), x)
    ours, theirs = (jax.jit(transform(problem(scan, every, reverse))) for scan in (by_li, by_lax))
    near(ours(*x), theirs(*x))
    assert not caplog.records  # no loop fell back to XLA


@pytest.mark.long
@pytest.mark.parametrize("name", FIRST)
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("case", [CASES[1], CASES[4]])
def test_members_are_those_of_lax_scan(case, batch, name, caplog):
    """One axis of members, two of them, and one at the end of the results."""
    length, every, reverse = case
    axes = BATCHES[batch]
    first = [jax.tree.map(lambda x: jnp.stack([x, 0.9 * x, 1.1 * x]), x) for x in arguments(length)]
    x = [x if axis == 0 else jax.tree.map(lambda x: x[0], x) for x, axis in zip(first, axes, strict=True)]

    def mapped(scan):
        return jax.vmap(FIRST[name](problem(scan, every, reverse)), axes, axis_size=3)

    near(jax.jit(mapped(by_li))(*x), jax.jit(mapped(by_lax))(*x))
    twice = [jax.tree.map(lambda x: jnp.stack([x, 0.8 * x]), x[0]), *x[1:]]
    nested = [jax.jit(jax.vmap(mapped(scan), (0, None, None), out_axes=-1)) for scan in (by_li, by_lax)]
    near(nested[0](*twice), nested[1](*twice))
    assert not caplog.records


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jvp", "grad", "jacrev"])
def test_members_of_derivatives(name, caplog):
    x = [jax.tree.map(lambda x: jnp.stack([x, 0.9 * x, 1.1 * x]), x) for x in arguments(12)]
    x[1] = x[1][0]
    ours, theirs = (jax.jit(jax.vmap(FIRST[name](problem(scan, 3, True)), (0, None, 0))) for scan in (by_li, by_lax))
    near(ours(*x), theirs(*x))
    assert not caplog.records


def around(scan, kind):
    """A loss with a scan inside of control flow, of 3 rounds."""
    run = problem(scan, 3, False)

    def value(start, r, xs):
        def once(state):
            z, w, _, _ = run(state, r, xs)
            return 0.9 * z, 0.1 * w

        if kind == "scan":
            end = lax.scan(lambda c, _: (once(c), None), start, length=3)[0]
        elif kind == "cond":
            end = lax.cond(r > 0.5, once, lambda c: c, start)
        elif kind == "map":
            end = jax.tree.map(jnp.sum, lax.map(lambda k: once(jax.tree.map(lambda x: x * k, start)), jnp.arange(3.0)))
        else:
            end = once(once(once(start)))
        return jnp.sum(end[0] ** 2) + jnp.sum(end[1])

    return value


@pytest.mark.long
@pytest.mark.parametrize("kind", ["scan", "cond", "map", "calls"])
def test_inside_of_control_flow(kind):
    x = arguments(12)
    ours, theirs = (jax.jit(jax.value_and_grad(around(scan, kind), argnums=(0, 1, 2))) for scan in (by_li, by_lax))
    near(ours(*x), theirs(*x))


def test_a_while_loop_around_it():
    def halve(x):
        return li.scan(lambda c, _: (c / 2, None), x, length=2)[0]

    assert jax.jit(lambda x: lax.while_loop(lambda x: x > 1, halve, x))(100.0) == 100 / 4**4


@pytest.mark.long
def test_types_tables_and_what_is_closed_over():
    """float32, integers, booleans, a table of 300 entries, an array of each member in a closure, in one loop."""
    table = jnp.sin(jnp.arange(300.0))

    def run(scan, x, k):
        def step(carry, row):
            a, b, n, flag = carry
            a = a * jnp.float32(0.9) + row[0] * k
            return (a, b + table[n], (n + 7) % 300, jnp.logical_xor(flag, a > 0.2)), (a, n, flag)

        rows = (jnp.linspace(0, 1, 40, dtype=jnp.float32), jnp.arange(40))
        return scan(step, (x, jnp.zeros(3), jnp.array(5), jnp.array(True)), rows)

    x, k = (jnp.linspace(-1, 1, 21, dtype=jnp.float32) * s for s in (1, 3))
    found, expected = (jax.jit(jax.vmap(lambda x, k, s=s: run(s, x, k)))(x, k) for s in (li.scan, lax.scan))
    near(found, expected, 5e-7)  # observed: 1.6e-7
    by_k = [jax.grad(lambda k, s=s: run(s, x[0], k)[0][0])(k[3]) for s in (li.scan, lax.scan)]
    near(*by_k, 5e-7)


def test_without_x64_numbers_have_32_bits():
    with jax.enable_x64(False):
        end, path = li.scan(lambda c, x: (c * 0.5 + x, c), 1.0, jnp.ones(4))
    assert end.dtype == path.dtype == np.float32
    assert end == 1.9375


def test_members_with_nan_and_long_loops_beside_others():
    """Newton's iterations for a square root: a member that never converges neither delays nor changes the others."""

    def newton(a, _):
        a, x = a
        x = lax.while_loop(lambda x: (jnp.abs(x * x - a) > 1e-14 * a) & (x > 0), lambda x: (x + a / x) / 2, a)
        return (a, x), None

    values = jnp.array([2.0, np.nan, 3.0, -1.0, 5.0])
    found = jax.jit(jax.vmap(lambda a: li.scan(newton, (a, a), length=2)[0][1]))(values)
    np.testing.assert_allclose(found[::2], np.sqrt(values[::2]), rtol=1e-14)
    assert np.isnan(found[1])


def chaotic(x):
    return li.scan(lambda c, _: (3.9 * c * (1 - c), c), x, length=300, every=100)


def test_bits_depend_on_no_threads_and_no_other_members(monkeypatch):
    x = jnp.linspace(0.1, 0.9, 1000)
    run = jax.jit(jax.vmap(chaotic))
    expected = jax.tree.map(np.asarray, run(x))
    for start, end in ((0, 1), (3, 10), (500, 1000)):
        near(run(x[start:end]), jax.tree.map(lambda y, s=start, e=end: y[s:e], expected), 0)
    near(jax.jit(chaotic)(x[7]), jax.tree.map(lambda y: y[7], expected), 0)
    share_short_calls(monkeypatch)
    several = jax.jit(jax.vmap(lambda x: chaotic(x)))
    found = []
    threads = [threading.Thread(target=lambda: found.append(several(x))) for _ in range(8)]
    for each in (*(t.start for t in threads), *(t.join for t in threads)):
        each()
    for each in found:
        near(each, expected, 0)
    assert len(found) == 8


def calls(run, *x):
    return "lieint_" in jax.jit(run).lower(*x).as_text()


def test_the_engine_is_the_users_choice(monkeypatch):
    """Call, switch, call: JAX compiles again."""
    run, x = (
        jax.jit(jax.vmap(lambda x: li.scan(lambda c, _: (3.2 * c * (1 - c), c), x, length=300))),
        arguments(7)[2] % 1,
    )
    assert "lieint_" in run.lower(x).as_text()
    first = run(x)
    with li.engine("xla"):
        assert "lieint_" not in run.lower(x).as_text()
        near(run(x), first)
        assert not calls(chaotic, 0.3)
    assert calls(chaotic, 0.3)
    monkeypatch.setenv("LIEINT_ENGINE", "xla")
    assert not calls(lambda x: chaotic(x), 0.3)
    with li.engine("native"):
        assert calls(lambda x: chaotic(x), 0.3)
    monkeypatch.setenv("LIEINT_ENGINE", "fast")
    with pytest.raises(ValueError, match="LIEINT_ENGINE must be one of native, xla, got 'fast'"):
        jax.jit(lambda x: chaotic(x))(0.3)
    with pytest.raises(ValueError, match="engine must be one of native, xla, got 'gpu'"):
        li.engine("gpu")


@pytest.mark.long
def test_other_platforms_run_the_loop_by_xla():
    lowered = jax.jit(chaotic).trace(0.3).lower(lowering_platforms=("cuda",))
    assert "lieint_" not in lowered.as_text()
    with li.engine("xla"):
        exported = jax.export.export(jax.jit(jax.grad(lambda x: chaotic(x)[0])))(0.3)
    assert exported.call(0.3) == pytest.approx(float(jax.grad(lambda x: chaotic(x)[0])(0.3)), rel=1e-9)


def test_operations_without_a_formula_run_by_xla_and_the_log_says_so_once(caplog):
    def step(c, _):
        return jnp.linalg.eigh(jnp.diag(c) + 1)[0], None

    x = jnp.array([3.0, 1.0, 2.0])
    with caplog.at_level(logging.WARNING):
        found = [li.scan(step, x * k, length=4)[0] for k in (1.0, 2.0)]
    near(found[0], lax.scan(step, x, length=4)[0])
    assert [r.message for r in caplog.records] == [
        "XLA runs a loop, which is slower than machine code: eigh has no formula in machine code"
    ]


def test_keys_and_prints_go_through_xla(capfd):
    def step(key, _):
        jax.debug.print("drawn")
        key, own = jax.random.split(key)
        return key, jax.random.normal(own)

    found, expected = (scan(step, jax.random.key(0), length=3)[1] for scan in (li.scan, lax.scan))
    jax.effects_barrier()
    near(found, expected)
    assert capfd.readouterr().out.count("drawn") == 6


def counted(z, count, r=0.9, rows=1, most=None):
    """A pendulum for `count` steps, a number that the loop reads when it runs; and its angles, if there are rows."""

    def step(n, z, _):
        z = jnp.stack([z[0] + 0.1 * z[1] * r, z[1] - 0.1 * jnp.sin(z[0]) * jnp.cos(0.1 * n)])
        return z, None if most is None and rows == 1 else z[0]

    return march(step, z, rows=rows, every=count, most=most)


def by_python(z, count, r=0.9):
    angles = []
    for n in range(count):
        z = jnp.stack([z[0] + 0.1 * z[1] * r, z[1] - 0.1 * jnp.sin(z[0]) * jnp.cos(0.1 * n)])
        angles.append(z[0])
    return z, jnp.stack([*angles, z[0]])


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "xla"])
def test_a_number_of_steps_may_be_an_argument(engine, caplog):
    z, zs = jnp.array([0.3, 0.2]), jnp.array([[0.3, 0.2], [0.6, -0.2], [1.0, 0.1]])
    with li.engine(engine):
        run = jax.jit(counted)
        for count in (0, 1, 5):
            near(run(z, count)[0], by_python(z, count)[0])
        near(jax.jit(lambda n: counted(z, n, rows=3)[1])(4), by_python(z, 12)[1][3:12:4])
        some = jax.jit(lambda n, rows: counted(z, n, rows=rows, most=5))
        for rows in (0, 3, 5, 9):  # never more than the result has
            done = min(rows, 5)
            last, angles = some(4, rows)
            near((last, angles[:done]), (by_python(z, 4 * done)[0], by_python(z, 20)[1][3 : 4 * done : 4]))
        each = jax.jit(jax.vmap(lambda z, n: counted(z, n)[0]))(zs, jnp.array([3, 0, 5]))
        near(each, jnp.stack([by_python(z, n)[0] for z, n in zip(zs, (3, 0, 5), strict=True)]))
        slope = jax.jit(jax.jacfwd(lambda r, n: counted(z, n, r)[0]))(0.9, 5)
        push = jax.jit(lambda n: jax.linearize(lambda r: counted(z, n, r)[0], 0.9)[1](1.0))(5)
    expected = jax.jacfwd(lambda r: by_python(z, 5, r)[0])(0.9)
    near((slope, push), (expected, expected))
    assert not caplog.records


def test_reverse_mode_refuses_a_number_of_steps_that_is_an_argument():
    with pytest.raises(ValueError, match="number of steps is known when JAX traces it"):
        jax.grad(lambda r: counted(jnp.array([0.3, 0.2]), jnp.array(4), r)[0].sum())(0.9)


@pytest.mark.long
def test_a_scan_inside_of_a_scan_is_machine_code(caplog):
    def nested(scan):
        def outer(c, x):
            return scan(lambda d, x: (0.9 * jnp.sin(d) + c * x, d), c, jnp.arange(4.0) * x)

        return lambda c: scan(outer, c, jnp.linspace(0.1, 0.2, 6))

    near(*(jax.jit(nested(scan))(0.3) for scan in (li.scan, lax.scan)))
    near(*(jax.jit(jax.grad(lambda c, s=scan: nested(s)(c)[1].sum()))(0.3) for scan in (li.scan, lax.scan)))
    assert not caplog.records


@pytest.mark.parametrize(("rows", "every", "reverse"), [(91, 1, False), (91, 1, True), (2, 97, False)])
def test_steps_know_their_number_in_gradients_too(rows, every, reverse):
    """From 65 steps on, pieces of the loop run again in reverse mode, and each step must know its number there."""

    def step(n, z, _):
        z = z + 0.01 * jnp.cos(0.1 * n) * z * z
        return z, z * n

    def ours(z):
        z, ys = march(step, z, rows=rows, every=every, reverse=reverse)
        return jnp.sum(ys) + z**2

    def theirs(z):
        numbers = jnp.arange(rows * every)
        z, ys = lax.scan(lambda z, n: step(n, z, None), z, numbers, reverse=reverse)
        return jnp.sum(ys[every - 1 :: every]) + z**2

    near(*(jax.jit(jax.value_and_grad(f))(0.3) for f in (ours, theirs)))


def test_gradients_of_a_sum_over_members():
    """The cotangents of what members share are summed."""
    (z, w), r, xs = arguments(12)
    zs = jnp.stack([z, 0.9 * z, 1.1 * z])

    def total(scan):
        run = loss(problem(scan, 3, False))
        return lambda zs, r, xs: jnp.sum(jax.vmap(lambda z: run((z, w), r, xs))(zs))

    near(*(jax.jit(jax.grad(total(scan), **GRADIENT))(zs, r, xs) for scan in (by_li, by_lax)))


def test_gradients_of_long_loops_compute_nothing_for_constants():
    """The pieces of a loop of more than 64 steps had zero tangents of all that it closes over."""

    def loss(x, c):
        return li.scan(lambda x, _: (jnp.sin(c @ x), None), x, length=100)[0].sum()

    given = jax.ShapeDtypeStruct((3,), float), jax.ShapeDtypeStruct((3, 3), float)
    of_state, of_both = (li.explain(jax.grad(loss, argnums), *given).loops for argnums in (0, (0, 1)))
    assert max(x.operations for x in of_state) < max(x.operations for x in of_both)


@pytest.mark.long
def test_gradients_of_a_checkpoint_around_a_long_loop_in_a_scan():
    def total(scan):
        @jax.checkpoint
        def once(z, _):
            z, _ = scan(lambda z, _: (jnp.sin(z) * z[::-1], z[0]), z, None, 100)
            return z, None

        return lambda z: lax.scan(once, z, None, length=3)[0].sum()

    z = jnp.array([1.0, 0.9])
    near(*(jax.jit(jax.grad(total(scan)))(z) for scan in (li.scan, lax.scan)))


def test_outside_of_jit_a_function_is_traced_once(caplog):
    log = logging.getLogger("traced")  # a list would be read, and changes

    def half(x, _):
        log.warning("traced")
        return x / 2, None

    for _ in range(3):
        assert li.scan(half, jnp.array(1.0), length=3)[0] == 0.125
    assert len(caplog.records) == 1

    class Doubled:
        __hash__ = None

        def __call__(self, x, _):
            return 2 * x, None

    assert li.scan(Doubled(), 1.0, length=3)[0] == 8


TYPES = {  # what a step does with each array of the carry
    "twice": lambda c: 2 * c,
    "a float32 more": lambda c: c + np.float32(1),
    "one more": lambda c: c + 1.0,
    "times a float64": lambda c: c * np.float64(2),
    "half": lambda c: c / 2,
    "an int32 more": lambda c: c + np.int32(1),
    "a vector more": lambda c: c + jnp.ones(2),
}


@pytest.mark.parametrize("change", TYPES.values(), ids=TYPES)
def test_carries_have_the_types_that_lax_scan_gives_them(change):
    """A Python number takes the type that the step returns; a strongly typed carry that changes its type is refused."""
    starts = [
        0.5,
        1,
        True,
        np.float32(1),
        jnp.float64(1),
        jnp.int32(1),
        jnp.asarray(2.0),
        (0.0, jnp.float32(1)),
        (0, 0.0),
    ]

    def step(carry, _):
        return jax.tree.map(change, carry), jax.tree.map(lambda c: c * jnp.float32(3), carry)

    def types_of(scan, start):
        try:
            found = jax.eval_shape(lambda: scan(step, start, length=3))
        except (TypeError, ValueError):
            return "refused"
        return [(x.dtype, x.weak_type, x.shape) for x in jax.tree.leaves(found)]

    for start in starts:
        assert types_of(li.scan, start) == types_of(lax.scan, start), start


def test_weakly_typed_carries_have_the_values_of_lax_scan():
    def step(c, _):
        return (c[1] / np.float32(2), c[0] + np.float32(0.5)), c[0]

    for scan in (li.scan, lax.scan):
        (a, b), path = scan(step, (1, 0.25), length=4)
        assert (a.dtype, b.dtype, path.dtype) == (np.float32,) * 3
        np.testing.assert_array_equal([a, b, *path], [0.625, 0.8125, 1.0, 0.125, 0.75, 0.3125])
