"""A spherical pendulum: its conserved quantities, swing and precession compared with the closed form, and its path."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import AliasChoices, Field, field_validator, model_validator

from lieint_jax import _checks, diagnostics, schemes, systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios import heavy_top
from lieint_jax.app.scenarios._common import Above, Common, NonNegative, Table, Triple, follow, nominal, series
from lieint_jax.app.scenarios.heavy_top import Comparison, comparison_lines
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.systems import Pendulum, PotentialTop
from lieint_jax.types import State, Step, Trajectory


class InitialState(Table):
    """The nominal state: a unit vector, and a velocity, whose component along the vector is removed."""

    direction: Triple
    """A unit vector in space, from the pivot to the bob."""
    velocity: Triple
    """Of the direction, per time_unit: for a pendulum of length 1 the bob's velocity."""

    @field_validator("direction")
    @classmethod
    def _unit(cls, value: list[float]) -> list[float]:
        return _unit_vector(value)


class Spread(Table):
    """Standard deviations, per component, of the members about the nominal state."""

    direction_deg: NonNegative = 0.0
    """In degrees."""
    velocity: NonNegative = 0.0
    """Of the direction, per time_unit."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["pendulum"]  # pyright: ignore[reportIncompatibleVariableOverride]
    mass: Above
    """In a unit of mass."""
    gravity: float
    """The acceleration of gravity over the pendulum's length, per time_unit squared."""
    axis: Triple = [0.0, 0.0, -1.0]
    """The direction of gravity in space, a unit vector: downwards."""
    scheme: Literal["sphere_midpoint"] = "sphere_midpoint"
    normalized: bool = Field(default=False, validation_alias=AliasChoices("normalized", "normalised"))
    """Whether the midpoint is put back on the sphere, which makes the scheme symplectic."""
    order: Literal[2, 4, 6, 8] = 2
    """Of accuracy; above 2 by composition."""
    state: InitialState
    spread: Spread = Spread()

    @field_validator("axis")
    @classmethod
    def _unit(cls, value: list[float]) -> list[float]:
        return _unit_vector(value)

    @model_validator(mode="after")
    def _some_gravity(self) -> Scenario:
        if self.gravity == 0:
            raise ValueError("gravity must not be 0")
        return self

    def assumption(self) -> str:
        return (
            f"spread about the nominal state, an assumption: {self.spread.direction_deg:g}° of direction and "
            f"{self.spread.velocity:g} of velocity (1 sigma, each component)"
        )


def _unit_vector(value: list[float]) -> list[float]:
    if abs(np.linalg.norm(value) - 1) > _checks.UNIT_TOLERANCE:
        raise ValueError("must be a unit vector; divide it by its norm")
    return value


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step and the batch of initial states, the nominal one first."""
    bob = systems.pendulum(scenario.mass, scenario.gravity, scenario.axis)
    kick, jolt = jax.random.normal(jax.random.key(scenario.seed), (2, scenario.members, 3)).at[:, 0].set(0.0)
    kick, jolt = jnp.deg2rad(scenario.spread.direction_deg) * kick, scenario.spread.velocity * jolt

    def member(kick: Any, jolt: Any) -> State:
        q = so3.Ad(so3.exp(kick), jnp.asarray(scenario.state.direction))
        V = jnp.asarray(scenario.state.velocity) + jolt
        return bob.state(q, velocity=V - q * (q @ V) / (q @ q))

    step = schemes.sphere_midpoint(bob, scenario.normalized)
    step = step if scenario.order == 2 else schemes.compose(step, scenario.order)
    return step, jax.vmap(member)(kick, jolt)


def report(scenario: Scenario, step: Any, run: Trajectory) -> str:
    """The changes of conserved quantities, worst of all members; the swing compared with the closed form."""
    lines = [f"\n  {'largest change, all members':<34}{'found':>10}   the scheme promises"]
    lines += [f"  {name:<34}{x:>10.1e}   conserved to round-off" for name, x in changes(step.system, run).items()]
    lines += comparison_lines(quantities(step.system, run, scenario.time_unit))
    lines.append(
        "  closed form: elliptic integrals; the difference is the scheme's error, of its order in dt, or round-off"
    )
    lines.append("  — none: fewer than two swings, states saved too far apart, or a swing through the axis")
    return "\n".join(lines)


def changes(bob: Pendulum, run: Trajectory) -> dict[str, float]:
    """Largest changes: energy relative to ½|π|²/m + |mG|, γ·π relative to √(2m(H + |mG|)); |q|² − 1 and q·π."""
    H, gamma_pi, defect = (series(f, run) for f in (bob.energy, lambda z: bob.momentum(z)[0], bob.phase_space.defect))
    depth = abs(float(bob.potential(bob.axis)))
    kinetic = H[0] + depth  # its largest value, at the lowest point
    return {
        "energy, relative": float(np.max(abs(H - H[0]) / (kinetic + depth))),
        "γ·π, relative": float(np.max(abs(gamma_pi - gamma_pi[0]) / np.sqrt(2 * float(bob.mass) * kinetic))),
        "constraints |q| = 1, q·π = 0": float(np.max(defect)),
    }


def as_top(bob: Pendulum, run: Trajectory) -> tuple[PotentialTop, Trajectory]:
    """The pendulum in a uniform field as Lagrange's top without spin: Λe₃ = q, Π₃ = q·π = 0; the top's axis is −γ."""
    depth = -bob.potential(bob.axis)
    top = systems.heavy_top(jnp.full(3, bob.mass), jnp.array([0.0, 0.0, 1.0]) * depth, -bob.axis)

    def attitude(state: State) -> Any:
        return so3.from_matrix(jnp.stack([*frame(state.q), state.q], axis=1))

    q: Any = series(attitude, run)
    return top, run._replace(state=State(q, run.state.p))


def quantities(bob: Pendulum, run: Trajectory, unit: str) -> list[Comparison]:
    """Period, precession and bounds of the swing, measured for every member, and in closed form."""
    top, turned = as_top(bob, run)
    period, rate, least, greatest = heavy_top.quantities(top, turned, unit)
    return [
        Comparison(f"lowest point to lowest point ({unit})", *period[1:]),
        Comparison(f"mean rate about γ (rad/{unit})", -rate.nominal, rate.spread, -rate.closed_form),
        Comparison("least angle from γ (°)", 180 - greatest.nominal, greatest.spread, 180 - greatest.closed_form),
        Comparison("greatest angle from γ (°)", 180 - least.nominal, least.spread, 180 - least.closed_form),
    ]


@plots.style()
def draw_path(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot a dozen swings of the bob on the sphere, seen from below and aside, and its angle from γ against time."""
    bob, unit = step.system, scenario.time_unit
    rows = quantities(bob, run, unit)
    steps = scenario.steps
    if np.isfinite(rows[0].nominal):
        steps = min(steps, int(12 * rows[0].nominal / abs(scenario.dt)) + 1)
    long = follow(step, nominal(run), scenario.dt, steps)
    path, axis = np.asarray(long.state.q), np.asarray(bob.axis)
    fig, axes = plots.figure(2)
    axes[0, 0].remove()
    left, right = fig.add_subplot(1, 2, 1, projection="3d"), axes[0, 1]
    plots.sphere_path(left, path, axis, eye=axis + 0.8 * path[0], pole_label="γ")
    if scenario.members > 1:
        ends = np.asarray(run.state.q[-1])
        plots.sphere_points(left, ends, f"members at t = {run.t[-1]:.4g}", color=plots.INK, s=2, alpha=0.5)
    left.legend(loc="lower left")
    left.set_title(f"the bob to t = {long.t[-1]:.4g} {unit}")
    angle = np.rad2deg(np.arccos(np.clip(path @ axis, -1, 1)))
    plots.series(right, np.asarray(long.t), {"": angle}, "angle from γ (°)", unit)
    for row in rows[2:]:
        if np.isfinite(row.closed_form):
            right.axhline(row.closed_form, color=plots.RED, lw=0.7, ls="--")
    right.set_title("dashed: its bounds in closed form")
    fig.suptitle(scenario.title)
    return fig


@plots.style()
def draw_energy(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot energy and constraint errors of the nominal member by both forms of the midpoint rule."""
    unit = scenario.time_unit
    bob, energy, constraint, t = step.system, {}, {}, np.zeros(0)
    for normalized in (False, True):
        scheme = schemes.sphere_midpoint(bob, normalized)
        long = follow(scheme, nominal(run), scenario.dt, scenario.steps)
        energy[scheme.name] = np.asarray(diagnostics.energy_error(bob, long))
        constraint[scheme.name] = np.asarray(diagnostics.constraint_error(bob, long))
        t = np.asarray(long.t)
    fig, axes = plots.figure(2)
    H = abs(float(bob.energy(nominal(run)))) or 1.0
    plots.log_error(axes[0, 0], t, {k: error / H for k, error in energy.items()}, "energy error, over |H₀|", unit)
    plots.log_error(axes[0, 1], t, constraint, "constraint error |q|² − 1", unit)
    fig.suptitle(scenario.title)
    return fig


PICTURES = {"path": draw_path, "energy": draw_energy}
