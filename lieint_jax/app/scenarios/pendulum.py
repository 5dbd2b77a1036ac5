"""A spherical pendulum: its conserved quantities, swing and precession compared with the closed form, and its path."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
from pydantic import AliasChoices, Field, model_validator

from lieint_jax import schemes, systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread, heavy_top
from lieint_jax.app.scenarios._common import (
    Common,
    NonNegative,
    NumberSpread,
    PositiveFloat,
    Table,
    Triple,
    UnitVector,
    compose_to_order,
    deviates,
)
from lieint_jax.app.scenarios._pictures import changes_by_scheme, draw_on_sphere, picture
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, Quantity
from lieint_jax.app.scenarios._runs import drawn_trajectory, nominal_state, series
from lieint_jax.app.scenarios._spread import DIRECTION, for_member, same_side_of
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.systems import Pendulum, PotentialTop
from lieint_jax.types import State, Step, Trajectory

_FINE = 4  # steps of the drawn path per step of the scenario, so that it reaches its bounds


class InitialState(Table):
    """The nominal state: a unit vector, and a velocity, whose component along the vector is removed."""

    direction: Annotated[UnitVector, DIRECTION]
    """A unit vector in space, from the pivot to the bob."""
    velocity: Triple
    """The velocity of the direction, per time_unit: for a pendulum of length 1 the bob's velocity."""


class Spread(NumberSpread):
    """Standard deviations of each component of the members' states, and of numbers of the scenario by their paths."""

    direction_deg: NonNegative = 0.0
    """In degrees."""
    velocity: NonNegative = 0.0
    """Standard deviation of the velocity of the direction, per time_unit."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["pendulum"]  # pyright: ignore[reportIncompatibleVariableOverride]
    mass: PositiveFloat
    """In a unit of mass."""
    gravity: Annotated[float, same_side_of(0)]
    """The acceleration of gravity over the pendulum's length, per time_unit squared."""
    axis: Annotated[UnitVector, DIRECTION] = [0.0, 0.0, -1.0]
    """The direction of gravity in space, a unit vector: downwards."""
    scheme: Literal["sphere_midpoint"] = "sphere_midpoint"
    normalized: bool = Field(default=False, validation_alias=AliasChoices("normalized", "normalised"))
    """Whether the midpoint is projected to the sphere, which makes the scheme symplectic."""
    order: Literal[2, 4, 6, 8] = 2
    """The order of accuracy; above 2 by composition."""
    state: InitialState
    spread: Spread = Spread()

    @model_validator(mode="after")
    def _check_gravity(self) -> Scenario:
        if self.gravity == 0:
            raise ValueError("gravity must not be 0")
        return self

    def spreads(self) -> dict[str, tuple[float, str]]:
        return {"direction": (self.spread.direction_deg, "°"), "velocity": (self.spread.velocity, "")}


def build(scenario: Scenario, indices: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states, the nominal one first."""
    return _spread.build(scenario, deviates(scenario, indices), _step, _start)


def _step(scenario: Scenario) -> Step:
    bob = systems.pendulum(scenario.mass, scenario.gravity, scenario.axis)
    return compose_to_order(schemes.sphere_midpoint(bob, scenario.normalized), scenario.order)


def _start(scenario: Scenario, bob: Pendulum, noise: Any) -> State:
    rotation, change = jnp.deg2rad(scenario.spread.direction_deg) * noise[0], scenario.spread.velocity * noise[1]
    q = so3.Ad(so3.exp(rotation), jnp.asarray(scenario.state.direction))
    V = jnp.asarray(scenario.state.velocity) + change
    return bob.state(q, velocity=V - q * (q @ V) / (q @ q))


def conserved(scenario: Scenario, bob: Pendulum, run: Trajectory) -> list[Conserved]:
    """Energy relative to ½|π|²/m + |mG|, γ·π relative to √(2m(H + |mG|)); |q|² − 1 and q·π, which are 0."""
    H, gamma_pi, defect = (series(f, run, bob) for f in (Pendulum.energy, Pendulum.momentum, _defect))
    depth = abs(float(bob.potential(bob.axis)))
    kinetic = H[0] + depth  # its largest value, at the lowest point
    return [
        Conserved("energy, relative", H, kinetic + depth, ROUND_OFF),
        Conserved("γ·π, relative", gamma_pi[..., 0], np.sqrt(2 * float(bob.mass) * kinetic), ROUND_OFF),
        Conserved("constraints |q| = 1, q·π = 0", defect, promise=ROUND_OFF, initial=0.0),
    ]


def _defect(bob: Pendulum, state: State) -> Any:
    return bob.phase_space.defect(state)


def as_top(bob: Pendulum, run: Trajectory) -> tuple[PotentialTop, Trajectory]:
    """The pendulum in a uniform field as Lagrange's top without spin: Λe₃ = q, Π₃ = q·π = 0; the top's axis is −γ."""
    depth = -bob.potential(bob.axis)
    top = systems.heavy_top(jnp.full(3, bob.mass), jnp.array([0.0, 0.0, 1.0]) * depth, -bob.axis)
    q: Any = series(_attitude, run)
    return top, run._replace(state=State(q, run.state.p))


def _attitude(state: State) -> Any:
    return so3.from_matrix(jnp.stack([*frame(state.q), state.q], axis=1))


def quantities(scenario: Scenario, bob: Pendulum, run: Trajectory) -> list[Quantity]:
    """Period, precession and bounds of the swing, measured for every member, and in closed form."""
    period, rate, least, greatest = heavy_top.quantities(scenario, *as_top(bob, run))
    return [
        replace(period, name=f"lowest point to lowest point ({scenario.time_unit})"),
        _complement(f"mean rate about γ (rad/{scenario.time_unit})", rate, 0.0),
        _complement("least angle from γ (°)", greatest, 180.0),
        _complement("greatest angle from γ (°)", least, 180.0),
    ]


def _complement(name: str, of_top: Quantity, total: float) -> Quantity:
    """The quantity of the pendulum that adds up with one of the top to `total`."""
    assert of_top.closed_form is not None
    return replace(of_top, name=name, values=total - of_top.values, closed_form=total - of_top.closed_form)


def remarks(scenario: Scenario, step: Step, run: Trajectory) -> list[str]:
    """How to read the table."""
    return [
        heavy_top.CLOSED_FORM,
        "  — none: fewer than two swings, states saved too rarely, or a swing through the axis",
    ]


@picture(2, spatial=(0,))
def draw_path(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot a dozen swings of the bob on the sphere, seen from below, and its angle from γ against time."""
    step = for_member(scenario, step)
    bob, unit = step.system, scenario.time_unit
    period, _, *bounds = quantities(scenario, bob, run)
    steps = scenario.steps
    if np.isfinite(period.nominal):
        steps = min(steps, int(12 * period.nominal / abs(scenario.dt)) + 1)
    long = drawn_trajectory(step, nominal_state(run), scenario.dt / _FINE, _FINE * steps)
    known = [x.closed_form for x in bounds if x.closed_form is not None and np.isfinite(x.closed_form)]
    path, ends = np.asarray(long.state.q), np.asarray(run.state.q[-1])
    look = {"unit": unit, "pole_label": "γ, down", "bounds": known}
    draw_on_sphere(axes, np.asarray(long.t), path, float(run.t[-1]), ends, np.asarray(bob.axis), **look)
    axes[0].set_title(f"the nominal bob to t = {long.t[-1]:.4g} {unit}")
    axes[1].set_title("dashed: its bounds in closed form")


@picture(2)
def draw_energy(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot energy and constraint errors of the nominal member by both forms of the midpoint rule."""
    bob = for_member(scenario, step.system)
    both = [schemes.sphere_midpoint(bob, normalized) for normalized in (False, True)]
    t, found = changes_by_scheme(conserved, scenario, both, nominal_state(run))
    for ax, name in ((axes[0], "energy, relative"), (axes[1], "constraints |q| = 1, q·π = 0")):
        plots.log_error(ax, t, {scheme: errors[name] for scheme, errors in found.items()}, name, scenario.time_unit)


PICTURES = {"path": draw_path, "energy": draw_energy}
