"""The command `lieint info` describes a run in a store."""

from pathlib import Path

import jax
import numpy as np
import pytest

import lieint_jax as li

BODY = li.systems.rigid_body([1.0, 2.0, 3.0])


def test_the_date_of_a_run_is_shown(lieint):
    date = "2026-03-01T12:00:00 TDB"
    states = jax.vmap(lambda w: BODY.state(angular_velocity=w))(np.array([[0.2, 0.0, 1.0], [0.3, -0.5, 0.8]]))
    step = li.schemes.so3_midpoint(BODY)
    li.run(step, states, 0.1, 100, save_every=10, store="a.zarr", epoch=date, progress=False)
    assert f"t = 0 … 10; t = 0 at {date}" in lieint("info", "a.zarr")
    assert li.open("a.zarr").epoch == li.dates.epoch(date)


def test_a_run_of_one_body_is_described_drawn_and_animated(lieint):
    state = BODY.state(angular_velocity=[0.1, 0.2, 1.0])
    li.run(li.schemes.so3_midpoint(BODY), state, 0.1, 20, store="one.zarr", progress=False)
    described = lieint("info", "one.zarr")
    assert "1 member(s), 20 steps of 0.1" in described
    assert "1 of 1 members converged at every step" in described
    assert "1 of 1 members converged at every step" in lieint("plot", "one.zarr")
    lieint.drew("one-errors.png", "one-motion.png")
    lieint("animate", "one.zarr", "--seconds", "0.2")
    assert Path("one.gif").read_bytes().startswith(b"GIF")


def test_a_store_of_a_custom_scheme_is_described_by_its_system(lieint):
    """Its class is not imported, and its step cannot be rebuilt; energies need the system only."""
    step = li.schemes.so3_explicit(BODY)
    Own = li.pytree(type("Own", (type(step),), {"__module__": __name__, "__annotations__": {}}))
    state = BODY.state(angular_velocity=[0.1, 0.2, 1.0])
    li.run(Own(**vars(step)), state, 0.1, 8, progress=False, store="own.zarr")
    assert "largest change of energy" in lieint("info", "own.zarr")
    assert "a step of the user's" in lieint("plot", "own.zarr")
    with pytest.raises(ValueError, match=r"test_info\.Own"):
        li.open("own.zarr")
