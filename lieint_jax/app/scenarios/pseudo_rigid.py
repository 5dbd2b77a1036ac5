"""A pseudo-rigid body: conservation, measured and promised by the rule, delay plots, and energy by two rules."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from lieint_jax import _checks, diagnostics, plots, systems
from lieint_jax._numerics import random_bits
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._kind import Kind, for_last_run, picture, step_of
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, citation
from lieint_jax.app.scenarios._runs import length, positive, series
from lieint_jax.app.scenarios._spread import POSITIVE_DETERMINANT, SECOND_MOMENTS
from lieint_jax.runs import Run
from lieint_jax.systems import PseudoRigidBody
from lieint_jax.types import State
from lieint_jax.types.shapes import PyTree

_LAWS = {
    "mooney_rivlin": systems.mooney_rivlin,
    "neo_hookean": systems.neo_hookean,
    "saint_venant_kirchhoff": systems.saint_venant_kirchhoff,
}
_LONGEST = 4_000  # largest number of drawn steps, which are all saved, since a delay plot needs each

Matrix = Annotated[list[keys.Triple], Field(min_length=3, max_length=3)]


class Material(keys.Table):
    """A law of stored energy and its Lamé constants."""

    law: Literal["mooney_rivlin", "neo_hookean", "saint_venant_kirchhoff"] = "mooney_rivlin"
    lam: keys.PositiveFloat
    """Lamé's λ times the body's volume: an energy."""
    mu: keys.PositiveFloat
    """Lamé's μ times the body's volume: an energy."""


def _check_determinant(matrix: list[list[float]]) -> None:
    if not np.linalg.det(matrix) > 0:
        raise ValueError("must have a positive determinant")


class InitialState(keys.Rate):
    """The nominal state: F, and one of angular velocity in space, velocity and momentum."""

    deformation: Annotated[Matrix, POSITIVE_DETERMINANT, keys.checked(_check_determinant)] = np.eye(3).tolist()
    """F, 3 × 3, without unit; by default undeformed, axes along those of space."""
    velocity: Matrix | None = None
    """The time derivative of F, per time_unit."""
    momentum: Matrix | None = None
    """P, of F: velocity times the second moments of mass."""

    def _check_motion(self) -> None:
        if len(self.motion()) != 1:
            raise ValueError("give exactly one of angular_velocity_rad, angular_velocity_deg, velocity, momentum")

    def motion(self) -> dict[str, Any]:
        given = {"angular_velocity": self.rate(), "velocity": self.velocity, "momentum": self.momentum}
        return {key: value for key, value in given.items() if value is not None}


class Spread(keys.RateSpread, keys.NumberSpread):
    """Standard deviations of the members about the nominal state, to which an angular velocity is added, and of
    numbers of the scenario by their paths."""

    deformation: Annotated[keys.NonNegative, keys.Stated("F")] = 0.0
    """Standard deviation of each entry of F, without unit."""


class PseudoRigid(Kind):
    """The keys of a scenario of this kind."""

    inertia: Annotated[list[Any], SECOND_MOMENTS, keys.checked(partial(_checks.positive_definite, "inertia"))]
    """E, the second moments of mass, principal (3) or a tensor in body axes (3 × 3)."""
    material: Material
    scheme: Literal["additive"] = "additive"
    rule: Literal["average", "symplectic", "energy", "energy_momentum"] = "average"
    alpha: Annotated[float, Field(ge=0, le=1)] = 0.5
    """α of the symplectic rule."""
    lag: keys.PositiveInt = 3
    """The delay of the delay plots, in steps."""
    state: InitialState
    spread: Spread = Spread()
    published: dict[Literal["midpoint_energy_variation"], keys.Published] = {}

    fixed: ClassVar[dict[str, str]] = Kind.fixed | {"alpha": "it is a number of the scheme"}

    def _check_alpha(self) -> None:
        if self.alpha != 0.5 and self.rule != "symplectic":
            raise ValueError(f"alpha: the rule {self.rule!r} conserves energy for 0.5 only (got {self.alpha})")
        if self.steps <= 2 * self.lag:
            raise ValueError(f"steps = {self.steps} must be more than 2·lag = {2 * self.lag}")

    def make_system(self) -> PseudoRigidBody:
        material = _LAWS[self.material.law](self.material.lam, self.material.mu)
        return systems.pseudo_rigid_body(jnp.asarray(self.inertia), material)

    def options(self) -> tuple[Any, ...]:
        return self.rule, self.alpha

    def deviates(self, indices: np.ndarray) -> PyTree:
        """Those of F and of the added angular velocity, (m, 3, 3) and (m, 3)."""
        shapes, seeds = ((self.members, 3, 3), (self.members, 3)), jax.random.split(jax.random.key(self.seed))
        sizes = self.spread.deformation, self.spread.rate()
        noise = [
            x * random_bits.normal_rows(k, shape, indices) for x, k, shape in zip(sizes, seeds, shapes, strict=True)
        ]
        return tuple(jnp.where((indices == 0).reshape(-1, *[1] * (x.ndim - 1)), 0.0, x) for x in noise)

    def start(self, system: Any, noise: PyTree) -> State:
        motion = {name: jnp.asarray(x) for name, x in self.state.motion().items()}
        start = system.state(jnp.asarray(self.state.deformation), **motion)
        (dF, spin), V = noise, system.velocity(start)
        F = start.q + dF
        rotating = system.state(F, angular_velocity=spin)
        moved = State(F, rotating.p + system.state(F, velocity=V @ jnp.linalg.inv(start.q) @ F).p)
        is_nominal = ~jnp.any(dF) & ~jnp.any(spin)  # whose state is exact, whereas F⁻¹F rounds
        return jax.tree.map(lambda x, x0: jnp.where(is_nominal, x0, x), moved, start)

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy and momentum, relative to the member's initial |H| and |Φ|."""
        H, Phi = series(PseudoRigidBody.energy, run), series(PseudoRigidBody.momentum, run)
        promised = "bounded, not conserved" if self.rule == "symplectic" else ROUND_OFF
        return [
            Conserved("energy, relative", H, positive(abs(H[0])), promised),
            Conserved("momentum rot[PFᵀ], relative", Phi, positive(length(Phi[0])), ROUND_OFF),
        ]

    def remarks(self, run: Run) -> list[str]:
        """The least det F; the energy of the nominal member by the midpoint rule and the published variation."""
        found, least = self.energies(run), float(np.linalg.det(run.state.q).min())
        lines = [f"  {'least det F':<34}{least:>10.3g}   above 0, or flagged"]
        lines += [f"\n  energy of the nominal member, {len(found.t) - 1} steps, max − min"]
        lines += [f"  {name:<34}{np.ptp(H):>12.3g}" for name, H in found.energy.items()]
        if (printed := self.published.get("midpoint_energy_variation")) is not None:
            lines[-1] += f"   published {citation(self, printed)}"
        if not found.converged:
            lines.append("  NOT all of these steps converged: values after the first failure are wrong")
        return lines

    @for_last_run
    def energies(self, run: Run) -> Energies:
        """Integrate by both rules from the nominal state, at most `_LONGEST` steps, all saved."""
        one, steps = run.member(0), min(self.steps, _LONGEST)
        rules = [(f"the rule {self.rule!r}", one.step), (MIDPOINT, step_of(one.system, "additive", 2, "symplectic"))]
        if (self.rule, self.alpha) == ("symplectic", 0.5):
            rules = [(MIDPOINT, one.step)]
        made = {name: self.drawn(one, steps=steps, step=step) for name, step in rules}
        energy = {name: series(PseudoRigidBody.energy, long) for name, long in made.items()}
        own = next(iter(made.values()))
        displacement = np.sum((np.asarray(own.state.q) - np.eye(3)) ** 2, axis=(1, 2))
        converged = all(bool(np.all(long.info.converged)) for long in made.values())
        return Energies(np.asarray(own.t), energy, displacement, converged)

    @picture(2, subplot_kw={"projection": "3d"})
    def draw_torus(self, axes: np.ndarray, run: Run) -> None:
        """Draw delay plots as in the paper's Figures 3 to 5: of the midpoint rule's energy, and of the displacement."""
        found = self.energies(run)
        panels = {
            f"energy H of the {MIDPOINT}": ("H", found.energy[MIDPOINT]),
            f"displacement d = ‖F − 1‖² of the rule {self.rule!r}": ("d", found.displacement),
        }
        for ax, (title, (symbol, x)) in zip(axes, panels.items(), strict=True):
            plots.delay_plot(ax, np.asarray(diagnostics.delay(jnp.asarray(x), self.lag)), symbol)
            ax.set_title(f"{title},\nless the middle of its range, at the steps n, n + N, n + 2N; N = {self.lag}")

    @picture(2)
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot energy errors of the nominal member by the scenario's rule and the midpoint rule; its displacement."""
        found = self.energies(run)
        size = max(float(abs(H[0])) for H in found.energy.values())
        errors = {name: H - H[0] for name, H in found.energy.items()}
        plots.log_error(axes[0], found.t, errors, "energy error", self.time_unit, size=size, of="|H₀|")
        plots.series(axes[1], found.t, {"": found.displacement}, "displacement ‖F − 1‖²", self.time_unit)


class Energies(NamedTuple):
    """The nominal member at every step: H by the scenario's rule and the midpoint rule, ‖F − 1‖² by the former."""

    t: np.ndarray
    energy: dict[str, np.ndarray]
    displacement: np.ndarray
    converged: bool


MIDPOINT = "implicit midpoint rule"
