"""The material constants of an elastic ball: λ and μ estimated from its vibration.

A pseudo-rigid ball, stretched and released, rotates and vibrates. Its strain C = FᵀF is observed with noise, and the
constants of its material are fitted. The data are computed from the equations of motion by collocation of order 16; the
model is the energy-momentum scheme of order 2. The fit uses forward derivatives; as a check, the gradient in reverse
mode, by undoing steps, must vanish at the estimate. All quantities are dimensionless.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import lieint_jax as li

TITLE = "λ and μ of an elastic ball"
TRUTH = {"lam": 20.0, "mu": 6.0}  # Lamé's constants times the volume
GUESS = {"lam": 25.0, "mu": 4.5}  # with errors of a quarter
SECOND_MOMENTS = (2.0, 2.0, 2.0)  # of mass, of a ball
STRETCH = ((1.2, 0.05, 0.0), (0.0, 0.95, 0.1), (0.0, 0.0, 0.9))  # the deformation F at the start
SPIN = (0.3, 0.2, 1.0)  # the angular velocity at the start
NOISE = 0.005  # the standard deviation of each component of C
DT, EVERY = 0.01, 10  # the step size, and steps between two observations
COMPONENTS = (0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)  # xx, yy, zz, yz, xz, xy


def main(observations: int = 40, out: Path | None = None, seed: int = 6, pictures: bool = True) -> None:
    """Fit λ and μ, and verify the estimate by the gradient in reverse mode.

    Args:
        observations: the number of times at which the strain is observed, every 0.1.
        out: the picture; by default material.png, or material-2.png where that exists.
        seed: of the noise.
        pictures: draw the observed and the fitted strain.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("material.png")
    clean = exact_strains(observations)
    data = clean + NOISE * jnp.asarray(np.random.default_rng(seed).normal(size=clean.shape))

    def residuals(params, adjoint=None):
        model, converged = strains(params, observations, adjoint)
        return (model - data) / NOISE, converged

    guess = jax.tree.map(jnp.array, GUESS)
    found = li.fit(residuals, guess, bounds=li.fitting.positive, iterations=30, standardized=True)
    reverse = jax.jit(jax.grad(lambda params: jnp.sum(residuals(params, li.ReversibleAdjoint())[0] ** 2) / 2))
    first, last = (float(jnp.linalg.norm(ravel_pytree(reverse(params))[0])) for params in (guess, found.params))
    print(f"{TITLE} from {observations} observations of its strain, noise {NOISE} a component")
    print(f"  {found.outcome}")
    print(f"  the gradient in reverse mode, by undoing steps, is {last / first:.1e} of that at the guess\n")
    print(f"{'truth':>15}{'estimate':>12}{'± 1 sigma':>11}")
    for name, key in (("λ", "lam"), ("μ", "mu")):
        print(f"  {name}{TRUTH[key]:>12.4f}{found.params[key]:>12.5f}{found.standard_errors[key]:>11.5f}")
    if pictures:
        fitted = jax.jit(lambda params: strains(params, observations)[0])(found.params)
        print("pictures:", *li.plots.save(draw(np.asarray(data), np.asarray(fitted)), out))


def start(params):
    """The ball with the constants `params`, and its initial state: stretched by a fifth and rotating."""
    energy = li.systems.mooney_rivlin(params["lam"], params["mu"])
    ball = li.systems.pseudo_rigid_body(jnp.array(SECOND_MOMENTS), energy)
    return ball, ball.state(jnp.array(STRETCH), angular_velocity=jnp.array(SPIN))


def strains(params, observations, adjoint=None):
    """C at all observations, (observations, 6), and whether steps converged."""
    ball, state = start(params)
    step = li.schemes.additive(ball)
    path = li.integrate(step, state, DT, observations * EVERY, save_every=EVERY, adjoint=adjoint)
    return jax.vmap(ball.strain)(path.state)[1:, *COMPONENTS], path.info.converged


def exact_strains(observations):
    """C at all observations, (observations, 6), by collocation of order 16."""
    ball, state = start(TRUTH)

    def advance(state, _):
        state = li.diagnostics.flow(ball, state, DT * EVERY, 4)
        return state, ball.strain(state)[COMPONENTS]

    return jax.jit(lambda state: jax.lax.scan(advance, state, length=observations)[1])(state)


@li.plots.style()
def draw(data, fitted):
    """Plot the observed and the fitted strain along the axes."""
    fig, [[ax]] = li.plots.figure()
    fig.suptitle(TITLE)
    t, names = DT * EVERY * np.arange(1, len(data) + 1), ("$C_{xx}$", "$C_{yy}$", "$C_{zz}$")
    li.plots.series(ax, t, dict(zip(names, fitted.T, strict=False)), "strain $C$")
    [first, *_] = ax.plot(t, data[:, :3], ".", ms=4, color=li.plots.PURPLE)
    first.set_label("observed")
    ax.set_title("observed strain, and that of the fitted constants")
    ax.legend()
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
