"""Initial states as a function of member numbers: a part makes only its own; and the memory of a run into a store."""

import tracemalloc

import internals
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stores import assert_same

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])
STEP = li.schemes.so3_midpoint(BODY)
MEMBERS = 41
OMEGA = np.random.default_rng(7).normal(size=(MEMBERS, 3))
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
JJJ = np.array([1.0, 2.0, 3.0])


def states_of(numbers, scale=1.0):
    """The states of these members, attitudes all the same."""
    return li.State(jnp.tile(IDENTITY, (len(numbers), 1)), scale * jnp.asarray(OMEGA)[numbers] * JJJ)


def run(states=states_of, store=None, part=None, **options):
    options = dict(dt=0.1, num_steps=60, save_every=5, progress=False, members=MEMBERS) | options
    return li.run(STEP, states, store=store, part=part, **options)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    internals.make_states_of(monkeypatch, 8)
    internals.commit_every(monkeypatch, 4)


def scaled(scale):
    return lambda numbers: states_of(numbers, scale)


@pytest.mark.parametrize("reduce", [None, "energy"])
def test_a_part_makes_its_own_members_only_and_all_parts_are_one_run(tmp_path, reduce):
    whole = run(states_of(np.arange(MEMBERS)), members=None, reduce=reduce)
    assert_same(run(reduce=reduce), whole)
    store, (parts, _) = tmp_path / "run.zarr", internals.members_of_parts(MEMBERS, 4)
    for k in (2, 0, 3, 1):
        asked = []

        def noted(numbers, asked=asked):
            if isinstance(numbers, np.ndarray):  # otherwise JAX traces it
                asked.append(numbers.tolist())
            return states_of(numbers)

        own = parts[k]
        assert_same(run(noted, None, (k, 4), reduce=reduce), run(store=store, part=(k, 4), reduce=reduce))
        blocks = {0, *range(own.start // 8, (own.stop - 1) // 8 + 1)}  # the first describes the run
        assert asked == [list(range(8 * b, min(8 * b + 8, MEMBERS))) for b in sorted(blocks)]
    assert_same(li.open(store), whole)


@pytest.mark.long
def test_members_of_one_part_that_start_together_do_not_share_a_time(tmp_path):
    """Only a scalar time is shared: the members of a part, or of a block, do not show whether all start together."""

    def late(numbers):
        return states_of(numbers)._replace(t=(numbers // 11).astype(float))

    whole = run(late)
    np.testing.assert_array_equal(whole.state.t[0], np.arange(MEMBERS) // 11)
    for k in range(4):
        run(late, tmp_path / "late.zarr", (k, 4))
    assert_same(li.open(tmp_path / "late.zarr"), whole)

    def together(numbers):
        return states_of(numbers)._replace(t=np.float64(3.0))

    for k in range(2):
        run(together, tmp_path / "together.zarr", (k, 2))
    found = li.open(tmp_path / "together.zarr")
    assert_same(found, run(together))
    assert found.t[0] == 3.0


@pytest.mark.long
def test_each_member_may_have_a_system_of_its_own(tmp_path):
    J = np.linspace(1.0, 1.5, MEMBERS)[:, None] * [1.0, 2.0, 2.5]
    steps = jax.vmap(lambda J: li.schemes.so3_midpoint(li.systems.rigid_body(J)))(J)
    options = dict(dt=0.1, num_steps=20, save_every=5, progress=False, own_step=True, members=MEMBERS)
    for k in range(3):
        li.run(steps, states_of, store=tmp_path / "run.zarr", part=(k, 3), **options)
    assert_same(li.open(tmp_path / "run.zarr"), li.run(steps, states_of, **options))


def of_numpy(scale, last=0.0):
    """As `scaled`, by a function that JAX cannot trace; the last member rotates faster by `last`."""

    def states(numbers):
        momenta = scale * OMEGA[numbers] * JJJ
        momenta[numbers == MEMBERS - 1] += last
        return li.State(np.tile(IDENTITY, (len(numbers), 1)), momenta)

    return states


@pytest.mark.parametrize(
    ("one", "others"),
    [(scaled(1.0), [scaled(1.5), of_numpy(1.0)]), (of_numpy(1.0), [of_numpy(1.5), of_numpy(1.0, 1e-12)])],
    ids=["traced", "of NumPy"],
)
def test_a_part_with_another_function_of_states_is_refused(tmp_path, one, others):
    store = tmp_path / "run.zarr"
    run(one, store, (0, 2))
    for states, members in [*((x, MEMBERS) for x in others), (states_of(np.arange(MEMBERS)), None)]:
        with pytest.raises(ValueError, match=r"holds another run.*the states that the function makes differ"):
            run(states, store, (1, 2), members=members)
    run(one, store, (1, 2))
    assert_same(li.open(store), run(one))


def test_equations_of_states_are_those_of_extra_values_of_these_names(tmp_path):
    def named(name):
        return lambda numbers: states_of(numbers)._replace(extra={name: numbers * 1.0})

    run(named("a"), tmp_path / "run.zarr", (0, 2))
    with pytest.raises(ValueError, match=r"the states that the function makes differ$"):
        run(named("b"), tmp_path / "run.zarr", (1, 2))


def test_a_part_whose_function_returns_other_states_when_it_is_resumed_is_refused(tmp_path):
    table = tmp_path / "scale.txt"

    def read(numbers):  # the trace of which is the same
        return states_of(numbers, float(table.read_text()) if isinstance(numbers, np.ndarray) else 1.0)

    table.write_text("1.0")
    run(read, tmp_path / "run.zarr", (0, 2))
    table.write_text("1.5")
    with pytest.raises(ValueError, match=r"part 0 of .* began with other initial states .*Remove parts/0/state"):
        run(read, tmp_path / "run.zarr", (0, 2))


def test_functions_that_return_no_states_of_these_members_are_refused():
    def changing(numbers):
        found = states_of(numbers)
        return found if numbers[0] == 0 else found._replace(work=np.zeros(len(numbers)))

    off = np.where(np.arange(MEMBERS) == 30, 1.1, 1.0)[:, None]
    for states, options, message in (
        (states_of, dict(members=None), "states is a function of member numbers: give their number"),
        (states_of, dict(members=0), "members must be an integer ≥ 1, got 0"),
        (states_of(np.arange(41)), {}, "members is the number of members where states is a function"),
        (lambda n: OMEGA[n], {}, "states must return a State .*got ndarray"),
        (lambda n: states_of(n[:-1]), {}, r"the states of 8 member\(s\) .* got shapes \(7, 4\), \(7, 3\)"),
        (lambda n: states_of(n)._replace(t=1.0 * n[0]), {}, "one scalar t and work for all members, got 0.0 and 8.0"),
        (changing, {}, "arrays of the same shapes for all members, which changes at 8"),
        (lambda n: states_of(n)._replace(q=IDENTITY * off[n]), dict(part=(1, 2)), r"1 member\(s\): 30 .*worst"),
        (lambda n: states_of(n, np.where(n == 30, np.nan, 1.0)[:, None]), dict(part=(1, 2)), r"not finite for.*: 30"),
    ):
        with pytest.raises(ValueError, match=message):
            run(states, **options)


def test_a_part_is_refused_before_it_makes_members_that_do_not_fit_the_memory(tmp_path, monkeypatch):
    internals.memory_of(monkeypatch, 1e9)
    asked = []

    def repeated(numbers):
        asked.append(numbers)
        return states_of(numbers % MEMBERS)

    options = dict(store=tmp_path / "run.zarr", members=10**9, num_steps=0, save_every=None)
    with pytest.raises(
        ValueError, match=r"states of 1\d* members would hold 56\.?\d* GB .* has 1 GB; .* more parts: part"
    ):
        run(repeated, **options)
    with pytest.raises(
        ValueError, match=r"states of \d{8,9} members would hold 5\.6 GB in memory, .* has 1 GB; use fewer"
    ):
        run(repeated, part=(3, 10), **options)
    assert len(asked) <= 4  # one block describes the run
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_store_needs_the_memory_of_two_buffers_of_rows(tmp_path, monkeypatch):
    """One is filled while the other is written; rows are joined along time a few chunks at once."""
    internals.small_chunks(monkeypatch, 1000, joined=2)
    internals.commit_every(monkeypatch, 64)
    members = 8000
    states = li.State(np.tile(IDENTITY, (members, 1)), np.tile(OMEGA[:40], (members // 40, 1)))
    buffer = 64 * members * 65
    run(states, members=None, num_steps=2, save_every=1)  # compiled
    tracemalloc.start()
    try:
        run(states, tmp_path / "run.zarr", members=None, num_steps=191, save_every=1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 3.0 * buffer  # observed: 2.3 to 2.6; 4.8 when all rows were joined at once
    given = li.peak_memory(states, 192, store=tmp_path / "run.zarr")
    assert given == li.peak_memory(
        lambda n: jax.tree.map(lambda x: x[n], states), 192, store=tmp_path / "run.zarr", members=members
    )
    part = li.peak_memory(states, 192, store=tmp_path / "run.zarr", part=(0, 10))
    assert part < given
