"""A heavy top: its integrals, its nutation and precession compared with the closed form, and its axis on the sphere."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import model_validator

from lieint_jax import diagnostics, schemes, systems
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._body import TopScenario, axis_in_space, inertia_matrix, initial_state, top_schemes
from lieint_jax.app.scenarios._common import Direction, Triple, check_order, checked, deviates
from lieint_jax.app.scenarios._pictures import draw_on_sphere, picture
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runge_kutta import RungeKutta, cost
from lieint_jax.app.scenarios._runs import LONGEST, POINTS, drawn_trajectory, nominal_state, series
from lieint_jax.app.scenarios._spread import for_member
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.systems import PotentialTop, kovalevskaya_integral, lagrange_motion
from lieint_jax.types import State, Step, Trajectory, vectors

CLOSED_FORM = (
    "  closed form: elliptic integrals; the difference is the scheme's error, of its order in dt, or round-off"
)
_LONG = 10  # length of the picture of energies, over that of the run
_NYSTROM = (4, 6)  # orders of nystrom
_MIN_SAMPLES = 6  # saved states per nutation that a measurement needs
_STENCIL = 6  # saved states through which an angle and its rate are interpolated
_HALVINGS = 50  # of the interval between two saved states that contains an extreme


def _check_weight(weight: list[float]) -> None:
    if not any(weight):
        raise ValueError("must not be zero; a body without weight is a rigid_body")


class Scenario(TopScenario):
    """The keys of a scenario of this kind."""

    system: Literal["heavy_top"]  # pyright: ignore[reportIncompatibleVariableOverride]
    weight: Annotated[Triple, checked(_check_weight)]
    """The weight times the vector to the center of mass, in body axes: an energy."""
    axis: Direction = [0.0, 0.0, 1.0]
    """The direction in space along which the potential energy grows: upwards."""
    scheme: Literal["nystrom", "top_energy_momentum", "splitting"] = "top_energy_momentum"  # pyright: ignore[reportIncompatibleVariableOverride]

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.scheme == "nystrom":
            check_order("nystrom", self.order, _NYSTROM)
        return self


def build(scenario: Scenario, indices: np.ndarray | None = None) -> tuple[Step, State]:
    """The step and the batch of initial states."""
    return _spread.build(scenario, deviates(scenario, indices), _step, initial_state)


def _step(scenario: Scenario) -> Step:
    top = systems.heavy_top(scenario.inertia, scenario.weight, scenario.axis)
    return _schemes(scenario, top)[scenario.scheme]


def _schemes(scenario: Scenario, top: PotentialTop) -> dict[str, Step]:
    """The schemes for tops, at the order of the scenario."""
    nystrom = {"nystrom": schemes.nystrom(top, scenario.order)} if scenario.order in _NYSTROM else {}
    return nystrom | top_schemes(scenario, top)


def is_lagrange(top: PotentialTop) -> bool:
    """Whether the top is symmetric about the axis to its center of mass, and that axis is the third."""
    J, E = inertia_matrix(top), _weight(top)
    size = 1e-12 * J.max()
    symmetric = abs(J[0, 0] - J[1, 1]) <= size and abs(J - np.diag(np.diag(J))).max() <= size
    return bool(symmetric and abs(E[:2]).max() <= 1e-12 * abs(E[2]))


def conserved(scenario: Scenario, top: PotentialTop, run: Trajectory) -> list[Conserved]:
    """The integrals: energy relative to the initial ½Π·J⁻¹Π + |E||γ|, momenta relative to |π|."""
    size = np.linalg.norm(_weight(top)) * np.linalg.norm(np.asarray(top.axis))
    kinetic = series(PotentialTop.kinetic_energy, run, top)[0]
    momentum = np.linalg.norm(np.asarray(run.state.p[0]), axis=-1) * np.linalg.norm(np.asarray(top.axis))
    found = [
        Conserved("energy, relative", series(PotentialTop.energy, run, top), kinetic + size),
        Conserved("γ·π, relative to |π|", series(PotentialTop.momentum, run, top)[..., 0], momentum),
    ]
    J, E = inertia_matrix(top), _weight(top)
    if is_lagrange(top):
        found.append(Conserved("Π₃, relative to |π|", series(PotentialTop.body_momentum, run, top)[..., 2], momentum))
    if np.allclose(J, np.diag([2.0, 2.0, 1.0]) * J[2, 2], rtol=1e-12, atol=0) and not E[1:].any():
        K = series(kovalevskaya_integral, run, top)
        found.append(Conserved("Kovalevskaya's integral, relative", K, np.maximum(abs(K[0]), (size / J[2, 2]) ** 2)))
    return found


def _weight(top: PotentialTop) -> np.ndarray:
    return np.asarray(top.potential.weight)  # pyright: ignore[reportFunctionMemberAccess]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)


def quantities(scenario: Any, top: PotentialTop, run: Trajectory) -> list[Quantity]:
    """Nutation and precession of the axis to the center of mass, measured for every member, and in closed form."""
    motions = np.array([motion(top, run, m) for m in range(run.state.p.shape[1])])
    closed = np.full(4, np.nan)
    if is_lagrange(top):
        exact = lagrange_motion(top, nominal_state(run))
        closed = np.array([exact.nutation_period, exact.precession_rate, *np.rad2deg(exact.inclination)])
    names = (
        f"nutation period ({scenario.time_unit})",
        f"mean precession (rad/{scenario.time_unit})",
        "least inclination (°)",
        "greatest inclination (°)",
    )
    columns = zip(names, motions.T, closed, strict=True)
    return [Quantity(name, x, closed_form=float(exact)) for name, x, exact in columns]


def remarks(scenario: Scenario, step: Step, run: Trajectory) -> list[str]:
    """How to read the table."""
    top = for_member(scenario, step.system)
    if is_lagrange(top):
        lines = [CLOSED_FORM]
    else:
        lines = ["  (a closed form is known for J₁ = J₂ and the weight along the third axis: Lagrange's top)"]
    if any(np.isnan(x.nominal) for x in quantities(scenario, top, run)):
        lines.append(
            f"  — not measured: fewer than two nutations, or states saved fewer than {_MIN_SAMPLES} times in one"
        )
    return lines


def motion(top: PotentialTop, run: Trajectory, member: int = 0) -> np.ndarray:
    """Nutation period, mean precession rate, least and greatest inclination (°) of a member, over whole nutations.

    They are interpolated at the times when the axis is lowest and highest; nan if it is lowest fewer than twice, or if
    states are saved too rarely.
    """
    q, p = (jnp.asarray(x[:, member]) for x in (run.state.q, run.state.p))
    t, axis = np.asarray(run.t), _unit(np.asarray(top.axis))
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


@picture(2, spatial=(0,))
def draw_path(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot the axis to the center of mass on the sphere, for one revolution about γ at most, and its inclination."""
    step = for_member(scenario, step)
    top, unit = step.system, scenario.time_unit
    rate = motion(top, run)[1]
    steps = scenario.steps
    if np.isfinite(rate) and rate:
        steps = min(steps, int(2 * np.pi / abs(rate * scenario.dt)) + 1)
    long = drawn_trajectory(step, nominal_state(run), scenario.dt, steps)
    path, ends = (axis_in_space(q, _unit(_weight(top))) for q in (long.state.q, run.state.q[-1]))
    bounds = np.rad2deg(lagrange_motion(top, nominal_state(run)).inclination) if is_lagrange(top) else []
    look = {"unit": unit, "pole_label": "γ, up", "angle_label": "inclination (°)", "bounds": bounds}
    draw_on_sphere(axes, np.asarray(long.t), path, float(run.t[-1]), ends, _unit(np.asarray(top.axis)), **look)
    axes[0].set_title(f"the nominal axis in space to t = {long.t[-1]:.4g} {unit}")
    if is_lagrange(top):
        axes[1].set_title("its nutation; dashed, the bounds in closed form")


@picture(size=(6.4, 4.2))
def draw_energy(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot the largest energy error so far of each scheme, and of Runge–Kutta at the cost of the slower scheme."""
    top, z, dt = for_member(scenario, step.system), nominal_state(run), scenario.dt
    found, peer = _schemes(scenario, top), RungeKutta(top)
    ratio = cost(peer, z, dt) / max(cost(scheme, z, dt) for scheme in found.values())
    end = dt * min(_LONG * scenario.steps, LONGEST)
    t, curves = np.linspace(0, end, POINTS + 1)[1:], {}
    for scheme, h in [*((s, dt) for s in found.values()), (peer, dt * ratio)]:
        long = drawn_trajectory(scheme, z, h, round(end / h), round(end / h))
        error = np.abs(np.asarray(diagnostics.energy_error(top, long))) / abs(float(top.energy(z)))
        curves[f"{scheme.name.replace('[so3_midpoint[symplectic]]', '')}, Δt = {h:.2g}"] = np.interp(
            abs(t), np.abs(long.t), np.maximum.accumulate(error)
        )
    axes[0].set_xscale("log" if dt > 0 else "linear")
    plots.log_error(axes[0], t, curves, "largest relative energy error so far", scenario.time_unit)
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(low, high * (high / low) ** 0.45)  # room for the legend
    axes[0].legend(loc="upper left")
    axes[0].set_title("Runge–Kutta: steps of equal cost per unit of time")


PICTURES = {"path": draw_path, "energy": draw_energy}
