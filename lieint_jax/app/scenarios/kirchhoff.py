"""A neutrally buoyant ellipsoid in a fluid: its conserved quantities, its tilt, and whether its spin is stable."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field, model_validator

from lieint_jax import diagnostics, maps, schemes
from lieint_jax.app import plots
from lieint_jax.app.scenarios._common import (
    Above,
    Common,
    NonNegative,
    Rate,
    RateSpread,
    Triple,
    deviation,
    follow,
    member,
    nominal,
    series,
)
from lieint_jax.app.scenarios._runge_kutta import RungeKutta
from lieint_jax.systems import Euler, kirchhoff
from lieint_jax.types import State, Step, Trajectory

PositiveTriple = Annotated[list[Above], Field(min_length=3, max_length=3)]


class InitialState(Rate):
    """The nominal state: at the origin, axes along those of space, with these velocities in the body."""

    velocity: Triple
    """In body axes, in the unit of semi_axes per time_unit."""

    @model_validator(mode="after")
    def _one_rate(self) -> Self:
        if self.rate() is None:
            raise ValueError("give exactly one of angular_velocity_rad and angular_velocity_deg")
        return self


class Spread(RateSpread):
    """Standard deviations of the members about the nominal state."""

    velocity: NonNegative = 0.0
    """Of each component, in the unit of semi_axes per time_unit."""


class Scenario(Common):
    """The keys of a scenario of this kind."""

    system: Literal["kirchhoff"]  # pyright: ignore[reportIncompatibleVariableOverride]
    semi_axes: PositiveTriple
    """Of the ellipsoid, in a unit of length."""
    center_of_mass: Triple = [0.0, 0.0, 0.0]
    """In body axes from the center of the ellipsoid, in the same unit."""
    scheme: Literal["group_midpoint"] = "group_midpoint"
    map: Literal["exponential", "cayley"] = "exponential"
    order: Literal[2, 4, 6, 8] = 2
    """Of accuracy; above 2 by composition."""
    state: InitialState
    spread: Spread = Spread()

    def assumption(self) -> str:
        return (
            f"spread about the nominal state, an assumption: {self.spread.rate():g} rad/{self.time_unit} of "
            f"angular velocity and {self.spread.velocity:g} of velocity (1 sigma, each component)"
        )


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step and the batch of initial states, the nominal one first."""
    a, b, c = scenario.semi_axes
    body = kirchhoff((a, b, c), scenario.center_of_mass)
    step: Step = schemes.group_midpoint(body, getattr(maps, scenario.map))
    if scenario.order > 2:
        step = schemes.compose(step, scenario.order)
    jolt = jax.random.normal(jax.random.key(scenario.seed), (scenario.members, 6)).at[0].set(0.0)
    unit = jnp.repeat(jnp.array([scenario.spread.rate(), scenario.spread.velocity]), 3)
    velocities = jnp.array([*(scenario.state.rate() or []), *scenario.state.velocity]) + unit * jolt
    return step, jax.vmap(lambda v: body.state(velocity=v))(velocities)


def report(scenario: Scenario, step: Any, run: Trajectory) -> str:
    """The body in the fluid; the changes of conserved quantities, worst of all members; its motion."""
    a, b, c = scenario.semi_axes
    m, axes = np.diag(np.asarray(kirchhoff((a, b, c)).metric)), np.array([a, b, c])
    solid = (np.sum(axes**2) - axes**2) / 5
    lines = [f"\n  {'in the axes of the ellipsoid':<34}" + "".join(f"{a:>10g}" for a in axes)]
    for name, values in {"added mass ÷ displaced": m[3:] - 1, "added inertia ÷ displaced": m[:3] / solid - 1}.items():
        lines.append(f"  {name:<34}" + "".join(f"{x:>10.3f}" for x in values))
    lines.append(f"\n  {'largest change, all members':<34}{'found':>10}   the scheme promises")
    lines += [f"  {name:<34}{x:>10.1e}   {promise}" for name, (x, promise) in changes(step.system, run).items()]
    lines.append(f"\n  {'':<34}{'nominal':>10}{'± ensemble':>12}")
    lines += [f"  {row.name:<34}{row.nominal:>10.4f}{row.spread:>12.4f}" for row in quantities(scenario, run)]
    need = spin_needed(step.system)
    if need is None:
        lines.append("  (the spin it needs is known in closed form for a body of revolution about the third axis)")
    else:
        Pi = np.asarray(step.system.body_momentum(nominal(run)))
        have = abs(Pi[2] / Pi[5]) if Pi[5] else np.inf
        verdict = "stable" if have > need else "not stable"
        lines.append(f"  |Π₃/P₃| = {have:.4f}, needed to go along the third axis: {need:.4f} [Lamb §128]: {verdict}")
    return "\n".join(lines)


def changes(body: Euler, run: Trajectory) -> dict[str, tuple[float, str]]:
    """Largest relative change of each conserved quantity, and the scheme's promise for it."""
    H, (Pi_P, P_P) = series(body.energy, run), np.moveaxis(series(body.casimirs, run), -1, 0)
    p = np.asarray(run.state.p)
    sizes = [np.linalg.norm(x[0], axis=-1) for x in (p[..., :3], p[..., 3:])]
    found = {
        "energy": (np.max(abs(H - H[0]) / H[0]), "round-off"),
        "spatial momentum π": (np.max(abs(p - p[0])) / abs(p[0]).max(), "bit for bit"),
        "Π·P": (np.max(abs(Pi_P - Pi_P[0]) / np.maximum(sizes[0] * sizes[1], np.finfo(float).tiny)), "round-off"),
        "|P|²": (np.max(abs(P_P - P_P[0]) / np.maximum(sizes[1] ** 2, np.finfo(float).tiny)), "round-off"),
    }
    return {name: (float(x), promise) for name, (x, promise) in found.items()}


def spin_needed(body: Euler) -> float | None:
    """The least |Π₃/P₃| with which a body of revolution moves stably along its axis, 0 if it needs no spin.

    It is 2√(I₁(1/m₃ − 1/m₁)). None if the body is not one of revolution about the third axis, with its mass central.
    """
    m = np.asarray(body.metric)
    I1, I2, _, m1, m2, m3 = np.diag(m)
    if max(abs(I1 - I2), abs(m1 - m2), abs(m - np.diag(np.diag(m))).max()) > 1e-12 * m.max():
        return None
    return float(2 * np.sqrt(max(I1 * (1 / m3 - 1 / m1), 0.0)))


class EnsembleQuantity(NamedTuple):
    """A quantity of the motion: its value for the nominal member, and its standard deviation over the members."""

    name: str
    nominal: float
    spread: float


def quantities(scenario: Scenario, run: Trajectory) -> list[EnsembleQuantity]:
    """The mean speed along the impulse P, and the largest angle of the third axis from its initial direction."""
    q, p, t = np.asarray(run.state.q), np.asarray(run.state.p), np.asarray(run.t)
    P = p[0, :, 3:]
    way = np.einsum("mi,mi->m", q[-1, :, :3, 3] - q[0, :, :3, 3], P)
    speed = way / np.maximum(np.linalg.norm(P, axis=1), np.finfo(float).tiny) / (t[-1] - t[0])
    tilt = tilts(q).max(axis=0)
    unit = scenario.time_unit
    return [
        EnsembleQuantity(name, float(x[0]), float(deviation(x)))
        for name, x in ((f"mean speed along the impulse (/{unit})", speed), ("third axis strays by (°)", tilt))
    ]


def tilts(q: Any) -> np.ndarray:
    """The angle in degrees of the third axis from its initial direction, for motions (times, …, 4, 4)."""
    axis = np.asarray(q)[..., :3, 2]
    across, along = np.cross(axis, axis[0]), np.sum(axis * axis[0], axis=-1)
    return np.rad2deg(np.arctan2(np.linalg.norm(across, axis=-1), along))


@plots.style()
def draw_path(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot the path of the center of the nominal and the last member, and the last one's third axis on the sphere."""
    fig, axes = plots.figure(2)
    for ax in axes[0]:
        ax.remove()
    left, right = (fig.add_subplot(1, 2, k, projection="3d") for k in (1, 2))
    last = member(run, -1)
    members = {"nominal": nominal(run)} | ({"the last member": last} if scenario.members > 1 else {})
    paths = {name: np.asarray(follow(step, z, scenario.dt, scenario.steps).state.q) for name, z in members.items()}
    for (name, q), color in zip(paths.items(), (plots.INK, plots.BLUE), strict=False):
        left.plot(*q[:, :3, 3].T, color=color, lw=0.8, label=name)
    left.legend()
    plots.cube(left).set(xlabel="x", ylabel="y", zlabel="z", title="the center of the ellipsoid")
    q = paths["the last member" if scenario.members > 1 else "nominal"]
    P = np.asarray(last.p[3:])
    pole = P / np.linalg.norm(P) if P.any() else None
    plots.sphere_path(right, q[:, :3, 2], pole, eye=q[0, :3, 2] + 0.5 * q[0, :3, 0], pole_label="impulse")
    right.set_title("its third axis")
    fig.suptitle(scenario.title)
    return fig


@plots.style()
def draw_energy(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot energy errors of the last member by this scheme and by Runge–Kutta, and the tilts of all members' axes."""
    body, curves, t = step.system, {}, np.zeros(0)
    start = member(run, -1)
    for scheme in (step, RungeKutta(body)):
        long = follow(scheme, start, scenario.dt, scenario.steps)
        curves[scheme.name] = np.asarray(diagnostics.energy_error(body, long)) / float(body.energy(start))
        t = np.asarray(long.t)
    fig, axes = plots.figure(2)
    plots.log_error(axes[0, 0], t, curves, "energy error, relative", scenario.time_unit)
    right = axes[0, 1]
    tilt = tilts(run.state.q)
    if scenario.members > 1:
        right.plot(run.t, tilt[:, 1], color=plots.BLUE, lw=0.4, alpha=0.6, label="the other members")
        right.plot(run.t, tilt[:, 2:], color=plots.BLUE, lw=0.4, alpha=0.4)
    right.plot(run.t, tilt[:, 0], color=plots.INK, lw=1.2, label="nominal member")
    right.set(xlabel=f"t ({scenario.time_unit})", ylabel="third axis strays by (°)")
    right.legend()
    fig.suptitle(scenario.title)
    return fig


PICTURES = {"path": draw_path, "energy": draw_energy}
