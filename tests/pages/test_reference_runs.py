"""The reference runs of the site: recomputed to the last bit, and the package's own runs compared with them."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_runs

import lieint_jax as li
from lieint_jax import orbits, potentials, schemes, systems, torques

FILES = {name: json.loads((reference_runs.FOLDER / f"{name}.json").read_text()) for name in reference_runs.MOTIONS}

QUICK = ("free_body", "heavy_top")
ALL = [pytest.param(name, marks=[] if name in QUICK else pytest.mark.long) for name in FILES]


def start_of(name, *sizes):
    """The columns after t of the first row, cut into vectors of these sizes."""
    return np.split(np.array(FILES[name]["states"][0][1:]), np.cumsum(sizes)[:-1])


def body_columns(body):
    return lambda state: jnp.concatenate([state.q, body.angular_velocity(state)])


def bodies_columns(bodies):
    def columns(state):
        velocities = state.p[:, :3] / bodies.masses[:, None]
        parts = state.q[:, :3], state.q[:, 3:], velocities, bodies.angular_velocities(state)
        return jnp.concatenate([x.ravel() for x in parts])

    return columns


def free_body():
    J = FILES["free_body"]["inputs"]["J"]
    q, W = start_of("free_body", 4, 3)
    body = systems.rigid_body(J)
    return body, body.state(q, angular_velocity=W), body_columns(body)


def heavy_top():
    inputs = FILES["heavy_top"]["inputs"]
    q, W = start_of("heavy_top", 4, 3)
    top = systems.heavy_top(inputs["J"], inputs["c"])
    return top, top.state(q, angular_velocity=W), body_columns(top.free)


def satellite():
    inputs = FILES["satellite"]["inputs"]
    q, W, r, v = start_of("satellite", 4, 3, 3, 3)
    orbit = orbits.from_state(1.0, r, v)

    def field(t):
        r = orbit(t)[0]
        size = jnp.linalg.norm(r)
        return 3 * r[2] * r / size**5 - jnp.array([0, 0, 1.0]) / size**3

    magnetic, drag = torques.dipole(inputs["m"], field), torques.viscous(inputs["d"])
    law = torques.gravity_gradient(orbit, inputs["J"]) + magnetic + drag
    body = systems.torqued_body(inputs["J"], law)

    def columns(state):
        return jnp.concatenate([state.q, body.angular_velocity(state), *orbit(state.t)])

    return body, body.state(q, angular_velocity=W, t=0.0), columns


def binary():
    inputs = FILES["binary"]["inputs"]
    x, q, v, W = start_of("binary", 6, 8, 6, 6)
    masses, inertias = [inputs["m_1"], inputs["m_2"]], [inputs["J_1"], inputs["J_2"]]
    bodies = systems.rigid_bodies(masses, inertias, potentials.maccullagh(1.0, masses, inertias))
    x, v, W = (a.reshape(2, 3) for a in (x, v, W))
    start = bodies.state(x, q.reshape(2, 4), velocities=v, angular_velocities=W)
    return bodies, start, bodies_columns(bodies)


def elastic():
    inputs = FILES["elastic"]["inputs"]
    F, V = (x.reshape(3, 3) for x in start_of("elastic", 9, 9))
    body = systems.pseudo_rigid_body(inputs["E"], systems.saint_venant_kirchhoff(inputs["lambda"], inputs["mu"]))
    return body, body.state(F, velocity=V), lambda s: jnp.concatenate([s.q.ravel(), body.velocity(s).ravel()])


def rod():
    inputs = FILES["rod"]["inputs"]
    x, q, v, W = (a.reshape(3, -1) for a in start_of("rod", 9, 12, 9, 9))
    section = systems.Section(1.0, inputs["J_2"][:2], inputs["C"], inputs["B"])
    chain = systems.rod(2.0, 2, section)
    np.testing.assert_array_equal(chain.masses, [inputs[f"m_{k}"] for k in (1, 2, 3)])
    np.testing.assert_array_equal(chain.inertias, [inputs[f"J_{k}"] for k in (1, 2, 3)])
    return chain, chain.state(x, q, velocities=v, angular_velocities=W), bodies_columns(chain)


RUNS = {  # the largest difference in all columns and times: a bound, and what is observed
    ("free_body", "exact"): (schemes.exact, 1, 2e-14),  # 2e-15 to 5e-15
    ("free_body", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 8, 2e-13),  # 5e-14 to 7e-14
    ("heavy_top", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 16, 5e-13),  # 2e-14 to 1.5e-13
    ("heavy_top", "gauss"): (lambda s: schemes.gauss(s, 8), 8, 3e-13),  # 3e-15 to 8e-14
    ("satellite", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 16, 3e-13),  # 5e-14
    ("satellite", "midpoint"): (
        lambda s: schemes.compose(schemes.torqued_midpoint(s), 10),
        16,
        1e-12,
    ),  # 2e-14 to 3e-13
    ("binary", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 16, 5e-13),  # 4e-14 to 9e-14
    ("binary", "gauss"): (lambda s: schemes.gauss(s, 8), 8, 2e-13),  # 9e-15 to 5e-14
    ("elastic", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 8, 2e-13),  # 3e-14 to 4e-14
    ("elastic", "gauss"): (lambda s: schemes.gauss(s, 8), 8, 1e-14),  # 8e-16 to 2e-15
    ("rod", "extrapolate"): (lambda s: schemes.extrapolate(s, 14), 16, 1e-13),  # 2e-14
    ("rod", "gauss"): (lambda s: schemes.gauss(s, 8), 8, 1e-14),  # 2e-15
}


@pytest.mark.parametrize("name", ALL)
def test_a_file_is_what_its_equations_give_to_the_last_bit(name):
    """By shorter steps and a lower order than those of the file."""
    motion = reference_runs.MOTIONS[name]()
    found = reference_runs.states(motion, 0.7 * motion.longest, 36)
    assert [row[1:] for row in FILES[name]["states"]] == found
    assert [row[0] for row in FILES[name]["states"]] == motion.times
    assert FILES[name]["inputs"] == motion.inputs
    assert len(FILES[name]["columns"]) == 1 + len(motion.start)


@pytest.mark.parametrize(
    ("name", "scheme"),
    [pytest.param(*key, marks=[] if key[0] in QUICK and key[1] != "gauss" else pytest.mark.long) for key in RUNS],
)
def test_runs_of_the_package_agree_with_the_files(name, scheme):
    make, steps, bound = RUNS[name, scheme]
    system, start, columns = globals()[name]()
    rows = np.array(FILES[name]["states"])
    run = li.integrate(make(system), start, rows[1, 0] / steps, 10 * steps, save_every=steps)
    assert bool(run.info.converged.all())
    np.testing.assert_allclose(jax.jit(jax.vmap(columns))(run.state), rows[:, 1:], rtol=0, atol=bound)
