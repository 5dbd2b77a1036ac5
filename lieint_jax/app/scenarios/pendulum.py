"""A spherical pendulum: its conserved quantities, swing and precession compared with the closed form, and its path."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np

from lieint_jax import measure, schemes, systems
from lieint_jax.app.scenarios._keys import NonNegative, NumberSpread, Order, PositiveFloat, Table, Triple, UnitVector
from lieint_jax.app.scenarios._kind import Kind, picture
from lieint_jax.app.scenarios._pictures import draw_errors, draw_on_sphere
from lieint_jax.app.scenarios._report import CLOSED_FORM, ROUND_OFF, Conserved, Quantity
from lieint_jax.app.scenarios._runs import nominal_state, nominal_system, series
from lieint_jax.app.scenarios._spread import DIRECTION, same_side_of
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.systems import LagrangeMotion, Pendulum, lagrange_motion, pendulum_as_top
from lieint_jax.types import State

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


class SphericalPendulum(Kind):
    """The keys of a scenario of this kind."""

    mass: PositiveFloat
    """In a unit of mass."""
    gravity: Annotated[float, same_side_of(0)]
    """The acceleration of gravity over the pendulum's length, per time_unit squared."""
    axis: Annotated[UnitVector, DIRECTION] = [0.0, 0.0, -1.0]
    """The direction of gravity in space, a unit vector: downwards."""
    scheme: Literal["sphere_midpoint"] = "sphere_midpoint"
    normalized: bool = False
    """Whether the midpoint is projected to the sphere, which makes the scheme symplectic."""
    order: Order = 2
    state: InitialState
    spread: Spread = Spread()

    def _check_gravity(self) -> None:
        if self.gravity == 0:
            raise ValueError("gravity must not be 0")

    def make_system(self) -> Pendulum:
        return systems.pendulum(self.mass, self.gravity, self.axis)

    def options(self) -> tuple[Any, ...]:
        return (self.normalized,)

    def start(self, system: Pendulum, noise: Any) -> State:
        q = so3.Ad(so3.exp(jnp.deg2rad(self.spread.direction_deg) * noise[0]), jnp.asarray(self.state.direction))
        V = jnp.asarray(self.state.velocity) + self.spread.velocity * noise[1]
        return system.state(q, velocity=V - q * (q @ V) / (q @ q))

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy relative to ½|π|²/m + |mG|, γ·π relative to √(2m(H + |mG|)); |q|² − 1 and q·π, which are 0."""
        bob = nominal_system(run)
        H, gamma_pi, defect = (series(f, run) for f in (Pendulum.energy, Pendulum.momentum, _defect))
        depth = abs(float(bob.potential(bob.axis)))
        kinetic = H[0] + depth  # its largest value, at the lowest point
        return [
            Conserved("energy, relative", H, kinetic + depth, ROUND_OFF),
            Conserved("γ·π, relative", gamma_pi[..., 0], np.sqrt(2 * float(bob.mass) * kinetic), ROUND_OFF),
            Conserved("constraints |q| = 1, q·π = 0", defect, promise=ROUND_OFF, initial=0.0),
        ]

    def quantities(self, run: Run) -> list[Quantity]:
        """Period, precession and bounds of the swing, measured for every member, and in closed form."""
        found, exact = measure.nutation(run), self._closed_form(run)
        least, greatest = self._bounds(run)
        rows = [
            (f"lowest point to lowest point ({self.time_unit})", found.period, exact.nutation_period),
            (f"mean rate about γ (rad/{self.time_unit})", found.precession_rate, -exact.precession_rate),
            ("least angle from γ (°)", np.rad2deg(found.least), least),
            ("greatest angle from γ (°)", np.rad2deg(found.greatest), greatest),
        ]
        return [Quantity(name, x, closed_form=float(closed)) for name, x, closed in rows]

    def _closed_form(self, run: Run) -> LagrangeMotion:
        """That of the nominal member; the top's inclination is that from −γ."""
        return lagrange_motion(*pendulum_as_top(nominal_system(run), nominal_state(run)))

    def _bounds(self, run: Run) -> np.ndarray:
        """The least and the greatest angle from γ in closed form, in degrees."""
        angles = np.rad2deg(self._closed_form(run).inclination)
        return angles if self.gravity < 0 else 180 - angles[::-1]

    def remarks(self, run: Run) -> list[str]:
        """How to read the table."""
        reasons = "fewer than two swings, states saved too rarely, or a swing through the axis"
        return [CLOSED_FORM, f"  — none: {reasons}"]

    @picture(2, spatial=(0,))
    def draw_path(self, axes: np.ndarray, run: Run) -> None:
        """Plot a dozen swings of the bob on the sphere, seen from below, and its angle from γ against time."""
        one = run.member(0)
        period, steps = measure.nutation(one).period, self.steps
        if np.isfinite(period):
            steps = min(steps, int(12 * period / abs(self.dt)) + 1)
        long = self.drawn(one, _FINE, steps)
        bounds = self._bounds(one)
        look: Any = {"unit": self.time_unit, "pole_label": "γ, down", "bounds": bounds[np.isfinite(bounds)]}
        path, ends, pole = (np.asarray(x) for x in (long.state.q, run.state.q[-1], nominal_system(one).axis))
        draw_on_sphere(axes, np.asarray(long.t), path, float(run.t[-1]), ends, pole, **look)
        axes[0].set_title(f"the nominal bob to t = {long.t[-1]:.4g} {self.time_unit}")
        axes[1].set_title("dashed: its bounds in closed form")

    @picture(2)
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot energy and constraint errors of the nominal member by both forms of the midpoint rule."""
        one = run.member(0)
        both = [schemes.sphere_midpoint(nominal_system(one), normalized) for normalized in (False, True)]
        for ax, name in zip(axes, ("energy, relative", "constraints |q| = 1, q·π = 0"), strict=True):
            draw_errors(ax, self, one, both, {name: ""}, name)


def _defect(bob: Pendulum, state: State) -> Any:
    return bob.phase_space.defect(state)
