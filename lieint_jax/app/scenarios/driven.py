"""A satellite under the torque of gravity's gradient on a given orbit: energy less work, and where its axes point."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure
from pydantic import Field, model_validator

from lieint_jax import diagnostics, orbits, systems
from lieint_jax._numerics import vec3
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _body
from lieint_jax.app.scenarios._body import TopScenario, about, in_space, inertia_matrix, top_schemes
from lieint_jax.app.scenarios._common import Above, Table, deviation, follow, nominal, series
from lieint_jax.groups import so3
from lieint_jax.orbits import Kepler
from lieint_jax.systems import GravityGradient
from lieint_jax.types import State, Step, Trajectory, energy_less_work

_DISTINCT = 1e-9  # the least relative difference of two moments of inertia that distinguishes their axes


class Orbit(Table):
    """A Kepler orbit about the center of attraction: an ellipse, or a hyperbola with semi_major_axis < 0."""

    mu: Above
    """The gravitational parameter GM, in length³ per time_unit²."""
    semi_major_axis: float
    """A length, in the unit of mu; negative for a hyperbola."""
    eccentricity: Annotated[float, Field(ge=0)]
    """Below 1 for an ellipse, above 1 for a hyperbola."""
    inclination_deg: float = 0.0
    """In degrees, as the two angles below: R_z(node) R_x(inclination) R_z(periapsis) takes the orbit to space."""
    node_deg: float = 0.0
    """The longitude of the ascending node, in degrees."""
    periapsis_deg: float = 0.0
    """The argument of periapsis, in degrees."""
    periapsis_time: float = 0.0
    """When the body is nearest, in time_unit, on the clock of state.t."""

    @model_validator(mode="after")
    def _an_orbit(self) -> Self:
        self.motion()
        return self

    def motion(self) -> Kepler:
        inclination, node, periapsis = np.deg2rad([self.inclination_deg, self.node_deg, self.periapsis_deg])
        return orbits.kepler(
            self.mu,
            self.semi_major_axis,
            self.eccentricity,
            inclination,
            node=node,
            periapsis=periapsis,
            periapsis_time=self.periapsis_time,
        )


class InitialState(_body.InitialState):
    """The nominal state; relative to space, or to the orbit's axes: radially outward, along the motion, normal."""

    t: float = 0.0
    """The time at the start, in time_unit."""
    relative_to: Literal["space", "orbit"] = "space"
    """What attitude and angular velocity (in body axes) are relative to; the orbit's axes turn as the body goes."""


class Scenario(TopScenario):
    """The keys of a scenario of this kind. Give dt, or steps_per_orbit in its place."""

    system: Literal["driven"]  # pyright: ignore[reportIncompatibleVariableOverride]
    dt: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Step size, in time_unit, of either sign."""
    steps_per_orbit: Above | None = None
    """The period of the orbit, an ellipse, over the step size."""
    orbit: Orbit
    state: InitialState  # pyright: ignore[reportIncompatibleVariableOverride]

    @model_validator(mode="after")
    def _one_step_size(self) -> Self:
        if (self.dt is None) == (self.steps_per_orbit is None):
            raise ValueError("give exactly one of dt and steps_per_orbit")
        if self.steps_per_orbit is not None:
            if self.orbit.semi_major_axis < 0:
                raise ValueError("steps_per_orbit is a key of ellipses; a hyperbola has no period: give dt")
            period = 2 * np.pi / float(self.orbit.motion().mean_motion)
            self.dt = period / self.steps_per_orbit  # pyright: ignore[reportIncompatibleVariableOverride]
            self.steps_per_orbit = None  # results hold dt
        return self


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step and the batch of initial states, which share their time."""
    body, given = systems.gravity_gradient(scenario.inertia, scenario.orbit.motion()), scenario.state
    q, Omega = given.attitude(), jnp.asarray(given.rate())
    if given.relative_to == "orbit":
        R, rate = orbit_axes(body.orbit, jnp.asarray(given.t))
        q = so3.multiply(so3.from_matrix(R), q)
        Omega = Omega + so3.Ad_star(q, rate)
    states = about(scenario, body, q, Omega, t=given.t, work=0.0)
    return top_schemes(scenario, body)[scenario.scheme], states._replace(t=jnp.asarray(given.t, states.p.dtype))


def orbit_axes(orbit: Any, t: Array) -> tuple[Array, Array]:
    """The matrix whose columns point radially outward, along the motion and along the normal, and its spin in space."""
    position, velocity = orbit(t)
    normal = jnp.stack(vec3.cross(position, velocity))
    r, z = (x / jnp.sqrt(vec3.dot(x, x)) for x in (position, normal))
    return jnp.stack([r, jnp.stack(vec3.cross(z, r)), z], axis=1), normal / vec3.dot(position, position)


def report(scenario: Scenario, step: Any, run: Trajectory) -> str:
    """The changes of energy and of energy less work, worst of all members; where the axes of inertia point."""
    body = step.system
    lines = ["\n  largest change, all members and saved times, over the largest |energy|"]
    lines += [f"  {name:<62}{change:>10.1e}" for name, change in changes(scenario, body, run).items()]
    lines += [f"\n  {'':<62}{'nominal':>10}{'± ensemble':>12}"]
    lines += [f"  {name:<62}{nominal:>10.3f}{spread:>12.3f}" for name, nominal, spread in quantities(body, run)]
    captured = librating(body, run)
    if captured is not None:
        lines.append(
            f"  {int(captured.sum())} of {len(captured)} members librate: their axis of least inertia stays on its "
            "side of the horizon"
        )
    return "\n".join(lines)


def changes(scenario: Scenario, body: GravityGradient, run: Trajectory) -> dict[str, float]:
    """Largest changes over the largest |H| of each member: of H, H − W, and on a circle of Jacobi's integral."""
    H, kept = (series(f, run) for f in (body.energy, lambda z: energy_less_work(body, z)))
    found = {"energy, on which the orbit works": H, "energy less work": kept}
    if scenario.orbit.eccentricity == 0:
        spin = orbit_axes(body.orbit, jnp.zeros(()))[1]
        found["Jacobi's integral H − n·π"] = H - np.asarray(run.state.p) @ np.asarray(spin)
    size = abs(H).max(axis=0)
    return {name: float((abs(x - x[0]) / size).max()) for name, x in found.items()}


class Pointing(NamedTuple):
    """An angle, mean or largest over the run: of the nominal member, and its standard deviation over the members."""

    name: str
    nominal: float
    spread: float


def quantities(body: GravityGradient, run: Trajectory) -> list[Pointing]:
    """The angles (°, ≤ 90) of the axes of least and greatest inertia from the vertical and the normal of the orbit."""
    found = []
    for which, (axis, cosine) in _cosines(body, run).items():
        angles = np.rad2deg(np.arccos(np.clip(abs(cosine), 0, 1)))
        for name, x in (("mean", angles.mean(axis=0)), ("largest", angles.max(axis=0))):
            found.append(Pointing(f"{which} inertia's axis from the {axis}, {name} (°)", x[0], float(deviation(x))))
    return found


def librating(body: GravityGradient, run: Trajectory) -> np.ndarray | None:
    """Whether each member's axis of least inertia stays on its side of the horizon; None if there is no such axis."""
    cosines = _cosines(body, run)
    if "least" not in cosines:
        return None
    _, cosine = cosines["least"]
    return (cosine * np.sign(cosine[0]) > 0).all(axis=0)


def _cosines(body: GravityGradient, run: Trajectory) -> dict[str, tuple[str, np.ndarray]]:
    """By axis of the body: the name of one of the orbit, and the cosine of the angle between them, (times, members)."""
    R = np.asarray(jax.jit(jax.vmap(lambda t: orbit_axes(body.orbit, t)[0]))(jnp.asarray(run.t)))
    return {
        which: (name, np.einsum("tmi,ti->tm", series(lambda z, e=e: so3.Ad(z.q, e), run), R[:, :, k]))
        for which, (e, name, k) in _principal(body).items()
    }


def _principal(body: GravityGradient) -> dict[str, tuple[np.ndarray, str, int]]:
    """The axes of least and greatest inertia, if single, and that of the orbit along which each one is stable."""
    moments, axes = np.linalg.eigh(inertia_matrix(body))
    least, greatest = np.diff(moments) > _DISTINCT * moments[2]
    found = {"least": (axes[:, 0], "vertical", 0)} if least else {}
    return found | ({"greatest": (axes[:, 2], "orbit's normal", 2)} if greatest else {})


@plots.style()
def draw_pointing(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot an axis of inertia in the orbit's axes, as a path on the sphere, and its angle from where it is stable."""
    body = step.system
    (axis, stable, k), *_ = [*_principal(body).values(), (np.eye(3)[0], "vertical", 0)]
    long = follow(step, nominal(run), _dt(scenario), scenario.steps)
    R = np.asarray(jax.vmap(lambda t: orbit_axes(body.orbit, t)[0])(jnp.asarray(long.t)))
    path = np.einsum("tij,ti->tj", R, in_space(long.state.q, axis))
    end = orbit_axes(body.orbit, jnp.asarray(run.t[-1]))[0]
    fig, axes = plots.figure(2)
    axes[0, 0].remove()
    left, right = fig.add_subplot(1, 2, 1, projection="3d"), axes[0, 1]
    pole, aside, above = (np.roll(np.eye(3)[k], j) for j in range(3))
    plots.sphere_path(left, path, pole, eye=pole + 0.6 * aside + 0.4 * above, pole_label=stable)
    if scenario.members > 1:
        ends = in_space(run.state.q[-1], axis) @ np.asarray(end)
        plots.sphere_points(left, ends, f"members at t = {run.t[-1]:.4g}", color=plots.INK, s=2, alpha=0.5)
    left.legend(loc="lower left")
    left.set_title("a body axis in the orbit's axes")
    angle = np.rad2deg(np.arccos(np.clip(path @ pole, -1, 1)))
    t, unit = _clock(scenario, long)
    plots.series(right, t, {"": angle}, f"angle from the {stable} (°)", unit)
    fig.suptitle(scenario.title)
    return fig


@plots.style()
def draw_energy(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot the error of energy less work of the nominal member by both schemes, and how much the energy changes."""
    body, curves, t, unit = step.system, {}, np.zeros(0), ""
    for name, scheme in top_schemes(scenario, body).items():
        long = follow(scheme, nominal(run), _dt(scenario), scenario.steps)
        H = np.asarray(jax.vmap(body.energy)(long.state))
        curves[f"H − W, {name}"] = np.asarray(diagnostics.energy_error(body, long)) / abs(H).max()
        curves["H"] = (H - H[0]) / abs(H).max()
        t, unit = _clock(scenario, long)
    fig, axes = plots.figure(size=(6.4, 4.2))
    plots.log_error(axes[0, 0], t, curves, "change over the largest |energy|", unit)
    axes[0, 0].set_title("energy H, on which the orbit works, and energy less work")
    return fig


def _dt(scenario: Scenario) -> float:
    """The step size, which a scenario has once it is read."""
    assert scenario.dt is not None
    return scenario.dt


def _clock(scenario: Scenario, run: Trajectory) -> tuple[np.ndarray, str]:
    """The times of a run and their unit, in periods of an ellipse."""
    t, orbit = np.asarray(run.t), scenario.orbit
    if orbit.semi_major_axis < 0:
        return t, scenario.time_unit
    return t * float(orbit.motion().mean_motion) / (2 * np.pi), "orbits"


PICTURES = {"pointing": draw_pointing, "energy": draw_energy}
