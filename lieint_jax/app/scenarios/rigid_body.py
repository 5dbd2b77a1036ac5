"""A tumbling free rigid body: its mean periods and the direction of its momentum, compared with published values."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import model_validator

from lieint_jax import diagnostics, maps, schemes, systems
from lieint_jax._integrate import integrate
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._body import (
    BodyScenario,
    InitialState,
    about_least,
    in_space,
    inertia_matrix,
    longitude_latitude,
    start,
)
from lieint_jax.app.scenarios._common import Published, Text, at_order, check_order, deviates
from lieint_jax.app.scenarios._pictures import picture
from lieint_jax.app.scenarios._report import Quantity
from lieint_jax.app.scenarios._runs import follow, nominal, thinned
from lieint_jax.app.scenarios._spread import of_member
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.systems import RigidBody
from lieint_jax.types import State, Step, Trajectory

Z = (0.0, 0.0, 1.0)  # the body axis that is drawn

_SUBSCRIPTS = "₁₂₃"
_TINY = float(np.finfo(float).tiny)


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
    def _keys_of_the_scheme(self) -> Self:
        if self.kappa is not None and self.scheme != "so3_midpoint":
            raise ValueError(f"kappa is a key of so3_midpoint; {self.scheme} has none")
        check_order(self.scheme, self.order, _ORDERS.get(self.scheme, ()))
        return self

    @model_validator(mode="after")
    def _observations_are_saved(self) -> Self:
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


def build(scenario: Scenario, numbers: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states."""
    return _spread.build(scenario, deviates(scenario, numbers), _step, start)


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
    return at_order(step, scenario.order)


def quantities(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Quantity]:
    """Mean periods of the tumbling and the direction of the angular momentum, with their published values."""
    p = np.asarray(run.state.p)[0]
    longitude, latitude = longitude_latitude(p / np.linalg.norm(p, axis=1, keepdims=True))
    precession, rotation = mean_periods(body, run)
    unit, published = scenario.time_unit, {**scenario.published}

    def declared(name: str, values: np.ndarray, key: Any) -> Quantity:
        return Quantity(name, values, published=published.get(key), angle=key.endswith("_deg"))

    return [
        declared(f"precession period ({unit})", precession, "precession_period"),
        declared(f"rotation period ({unit})", rotation, "rotation_period"),
        declared("angular momentum longitude (°)", longitude, "momentum_longitude_deg"),
        declared("angular momentum latitude (°)", latitude, "momentum_latitude_deg"),
    ]


def remarks(scenario: Scenario, step: Any, run: Trajectory) -> list[str]:
    """Why a period is missing, and predictions next to observations."""
    body = of_member(scenario, step.system)
    lines = [_sighting(scenario, seen) for seen in sightings(scenario, body, run)]
    if any(np.isnan(x.nominal) for x in quantities(scenario, body, run)):
        missing = "  — no period: the body spins about an axis, or states are saved too far apart (lower save_every)"
        return [missing, *lines]
    return lines


def mean_periods(body: RigidBody, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Mean precession and rotation periods of a tumbling free body, one of each per member.

    The body tumbles about its axis of least inertia if |Π|² < 2H J₂, else about that of greatest inertia (Poinsot). The
    first period is that of the axis' precession about the angular momentum, the second that of Π about the axis in the
    body.

    Returns:
        Arrays (members,); nan where states are saved too far apart to follow the angles (more than 2.5 rad at |Π|/J₁).
    """
    moments, axes = np.linalg.eigh(inertia_matrix(body))  # ascending; columns are axes in the body
    axes[:, 2] *= np.linalg.det(axes)  # right-handed
    precession, rotation = [], []
    for m in range(run.state.p.shape[1]):
        R, pi = np.asarray(_matrices(run.state.q[:, m])), np.asarray(run.state.p[0, m])
        Pi = R.transpose(0, 2, 1) @ pi @ axes
        square = (Pi[0] ** 2).sum()
        long = about_least(moments, Pi[0])
        e = R @ axes[:, 0 if long else 2]
        Pi = Pi[:, [1, 2, 0]] if long else Pi
        across = np.stack(frame(jnp.asarray(pi / np.maximum(np.linalg.norm(pi), np.finfo(float).tiny))))
        rate = np.sqrt(square) / moments[0]
        too_coarse = rate * abs(run.t[1] - run.t[0]) > 2.5
        phi, psi = (np.unwrap(np.arctan2(y, x)) for x, y in (across @ e.T, Pi[:, :2].T))
        for periods, angle in ((precession, phi), (rotation, psi)):
            turn = abs(angle[-1] - angle[0])
            periods.append(np.nan if too_coarse or turn == 0 else 2 * np.pi * abs(run.t[-1] - run.t[0]) / turn)
    return np.array(precession), np.array(rotation)


_matrices = jax.jit(jax.vmap(so3.to_matrix))


def save_index(scenario: Scenario, seen: Observation) -> int:
    """The index of the saved state at the time of an observation."""
    return round(seen.t / (scenario.dt * scenario.save_every))


class Sighting(NamedTuple):
    """An observation and its prediction; angles in degrees."""

    observation: Observation
    euler_313_deg: np.ndarray
    angular_velocity_deg: np.ndarray
    apart_deg: float
    spread_deg: float
    integrator_error_deg: float


def sightings(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Sighting]:
    """The prediction of the nominal member for each observation within the run.

    `spread_deg` is the root mean square angle of the members about the nominal one; `integrator_error_deg` the angle
    between the nominal one and a solution of the equations of motion by `diagnostics.flow`, accurate to round-off.
    """
    found = []
    for seen in scenario.observation:
        k = save_index(scenario, seen)
        if not 0 <= k < len(run.t):
            continue
        now, start = nominal(run, k), nominal(run)
        Omega = jnp.linalg.norm(body.angular_velocity(start))
        true = diagnostics.flow(body, start, seen.t, 2 * int(abs(seen.t * Omega)) + 2)
        apart = jax.vmap(so3.angle, in_axes=(0, None))(jnp.asarray(run.state.q[k]), now.q)
        found.append(
            Sighting(
                seen,
                np.rad2deg(np.asarray(so3.to_euler_313(now.q))) % 360,
                np.rad2deg(np.asarray(body.angular_velocity(now))),
                float(jnp.rad2deg(so3.angle(now.q, seen.attitude()))),
                float(jnp.rad2deg(jnp.sqrt(jnp.mean(apart**2)))),
                float(jnp.rad2deg(so3.angle(now.q, true.q))),
            )
        )
    return found


def _sighting(scenario: Scenario, sighting: Sighting) -> str:
    seen = sighting.observation

    def triple(values: np.ndarray | list[float]) -> str:
        return "(" + ", ".join(f"{x:8.2f}" for x in values) + ")"

    lines = [f"\n  {seen.label}: t = {seen.t:g} {scenario.time_unit}   [{scenario.source(seen.source)}]"]
    if seen.euler_313_deg:
        predicted, observed = triple(sighting.euler_313_deg), triple(seen.euler_313_deg)
        lines += [f"    Euler 3-1-3 (°)      predicted {predicted}   observed {observed}"]
    if seen.angular_velocity_deg:
        predicted, observed = triple(sighting.angular_velocity_deg), triple(seen.angular_velocity_deg)
        lines += [f"    body rate (°/{scenario.time_unit})      predicted {predicted}   observed {observed}"]
    lines += [
        f"    attitude predicted and observed: {sighting.apart_deg:.2f}° apart; members about the nominal one: "
        f"{sighting.spread_deg:.2f}° rms; the integrator's own error: {sighting.integrator_error_deg:.2g}°",
        "    (torque-free: what remains is the error of the initial state, of the observation, and torques left out)",
    ]
    return "\n".join(lines)


@picture(2, size=(4.7, 4.2), gridspec_kw={"width_ratios": [2, 1]})
def draw_path(axes: Any, scenario: Scenario, step: Any, run: Trajectory) -> None:
    """Map where the body's z axis points in space, with all members at the first observation, and what was observed.

    Next to the map of the sky is one of the members' surroundings.
    """
    step = of_member(scenario, step)
    place, close = axes
    wide = place.figure.add_subplot(place.get_subplotspec(), projection="mollweide")
    place.remove()
    seen = [s for s in scenario.observation if 0 <= save_index(scenario, s) < len(run.t)][:1]
    last = save_index(scenario, seen[0]) if seen else len(run.t) - 1
    long = follow(step, nominal(run), scenario.dt, last * scenario.save_every)
    path, members = in_space(long.state.q, Z), in_space(run.state.q[last], Z)
    pole = np.asarray(run.state.p[0, :1]) / np.linalg.norm(run.state.p[0, 0])
    center = float(30 * np.round(np.rad2deg(np.arctan2(pole[0, 1], pole[0, 0])) / 30))
    ax, span = plots.sky(wide, center), f"to t = {long.t[-1]:.4g} {scenario.time_unit}"
    plots.sky_path(ax, path, f"body axis z, nominal member, {span}", center, color=plots.BLUE, lw=0.8)
    label = f"{scenario.members} members then" if scenario.members > 1 else "axis z then"
    plots.sky_points(ax, members, label, center, color=plots.INK, s=2, alpha=0.4, lw=0, zorder=3)
    plots.sky_points(ax, pole, "angular momentum", center, color=plots.GREEN, marker="P", s=45, zorder=3)
    observed = in_space(seen[0].attitude()[None], Z) if seen else np.zeros((0, 3))
    if seen:
        plots.sky_points(ax, observed, "observed then", center, color=plots.RED, marker="x", s=60, lw=1.6, zorder=4)
        plots.caption(ax.figure, _observation_in_words(scenario, seen[0], path[-1], members))
    legend = ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    legend.legend_handles[1].set_sizes([12])  # the members' dots are too small to be found in it
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
        return np.rad2deg((offset * (angle / np.maximum(np.linalg.norm(offset, axis=1), _TINY))[:, None]).T)

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
    """What the cross of `draw_path` is, and how far from the predicted axes it lies."""
    [observed] = in_space(seen.attitude()[None], Z)

    def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), a @ b))

    spread = np.sqrt(np.mean(degrees(members, nominal_axis) ** 2))
    return (
        f"Cross: axis z of the attitude observed by {seen.label} ({scenario.source(seen.source)}), "
        f"{degrees(observed, nominal_axis):.1f}° from the nominal prediction; members scatter by {spread:.1f}° rms"
    )


@picture(3)
def draw_invariants(axes: Any, scenario: Scenario, step: Any, run: Trajectory) -> None:
    """Plot the energy and Poisson errors of the nominal member against time."""
    step = of_member(scenario, step)
    n, every = thinned(scenario.steps)

    @jax.jit
    def errors(z: State) -> tuple[Array, Array, Array]:
        series = integrate(step, z, scenario.dt, n, save_every=every)
        energy = diagnostics.energy_error(step.system, series) / step.system.energy(z)
        sigma = jax.vmap(so3.vee)(diagnostics.poisson_error(step, z, scenario.dt, n)[::every])
        return series.t, energy, jnp.linalg.norm(sigma, axis=1)

    t, energy, sigma = (np.asarray(x) for x in errors(nominal(run)))
    plots.log_error(axes[0], t, {"nominal member": energy}, "relative energy error", scenario.time_unit)
    plots.log_error(axes[1], t, {"nominal member": sigma}, "Poisson error |σ|", scenario.time_unit)
    _draw_polhode(axes[2], step.system, run)


def _draw_polhode(ax: Any, body: RigidBody, run: Trajectory) -> None:
    """The body momentum of the nominal member, looked at along the principal axis that it goes about."""
    moments, axes = np.linalg.eigh(inertia_matrix(body))
    Pi = np.asarray(jax.jit(jax.vmap(body.body_momentum))(jax.tree.map(lambda x: jnp.asarray(x[:, 0]), run.state)))
    Pi = Pi @ axes / np.linalg.norm(Pi[0])
    about = 0 if about_least(moments, Pi[0]) else 2
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
