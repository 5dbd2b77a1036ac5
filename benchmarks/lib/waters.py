"""A cluster of 64 rigid waters (TIP4P/2005): ours beside jax_md's rigid bodies, with one and the same potential.

Both call our function of the potential, jax_md through its derivative by quaternions. It steps by velocity Verlet, with
turns about one axis after the other (Miller et al. 2002), ours by `splitting` with the exact free rotation. Units: nm,
ps, u, kJ/mol. Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from lib.measure import WIDE

import lieint_jax as li
from lieint_jax.groups import so3
from lieint_jax.runs import compiler_options
from lieint_jax.systems import RigidBodies

SIDE, SPACING, THERMAL = 4, 0.31, 2.494  # bodies on an edge; nm; kT at 300 K, kJ/mol
DT = 1e-3
_SHORT = 2e-3  # nm and radians
_Run = Callable[[Any, int, float], tuple[Any, Any]]  # states, number of steps, dt ↦ states, energy range


def cluster() -> tuple[RigidBodies, li.State]:
    """Waters on a cubic lattice, with random attitudes and momenta of 300 K."""
    molecule, random, count = li.potentials.water(), np.random.default_rng(3), SIDE**3
    side = np.arange(SIDE) * SPACING
    places = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    turns = random.normal(size=(count, 4))
    masses, inertias = np.full(count, molecule.mass), np.tile(molecule.inertia, (count, 1))
    v = random.normal(size=(count, 3)) * np.sqrt(THERMAL / molecule.mass)
    Omega = random.normal(size=(count, 3)) * np.sqrt(THERMAL / molecule.inertia)
    system = li.systems.rigid_bodies(masses, inertias, molecule.potential(count))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    start = system.state(places - places.mean(axis=0), turns, velocities=v - v.mean(axis=0), angular_velocities=Omega)
    return system, _relax(system, start)


def _relax(system: RigidBodies, state: li.State) -> li.State:
    """The state, moved along its forces by short ways, since random attitudes let sites meet; with its own momenta."""
    space = system.phase_space

    def slide(_: Any, state: li.State) -> li.State:
        force = system.force(state.q).ravel()
        way = _SHORT * force / jnp.abs(force).max()
        return space.perturb(state, jnp.concatenate([way, jnp.zeros_like(way)]))._replace(p=state.p)

    return jax.jit(lambda z: lax.fori_loop(0, 500, slide, z))(state)


def ours() -> tuple[Any, _Run]:
    """Our state and loop."""
    system, start = cluster()
    step = li.schemes.splitting(system)
    return start, _looped(lambda z, dt: step(z, dt)[0], system.energy)


def jax_md() -> tuple[Any, _Run]:
    """jax_md's state and loop, from the same positions and momenta."""
    from jax_md import rigid_body, simulate, space  # pyright: ignore[reportMissingImports]

    system, start = cluster()
    V = system.potential

    def energy_of(body: Any) -> Any:
        return V(body.center, jax.vmap(so3.to_matrix)(body.orientation.vec))

    _, shift = space.free()
    make, step = simulate.nve(energy_of, shift, DT)
    body = rigid_body.RigidBody(start.q[:, :3], rigid_body.Quaternion(start.q[:, 3:]))  # pyright: ignore
    mass = rigid_body.RigidBody(system.masses, system.inertias)  # pyright: ignore
    state = make(jax.random.key(0), body, THERMAL, mass=mass)
    Pi = jax.vmap(so3.Ad_star)(start.q[:, 3:], start.p[:, 3:])
    conjugate = rigid_body.angular_momentum_to_conjugate_momentum(body.orientation, Pi)
    state = state.set(momentum=rigid_body.RigidBody(start.p[:, :3], conjugate))  # pyright: ignore

    def total(state: Any) -> Any:
        kinetic = rigid_body.kinetic_energy(state.position, state.momentum, state.mass)
        return kinetic + energy_of(state.position)

    return state, _looped(lambda z, dt: step(z, dt=dt), total)


def _looped(step: Callable[[Any, Any], Any], energy: Callable[[Any], Any]) -> _Run:
    """A compiled loop of any number of steps, and the largest change of the energy at every tenth of them."""

    @partial(jax.jit, compiler_options=compiler_options())
    def run(state: Any, num_steps: Any, dt: Any) -> tuple[Any, Any]:
        first = energy(state)

        def tenth(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, worst = carry
            state = lax.fori_loop(0, num_steps // 10, lambda _, z: step(z, dt), state)
            return state, jnp.maximum(worst, jnp.abs(energy(state) - first))

        return lax.fori_loop(0, 10, tenth, (state, jnp.zeros(())))

    return run


def everything(steps: int, rounds: int, notes: list[str]) -> list[dict[str, Any]]:
    """Steps a second at a femtosecond, and the energy's error over one stretch of time at that and at equal cost."""
    makers, entries = (("ours, splitting" + WIDE, ours), ("jax_md, NVE" + WIDE, jax_md)), {}
    for name, make in makers:
        try:
            entries[name] = make()
        except ImportError as error:
            notes.append(f"{name} left out: {error}")
    seconds: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(rounds + 1):
        for name, (state, run) in entries.items():
            began = time.perf_counter()
            jax.block_until_ready(run(state, steps, DT))
            seconds[name].append(time.perf_counter() - began)
    best = {name: min(found[1:]) / steps for name, found in seconds.items()}
    system, start = cluster()
    kinetic, slowest = float(system.kinetic_energy(start)), max(best.values())
    found = []
    for name, (state, run) in entries.items():
        count = 10 * round(steps * slowest / best[name] / 10)  # of steps that cost as much as `steps` of the slowest
        same, equal = run(state, steps, DT)[1], run(state, count, steps * DT / count)[1]
        found.append(
            {
                "name": name,
                "rate": 1 / best[name],
                "compile_seconds": seconds[name][0] - best[name] * steps,
                "error": float(same) / kinetic,
                "equal_dt": steps * DT / count,
                "equal_error": float(equal) / kinetic,
            }
        )
    return found
