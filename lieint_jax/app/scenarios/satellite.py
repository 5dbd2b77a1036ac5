"""A satellite in a low orbit, from its release to its operation: its capture, and the work of every law of torque."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import field_validator

from lieint_jax import measure, plots, schemes, systems, torques
from lieint_jax.app.scenarios import _body
from lieint_jax.app.scenarios import _satellite_laws as equipment
from lieint_jax.app.scenarios._body import BodyKind, inertia_matrix
from lieint_jax.app.scenarios._files import Ephemeris, SatelliteOrbitFile, given_motion
from lieint_jax.app.scenarios._keys import HOUR, NonNegative, PositiveFloat, RotationSpread, Stated, Table, Triple
from lieint_jax.app.scenarios._kind import for_last_run, picture
from lieint_jax.app.scenarios._pictures import draw_balance, draw_members
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, Quantity
from lieint_jax.app.scenarios._runs import energy, length, series
from lieint_jax.app.scenarios._spread import draw_members as draw_numbers
from lieint_jax.app.scenarios._spread import stretch_inertia, with_numbers
from lieint_jax.groups import so3
from lieint_jax.runs import Run
from lieint_jax.types import State, Step, labels

_CAPTURED = 10.0  # degrees from the nadir
_SLOW = 0.5  # °/s: detumbled


class InitialState(_body.InitialState):
    """The nominal state at t = 0; relative to space, or to the axes of the orbit: z to the nadir, x forward."""

    relative_to: Literal["space", "orbit"] = "space"
    """Relative to the orbit, attitude and angular velocity are those of the body with respect to its moving axes."""


class Spread(RotationSpread):
    """Standard deviations of the members about the nominal satellite and its state."""

    inertia: Annotated[NonNegative, Stated("second moments of mass", "of them")] = 0.0
    """Relative standard deviation of the second moments of mass along each body axis."""
    residual_dipole: Annotated[NonNegative, Stated("residual dipole", "A m²")] = 0.0
    """Standard deviation of each component of the residual dipole, in A m²."""


class Satellite(BodyKind):
    """The keys of a scenario of this kind. Units: SI; the axes of space are inertial, z to the pole."""

    time_unit: Literal["s"] = "s"  # pyright: ignore[reportIncompatibleVariableOverride]
    date: str | None = None
    """In place of epoch, a day as YYYY-MM-DD, 0 h UT: from one of them follow the Earth's field and rotation."""
    orbit: equipment.Orbit | None = None
    """Give orbit or ephemeris."""
    ephemeris: Ephemeris | None = None
    """In m and m/s."""
    residual_dipole: Triple = [0.0, 0.0, 0.0]
    """The magnetic moment of the switched-off satellite in body axes, in A m²."""
    drag: equipment.Drag | None = None
    rods: equipment.Rods | None = None
    wheels: equipment.Wheels | None = None
    max_dipole: PositiveFloat | None = None
    """The largest dipole of a magnetic torquer along each body axis, in A m²; for detumbling and unloading."""
    detumbling: equipment.Detumbling | None = None
    pointing: equipment.Pointing | None = None
    unloading: equipment.Unloading | None = None
    scheme: Literal["torqued_midpoint"] = "torqued_midpoint"
    state: InitialState  # pyright: ignore[reportIncompatibleVariableOverride]
    spread: Spread = Spread()  # pyright: ignore[reportIncompatibleVariableOverride]

    files: ClassVar[Mapping[str, type[Table]]] = {**BodyKind.files, "orbit": SatelliteOrbitFile}
    fixed: ClassVar[dict[str, str]] = BodyKind.fixed | {
        "*.window": "all members share the phases",
        "wheels.tilt_deg": "momenta of wheels are measured along axes that all members share",
    }
    fixed |= dict.fromkeys(
        ("orbit.*", "ephemeris.*", "drag.*density*", "drag.*height*"), "all members share the orbit, field and air"
    )

    @field_validator("date")
    @classmethod
    def _check_date(cls, value: str | None) -> str | None:
        try:
            datetime.date.fromisoformat(value or "2000-01-01")
        except ValueError as error:
            raise ValueError(f'must be a day such as "2026-03-01": {error}') from error
        return value

    def _check_equipment(self) -> None:
        for name in self.controls():
            if name != "pointing" and self.max_dipole is None:
                raise ValueError(f"{name} needs torquers: give max_dipole")
            if name != "detumbling" and self.wheels is None:
                raise ValueError(f"{name} needs wheels: give a table wheels")
        if self.detumbling is not None and self.unloading is not None:
            (a, b), (c, d) = self.detumbling.window, self.unloading.window
            if a < d and c < b:
                raise ValueError("detumbling and unloading use the same torquers: their windows must not overlap")

    def _check_orbit_and_wheels(self) -> None:
        self.environment()
        self._driven_inertia(jnp.asarray(inertia_matrix(self)))

    def environment(self) -> equipment.Surroundings:
        """The functions of time along the orbit."""
        motion = given_motion(self.orbit, self.ephemeris, 0.0, self.dt * self.steps)
        return equipment.surroundings(motion, self.date_of_zero(), self.drag)

    def date_of_zero(self) -> str:
        """The epoch, or the date."""
        if (self.date is None) == (self.epoch is None):
            raise ValueError("give either epoch or date: the Earth's field follows from it")
        return f"{self.date or self.epoch}"

    def controls(self) -> dict[str, equipment.Control]:
        """The laws of control in the order in which they begin."""
        given = {"detumbling": self.detumbling, "pointing": self.pointing, "unloading": self.unloading}
        return dict(sorted(((k, c) for k, c in given.items() if c is not None), key=lambda pair: pair[1].window))

    own_step = True  # every member has its own inertia and dipole
    certified = False
    unit_km = 1e-3

    def given_orbit(self) -> Callable[..., Any]:
        """In m and m/s."""
        return self.environment().orbit

    def _driven_inertia(self, locked: Any) -> Any:
        """The inertia of the body without the axial inertia of the wheels."""
        if self.wheels is None:
            return locked
        return torques.body_inertia(locked, self.wheels.axes(), self.wheels.inertia_kg_m2)

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The steps of the members, each with its own inertia and dipole, and their states."""
        around, spread = self.environment(), self.spread
        key = jax.random.fold_in(jax.random.key(self.seed), 1)
        own = jax.random.normal(key, (2, self.members, 3)).at[:, 0].set(0.0)
        nominal = jnp.asarray(inertia_matrix(self))
        locked = jax.vmap(stretch_inertia, (None, 0))(nominal, jnp.exp(spread.inertia * own[0]))
        dipoles = jnp.asarray(self.residual_dipole) + spread.residual_dipole * own[1]
        pose = self._pose(around)

        def member(own: Any, locked: Any, dipole: Any, noise: Any) -> tuple[Step, State]:
            of_member = with_numbers(self, own)
            law = torques.total(equipment.laws(of_member, around, locked, dipole))
            body = systems.torqued_body(of_member._driven_inertia(locked), law)
            q, Omega = of_member._pose(around) if own else pose
            return schemes.torqued_midpoint(body), self.state_about(body, noise, q, Omega, works=True)

        noise = self.deviates(self.indices(None))
        step, states = jax.jit(jax.vmap(member))(draw_numbers(self), locked, dipoles, noise)
        if self.wheels is not None and self.own_numbers():
            least = np.linalg.eigvalsh(np.asarray(step.system.inertia)).min(axis=-1)
            if heavy := int((least <= 0).sum()):
                raise ValueError(
                    f"spread: {heavy} members have wheels heavier than the satellite: give smaller spreads"
                )
        return step, states._replace(t=jnp.zeros((), states.p.dtype))

    def _pose(self, around: equipment.Surroundings) -> tuple[Any, Any]:
        """The nominal attitude, and the angular velocity in the body."""
        given, frame = self.state, around.frame
        q, Omega = given.attitude(), jnp.asarray(given.rate())
        if given.relative_to == "orbit":
            Omega = Omega + so3.Ad_star(q, frame.angular_velocity(0.0))
            q = so3.multiply(frame(0.0), q)
        return q, Omega

    @for_last_run
    def course(self, run: Run) -> Course:
        """The measured series of all members."""
        extra, frame = run.state.extra or {}, self.environment().frame
        axes = np.zeros((0, 3)) if self.wheels is None else np.asarray(self.wheels.axes())
        h = length(np.asarray(extra["wheels"]) @ axes) if len(axes) else np.zeros(run.state.p.shape[:2])
        nadir = measure.tilt(run, direction=lambda t: so3.Ad(frame(t), jnp.array([0.0, 0.0, 1.0])))
        rate, H = measure.rotation_rates(run), series(energy, run)
        return Course(np.rad2deg(rate), np.rad2deg(nadir), h, np.asarray(extra["works"]), H, labels(run.system))

    def conserved(self, run: Run) -> list[Conserved]:
        """The energy less the work of all laws, relative to the largest energy of each member."""
        c = self.course(run)
        size = abs(c.energy).max(axis=0)
        return [Conserved("energy less the work of all laws", c.energy - c.works.sum(axis=-1), size, ROUND_OFF)]

    def quantities(self, run: Run) -> list[Quantity]:
        """Rates, angles and momenta at the end, and when the members were captured."""
        c, t = self.course(run), np.asarray(run.t)
        slow, captured = measure.first_below(t, c.rate, _SLOW), measure.captured_since(t, c.nadir_angle, _CAPTURED)
        found = [
            Quantity("rate at the end (°/s)", c.rate[-1]),
            Quantity("z axis from the nadir at the end (°)", c.nadir_angle[-1]),
            Quantity(f"first slower than {_SLOW:g} °/s (s)", slow, ".0f"),
            Quantity(f"within {_CAPTURED:g}° of the nadir since (s)", captured, ".0f"),
        ]
        if self.wheels is not None:
            found += [
                Quantity("largest momentum of the wheels (mN m s)", 1e3 * c.wheels.max(axis=0)),
                Quantity("momentum of the wheels at the end (mN m s)", 1e3 * c.wheels[-1]),
            ]
        return found

    def phases(self, t: np.ndarray) -> list[tuple[str, int, int]]:
        """Name, first and last saved time of each phase: between the edges of the windows of control."""
        controls = self.controls()
        edges = sorted({t[0], t[-1], *(x for c in controls.values() for x in c.window if t[0] < x < t[-1])})
        found = []
        for start, stop in itertools.pairwise(edges):
            acting = [name for name, c in controls.items() if c.window[0] <= (start + stop) / 2 < c.window[1]]
            first, last = (int(np.searchsorted(t, x)) for x in (start, stop))
            if first < last:
                found.append((" and ".join(acting) or "free motion", first, last))
        return found

    def remarks(self, run: Run) -> list[str]:
        """The phases, and the work of each law in each of them."""
        c, t = self.course(run), np.asarray(run.t)
        parts = self.phases(t)
        lines = [
            f"\n  {'phase':<28}{'until (s)':>10}{'rate (°/s)':>20}{'from the nadir (°)':>22}{'wheels (mN m s)':>19}",
            f"  {'median and largest, at its end':<38}",
        ]
        for name, _, k in parts:
            pairs = [f"{np.median(x[k]):.3f}  {np.max(x[k]):.3f}" for x in (c.rate, c.nadir_angle, 1e3 * c.wheels)]
            lines.append(f"  {name:<28}{t[k]:>10.0f}{pairs[0]:>20}{pairs[1]:>22}{pairs[2]:>19}")
        lines.append(f"\n  {'work (µJ), mean of members':<28}" + "".join(f"{_short(name):>20}" for name, *_ in parts))
        for j, name in enumerate(c.names):
            values = [np.mean(c.works[k, :, j] - c.works[i, :, j]) for _, i, k in parts]
            lines.append(f"  {name:<28}" + "".join(f"{1e6 * x:>20.4f}" for x in values))
        gained = [np.mean(c.energy[k] - c.energy[i]) for _, i, k in parts]
        lines.append(f"  {'energy, changed by':<28}" + "".join(f"{1e6 * x:>20.4f}" for x in gained))
        if "bdot" in c.names:
            work = c.works[..., c.names.index("bdot")]
            braked = f"{np.sum(np.all(np.diff(work, axis=0) <= 0, axis=0))} of {work.shape[1]} starts"
            lines.append(f"\n  detumbling never raised the energy between two saved times: {braked}")
        done = c.nadir_angle[-1] <= _CAPTURED
        share = f"{done.sum()} of {done.size}, {_percent(*fraction(done))} of all starts"
        return [*lines, f"  at the end within {_CAPTURED:g}° of the nadir: {share}"]

    def _mark_phases(self, ax: Any, t: np.ndarray, named: bool = True) -> None:
        """Mark the edges of the phases on an axis in hours, with their names above it."""
        for name, first, last in self.phases(t):
            if first:
                ax.axvline(t[first] / HOUR, color="gray", lw=0.6, ls=":", zorder=1)
            if named:
                middle, at = (t[first] + t[last]) / 2 / HOUR, ("data", "axes fraction")
                look: Any = {"ha": "center", "va": "bottom", "size": 7.5}
                ax.annotate(name.replace(" and ", "\nand "), (middle, 1.0), (0, 4), at, "offset points", **look)

    @picture(3)
    def draw_phases(self, axes: np.ndarray, run: Run) -> None:
        """Plot rates, angles and momenta of the wheels of the first hundred members; the nominal one in black."""
        c, t = self.course(run), np.asarray(run.t)
        for ax, values, label in (
            (axes[0], c.rate, "angular velocity (°/s)"),
            (axes[1], c.nadir_angle, "z axis from the nadir (°)"),
            (axes[2], 1e3 * c.wheels, "momentum of the wheels (mN m s)"),
        ):
            draw_members(ax, t / HOUR, values, label, "h")
            self._mark_phases(ax, t)
        axes[1].set(ylim=(0, 180), yticks=range(0, 181, 30))
        if (c.rate > 0).all():
            axes[0].set_yscale("log")

    @picture(2)
    def draw_works(self, axes: np.ndarray, run: Run) -> None:
        """Plot the work of each law on the nominal member, and how well the works add up to the change of energy."""
        c, t = self.course(run), np.asarray(run.t)
        draw_balance(axes, t / HOUR, 1e6 * c.energy, 1e6 * c.works, c.names, unit="µJ", time_unit="h")
        for ax in axes:
            self._mark_phases(ax, t, named=False)

    @picture(2)
    def draw_capture(self, axes: np.ndarray, run: Run) -> None:
        """Plot when each start became slow, by its initial rate and fate, and how many are slow or captured."""
        left, right = axes
        c, t = self.course(run), np.asarray(run.t)
        slow = measure.first_below(t, c.rate, _SLOW, interpolate=True)
        captured, never = np.isfinite(measure.captured_since(t, c.nadir_angle, _CAPTURED)), int(np.isnan(slow).sum())
        hours = np.where(np.isnan(slow), t[-1], slow) / HOUR
        for fate, chosen, color in (("captured", captured, plots.BLUE), ("not captured", ~captured, plots.RED)):
            label = f"{fate}: {chosen.sum()} of {chosen.size}"
            plots.points(left, c.rate[0, chosen], hours[chosen], label, color)
        left.set(xlabel="initial angular velocity (°/s)", ylabel=f"first slower than {_SLOW:g} °/s, at t (h)")
        left.set(xlim=(0, None), ylim=(0, None))
        left.legend(loc="upper left", title=f"never slower: {never}, drawn at the end" if never else None)
        left.set_title(f"captured, within {_CAPTURED:g}° of the nadir for good: {_percent(*fraction(captured))}")

        curves = {f"slower than {_SLOW:g} °/s": c.rate < _SLOW}
        curves |= {f"z within {limit:g}° of the nadir": c.nadir_angle <= limit for limit in (90.0, _CAPTURED, 1.0)}
        percent = {name: 100 * x.mean(axis=1) for name, x in curves.items()}
        plots.series(right, t / HOUR, percent, "of all starts (%)", "h").set_ylim(0, 102)
        right.legend(loc="center right")
        self._mark_phases(right, t)


class Course(NamedTuple):
    """The measured series of a run."""

    rate: np.ndarray  # the size of the angular velocity in space, °/s, (times, members)
    nadir_angle: np.ndarray  # the angle of the z axis from the nadir, degrees, (times, members)
    wheels: np.ndarray  # the size of the momentum of the wheels, N m s, (times, members); 0 without wheels
    works: np.ndarray  # the work of each law, J, (times, members, laws)
    energy: np.ndarray  # the energy, J, (times, members)
    names: list[str]  # the names of the laws


def _percent(part: float, error: float) -> str:
    """A part and its error in per cent, with two digits of the error."""
    decimals = max(0, 1 - int(np.floor(np.log10(100 * error))))
    return f"({100 * part:.{decimals}f} ± {100 * error:.{decimals}f}) %"


def _short(name: str) -> str:
    """The name of a phase, shortened for the head of a column."""
    return name.replace("detumbling", "detumble").replace("pointing", "point").replace("unloading", "unload")


def fraction(chosen: np.ndarray) -> tuple[float, float]:
    """The fraction of members with a property, and its standard error.

    The error is that of Jeffreys' posterior, Beta(k + ½, n − k + ½). It is not 0 if all members have the property, and
    tends to √(p(1 − p)/n).
    """
    n, k = chosen.size, int(chosen.sum())
    p = (k + 0.5) / (n + 1)
    return k / n, float(np.sqrt(p * (1 - p) / (n + 2)))
