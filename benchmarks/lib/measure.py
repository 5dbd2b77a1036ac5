"""Measurements of contestants: rates, errors against a reference, drifts of the invariants.

Importing this imports jax: pin the process to a core first.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from lib import cpp, peers
from lib.contest import Contestant, Timing, race, steps_lasting

import lieint_jax as li
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa, kappa_cayley, kappa_exponential, kappa_symplectic
from lieint_jax.runs import compiler_options
from lieint_jax.systems import RigidBody

jax.config.update("jax_enable_x64", True)

INERTIA, DT, END, WATCHED, BATCH = (1.0, 2.0, 3.0), 0.05, 10.0, 16, 1000
KAPPAS = (kappa_symplectic, kappa_cayley, kappa_exponential)
DTYPES = ("float64", "float32")
WIDE = ", wide vectors"
_PACKAGES = (
    "jax",
    "numpy",
    "diffrax",
    "mujoco",
    "scipy",
    "heyoka",
    "astrojax",
    "jax_md",
    "rebound",
    "reboundx",
    "pyelastica",
    "exudyn",
)
_LEVELS = (4, 8)  # steps per unit of time of the two references by `by_flow`


States = tuple[np.ndarray, np.ndarray]  # configurations and momenta


class Sizes(NamedTuple):
    """The extent of the measurements.

    Attributes:
        batches: numbers of bodies in the scaling table.
        seconds: approximate duration of one timed call.
        rounds: timed calls of each contestant.
        drift_steps: steps of the drift run.
        drift_seconds: approximate longest duration of the drift run; slow peers take fewer steps.
    """

    batches: tuple[int, ...] = (1, 1000, 100_000)
    seconds: float = 0.15
    rounds: int = 5
    drift_steps: int = 100_000
    drift_seconds: float = 10.0


QUICK = Sizes((1, 1000), 0.02, 3, 2_000, 1.0)


def bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random unit quaternions, and the spatial momenta of random body velocities in the unit ball."""
    attitude, velocity, radius = (np.random.default_rng(seed) for seed in (1, 2, 3))
    q, Omega = attitude.normal(size=(count, 4)), velocity.normal(size=(count, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    Omega *= np.cbrt(radius.random((count, 1))) / np.linalg.norm(Omega, axis=1, keepdims=True)
    return q, np.asarray(jax.vmap(so3.Ad)(jnp.asarray(q), jnp.asarray(INERTIA * Omega)))


def body(dtype: str = "float64") -> RigidBody:
    return li.systems.rigid_body(np.asarray(INERTIA, dtype))


def midpoint(kappa: Kappa, dtype: str = "float64") -> Contestant:
    """The paper's scheme at dt = DT."""
    step = li.schemes.so3_midpoint(body(dtype), kappa)
    pace = {"symplectic": 9e7, "cayley": 4e7}.get(kappa.name, 2e7)
    return ours(f"ours, {kappa.name} κ", step, DT, pace=pace)


def ours(
    name: str,
    step: li.Step,
    dt: float,
    start: Callable[[li.State], li.State] = lambda z: z,
    pace: float = 1e6,
    times: Callable[[int], np.ndarray] | None = None,
) -> Contestant:
    """A step through `li.run`, the whole call; `start` adds to states (q, p) what else the initial ones hold.

    With `times`, number of steps ↦ step boundaries, those are taken in place of steps of dt.
    """
    dtype = str(jax.tree.leaves(step.system)[0].dtype)

    def load(q: np.ndarray, p: np.ndarray) -> tuple[li.State, Any]:
        return start(_state(q, p, dtype)), None

    def advance(states: tuple[li.State, Any], num_steps: int) -> tuple[li.State, Any]:
        given: dict[str, Any] = {"dt": dt, "num_steps": num_steps} if times is None else {"times": times(num_steps)}
        run = li.run(step, states[0], **given, save_every=None, progress=False)
        return jax.tree.map(lambda x: x[-1], (run.state, run.info))

    return Contestant(name, dtype, pace, load, advance, read_states, solve_info)


def vmapped(name: str, step: li.Step, dt: float, pace: float = 1e7) -> Contestant:
    """A step in a custom program, `jax.jit` of a vmapped `integrate`, which XLA compiles for each number of steps."""
    dtype = str(jax.tree.leaves(step.system)[0].dtype)

    @partial(jax.jit, static_argnums=1, compiler_options=compiler_options())
    def run(states: li.State, n: int) -> tuple[li.State, li.StepInfo]:
        trajectory = jax.vmap(lambda z: li.integrate(step, z, dt, n, save_every=n))(states)
        return jax.tree.map(lambda leaf: leaf[:, -1], (trajectory.state, trajectory.info))

    def load(q: np.ndarray, p: np.ndarray) -> tuple[li.State, Any]:
        return _state(q, p, dtype), None

    def advance(states: tuple[li.State, Any], num_steps: int) -> tuple[li.State, Any]:
        return jax.block_until_ready(run(states[0], num_steps))

    return Contestant(name, dtype, pace, load, advance, read_states, solve_info)


def read_states(states: tuple[li.State, Any]) -> States:
    """Configurations and momenta."""
    return np.asarray(states[0].q), np.asarray(states[0].p)


def solve_info(states: tuple[li.State, Any]) -> tuple[float, bool]:
    """The largest residual so far, and whether all steps converged."""
    return float(np.max(states[1].residual)), bool(np.all(states[1].converged))


def contestants(missing: list[str]) -> list[Contestant]:
    """All contestants at dt = DT; a note on each one whose package is not installed is appended to `missing`."""
    makers: list[tuple[str, Callable[[], Contestant]]] = []
    for dtype in DTYPES:
        for form in ("newton", "scalar"):
            makers.append(("C++", partial(cpp.symplectic, form, INERTIA, DT, dtype)))
        for kappa in KAPPAS:
            makers.append(("ours", partial(midpoint, kappa, dtype)))
        custom = li.schemes.so3_midpoint(body(dtype), kappa_symplectic)
        makers.append(("ours", partial(vmapped, "ours, symplectic κ, custom jax.vmap", custom, DT, 9e7)))
        for peer in (peers.tsit5, peers.dopri8):
            makers.append(("diffrax", partial(peer, INERTIA, DT, dtype)))
    makers.append(("MuJoCo", partial(peers.mujoco_rk4, INERTIA, DT)))
    makers.append(("scipy", partial(peers.dop853, INERTIA, DT)))
    return list(those_here(makers, missing))


def those_here(makers: Sequence[tuple[str, Callable[[], Contestant]]], missing: list[str]) -> Iterator[Contestant]:
    """The contestants that can be made; a note on each other one is appended to `missing`."""
    for name, make in makers:
        try:
            yield make()
        except ImportError as error:
            note = f"{name} left out: {error}"
            if note not in missing:
                missing.append(note)


def everything(sizes: Sizes) -> dict[str, Any]:
    """All results, as values that JSON can hold. Run it on one core."""
    notes: list[str] = []
    entries = contestants(notes)
    notes += cpp.notes("free_rigid_body")
    same_scheme = [c for c in entries if "symplectic" in c.name]
    exact, doubt = reference(END)
    return {
        "machine": machine(),
        "rates": [r for b in sizes.batches for r in rates(entries if b == BATCH else same_scheme, b, sizes)],
        "quality": [quality(c, exact, sizes, body()) for c in entries],
        "agreement": agreement(same_scheme),
        "reference_doubt": doubt,
        "notes": notes,
    }


def machine() -> dict[str, Any]:
    cpu = re.search("model name.*: (.*)", Path("/proc/cpuinfo").read_text())
    return {
        "cpu": cpu.group(1) if cpu else platform.processor(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def our_rates(sizes: Sizes) -> list[dict[str, Any]]:
    """Rates of our symplectic step alone."""
    entries = [midpoint(kappa_symplectic, dtype) for dtype in DTYPES]
    return [r for b in sizes.batches for r in rates(entries, b, sizes)]


def rates(
    entries: Sequence[Contestant], count: int, sizes: Sizes, start: Callable[[int], States] = bodies
) -> list[dict[str, Any]]:
    """Body-steps a second with `count` bodies; scipy, which takes one after the other, gets `WATCHED` of them."""
    q, p = start(count)
    found = []
    for single in (False, True):
        group = [c for c in entries if c.name.startswith("scipy") == single]
        watched = min(count, WATCHED) if single else count
        steps = [steps_lasting(sizes.seconds, c, watched) for c in group]
        timings = race(group, q[:watched], p[:watched], steps, sizes.rounds)
        found += [_record(c, t, count) for c, t in zip(group, timings, strict=True)]
    return found


def _record(contestant: Contestant, timing: Timing, count: int) -> dict[str, Any]:
    return {
        "name": contestant.name,
        "dtype": contestant.dtype,
        "bodies": count,
        "rate": timing.rate,
        "median_rate": timing.median_rate,
        "compile_seconds": timing.compile_seconds,
    }


def reference(end: float) -> tuple[np.ndarray, float]:
    """Attitudes of the watched bodies at t = end by `RigidBody.solution`, and their distance from `diagnostics.flow`.

    The two methods share nothing; their distance is due to the rounding errors of the many steps of the latter.
    """
    states = _state(*bodies(WATCHED))
    exact = np.asarray(jax.jit(jax.vmap(body().solution, (0, None)))(states, end).q)
    steps = round(4 * end)
    flowed = jax.jit(jax.vmap(lambda z: li.diagnostics.flow(body(), z, end, steps)))(states).q
    return exact, attitude_error(np.asarray(flowed), exact)


def by_flow(
    system: Any, start: States, end: float, apart: Callable[[np.ndarray, np.ndarray], Any] | None = None
) -> tuple[np.ndarray, Any]:
    """q at t = end by `diagnostics.flow`, and its distance from that with half as many steps, in radians or `apart`."""
    states = li.State(jnp.asarray(start[0]), jnp.asarray(start[1]))
    flow = jax.jit(jax.vmap(li.diagnostics.flow, (None, 0, None, None)), static_argnums=3)
    coarse, fine = (np.asarray(flow(system, states, end, round(level * end)).q) for level in _LEVELS)
    return fine, (apart or attitude_error)(coarse, fine)


def attitude_error(q: np.ndarray, exact: np.ndarray) -> float:
    """The largest angle between two sets of attitudes, in radians."""
    return float(attitude_errors(q, exact).max())


def attitude_errors(q: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """The angles between attitudes, in radians."""
    return np.asarray(jax.vmap(so3.angle)(jnp.asarray(_unit(q)), jnp.asarray(exact)))


def energy_drift(system: Any, q: np.ndarray, p: np.ndarray) -> float:
    """The largest |H − H₀|/H₀ of states (times, bodies, …) at attitudes q/|q|; for tops |H − H₀|/(T₀ + |E|)."""
    states = _state(_unit(q), p)
    H = np.asarray(jax.vmap(jax.vmap(system.energy))(states))
    weight = getattr(getattr(system, "potential", None), "weight", np.zeros(3))
    size = np.asarray(jax.vmap(system.kinetic_energy)(jax.tree.map(lambda x: x[0], states))) + np.linalg.norm(weight)
    return float(np.max(np.abs(H - H[0]) / size))


def quality(
    contestant: Contestant,
    exact: np.ndarray,
    sizes: Sizes,
    system: Any,
    bodies: Callable[[int], States] = bodies,
    apart: Callable[[np.ndarray, np.ndarray], float] = attitude_error,
    energy_drift: Callable[[Any, np.ndarray, np.ndarray], float] = energy_drift,
) -> dict[str, Any]:
    """Accuracy and conservation of a contestant at dt = DT, the worst of the watched bodies.

    The attitude error at t = END; then, over ten times of a long run, the largest |H − H₀|/H₀, |Φ − Φ₀|/|π₀| for the
    momentum map Φ (0 means bit for bit) and residual, and whether all steps converged (None for explicit methods).
    """
    start = contestant.load(*bodies(WATCHED))
    error = apart(contestant.read(contestant.advance(start, round(END / DT)))[0], exact)
    chunk = max(min(sizes.drift_steps, int(sizes.drift_seconds * contestant.pace / WATCHED)) // 10, 1)
    states = [start]
    for _ in range(10):
        states.append(contestant.advance(states[-1], chunk))
    q, p = (np.stack(x) for x in zip(*map(contestant.read, states), strict=True))
    solved = [contestant.info(z) for z in states[1:]] if contestant.info else None
    return {
        "name": contestant.name,
        "dtype": contestant.dtype,
        "error": error,
        "steps": 10 * chunk,
        "energy_drift": energy_drift(system, q, p),
        "momentum_drift": _momentum_drift(system, q, p),
        "residual": max(residual for residual, _ in solved) if solved else None,
        "converged": all(converged for _, converged in solved) if solved else None,
    }


def _momentum_drift(system: Any, q: np.ndarray, p: np.ndarray) -> float:
    Phi = np.asarray(jax.vmap(jax.vmap(system.momentum))(_state(q, p)))
    return float(np.max(np.abs(Phi - Phi[0]) / np.linalg.norm(p[0], axis=1, keepdims=True)))


def _state(q: np.ndarray, p: np.ndarray, dtype: str = "float64") -> li.State:
    return li.State(jnp.asarray(q, dtype), jnp.asarray(p, dtype))


def _unit(q: np.ndarray) -> np.ndarray:
    q = q.astype(np.float64)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def agreement(same_scheme: Sequence[Contestant], dtypes: Sequence[str] = DTYPES) -> list[dict[str, Any]]:
    """The distance of each contestant's states at t = END from those of the first: same scheme, same initial states.

    At a later time, rounding errors would have grown exponentially on bodies that start near the middle axis.
    """
    found, num_steps = [], round(END / DT)
    for dtype in dtypes:
        first, *others = [c for c in same_scheme if c.dtype == dtype]
        ends = [np.concatenate(c.read(c.advance(c.load(*bodies(BATCH)), num_steps)), axis=1) for c in (first, *others)]
        for c, end in zip(others, ends[1:], strict=True):
            apart = float(np.max(np.abs(end - ends[0])))
            found.append({"a": first.name, "b": c.name, "dtype": dtype, "steps": num_steps, "apart": apart})
    return found
