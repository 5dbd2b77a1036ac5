"""Rotating liquid spheroids under their own gravity: their bar modes, measured and in closed form (Chandrasekhar)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax import measure, plots, systems
from lieint_jax.app.scenarios._kind import Kind, picture
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, change_lines
from lieint_jax.app.scenarios._runs import length, series
from lieint_jax.runs import Run
from lieint_jax.systems import IncompressibleBody
from lieint_jax.types import State

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

    def _check_members(self) -> None:
        if (self.last_eccentricity is None) != (self.members == 1):
            raise ValueError("last_eccentricity and members > 1 go together")

    def eccentricities(self) -> np.ndarray:
        """The eccentricities of all members."""
        last = self.eccentricity if self.last_eccentricity is None else self.last_eccentricity
        return np.linspace(self.eccentricity, last, self.members)

    def make_system(self) -> IncompressibleBody:
        return systems.incompressible_body(np.full(3, 0.2), systems.self_gravity(1.0, 1.0, 1.0))

    def options(self) -> tuple[Any, ...]:
        return ("incompressible",)

    def deviates(self, indices: np.ndarray) -> tuple[Array, Array]:
        """The semi-axes with a small bar, (m, 3), and the angular velocities of the members."""
        e = self.eccentricities()[indices]
        a, Omega = systems.maclaurin_spheroid(e)
        axes = np.stack([a * (1 + self.bar), a / (1 + self.bar), a * np.sqrt(1 - e * e)], axis=1)
        return jnp.asarray(axes), jnp.asarray(Omega)

    def start(self, system: IncompressibleBody, noise: tuple[Array, Array]) -> State:
        axes, Omega = noise
        return system.state(jnp.diag(axes), angular_velocity=Omega * jnp.array([0.0, 0.0, 1.0]))

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy, angular momentum, circulation and volume."""
        H, L = (series(f, run) for f in (IncompressibleBody.energy, IncompressibleBody.momentum))
        K, volume = series(IncompressibleBody.circulation, run), np.linalg.det(run.state.q)
        return [
            Conserved("energy, relative", H, abs(H[0]), ROUND_OFF),
            Conserved("angular momentum, relative", L, length(L[0]), ROUND_OFF),
            Conserved("volume, relative", volume, promise=ROUND_OFF, initial=1.0),
            Conserved("circulation, relative", K, length(K[0]), "O(Δt²)"),
        ]

    def report(self, run: Run) -> str:
        """The conserved quantities, and the modes of some members next to the closed form."""
        e, modes = self.eccentricities(), measured_modes(run)
        known, Omega = systems.maclaurin_modes(e), systems.maclaurin_spheroid(e).angular_velocity
        lines = change_lines(self.conserved(run))
        lines.append(f"\n  {'e':>8}{'Ω':>10}{'σ measured':>26}{'closed form':>26}{'difference':>12}")
        for m in np.unique(np.linspace(0, len(e) - 1, min(len(e), _ROWS)).round().astype(int)):
            for k in range(2):
                first = f"{e[m]:>8.4f}{Omega[m]:>10.6f}" if k == 0 else " " * 18
                off = abs(modes[m, k] - known[m, k])
                lines.append(f"  {first}{_complex(modes[m, k])}{_complex(known[m, k])}{off:>12.1e}")
        limits = f"a bar may grow by friction for e > {SECULAR}, must grow for e > {DYNAMICAL}"
        return "\n".join([*lines, f"\n  {limits} [Chandrasekhar 1969, § 33]"])

    @picture(2)
    def draw_modes(self, axes: np.ndarray, run: Run) -> None:
        """Plot the rates of the bar against the eccentricity, and the growth of the bars of three members."""
        left, right = axes
        e, fine = self.eccentricities(), np.linspace(0.02, 0.985, 1000)
        known, modes = systems.maclaurin_modes(fine), measured_modes(run)
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


def bars(run: Run) -> np.ndarray:
    """B_xx − B_yy + 2iB_xy with B = FFᵀ, the shape in space: (times, members), complex."""
    F = np.asarray(run.state.q)
    B = F @ np.swapaxes(F, -1, -2)
    return B[..., 0, 0] - B[..., 1, 1] + 2j * B[..., 0, 1]


def measured_modes(run: Run) -> np.ndarray:
    """The two rates of each member's bar, (members, 2), while it is small; nan for a short series."""
    found = []
    for z in bars(run).T:
        large = abs(z) > _MAX_BAR
        end = int(large.argmax()) if large.any() else len(z)
        found.append(measure.complex_rates(run.t[:end], z[:end]))
    return np.array(found)


def _complex(rate: complex) -> str:
    imaginary = f"{-rate.imag:+.6f} growth" if abs(rate.imag) > 1e-7 else ""
    return f"{rate.real:>12.7f}{imaginary:>14}"
