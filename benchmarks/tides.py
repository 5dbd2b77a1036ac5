"""How well is angular momentum conserved under tides, by this package and by REBOUNDx?

The Earth rotates in five hours about an axis 0.2 rad off the normal of the Moon's orbit, a circle of ten Earth radii,
60° inclined; both tides lag by 638 s. Alone, and with the Sun at one astronomical unit. 10⁴ orbits; a step of this
package is a hundredth of one, so there are 10⁶. REBOUNDx runs its `tides_spin` with IAS15, both with their defaults, if
it is installed (`pip install rebound reboundx`).

    python benchmarks/tides.py [--quick] [--out DIR]

The error is |L − L₀| of all bodies, spins included, over the angular momentum of the pair about its own center, as in
REBOUNDx's issue 172 (github.com/dtamayo/reboundx/issues/172). That reports 0.4 after 200 000 years, fewer than 7·10⁶
orbits, of the Sun, the Earth and the Moon soon after it formed, 60° inclined, with IAS15. REBOUNDx's `tau` is half the
lag (docs/pages/howto/tides.md). Its bodies are also flattened by their rotation, those here are spheres.
"""

from __future__ import annotations

import importlib.util
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lib import command

G, AU, HOUR = 6.6743e-11, 1.495978707e11, 3600.0
SUN, MASSES, RADII = 1.98841e30, np.array([5.9722e24, 7.346e22]), np.array([6.371e6, 1.7374e6])
MOMENTS, K2, LAG = np.array([0.3307, 0.393]) * MASSES * RADII**2, np.array([0.298, 0.024]), 638.0
DISTANCE, INCLINATION, OFF, DAY = 10 * RADII[0], np.pi / 3, 0.2, 5 * HOUR
RATE = np.sqrt(G * MASSES.sum() / DISTANCE**3)
PERIOD = 2 * np.pi / RATE
REPORTED = (7e6, 0.4)  # orbits and error in issue 172


class Start(NamedTuple):
    """Masses, positions, velocities, spins: of the Sun, if there is one, the Earth and the Moon, in SI units."""

    masses: np.ndarray
    x: np.ndarray
    v: np.ndarray
    omega: np.ndarray


def start(sun: bool) -> Start:
    """The bodies at the start, about their barycenter."""

    def tilted(angle: float) -> np.ndarray:
        return np.array([0.0, -np.sin(angle), np.cos(angle)])

    shares = np.array([-MASSES[1], MASSES[0]])[:, None] / MASSES.sum()
    x = shares * np.array([DISTANCE, 0.0, 0.0])
    v = shares * RATE * DISTANCE * np.array([0.0, np.cos(INCLINATION), np.sin(INCLINATION)])
    omega = np.stack([2 * np.pi / DAY * tilted(INCLINATION - OFF), RATE * tilted(INCLINATION)])
    if not sun:
        return Start(MASSES, x, v, omega)
    share, year = MASSES.sum() / (SUN + MASSES.sum()), np.sqrt(G * (SUN + MASSES.sum()) / AU**3)
    along, across = np.array([AU, 0.0, 0.0]), np.array([0.0, year * AU, 0.0])
    return Start(
        np.concatenate([[SUN], MASSES]),
        np.concatenate([[-share * along], (1 - share) * along + x]),
        np.concatenate([[-share * across], (1 - share) * across + v]),
        np.concatenate([np.zeros((1, 3)), omega]),
    )


def momentum_of_pair(begin: Start) -> float:
    """|L| of the Earth and the Moon about their own center of mass, spins included."""
    x, v = np.diff(begin.x[-2:], axis=0)[0], np.diff(begin.v[-2:], axis=0)[0]
    return float(np.linalg.norm(MASSES.prod() / MASSES.sum() * np.cross(x, v) + MOMENTS @ begin.omega[-2:]))


def momentum_of_all(begin: Start) -> float:
    """|L| of all bodies about their barycenter, spins included."""
    orbital = (begin.masses[:, None] * np.cross(begin.x, begin.v)).sum(axis=0)
    return float(np.linalg.norm(orbital + MOMENTS @ begin.omega[-2:]))


def ours(sun: bool, orbits: int, saves: int) -> dict[str, Any]:
    """A run of this package, in units of the Earth's mass and radius and of the Moon's period."""
    import jax
    import jax.numpy as jnp
    from lib import measure  # float64

    import lieint_jax as li

    del measure
    begin, (M, R) = start(sun), (MASSES[0], RADII[0])
    g, extra = G * M * PERIOD**2 / R**3, np.zeros(int(sun))
    masses, moments = begin.masses / M, np.concatenate([1 + extra, MOMENTS / (M * R**2)])
    law = li.tides.constant_lag(
        g,
        masses,
        np.concatenate([1 + extra, RADII / R]),
        np.concatenate([extra, K2]),
        LAG / PERIOD,
    )
    gravity = li.potentials.point_masses(g, masses)
    bodies = li.systems.rigid_bodies(masses, np.repeat(moments[:, None], 3, axis=1), gravity + law.potential, law)
    state = bodies.state(begin.x / R, velocities=begin.v * PERIOD / R, angular_velocities=begin.omega * PERIOD)
    states = jax.tree.map(lambda x: x[None], state)._replace(t=state.t)
    step, began = li.schemes.bodies_energy_momentum(bodies), time.perf_counter()
    steps = 100 * orbits
    run = li.run(step, states, 0.01, steps, save_every=steps // saves, progress=False)
    seconds = time.perf_counter() - began
    assert run.info.converged.all()
    path = jax.tree.map(lambda x: jnp.asarray(x[:, 0]), run.state._replace(t=None))
    L = np.array(jax.vmap(bodies.momentum)(path))[:, 3:]
    H = np.array(jax.vmap(bodies.energy)(path) - path.work)
    spins = np.linalg.norm(path.p[:, -2, 3:], axis=1)
    return {
        "name": "this package",
        "orbits": np.array(run.t).tolist(),
        "errors": (np.linalg.norm(L - L[0], axis=1) * M * R**2 / PERIOD / momentum_of_pair(begin)).tolist(),
        "slowing": float(1 - spins[-1] / spins[0]),
        "energy": float(abs(H / H[0] - 1).max()),
        "seconds": seconds,
    }


def reboundx(sun: bool, orbits: int, saves: int) -> dict[str, Any]:
    """The same by REBOUNDx; its error is saved at the end of the step that passes a time."""
    import rebound  # pyright: ignore[reportMissingImports]
    import reboundx  # pyright: ignore[reportMissingImports]

    begin, sim = start(sun), rebound.Simulation()
    sim.G, sim.integrator, sim.dt = G, "IAS15", PERIOD / 100
    radii = np.concatenate([np.zeros(int(sun)), RADII])
    for m, r, x, v in zip(begin.masses, radii, begin.x, begin.v, strict=True):
        sim.add(m=m, r=r, **dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*x, *v), strict=True)))
    extras = reboundx.Extras(sim)
    tides = extras.load_force("tides_spin")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what changed in version 4.5
        extras.add_force(tides)
    pair = [sim.particles[k + int(sun)] for k in (0, 1)]
    for body, k2, J, omega in zip(pair, K2, MOMENTS, begin.omega[-2:], strict=True):
        for name, value in (("k2", k2), ("tau", LAG / 2), ("I", J), ("Omega", list(omega))):
            body.params[name] = value
    extras.initialize_spin_ode(tides)

    def spins() -> np.ndarray:
        return np.array([list(body.params["Omega"]) for body in pair])

    def momentum() -> np.ndarray:
        return sum(p.m * np.cross(p.xyz, p.vxyz) for p in sim.particles) + MOMENTS @ spins()

    first, began, times, errors = momentum(), time.perf_counter(), [0.0], [0.0]
    for k in range(saves):
        sim.integrate(orbits * PERIOD * (k + 1) / saves, exact_finish_time=0)
        times.append(sim.t / PERIOD)
        errors.append(float(np.linalg.norm(momentum() - first)) / momentum_of_pair(begin))
    return {
        "name": "REBOUNDx, IAS15",
        "orbits": times,
        "errors": errors,
        "slowing": float(1 - np.linalg.norm(spins()[0]) * DAY / (2 * np.pi)),
        "seconds": time.perf_counter() - began,
    }


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report

    orbits, saves = (100, 50) if options.quick else (10_000, 400)
    packages = (ours, reboundx) if importlib.util.find_spec("reboundx") else (ours,)
    found = {
        title: [run(sun, orbits, saves) for run in packages]
        for title, sun in (("Earth and Moon", False), ("Earth, Moon and Sun", True))
    }
    result = {"machine": measure.machine(), "runs": found, "reported": REPORTED}
    head = ["", "largest error of L", "at the end", "1 − Earth's spin", "s"]
    sections = [report.machine(result), f"Errors of L over that of the pair, {orbits} orbits"]
    for title, runs in found.items():
        rows = [
            [run["name"], f"{max(run['errors']):.1e}", f"{run['errors'][-1]:.1e}", f"{run['slowing']:.4e}", seconds]
            for run, seconds in ((run, f"{run['seconds']:.0f}") for run in runs)
        ]
        sections += [title, report.table(head, rows)]
    report.publish("tides", sections, result, options.out)
    draw(found, options.out / "tides.png")


def draw(found: dict[str, Any], path: Path) -> None:
    """Errors against orbits, and the reported one; logarithmic axes."""
    from lieint_jax import plots

    with plots.style():
        fig, axes = plots.figure(2, size=(4.6, 3.6), sharey=True)
        for ax, runs in zip(axes[0], found.values(), strict=True):
            for run, color in zip(runs, (plots.BLUE, plots.RED), strict=False):
                ax.loglog(run["orbits"][1:], run["errors"][1:], color=color, lw=1.2, label=run["name"])
            ax.set(xlabel="orbits of the Moon")
        axes[0, 1].plot(*REPORTED, "k*", ms=9, label="reported for REBOUNDx,\nissue 172")
        axes[0, 0].set_ylabel("|L − L₀| over the pair's |L|")
        plots.letter_panels(axes, list(found))
        for ax, sun in zip(axes[0], (False, True), strict=True):
            larger = momentum_of_all(start(sun)) / momentum_of_pair(start(sun))
            plots.round_off(ax, larger * float(np.finfo(float).eps), "|L₀|")
        plots.save(fig, path)


if __name__ == "__main__":
    main()
