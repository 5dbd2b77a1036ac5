"""Flying spaghetti: a rod that bends in flight, its energy less the work of the throw, and its momenta afterwards.

A straight rod at rest is thrown by a force and a moment on its lower end, which grow until t = 2.5 and are over at
t = 5. It flies on, tumbling and bending out of its plane. The numbers have no units. Look at the energy: it changes
only by the work of the loads, and in free flight the momentum P and the angular momentum L do not change at all.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import lieint_jax as li

TITLE = "Flying spaghetti"
# All numbers: Simo & Vu-Quoc 1988, Comput. Methods Appl. Mech. Eng. 66:125, as repeated by later papers.
LENGTH = 10.0
START = (0.0, 0.0, 8.0, 0.1**0.5, 0.0, 0.9**0.5, 0.0)  # position and attitude of the first section; the last: (6, 0, 0)
SECTION = li.systems.Section(mass=1.0, inertia=(10.0, 10.0), stretching=(1e4, 1e4, 1e4), bending=(500.0, 500.0, 500.0))
FORCE, MOMENT = (20.0, 0.0, 0.0), (0.0, 200.0, 100.0)  # on the last section, in space, at their greatest
PEAK, END = 2.5, 5.0  # times: the loads grow from 0, and fall to 0, linearly
SPREAD = {"bending stiffness": 0.1, "moment": 0.05}  # 1σ of each component over it, an assumption: neighboring motions


def main(
    members: int = 8,
    steps: int = 400,
    dt: float = 0.025,
    elements: int = 10,
    damping: float = 0.0,
    out: Path | None = None,
    resume: bool = False,
    seed: int = 1988,
    pictures: bool = True,
) -> None:
    """Throw the rod, and measure what it conserves and how far it bends.

    Args:
        members: the number of rods; the first is the published one.
        steps: the number of steps, a multiple of 2.
        dt: the step size, in the time unit of the rod; the error of a motion is of second order in it.
        elements: the parts of the rod; the error of its shape is of second order in their length.
        damping: the retardation time of a Kelvin–Voigt material, in the time unit of the rod; 0 for an elastic one.
        out: the store of the run; by default spaghetti.zarr, or spaghetti-2.zarr where that exists.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
        pictures: draw the shape of the first rod, and the energy with the work.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("spaghetti.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "time unit")

    def member(noise):
        stiffness, moment = (
            jnp.array(x) * (1 + sigma * deviation)
            for x, sigma, deviation in zip((SECTION.bending, MOMENT), SPREAD.values(), noise, strict=True)
        )
        rod = li.systems.rod(
            LENGTH,
            elements,
            SECTION._replace(bending=stiffness),
            pose=jnp.array(START),
            damping=damping,
            loads={-1: Partial(load, jnp.concatenate([jnp.array(FORCE), moment]))},
        )
        return li.schemes.bodies_energy_momentum(rod), rod.state()

    noise = jax.random.normal(jax.random.key(seed), (members, 2, 3)).at[0].set(0.0)
    rods, states = jax.jit(jax.vmap(member))(noise)
    run = li.run(rods, states, dt, steps, save_every=2, own_step=True, store=store, resume=resume)
    t, work = np.asarray(run.t), np.asarray(run.state.work)
    H = np.asarray(run.map(lambda step, z: step.system.energy(z)))
    momentum = np.asarray(run.map(lambda step, z: step.system.conservative.momentum(z)))
    P, L, flying = momentum[..., :3], momentum[..., 3:], t >= END
    promise = "conserved to round-off"
    changed = [li.report.Change("energy less work, relative", H - work, abs(H).max(axis=0), promise)]
    q = np.asarray(run.state.q)[..., 3:]
    turns = 2 * np.arccos(np.clip(abs(np.sum(q[:, :, 1:] * q[:, :, :-1], axis=-1)), 0, 1))  # of neighboring sections
    rows = [
        li.report.Row("largest turn of an element (°)", np.rad2deg(turns).max(axis=(0, 2))),
        li.report.Row("work of loads and damping", work[-1]),
    ]
    if flying.any():
        for name, x in {"P": P[flying], "L": L[flying]}.items():
            size = np.linalg.norm(x[0], axis=-1, keepdims=True)
            changed.append(li.report.Change(f"{name} in free flight, relative", x, size, promise))
        impulse = END / 2 * float(np.linalg.norm(FORCE))
        end_P, end_L = (np.linalg.norm(x[-1], axis=-1) for x in (P, L))
        rows.append(li.report.Row("|P| at the end; impulse of the loads", end_P, closed_form=impulse))
        rows.append(li.report.Row("|L| at the end", end_L))
    spread = ", ".join(f"{name} {100 * sigma:g} %" for name, sigma in SPREAD.items())
    print(li.report.text(TITLE, run, rows, changed=changed, spread=spread, error=1))
    if pictures:
        drawn = li.plots.save(draw_shape(run), out.with_name(f"{out.stem}-shape.png"))
        print("pictures:", *drawn, *li.plots.save(draw_energy(t, H, work), out.with_name(f"{out.stem}-energy.png")))


def load(greatest, t):
    """The force and the moment on the last section at a time, (6,)."""
    return jnp.interp(t, jnp.array([0.0, PEAK, END]), jnp.array([0.0, 1.0, 0.0]), left=0.0, right=0.0) * greatest


@li.plots.style()
def draw_shape(run):
    """Plot the line of centers of the first rod at several times, in two of the planes of the axes of space."""
    fig, axes = li.plots.figure(rows=2, size=(8.0, 2.2), sharex=True)
    li.plots.chain(axes[:, 0], np.asarray(run.t), np.asarray(run.member(0).state.q)[..., :3], "the nominal rod")
    fig.suptitle(TITLE)
    return fig


@li.plots.style()
def draw_energy(t, H, work):
    """Plot the change of energy and the work against time, and the change of energy less work."""
    fig, [axes] = li.plots.figure(2)
    li.plots.balance(axes, t, H, work[..., None], ["work"])
    fig.suptitle(TITLE)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
