"""A neutrally buoyant ellipsoid in a fluid: its conserved quantities, its tilt, and the stability of its spin."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import maps, schemes
from lieint_jax._numerics import random_bits
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._common import (
    TINY,
    Common,
    GivenRate,
    NonNegative,
    NumberSpread,
    PositiveTriple,
    RateSpread,
    Triple,
    compose_to_order,
    member_indices,
)
from lieint_jax.app.scenarios._pictures import changes_by_scheme, picture
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runge_kutta import RungeKutta
from lieint_jax.app.scenarios._runs import angles_deg, drawn_trajectory, member_state, nominal_state, series
from lieint_jax.app.scenarios._spread import for_member
from lieint_jax.systems import Euler, kirchhoff
from lieint_jax.types import State, Step, Trajectory


class InitialState(GivenRate):
    """The nominal state: at the origin, with axes along those of space, and velocities in the body."""

    velocity: Triple
    """In body axes, in the unit of semi_axes per time_unit."""


class Spread(RateSpread, NumberSpread):
    """Standard deviations of the members about the nominal state, and of numbers of the scenario by their paths."""

    velocity: NonNegative = 0.0
    """Standard deviation of each component, in the unit of semi_axes per time_unit."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["kirchhoff"]  # pyright: ignore[reportIncompatibleVariableOverride]
    semi_axes: PositiveTriple
    """The semi-axes of the ellipsoid, in a unit of length."""
    center_of_mass: Triple = [0.0, 0.0, 0.0]
    """In body axes from the center of the ellipsoid, in the same unit."""
    scheme: Literal["group_midpoint"] = "group_midpoint"
    map: Literal["exponential", "cayley"] = "exponential"
    order: Literal[2, 4, 6, 8] = 2
    """The order of accuracy; above 2 by composition."""
    state: InitialState
    spread: Spread = Spread()

    def spreads(self) -> dict[str, tuple[float, str]]:
        return {"angular velocity": self.spread.with_unit(self.time_unit), "velocity": (self.spread.velocity, "")}


def build(scenario: Scenario, indices: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states, the nominal one first."""
    indices, key = member_indices(scenario, indices), jax.random.key(scenario.seed)
    noise = random_bits.normal_rows(key, (scenario.members, 6), indices)
    noise = jnp.where((indices == 0)[:, None], 0.0, noise)
    return _spread.build(scenario, noise, _step, _start, traced=False)


def _step(scenario: Scenario) -> Step:
    a, b, c = scenario.semi_axes
    body = kirchhoff((a, b, c), scenario.center_of_mass)
    return compose_to_order(schemes.group_midpoint(body, getattr(maps, scenario.map)), scenario.order)


def _start(scenario: Scenario, body: Euler, noise: Any) -> State:
    unit = jnp.repeat(jnp.array([scenario.spread.rate(), scenario.spread.velocity]), 3)
    velocity = jnp.array([*(scenario.state.rate() or []), *scenario.state.velocity]) + unit * noise
    return body.state(velocity=velocity)


def conserved(scenario: Scenario, body: Euler, run: Trajectory) -> list[Conserved]:
    """Energy, the momentum in space and the Casimirs."""
    H, (Pi_P, P_P) = series(Euler.energy, run, body), np.moveaxis(series(Euler.casimirs, run, body), -1, 0)
    p = np.asarray(run.state.p)
    angular, linear = (np.linalg.norm(x[0], axis=-1) for x in (p[..., :3], p[..., 3:]))
    return [
        Conserved("energy", H, H[0], "round-off"),
        Conserved("spatial momentum π", p, abs(p[0]).max(), "bit for bit"),
        Conserved("Π·P", Pi_P, np.maximum(angular * linear, TINY), "round-off"),
        Conserved("|P|²", P_P, np.maximum(linear**2, TINY), "round-off"),
    ]


def quantities(scenario: Scenario, body: Euler, run: Trajectory) -> list[Quantity]:
    """The mean speed along the impulse P, and the largest angle of the third axis from its initial direction."""
    q, p, t = np.asarray(run.state.q), np.asarray(run.state.p), np.asarray(run.t)
    P = p[0, :, 3:]
    distance = np.einsum("mi,mi->m", q[-1, :, :3, 3] - q[0, :, :3, 3], P)
    speed = distance / np.maximum(np.linalg.norm(P, axis=1), TINY) / (t[-1] - t[0])
    return [
        Quantity(f"mean speed along the impulse (/{scenario.time_unit})", speed),
        Quantity("third axis strays by (°)", tilts(q).max(axis=0)),
    ]


def remarks(scenario: Scenario, step: Step, run: Trajectory) -> list[str]:
    """Whether the spin is stable, and the added mass and inertia of the fluid."""
    body = for_member(scenario, step.system)
    needed = spin_needed(body)
    if needed is None:
        lines = ["  (the needed spin is known in closed form for a body of revolution about the third axis)"]
    else:
        Pi = np.asarray(body.body_momentum(nominal_state(run)))
        spin = abs(Pi[2] / Pi[5]) if Pi[5] else np.inf
        verdict = "stable" if spin > needed else "not stable"
        lines = [f"  |Π₃/P₃| = {spin:.4f}, needed to move along the third axis: {needed:.4f} [Lamb §128]: {verdict}"]
    a, b, c = scenario.semi_axes
    m, axes = np.diag(np.asarray(kirchhoff((a, b, c)).metric)), np.array([a, b, c])
    solid = (np.sum(axes**2) - axes**2) / 5
    lines.append(f"\n  {'in the axes of the ellipsoid':<34}" + "".join(f"{a:>10g}" for a in axes))
    for name, values in {"added mass ÷ displaced": m[3:] - 1, "added inertia ÷ displaced": m[:3] / solid - 1}.items():
        lines.append(f"  {name:<34}" + "".join(f"{x:>10.3f}" for x in values))
    return lines


def spin_needed(body: Euler) -> float | None:
    """The least |Π₃/P₃| with which a body of revolution moves stably along its axis, 0 if it needs no spin.

    It is 2√(I₁(1/m₃ − 1/m₁)). None unless it is a body of revolution about the third axis with a central mass.
    """
    m = np.asarray(body.metric)
    I1, I2, _, m1, m2, m3 = np.diag(m)
    if max(abs(I1 - I2), abs(m1 - m2), abs(m - np.diag(np.diag(m))).max()) > 1e-12 * m.max():
        return None
    return float(2 * np.sqrt(max(I1 * (1 / m3 - 1 / m1), 0.0)))


def tilts(q: Any) -> np.ndarray:
    """The angle in degrees of the third axis from its initial direction, for motions (times, …, 4, 4)."""
    axis = np.asarray(q)[..., :3, 2]
    return angles_deg(axis, axis[0])


@picture(2, spatial=(0, 1))
def draw_path(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot the path of the center of the nominal and the last member, and the last one's third axis on the sphere."""
    left, right = axes
    last, name_of_last = (
        member_state(run, -1),
        f"member {scenario.members - 1}" if scenario.members > 1 else "nominal member",
    )
    members = {"nominal member": (0, nominal_state(run)), name_of_last: (-1, last)}
    paths = {
        name: np.asarray(drawn_trajectory(for_member(scenario, step, m), z, scenario.dt, scenario.steps).state.q)
        for name, (m, z) in members.items()
    }
    for (name, q), color in zip(paths.items(), (plots.INK, plots.BLUE), strict=False):
        left.plot(*q[:, :3, 3].T, color=color, lw=0.8, label=name)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=2)
    until = f"to t = {run.t[-1]:.4g} {scenario.time_unit}"
    plots.cube(left).set(xlabel="x", ylabel="y", zlabel="z")
    left.set_title(f"path of the center {until}, in the unit of the semi-axes")
    q = paths[name_of_last]
    P = np.asarray(last.p[3:])
    pole = P / np.linalg.norm(P) if P.any() else None
    plots.sphere_path(
        right, q[:, :3, 2], pole, eye=q[0, :3, 2] + 0.5 * q[0, :3, 0], pole_label="direction of the impulse"
    )
    right.set_title(f"third axis of {name_of_last.replace('nominal', 'the nominal')} in space")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02))


@picture(2)
def draw_energy(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot energy errors of the last member by this scheme and by Runge–Kutta, and the tilts of all members' axes."""
    left, right = axes
    step = for_member(scenario, step, -1)
    t, found = changes_by_scheme(conserved, scenario, (step, RungeKutta(step.system)), member_state(run, -1))
    curves = {scheme: errors["energy"] for scheme, errors in found.items()}
    plots.log_error(left, t, curves, "energy error, relative", scenario.time_unit)
    tilt = tilts(run.state.q)
    if scenario.members > 1:
        right.plot(run.t, tilt[:, 1], color=plots.BLUE, lw=0.4, alpha=0.6, label="the other members")
        right.plot(run.t, tilt[:, 2:], color=plots.BLUE, lw=0.4, alpha=0.4)
    right.plot(run.t, tilt[:, 0], color=plots.INK, lw=1.2, label="nominal member")
    right.set(xlabel=f"t ({scenario.time_unit})", ylabel="third axis strays by (°)")
    right.legend()


PICTURES = {"path": draw_path, "energy": draw_energy}
