"""A heavy top: its conserved quantities, nutation and precession beside the closed form, its axis on the sphere."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import field_validator

from lieint_jax import diagnostics, plots, systems
from lieint_jax._numerics import three
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import frame
from lieint_jax.scenarios._body import TopScenario, ensemble, in_space, inertia_matrix, top_schemes
from lieint_jax.scenarios._common import LONGEST, POINTS, Triple, deviation, follow, largest_changes, nominal, series
from lieint_jax.scenarios._runge_kutta import RungeKutta, cost
from lieint_jax.systems import PotentialTop, kovalevskaya_integral, lagrange_motion
from lieint_jax.types import State, Step, Trajectory

_LONG = 10  # length of the energies' picture, over that of the run
_SAMPLES = 6  # the fewest saved states per nutation from which it is measured


class Scenario(TopScenario):
    """The keys of a scenario of this kind."""

    system: Literal["heavy_top"]  # pyright: ignore[reportIncompatibleVariableOverride]
    weight: Triple
    """The weight times the vector to the centre of mass, in body axes: an energy."""
    axis: Triple = [0.0, 0.0, 1.0]
    """The direction in space along which the potential energy grows: upwards."""

    @field_validator("weight", "axis")
    @classmethod
    def _a_direction(cls, value: list[float]) -> list[float]:
        if not any(value):
            raise ValueError("must not be zero; a body without weight is a rigid_body")
        return value


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step and the batch of initial states."""
    top = systems.heavy_top(scenario.inertia, scenario.weight, scenario.axis)
    return top_schemes(scenario, top)[scenario.scheme], ensemble(scenario, top)


class Comparison(NamedTuple):
    """A measured quantity beside its closed form: nominal value, standard deviation over the members, closed form."""

    name: str
    nominal: float
    spread: float
    closed_form: float


def report(scenario: Scenario, step: Any, run: Trajectory) -> str:
    """The changes of conserved quantities, worst of all members; nutation and precession beside the closed form."""
    lines = largest_changes(changes(step.system, run), 34)
    unit, known = scenario.time_unit, is_lagrange(step.system)
    lines += [f"\n  {'':<34}{'nominal':>10}{'± ensemble':>12}{'closed form' if known else '':>14}"]
    rows = quantities(step.system, run, unit)
    for row in rows:
        nominal, spread, closed = (
            f"{x:.5f}" if np.isfinite(x) else "—" for x in (row.nominal, row.spread, row.closed_form)
        )
        lines.append(f"  {row.name:<34}{nominal:>10}{spread:>12}{closed if known else '':>14}".rstrip())
    if known:
        lines.append("  closed form: elliptic integrals; the difference is the scheme's error, that of its order in dt")
    else:
        lines.append("  (a closed form is known for J₁ = J₂ and the weight along the third axis: Lagrange's top)")
    if any(np.isnan(row.nominal) for row in rows):
        lines.append(f"  — not measured: fewer than two nutations, or states saved fewer than {_SAMPLES} times in one")
    return "\n".join(lines)


def is_lagrange(top: PotentialTop) -> bool:
    """True if the top is symmetric about the axis to its centre of mass, and that axis is the third."""
    J, E = inertia_matrix(top), _weight(top)
    size = 1e-12 * J.max()
    symmetric = abs(J[0, 0] - J[1, 1]) <= size and abs(J - np.diag(np.diag(J))).max() <= size
    return bool(symmetric and abs(E[:2]).max() <= 1e-12 * abs(E[2]))


def changes(top: PotentialTop, run: Trajectory) -> dict[str, float]:
    """Largest relative changes of the integrals: energy over the initial ½Π·J⁻¹Π + |E||γ|, momenta over |π|."""
    size = np.linalg.norm(_weight(top)) * np.linalg.norm(np.asarray(top.axis))
    kinetic = series(top.kinetic_energy, run)[0]
    momentum = np.linalg.norm(np.asarray(run.state.p[0]), axis=-1) * np.linalg.norm(np.asarray(top.axis))
    found = {
        "energy, relative": _change(series(top.energy, run), kinetic + size),
        "γ·π, relative to |π|": _change(series(lambda z: top.momentum(z)[0], run), momentum),
    }
    J, E = inertia_matrix(top), _weight(top)
    if is_lagrange(top):
        found["Π₃, relative to |π|"] = _change(series(lambda z: top.body_momentum(z)[2], run), momentum)
    if np.allclose(J, np.diag([2.0, 2.0, 1.0]) * J[2, 2], rtol=1e-12, atol=0) and not E[1:].any():
        K = series(lambda z: kovalevskaya_integral(top, z), run)
        found["Kovalevskaya's integral, relative"] = _change(K, np.maximum(abs(K[0]), (size / J[2, 2]) ** 2))
    return found


def _change(x: np.ndarray, size: np.ndarray) -> float:
    return float((abs(x - x[0]) / size).max())


def _weight(top: PotentialTop) -> np.ndarray:
    return np.asarray(top.potential.weight)  # pyright: ignore[reportFunctionMemberAccess]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x)


def quantities(top: PotentialTop, run: Trajectory, unit: str) -> list[Comparison]:
    """Nutation and precession of the axis to the centre of mass, measured for every member, and in closed form."""
    motions = np.array([motion(top, run, m) for m in range(run.state.p.shape[1])])
    closed = np.full(4, np.nan)
    if is_lagrange(top):
        exact = lagrange_motion(top, nominal(run))
        closed = np.array([exact.nutation_period, exact.precession_rate, *np.rad2deg(exact.inclination)])
    names = (
        f"nutation period ({unit})",
        f"mean precession (rad/{unit})",
        "least inclination (°)",
        "greatest inclination (°)",
    )
    columns = zip(names, motions[0], deviation(motions), closed, strict=True)
    return [Comparison(name, *map(float, x)) for name, *x in columns]


def motion(top: PotentialTop, run: Trajectory, member: int = 0) -> np.ndarray:
    """Nutation period, mean precession rate, least and greatest inclination (°) of a member, over whole nutations.

    They are interpolated at the times when the axis is lowest; nan if there are fewer than two such times, or if states
    are saved too far apart.
    """
    q, p = (jnp.asarray(x[:, member]) for x in (run.state.q, run.state.p))
    t, axis = np.asarray(run.t), _unit(np.asarray(top.axis))
    e, velocity = (np.asarray(x) for x in _axis_and_velocity(top, State(q, p), _unit(_weight(top))))
    u, slope = e @ axis, velocity @ axis
    across = np.stack(frame(jnp.asarray(axis)))
    phi = np.unwrap(np.arctan2(*(across @ e.T)[::-1]))
    angle = np.rad2deg(np.arccos(np.clip(u, -1, 1)))
    lowest = np.flatnonzero(
        (slope[:-1] < 0) & (slope[1:] >= 0) if t[-1] > t[0] else (slope[:-1] > 0) & (slope[1:] <= 0)
    )
    period = rate = np.nan
    if len(lowest) > 1 and np.diff(lowest).min() >= _SAMPLES:
        part = slope[lowest] / (slope[lowest] - slope[lowest + 1])
        at, turned = (x[lowest] + part * (x[lowest + 1] - x[lowest]) for x in (t, phi))
        period = abs(at[-1] - at[0]) / (len(at) - 1)
        rate = (turned[-1] - turned[0]) / (at[-1] - at[0])
    return np.array([period, rate, angle.min(), angle.max()])


@jax.jit
def _axis_and_velocity(top: PotentialTop, states: State, axis: Any) -> tuple[Any, Any]:
    """The direction in space of an axis of the body, and its velocity, (n, 3) each."""

    def one(state: State) -> tuple[Any, Any]:
        moved = jnp.stack(three.cross(top.angular_velocity(state), axis))
        return so3.Ad(state.q, axis), so3.Ad(state.q, moved)

    return jax.vmap(one)(states)


@plots.style()
def draw_path(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot the axis to the centre of mass on the sphere, for one turn about γ or the whole run, and its inclination."""
    top, unit = step.system, scenario.time_unit
    rate = motion(top, run)[1]
    steps = scenario.steps
    if np.isfinite(rate) and rate:
        steps = min(steps, int(2 * np.pi / abs(rate * scenario.dt)) + 1)
    long = follow(step, nominal(run), scenario.dt, steps)
    weight, axis = _unit(_weight(top)), _unit(np.asarray(top.axis))
    path, ends = in_space(long.state.q, weight), in_space(run.state.q[-1], weight)
    fig, axes = plots.figure(2)
    axes[0, 0].remove()
    left, right = fig.add_subplot(1, 2, 1, projection="3d"), axes[0, 1]
    plots.sphere_path(left, path, axis, eye=axis + 0.8 * path[0], pole_label="γ")
    if scenario.members > 1:
        plots.sphere_points(left, ends, f"members at t = {run.t[-1]:.4g}", color=plots.INK, s=2, alpha=0.5)
    left.legend(loc="lower left")
    left.set_title(f"the axis in space to t = {long.t[-1]:.4g} {unit}")
    plots.series(
        right, np.asarray(long.t), {"": np.rad2deg(np.arccos(np.clip(path @ axis, -1, 1)))}, "inclination (°)", unit
    )
    if is_lagrange(top):
        for bound in np.rad2deg(lagrange_motion(top, nominal(run)).inclination):
            right.axhline(bound, color=plots.RED, lw=0.7, ls="--")
        right.set_title("nutation; dashed, its bounds in closed form")
    fig.suptitle(scenario.title)
    return fig


@plots.style()
def draw_energy(scenario: Scenario, step: Any, run: Trajectory) -> Figure:
    """Plot the largest energy error so far of each scheme, and of Runge–Kutta at the cost of the slower scheme."""
    top, start, dt = step.system, nominal(run), scenario.dt
    both, peer = top_schemes(scenario, top), RungeKutta(top)
    ratio = cost(peer, start, dt) / max(cost(scheme, start, dt) for scheme in both.values())
    end = dt * min(_LONG * scenario.steps, LONGEST)
    t, curves = np.linspace(0, end, POINTS + 1)[1:], {}
    for scheme, h in [*((s, dt) for s in both.values()), (peer, dt * ratio)]:
        long = follow(scheme, start, h, round(end / h), round(end / h))
        error = np.abs(np.asarray(diagnostics.energy_error(top, long))) / abs(float(top.energy(start)))
        curves[f"{scheme.name.split('[so3')[0]}, Δt = {h:.2g}"] = np.interp(
            abs(t), np.abs(long.t), np.maximum.accumulate(error)
        )
    fig, axes = plots.figure(size=(6.4, 4.2))
    axes[0, 0].set_xscale("log" if dt > 0 else "linear")
    plots.log_error(axes[0, 0], t, curves, "largest relative energy error so far", scenario.time_unit)
    axes[0, 0].set_title("Runge–Kutta takes steps of equal cost per unit of time")
    return fig


PICTURES = {"path": draw_path, "energy": draw_energy}
