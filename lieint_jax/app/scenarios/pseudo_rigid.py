"""A pseudo-rigid body: conservation, measured and promised by the rule, delay plots, and energy by two rules."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field, model_validator

from lieint_jax import _checks, diagnostics, schemes, systems
from lieint_jax._numerics import random_bits
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._common import (
    TINY,
    Common,
    NonNegative,
    NumberSpread,
    PositiveFloat,
    PositiveInt,
    Published,
    Rate,
    RateSpread,
    Table,
    Triple,
    checked,
    member_indices,
)
from lieint_jax.app.scenarios._pictures import picture
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, citation
from lieint_jax.app.scenarios._runs import cached_for_last_run, drawn_trajectory, nominal_state, series
from lieint_jax.app.scenarios._spread import POSITIVE_DETERMINANT, SECOND_MOMENTS, for_member
from lieint_jax.systems import PseudoRigidBody
from lieint_jax.types import State, Step, Trajectory
from lieint_jax.types.shapes import PyTree

_LONGEST = 4_000  # largest number of drawn steps, which are all saved, since a delay plot needs each

Matrix = Annotated[list[Triple], Field(min_length=3, max_length=3)]


class Material(Table):
    """A law of stored energy and its Lamé constants."""

    law: Literal["mooney_rivlin", "neo_hookean", "saint_venant_kirchhoff"] = "mooney_rivlin"
    lam: PositiveFloat
    """Lamé's λ times the body's volume: an energy."""
    mu: PositiveFloat
    """Lamé's μ times the body's volume: an energy."""


def _check_determinant(matrix: list[list[float]]) -> None:
    if not np.linalg.det(matrix) > 0:
        raise ValueError("must have a positive determinant")


class InitialState(Rate):
    """The nominal state: F, and one of angular velocity in space, velocity and momentum."""

    deformation: Annotated[Matrix, POSITIVE_DETERMINANT, checked(_check_determinant)] = np.eye(3).tolist()
    """F, 3 × 3, without unit; by default undeformed, axes along those of space."""
    velocity: Matrix | None = None
    """The time derivative of F, per time_unit."""
    momentum: Matrix | None = None
    """P, of F: velocity times the second moments of mass."""

    @model_validator(mode="after")
    def _check_motion(self) -> Self:
        if len(self.motion()) != 1:
            raise ValueError("give exactly one of angular_velocity_rad, angular_velocity_deg, velocity, momentum")
        return self

    def motion(self) -> dict[str, Any]:
        given = {"angular_velocity": self.rate(), "velocity": self.velocity, "momentum": self.momentum}
        return {key: value for key, value in given.items() if value is not None}


class Spread(RateSpread, NumberSpread):
    """Standard deviations of the members about the nominal state, to which an angular velocity is added, and of
    numbers of the scenario by their paths."""

    deformation: NonNegative = 0.0
    """Standard deviation of each entry of F, without unit."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["pseudo_rigid"]  # pyright: ignore[reportIncompatibleVariableOverride]
    inertia: Annotated[list[Any], SECOND_MOMENTS, checked(partial(_checks.positive_definite, "inertia"))]
    """E, the second moments of mass, principal (3) or a tensor in body axes (3 × 3)."""
    material: Material
    scheme: Literal["additive"] = "additive"
    rule: Literal["average", "symplectic", "energy", "energy_momentum"] = "average"
    alpha: Annotated[float, Field(ge=0, le=1)] = 0.5
    """α of the symplectic rule."""
    lag: PositiveInt = 3
    """The delay of the delay plots, in steps."""
    state: InitialState
    spread: Spread = Spread()
    published: dict[Literal["midpoint_energy_variation"], Published] = {}

    fixed: ClassVar[dict[str, str]] = Common.fixed | {"alpha": "it is a number of the scheme"}

    @model_validator(mode="after")
    def _check_alpha(self) -> Self:
        if self.alpha != 0.5 and self.rule != "symplectic":
            raise ValueError(f"alpha: the rule {self.rule!r} conserves energy for 0.5 only (got {self.alpha})")
        if self.steps <= 2 * self.lag:
            raise ValueError(f"steps = {self.steps} must be more than 2·lag = {2 * self.lag}")
        return self

    def spreads(self) -> dict[str, tuple[float, str]]:
        return {"F": (self.spread.deformation, ""), "angular velocity": self.spread.with_unit(self.time_unit)}


def build(scenario: Scenario, indices: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states, the nominal one first."""
    for_F, for_spin = jax.random.split(jax.random.key(scenario.seed))
    indices, members = member_indices(scenario, indices), scenario.members
    first = jnp.asarray(indices == 0)
    dF = scenario.spread.deformation * random_bits.normal_rows(for_F, (members, 3, 3), indices)
    spin = scenario.spread.rate() * random_bits.normal_rows(for_spin, (members, 3), indices)
    dF, spin = jnp.where(first[:, None, None], 0.0, dF), jnp.where(first[:, None], 0.0, spin)
    step, states = _spread.build(scenario, (dF, spin), _step, _start)
    start = _nominal(scenario, for_member(scenario, step.system))

    def exact(x: Array, x0: Array) -> Array:  # the nominal state, since F⁻¹F rounds
        return jnp.where(first.reshape(-1, *[1] * x0.ndim), x0, x)

    return step, jax.tree.map(exact, states, start)


def _step(scenario: Scenario) -> Step:
    material = getattr(systems, scenario.material.law)(scenario.material.lam, scenario.material.mu)
    body = systems.pseudo_rigid_body(jnp.asarray(scenario.inertia), material)
    return schemes.additive(body, scenario.rule, scenario.alpha)


def _nominal(scenario: Scenario, body: Any) -> State:
    """The nominal state of a scenario."""
    motion = {name: jnp.asarray(x) for name, x in scenario.state.motion().items()}
    return body.state(jnp.asarray(scenario.state.deformation), **motion)


def _start(scenario: Scenario, body: Any, noise: PyTree) -> State:
    dF, spin = noise
    start = _nominal(scenario, body)
    F, V = start.q + dF, body.velocity(start)
    rotating = body.state(F, angular_velocity=spin)
    return rotating._replace(p=rotating.p + body.state(F, velocity=V @ jnp.linalg.inv(start.q) @ F).p)


def conserved(scenario: Scenario, body: PseudoRigidBody, run: Trajectory) -> list[Conserved]:
    """Energy and momentum, relative to the member's initial |H| and |Φ|."""
    H, Phi = series(PseudoRigidBody.energy, run, body), series(PseudoRigidBody.momentum, run, body)
    size = np.maximum(np.linalg.norm(Phi[0], axis=-1), TINY)
    promised = "bounded, not conserved" if scenario.rule == "symplectic" else ROUND_OFF
    return [
        Conserved("energy, relative", H, np.maximum(abs(H[0]), TINY), promised),
        Conserved("momentum rot[PFᵀ], relative", Phi, size, ROUND_OFF),
    ]


def remarks(scenario: Scenario, step: Step, run: Trajectory) -> list[str]:
    """The least det F; the energy of the nominal member by the midpoint rule and the published variation."""
    found, least = energies(scenario, step, run), float(np.linalg.det(run.state.q).min())
    lines = [f"  {'least det F':<34}{least:>10.3g}   above 0, or flagged"]
    lines += [f"\n  energy of the nominal member, {len(found.t) - 1} steps, max − min"]
    lines += [f"  {name:<34}{np.ptp(H):>12.3g}" for name, H in found.energy.items()]
    if (printed := scenario.published.get("midpoint_energy_variation")) is not None:
        lines[-1] += f"   published {citation(scenario, printed)}"
    if not found.converged:
        lines.append("  NOT all of these steps converged: values after the first failure are wrong")
    return lines


class Energies(NamedTuple):
    """The nominal member at every step: H by the scenario's rule and the midpoint rule, ‖F − 1‖² by the former."""

    t: np.ndarray
    energy: dict[str, np.ndarray]
    displacement: np.ndarray
    converged: bool


MIDPOINT = "implicit midpoint rule"


@cached_for_last_run
def energies(scenario: Scenario, step: Step, run: Trajectory) -> Energies:
    """Integrate by both rules from the nominal state, at most `_LONGEST` steps, all saved."""
    step = for_member(scenario, step)
    body, start, energy = step.system, nominal_state(run), {}
    steps = min(scenario.steps, _LONGEST)
    own = midpoint = drawn_trajectory(step, start, scenario.dt, steps)
    converged = bool(np.all(own.info.converged))
    if (scenario.rule, scenario.alpha) != ("symplectic", 0.5):
        energy[f"the rule {scenario.rule!r}"] = np.asarray(jax.vmap(body.energy)(own.state))
        midpoint = drawn_trajectory(schemes.additive(body, "symplectic"), start, scenario.dt, steps)
        converged &= bool(np.all(midpoint.info.converged))
    energy[MIDPOINT] = np.asarray(jax.vmap(body.energy)(midpoint.state))
    displacement = np.sum((np.asarray(own.state.q) - np.eye(3)) ** 2, axis=(1, 2))
    return Energies(np.asarray(own.t), energy, displacement, converged)


@picture(2, subplot_kw={"projection": "3d"})
def draw_torus(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Draw delay plots as in the paper's Figures 3 to 5: of the midpoint rule's energy, and of the displacement."""
    found = energies(scenario, step, run)
    panels = {
        f"energy H of the {MIDPOINT}": ("H", found.energy[MIDPOINT]),
        f"displacement d = ‖F − 1‖² of the rule {scenario.rule!r}": ("d", found.displacement),
    }
    for ax, (title, (symbol, x)) in zip(axes, panels.items(), strict=True):
        plots.delay_plot(ax, np.asarray(diagnostics.delay(jnp.asarray(x), scenario.lag)), symbol)
        ax.set_title(f"{title},\nless the middle of its range, at the steps n, n + N, n + 2N; N = {scenario.lag}")


@picture(2)
def draw_energy(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot energy errors of the nominal member by the scenario's rule and by the midpoint rule; its displacement."""
    found = energies(scenario, step, run)
    size = max(float(abs(H[0])) for H in found.energy.values())
    errors = {name: H - H[0] for name, H in found.energy.items()}
    plots.log_error(axes[0], found.t, errors, "energy error", scenario.time_unit, size, "|H₀|")
    plots.series(axes[1], found.t, {"": found.displacement}, "displacement ‖F − 1‖²", scenario.time_unit)


PICTURES = {"torus": draw_torus, "energy": draw_energy}
