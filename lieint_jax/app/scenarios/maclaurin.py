"""Rotating liquid spheroids under their own gravity: their bar modes, measured and in closed form (Chandrasekhar)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field, model_validator

from lieint_jax import systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios._kind import Kind, picture
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, change_lines
from lieint_jax.app.scenarios._runs import length, series
from lieint_jax.runs import Run
from lieint_jax.systems import IncompressibleBody
from lieint_jax.types import State, Step

SECULAR, DYNAMICAL = 0.812670, 0.952887  # eccentricities at which a bar may and must grow [Chandrasekhar 1969, § 33]
_MAX_BAR = 1e-3  # largest bar whose modes are measured
_ROWS = 16  # largest number of members in the report

Eccentricity = Annotated[float, Field(gt=0, lt=0.99)]


class Maclaurin(Kind):
    """The keys of a scenario of this kind. Units: G = M = R = 1, R the radius of a ball of the same volume."""

    eccentricity: Eccentricity
    """The eccentricity of the nominal spheroid, √(1 − c²/a²)."""
    last_eccentricity: Eccentricity | None = None
    """That of the last member; the members between have eccentricities at equal distances."""
    bar: Annotated[float, Field(gt=0, le=0.01)] = 1e-6
    """The initial deformation: two opposite axes are longer by this factor, two are shorter."""
    scheme: Literal["additive"] = "additive"
    order: Literal[2, 4, 6] = 2
    """The order of accuracy; above 2 by composition."""

    no_spread: ClassVar[str] = "the members are spheroids of eccentricities at equal distances"

    @model_validator(mode="after")
    def _check_members(self) -> Self:
        if (self.last_eccentricity is None) != (self.members == 1):
            raise ValueError("last_eccentricity and members > 1 go together")
        return self

    def eccentricities(self) -> np.ndarray:
        """The eccentricities of all members."""
        last = self.eccentricity if self.last_eccentricity is None else self.last_eccentricity
        return np.linspace(self.eccentricity, last, self.members)

    def make_system(self) -> IncompressibleBody:
        return systems.incompressible_body(np.full(3, 0.2), systems.self_gravity(1.0, 1.0, 1.0))

    def options(self) -> tuple[Any, ...]:
        return ("incompressible",)

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The step and the spheroids with a small bar, each in its rotation."""
        step, e = self.make_step(), self.eccentricities()[self.indices(indices)]
        a, Omega = spheroid(e)
        axes = np.stack([a * (1 + self.bar), a / (1 + self.bar), a * np.sqrt(1 - e * e)], axis=1)

        def member(axes: Array, Omega: Array) -> State:
            return step.system.state(jnp.diag(axes), angular_velocity=Omega * jnp.array([0.0, 0.0, 1.0]))

        return step, jax.vmap(member)(jnp.asarray(axes), jnp.asarray(Omega))

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy, angular momentum, circulation and volume."""
        H, L = (series(f, run) for f in (IncompressibleBody.energy, IncompressibleBody.momentum))
        K, volume = series(circulation, run), np.linalg.det(run.state.q)
        return [
            Conserved("energy, relative", H, abs(H[0]), ROUND_OFF),
            Conserved("angular momentum, relative", L, length(L[0]), ROUND_OFF),
            Conserved("volume, relative", volume, promise=ROUND_OFF, initial=1.0),
            Conserved("circulation, relative", K, length(K[0]), "O(Δt²)"),
        ]

    def report(self, run: Run) -> str:
        """The conserved quantities, and the modes of some members next to the closed form."""
        e, modes = self.eccentricities(), measured_modes(run)
        known = _ordered(bar_modes(e))
        lines = change_lines(self.conserved(run))
        lines.append(f"\n  {'e':>8}{'Ω':>10}{'σ measured':>26}{'closed form':>26}{'difference':>12}")
        for m in np.unique(np.linspace(0, len(e) - 1, min(len(e), _ROWS)).round().astype(int)):
            for k in range(2):
                first = f"{e[m]:>8.4f}{float(spheroid(e[m])[1]):>10.6f}" if k == 0 else " " * 18
                off = abs(modes[m, k] - known[m, k])
                lines.append(f"  {first}{_complex(modes[m, k])}{_complex(known[m, k])}{off:>12.1e}")
        limits = f"a bar may grow by friction for e > {SECULAR}, must grow for e > {DYNAMICAL}"
        return "\n".join([*lines, f"\n  {limits} [Chandrasekhar 1969, § 33]"])

    @picture(2)
    def draw_modes(self, axes: np.ndarray, run: Run) -> None:
        """Plot the rates of the bar against the eccentricity, and the growth of the bars of three members."""
        left, right = axes
        e, fine = self.eccentricities(), np.linspace(0.02, 0.985, 1000)
        known, modes = bar_modes(fine), measured_modes(run)
        growth, measured = np.abs(np.imag(known[:, 0])), np.abs(np.imag(modes)).max(axis=1)
        left.plot(fine, np.real(known), color=plots.INK, lw=0.9)
        left.plot([], [], color=plots.INK, lw=0.9, label="rotation rate σ, closed form")
        left.plot(fine[growth > 0], growth[growth > 0], color=plots.ORANGE, lw=0.9, label="growth rate, closed form")
        left.plot(e, np.real(modes), ".", color=plots.BLUE, ms=4)
        grows = measured > 1e-3
        left.plot(e[grows], measured[grows], ".", color=plots.BLUE, ms=4, label="measured")
        for limit, name in ((SECULAR, "Jacobi's branch"), (DYNAMICAL, "the bar must grow")):
            left.axvline(limit, color=plots.INK, lw=0.6, ls=":")
            left.annotate(name, (limit, -1.3), rotation=90, ha="right", va="bottom", fontsize="small")
        left.set(xlabel="eccentricity e", ylabel=r"rate ($\sqrt{GM/R^3}$)", title="how fast the bar rotates and grows")
        left.set_ylim(-1.35, 1.25)
        left.legend(loc="center left", bbox_to_anchor=(0.0, 0.62))
        z, t = bars(run), np.asarray(run.t)
        styles = zip((plots.INK, plots.BLUE, plots.ORANGE), ("-", "--", "-"), strict=True)
        for m, (color, dashes) in zip((0, len(e) // 2, len(e) - 1), styles, strict=True):
            size = np.maximum(abs(z[:, m]), 1e-300)
            right.semilogy(t, size, color=color, ls=dashes, lw=0.8, label=f"e = {e[m]:.3f}")
        right.set(xlabel=r"t ($\sqrt{R^3/GM}$)", ylabel=r"$|B_{xx}-B_{yy}+2iB_{xy}|$ ($R^2$), $B=FF^T$")
        right.set_title("size of the bar")
        right.legend()


def spheroid(e: Any) -> tuple[np.ndarray, np.ndarray]:
    """The equatorial semi-axis and the angular velocity Ω of Maclaurin's spheroids."""
    e = np.asarray(e, float)
    q = np.sqrt(1 - e * e)
    square = 2 * q / e**3 * (3 - 2 * e * e) * np.arcsin(e) - 6 * q * q / e**2  # over πGρ = 3/4
    return q ** (-1 / 3), np.sqrt(0.75 * square)


def bar_modes(e: Any) -> np.ndarray:
    """Ω ± √(4B₁₁ − Ω²), (…, 2), complex: the rates at which the bar e^{iσt} rotates in space, twice those of its axes.

    Source: Chandrasekhar 1969, Ellipsoidal Figures of Equilibrium, § 33 (105), in space.
    """
    e = np.asarray(e, float)
    Omega, q = spheroid(e)[1], np.sqrt(1 - e * e)
    A1 = q / e**3 * np.arcsin(e) - q * q / e**2
    A3 = 2 / e**2 - 2 * q / e**3 * np.arcsin(e)
    A13 = (A1 - A3) / (q * q - 1)  # times a², and so are A₁₁ and B₁₁
    B11 = A1 - (2 - A13) / 4
    root = np.sqrt(3 * B11 - Omega**2 + 0j)  # 4B₁₁ over πGρ
    return np.stack([Omega + root, Omega - root], axis=-1)


def circulation(body: IncompressibleBody, state: State) -> Any:
    """rot[FᵀP], which a liquid's equal particles conserve: the vorticity in the reference state."""
    K = state.q.T @ state.p
    return jnp.stack([K[2, 1] - K[1, 2], K[0, 2] - K[2, 0], K[1, 0] - K[0, 1]])


def bars(run: Run) -> np.ndarray:
    """B_xx − B_yy + 2iB_xy with B = FFᵀ, the shape in space: (times, members), complex."""
    F = np.asarray(run.state.q)
    B = F @ np.swapaxes(F, -1, -2)
    return B[..., 0, 0] - B[..., 1, 1] + 2j * B[..., 0, 1]


def measured_modes(run: Run) -> np.ndarray:
    """The two rates of each member's bar, (members, 2), by Prony's method while it is small; nan for a short series."""
    z, t = bars(run), np.asarray(run.t)
    found = np.full((z.shape[1], 2), np.nan + 0j)
    for m, series_of_member in enumerate(z.T):
        large = abs(series_of_member) > _MAX_BAR
        x = series_of_member[: int(large.argmax()) if large.any() else None]
        if len(x) < 8:
            continue
        pairs = np.stack([x[1:-1], x[:-2]], axis=1)
        coefficients = np.linalg.lstsq(pairs, x[2:], rcond=None)[0]
        roots = np.roots([1, *-coefficients])
        rates = -1j * np.log(roots) / (t[1] - t[0])
        found[m] = sorted(rates, key=lambda rate: (-round(rate.real, 6), rate.imag))
    return found


def _ordered(modes: np.ndarray) -> np.ndarray:
    """Sort modes as in `measured_modes`: the faster first, and of two with the same speed the growing one."""
    return np.array([sorted(pair, key=lambda rate: (-round(rate.real, 6), rate.imag)) for pair in modes])


def _complex(rate: complex) -> str:
    imaginary = f"{-rate.imag:+.6f} growth" if abs(rate.imag) > 1e-7 else ""
    return f"{rate.real:>12.7f}{imaginary:>14}"
