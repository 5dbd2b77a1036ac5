"""A satellite in a low orbit, from its release to its work: what captures it, and the work of every law of torque."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import field_validator, model_validator

from lieint_jax import schemes, systems, torques
from lieint_jax.app import plots
from lieint_jax.app.scenarios import _body
from lieint_jax.app.scenarios._common import Above, NonNegative, Triple, deviates
from lieint_jax.app.scenarios._pictures import picture
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, Quantity
from lieint_jax.app.scenarios._runs import for_last_run, over_members
from lieint_jax.app.scenarios._satellite_laws import (
    Control,
    Detumbling,
    Drag,
    Orbit,
    Pointing,
    Rods,
    Surroundings,
    Unloading,
    Wheels,
    laws,
    surroundings,
)
from lieint_jax.app.scenarios._spread import drawn, stretch_inertia, with_numbers
from lieint_jax.groups import so3
from lieint_jax.systems import TorquedBody
from lieint_jax.types import State, Step, Trajectory, labels

STEP_AXIS = 0  # every member has an inertia and a dipole of its own
CERTIFIED = False  # control and friction conserve no form and no momentum; the report has the balance of energy
_CAPTURED = 10.0  # degrees from the nadir
_SLOW = 0.5  # °/s: detumbled


class InitialState(_body.InitialState):
    """The nominal state at t = 0; relative to space, or to the axes of the orbit: z to the nadir, x forward."""

    relative_to: Literal["space", "orbit"] = "space"
    """Relative to the orbit, attitude and angular velocity are those of the body with respect to its moving axes."""


class Spread(_body.Spread):
    """Standard deviations of the members about the nominal satellite and its state."""

    inertia: NonNegative = 0.0
    """Of the logarithms of the second moments of mass along the body axes, so of about this part of them."""
    residual_dipole: NonNegative = 0.0
    """Of each component, in A m²."""


class Scenario(_body.BodyScenario):
    """The keys of a scenario of this kind. Units: SI; the axes of space are inertial, z to the pole."""

    system: Literal["satellite"]  # pyright: ignore[reportIncompatibleVariableOverride]
    time_unit: Literal["s"] = "s"  # pyright: ignore[reportIncompatibleVariableOverride]
    date: str
    """YYYY-MM-DD, 0 h UT, at t = 0: from it follow the Earth's field and rotation."""
    orbit: Orbit
    residual_dipole: Triple = [0.0, 0.0, 0.0]
    """The magnetic moment of the switched-off satellite in body axes, in A m²."""
    drag: Drag | None = None
    rods: Rods | None = None
    wheels: Wheels | None = None
    max_dipole: Above | None = None
    """Of each magnetic torquer, along the body axes, in A m²; needed for detumbling and unloading."""
    detumbling: Detumbling | None = None
    pointing: Pointing | None = None
    unloading: Unloading | None = None
    scheme: Literal["torqued_midpoint"] = "torqued_midpoint"
    state: InitialState  # pyright: ignore[reportIncompatibleVariableOverride]
    spread: Spread = Spread()  # pyright: ignore[reportIncompatibleVariableOverride]

    fixed: ClassVar[dict[str, str]] = _body.BodyScenario.fixed | {
        **dict.fromkeys(("orbit.*", "drag.*density*", "drag.*height*"), "all members share the orbit, field and air"),
        "*.window": "all members share the phases",
        "wheels.tilt_deg": "momenta of wheels are measured along axes that all members share",
    }

    @field_validator("date")
    @classmethod
    def _a_day(cls, value: str) -> str:
        try:
            datetime.date.fromisoformat(value)
        except ValueError as error:
            raise ValueError(f'must be a day such as "2026-03-01": {error}') from error
        return value

    @model_validator(mode="after")
    def _equipment_is_there(self) -> Self:
        torquers = [name for name in ("detumbling", "unloading") if getattr(self, name) is not None]
        if torquers and self.max_dipole is None:
            raise ValueError(f"{torquers[0]} needs torquers: give max_dipole")
        for name in ("pointing", "unloading"):
            if getattr(self, name) is not None and self.wheels is None:
                raise ValueError(f"{name} needs wheels: give a table wheels")
        if self.detumbling is not None and self.unloading is not None:
            (a, b), (c, d) = self.detumbling.window, self.unloading.window
            if a < d and c < b:
                raise ValueError("detumbling and unloading use the same torquers: their windows must not overlap")
        return self

    @model_validator(mode="after")
    def _the_earth_is_there(self) -> Self:
        self.around()
        _driven_inertia(self, jnp.asarray(_matrix(self.inertia)))
        return self

    def around(self) -> Surroundings:
        """The functions of time along the orbit."""
        return surroundings(self.orbit, datetime.date.fromisoformat(self.date), self.drag)

    def controls(self) -> dict[str, Control]:
        """The laws of control in the order in which they begin."""
        given = {name: getattr(self, name) for name in ("detumbling", "pointing", "unloading")}
        return dict(sorted(((k, c) for k, c in given.items() if c is not None), key=lambda pair: pair[1].window))

    def spreads(self) -> dict[str, tuple[float, str]]:
        more = {
            "second moments of mass": (self.spread.inertia, "of them"),
            "residual dipole": (self.spread.residual_dipole, "A m²"),
        }
        return super().spreads() | more


def _matrix(inertia: Any) -> np.ndarray:
    J = np.asarray(inertia, float)
    return np.diag(J) if J.ndim == 1 else J


def _driven_inertia(scenario: Scenario, locked: Any) -> Any:
    """The inertia that moves with the momentum π: without the axial parts of the wheels."""
    if scenario.wheels is None:
        return locked
    return torques.body_inertia(locked, scenario.wheels.axes(), scenario.wheels.inertia_kg_m2)


def build(scenario: Scenario) -> tuple[Step, State]:
    """The steps of the members, each with an inertia and a dipole of its own, and their states."""
    around, spread = scenario.around(), scenario.spread
    key = jax.random.fold_in(jax.random.key(scenario.seed), 1)
    own = jax.random.normal(key, (2, scenario.members, 3)).at[:, 0].set(0.0)
    locked = jax.vmap(stretch_inertia, (None, 0))(
        jnp.asarray(_matrix(scenario.inertia)), jnp.exp(spread.inertia * own[0])
    )
    dipoles = jnp.asarray(scenario.residual_dipole) + spread.residual_dipole * own[1]
    q, Omega = _initial(scenario, around)
    kick, jolt = jnp.swapaxes(deviates(scenario), 0, 1)
    kick, jolt = jnp.deg2rad(spread.attitude_deg) * kick, spread.rate() * jolt

    def member(own: Any, locked: Any, dipole: Any, kick: Any, jolt: Any) -> tuple[Step, State]:
        its = with_numbers(scenario, own)
        law = torques.total(laws(its, around, locked, dipole))
        body = systems.torqued_body(_driven_inertia(its, locked), law)
        attitude, rate = _initial(its, around) if own else (q, Omega)
        state = body.state(so3.multiply(so3.exp(kick), attitude), angular_velocity=rate + jolt, works=True)
        return schemes.torqued_midpoint(body), state

    step, states = jax.jit(jax.vmap(member))(drawn(scenario), locked, dipoles, kick, jolt)
    _check_wheels(scenario, step)
    return step, states._replace(t=jnp.zeros((), states.p.dtype))


def _check_wheels(scenario: Scenario, step: Any) -> None:
    """ValueError if members have wheels whose axial inertia is larger than that of the satellite with them."""
    if scenario.wheels is not None and scenario.own_numbers():
        heavy = int((np.linalg.eigvalsh(np.asarray(step.system.inertia)).min(axis=-1) <= 0).sum())
        if heavy:
            raise ValueError(f"spread: {heavy} members have wheels heavier than the satellite: give smaller spreads")


def _initial(scenario: Scenario, around: Surroundings) -> tuple[Any, Any]:
    """The nominal attitude, and the angular velocity in the body."""
    given, frame = scenario.state, around.frame
    q, Omega = given.attitude(), jnp.asarray(given.rate())
    if given.relative_to == "orbit":
        Omega = Omega + so3.Ad_star(q, frame.angular_velocity(0.0))
        q = so3.multiply(frame(0.0), q)
    return q, Omega


class Course(NamedTuple):
    """What is measured of a run.

    Attributes:
        rate: the size of the angular velocity in space, °/s, (times, members).
        off: the angle of the z axis from the nadir, degrees, (times, members).
        wheels: the size of the momentum of the wheels, N m s, (times, members); 0 without wheels.
        works: of each law, J, (times, members, laws).
        energy: (times, members).
        names: of the laws.
    """

    rate: np.ndarray
    off: np.ndarray
    wheels: np.ndarray
    works: np.ndarray
    energy: np.ndarray
    names: list[str]


def course(scenario: Scenario, body: TorquedBody, run: Trajectory) -> Course:
    """The course of all members."""
    return _course(scenario, body, run)


@for_last_run
def _course(scenario: Scenario, body: TorquedBody, run: Trajectory) -> Course:
    axes = None if scenario.wheels is None else scenario.wheels.axes()

    def measured(body: TorquedBody, state: State) -> tuple[Any, ...]:
        Omega = body.angular_velocity(state)
        z = so3.Ad(state.q, jnp.array([0.0, 0.0, 1.0], state.q.dtype))
        extra: Any = state.extra
        h = jnp.zeros(()) if axes is None else jnp.linalg.norm(extra["wheels"] @ axes)
        return jnp.linalg.norm(Omega), z, h, extra["works"], body.energy(state)

    rate, z, h, works, energy = over_members(measured, body, run)
    frames = jax.vmap(scenario.around().frame)(jnp.asarray(run.t))
    down = np.asarray(jax.vmap(so3.Ad, (0, None))(frames, jnp.array([0.0, 0.0, 1.0])))[:, None]
    angle = np.arctan2(np.linalg.norm(np.cross(z, down), axis=-1), np.sum(z * down, axis=-1))
    return Course(np.rad2deg(rate), np.rad2deg(angle), h, works, energy, labels(body))


def conserved(scenario: Scenario, body: TorquedBody, run: Trajectory) -> list[Conserved]:
    """The energy less the work of all laws, relative to the largest energy of each member."""
    c = course(scenario, body, run)
    size = abs(c.energy).max(axis=0)
    return [Conserved("energy less the work of all laws", c.energy - c.works.sum(axis=-1), size, ROUND_OFF)]


def quantities(scenario: Scenario, body: TorquedBody, run: Trajectory) -> list[Quantity]:
    """Rates, angles and momenta at the end, and when the members were captured."""
    c = course(scenario, body, run)
    found = [
        Quantity("rate at the end (°/s)", c.rate[-1]),
        Quantity("z axis from the nadir at the end (°)", c.off[-1]),
        Quantity(f"first slower than {_SLOW:g} °/s (s)", first_slow(np.asarray(run.t), c.rate), ".0f"),
        Quantity(f"within {_CAPTURED:g}° of the nadir since (s)", captured_since(np.asarray(run.t), c.off), ".0f"),
    ]
    if scenario.wheels is not None:
        found += [
            Quantity("largest momentum of the wheels (mN m s)", 1e3 * c.wheels.max(axis=0)),
            Quantity("momentum of the wheels at the end (mN m s)", 1e3 * c.wheels[-1]),
        ]
    return found


def first_slow(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The first saved time at which a member rotates slowly, (members,); nan if there is none."""
    slow = rate < _SLOW
    return np.where(slow.any(axis=0), t[slow.argmax(axis=0)], np.nan)


def captured_since(t: np.ndarray, off: np.ndarray) -> np.ndarray:
    """The first saved time from which on a member is near the nadir, (members,); nan if it is not at the end."""
    far = off > _CAPTURED
    last = np.where(far.any(axis=0), len(t) - 1 - far[::-1].argmax(axis=0), -1)
    return np.where(last == len(t) - 1, np.nan, t[np.minimum(last + 1, len(t) - 1)])


def phases(scenario: Scenario, t: np.ndarray) -> list[tuple[str, int, int]]:
    """Name, first and last saved time of each phase: between the edges of the windows of control."""
    controls = scenario.controls()
    edges = sorted({t[0], t[-1], *(x for c in controls.values() for x in c.window if t[0] < x < t[-1])})
    found = []
    for start, stop in itertools.pairwise(edges):
        acting = [name for name, c in controls.items() if c.window[0] <= (start + stop) / 2 < c.window[1]]
        first, last = (int(np.searchsorted(t, x)) for x in (start, stop))
        if first < last:
            found.append((" and ".join(acting) or "free motion", first, last))
    return found


def remarks(scenario: Scenario, step: Any, run: Trajectory) -> list[str]:
    """The phases, and the work of each law in each of them."""
    c, t = course(scenario, step.system, run), np.asarray(run.t)
    parts = phases(scenario, t)
    lines = [
        f"\n  {'phase':<28}{'until (s)':>10}{'rate (°/s)':>20}{'from the nadir (°)':>22}{'wheels (mN m s)':>19}",
        f"  {'median and largest, at its end':<38}",
    ]
    for name, _, k in parts:
        pairs = [f"{np.median(x[k]):.3f}  {np.max(x[k]):.3f}" for x in (c.rate, c.off, 1e3 * c.wheels)]
        lines.append(f"  {name:<28}{t[k]:>10.0f}{pairs[0]:>20}{pairs[1]:>22}{pairs[2]:>19}")
    lines.append(f"\n  {'work (µJ), mean of members':<28}" + "".join(f"{_short(name):>20}" for name, *_ in parts))
    for j, name in enumerate(c.names):
        values = [np.mean(c.works[k, :, j] - c.works[i, :, j]) for _, i, k in parts]
        lines.append(f"  {name:<28}" + "".join(f"{1e6 * x:>20.4f}" for x in values))
    gained = [np.mean(c.energy[k] - c.energy[i]) for _, i, k in parts]
    lines.append(f"  {'energy, changed by':<28}" + "".join(f"{1e6 * x:>20.4f}" for x in gained))
    if "bdot" in c.names:
        work = c.works[..., c.names.index("bdot")]
        braked = int(np.sum(np.all(np.diff(work, axis=0) <= 0, axis=0)))
        lines.append(f"\n  the detumbling gave no energy between any two saved times to {braked} of {work.shape[1]}")
    done = int(np.sum(c.off[-1] <= _CAPTURED))
    lines.append(f"  at the end within {_CAPTURED:g}° of the nadir: {done} of {c.off.shape[1]}")
    return lines


def _short(name: str) -> str:
    """A name of a phase for the head of a column."""
    return name.replace("detumbling", "detumble").replace("pointing", "point").replace("unloading", "unload")


def _shade(ax: Any, scenario: Scenario, t: np.ndarray) -> None:
    """Mark the edges of the phases."""
    for _, first, _ in phases(scenario, t)[1:]:
        ax.axvline(t[first], color="gray", lw=0.6, ls=":")


@picture(2, 2)
def draw_phases(axes: Any, scenario: Scenario, step: Any, run: Trajectory) -> None:
    """Plot rates and angles of all members, the wheels' momenta, and the work of each law on the nominal member."""
    c, t = course(scenario, step.system, run), np.asarray(run.t)
    shown = slice(0, 100)
    for ax, values, label in (
        (axes[0], c.rate, "angular velocity (°/s)"),
        (axes[1], c.off, "z axis from the nadir (°)"),
        (axes[2], 1e3 * c.wheels, "momentum of the wheels (mN m s)"),
    ):
        others = ax.plot(t, values[:, shown], color=plots.BLUE, lw=0.4, alpha=0.4)
        nominal = ax.plot(t, values[:, 0], color=plots.INK, lw=1.0)
        ax.set(xlabel="t (s)", ylabel=label)
        _shade(ax, scenario, t)
        ax.legend([nominal[0], others[0]], ["nominal member", "other members"])
    if (c.rate > 0).all():
        axes[0].set_yscale("log")
    works: Mapping[str, np.ndarray] = {name: 1e6 * c.works[:, 0, j] for j, name in enumerate(c.names)}
    for name, work in works.items():
        axes[3].plot(t, work, lw=0.9, label=name.replace("_", " "))
    axes[3].set_yscale("symlog", linthresh=0.1)
    axes[3].set(xlabel="t (s)", ylabel="work of each law (µJ)")
    axes[3].legend(fontsize="small")
    _shade(axes[3], scenario, t)


@picture(2)
def draw_capture(axes: Any, scenario: Scenario, step: Any, run: Trajectory) -> None:
    """Plot when each start was slow and captured against its initial rate, and how many of them are, with time."""
    left, right = axes
    c, t = course(scenario, step.system, run), np.asarray(run.t)
    events = (
        (first_slow(t, c.rate), plots.BLUE, f"slower than {_SLOW:g} °/s"),
        (captured_since(t, c.off), plots.ORANGE, f"within {_CAPTURED:g}° of the nadir for good"),
    )
    for since, color, label in events:
        reached = np.isfinite(since)
        left.scatter(c.rate[0, reached], since[reached], s=5, color=color, label=f"{label}: {reached.sum()}")
    left.set(xlabel="initial angular velocity (°/s)", ylabel=f"reached at t ({scenario.time_unit})")
    left.set_ylim(0, t[-1])
    left.legend()
    for limit, color in ((90.0, plots.ORANGE), (_CAPTURED, plots.BLUE), (1.0, plots.INK)):
        right.plot(t, 100 * np.mean(c.off <= limit, axis=1), color=color, lw=0.9, label=f"within {limit:g}°")
    right.set(xlabel="t (s)", ylabel="of all starts (%)", ylim=(0, 102))
    right.legend()
    _shade(right, scenario, t)


PICTURES = {"phases": draw_phases, "capture": draw_capture}
