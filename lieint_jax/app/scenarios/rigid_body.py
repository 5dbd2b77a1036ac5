"""A tumbling free rigid body: its mean periods and the direction of its momentum, compared with published values."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import model_validator

from lieint_jax import diagnostics, maps, schemes, systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._body import (
    BodyScenario,
    InitialState,
    axis_in_space,
    inertia_matrix,
    initial_state,
    is_long_axis_mode,
    longitude_latitude,
)
from lieint_jax.app.scenarios._common import TINY, Published, Text, check_order, compose_to_order, deviates
from lieint_jax.app.scenarios._pictures import picture
from lieint_jax.app.scenarios._report import Quantity
from lieint_jax.app.scenarios._runs import angles_deg, drawn_steps, drawn_trajectory, nominal_state
from lieint_jax.app.scenarios._spread import for_member
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import integrate
from lieint_jax.systems import RigidBody
from lieint_jax.types import State, Step, Trajectory

Z = (0.0, 0.0, 1.0)  # the body axis that is drawn

_SUBSCRIPTS = "₁₂₃"


class Observation(InitialState):
    """An observed attitude and angular velocity at time t, with its source."""

    label: Text
    t: float
    """In time_unit, a multiple of dt times save_every."""
    source: str
    """A key of the table sources, or the source itself if there is no such table."""


_ORDERS = {
    "so3_midpoint": range(2, 12, 2),
    "so3_explicit": range(2, 12, 2),
    "preprocessed": range(4, 12, 2),
    "gauss": range(2, 22, 2),
    "extrapolate": range(4, 22, 2),
}


class Scenario(BodyScenario):
    """The keys of a scenario of this kind."""

    system: Literal["rigid_body"]  # pyright: ignore[reportIncompatibleVariableOverride]
    scheme: Literal["so3_midpoint", "so3_explicit", "preprocessed", "calibrated", "exact", "gauss", "extrapolate"] = (
        "so3_midpoint"
    )
    kappa: Literal["symplectic", "cayley", "exponential"] | None = None
    """The κ of so3_midpoint; by default the symplectic one."""
    order: Literal[2, 4, 6, 8, 10, 12, 14, 16, 18, 20] | None = None
    """Even. Of so3_midpoint and so3_explicit 2 to 10, by default 2, above 2 by composition; of preprocessed 4 to 10, by
    default 4; of gauss 2 to 20, by default 16; of extrapolate 4 to 20, by default 12."""
    published: dict[
        Literal["precession_period", "rotation_period", "momentum_longitude_deg", "momentum_latitude_deg"], Published
    ] = {}
    observation: list[Observation] = []

    @model_validator(mode="after")
    def _check_scheme(self) -> Self:
        if self.kappa is not None and self.scheme != "so3_midpoint":
            raise ValueError(f"kappa is a key of so3_midpoint; {self.scheme} has none")
        check_order(self.scheme, self.order, _ORDERS.get(self.scheme, ()))
        return self

    @model_validator(mode="after")
    def _check_observations(self) -> Self:
        interval = self.dt * self.save_every
        for seen in self.observation:
            if seen.t * interval < 0:
                raise ValueError(
                    f"observation.t = {seen.t} lies on the other side of t = 0 than the run, since dt = {self.dt:.9g}: "
                    f"give dt {'>' if seen.t > 0 else '<'} 0"
                )
            if abs(seen.t / interval - round(seen.t / interval)) > 1e-6:
                raise ValueError(f"observation.t = {seen.t} must be a multiple of dt·save_every = {interval:.9g}")
        return self


def build(scenario: Scenario, indices: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states."""
    return _spread.build(scenario, deviates(scenario, indices), _step, initial_state)


def _step(scenario: Scenario) -> Step:
    body = systems.rigid_body(scenario.inertia)
    match scenario.scheme:
        case "exact":
            return schemes.exact(body)
        case "calibrated":
            return schemes.calibrated(body)
        case "preprocessed":
            return schemes.preprocessed(body, scenario.order or 4)
        case "gauss":
            return schemes.gauss(body, (scenario.order or 16) // 2)
        case "extrapolate":
            return schemes.extrapolate(body, scenario.order or 12)
        case "so3_explicit":
            step: Step = schemes.so3_explicit(body)
        case _:
            step = schemes.so3_midpoint(body, getattr(maps, f"kappa_{scenario.kappa or 'symplectic'}"))
    return compose_to_order(step, scenario.order)


def quantities(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Quantity]:
    """Mean periods of the tumbling and the direction of the angular momentum, with their published values."""
    p = np.asarray(run.state.p)[0]
    longitude, latitude = longitude_latitude(p / np.linalg.norm(p, axis=1, keepdims=True))
    precession, rotation = measured_periods(body, run)
    unit, published = scenario.time_unit, {**scenario.published}

    def quantity(name: str, values: np.ndarray, key: Any) -> Quantity:
        return Quantity(name, values, published=published.get(key), angle=key.endswith("_deg"))

    return [
        quantity(f"precession period ({unit})", precession, "precession_period"),
        quantity(f"rotation period ({unit})", rotation, "rotation_period"),
        quantity("angular momentum longitude (°)", longitude, "momentum_longitude_deg"),
        quantity("angular momentum latitude (°)", latitude, "momentum_latitude_deg"),
    ]


def remarks(scenario: Scenario, step: Step, run: Trajectory) -> list[str]:
    """The reason for a missing period, and predictions next to observations."""
    body = for_member(scenario, step.system)
    lines = [_prediction_lines(scenario, found) for found in predictions(scenario, body, run)]
    if any(np.isnan(x.nominal) for x in quantities(scenario, body, run)):
        missing = "  — no period: the body spins about an axis, or states are saved too rarely (lower save_every)"
        return [missing, *lines]
    return lines


def measured_periods(body: RigidBody, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Mean precession and rotation periods of a tumbling free body, one of each per member.

    The body tumbles about its axis of least inertia if |Π|² < 2H J₂, else about that of greatest inertia (Poinsot). The
    first period is that of the axis' precession about the angular momentum, the second that of Π about the axis in the
    body.

    Returns:
        Arrays (members,); nan where states are saved too rarely to unwrap the angles (more than 2.5 rad at |Π|/J₁).
    """
    moments, axes = np.linalg.eigh(inertia_matrix(body))  # ascending; columns are axes in the body
    axes[:, 2] *= np.linalg.det(axes)  # right-handed
    precession, rotation = [], []
    for m in range(run.state.p.shape[1]):
        R, pi = np.asarray(_matrices(run.state.q[:, m])), np.asarray(run.state.p[0, m])
        Pi = R.transpose(0, 2, 1) @ pi @ axes
        square = (Pi[0] ** 2).sum()
        long = is_long_axis_mode(moments, Pi[0])
        e = R @ axes[:, 0 if long else 2]
        Pi = Pi[:, [1, 2, 0]] if long else Pi
        across = np.stack(frame(jnp.asarray(pi / np.maximum(np.linalg.norm(pi), TINY))))
        rate = np.sqrt(square) / moments[0]
        too_coarse = rate * abs(run.t[1] - run.t[0]) > 2.5
        phi, psi = (np.unwrap(np.arctan2(y, x)) for x, y in (across @ e.T, Pi[:, :2].T))
        for periods, angle in ((precession, phi), (rotation, psi)):
            total = abs(angle[-1] - angle[0])
            periods.append(np.nan if too_coarse or total == 0 else 2 * np.pi * abs(run.t[-1] - run.t[0]) / total)
    return np.array(precession), np.array(rotation)


_matrices = jax.jit(jax.vmap(so3.to_matrix))


def save_index(scenario: Scenario, seen: Observation) -> int:
    """The index of the saved state at the time of an observation."""
    return round(seen.t / (scenario.dt * scenario.save_every))


class Prediction(NamedTuple):
    """The prediction of an observation; angles in degrees.

    Attributes:
        observation: the observation.
        euler_313_deg: the predicted attitude, (3,).
        angular_velocity_deg: the predicted angular velocity in the body, (3,).
        misfit_deg: the angle between the predicted and the observed attitude.
        spread_deg: the root mean square angle of the members about the nominal one.
        integrator_error_deg: the angle between the nominal attitude and that of `diagnostics.flow`, which is accurate
            to round-off.
    """

    observation: Observation
    euler_313_deg: np.ndarray
    angular_velocity_deg: np.ndarray
    misfit_deg: float
    spread_deg: float
    integrator_error_deg: float


def predictions(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Prediction]:
    """The predictions of the nominal member for the observations within the run."""
    found = []
    for seen in scenario.observation:
        k = save_index(scenario, seen)
        if not 0 <= k < len(run.t):
            continue
        now, start = nominal_state(run, k), nominal_state(run)
        Omega = jnp.linalg.norm(body.angular_velocity(start))
        true = diagnostics.flow(body, start, seen.t, 2 * int(abs(seen.t * Omega)) + 2)
        angles = jax.vmap(so3.angle, in_axes=(0, None))(jnp.asarray(run.state.q[k]), now.q)
        found.append(
            Prediction(
                seen,
                np.rad2deg(np.asarray(so3.to_euler_313(now.q))) % 360,
                np.rad2deg(np.asarray(body.angular_velocity(now))),
                float(jnp.rad2deg(so3.angle(now.q, seen.attitude()))),
                float(jnp.rad2deg(jnp.sqrt(jnp.mean(angles**2)))),
                float(jnp.rad2deg(so3.angle(now.q, true.q))),
            )
        )
    return found


def _prediction_lines(scenario: Scenario, found: Prediction) -> str:
    seen = found.observation

    def triple(values: np.ndarray | list[float]) -> str:
        return "(" + ", ".join(f"{x:8.2f}" for x in values) + ")"

    lines = [f"\n  {seen.label}: t = {seen.t:g} {scenario.time_unit}   [{scenario.source(seen.source)}]"]
    if seen.euler_313_deg:
        predicted, observed = triple(found.euler_313_deg), triple(seen.euler_313_deg)
        lines += [f"    Euler 3-1-3 (°)      predicted {predicted}   observed {observed}"]
    if seen.angular_velocity_deg:
        predicted, observed = triple(found.angular_velocity_deg), triple(seen.angular_velocity_deg)
        lines += [f"    body rate (°/{scenario.time_unit})      predicted {predicted}   observed {observed}"]
    lines += [
        f"    angle between attitudes predicted and observed: {found.misfit_deg:.2f}°; members about the nominal one: "
        f"{found.spread_deg:.2f}° rms; the integrator's own error: {found.integrator_error_deg:.2g}°",
        "    (torque-free: the angle includes errors of the initial state and the observation, and omitted torques)",
    ]
    return "\n".join(lines)


@picture(2, size=(4.7, 4.2), gridspec_kw={"width_ratios": [2, 1]})
def draw_path(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Map the direction of the body's z axis in space, of all members at the first observation, and the observed one.

    Next to the map of the sky is one of the members' surroundings.
    """
    step = for_member(scenario, step)
    place, close = axes
    wide = place.figure.add_subplot(place.get_subplotspec(), projection="mollweide")
    place.remove()
    seen = [s for s in scenario.observation if 0 <= save_index(scenario, s) < len(run.t)][:1]
    last = save_index(scenario, seen[0]) if seen else len(run.t) - 1
    long = drawn_trajectory(step, nominal_state(run), scenario.dt, last * scenario.save_every)
    path, members = axis_in_space(long.state.q, Z), axis_in_space(run.state.q[last], Z)
    pole = np.asarray(run.state.p[0, :1]) / np.linalg.norm(run.state.p[0, 0])
    center = float(30 * np.round(np.rad2deg(np.arctan2(pole[0, 1], pole[0, 0])) / 30))
    ax, span = plots.sky(wide, center), f"to t = {long.t[-1]:.4g} {scenario.time_unit}"
    plots.sky_path(ax, path, f"body axis z, nominal member, {span}", center, color=plots.BLUE, lw=0.8)
    label = f"{scenario.members} members then" if scenario.members > 1 else "axis z then"
    plots.sky_points(ax, members, label, center, color=plots.INK, s=2, alpha=0.4, lw=0, zorder=3)
    plots.sky_points(ax, pole, "angular momentum", center, color=plots.GREEN, marker="P", s=45, zorder=3)
    observed = axis_in_space(seen[0].attitude()[None], Z) if seen else np.zeros((0, 3))
    if seen:
        plots.sky_points(ax, observed, "observed then", center, color=plots.RED, marker="x", s=60, lw=1.6, zorder=4)
        plots.caption(ax.figure, _observation_in_words(scenario, seen[0], path[-1], members))
    legend = ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, borderpad=0.9)
    legend.legend_handles[1].set_sizes([12])  # the members' dots would be too small in the legend
    ax.set(xlabel="longitude in the axes of space", ylabel="latitude")
    ax.set_title(f"(a) the whole sky, {span}", loc="left")
    _draw_surroundings(close, path, members, observed)
    close.set_title("(b) the same about the nominal member", loc="left")


def _draw_surroundings(ax: Any, path: np.ndarray, members: np.ndarray, observed: np.ndarray) -> None:
    """The members' axes and the observed one in degrees east and north of the end of the path."""
    end = path[-1]
    east = np.cross((0.0, 0.0, 1.0), end)
    east = east / np.linalg.norm(east) if east.any() else np.eye(3)[0]
    across = np.stack([east, np.cross(end, east)], axis=1)

    def from_end(x: np.ndarray) -> np.ndarray:
        offset, angle = x @ across, np.arccos(np.clip(x @ end, -1, 1))
        return np.rad2deg((offset * (angle / np.maximum(np.linalg.norm(offset, axis=1), TINY))[:, None]).T)

    shown = np.concatenate([from_end(members), from_end(observed)], axis=1)
    half = 1.15 * max(abs(shown).max(), 1.0)
    near = path @ end > np.cos(np.deg2rad(min(3 * half, 90)))
    ax.plot(*np.where(near, from_end(path), np.nan), color=plots.BLUE, lw=0.8)
    ax.plot(*from_end(members), ".", color=plots.INK, ms=2.5, mew=0, alpha=0.5, zorder=3)
    ax.plot(0, 0, "o", color=plots.BLUE, ms=6, mfc="white", mew=1.5, zorder=4, label="nominal member")
    ax.legend(loc="lower left")
    ax.plot(*from_end(observed), "x", color=plots.RED, ms=7, mew=1.6, zorder=4)
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xlabel="east (°)", ylabel="north (°)")


def _observation_in_words(scenario: Scenario, seen: Observation, nominal_axis: np.ndarray, members: np.ndarray) -> str:
    """The caption of `draw_path`: the source of the cross, and its distance from the predicted axes."""
    [observed] = axis_in_space(seen.attitude()[None], Z)
    spread = np.sqrt(np.mean(angles_deg(members, nominal_axis) ** 2))
    return (
        f"Cross: axis z of the attitude observed by {seen.label} ({scenario.source(seen.source)}), "
        f"{angles_deg(observed, nominal_axis):.1f}° from the nominal prediction; members scatter by {spread:.1f}° rms"
    )


@picture(3)
def draw_invariants(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot the energy and Poisson errors of the nominal member against time."""
    step = for_member(scenario, step)
    n, every = drawn_steps(scenario.steps)

    @jax.jit
    def errors(z: State) -> tuple[Array, Array, Array]:
        series = integrate(step, z, scenario.dt, n, save_every=every)
        energy = diagnostics.energy_error(step.system, series) / step.system.energy(z)
        sigma = jax.vmap(so3.vee)(diagnostics.poisson_error(step, z, scenario.dt, n)[::every])
        return series.t, energy, jnp.linalg.norm(sigma, axis=1)

    t, energy, sigma = (np.asarray(x) for x in errors(nominal_state(run)))
    plots.log_error(axes[0], t, {"nominal member": energy}, "relative energy error", scenario.time_unit)
    plots.log_error(axes[1], t, {"nominal member": sigma}, "Poisson error |σ|", scenario.time_unit)
    _draw_polhode(axes[2], step.system, run)


def _draw_polhode(ax: Any, body: RigidBody, run: Trajectory) -> None:
    """The body momentum of the nominal member, seen along the principal axis that it circles."""
    moments, axes = np.linalg.eigh(inertia_matrix(body))
    Pi = np.asarray(jax.jit(jax.vmap(body.body_momentum))(jax.tree.map(lambda x: jnp.asarray(x[:, 0]), run.state)))
    Pi = Pi @ axes / np.linalg.norm(Pi[0])
    about = 0 if is_long_axis_mode(moments, Pi[0]) else 2
    x, y = (k for k in range(3) if k != about)
    angle = np.linspace(0, 2 * np.pi, 145)
    ax.plot(np.cos(angle), np.sin(angle), color=plots.GRAY, lw=0.8)
    ax.plot(Pi[:, x], Pi[:, y], ".", ms=2, color=plots.BLUE)
    ax.set(
        aspect="equal",
        xlabel=f"Π{_SUBSCRIPTS[x]} / |Π|",
        ylabel=f"Π{_SUBSCRIPTS[y]} / |Π|",
        title=f"polhode, seen along principal axis {about + 1}",
    )


PICTURES = {"path": draw_path, "invariants": draw_invariants}
