"""A tumbling free rigid body: its mean periods and the direction of its momentum, compared with published values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import adjoints, diagnostics, measure, plots, systems
from lieint_jax.app.scenarios import _body
from lieint_jax.app.scenarios._files import ObservationFile
from lieint_jax.app.scenarios._keys import TINY, Published, Table, Text
from lieint_jax.app.scenarios._kind import check_order, picture
from lieint_jax.app.scenarios._report import Quantity
from lieint_jax.app.scenarios._runs import angles, drawn_steps, length, nominal_state, nominal_system, series
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.systems import RigidBody

Z = (0.0, 0.0, 1.0)  # the body axis that is drawn

_SUBSCRIPTS = "₁₂₃"
_AMPLIFIED = 1e-11  # a larger Poisson error of an exact scheme is round-off that the motion amplifies


class Observation(_body.InitialState):
    """An observed attitude and angular velocity at time t, with its source."""

    label: Text
    t: float
    """In time_unit, a multiple of dt times save_every."""
    source: str
    """A key of the table sources, or the source itself if there is no such table."""


class FreeBody(_body.BodyKind):
    """The keys of a scenario of this kind."""

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

    files: ClassVar[Mapping[str, type[Table]]] = {**_body.BodyKind.files, "observation": ObservationFile}

    def _check_scheme(self) -> None:
        if self.kappa is not None and self.scheme != "so3_midpoint":
            raise ValueError(f"kappa is a key of so3_midpoint; {self.scheme} has none")
        check_order(self.scheme, self.order)

    def _check_observations(self) -> None:
        interval = self.dt * self.save_every
        for seen in self.observation:
            if seen.t * interval < 0:
                raise ValueError(
                    f"observation.t = {seen.t} lies on the other side of t = 0 than the run, since dt = {self.dt:.9g}: "
                    f"give dt {'>' if seen.t > 0 else '<'} 0"
                )
            if abs(seen.t / interval - round(seen.t / interval)) > 1e-6:
                raise ValueError(f"observation.t = {seen.t} must be a multiple of dt·save_every = {interval:.9g}")

    def make_system(self) -> RigidBody:
        return systems.rigid_body(self.inertia)

    def options(self) -> tuple[Any, ...]:
        return (_body.KAPPAS[self.kappa or "symplectic"],) if self.scheme == "so3_midpoint" else ()

    def conserved(self, run: Run) -> list[Any]:
        """Nothing: its certificate has more digits."""
        return []

    def quantities(self, run: Run) -> list[Quantity]:
        """Mean periods of the tumbling and the direction of the angular momentum, with their published values."""
        periods, pole = measure.periods(run), measure.pole(run)
        rows = {
            "precession_period": (f"precession period ({self.time_unit})", periods.precession),
            "rotation_period": (f"rotation period ({self.time_unit})", periods.rotation),
            "momentum_longitude_deg": ("angular momentum longitude (°)", np.rad2deg(pole.longitude[0])),
            "momentum_latitude_deg": ("angular momentum latitude (°)", np.rad2deg(pole.latitude[0])),
        }
        known: dict[str, Published] = {**self.published}
        return [Quantity(*row, published=known.get(key), angle=key.endswith("_deg")) for key, row in rows.items()]

    def remarks(self, run: Run) -> list[str]:
        """The reason for a missing period, and predictions next to observations."""
        one = run.member(0)
        missing = "  — no period: the body spins about an axis, or states are saved too rarely (lower save_every)"
        lines = [missing] if np.isnan(measure.periods(one)[:2]).any() else []
        return lines + [self._prediction(run, seen) for seen in self.observation if self._is_seen(run, seen)]

    def save_index(self, seen: Observation) -> int:
        """The index of the saved state at the time of an observation."""
        return round(seen.t / (self.dt * self.save_every))

    def _is_seen(self, run: Run, seen: Observation) -> bool:
        return 0 <= self.save_index(seen) < len(run.t)

    def _prediction(self, run: Run, seen: Observation) -> str:
        """The predicted attitude and rate of the nominal member next to an observation, with the sizes of errors.

        The integrator's own error is that against `diagnostics.flow`, which is accurate to round-off.
        """
        body, k = nominal_system(run), self.save_index(seen)
        now, start = nominal_state(run, k), nominal_state(run)
        Omega = jnp.linalg.norm(body.angular_velocity(start))
        true = diagnostics.flow(body, start, seen.t, 2 * int(abs(seen.t * Omega)) + 2)
        members = jax.vmap(so3.angle, in_axes=(0, None))(jnp.asarray(run.state.q[k]), now.q)
        misfit, own = (float(jnp.rad2deg(so3.angle(now.q, q))) for q in (seen.attitude(), true.q))
        spread = float(jnp.rad2deg(jnp.sqrt(jnp.mean(members**2))))

        def triple(values: np.ndarray | list[float]) -> str:
            return "(" + ", ".join(f"{x:8.2f}" for x in values) + ")"

        lines = [f"\n  {seen.label}: t = {seen.t:g} {self.time_unit}   [{self.source(seen.source)}]"]
        euler, rate = np.rad2deg(np.asarray(so3.to_euler_313(now.q))) % 360, body.angular_velocity(now)
        for name, predicted, observed in (
            ("Euler 3-1-3 (°)", euler, seen.euler_313_deg),
            (f"body rate (°/{self.time_unit})", np.rad2deg(np.asarray(rate)), seen.angular_velocity_deg),
        ):
            if observed:
                lines.append(f"    {name}      predicted {triple(predicted)}   observed {triple(observed)}")
        lines += [
            f"    angle between attitudes predicted and observed: {misfit:.2f}°; members about the nominal "
            f"one: {spread:.2f}° rms; the integrator's own error: {own:.2g}°",
            "    (torque-free: the angle includes errors of the initial state and the observation, and omitted "
            "torques)",
        ]
        return "\n".join(lines)

    @picture(2, size=(4.7, 4.2), gridspec_kw={"width_ratios": [2, 1]})
    def draw_path(self, axes: np.ndarray, run: Run) -> None:
        """Map the direction of the body's z axis in space, of all members at the first observation, and that observed.

        Next to the map of the sky is one of the members' surroundings.
        """
        one = run.member(0)
        place, close = axes
        wide = place.figure.add_subplot(place.get_subplotspec(), projection="mollweide")
        place.remove()
        seen = [s for s in self.observation if self._is_seen(run, s)][:1]
        last = self.save_index(seen[0]) if seen else len(run.t) - 1
        long = self.drawn(one, steps=last * self.save_every)
        path, members = _body.axis_in_space(long.state.q, Z), _body.axis_in_space(run.state.q[last], Z)
        pole = np.asarray(run.state.p[0, :1]) / np.linalg.norm(run.state.p[0, 0])
        center = float(30 * np.round(np.rad2deg(np.arctan2(pole[0, 1], pole[0, 0])) / 30))
        ax, span = plots.sky(wide, center), f"to t = {long.t[-1]:.4g} {self.time_unit}"
        plots.sky_path(ax, path, f"body axis z, nominal member, {span}", center, color=plots.BLUE, lw=0.8)
        label = f"{self.members} members then" if self.members > 1 else "axis z then"
        plots.sky_points(ax, members, label, center, color=plots.INK, zorder=3)
        plots.sky_points(ax, pole, "angular momentum", center, color=plots.GREEN, marker="P", s=45, zorder=3)
        observed = _body.axis_in_space(seen[0].attitude()[None], Z) if seen else np.zeros((0, 3))
        if seen:
            plots.sky_points(ax, observed, "observed then", center, color=plots.RED, marker="x", s=60, lw=1.6, zorder=4)
            plots.caption(ax.figure, self._observation_in_words(seen[0], path[-1], members))
        legend = ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, borderpad=0.9)
        legend.legend_handles[1].set_sizes([12])  # the members' dots would be too small in the legend
        ax.set(xlabel="longitude in the axes of space", ylabel="latitude")
        ax.set_title(f"(a) the whole sky, {span}", loc="left")
        _draw_surroundings(close, path, members, observed)
        close.set_title("(b) the same about the nominal member", loc="left")

    def _observation_in_words(self, seen: Observation, nominal_axis: np.ndarray, members: np.ndarray) -> str:
        """The caption of `draw_path`: the source of the cross, and its distance from the predicted axes."""
        [observed] = _body.axis_in_space(seen.attitude()[None], Z)
        spread = np.rad2deg(np.sqrt(np.mean(angles(members, nominal_axis) ** 2)))
        off = np.rad2deg(angles(observed, nominal_axis))
        return (
            f"Cross: axis z of the attitude observed by {seen.label} ({self.source(seen.source)}), "
            f"{off:.1f}° from the nominal prediction; members scatter by {spread:.1f}° rms"
        )

    @picture(3)
    def draw_invariants(self, axes: np.ndarray, run: Run) -> None:
        """Plot the energy and Poisson errors of the nominal member against time."""
        one, (n, every) = run.member(0), drawn_steps(self.steps)
        z, step = nominal_state(one), one.step
        long = self.drawn(one)
        t, energy = np.asarray(long.t), np.asarray(long.energy_error() / step.system.energy(z))
        poisson = jax.jit(lambda z: jax.vmap(so3.vee)(diagnostics.poisson_error(step, z, self.dt, n)[::every]))
        sigma = length(np.asarray(poisson(z)))
        plots.log_error(axes[0], t, {"nominal member": energy}, "relative energy error", self.time_unit)
        plots.log_error(axes[1], t, {"nominal member": sigma}, "Poisson error |σ|", self.time_unit)
        if sigma.max() > _AMPLIFIED:
            L = adjoints.transition(step, z, self.dt, n, save_every=every).matrix
            plots.amplified_round_off(axes[1], t, np.asarray(L))
        _draw_polhode(axes[2], one)


def _draw_surroundings(ax: Any, path: np.ndarray, members: np.ndarray, observed: np.ndarray) -> None:
    """The members' axes and the observed one in degrees east and north of the end of the path."""
    end = path[-1]
    aside = np.cross((0.0, 0.0, 1.0), end)
    aside = aside / np.linalg.norm(aside) if aside.any() else np.eye(3)[0]
    across = np.stack([aside, np.cross(end, aside)], axis=1)

    def from_end(x: np.ndarray) -> np.ndarray:
        offset, angle = x @ across, np.arccos(np.clip(x @ end, -1, 1))
        return np.rad2deg((offset * (angle / np.maximum(np.linalg.norm(offset, axis=1), TINY))[:, None]).T)

    shown = np.concatenate([from_end(members), from_end(observed)], axis=1)
    half = 1.15 * max(abs(shown).max(), 1.0)
    near = path @ end > np.cos(np.deg2rad(min(3 * half, 90)))
    ax.plot(*np.where(near, from_end(path), np.nan), color=plots.BLUE, lw=0.8)
    east, north = from_end(members)
    plots.points(ax, east, north, f"{len(members)} members", zorder=3)
    ax.plot(0, 0, "o", color=plots.BLUE, ms=6, mfc="white", mew=1.5, zorder=4, label="nominal member")
    ax.legend(loc="lower left")
    ax.plot(*from_end(observed), "x", color=plots.RED, ms=7, mew=1.6, zorder=4)
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xlabel="east (°)", ylabel="north (°)")


def _draw_polhode(ax: Any, one: Run) -> None:
    """The body momentum of the nominal member, seen along the principal axis that it circles."""
    moments, axes = np.linalg.eigh(_body.inertia_matrix(one.system))
    Pi = series(RigidBody.body_momentum, one)
    Pi = Pi @ axes / np.linalg.norm(Pi[0])
    about = 0 if _body.is_long_axis_mode(moments, Pi[0]) else 2
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
