"""A stored run is resumed by the same equations only; what differs is named."""

import os
import subprocess
import sys
from pathlib import Path

import internals
import jax
import jax.numpy as jnp
import laws_alike
import numpy as np
import pytest
from stores import assert_same

import lieint_jax as li

MEMBERS = 256


def run(rate, path=None, last=1.0, members=MEMBERS, **options):
    """A run of attitudes that rotate at a given rate, from times up to the last one."""
    spin = li.systems.kinematics(li.groups.so3, rate)
    states = jax.vmap(lambda t: spin.state(t=t))(jnp.linspace(0.0, last, members))
    options = dict(dt=0.01, num_steps=600, save_every=100, progress=False, store=path) | options
    return li.run(li.schemes.magnus(spin, order=2), states, **options)


def turning(k):
    """A rate that is the same function for every k but for its decorator."""

    class Rate:
        @laws_alike.scaled(k)
        def __call__(self, t):
            return jnp.array([jnp.cos(t), 0.3, 0.0])

    return Rate()


class Begun(Exception):  # noqa: N818
    """The run would begin to integrate."""


@pytest.fixture
def no_loop(monkeypatch):
    """A store is made, and no step: a run begins to integrate by an error."""
    internals.refuse_to_integrate(monkeypatch, Begun)
    internals.by_engine(monkeypatch, "xla")  # the other would compare a step with it


def begin(*arguments, **options):
    with pytest.raises(Begun):
        run(*arguments, **options)


ELSEWHERE = "from test_resume import turning, run; import sys; run(turning(1.0), sys.argv[1], resume=True)"


def test_a_run_is_resumed_by_the_same_function_in_another_process_bit_for_bit_and_not_by_another(tmp_path, monkeypatch):
    path = tmp_path / "run.zarr"
    with monkeypatch.context() as patch:
        internals.commit_every(patch, 2)
        internals.interrupt_after_the_first_call(patch)
        with pytest.raises(KeyboardInterrupt):
            run(turning(1.0), path)
    own = {"test_resume.turning.<locals>.Rate object": turning(1.0)}
    assert 1 < len(li.open(path, own=own).t) < 7
    before = {f: f.read_bytes() for f in path.rglob("*") if f.is_file()}
    with pytest.raises(
        ValueError, match=r"holds another run and cannot be resumed .*: the equations of the step differ$"
    ):
        run(turning(5.0), path, resume=True)
    assert before == {f: f.read_bytes() for f in path.rglob("*") if f.is_file()}
    folders = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": folders, "PYTHONHASHSEED": "7", "JAX_ENABLE_X64": "1"}
    subprocess.run([sys.executable, "-c", ELSEWHERE, str(path)], env=environment, check=True)
    assert_same(li.open(path, own=own).state, run(turning(1.0)).state)


def highest(k):
    return lambda step, z: k * z.q[0]


def above(k):
    return lambda step, z: z.q[0] > k


@pytest.mark.usefixtures("no_loop")
@pytest.mark.parametrize(
    ("others", "sentence"),
    [
        (dict(rate=turning(5.0)), "the equations of the step differ"),
        (dict(reduce=highest(2.0)), "the equations of reduce differ"),
        (dict(first=above(0.6)), "the equations of first differ"),
        (
            dict(rate=turning(5.0), reduce=highest(2.0)),
            "the equations of reduce differ; the equations of the step differ",
        ),
    ],
)
def test_the_function_that_differs_is_named(tmp_path, others, sentence):
    def options():
        return dict(rate=turning(1.0), reduce=highest(1.0), per="member", first=above(0.5), save_every=None)

    path = tmp_path / "run.zarr"
    begin(path=path, **options())
    begin(path=path, resume=True, **options())
    with pytest.raises(ValueError, match=f"cannot be resumed by this one: {sentence}$"):
        run(path=path, resume=True, **options() | others)


@pytest.mark.usefixtures("no_loop")
@pytest.mark.parametrize(
    ("others", "sentence"),
    [
        (dict(dt=0.02), r"dt is 0\.01 in the store and 0\.02 here"),
        (dict(save_every=200), "save_every is 100 in the store and 200 here"),
        (
            dict(save_every=None, save_at=[0.5, 1.2]),
            r"the equations .*; save_every is 100 in .* here; the times of save_at differ",
        ),
        (dict(num_steps=500), "num_steps is 600 in the store and 500 here"),
        (dict(members=255), r"the initial states differ \(p, q, t\); members is 256 in the store and 255 here"),
        (dict(last=2.0), r"the initial states differ \(t\)"),
        (dict(reduce="energy"), "the equations of reduce differ; reduce is None in the store and 'energy' here"),
        (dict(epoch="2020-01-01 TDB"), "epoch is None in the store and '2020-01-01.*' here"),
    ],
    ids=lambda x: next(iter(x)) if isinstance(x, dict) else "",
)
def test_the_argument_that_differs_is_named(tmp_path, others, sentence):
    begin(turning(1.0), tmp_path / "run.zarr")
    with pytest.raises(ValueError, match=rf"cannot be resumed by this one: {sentence}$"):
        run(turning(1.0), tmp_path / "run.zarr", resume=True, **others)


@pytest.mark.usefixtures("no_loop")
def test_numbers_of_a_law_are_compared_as_those_of_the_step(tmp_path):
    def rate(k):
        return jax.tree_util.Partial(lambda k, t: k * jnp.array([jnp.cos(t), 0.3, 0.0]), k)

    begin(rate(0.1), tmp_path / "run.zarr")
    begin(rate(0.1), tmp_path / "run.zarr", resume=True)
    with pytest.raises(ValueError, match=r"by this one: the numbers of the step differ \(system\.rate\.0\.0\)$"):
        run(rate(0.7), tmp_path / "run.zarr", resume=True)


@pytest.mark.usefixtures("no_loop")
@pytest.mark.parametrize(
    "options",
    [dict(save_every=None, save_at=[0.5, 1.234], reduce=None), dict(dt=None, times=np.linspace(0.0, 2.0, 601) ** 2)],
    ids=["save_at", "times"],
)
def test_equations_are_compared_whatever_the_times(tmp_path, options):
    options = dict(num_steps=None, last=0.0) | options if "times" in options else options
    begin(turning(1.0), tmp_path / "run.zarr", **options)
    begin(turning(1.0), tmp_path / "run.zarr", resume=True, **options)
    with pytest.raises(ValueError, match=r"by this one: the equations of the step differ$"):
        run(turning(5.0), tmp_path / "run.zarr", resume=True, **options)


@pytest.mark.usefixtures("no_loop")
@pytest.mark.parametrize("scheme", ["exact", "so3_midpoint"])
def test_a_system_for_each_member_and_constants_of_a_step_are_compared(tmp_path, scheme):
    """`exact` computes constants once for all steps."""

    def begin(J, resume=False, reduce="energy"):
        steps = jax.vmap(lambda J: getattr(li.schemes, scheme)(li.systems.rigid_body(J)))(J)
        states = jax.vmap(lambda s: s.system.state(angular_velocity=jnp.array([0.2, 0.0, 1.0])))(steps)
        options = dict(own_step=True, progress=False, store=tmp_path / "run.zarr", resume=resume, reduce=reduce)
        li.run(steps, states, 0.1, 20, **options)

    J = np.linspace(1.0, 1.5, 5)[:, None] * [1.0, 2.0, 2.5]
    for resume in (False, True):
        with pytest.raises(Begun):
            begin(J, resume)
    named = r"the initial states differ \(p\); the numbers of the step differ \(system\.inertia\)$"
    with pytest.raises(ValueError, match=named):
        begin(1.1 * J, resume=True)
    with pytest.raises(ValueError, match="the equations of reduce differ; reduce is"):
        begin(J, resume=True, reduce=lambda step, z: step.system.energy(z) + 0)


@pytest.mark.usefixtures("no_loop")
@pytest.mark.parametrize("reduced", [False, True])
def test_a_rule_for_many_members_is_compared(tmp_path, reduced):
    def rate(factor):
        @jax.custom_batching.custom_vmap
        def turned(t):
            return jnp.array([jnp.cos(t), 0.3, 0.0])

        @turned.def_vmap
        def rule(size, batched, t):
            return factor * jax.vmap(lambda t: jnp.array([jnp.cos(t), 0.3, 0.0]))(t), True

        return turned

    def options(factor):
        value = rate(factor)
        return {"reduce": lambda step, z: value(z.t) @ jnp.ones(3)} if reduced else {}

    path, what = tmp_path / "run.zarr", "reduce" if reduced else "the step"
    begin(rate(1.0), path, **options(1.0))
    begin(rate(1.0), path, resume=True, **options(1.0))
    with pytest.raises(ValueError, match=f"by this one: the equations of {what} differ$"):
        run(rate(1.0 if reduced else 2.0), path, resume=True, **options(2.0))


@pytest.mark.usefixtures("no_loop")
def test_versions_are_compared_and_named_first(tmp_path, monkeypatch):
    path = tmp_path / "run.zarr"
    begin(turning(1.0), path)
    internals.another_version(monkeypatch, jax="9.9")
    named = rf"versions.jax is '{jax.__version__}' in the store and '9.9' here"
    with pytest.raises(ValueError, match=rf"on another machine, whose last bits may differ: {named}\. Pass same_bits"):
        run(turning(1.0), path, resume=True)
    begin(turning(1.0), path, resume=True, same_bits=False)
    for same_bits in (True, False):  # another JAX may trace one function into other equations
        refused = rf"begun with other packages.*: {named}; the equations of the step differ\. Resume it with those"
        with pytest.raises(ValueError, match=refused):
            run(turning(5.0), path, resume=True, same_bits=same_bits)
    with pytest.raises(ValueError, match=rf"holds another run .* by this one: {named}; dt is 0.01 in the store"):
        run(turning(5.0), path, resume=True, dt=0.02)
    monkeypatch.undo()
    internals.by_engine(monkeypatch, "xla")
    internals.refuse_to_integrate(monkeypatch, Begun)
    internals.another_version(monkeypatch, lieint_jax="9.9")
    with pytest.raises(ValueError, match=r"by this one: versions.lieint_jax is '.*' in the store and '9.9' here$"):
        run(turning(5.0), path, resume=True)


def test_the_engines_compute_the_same_equations(tmp_path, monkeypatch):
    internals.refuse_to_integrate(monkeypatch, Begun)
    begin(turning(1.0), tmp_path / "run.zarr")
    internals.by_engine(monkeypatch, "xla")
    begin(turning(1.0), tmp_path / "run.zarr", resume=True, same_bits=False)
    with pytest.raises(ValueError, match=r"by this one: the equations of the step differ; .*engine is 'native' in"):
        run(turning(5.0), tmp_path / "run.zarr", resume=True, same_bits=False)


def called(t):
    shape = jax.ShapeDtypeStruct((3,), t.dtype)
    return jax.pure_callback(lambda t: np.cos(t) * np.eye(3)[0], shape, t, vmap_method="sequential")


def test_a_run_that_calls_back_into_python_is_stored_and_not_resumed(tmp_path):
    path, reason = tmp_path / "run.zarr", r"the equations of the step cannot be compared: they call back into Python"
    options = dict(num_steps=4, save_every=2)
    with pytest.warns(RuntimeWarning, match=f"this run cannot be resumed: {reason}"):
        stored = run(called, path, **options)
    angle = np.sin(stored.state.t[-1]) - np.sin(stored.state.t[0])
    np.testing.assert_allclose(
        np.abs(stored.state.q[-1, :, 1]), np.sin(angle / 2), rtol=0, atol=1e-7
    )  # second order: 1e-8
    for rate in (called, turning(1.0)):
        with pytest.raises(ValueError, match=rf"can neither be resumed nor be written in parts: {reason}"):
            run(rate, path, resume=True, **options)
    with pytest.raises(ValueError, match=rf"can neither be resumed nor be written in parts: {reason}"):
        run(called, tmp_path / "parts.zarr", part=(0, 2), **options)
