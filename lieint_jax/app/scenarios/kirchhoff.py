"""A neutrally buoyant ellipsoid in a fluid: its conserved quantities, its tilt, and the stability of its spin."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import maps, measure, plots, systems
from lieint_jax._numerics import random_bits
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._kind import Kind, picture, quantity
from lieint_jax.app.scenarios._pictures import draw_errors, draw_members, draw_paths
from lieint_jax.app.scenarios._report import Conserved
from lieint_jax.app.scenarios._runs import length, nominal_state, nominal_system, positive, series
from lieint_jax.diagnostics import RungeKutta
from lieint_jax.runs import Run
from lieint_jax.systems import Euler
from lieint_jax.types import State


class InitialState(keys.GivenRate):
    """The nominal state: at the origin, with axes along those of space, and velocities in the body."""

    velocity: keys.Triple
    """In body axes, in the unit of semi_axes per time_unit."""


class Spread(keys.RateSpread, keys.NumberSpread):
    """Standard deviations of the members about the nominal state, and of numbers of the scenario by their paths."""

    velocity: keys.NonNegative = 0.0
    """Standard deviation of each component, in the unit of semi_axes per time_unit."""


class Kirchhoff(Kind):
    """The keys of a scenario of this kind."""

    semi_axes: keys.PositiveTriple
    """The semi-axes of the ellipsoid, in a unit of length."""
    center_of_mass: keys.Triple = [0.0, 0.0, 0.0]
    """In body axes from the center of the ellipsoid, in the same unit."""
    scheme: Literal["group_midpoint"] = "group_midpoint"
    map: Literal["exponential", "cayley"] = "exponential"
    order: keys.Order = 2
    state: InitialState
    spread: Spread = Spread()
    traced = False

    def make_system(self) -> Euler:
        a, b, c = self.semi_axes
        return systems.kirchhoff((a, b, c), self.center_of_mass)

    def options(self) -> tuple[Any, ...]:
        return (maps.cayley if self.map == "cayley" else maps.exponential,)

    def deviates(self, indices: np.ndarray) -> Any:
        """Those of both velocities, (m, 6)."""
        noise = random_bits.normal_rows(jax.random.key(self.seed), (self.members, 6), indices)
        return jnp.where((indices == 0)[:, None], 0.0, noise)

    def start(self, system: Euler, noise: Any) -> State:
        unit = jnp.repeat(jnp.array([self.spread.rate(), self.spread.velocity]), 3)
        return system.state(velocity=jnp.array([*self.state.rate(), *self.state.velocity]) + unit * noise)

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy, the momentum in space and the Casimirs."""
        H, (Pi_P, P_P) = series(Euler.energy, run), np.moveaxis(series(Euler.casimirs, run), -1, 0)
        p = np.asarray(run.state.p)
        angular, linear = length(p[..., :3]), length(p[..., 3:])
        return [
            Conserved("energy", H, H[0], "round-off"),
            Conserved("spatial momentum π", p, abs(p[0]).max(), "bit for bit"),
            Conserved("Π·P", Pi_P, positive(angular * linear), "round-off"),
            Conserved("|P|²", P_P, positive(linear**2), "round-off"),
        ]

    @quantity("mean speed along the impulse (/{time_unit})")
    def speed(self, run: Run) -> np.ndarray:
        x, P = run.state.q[..., :3, 3], run.state.p[0, :, 3:]
        distance = np.einsum("mi,mi->m", x[-1] - x[0], P)
        return distance / np.maximum(length(P), keys.TINY) / (run.t[-1] - run.t[0])

    @quantity("third axis strays by (°)")
    def largest_tilt(self, run: Run) -> np.ndarray:
        return np.rad2deg(measure.tilt(run)).max(axis=0)

    def remarks(self, run: Run) -> list[str]:
        """Whether the spin is stable, and the added mass and inertia of the fluid."""
        body = nominal_system(run)
        needed = systems.kirchhoff_spin(body)
        if np.isnan(needed):
            lines = ["  (the needed spin is known in closed form for a body of revolution about the third axis)"]
        else:
            Pi = np.asarray(body.body_momentum(nominal_state(run)))
            spin = abs(Pi[2] / Pi[5]) if Pi[5] else np.inf
            verdict = "stable" if spin > needed else "not stable"
            lines = [
                f"  |Π₃/P₃| = {spin:.4f}, needed to move along the third axis: {needed:.4f} [Lamb §128]: {verdict}"
            ]
        axes = np.array(self.semi_axes)
        m = np.diag(np.asarray(self.model_copy(update={"center_of_mass": [0.0] * 3}).make_system().metric))
        solid = (np.sum(axes**2) - axes**2) / 5
        rows = {"added mass ÷ displaced": m[3:] - 1, "added inertia ÷ displaced": m[:3] / solid - 1}
        lines.append(f"\n  {'in the axes of the ellipsoid':<34}" + "".join(f"{a:>10g}" for a in axes))
        return lines + [f"  {name:<34}" + "".join(f"{x:>10.3f}" for x in values) for name, values in rows.items()]

    @picture(2, spatial=(0, 1))
    def draw_path(self, axes: np.ndarray, run: Run) -> None:
        """Plot the paths of the centers of the nominal and the last member, and the last one's third axis in space."""
        left, right = axes
        last = f"member {self.members - 1}" if self.members > 1 else "nominal member"
        members = {"nominal member": run.member(0), last: run.member(-1)}
        paths = {name: np.asarray(self.drawn(one).state.q) for name, one in members.items()}
        draw_paths(left, {name: q[:, :3, 3] for name, q in paths.items()})
        left.set_title(f"path of the center to t = {run.t[-1]:.4g} {self.time_unit}, in the unit of the semi-axes")
        q, P = paths[last], np.asarray(run.state.p[0, -1, 3:])
        pole = P / np.linalg.norm(P) if P.any() else None
        eye = q[0, :3, 2] + 0.5 * q[0, :3, 0]
        plots.sphere_path(right, q[:, :3, 2], pole, eye=eye, pole_label="direction of the impulse")
        right.set_title(f"third axis of {last.replace('nominal', 'the nominal')} in space")
        right.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02))

    @picture(2)
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot energy errors of the last member, also by Runge–Kutta, and the tilts of all members' axes."""
        one = run.member(-1)
        steps = one.step, RungeKutta(one.system)
        draw_errors(axes[0], self, one, steps, {"energy": ""}, "energy error, relative")
        t, tilts = np.asarray(run.t), np.rad2deg(measure.tilt(run))
        draw_members(axes[1], t, tilts, "third axis strays by (°)", self.time_unit)
