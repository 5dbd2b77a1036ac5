"""Maclaurin's spheroids and their bars: when a rotating liquid planet becomes a bar.

Homogeneous liquid spheroids rotate under their own gravity (Maclaurin 1742), each with a tiny bar-shaped perturbation.
Below the eccentricity 0.9529 the bar is the sum of two waves; above, it grows until the spheroid becomes a long
ellipsoid. Units: G = M = R = 1, with R the radius of a ball of the same volume.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lieint_jax as li

TITLE = "Maclaurin's spheroids and their bars"
SECULAR, DYNAMICAL = 0.812670, 0.952887  # eccentricities where a bar may and must grow [Chandrasekhar 1969, § 33]
LARGEST_BAR = 1e-3  # the rates of a bar are measured while it is smaller
ROWS = 16  # the largest number of members in the report


def main(
    members: int = 89,
    steps: int = 1500,
    first: float = 0.1,
    last: float = 0.98,
    bar: float = 1e-6,
    out: Path | None = None,
    resume: bool = False,
    pictures: bool = True,
    certificate: bool = True,
) -> None:
    """Integrate the spheroids, and compare the rates of their bars with the closed form.

    Args:
        members: the number of spheroids, of eccentricities at equal distances.
        steps: the number of steps of 0.1 √(R³/GM), a multiple of 5.
        first: the eccentricity √(1 − c²/a²) of the first spheroid, above 0.
        last: that of the last spheroid, below 0.99.
        bar: the initial deformation: two opposite axes are longer by this factor, two are shorter.
        out: the store of the run; by default maclaurin.zarr, or maclaurin-2.zarr where that exists.
        resume: continue the run in `out`.
        pictures: draw the rates and the growth of bars, and the errors.
        certificate: measure what the scheme conserves along the first member.
    """
    jax.config.update("jax_enable_x64", True)
    out = out or li.report.new_path("maclaurin.zarr", resume)
    store = li.StoreOptions(out, {"title": TITLE}, "√(R³/GM)")
    liquid = li.systems.incompressible_body(np.full(3, 0.2), li.systems.self_gravity(1.0, 1.0, 1.0))
    step = li.schemes.compose(li.schemes.additive(liquid, "incompressible"), 4)
    e = np.linspace(first, last, members)
    a, Omega = li.systems.maclaurin_spheroid(e)
    axes = jnp.asarray(np.stack([a * (1 + bar), a / (1 + bar), a * np.sqrt(1 - e * e)], axis=1))
    spins = jnp.asarray(Omega)[:, None] * jnp.array([0.0, 0.0, 1.0])
    states = jax.jit(jax.vmap(lambda x, w: liquid.state(jnp.diag(x), angular_velocity=w)))(axes, spins)
    run = li.run(step, states, 0.1, steps, save_every=5, store=store, resume=resume)
    volume = np.linalg.det(np.asarray(run.state.q))
    K = np.asarray(run.map(lambda step, z: step.system.circulation(z)))
    circulation = li.report.Change("circulation, relative", K, np.linalg.norm(K[0], axis=-1, keepdims=True), "O(Δt²)")
    changed = [*li.report.changes(run), li.report.Change("volume, relative", volume), circulation]
    rates = measured_rates(run)
    remarks = table_of_rates(e, Omega, rates)
    print(li.report.text(TITLE, run, changed=changed, remarks=remarks))
    if certificate:
        print(f"\n{li.report.certificate(run)}")
    if pictures:
        drawn = li.plots.save(draw_rates(run, e, rates), out.with_name(f"{out.stem}-modes.png"))
        print("pictures:", *drawn, *li.plots.save(li.plots.errors(run, TITLE), out.with_name(f"{out.stem}-errors.png")))


def bars(run):
    """B_xx − B_yy + 2iB_xy with B = FFᵀ, the shape in space: (times, members), complex."""
    F = np.asarray(run.state.q)
    B = F @ np.swapaxes(F, -1, -2)
    return B[..., 0, 0] - B[..., 1, 1] + 2j * B[..., 0, 1]


def measured_rates(run):
    """The two rates of each member's bar, (members, 2), while it is small; NaN for a short series."""
    found = []
    for z in bars(run).T:
        large = abs(z) > LARGEST_BAR
        end = int(large.argmax()) if large.any() else len(z)
        found.append(li.measure.complex_rates(run.t[:end], z[:end]))
    return np.array(found)


def table_of_rates(e, Omega, rates):
    """The measured rates of some members next to those in closed form."""

    def number(rate):
        growth = f"{-rate.imag:+.6f} growth" if abs(rate.imag) > 1e-7 else ""
        return f"{rate.real:>12.7f}{growth:>14}"

    known = li.systems.maclaurin_modes(e)
    lines = [f"\n  {'e':>8}{'Ω':>10}{'σ measured':>26}{'closed form':>26}{'difference':>12}"]
    for m in np.unique(np.linspace(0, len(e) - 1, min(len(e), ROWS)).round().astype(int)):
        for k in range(2):
            head = f"{e[m]:>8.4f}{Omega[m]:>10.6f}" if k == 0 else " " * 18
            off = abs(rates[m, k] - known[m, k])
            lines.append(f"  {head}{number(rates[m, k])}{number(known[m, k])}{off:>12.1e}")
    limits = f"a bar may grow by friction for e > {SECULAR}, must grow for e > {DYNAMICAL}"
    return [*lines, f"\n  {limits} [Chandrasekhar 1969, § 33]"]


@li.plots.style()
def draw_rates(run, e, rates):
    """Plot the rates of the bar against the eccentricity, and the growth of the bars of three members."""
    plots, fine = li.plots, np.linspace(0.02, 0.985, 1000)
    fig, [[left, right]] = plots.figure(2)
    fig.suptitle(TITLE)
    known = li.systems.maclaurin_modes(fine)
    growth, measured = abs(np.imag(known[:, 0])), abs(np.imag(rates)).max(axis=1)
    left.plot(fine, np.real(known), color=plots.INK, lw=0.9)
    left.plot([], [], color=plots.INK, lw=0.9, label="rotation rate σ, closed form")
    left.plot(fine[growth > 0], growth[growth > 0], color=plots.ORANGE, lw=0.9, label="growth rate, closed form")
    left.plot(e, np.real(rates), ".", color=plots.BLUE, ms=4)
    grows = measured > 1e-3
    left.plot(e[grows], measured[grows], ".", color=plots.BLUE, ms=4, label="measured")
    for limit, name in ((SECULAR, "Jacobi's branch"), (DYNAMICAL, "the bar must grow")):
        left.axvline(limit, color=plots.INK, lw=0.6, ls=":")
        left.annotate(name, (limit, -1.3), rotation=90, ha="right", va="bottom", fontsize="small")
    left.set(xlabel="eccentricity e", ylabel=r"rate ($\sqrt{GM/R^3}$)", ylim=(-1.35, 1.25))
    left.set_title("how fast the bar rotates and grows")
    left.legend(loc="center left", bbox_to_anchor=(0.0, 0.62))
    size, t = np.maximum(abs(bars(run)), 1e-300), np.asarray(run.t)
    for m, color in zip((0, len(e) // 2, len(e) - 1), (plots.INK, plots.BLUE, plots.ORANGE), strict=True):
        right.semilogy(t, size[:, m], color=color, lw=0.8, label=f"e = {e[m]:.3f}")
    right.set(xlabel=r"t ($\sqrt{R^3/GM}$)", ylabel=r"$|B_{xx}-B_{yy}+2iB_{xy}|$ ($R^2$), $B=FF^T$")
    right.set_title("size of the bar")
    right.legend()
    return fig


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
