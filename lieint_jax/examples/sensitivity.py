"""Lyapunov exponents of a chaotic heavy top: from the linearization of the step itself.

The derivative of each step maps a frame of tangent vectors (δθ, δπ), and a QR decomposition makes it orthonormal again;
the logarithms of R's diagonal add up to the exponents times t. Their sum is zero to round-off for a symplectic step,
and in the limit they come in pairs ±λ. One pair does not vanish in the limit; the others tend to zero like log(t)/t:
one belongs to the flow's direction and energy, one to the rotation about the vertical and its momentum. Two independent
methods check the exponents: the variational equations of the vector field by collocation, and two neighboring
trajectories that separate and are rescaled. All quantities are dimensionless.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "Lyapunov exponents of a chaotic heavy top"
INERTIA, WEIGHT = (1.0, 2.0, 2.5), (0.5, 0.4, 1.0)  # asymmetric: not integrable [Ziglin 1982]
TURN, SPIN = (1.2, 0.5, -0.2), (0.4, 0.9, 0.6)  # rotation vector of the attitude, and angular velocity, at the start
DT, SHORT = 0.05, 400  # the step size, and the number of steps that are compared with the vector field
SAVES, BLOCKS = 200, 10  # times at which the exponents are drawn, and blocks of the second half of the run


def main(steps: int = 20_000, out: Path | None = None, pictures: bool = True) -> None:
    """Compute the exponents by Strang splitting, and verify them by two other methods.

    Args:
        steps: the number of steps of 0.05, a multiple of 200.
        out: the picture; by default sensitivity.png, or sensitivity-2.png where that exists.
        pictures: draw the exponents against time.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("sensitivity.png")
    top = li.systems.heavy_top(INERTIA, WEIGHT)
    state = top.state(li.groups.so3.exp(jnp.array(TURN)), angular_velocity=jnp.array(SPIN))
    step = li.schemes.splitting(top)
    found = li.diagnostics.lyapunov(step, state, DT, steps, vectors=np.eye(6), batches=SAVES)
    t = DT * steps / SAVES * np.arange(1, SAVES + 1)
    values = np.cumsum(found.growth, axis=0) / t[:, None]
    precise = li.schemes.compose(step, 6)
    short = np.asarray(li.diagnostics.lyapunov(precise, state, DT, SHORT, vectors=np.eye(6)).exponents)
    of_flow = jax.jit(lambda state: li.diagnostics.exponents_of_flow(top, state, DT * SHORT, 100))(state)
    of_neighbors = jax.jit(lambda state: li.diagnostics.exponent_of_neighbors(step, state, DT, steps))(state)
    last = np.sort(values[-1])[::-1]
    ends = slice(SAVES // 2 - 1, None, SAVES // (2 * BLOCKS))
    rates = np.diff((values[:, 0] * t)[ends]) / np.diff(t[ends])  # the largest exponent of each block
    print(f"{TITLE}, J = {numbers(INERTIA, 'g')}, E = {numbers(WEIGHT, 'g')}")
    print(f"  to t = {DT * SHORT:g}, order 6:            {numbers(short)}")
    print(f"  the same by the vector field:  {numbers(of_flow)}")
    print(f"  largest difference             {abs(short - of_flow).max():.1e}")
    print(f"  to t = {t[-1]:g}, splitting:      {numbers(values[-1])}")
    print(f"  their sum                      {last.sum():.1e}; pairs ±λ to {abs(last + last[::-1]).max():.1e}")
    print(f"  largest by two neighbors      {of_neighbors:.5f}")
    error = rates.std(ddof=1) / np.sqrt(BLOCKS)
    print(f"  largest, over the second half  {rates.mean():.4f} ± {error:.4f}, a standard error")
    if pictures:
        print("pictures:", *li.plots.save(draw(t, values), out))


def numbers(values, digits="9.5f"):
    """Several numbers in parentheses."""
    return "(" + ", ".join(format(x, digits) for x in values) + ")"


@li.plots.style()
def draw(t, values):
    """Plot the exponents against time."""
    fig, [[ax]] = li.plots.figure()
    fig.suptitle(TITLE)
    curves = {f"$\\lambda_{k + 1}$": values[:, k] for k in range(values.shape[1])}
    li.plots.series(ax, t, curves, "finite-time exponent").axhline(0, lw=0.5, color=li.plots.GRAY)
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
