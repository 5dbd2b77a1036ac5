"""A droplet of rigid molecules of water in vacuum: conserved quantities, temperature, and O–O distances."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from pydantic import Field

from lieint_jax import measure, plots, potentials, schemes, systems
from lieint_jax._numerics import random_bits
from lieint_jax.app.scenarios._keys import NumberSpread, PositiveFloat, Published, Table
from lieint_jax.app.scenarios._kind import Kind, picture, step_of
from lieint_jax.app.scenarios._report import Conserved, citation
from lieint_jax.app.scenarios._runs import nominal_state, series
from lieint_jax.app.scenarios._spread import draw_members, with_numbers
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.systems import RigidBodies
from lieint_jax.types import State, Step

_BOLTZMANN = 0.00831446261815324  # kJ/(mol K)
_SCALED_EVERY = 10  # steps between scalings of the momenta while a droplet settles
_LONGEST = 2000  # largest number of steps in the picture of errors: the energy–momentum scheme is slow


class Settling(Table):
    """How a droplet is made: molecules on a grid with random attitudes, then steps in which momenta are scaled."""

    spacing_nm: PositiveFloat = 0.31
    """The spacing of the grid, in nm."""
    temperature_kelvin: PositiveFloat
    """The temperature to which the momenta are scaled every ten steps, in K."""
    steps: Annotated[int, Field(ge=0, le=10**7)]
    """The number of steps of the splitting, with dt."""


class PublishedValues(Table):
    """Published values to compare with."""

    first_peak_nm: Published
    """The first peak of the O–O distances, in nm."""


class Water(Kind):
    """The keys of a scenario of this kind. Units are nm, ps, u and kJ/mol, which are consistent."""

    time_unit: Literal["ps"] = "ps"  # pyright: ignore[reportIncompatibleVariableOverride]
    model: Literal["TIP4P", "TIP4P/2005"] = "TIP4P/2005"
    """The model of the molecule: its charges and its Lennard-Jones site."""
    molecules: Annotated[int, Field(ge=2, le=1000)]
    """The number of molecules of a droplet; all interact, without a cut-off."""
    scheme: Literal["splitting", "nystrom", "bodies_energy_momentum"] = "splitting"
    order: Literal[2, 4, 6] = 2
    """The order of accuracy; above 2 by composition. nystrom has 4 and 6."""
    settling: Settling
    spread: NumberSpread = NumberSpread()
    """Standard deviations of how a droplet is made by their paths, such as `settling.temperature_kelvin`."""
    published: PublishedValues | None = None

    def _check_order(self) -> None:
        if self.scheme == "nystrom" and self.order == 2:
            raise ValueError("nystrom has order = 4 and order = 6")

    def assumption(self) -> str:
        made = "members: other attitudes of the molecules on the grid, and other velocities, before they settle"
        return "; ".join(filter(None, (made, super().assumption())))

    own_step = False  # the molecules are the same in all droplets

    def make_system(self) -> RigidBodies:
        molecule, n = potentials.water(self.model), self.molecules
        return systems.rigid_bodies(np.full(n, molecule.mass), np.tile(molecule.inertia, (n, 1)), molecule.potential(n))

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The step and the batch of droplets, once they have settled."""
        step, indices = self.make_step(), self.indices(indices)
        keys = random_bits.split_rows(jax.random.key(self.seed), self.members, indices)
        own = {path: values[indices] for path, values in draw_members(self).items()}
        member = jax.vmap(lambda key, own: with_numbers(self, own).start(step.system, key))
        return step, jax.jit(member)(keys, own)

    def start(self, system: RigidBodies, noise: Array) -> State:
        """A droplet that has settled, its center of mass at rest at the origin; `noise` is its random key."""
        n, given = self.molecules, self.settling
        for_attitude, *others = jax.random.split(noise, 3)
        q = jax.random.normal(for_attitude, (n, 4))
        v, Omega = (jax.random.normal(k, (n, 3)) for k in others)
        v = (v - jnp.mean(v, axis=0)) / jnp.sqrt(system.masses[:, None])
        q = q / jnp.sqrt(jnp.sum(q * q, axis=1, keepdims=True))
        rates = Omega / jnp.sqrt(system.inertias)
        state = system.state(_grid(n, given.spacing_nm), q, velocities=v, angular_velocities=rates)
        step, K = schemes.splitting(system), _BOLTZMANN * given.temperature_kelvin * (6 * n - 6) / 2

        def rescale(state: State) -> State:
            return state._replace(p=state.p * jnp.sqrt(K / system.kinetic_energy(state)))

        def relax(_: Any, state: State) -> State:
            return lax.fori_loop(0, _SCALED_EVERY, lambda _, z: step(z, self.dt)[0], rescale(state))

        return rescale(lax.fori_loop(0, -(-given.steps // _SCALED_EVERY), relax, state))

    def conserved(self, run: Run) -> list[Conserved]:
        """H relative to the least kinetic energy, P to the largest |p|, L to the largest |x × p|."""
        K, H, PL = (series(f, run) for f in (RigidBodies.kinetic_energy, RigidBodies.energy, RigidBodies.momentum))
        x, p = (np.asarray(y)[..., :3] for y in (run.state.q, run.state.p))
        return [
            Conserved("energy H, over the least kinetic energy", H, K.min()),
            Conserved("linear momentum P, over the largest |p|", PL[..., :3], abs(p).max()),
            Conserved("angular momentum L, over the largest |x × p|", PL[..., 3:], abs(np.cross(x, p)).max()),
        ]

    def remarks(self, run: Run) -> list[str]:
        """The temperature; the first peak of the O–O distances and the published one."""
        T, found = series(temperature, run), self.density(run)
        later = T[len(T) // 2 :]
        lines = [f"\n  {'temperature, second half of the run (K)':<54}{later.mean():>10.1f} ± {later.std():.1f}"]
        lines.append(f"  {'first peak of the O–O distances (nm)':<54}{found.peak:>10.4f}")
        if self.published:
            lines.append(f"  {'published, of the liquid (nm)':<60}{citation(self, self.published.first_peak_nm)}")
        return lines

    def distances(self, run: Run) -> np.ndarray:
        """The O–O distances at all saved times of all members, in nm, (times, members, pairs)."""
        return measure.distances(run, potentials.water(self.model).points[0])

    def density(self, run: Run) -> measure.PairDensity:
        """The density of the O–O distances, in nm, after the start."""
        return measure.pair_density(self.distances(run)[1:], np.linspace(0.2, 0.6, 81), 0.35)

    @picture(2, sharey=True)
    def draw_errors(self, axes: np.ndarray, run: Run) -> None:
        """Plot the errors of H, P and L of the nominal droplet by the splitting and by the energy–momentum scheme."""
        one = run.member(0)
        both = [step_of(one.system, name, self.order) for name in ("splitting", "bodies_energy_momentum")]
        t, found = self.changes(one, both, _LONGEST)
        titles = "splitting, symplectic", "energy–momentum scheme"
        for ax, errors, title in zip(axes, found.values(), titles, strict=True):
            plots.log_error(ax, t, errors, "relative change", "ps")
            ax.set_title(title)
        largest = max(float(x.max()) for errors in found.values() for x in errors.values())
        axes[0].set_ylim(1e-17, max(10 * largest, 1e-13))
        axes[1].set_ylabel("")
        plots.legend_below(axes)

    @picture(3, spatial=(0,))
    def draw_droplet(self, axes: np.ndarray, run: Run) -> None:
        """Plot the nominal droplet at the end, the temperature of the members, and the histogram of O–O distances."""
        left, middle, right = axes
        end, molecule = nominal_state(run, -1), potentials.water(self.model)
        R = np.asarray(jax.vmap(so3.to_matrix)(end.q[:, 3:]))
        sites = np.asarray(end.q)[:, None, :3] + np.einsum("nij,sj->nsi", R, molecule.points[:3])
        _draw_molecules(left, sites - sites.mean(axis=(0, 1)))
        left.set_title(f"the nominal droplet at t = {run.t[-1]:.3g} ps")
        T, t = series(temperature, run), np.asarray(run.t)
        plots.series(middle, t, {f"droplet {m}": T[:, m] for m in range(min(T.shape[1], 6))}, "temperature (K)", "ps")
        found = self.density(run)
        label = f"first peak at {found.peak:.3f} nm"
        right.plot(found.r, found.density / found.height, color=plots.INK, lw=1, label=label)
        if self.published:
            known = self.published.first_peak_nm
            right.axvline(known.value, color=plots.RED, ls="--", lw=1, label=f"liquid, published: {known.value:g} nm")
        right.set(xlabel="O–O distance r (nm)", ylabel="pairs per volume, over the first peak")
        right.legend()


def temperature(bodies: RigidBodies, state: State) -> Array:
    """2K over k_B and the 6N − 6 degrees of freedom that P and L leave, in K."""
    return 2 * bodies.kinetic_energy(state) / (_BOLTZMANN * (6 * bodies.masses.shape[0] - 6))


def _grid(n: int, spacing: float) -> np.ndarray:
    """The n points of a cubic grid that are nearest the middle of a cell, with their mean at the origin, (n, 3)."""
    side = np.arange(-6, 7) + 0.5
    points = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen = points[np.argsort((points**2).sum(axis=1), kind="stable")[:n]]
    return spacing * (chosen - chosen.mean(axis=0))


def _draw_molecules(ax: Any, sites: np.ndarray) -> None:
    """The atoms (molecules, 3, 3), oxygen first, about the origin, in nm; their bonds; a bar of a round length."""
    for hydrogen in (1, 2):
        bonds = np.stack([sites[:, 0], sites[:, hydrogen], np.full_like(sites[:, 0], np.nan)], axis=1).reshape(-1, 3)
        ax.plot(*bonds.T, color=plots.INK, lw=1.2)
    ax.scatter(*sites[:, 0].T, color=plots.RED, s=36, depthshade=True, label="oxygen")
    ax.scatter(*sites[:, 1:].reshape(-1, 3).T, color=plots.BLUE, s=8, depthshade=True, label="hydrogen")
    size = abs(sites).max()
    ax.view_init(elev=0, azim=-90)  # along y, so that the bar along x is seen in its length
    ax.set_proj_type("ortho")
    ax.set(xlim=(-size, size), ylim=(-size, size), zlim=(-1.1 * size, 0.9 * size))
    ax.set_box_aspect((1, 1, 1), zoom=1.4)
    ax.set_axis_off()
    length = 0.5 if size > 0.5 else 0.1
    ax.plot([-length / 2, length / 2], [0, 0], [-1.1 * size] * 2, color=plots.INK, lw=2)
    ax.text(0, 0, -1.13 * size, f"{length} nm", ha="center", va="top")
    ax.legend(loc="upper left", bbox_to_anchor=(-0.25, 1.0))
