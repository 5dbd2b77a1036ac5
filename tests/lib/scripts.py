"""A script for tests of the command: free bodies into a store, with a report and no pictures."""

from pathlib import Path

BODIES = '''"""Free bodies that tumble.

Times are in seconds.
"""

from pathlib import Path

import jax
import jax.numpy as jnp

import lieint_jax as li


def main(
    members: int = 12, steps: int = 400, out: Path = Path("bodies.zarr"), resume: bool = False, seed: int = 1
) -> None:
    """Integrate bodies whose angular velocities deviate by 5°/s.

    Args:
        members: the number of initial states; the first is the nominal one.
        steps: the number of steps, a multiple of 100.
        out: the store of the run.
        resume: continue the run in `out`.
        seed: of the deviations of the members.
    """
    jax.config.update("jax_enable_x64", True)
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    noise = jnp.deg2rad(5.0) * jax.random.normal(jax.random.key(seed), (members, 3)).at[0].set(0.0)
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(jnp.array([0.01, 1.0, 0.0]) + noise)
    run = li.run(li.schemes.so3_midpoint(body), states, 0.1, steps, save_every=100, store=out, resume=resume)
    print(li.report.text("Free bodies that tumble", run, time_unit="s"))


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
'''


def written(name="bodies.py", *changes):
    """The name of a file with this script, in which each (old, new) is replaced."""
    text = BODIES
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    Path(name).write_text(text, encoding="utf-8")
    return name
