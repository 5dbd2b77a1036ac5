"""Work against precision of two bodies like 1999 KW4: `python tests/lib/kw4.py` prints the table."""

import functools
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from example_runs import run_example
from two_bodies import reference

from lieint_jax import schemes
from lieint_jax.examples import kw4
from lieint_jax.groups import so3

TIME = 2 * 18.6 * 3600.0  # two orbits of this state, 13.5 turns of the primary
FORCES = (600, 2400, 9600)
SCHEMES = {  # the scheme, and its force evaluations a step
    "splitting": (schemes.splitting, 1),
    "suzuki": (lambda bodies: schemes.compose(schemes.splitting(bodies), 4), 5),
    "nystrom 4": (lambda bodies: schemes.nystrom(bodies, 4), 6),
    "nystrom 6": (lambda bodies: schemes.nystrom(bodies, 6), 14),
    "kahan_li 6": (lambda bodies: schemes.compose(schemes.splitting(bodies), 6), 9),
    "kahan_li 8": (lambda bodies: schemes.compose(schemes.splitting(bodies), 8), 17),
    "kepler 2": (lambda bodies: schemes.kepler_splitting(bodies, 2), 1),
    "kepler (8, 4)": (lambda bodies: schemes.kepler_splitting(bodies, (8, 4)), 5),
    "kepler (8, 6, 4)": (lambda bodies: schemes.kepler_splitting(bodies, (8, 6, 4)), 7),
    "energy-momentum": (schemes.bodies_energy_momentum, 5),  # counted: four iterations and the force of the step
}


@functools.cache
def start():
    """The bodies and the nominal state of `lieint run kw4`."""
    with tempfile.TemporaryDirectory() as folder:
        one = run_example(kw4, Path(folder), members=1, steps=40)[1].member(0)
        return one.system, jax.tree.map(lambda x: jnp.asarray(x[0]), one.state)


@functools.cache
def true_end():
    """The relative position and the rotations at the end, by DOP853 at 3e-14."""
    x, R = reference(*start(), TIME, 3e-14, 3e-14)
    return x[1] - x[0], R


@functools.partial(jax.jit, static_argnames="count")
def _end(step, state, dt, count):
    return jax.lax.fori_loop(0, count, lambda _, z: step(z, dt)[0], state)


def errors(name, forces):
    """|d − d_ref|/|d_ref| of the relative position, and the larger of the two attitudes' errors in rad."""
    make, each = SCHEMES[name]
    (bodies, state), (d, R) = start(), true_end()
    count = round(forces / each)
    q = np.array(_end(make(bodies), state, TIME / count, count).q)
    turned = np.array(jax.vmap(so3.to_matrix)(q[:, 3:]))
    apart = np.linalg.norm(turned - R, axis=(1, 2)) / np.sqrt(8)  # sin of half the angle
    return np.linalg.norm(q[1, :3] - q[0, :3] - d) / np.linalg.norm(d), 2 * np.arcsin(apart.max())


def main():
    print(f"{'force evaluations':<18}" + "".join(f"{n:>18}" for n in FORCES))
    for name in SCHEMES:
        print(f"{name:<18}" + "".join(f"{'{:.0e} / {:.0e}'.format(*errors(name, n)):>18}" for n in FORCES), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
