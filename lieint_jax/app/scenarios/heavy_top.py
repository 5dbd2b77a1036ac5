"""A heavy top: its integrals, its nutation and precession compared with the closed form, and its axis on the sphere."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import model_validator

from lieint_jax import systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios._body import TopKind, axis_in_space, inertia_matrix
from lieint_jax.app.scenarios._keys import Direction, Triple, checked
from lieint_jax.app.scenarios._kind import check_order, picture
from lieint_jax.app.scenarios._pictures import draw_on_sphere
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runge_kutta import RungeKutta, cost
from lieint_jax.app.scenarios._runs import LONGEST, POINTS, drawn_run, length, nominal_state, nominal_system, series
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.runs import Run
from lieint_jax.systems import PotentialTop, kovalevskaya_integral, lagrange_motion
from lieint_jax.types import State, vectors

CLOSED_FORM = (
    "  closed form: elliptic integrals; the difference is the scheme's error, of its order in dt, or round-off"
)
_LONG = 10  # length of the picture of energies, over that of the run
_MIN_SAMPLES = 6  # saved states per nutation that a measurement needs
_STENCIL = 6  # saved states through which an angle and its rate are interpolated
_HALVINGS = 50  # of the interval between two saved states that contains an extreme


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

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.scheme == "nystrom":
            check_order("nystrom", self.order)
        return self

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
        if is_lagrange(top):
            found.append(Conserved("Π₃, relative to |π|", series(PotentialTop.body_momentum, run)[..., 2], momentum))
        if np.allclose(J, np.diag([2.0, 2.0, 1.0]) * J[2, 2], rtol=1e-12, atol=0) and not E[1:].any():
            K = series(kovalevskaya_integral, run)
            unit = np.maximum(abs(K[0]), (size / J[2, 2]) ** 2)
            found.append(Conserved("Kovalevskaya's integral, relative", K, unit))
        return found

    def quantities(self, run: Run) -> list[Quantity]:
        """Nutation and precession of the axis to the center of mass, measured for every member, and in closed form."""
        return nutations(run, self.time_unit)

    def remarks(self, run: Run) -> list[str]:
        """How to read the table."""
        lines = [CLOSED_FORM]
        if not is_lagrange(nominal_system(run)):
            lines = ["  (a closed form is known for J₁ = J₂ and the weight along the third axis: Lagrange's top)"]
        if np.isnan(motion(run.member(0))).any():
            few = f"fewer than two nutations, or states saved fewer than {_MIN_SAMPLES} times in one"
            lines.append(f"  — not measured: {few}")
        return lines

    @picture(2, spatial=(0,))
    def draw_path(self, axes: np.ndarray, run: Run) -> None:
        """Plot the axis to the center of mass on the sphere, for at most one revolution about γ; its inclination."""
        one = run.member(0)
        top, rate, steps = nominal_system(one), motion(one)[1], self.steps
        if np.isfinite(rate) and rate:
            steps = min(steps, int(2 * np.pi / abs(rate * self.dt)) + 1)
        long = self.drawn(one.step, nominal_state(one), steps=steps)
        path, ends = (axis_in_space(q, _unit(_weight(top))) for q in (long.state.q, run.state.q[-1]))
        closed = is_lagrange(top)
        bounds = np.rad2deg(lagrange_motion(top, nominal_state(one)).inclination) if closed else []
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
        ratio = cost(peer, z, dt) / max(cost(step, z, dt) for step in found)
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


def is_lagrange(top: PotentialTop) -> bool:
    """Whether the top is symmetric about the axis to its center of mass, and that axis is the third."""
    J, E = inertia_matrix(top), _weight(top)
    size = 1e-12 * J.max()
    symmetric = abs(J[0, 0] - J[1, 1]) <= size and abs(J - np.diag(np.diag(J))).max() <= size
    return bool(symmetric and abs(E[:2]).max() <= 1e-12 * abs(E[2]))


def _weight(top: PotentialTop) -> np.ndarray:
    return np.asarray(top.potential.weight)  # pyright: ignore[reportFunctionMemberAccess]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)


def nutations(run: Run, time_unit: str) -> list[Quantity]:
    """The nutation of the members of a run, and of the nominal one in closed form."""
    top, motions = nominal_system(run), np.array([motion(run.member(m)) for m in range(run.members or 0)])
    closed = [np.nan] * 4
    if is_lagrange(top):
        exact = lagrange_motion(top, nominal_state(run))
        closed = [exact.nutation_period, exact.precession_rate, *np.rad2deg(exact.inclination)]
    names = (
        f"nutation period ({time_unit})",
        f"mean precession (rad/{time_unit})",
        "least inclination (°)",
        "greatest inclination (°)",
    )
    columns = zip(names, motions.T, closed, strict=True)
    return [Quantity(name, x, closed_form=float(exact)) for name, x, exact in columns]


def motion(one: Run) -> np.ndarray:
    """Nutation period, mean precession rate, least and greatest inclination (°) of a top, over whole nutations.

    They are interpolated at the times when the axis is lowest and highest; nan if it is lowest fewer than twice, or if
    states are saved too rarely.
    """
    top, q, p = nominal_system(one), jnp.asarray(one.state.q), jnp.asarray(one.state.p)
    t, axis = np.asarray(one.t), _unit(np.asarray(top.axis))
    e, velocity, acceleration = (np.asarray(x) for x in _axis_motion(top, State(q, p), _unit(_weight(top))))
    h = t[min(1, len(t) - 1)] - t[0]  # rates per saved state, so that backward runs need no other treatment
    u, slope, curvature = e @ axis, h * velocity @ axis, h**2 * acceleration @ axis
    across = np.stack(frame(jnp.asarray(axis)))
    (x, y), (dx, dy) = across @ e.T, h * across @ velocity.T
    phi = np.unwrap(np.arctan2(y, x))
    period = rate = np.nan
    lowest, highest = (np.flatnonzero((s * slope[:-1] < 0) & (s * slope[1:] >= 0)) for s in (1, -1))
    if len(lowest) > 1 and np.diff(lowest).min() >= _MIN_SAMPLES:
        [low, high] = (_Extremes.from_slope(k, slope, curvature) for k in (lowest, highest))
        times, change = t[0] + h * low.position, np.arctan2(low.value(y, dy), low.value(x, dx)) - phi[lowest]
        angles = phi[lowest] + np.remainder(change + np.pi, 2 * np.pi) - np.pi  # each change is less than π
        period = abs(times[-1] - times[0]) / (len(times) - 1)
        rate = (angles[-1] - angles[0]) / (times[-1] - times[0])
        u = np.concatenate([u, low.value(u, slope), high.value(u, slope)])
    angle = np.rad2deg(np.arccos(np.clip(u, -1, 1)))
    return np.array([period, rate, angle.min(), angle.max()])


class _Extremes(NamedTuple):
    """Extremes of a series with known rates, between saved states, by Hermite polynomials.

    Attributes:
        first: the index of the first saved state of each polynomial, (n,).
        offset: the index of each extreme relative to the middle of the polynomial's states, (n,).
    """

    first: np.ndarray
    offset: np.ndarray

    @classmethod
    def from_slope(cls, before: np.ndarray, slope: np.ndarray, curvature: np.ndarray) -> Self:
        """The zeros of `slope`, whose rate is `curvature`, each after the saved state `before`."""
        first = np.clip(before - _STENCIL // 2 + 1, 0, len(slope) - _STENCIL)
        low = before - first - (_STENCIL - 1) / 2
        high, sign = low + 1, np.sign(slope[before])
        polynomial = _hermite(first, slope, curvature)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            same = np.sign(_value(polynomial, middle)) == sign
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return cls(first, (low + high) / 2)

    @property
    def position(self) -> np.ndarray:
        """The indices of the extremes among the saved states."""
        return self.first + self.offset + (_STENCIL - 1) / 2

    def value(self, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """The values at the extremes of a series y with this slope."""
        return _value(_hermite(self.first, y, slope), self.offset)


def _hermite(first: np.ndarray, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The coefficients (2·_STENCIL, n) of the polynomials through y with this slope, from each `first` on."""
    nodes, powers = np.arange(_STENCIL) - (_STENCIL - 1) / 2, np.arange(2 * _STENCIL)
    conditions = np.concatenate([nodes[:, None] ** powers, powers * nodes[:, None] ** np.maximum(powers - 1, 0)])
    rows = first + np.arange(_STENCIL)[:, None]
    return np.linalg.solve(conditions, np.concatenate([y[rows], slope[rows]]))


def _value(polynomial: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.polynomial.polynomial.polyval(x, polynomial, tensor=False)


@jax.jit
def _axis_motion(top: PotentialTop, states: State, axis: Any) -> tuple[Any, Any, Any]:
    """The direction in space of an axis of the body, its velocity and its acceleration, (n, 3) each."""

    def velocity(state: State) -> Any:
        return so3.Ad(state.q, jnp.stack(vectors.cross(top.angular_velocity(state), axis)))

    def axis_and_velocity(state: State) -> tuple[Any, Any, Any]:
        return so3.Ad(state.q, axis), *jax.jvp(velocity, (state,), (top.vector_field(state),))

    return jax.vmap(axis_and_velocity)(states)
