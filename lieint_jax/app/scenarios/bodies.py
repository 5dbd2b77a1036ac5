"""Custom rigid bodies, one to a hundred, in potentials selected by name: distances, periods, conserved quantities.

Units: m, kg and s; reports are in hours, days and degrees. Positions and velocities are in any inertial axes,
angular velocities in the axes of each body. Gravity acts between all bodies, springs between two points of two bodies,
a field on the masses. Every member has its own masses and moments: the leaves of the step have the member axis.
"""

from __future__ import annotations

import operator
from functools import reduce
from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import Field, field_validator

from lieint_jax import measure, plots, potentials, systems
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._body import BodySpread, ExtendedBody, MultibodyKind, member_bodies
from lieint_jax.app.scenarios._kind import Kind, check_order, for_last_run, picture, step_of
from lieint_jax.app.scenarios._pictures import draw_changes
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runs import length, nominal_system, positive, series
from lieint_jax.potentials import Potential, Springs
from lieint_jax.runs import Run
from lieint_jax.systems import RigidBodies
from lieint_jax.types import State, Step

_MAX_PAIRS = 6  # pairs whose distances are reported one by one
_MAX_SHOWN = 8  # bodies and pairs in a picture and in the report's periods


class Spread(BodySpread):
    """Standard deviations of the members' bodies about the nominal one."""

    position_m: keys.NonNegative = 0.0
    """Standard deviation of each component of the position, in m."""
    velocity_m_s: keys.NonNegative = 0.0
    """Standard deviation of each component of the velocity, in m/s."""


PublishedKey = Literal["orbital_period_h", "apsidal_precession_deg_d", "rotation_period_h"]


def _check_name(value: str) -> None:
    if not value.isprintable():
        raise ValueError("must hold printable characters only")


class Body(ExtendedBody):
    """One body. Its angular velocity is in its own axes."""

    name: Annotated[keys.Text, Field(min_length=1, max_length=100), keys.checked(_check_name)]
    """The name of the body, in reports, in pictures and in `between`."""
    position_m: keys.Triple
    """The position of the center of mass, in m."""
    velocity_m_s: keys.Triple
    """The velocity of the center of mass, in m/s."""
    quaternion: keys.Quaternion | None = None
    """Attitude (w, x, y, z), body to space, of unit length, instead of euler_313_deg."""
    spread: Spread = Spread()  # pyright: ignore[reportIncompatibleVariableOverride]
    published: dict[PublishedKey, keys.Published] = {}
    """Orbital period about the first body and rotation period in hours, precession of the apsides in degrees a day."""

    def _check_attitude(self) -> None:
        if self.quaternion is not None and any(self.euler_313_deg):
            raise ValueError("give the attitude by quaternion or euler_313_deg, not both")

    def attitude(self) -> Array:
        return super().attitude() if self.quaternion is None else jnp.asarray(self.quaternion)


_KEYS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "point_masses": ((), ("G", "softening_m")),
    "maccullagh": ((), ("G",)),
    "spring": (("between", "points_m", "stiffness_n_m"), ("length_m",)),
    "uniform_field": (("field_m_s2",), ()),
}  # for each kind of potential: required keys and optional keys
_GRAVITY = ("point_masses", "maccullagh")


class Term(keys.Table):
    """A potential by its kind; several are added.

    `point_masses` is gravity between the centers, `maccullagh` gravity to second order of size over distance, which
    couples orbits and spins; `spring` joins a point of one body to a point of another; `uniform_field` acts on masses.
    """

    kind: Literal["point_masses", "maccullagh", "spring", "uniform_field"]
    G: keys.PositiveFloat | None = None
    """The constant of gravity, in m³ kg⁻¹ s⁻²; by default 6.67430e-11."""
    softening_m: keys.NonNegative | None = None
    """For point_masses: the length ε of −G m₁m₂/√(r² + ε²), in m; by default 0."""
    between: Annotated[list[str], Field(min_length=2, max_length=2)] | None = None
    """For a spring: the names of its two bodies."""
    points_m: Annotated[list[keys.Triple], Field(min_length=2, max_length=2)] | None = None
    """For a spring: its ends, each in the axes of its body from the center of mass, in m."""
    stiffness_n_m: keys.NonNegative | None = None
    """For a spring: its stiffness, in N/m."""
    length_m: keys.NonNegative | None = None
    """For a spring: the length at which it is slack, in m; by default 0."""
    field_m_s2: keys.Triple | None = None
    """For uniform_field: the acceleration of every mass, in m/s²."""

    def _check_keys(self) -> None:
        required, optional = _KEYS[self.kind]
        given = [name for name, value in self if name != "kind" and value is not None]
        for name in given:
            if name not in (*required, *optional):
                allowed = ", ".join((*required, *optional))
                raise ValueError(f"{name} is no key of the potential {self.kind!r}; allowed: {allowed}")
        missing = [name for name in required if name not in given]
        if missing:
            raise ValueError(f"the potential {self.kind!r} needs {' and '.join(missing)}")
        if self.between is not None and self.between[0] == self.between[1]:
            raise ValueError(f"a spring must join two bodies, got {self.between[0]!r} twice")
        if self.field_m_s2 is not None and not any(self.field_m_s2):
            raise ValueError("field_m_s2 must not be 0")

    def gravity(self) -> float:
        """The constant of gravity of this potential."""
        return 6.67430e-11 if self.G is None else self.G


class Bodies(MultibodyKind):
    """The keys of a scenario of this kind."""

    scheme: Literal["nystrom", "splitting", "gauss", "kepler_splitting", "bodies_energy_momentum"] = "nystrom"
    """kepler_splitting is for two bodies that attract each other."""
    order: int | list[int] | None = None
    """The order: of nystrom 6 or 4; of splitting and bodies_energy_momentum 2, 4, 6 or 8; of gauss 16 or any even one
    below it; of kepler_splitting [8, 6, 4], [8, 4] or 2. By default the first of these."""
    barycentric: bool = False
    """Whether every member's barycenter is put at rest at the origin; else positions and velocities are as given."""
    bodies: Annotated[list[Body], Field(min_length=1, max_length=100)]
    """The bodies, one table each."""
    potential: Annotated[list[Term], Field(min_length=1)]
    """The potentials that act on the bodies, one table each; they are added."""
    spread: keys.NumberSpread = keys.NumberSpread()
    """Standard deviations of numbers by their paths, such as `potential.1.G` or `bodies.NAME.position_m`."""

    fixed: ClassVar[dict[str, str]] = Kind.fixed | {
        "bodies.*.quaternion": "a unit quaternion has three degrees of freedom: give attitude_deg in [bodies.spread]"
    }

    @field_validator("bodies", "potential", mode="before")
    @classmethod
    def _check_list_of_tables(cls, value: Any, info: Any) -> Any:
        if isinstance(value, dict):
            raise ValueError(f"is a list of tables: write [[{info.field_name}]] for [{info.field_name}]")
        return value

    def _check_names_and_positions(self) -> None:
        names: dict[Any, str] = {}
        for body in self.bodies:
            if body.name in self.names()[: len(names)]:
                raise ValueError(f"two bodies have the name {body.name!r}")
            position = tuple(body.position_m)
            if position in names:
                raise ValueError(f"{names[position]} and {body.name} are at one place, {body.position_m}")
            names[position] = body.name

    def _check_potentials(self) -> None:
        gravities = [term.kind for term in self.potential if term.kind in _GRAVITY]
        if len(gravities) > 1:
            raise ValueError(f"gravity is given {len(gravities)} times, by {' and '.join(gravities)}: give it once")
        for term in self.potential:
            if term.kind != "uniform_field" and len(self.bodies) < 2:
                raise ValueError(f"the potential {term.kind!r} acts between bodies: give two [[bodies]] at least")
            for name in term.between or []:
                if name not in self.names():
                    raise ValueError(f"between has {name!r}, which is no body; there are {', '.join(self.names())}")

    def _check_scheme(self) -> None:
        check_order(self.scheme, self.order)
        if self.scheme == "kepler_splitting":
            if len(self.bodies) != 2:
                raise ValueError(f"kepler_splitting is for two bodies, got {len(self.bodies)}; use nystrom")
            if self.attraction() is None:
                raise ValueError("kepler_splitting is for bodies that attract each other; use nystrom")

    def names(self) -> list[str]:
        """The names of the bodies."""
        return [body.name for body in self.bodies]

    def attraction(self) -> Term | None:
        """The potential of gravity between the bodies, if there is one."""
        return next((term for term in self.potential if term.kind in _GRAVITY), None)

    def spreads(self) -> dict[str, tuple[float, str]]:
        return reduce(operator.or_, (body.spread.stated(self.time_unit, f"{body.name}'s ") for body in self.bodies))

    def noise_shape(self) -> tuple[int, ...]:
        return (len(self.bodies), 6, 3)

    def member(self, noise: Array) -> tuple[Step, State]:
        """The step and the state of a member, for its deviates."""
        given = self.bodies
        m, J, attitudes, rates = member_bodies(given, noise)
        bodies = systems.rigid_bodies(m, J, self._potential(m, J))
        sigma_x = jnp.asarray([[b.spread.position_m] for b in given])
        sigma_v = jnp.asarray([[b.spread.velocity_m_s] for b in given])
        x = jnp.asarray([b.position_m for b in given]) + sigma_x * noise[:, 4]
        v = jnp.asarray([b.velocity_m_s for b in given]) + sigma_v * noise[:, 5]
        if self.barycentric:
            x, v = (y - jnp.sum(m[:, None] * y, axis=0) / jnp.sum(m) for y in (x, v))
        state = bodies.state(x, attitudes, velocities=v, angular_velocities=rates)
        term = self.attraction()
        G = [term.gravity()] if term and self.scheme == "kepler_splitting" else []
        return step_of(bodies, self.scheme, self.order, *G), state

    def _potential(self, m: Array, J: Array) -> Potential:
        """The sum of the potentials, all springs in one."""
        terms: list[Potential] = []
        for term in self.potential:
            if term.kind == "point_masses":
                softening = 0.0 if term.softening_m is None else term.softening_m
                terms.append(potentials.point_masses(term.gravity(), m, softening=softening))
            elif term.kind == "maccullagh":
                terms.append(potentials.maccullagh(term.gravity(), m, J))
            elif term.kind == "uniform_field":
                terms.append(potentials.uniform_field(keys.array(term.field_m_s2), m))
        springs = [term for term in self.potential if term.kind == "spring"]
        return reduce(operator.add, terms + ([_springs(self.names(), springs)] if springs else []))

    def _in_orbit(self) -> bool:
        """Whether the bodies move under gravity between them, without a field that pulls them along."""
        return self.attraction() is not None and all(term.kind != "uniform_field" for term in self.potential)

    @for_last_run
    def distances(self, run: Run) -> np.ndarray:
        """The distances of all pairs i < j, (times, members, pairs)."""
        return measure.distances(run) if len(self.bodies) > 1 else np.zeros((*run.state.q.shape[:2], 0))

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy and momenta, relative to the greatest term of each."""
        K, H, Phi, each = series(_invariants, run)
        linear, angular = (positive(length(x).max(axis=(0, 2))) for x in (each[..., :3], each[..., 3:]))
        return [
            Conserved("energy H, over the greatest kinetic energy", H, positive(K.max(axis=0))),
            Conserved("linear momentum P, over the greatest |p|", Phi[..., :3], linear, norm=length),
            Conserved("angular momentum L, over the greatest |x × p + π|", Phi[..., 3:], angular, norm=length),
        ]

    def quantities(self, run: Run) -> list[Quantity]:
        """Distances and periods of orbits and rotations, with published values."""
        rows, rates = _distances(self.names(), self.distances(run)), measure.rotation_rates(run).mean(axis=0)
        for k in range(1, min(len(self.bodies), _MAX_SHOWN) if self._in_orbit() else 0):
            rows += self._orbit(k, run)
        for k, body in enumerate(self.bodies[:_MAX_SHOWN]):
            hours = 2 * np.pi / np.maximum(rates[..., k], keys.TINY) / keys.HOUR
            name = f"{body.name}: rotation period, mean rate (h)"
            rows.append(_row(name, hours, body.published.get("rotation_period_h")))
        return rows

    def _orbit(self, k: int, run: Run) -> list[Quantity]:
        """The orbit of body k about the first: nan for less than one revolution, or without lines to measure."""
        first, body, found = self.bodies[0], self.bodies[k], measure.apsides(measure.relative_motion(run, 0, k))
        name, known = f"{body.name} about {first.name}: period (h)", body.published
        apsides = np.rad2deg(found.precession_rate) * keys.DAY
        return [
            _row(name, found.period / keys.HOUR, known.get("orbital_period_h")),
            _row("  eccentricity of the mean ellipse", found.eccentricity),
            _row("  precession of the line of apsides (°/d)", apsides, known.get("apsidal_precession_deg_d")),
        ]

    def remarks(self, run: Run) -> list[str]:
        """How periods are measured, and which momenta a field does not conserve."""
        lines = []
        if self._in_orbit():
            days = abs(run.t[-1] - run.t[0]) / keys.DAY
            lines.append(f"  periods: mean rates of longitudes about L over {days:.4g} d, by least squares")
        if any(term.kind == "uniform_field" for term in self.potential):
            lines.append("  conserved in a field: P across the field and L about it only")
        return lines

    @picture(3)
    def draw_motion(self, axes: np.ndarray, run: Run) -> None:
        """Plot the nominal bodies' paths about their barycenter, their distances from the first, and the errors."""
        left, middle, right = axes
        one, names, distances = run.member(0), self.names(), self.distances(run)[:, 0]
        x, m = np.asarray(one.state.q[..., :3]), np.asarray(nominal_system(one).masses)
        x = x - (m @ x / m.sum())[:, None]
        unit, seconds = _clock(float(abs(run.t[-1] - run.t[0])))
        t = np.asarray(run.t) / seconds
        shown = dict(zip(names, np.moveaxis(x, 1, 0)[:_MAX_SHOWN], strict=False))
        plots.paths(left, shown).set(xlabel="x (m)", ylabel="y (m)", title="nominal member, about the barycenter")
        left.legend(loc="upper left", bbox_to_anchor=(1, 1))
        if len(names) > 1:
            curves = dict(zip(names[1:_MAX_SHOWN], distances[:, : len(names) - 1].T, strict=False))
            plots.series(middle, t, curves, f"distance from {names[0]} (m)", unit)
            for curve, look in zip(middle.lines, plots.STYLES[1:], strict=False):  # the style of each body's path
                curve.set(**look)
            middle.legend()
        else:
            plots.series(middle, t, dict(zip("xyz", one.state.q[:, 0, :3].T, strict=True)), "position (m)", unit)
        middle.set_title("nominal member")
        draw_changes(right, t, self.conserved(run), unit)
        right.set_title(run.step.name)


def _springs(names: list[str], springs: list[Term]) -> Springs:
    return potentials.springs(
        [[names.index(name) for name in term.between or []] for term in springs],
        keys.array([term.points_m for term in springs]),
        keys.array([term.stiffness_n_m for term in springs]),
        keys.array([0.0 if term.length_m is None else term.length_m for term in springs]),
    )


def _invariants(system: RigidBodies, state: State) -> tuple[Array, ...]:
    """Kinetic energy, energy, momenta P and L, and the momenta p and x × p + π of each body."""
    x, p, spin = state.q[:, :3], state.p[:, :3], state.p[:, 3:]
    each = jnp.concatenate([p, jnp.cross(x, p) + spin], axis=1)
    return system.kinetic_energy(state), system.energy(state), system.momentum(state), each


def _row(name: str, values: np.ndarray, published: keys.Published | None = None) -> Quantity:
    """A quantity of the report; a body at rest has an infinite period."""
    return Quantity(name, np.where(values < 1e300, values, np.inf), ".6g", published=published)


def _distances(names: list[str], distances: np.ndarray) -> list[Quantity]:
    """The least and the greatest distance of each pair, or of all pairs if they are many."""
    pairs = {
        f"{names[i]}–{names[j]}": distances[..., k]
        for k, (i, j) in enumerate(zip(*np.triu_indices(len(names), 1), strict=True))
    }
    if len(pairs) > _MAX_PAIRS:
        pairs = {"all pairs": np.moveaxis(distances, -1, 0).reshape(-1, distances.shape[1])}
    rows = []
    for pair, x in pairs.items():
        rows += [_row(f"{pair}: least distance (m)", x.min(axis=0)), _row("  greatest (m)", x.max(axis=0))]
    return rows


def _clock(span: float) -> tuple[str, float]:
    """The unit of the time axis for a run of a length in seconds, and its size in seconds."""
    return next(((unit, size) for unit, size in (("d", keys.DAY), ("h", keys.HOUR)) if span > 2 * size), ("s", 1.0))
