"""A satellite under the gravity-gradient torque on a given orbit: energy less work, and the pointing of its axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field

from lieint_jax import measure, orbits, plots, systems
from lieint_jax.app.scenarios import _body
from lieint_jax.app.scenarios._body import TopKind, inertia_matrix
from lieint_jax.app.scenarios._files import Ephemeris, EphemerisOrbit, OrbitFile, given_motion
from lieint_jax.app.scenarios._keys import PositiveFloat, Table, radians
from lieint_jax.app.scenarios._kind import for_last_run, picture
from lieint_jax.app.scenarios._pictures import draw_on_sphere
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runs import nominal_system, series
from lieint_jax.app.scenarios._spread import same_side_of
from lieint_jax.groups import so3
from lieint_jax.orbits import Kepler
from lieint_jax.runs import Run
from lieint_jax.systems import GravityGradient
from lieint_jax.types import State, energy_less_work

_ENERGY, _LESS_WORK = "energy, on which the orbit works", "energy less work"
_DISTINCT = 1e-9  # the least relative difference of two moments of inertia that distinguishes their axes


class Orbit(Table):
    """A Kepler orbit about the center of attraction: an ellipse, or a hyperbola with semi_major_axis < 0."""

    mu: PositiveFloat
    """The gravitational parameter GM, in length³ per time_unit²."""
    semi_major_axis: Annotated[float, same_side_of(0)]
    """A length, in the unit of mu; negative for a hyperbola."""
    eccentricity: Annotated[float, Field(ge=0), same_side_of(1)]
    """Below 1 for an ellipse, above 1 for a hyperbola."""
    inclination_deg: float = 0.0
    """In degrees, as the two angles below: R_z(node) R_x(inclination) R_z(periapsis) maps the orbit to space."""
    node_deg: float = 0.0
    """The longitude of the ascending node, in degrees."""
    periapsis_deg: float = 0.0
    """The argument of periapsis, in degrees."""
    periapsis_time: float = 0.0
    """The time of periapsis, in time_unit, on the clock of state.t."""

    def _check_orbit(self) -> None:
        self.motion()

    def motion(self) -> Kepler:
        inclination, node, periapsis = radians([self.inclination_deg, self.node_deg, self.periapsis_deg])
        angles = {"inclination": inclination, "node": node, "periapsis": periapsis}
        return orbits.kepler(
            self.mu, self.semi_major_axis, self.eccentricity, **angles, periapsis_time=self.periapsis_time
        )


class InitialState(_body.InitialState):
    """The nominal state; relative to space, or to the orbit's axes: radially outward, along the motion, normal."""

    t: float = 0.0
    """The time at the start, in time_unit."""
    relative_to: Literal["space", "orbit"] = "space"
    """What attitude and angular velocity (in body axes) are relative to; the orbit's axes rotate along the orbit."""


class Driven(TopKind):
    """The keys of a scenario of this kind. Give dt or steps_per_orbit."""

    dt: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Step size, in time_unit, of either sign."""
    steps_per_orbit: PositiveFloat | None = None
    """The period of the orbit, an ellipse, over the step size."""
    orbit: Orbit | None = None
    """Give orbit or ephemeris."""
    ephemeris: Ephemeris | None = None
    state: InitialState  # pyright: ignore[reportIncompatibleVariableOverride]

    files: ClassVar[Mapping[str, type[Table]]] = {**TopKind.files, "orbit": OrbitFile}
    fixed: ClassVar[dict[str, str]] = TopKind.fixed | {
        "ephemeris.*": "all members share the orbit",
        "steps_per_orbit": "all members have the same steps",
        "state.t": "all members share their time",
    }

    def _check_and_set_dt(self) -> None:
        if (self.dt is None) == (self.steps_per_orbit is None):
            raise ValueError("give exactly one of dt and steps_per_orbit")
        if self.steps_per_orbit is not None:
            if self.orbit is None or self.orbit.semi_major_axis < 0:
                kind = "an ephemeris" if self.orbit is None else "a hyperbola"
                raise ValueError(f"steps_per_orbit is a key of ellipses; {kind} has no period: give dt")
            period = 2 * np.pi / float(self.orbit.motion().mean_motion)
            self.dt = period / self.steps_per_orbit  # pyright: ignore[reportIncompatibleVariableOverride]
            self.steps_per_orbit = None  # files of results have dt

    def _check_motion(self) -> None:
        self.motion()

    def motion(self) -> Kepler | EphemerisOrbit:
        """The orbit, a function of time."""
        assert self.dt is not None
        return given_motion(self.orbit, self.ephemeris, self.state.t, self.state.t + self.dt * self.steps)

    def make_system(self) -> GravityGradient:
        return systems.gravity_gradient(self.inertia, self.motion())

    def start(self, system: GravityGradient, noise: Array) -> State:
        given = self.state
        q, Omega = given.attitude(), jnp.asarray(given.rate())
        if given.relative_to == "orbit":
            R, rate = measure.orbit_axes(system.orbit, jnp.asarray(given.t))
            q = so3.multiply(so3.from_matrix(R), q)
            Omega = Omega + so3.Ad_star(q, rate)
        return self.state_about(system, noise, q, Omega, t=given.t, work=0.0)

    def conserved(self, run: Run) -> list[Conserved]:
        """H, H − W, and on a circle Jacobi's integral, relative to the largest |H| of each member."""
        H, less_work = (series(f, run) for f in (GravityGradient.energy, energy_less_work))
        size = abs(H).max(axis=0)
        found = [Conserved(_ENERGY, H, size), Conserved(_LESS_WORK, less_work, size)]
        if self.orbit is not None and self.orbit.eccentricity == 0:
            spin = np.asarray(measure.orbit_axes(nominal_system(run).orbit, jnp.zeros(()))[1])
            found.append(Conserved("Jacobi's integral H − n·π", H - np.asarray(run.state.p) @ spin, size))
        return found

    @for_last_run
    def angles(self, run: Run) -> measure.OrbitAngles:
        """The angles between the principal axes and those of the orbit."""
        return measure.orbit_angles(run)

    def quantities(self, run: Run) -> list[Quantity]:
        """The angles (°, ≤ 90) of the axes of least and greatest inertia from the orbit's vertical and normal."""
        angles = self.angles(run)
        rows = {"least inertia's axis from the vertical": angles.vertical}
        rows |= {"greatest inertia's axis from the orbit's normal": angles.normal}
        found = []
        for name, x in rows.items():
            if np.isfinite(x).all():  # there is such an axis
                degrees = np.rad2deg(np.minimum(x, np.pi - x))
                found.append(Quantity(f"{name}, mean (°)", degrees.mean(axis=0), ".3f"))
                found.append(Quantity(f"{name}, largest (°)", degrees.max(axis=0), ".3f"))
        return found

    def remarks(self, run: Run) -> list[str]:
        """The unit of the changes, and the number of librating members."""
        lines = ["  changes are relative to the largest |energy| of each member"]
        vertical = self.angles(run).vertical
        if np.isfinite(vertical).all():
            count, horizon = measure.is_librating(vertical).sum(), "never crosses the horizon"
            lines.append(f"  {count} of {self.members} members librate: their axis of least inertia {horizon}")
        return lines

    @picture(2, spatial=(0,))
    def draw_pointing(self, axes: np.ndarray, run: Run) -> None:
        """Plot an axis of inertia in the orbit's axes, as a path on the sphere, and its angle from stability."""
        one = run.member(0)
        found = _principal(nominal_system(one)) or {"some": (np.eye(3)[0], "vertical", 0)}
        which, (axis, stable, k) = next(iter(found.items()))
        long = self.drawn(one)
        path, ends = series(_in_axes_of_orbit, long) @ axis, series(_in_axes_of_orbit, run)[-1] @ axis
        pole, aside, above = (np.roll(np.eye(3)[k], j) for j in range(3))
        t, unit = self._clock(long.t)
        look: dict[str, Any] = {"pole_label": stable, "angle_label": f"angle from the {stable} (°)", "unit": unit}
        look |= {"eye": pole + 0.6 * aside + 0.4 * above}
        draw_on_sphere(axes, t, path, self._clock(run.t)[0][-1], ends, pole, **look)
        axes[0].set_title(f"the axis of {which} inertia in the orbit's axes, nominal member")

    @picture(size=(6.4, 4.2))
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot the error of energy less work of the nominal member by both schemes, and the change of the energy."""
        one = run.member(0)
        both = {name: self.step_by(name, one.system) for name in ("top_energy_momentum", "splitting")}
        t, found = self.changes(one, both.values())
        curves = {f"H − W, {name}": errors[_LESS_WORK] for name, errors in zip(both, found.values(), strict=True)}
        curves["H"] = [*found.values()][-1][_ENERGY]
        plots.log_error(axes[0], self._clock(t)[0], curves, "change over the largest |energy|", self._clock(t)[1])
        axes[0].legend(loc="center right", bbox_to_anchor=(1.0, 0.4))  # between the two schemes
        axes[0].set_title("energy H, on which the orbit works, and energy less work")

    def _clock(self, t: Any) -> tuple[np.ndarray, str]:
        """Times and their unit, in periods of an ellipse."""
        if self.orbit is None or self.orbit.semi_major_axis < 0:
            return np.asarray(t), self.time_unit
        return np.asarray(t) * float(self.orbit.motion().mean_motion) / (2 * np.pi), "orbits"


def _in_axes_of_orbit(body: GravityGradient, state: State) -> Array:
    """The axes of the body, as columns, in those of the orbit."""
    return measure.orbit_axes(body.orbit, jnp.asarray(state.t))[0].T @ so3.to_matrix(state.q)


def _principal(body: GravityGradient) -> dict[str, tuple[np.ndarray, str, int]]:
    """The axes of least and greatest inertia, if distinct, and the axis of the orbit along which each is stable."""
    moments, axes = np.linalg.eigh(inertia_matrix(body))
    least, greatest = np.diff(moments) > _DISTINCT * moments[2]
    found = {"least": (axes[:, 0], "vertical", 0)} if least else {}
    return found | ({"greatest": (axes[:, 2], "orbit's normal", 2)} if greatest else {})
