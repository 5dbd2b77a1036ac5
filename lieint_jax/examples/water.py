"""A droplet of 64 molecules of water: energy and both momenta by two schemes, temperature, first O–O distance.

Rigid molecules in vacuum. Each interacts with all others, without a cut-off, so that only the scheme can change energy,
momentum and angular momentum. Units: nm, ps, u, kJ/mol, which are consistent.
"""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "A droplet of {} molecules of water"
BOLTZMANN = 0.00831446261815324  # kJ/(mol K)
DT = 0.001  # ps
SPACING, SETTLING_TEMPERATURE, SETTLING_STEPS = 0.31, 260.0, 4000  # nm, K: cold enough not to evaporate
SCALED_EVERY = 10  # steps between scalings of the momenta while a droplet settles
PUBLISHED = li.report.Published(0.280, 0.001, "Skinner et al. 2013, J. Chem. Phys. 138, 074506: X-rays, water at 295 K")


def main(
    members: int = 1,
    steps: int = 4000,
    molecules: int = 64,
    model: Literal["TIP4P", "TIP4P/2005"] = "TIP4P",
    scheme: Literal["splitting", "nystrom", "bodies_energy_momentum"] = "splitting",
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1983,
    pictures: bool = True,
    certificate: bool = False,
) -> None:
    """Let a droplet settle, integrate it, and measure its temperature and its O–O distances.

    Args:
        members: the number of droplets, with other attitudes of the molecules on the grid, and other velocities.
        steps: the number of steps of 1 fs, a multiple of 20.
        molecules: the number of molecules of a droplet.
        model: the charges and the Lennard-Jones site of a molecule: Jorgensen et al. 1983, J. Chem. Phys. 79, 926, or
            Abascal & Vega 2005, J. Chem. Phys. 123, 234505.
        scheme: `nystrom` is of order 4; `bodies_energy_momentum` conserves the energy, and is slow.
        out: the store of the run; by default water.zarr, or water-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the attitudes and velocities.
        pictures: draw a droplet, its temperature, the distances, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out, title = out or li.report.new_path("water.zarr", resume), TITLE.format(molecules)
    store = li.StoreOptions(out, {"title": title}, "ps")
    molecule = li.potentials.water(model)
    inertias = np.tile(molecule.inertia, (molecules, 1))
    droplet = li.systems.rigid_bodies(np.full(molecules, molecule.mass), inertias, molecule.potential(molecules))
    step = li.schemes.nystrom(droplet, 4) if scheme == "nystrom" else getattr(li.schemes, scheme)(droplet)
    keys = jax.random.split(jax.random.key(seed), members)
    states = jax.jit(jax.vmap(lambda key: settled_state(droplet, key)))(keys)
    run = li.run(step, states, DT, steps, save_every=20, store=store, resume=resume)
    K, T = (np.asarray(run.map(f)) for f in (lambda step, z: step.system.kinetic_energy(z), temperature))
    energy, *momenta = li.report.changes(run)
    changed = [energy._replace(name="energy H, over the least kinetic energy", size=K.min()), *momenta]
    distances = li.measure.distances(run, molecule.points[0])
    density = li.measure.pair_density(distances[1:], np.linspace(0.2, 0.6, 81), 0.35)
    later = T[len(T) // 2 :]
    rows = [
        li.report.Row("temperature, second half of the run (K)", later.mean(axis=0), digits=".1f"),
        li.report.Row("first peak of the O–O distances (nm); published, liquid", density.peak, PUBLISHED),
    ]
    remarks = [f"  the temperature fluctuates by {later.std():.1f} K"]
    print(li.report.text(title, run, rows, changed=changed, remarks=remarks))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_droplet(run, molecule, T, density), out.with_name(f"{out.stem}-droplet.png"))
        print("pictures:", *drawn, *li.plots.save(li.plots.errors(run, title), out.with_name(f"{out.stem}-errors.png")))


def settled_state(droplet, key):
    """A droplet that has settled, its center of mass at rest at the origin.

    Molecules with random attitudes and velocities on a cubic grid take steps, between which the momenta are scaled to
    the temperature of 6N − 6 degrees of freedom, those that the momenta P and L leave.
    """
    n = droplet.masses.shape[0]
    for_attitude, for_velocity, for_rate = jax.random.split(key, 3)
    q = jax.random.normal(for_attitude, (n, 4))
    v = jax.random.normal(for_velocity, (n, 3))
    v = (v - jnp.mean(v, axis=0)) / jnp.sqrt(droplet.masses[:, None])
    rates = jax.random.normal(for_rate, (n, 3)) / jnp.sqrt(droplet.inertias)
    attitudes = q / jnp.linalg.norm(q, axis=1, keepdims=True)
    state = droplet.state(grid(n), attitudes, velocities=v, angular_velocities=rates)
    step, K = li.schemes.splitting(droplet), BOLTZMANN * SETTLING_TEMPERATURE * (6 * n - 6) / 2

    def scaled(state):
        return state._replace(p=state.p * jnp.sqrt(K / droplet.kinetic_energy(state)))

    def relax(state, _):
        return jax.lax.fori_loop(0, SCALED_EVERY, lambda _, z: step(z, DT)[0], scaled(state)), None

    return scaled(jax.lax.scan(relax, state, length=-(-SETTLING_STEPS // SCALED_EVERY))[0])


def grid(n):
    """The n points of a cubic grid that are nearest the middle of a cell, with their mean at the origin, (n, 3)."""
    side = np.arange(-6, 7) + 0.5
    points = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen = points[np.argsort((points**2).sum(axis=1), kind="stable")[:n]]
    return SPACING * (chosen - chosen.mean(axis=0))


def temperature(step, state):
    """2K over k_B and the degrees of freedom that P and L leave, in K."""
    droplet = step.system
    return 2 * droplet.kinetic_energy(state) / (BOLTZMANN * (6 * droplet.masses.shape[0] - 6))


@li.plots.style()
def draw_droplet(run, molecule, T, density):
    """Plot the first droplet at the end, the temperature of the members, and the histogram of O–O distances."""
    plots = li.plots
    fig, [[left, middle, right]] = plots.figure(3)
    left.remove()
    left = fig.add_subplot(1, 3, 1, projection="3d")
    q = np.asarray(run.state.q[-1, 0])
    R = np.asarray(jax.vmap(li.groups.so3.to_matrix)(jnp.asarray(q[:, 3:])))
    atoms = q[:, None, :3] + np.einsum("nij,sj->nsi", R, molecule.points[:3])
    for hydrogen in (1, 2):
        for bond in atoms[:, [0, hydrogen]]:
            left.plot(*bond.T, color=plots.INK, lw=1.2)
    left.scatter(*atoms[:, 0].T, color=plots.RED, s=36, label="oxygen")
    left.scatter(*atoms[:, 1:].reshape(-1, 3).T, color=plots.BLUE, s=8, label="hydrogen")
    plots.cube(left).set(xlabel="x (nm)", ylabel="y (nm)", title=f"the first droplet at t = {run.t[-1]:.3g} ps")
    left.legend(loc="upper left")
    temperatures = {f"droplet {m}": T[:, m] for m in range(min(T.shape[1], 6))}
    plots.series(middle, np.asarray(run.t), temperatures, "temperature (K)", "ps")
    right.plot(density.r, density.density / density.height, color=plots.INK, label=f"peak at {density.peak:.3f} nm")
    right.axvline(PUBLISHED.value, color=plots.RED, ls="--", lw=1, label=f"liquid, published: {PUBLISHED.value:g} nm")
    right.set(xlabel="O–O distance r (nm)", ylabel="pairs per volume, over the first peak")
    right.legend()
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
