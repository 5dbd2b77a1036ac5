"""Batches: the same numbers as one body at a time, a report that names member and step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_bodies import rows

import lieint_jax as li
from lieint_jax import State

J123 = np.array([1.0, 2.0, 3.0])
BODY = li.systems.rigid_body(J123)
STEP = li.schemes.so3_midpoint(BODY)


def states(members, size=0.5):
    rng = np.random.default_rng(4)
    q, Omega = rng.normal(size=(members, 4)), rng.normal(size=(members, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    Omega *= size / np.linalg.norm(Omega, axis=1, keepdims=True)
    p = [np.array(rows(*x)).T @ (J123 * v) for x, v in zip(q, Omega, strict=True)]
    return State(jnp.array(q), jnp.array(np.array(p)))


alone = jax.jit(li.integrate, static_argnames=("num_steps", "save_every"))


def test_the_batch_is_the_bodies_one_by_one():
    batch = states(5)
    run = li.run(STEP, batch, 0.1, 60, save_every=20, progress=False)
    assert run.state.q.shape == (4, 5, 4)
    np.testing.assert_allclose(run.t, [0, 2, 4, 6], rtol=1e-15)
    assert run.info.converged.all()
    for m in range(5):
        one = alone(STEP, State(np.asarray(batch.q)[m], np.asarray(batch.p)[m]), 0.1, 60, save_every=20)
        np.testing.assert_allclose(np.asarray(run.state.q)[:, m], one.state.q, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(np.asarray(run.state.p)[:, m], one.state.p)


@pytest.mark.long
def test_an_ensemble_may_save_the_last_state_only_and_give_each_member_an_inertia():
    batch = states(4)
    J = np.array([[1.0, 2, 3], [1, 1, 2], [2, 2, 2], [1, 1.5, 2]])
    steps = jax.jit(jax.vmap(lambda J: li.schemes.so3_midpoint(li.systems.rigid_body(J))))(J)
    run = li.run(steps, batch, 0.1, 150, own_step=True, progress=False, save_every=None)
    assert run.state.q.shape == (2, 4, 4)
    member = State(np.asarray(batch.q)[1], np.asarray(batch.p)[1])
    one = alone(li.schemes.so3_midpoint(li.systems.rigid_body(J[1])), member, 0.1, 150, save_every=150)
    np.testing.assert_allclose(np.asarray(run.state.q)[-1, 1], one.state.q[1], rtol=0, atol=1e-14)


@pytest.mark.long
def test_the_first_failure_of_each_member_is_found():
    """Bodies that hang from a heavy point fall faster than the scheme can turn, each after its own number of steps."""
    top = li.systems.heavy_top([1.0, 2.0, 2.5], [0.0, 0.0, 12.0])
    step, dt = li.schemes.splitting(top), 0.2
    slow = 0.1 * jnp.asarray(np.random.default_rng(1).normal(size=(70, 3)))
    batch = jax.vmap(lambda w: top.state(angular_velocity=w))(slow)
    with pytest.warns(RuntimeWarning, match="did not converge at every step"):
        run = li.run(step, batch, dt, 40, save_every=4, reduce="energy", progress=False).summary
    each = jax.vmap(lambda z: li.integrate(step, z, dt, 40, save_every=1).info.converged)(batch)[:, 1:]
    first = np.where(np.all(each, axis=1), -1, np.argmin(each, axis=1))
    assert len(set(first.tolist())) > 2
    np.testing.assert_array_equal(run.failed, first)
    failing = np.sum(~np.asarray(each).reshape(70, 10, 4).all(axis=2), axis=0)
    np.testing.assert_array_equal(run.unconverged[1:4], failing[:3])  # later, what has failed is chaos


def test_the_progress_bar_goes_to_a_terminal_and_nowhere_else(capfd, monkeypatch):
    li.run(STEP, states(2), 0.1, 200, save_every=None)
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    li.run(STEP, states(2), 0.1, 200, save_every=None)
    out, err = capfd.readouterr()
    assert out == ""
    assert "step" in err


CELLS = """
import jax, jax.numpy as jnp, numpy as np
import lieint_jax as li
jax.config.update("jax_enable_x64", True)
body = li.systems.rigid_body([1.0, 2.0, 3.0])
step = li.schemes.so3_midpoint(body)
states = jax.vmap(lambda w: body.state(angular_velocity=w))(np.full((1000, 3), 0.1))
---
_ = li.run(step, states, 0.01, 100, save_every=None)
---
_ = li.run(step, states, 0.01, 60_000, save_every=None)
"""


@pytest.mark.long
def test_a_notebook_shows_a_bar_below_the_cell_of_a_run_that_takes_long():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in CELLS.split("---")])
    nbclient.NotebookClient(notebook, kernel_name="python3").execute()
    printed = ["".join(o.get("text", "") for o in cell.outputs) for cell in notebook.cells]
    assert printed[:2] == ["", ""]
    assert "body-steps/s, energy" in printed[2]
