"""A heavy top: its integrals, its nutation and precession compared with the closed form, and its axis on the sphere."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from lieint_jax import measure, plots, systems
from lieint_jax.app.scenarios._body import TopKind, axis_in_space, inertia_matrix
from lieint_jax.app.scenarios._keys import Direction, Triple, checked
from lieint_jax.app.scenarios._kind import check_order, for_last_run, picture
from lieint_jax.app.scenarios._pictures import draw_on_sphere
from lieint_jax.app.scenarios._report import CLOSED_FORM, Conserved, Quantity
from lieint_jax.app.scenarios._runs import LONGEST, POINTS, drawn_run, length, nominal_state, nominal_system, series
from lieint_jax.diagnostics import RungeKutta, step_cost
from lieint_jax.measure import Nutation
from lieint_jax.runs import Run
from lieint_jax.systems import LagrangeMotion, PotentialTop, is_lagrange_top, kovalevskaya_integral, lagrange_motion
from lieint_jax.types import State

_LONG = 10  # length of the picture of energies, over that of the run


def _check_weight(weight: list[float]) -> None:
    if not any(weight):
        raise ValueError("must not be zero; a body without weight is a rigid_body")


class HeavyTop(TopKind):
    """The keys of a scenario of this kind."""

    weight: Annotated[Triple, checked(_check_weight)]
    """The weight times the vector to the center of mass, in body axes: an energy."""
    axis: Direction = [0.0, 0.0, 1.0]
    """The direction in space along which the potential energy grows: upwards."""
    scheme: Literal["nystrom", "top_energy_momentum", "splitting"] = "top_energy_momentum"  # pyright: ignore[reportIncompatibleVariableOverride]

    def _check_order(self) -> None:
        if self.scheme == "nystrom":
            check_order("nystrom", self.order)

    def make_system(self) -> PotentialTop:
        return systems.heavy_top(self.inertia, self.weight, self.axis)

    def conserved(self, run: Run) -> list[Conserved]:
        """The integrals: energy relative to the initial ½Π·J⁻¹Π + |E||γ|, momenta relative to |π|."""
        top = nominal_system(run)
        J, E, gamma = inertia_matrix(top), _weight(top), np.linalg.norm(np.asarray(top.axis))
        size, momentum = np.linalg.norm(E) * gamma, length(np.asarray(run.state.p[0])) * gamma
        kinetic = series(PotentialTop.kinetic_energy, run)[0]
        found = [
            Conserved("energy, relative", series(PotentialTop.energy, run), kinetic + size),
            Conserved("γ·π, relative to |π|", series(PotentialTop.momentum, run)[..., 0], momentum),
        ]
        if is_lagrange_top(top):
            found.append(Conserved("Π₃, relative to |π|", series(PotentialTop.body_momentum, run)[..., 2], momentum))
        if np.allclose(J, np.diag([2.0, 2.0, 1.0]) * J[2, 2], rtol=1e-12, atol=0) and not E[1:].any():
            K = series(kovalevskaya_integral, run)
            unit = np.maximum(abs(K[0]), (size / J[2, 2]) ** 2)
            found.append(Conserved("Kovalevskaya's integral, relative", K, unit))
        return found

    @for_last_run
    def nutation(self, run: Run) -> Nutation:
        """The nutation and precession of each member."""
        return measure.nutation(run)

    def quantities(self, run: Run) -> list[Quantity]:
        """Nutation and precession of the axis to the center of mass, measured for every member, and in closed form."""
        found, closed = self.nutation(run), closed_form(nominal_system(run), nominal_state(run))
        known = [np.nan] * 4
        if closed is not None:
            known = [closed.nutation_period, closed.precession_rate, *np.rad2deg(closed.inclination)]
        rows = {
            f"nutation period ({self.time_unit})": found.period,
            f"mean precession (rad/{self.time_unit})": found.precession_rate,
            "least inclination (°)": np.rad2deg(found.least),
            "greatest inclination (°)": np.rad2deg(found.greatest),
        }
        return [Quantity(*row, closed_form=float(x)) for row, x in zip(rows.items(), known, strict=True)]

    def remarks(self, run: Run) -> list[str]:
        """How to read the table."""
        lines = [CLOSED_FORM]
        if not is_lagrange_top(nominal_system(run)):
            lines = ["  (a closed form is known for J₁ = J₂ and the weight along the third axis: Lagrange's top)"]
        if np.isnan(self.nutation(run).period[0]):
            lines.append("  — not measured: fewer than two nutations, or states saved fewer than 6 times in one")
        return lines

    @picture(2, spatial=(0,))
    def draw_path(self, axes: np.ndarray, run: Run) -> None:
        """Plot the axis to the center of mass on the sphere, for at most one revolution about γ; its inclination."""
        one = run.member(0)
        top, rate, steps = nominal_system(one), measure.nutation(one).precession_rate, self.steps
        if np.isfinite(rate) and rate:
            steps = min(steps, int(2 * np.pi / abs(rate * self.dt)) + 1)
        long = self.drawn(one, steps=steps)
        path, ends = (axis_in_space(q, _unit(_weight(top))) for q in (long.state.q, run.state.q[-1]))
        closed = closed_form(top, nominal_state(one))
        bounds = [] if closed is None else np.rad2deg(closed.inclination)
        look = {"unit": self.time_unit, "pole_label": "γ, up", "angle_label": "inclination (°)", "bounds": bounds}
        draw_on_sphere(axes, np.asarray(long.t), path, float(run.t[-1]), ends, _unit(np.asarray(top.axis)), **look)
        axes[0].set_title(f"the nominal axis in space to t = {long.t[-1]:.4g} {self.time_unit}")
        axes[1].set_title("its nutation; dashed, the bounds in closed form" if closed else "")

    @picture(size=(6.4, 4.2))
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot the largest energy error so far of each scheme, and of Runge–Kutta at the cost of the slower scheme."""
        one, dt = run.member(0), self.dt
        top, z = nominal_system(one), nominal_state(one)
        names = ["nystrom"] * (self.order in (4, 6)) + ["top_energy_momentum", "splitting"]
        found, peer = [self.step_by(name, top) for name in names], RungeKutta(top)
        ratio = step_cost(peer, z, dt) / max(step_cost(step, z, dt) for step in found)
        end = dt * min(_LONG * self.steps, LONGEST)
        t, curves = np.linspace(0, end, POINTS + 1)[1:], {}
        for step, h in [*((step, dt) for step in found), (peer, dt * ratio)]:
            long = drawn_run(step, z, h, round(end / h), round(end / h))
            error = np.maximum.accumulate(abs(np.asarray(long.energy_error()))) / abs(float(top.energy(z)))
            name = step.name.replace("[so3_midpoint[symplectic]]", "")
            curves[f"{name}, Δt = {h:.2g}"] = np.interp(abs(t), abs(np.asarray(long.t)), error)
        ax = axes[0]
        ax.set_xscale("log" if dt > 0 else "linear")
        plots.log_error(ax, t, curves, "largest relative energy error so far", self.time_unit)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.45)  # room for the legend
        ax.legend(loc="upper left")
        ax.set_title("Runge–Kutta: steps of equal cost per unit of time")


def closed_form(top: PotentialTop, state: State) -> LagrangeMotion | None:
    """The motion of Lagrange's top; None of another one."""
    return lagrange_motion(top, state) if is_lagrange_top(top) else None


def _weight(top: PotentialTop) -> np.ndarray:
    return np.asarray(top.potential.weight)  # pyright: ignore[reportFunctionMemberAccess]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)
