"""Tides of two bodies on a circle in the plane of their equators: recession, braking and the final locked state."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from pydantic import Field

from lieint_jax import potentials, schemes, systems, tides
from lieint_jax.app import plots
from lieint_jax.app.scenarios._common import DAY, Common, NonNegative, NumberSpread, PositiveFloat, Published, Table
from lieint_jax.app.scenarios._pictures import picture
from lieint_jax.app.scenarios._runs import over_members, standard_deviation
from lieint_jax.app.scenarios._spread import draw_members, member_values, with_numbers
from lieint_jax.types import State, Step, Trajectory

Pair = Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)]
Names = Annotated[list[str], Field(min_length=2, max_length=2)]
NonNegativePair = Annotated[list[NonNegative], Field(min_length=2, max_length=2)]

_HOUR, _YEAR = 1 / 24, 365.25  # d
_G = 6.6743e-20 * DAY**2  # km³/(kg d²)
_TERAWATT = 1e6 / DAY**3 / 1e12  # of kg km²/d³
_CONSTANT = 1e-3  # pictures show the change of what changes by less, relative to itself
_SLIGHT = 1e-2  # relative change of the distance below which a mean rate is reported
STEP_AXIS = 0  # every member has its own lags


class PublishedValues(Table):
    """Published values to compare with."""

    recession_cm: Published | None = None
    """The growth of the distance in a year, in cm."""
    distance_km: Published | None = None
    """The distance of the centers when both bodies are locked, in km."""
    period_d: Published | None = None
    """The period of the locked motion, in d."""


class Scenario(Common):
    """The keys of a scenario of this kind. Lists have a number for each of the two bodies."""

    system: Literal["tides"]  # pyright: ignore[reportIncompatibleVariableOverride]
    time_unit: Literal["d"] = "d"  # pyright: ignore[reportIncompatibleVariableOverride]
    names: Names = ["first body", "second body"]
    """The names of the bodies in pictures."""
    masses_kg: Pair
    """In kg."""
    radii_km: Pair
    """In km."""
    moment_factors: Pair
    """The moment of inertia over mass times squared radius; 0.4 for a homogeneous ball."""
    love_numbers: NonNegativePair
    """k₂, the response of a body to tides of degree 2."""
    lags_s: NonNegativePair
    """The constant time lags of the tides, in s."""
    lag_spread: NonNegative = 0.0
    """The standard deviation of the logarithm of both lags over the members."""
    distance_km: PositiveFloat
    """The initial distance of the centers, in km, on a circle."""
    rotation_periods_h: Pair
    """Sidereal, in hours, in the sense of the orbit."""
    spread: NumberSpread = NumberSpread()
    """Standard deviations of numbers by their paths, such as `love_numbers`."""
    published: PublishedValues | None = None

    fixed: ClassVar[dict[str, str]] = Common.fixed | {"lag_spread": "it is a standard deviation itself"}

    def assumption(self) -> str:
        lags = "members: both lags times one random factor" if self.lag_spread else ""
        return "; ".join(filter(None, (lags, super().assumption())))


def build(scenario: Scenario) -> tuple[Step, State]:
    """The steps of the members, each with its own lags, and their states."""
    random = np.random.default_rng(scenario.seed).normal(size=scenario.members)
    factors = jnp.asarray(np.exp(scenario.lag_spread * random * (np.arange(scenario.members) > 0)))
    own = draw_members(scenario)
    step = jax.vmap(lambda factor, own: _step(with_numbers(scenario, own), factor))(factors, own)
    if own:
        return step, jax.vmap(lambda own: _start(with_numbers(scenario, own)))(own)
    return step, jax.tree.map(lambda x: jnp.repeat(x[None], scenario.members, axis=0), _start(scenario))


def _step(scenario: Scenario, factor: Array) -> Step:
    masses, radii = (jnp.asarray(x) for x in (scenario.masses_kg, scenario.radii_km))
    J = jnp.repeat((jnp.asarray(scenario.moment_factors) * masses * radii**2)[:, None], 3, axis=1)
    lags = factor * jnp.asarray(scenario.lags_s) / DAY
    law = tides.constant_lag(_G, masses, radii, jnp.asarray(scenario.love_numbers), lags)
    gravity = potentials.point_masses(_G, masses)
    return schemes.bodies_energy_momentum(systems.rigid_bodies(masses, J, gravity, law))


def _start(scenario: Scenario) -> State:
    """Both bodies on a circle about their barycenter."""
    masses = jnp.asarray(scenario.masses_kg)
    speed = jnp.sqrt(_G * masses.sum() / scenario.distance_km)
    shares = jnp.stack([-masses[1], masses[0]])[:, None] / masses.sum()
    spins = 2 * np.pi / (jnp.asarray(scenario.rotation_periods_h) * _HOUR)
    return _step(scenario, jnp.asarray(1.0)).system.state(
        shares * jnp.array([1.0, 0.0, 0.0]) * scenario.distance_km,
        velocities=shares * jnp.array([0.0, 1.0, 0.0]) * speed,
        angular_velocities=spins[:, None] * jnp.array([0.0, 0.0, 1.0]),
    )


class Course(NamedTuple):
    """The measured series of a run, (times, members) or (times, members, 2).

    Attributes:
        distance: the distance of the centers, km.
        spins: the angular velocities about the normal of the orbit, rad/d.
        orbital: the angular momentum of the orbit about its normal.
        lost: the energy lost since the start.
    """

    distance: np.ndarray
    spins: np.ndarray
    orbital: np.ndarray
    lost: np.ndarray


def course(scenario: Scenario, run: Trajectory) -> Course:
    """The measured series of all members."""
    q, p = np.asarray(run.state.q), np.asarray(run.state.p)
    orbital = np.cross(q[..., :3], p[..., :3])[..., 2].sum(axis=-1)
    distance = np.linalg.norm(q[..., 1, :3] - q[..., 0, :3], axis=-1)
    return Course(distance, p[..., 5] / _moments(scenario), orbital, -np.asarray(run.state.work))


def recession(scenario: Scenario, run: Trajectory) -> np.ndarray:
    """The mean growth of the distance of each member, km a year, from the gain of the orbit's momentum, L ∝ √a.

    Its accuracy is limited by the rounding of the spins, which change little in a step: 1e-3 for the Moon.
    """
    found = course(scenario, run)
    gained = -((found.spins[-1] - found.spins[0]) * _moments(scenario)).sum(axis=-1)
    return 2 * member_values(scenario, "distance_km") * gained / found.orbital[0] / (float(run.t[-1]) / _YEAR)


def double_synchronous(scenario: Scenario, L: float) -> tuple[float, float]:
    """The distance in km and the period in d of the outer locked motion with the angular momentum L.

    The root of L = μ√(GMa) + (J₁ + J₂)√(GM/a³) above its least value, which it has where the orbit's part is three
    times the bodies'; nan if there is none.
    """
    m, R, factors = (np.asarray(x) for x in (scenario.masses_kg, scenario.radii_km, scenario.moment_factors))
    GM, mu, J = _G * m.sum(), m.prod() / m.sum(), (factors * m * R**2).sum()
    least = np.sqrt(3 * J / mu)

    if mu * np.sqrt(GM * least) + J * np.sqrt(GM / least**3) > L:
        return np.nan, np.nan
    roots = np.roots([mu, -L / np.sqrt(GM), 0, 0, J])  # of the equation for √a, times a^(3/2)
    a = float(roots.real.max() ** 2)
    return a, 2 * np.pi * np.sqrt(a**3 / GM)


def report(scenario: Scenario, step: Step, run: Trajectory) -> str:
    """The largest errors of the balances over the members; rates of recession and braking; the locked state."""
    found = course(scenario, run)
    J = _moments(scenario)
    L = found.orbital + (J * found.spins).sum(axis=-1)
    P = np.asarray(run.state.p)[..., :3]
    H = _energies(step, run) + found.lost
    sizes = {
        "energy H plus the energy lost": abs(H - H[0]).max() / abs(H[0]).max(),
        "linear momentum P, over that of a body": abs(P.sum(axis=2)).max() / abs(P).max(),
        "angular momentum L": abs(L - L[0]).max() / abs(L[0]).max(),
    }
    lines = ["largest relative changes of all members:"]
    lines += [f"  {name:<54}{size:>10.1e}" for name, size in sizes.items()]
    lines.append(f"  {'least loss between two saved states, over all of it':<54}{_least_loss(found.lost):>10.1e}")
    days = 2 * np.pi / found.spins / _HOUR
    century = float(run.t[-1]) / (100 * _YEAR)
    power = (found.lost[-1] - found.lost[0]) / float(run.t[-1]) * _TERAWATT
    circle, period_of_circle = _circle(scenario, found)
    rows = {
        "distance at the end (km)": found.distance[-1],
        "of a circle with the orbit's angular momentum (km)": circle,
        "rotation periods over that of this circle, 1st": days[-1, :, 0] * _HOUR / period_of_circle,
        "and 2nd": days[-1, :, 1] * _HOUR / period_of_circle,
        "power lost (TW)": power,
    }
    growth = abs(circle / member_values(scenario, "distance_km") - 1)
    if (growth < _SLIGHT).all():  # otherwise the rate varies too much for a mean
        rows |= {
            "distance grows (cm a year)": 1e5 * recession(scenario, run),
            "rotation of the first body slows (ms a century)": (days[-1] - days[0])[:, 0] * 3.6e6 / century,
        }
    several = len(power) > 1
    lines.append("\nnominal member" + (", and the standard deviation of all:" if several else ":"))
    lines += [
        f"  {name:<54}{x[0]:>16.9g}" + (f" ± {standard_deviation(x):.2g}" if several else "")
        for name, x in rows.items()
    ]
    a, period = double_synchronous(scenario, float(L[0, 0]))
    lines.append(f"  {'closed form: both locked at (km)':<54}{a:>16.9g}")
    lines.append(f"  {'with the period (d)':<54}{period:>16.9g}")
    names = {"recession_cm": "distance grows (cm a year)", "distance_km": "locked at (km)", "period_d": "period (d)"}
    for key, name in names.items():
        known = getattr(scenario.published, key, None)
        if known is not None:
            error = f" ± {known.error:g}" if known.error else ""
            remark = f"; {known.remark}" if known.remark else ""
            lines.append(
                f"  {f'published: {name}':<54}{known.value:>16.9g}{error} ({scenario.source(known.source)}{remark})"
            )
    return "\n".join(lines)


def _energies(step: Step, run: Trajectory) -> np.ndarray:
    """H of all members, (times, members)."""
    states = run.state._replace(t=None, work=None)
    return over_members(lambda bodies, z: bodies.energy(z), step.system, run._replace(state=states))


def _moments(scenario: Scenario) -> np.ndarray:
    """The moments of inertia of both bodies, (2,), or (members, 2) if they differ."""
    R = member_values(scenario, "radii_km")
    return member_values(scenario, "moment_factors") * member_values(scenario, "masses_kg") * np.square(R)


def _least_loss(lost: np.ndarray) -> float:
    return float(np.diff(lost, axis=0).min(initial=np.inf) / max(abs(lost[-1]).max(), 1e-300))


def _circle(scenario: Scenario, found: Course) -> tuple[np.ndarray, np.ndarray]:
    """The distance, km, and the period, d, of a circle of the angular momentum that the orbit has at the end."""
    m = member_values(scenario, "masses_kg")
    GM, mu = _G * m.sum(axis=-1), m.prod(axis=-1) / m.sum(axis=-1)
    specific = found.orbital[-1] / mu
    return specific**2 / GM, 2 * np.pi * specific**3 / GM**2


@picture(3)
def draw_course(axes: np.ndarray, scenario: Scenario, step: Step, run: Trajectory) -> None:
    """Plot the distance and the angular rates of the nominal member, and its balances."""
    found, t = course(scenario, run), np.asarray(run.t)
    L = (found.orbital + (_moments(scenario) * found.spins).sum(axis=-1))[:, 0]
    _draw_distance(axes[0], t, found.distance[:, 0], double_synchronous(scenario, float(L[0]))[0])
    n = np.sqrt(_G * sum(scenario.masses_kg) / found.distance[:, 0] ** 3)
    spins = {f"rotation, {name}": found.spins[:, 0, k] for k, name in enumerate(scenario.names)}
    _draw_rates(axes[1], t, spins | {"orbit": n})
    H = (_energies(step, run) + found.lost)[:, 0]
    curves = {"angular momentum L": L / L[0] - 1, "energy H plus the energy lost": H / H[0] - 1}
    plots.log_error(axes[2], t, curves, "relative change", scenario.time_unit)
    for ax, title in zip(axes, ("distance of the centers", "angular rates", "balances"), strict=True):
        ax.set_title(title)


def _draw_distance(ax: Axes, t: np.ndarray, distance: np.ndarray, locked: float) -> None:
    """Plot the distance and that of the locked state, or only the growth in cm if it is less than a thousandth."""
    if np.ptp(distance) <= _CONSTANT * distance[0]:
        plots.series(ax, t, {"": 1e5 * (distance - distance[0])}, f"growth from {distance[0]:g} km (cm)", "d")
        return
    plots.series(ax, t, {"": distance}, "distance (km)", "d")
    ax.axhline(locked, color=plots.RED, lw=0.7, ls="--", zorder=3, label="both locked, closed form")
    ax.legend(loc="center right")


def _draw_rates(ax: Axes, t: np.ndarray, rates: dict[str, np.ndarray]) -> None:
    """Plot angular rates, or their relative changes if all are less than a thousandth."""
    if all(np.ptp(rate) <= _CONSTANT * rate[0] for rate in rates.values()):
        plots.series(ax, t, {name: rate / rate[0] - 1 for name, rate in rates.items()}, "relative change", "d")
    else:
        plots.series(ax, t, rates, "angular rate (rad/d)", "d")


PICTURES = {"course": draw_course}
