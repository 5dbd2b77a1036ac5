"""Tides of two bodies on a circle in the plane of their equators: recession, braking and the final locked state."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from pydantic import Field

from lieint_jax import plots, potentials, schemes, systems, tides
from lieint_jax.app.scenarios._keys import DAY, NonNegative, NumberSpread, Pair, PositiveFloat, Published, Table
from lieint_jax.app.scenarios._kind import Kind, picture
from lieint_jax.app.scenarios._runs import series, standard_deviation
from lieint_jax.app.scenarios._spread import member_values
from lieint_jax.runs import Run
from lieint_jax.types import State, Step, energy_less_work

Names = Annotated[list[str], Field(min_length=2, max_length=2)]
NonNegativePair = Annotated[list[NonNegative], Field(min_length=2, max_length=2)]

_HOUR, _YEAR = 1 / 24, 365.25  # d
_G = 6.6743e-20 * DAY**2  # km³/(kg d²)
_TERAWATT = 1e6 / DAY**3 / 1e12  # of kg km²/d³
_CONSTANT = 1e-3  # pictures show the change of what changes by less, relative to itself
_SLIGHT = 1e-2  # relative change of the distance below which a mean rate is reported


class PublishedValues(Table):
    """Published values to compare with."""

    recession_cm: Published | None = None
    """The growth of the distance in a year, in cm."""
    distance_km: Published | None = None
    """The distance of the centers when both bodies are locked, in km."""
    period_d: Published | None = None
    """The period of the locked motion, in d."""


class Tides(Kind):
    """The keys of a scenario of this kind. Lists have a number for each of the two bodies."""

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

    fixed: ClassVar[dict[str, str]] = Kind.fixed | {"lag_spread": "it is a standard deviation itself"}

    def assumption(self) -> str:
        lags = "members: both lags times one random factor" if self.lag_spread else ""
        return "; ".join(filter(None, (lags, super().assumption())))

    own_step = True  # every member has its own lags

    def deviates(self, indices: np.ndarray) -> Array:
        """The factors of the members' lags."""
        random = np.random.default_rng(self.seed).normal(size=self.members)[indices]
        return jnp.asarray(np.exp(self.lag_spread * random * (indices > 0)))

    def member(self, noise: Array) -> tuple[Step, State]:
        return self.step_with(noise), self.circle()

    def step_with(self, factor: Array) -> Step:
        """The step with both lags times a factor."""
        masses, radii = jnp.asarray(self.masses_kg), jnp.asarray(self.radii_km)
        J = jnp.repeat((jnp.asarray(self.moment_factors) * masses * radii**2)[:, None], 3, axis=1)
        lags = factor * jnp.asarray(self.lags_s) / DAY
        law = tides.constant_lag(_G, masses, radii, jnp.asarray(self.love_numbers), lags)
        gravity = potentials.point_masses(_G, masses)
        return schemes.bodies_energy_momentum(systems.rigid_bodies(masses, J, gravity, law))

    def circle(self) -> State:
        """Both bodies on a circle about their barycenter."""
        masses = jnp.asarray(self.masses_kg)
        speed = jnp.sqrt(_G * masses.sum() / self.distance_km)
        shares = jnp.stack([-masses[1], masses[0]])[:, None] / masses.sum()
        spins = 2 * np.pi / (jnp.asarray(self.rotation_periods_h) * _HOUR)
        return self.step_with(jnp.asarray(1.0)).system.state(
            shares * jnp.array([1.0, 0.0, 0.0]) * self.distance_km,
            velocities=shares * jnp.array([0.0, 1.0, 0.0]) * speed,
            angular_velocities=spins[:, None] * jnp.array([0.0, 0.0, 1.0]),
        )

    def moments(self) -> np.ndarray:
        """The moments of inertia of both bodies, (2,), or (members, 2) if they differ."""
        R = member_values(self, "radii_km")
        return member_values(self, "moment_factors") * member_values(self, "masses_kg") * np.square(R)

    def course(self, run: Run) -> Course:
        """The measured series of all members."""
        q, p, J = np.asarray(run.state.q), np.asarray(run.state.p), self.moments()
        orbital = np.cross(q[..., :3], p[..., :3])[..., 2].sum(axis=-1)
        distance, spins = np.linalg.norm(q[..., 1, :3] - q[..., 0, :3], axis=-1), p[..., 5] / J
        lost = -np.asarray(run.state.work)
        return Course(distance, spins, orbital, lost, series(energy_less_work, run), orbital + (J * spins).sum(axis=-1))

    def recession(self, run: Run) -> np.ndarray:
        """The mean growth of the distance of each member, km a year, from the gain of the orbit's momentum, L ∝ √a.

        Its accuracy is limited by the rounding of the spins, which change little in a step: 1e-3 for the Moon.
        """
        found = self.course(run)
        gained = -((found.spins[-1] - found.spins[0]) * self.moments()).sum(axis=-1)
        return 2 * member_values(self, "distance_km") * gained / found.orbital[0] / (float(run.t[-1]) / _YEAR)

    def locked(self, L: float) -> tides.LockedOrbit:
        """The outer locked motion of the nominal bodies with the angular momentum L, in km and d."""
        R, factors = (np.asarray(x) for x in (self.radii_km, self.moment_factors))
        return tides.double_synchronous(_G, self.masses_kg, (factors * self.masses_kg * R**2).sum(), L)

    def report(self, run: Run) -> str:
        """The largest errors of the balances over the members; rates of recession and braking; the locked state."""
        found = self.course(run)
        P, H, L = np.asarray(run.state.p)[..., :3], found.balance, found.momentum
        sizes = {
            "energy H plus the energy lost": abs(H - H[0]).max() / abs(H[0]).max(),
            "linear momentum P, over that of a body": abs(P.sum(axis=2)).max() / abs(P).max(),
            "angular momentum L": abs(L - L[0]).max() / abs(L[0]).max(),
            "least loss between two saved states, over all of it": np.diff(found.lost, axis=0).min(initial=np.inf)
            / max(abs(found.lost[-1]).max(), 1e-300),
        }
        lines = ["largest relative changes of all members:", *(f"  {k:<54}{x:>10.1e}" for k, x in sizes.items())]
        rows = self._rows(found, run)
        several = self.members > 1
        lines.append("\nnominal member" + (", and the standard deviation of all:" if several else ":"))
        lines += [
            f"  {name:<54}{x[0]:>16.9g}" + (f" ± {standard_deviation(x):.2g}" if several else "")
            for name, x in rows.items()
        ]
        distance, period = self.locked(L[0, 0])
        lines += [f"  {'closed form: both locked at (km)':<54}{distance:>16.9g}"]
        lines += [f"  {'with the period (d)':<54}{period:>16.9g}"]
        names = {
            "recession_cm": "distance grows (cm a year)",
            "distance_km": "locked at (km)",
            "period_d": "period (d)",
        }
        for key, name in names.items():
            if (known := self._published().get(key)) is not None:
                error = f" ± {known.error:g}" if known.error else ""
                remark = f"; {known.remark}" if known.remark else ""
                text = f"{known.value:>16.9g}{error} ({self.source(known.source)}{remark})"
                lines.append(f"  {f'published: {name}':<54}{text}")
        return "\n".join(lines)

    def _rows(self, found: Course, run: Run) -> dict[str, np.ndarray]:
        """What is measured of all members at the end; mean rates only where they vary little."""
        days, t = 2 * np.pi / found.spins / _HOUR, float(run.t[-1])
        m = member_values(self, "masses_kg")
        GM, specific = _G * m.sum(axis=-1), found.orbital[-1] * m.sum(axis=-1) / m.prod(axis=-1)
        circle, period = specific**2 / GM, 2 * np.pi * specific**3 / GM**2
        rows = {
            "distance at the end (km)": found.distance[-1],
            "of a circle with the orbit's angular momentum (km)": circle,
            "rotation periods over that of this circle, 1st": days[-1, :, 0] * _HOUR / period,
            "and 2nd": days[-1, :, 1] * _HOUR / period,
            "power lost (TW)": (found.lost[-1] - found.lost[0]) / t * _TERAWATT,
        }
        if (abs(circle / member_values(self, "distance_km") - 1) < _SLIGHT).all():
            rows |= {
                "distance grows (cm a year)": 1e5 * self.recession(run),
                "rotation of the first body slows (ms a century)": (days[-1] - days[0])[:, 0] * 3.6e6 * 100 * _YEAR / t,
            }
        return rows

    @picture(3)
    def draw_course(self, axes: np.ndarray, run: Run) -> None:
        """Plot the distance and the angular rates of the nominal member, and its balances."""
        found, t = self.course(run), np.asarray(run.t)
        L, H = found.momentum[:, 0], found.balance[:, 0]
        _draw_distance(axes[0], t, found.distance[:, 0], self.locked(float(L[0]))[0])
        spins = {f"rotation, {name}": found.spins[:, 0, k] for k, name in enumerate(self.names)}
        _draw_rates(axes[1], t, spins | {"orbit": np.sqrt(_G * sum(self.masses_kg) / found.distance[:, 0] ** 3)})
        curves = {"angular momentum L": L / L[0] - 1, "energy H plus the energy lost": H / H[0] - 1}
        plots.log_error(axes[2], t, curves, "relative change", self.time_unit)
        for ax, title in zip(axes, ("distance of the centers", "angular rates", "balances"), strict=True):
            ax.set_title(title)


class Course(NamedTuple):
    """The measured series of a run, (times, members) or (times, members, 2)."""

    distance: np.ndarray  # the distance of the centers, km
    spins: np.ndarray  # the angular velocities about the normal of the orbit, rad/d
    orbital: np.ndarray  # the angular momentum of the orbit about its normal
    lost: np.ndarray  # the energy lost since the start
    balance: np.ndarray  # the energy plus the energy lost
    momentum: np.ndarray  # the angular momentum of orbit and bodies about the normal of the orbit


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
